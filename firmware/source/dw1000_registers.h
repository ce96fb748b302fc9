/* Values of the DW1000's registers (DW1000 User Manual v2.12). A test compares them, by their names, with those of
 * src/skyless/radios/dw1000/driver.py, where each one's page is. */
#ifndef DW1000_REGISTERS_H
#define DW1000_REGISTERS_H

#define DEVICE_ID 0xDECA0130u

/* SYS_STATUS, 40 bits */
#define CPLOCK (1ull << 1)
#define TXFRS (1ull << 7)
#define LDEDONE (1ull << 10)
#define RXPHE (1ull << 12)
#define RXFCG (1ull << 14)
#define RXFCE (1ull << 15)
#define RXRFSL (1ull << 16)
#define RXRFTO (1ull << 17)
#define LDEERR (1ull << 18)
#define RXOVRR (1ull << 20)
#define RXPTO (1ull << 21)
#define SLP2INIT (1ull << 23)
#define CLKPLL_LL (1ull << 25)
#define RXSFDTO (1ull << 26)
#define HPDWARN (1ull << 27)
#define AFFREJ (1ull << 29)
#define TXPUTE (1ull << 34)
#define RX_ERRORS (RXPHE | RXFCE | RXRFSL | RXRFTO | LDEERR | RXOVRR | RXPTO | RXSFDTO | AFFREJ)
#define UNUSED (0xF8ull << 32)
#define CLEARED 0x0737FFFFF8ull /* what is written back at most */
#define STATUS_OCTETS 5u
#define SYS_MASK_EVENTS (TXFRS | RXFCG | RX_ERRORS | CLKPLL_LL)

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
