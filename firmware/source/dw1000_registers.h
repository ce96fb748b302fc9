/* Values of the DW1000's registers (DW1000 User Manual v2.12). A test compares them, by their names, with those of
 * src/skyless/radios/dw1000/driver.py, where each one's page is. */
#ifndef DW1000_REGISTERS_H
#define DW1000_REGISTERS_H

#define DEVICE_ID 0xDECA0130u

/* SYS_STATUS, octets 0 to 2 as one number; octets 3 and 4 apart */
#define CPLOCK 0x000002u
#define TXFRS 0x000080u
#define LDEDONE 0x000400u
#define RXPHE 0x001000u
#define RXFCG 0x004000u
#define RXFCE 0x008000u
#define RXRFSL 0x010000u
#define RXRFTO 0x020000u
#define LDEERR 0x040000u
#define RXOVRR 0x100000u
#define RXPTO 0x200000u
#define SLP2INIT 0x800000u
#define RX_ERRORS (RXPHE | RXFCE | RXRFSL | RXRFTO | LDEERR | RXOVRR | RXPTO)
#define CLKPLL_LL_3 0x02u
#define RXSFDTO_3 0x04u
#define HPDWARN_3 0x08u
#define AFFREJ_3 0x20u
#define RX_ERRORS_3 (RXSFDTO_3 | AFFREJ_3)
#define TXPUTE_4 0x04u
#define UNUSED_4 0xF8u

/* SYS_CTRL */
#define TXSTRT_TXDLYS 0x06u
#define TRXOFF 0x40u
#define RXENAB 0x0100u

#define TX_FCTRL 0x0016C000u
#define TX_POWER 0x25456585u
#define CHAN_CTRL 0x4A480055u

/* Addresses in the one-time programmable memory */
#define OTP_LDOTUNE 0x04u
#define OTP_PART_ID 0x06u
#define OTP_LOT_ID 0x07u
#define OTP_VOLTAGE 0x08u
#define OTP_TEMPERATURE 0x09u
#define OTP_CRYSTAL_TRIM 0x1Eu

/* Waits */
#define RESET_US 5000u
#define LDE_LOAD_US 300u
#define LOCK_TRIES 50u
#define LDE_TRIES 10u

/* Power and carrier offset */
#define SFD_ACCUMULATED 5u
#define POWER_A 1217400
#define LOG10_2 30103

#endif
