/* Values of the DW1000's registers (DW1000 User Manual v2.12, "UM"); tests compare them with a published table. */
#ifndef DW1000_REGISTERS_H
#define DW1000_REGISTERS_H

#define DEVICE_ID 0xDECA0130u /* UM 7.2.2 */

/* SYS_STATUS, 40 bits (UM 7.2.17, pp. 86-92) */
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
#define RFPLL_LL (1ull << 24)
#define CLKPLL_LL (1ull << 25)
#define RXSFDTO (1ull << 26)
#define HPDWARN (1ull << 27)
#define AFFREJ (1ull << 29)
#define TXPUTE (1ull << 34)
#define RX_ERRORS (RXPHE | RXFCE | RXRFSL | RXRFTO | LDEERR | RXOVRR | RXPTO | RXSFDTO | AFFREJ)
#define NO_EVENT (0xF8ull << 32) /* bits that do not exist */
#define CLEARED 0x0737FFFFF8ull /* written back at most; CPLOCK shows that it runs as it was started */
#define STATUS_OCTETS 5u
#define SYS_MASK_EVENTS (TXFRS | RXFCG | RX_ERRORS | CLKPLL_LL) /* what raises the interrupt line (UM 7.2.16) */

#define BUFFER_POINTERS (3ull << 30) /* HSRBP and ICRBP: which receive buffer the host reads, and which the chip fills */

/* SYS_CFG (UM 7.2.6): the interrupt line is high when it says something; smart power, no filter, no RXAUTR */
#define HIRQ_POL 0x0200u
#define DIS_DRXB 0x1000u
#define RXWTOE 0x10000000u

/* SYS_CTRL (UM 7.2.15, pp. 80-84) */
#define TXSTRT_TXDLYS 0x06u
#define TRXOFF 0x40u
#define RXENAB 0x0100u
#define RXENAB_RXDLYE 0x0300u
#define HRBPT 0x01u /* in the fourth octet */

/* Sleep (UM 2.3, p. 17; 7.2.45) */
#define AON_CFG0_SLEEP 0x05u /* SLEEP_EN, WAKE_SPI; deep sleep, since WAKE_CNT is not set */
#define AON_CTRL_SAVE 0x02u
#define WAKE_OCTETS 131u /* behind a header, at 2 MHz: chip select low for 528 us of the 500 that it needs */

/* 6.8 Mbit/s, ranging bit, PRF 64 MHz, 128 symbols; the length is added (UM 7.2.10, Table 16) */
#define TX_FCTRL 0x0016C000u
/* Smart power, channel 5, PRF 64 MHz (UM 7.2.31, Tables 19 and 20); beacons use the third octet */
#define TX_POWER 0x25456585u
#define CHAN_CTRL 0x4A480055u /* channels 5, RXPRF 2, codes 9, standard SFD (UM 7.2.32) */

/* Addresses in the one-time programmable memory (UM 6.3, Table 10) */
#define OTP_LDOTUNE 0x04u
#define OTP_VOLTAGE 0x08u
#define OTP_TEMPERATURE 0x09u
#define OTP_CRYSTAL_TRIM 0x1Eu

/* Waits */
#define RESET_US 5000u /* until the chip is in INIT (data sheet 5.6: some 3 ms) */
#define LDE_LOAD_US 300u /* it takes 150 us (UM 2.5.5.10, Table 4) */
#define LOCK_TRIES 50u
#define LOCK_TRY_US 100u
#define LDE_TRIES 10u /* of 20 us */

/* The accumulator (UM 7.2.38) */
#define PMSC_RUNNING 0x0200u /* PMSC_CTRL0, low half: clocks by themselves (UM 7.2.50.1) */
#define PMSC_FOR_ACC 0x8248u /* the same with AMCE, FACE and the receiver's clock from the PLL */
#define ACC_SAMPLES 1016u /* at PRF 64 MHz */

/* Power and carrier offset */
#define SFD_ACCUMULATED 5u /* standard SFD in RXPACC where it did not saturate (UM 7.2.18, p. 95, Table 18) */
#define POWER_A 1217400 /* A at PRF 64 MHz, 121.74 dB, in 1e-4 dB (UM 4.7.1, p. 46) */
#define LOG10_2 30103 /* in 1e-5 */

#endif
