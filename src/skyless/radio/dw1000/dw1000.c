#include "dw1000.h"

#include <string.h>

#include "dw1000_registers.h"

#define WRITE 0x80u

struct setting {
    uint8_t file;
    uint16_t sub;
    uint8_t octets;
    uint32_t value;
};

/* Channel 5, PRF 64 MHz, 6.8 Mbit/s, preamble of 128 symbols with code 9. */
static const struct setting CONFIGURATION[] = {
    {0x1Fu, 0x0000u, 4u, CHAN_CTRL},
    {0x08u, 0x0000u, 4u, TX_FCTRL},
    {0x23u, 0x0004u, 2u, 0x889Bu},     /* AGC_TUNE1 (UM 7.2.36, Table 24) */
    {0x23u, 0x000Cu, 4u, 0x2502A907u}, /* AGC_TUNE2 (Table 25) */
    {0x23u, 0x0012u, 2u, 0x0035u},     /* AGC_TUNE3 (Table 26) */
    {0x27u, 0x0002u, 2u, 0x0001u},     /* DRX_TUNE0b: 6.8 Mbit/s, standard SFD (UM 7.2.40.2, Table 30) */
    {0x27u, 0x0004u, 2u, 0x008Du},     /* DRX_TUNE1a: PRF 64 (7.2.40.3, Table 31) */
    {0x27u, 0x0006u, 2u, 0x0020u},     /* DRX_TUNE1b: preambles of 128 to 1024 (7.2.40.4, Table 32) */
    {0x27u, 0x0008u, 4u, 0x313B006Bu}, /* DRX_TUNE2: PRF 64, PAC 8 (7.2.40.5, Tables 33, 6) */
    {0x27u, 0x0020u, 2u, 129u},        /* DRX_SFDTOC: 128 + 1 + SFD 8 - PAC 8; never 0 (7.2.40.7) */
    {0x27u, 0x0026u, 2u, 0x0028u},     /* DRX_TUNE4H: preambles from 128 (7.2.40.10, Table 34) */
    {0x28u, 0x000Bu, 1u, 0xD8u},       /* RF_RXCTRLH: channel 5 (UM 7.2.41, Table 37) */
    {0x28u, 0x000Cu, 4u, 0x001E3FE0u}, /* RF_TXCTRL: channel 5 (Table 38) */
    {0x2Au, 0x000Bu, 1u, 0xC0u},       /* TC_PGDELAY: channel 5 (UM 7.2.43, Table 40) */
    {0x2Bu, 0x0007u, 4u, 0x0800041Du}, /* FS_PLLCFG: channel 5 (UM 7.2.44, Table 43) */
    {0x2Bu, 0x000Bu, 1u, 0xBEu},       /* FS_PLLTUNE: channel 5 (Table 44) */
    {0x2Eu, 0x0806u, 1u, 0x6Du},       /* LDE_CFG1: PMULT 3, NTM 13 (UM 7.2.47.2, 2.5.5.4) */
    {0x2Eu, 0x1806u, 2u, 0x0607u},     /* LDE_CFG2: PRF 64 (7.2.47.6, 2.5.5.5) */
    {0x2Eu, 0x2804u, 2u, 0x28F4u},     /* LDE_REPC: code 9 (7.2.47.7) */
};

/* 100 000 log10(1 + i/32) */
static const uint16_t LOG10_TABLE[33] = {
    0u,     1336u,  2633u,  3892u,  5115u,  6305u,  7463u,  8591u,  9691u,  10763u, 11810u,
    12832u, 13830u, 14806u, 15761u, 16695u, 17609u, 18505u, 19382u, 20242u, 21085u, 21913u,
    22724u, 23521u, 24304u, 25072u, 25828u, 26570u, 27300u, 28018u, 28724u, 29419u, 30103u,
};

/* 65536 atan(i/32) / 2 pi */
static const uint16_t ANGLE_TABLE[33] = {
    0u,    326u,  651u,  975u,  1297u, 1617u, 1933u, 2246u, 2555u, 2860u, 3159u,
    3453u, 3742u, 4025u, 4302u, 4572u, 4836u, 5094u, 5344u, 5589u, 5826u, 6058u,
    6282u, 6500u, 6712u, 6917u, 7117u, 7310u, 7498u, 7679u, 7856u, 8026u, 8192u,
};

/* Arithmetic */

/* Towards minus infinity; the divisor is positive. */
static int32_t floor_divide(int32_t value, int32_t by)
{
    int32_t quotient = value / by;

    return ((value % by) < 0) ? (quotient - 1) : quotient;
}

int32_t dw1000_log10(uint32_t value)
{
    int32_t exponent = 15;

    while (value >= 0x10000u) {
        value >>= 1;
        exponent++;
    }
    while (value < 0x8000u) {
        value <<= 1;
        exponent--;
    }

    uint32_t at = (value - 0x8000u) >> 10;
    uint32_t low = LOG10_TABLE[at];
    uint32_t high = LOG10_TABLE[at + 1u];

    return (exponent * LOG10_2) + (int32_t)(low + (((high - low) * (value & 0x3FFu)) >> 10));
}

int32_t dw1000_accumulated(uint32_t symbols)
{
    return (symbols > 0u) ? (POWER_A + (2 * dw1000_log10(symbols))) : 0;
}

/* UM 4.7.2 */
int32_t dw1000_power_cdbm(uint32_t cir_power, int32_t level)
{
    if ((cir_power == 0u) || (level == 0)) {
        return DW1000_NOT_MEASURED;
    }
    return floor_divide(dw1000_log10(cir_power) + (17 * LOG10_2) - level + 50, 100);
}

/* UM 4.7.1 */
int32_t dw1000_first_path_cdbm(uint32_t f1, uint32_t f2, uint32_t f3, int32_t level)
{
    if (level == 0) {
        return DW1000_NOT_MEASURED;
    }
    while ((f1 >= 0x4000u) || (f2 >= 0x4000u) || (f3 >= 0x4000u)) {
        f1 >>= 1;
        f2 >>= 1;
        f3 >>= 1;
        level -= 2 * LOG10_2;
    }

    uint32_t squares = (f1 * f1) + (f2 * f2) + (f3 * f3);

    return (squares == 0u) ? DW1000_NOT_MEASURED : floor_divide(dw1000_log10(squares) - level + 50, 100);
}

/* One step of DRX_CAR_INT is -1e9 / (6.5 * 2**28) = -0.57311e-9 on channel 5 (UM p. 151, Table 35). */
int32_t dw1000_carrier_offset_ppb(int32_t integrator)
{
    if ((integrator > 57170) || (integrator < -57170)) {
        return DW1000_NOT_MEASURED;
    }
    return floor_divide(8192 - (integrator * 9390), 16384);
}

/* Angle of a vector whose components have 16 bits, from 0 to 65535 in 2^-16 turns; within 2 of them. */
uint32_t dw1000_angle(int32_t x, int32_t y)
{
    uint32_t along = (uint32_t)((x < 0) ? -x : x);
    uint32_t across = (uint32_t)((y < 0) ? -y : y);
    bool is_steep = across > along;
    uint32_t longer = is_steep ? across : along;
    uint32_t ratio = (longer > 0u) ? (((is_steep ? along : across) * 0x7FFFu) / longer) : 0u;
    uint32_t low = ANGLE_TABLE[ratio >> 10];
    uint32_t high = ANGLE_TABLE[(ratio >> 10) + 1u];
    uint32_t angle = low + ((((high - low) * (ratio & 0x3FFu)) + 0x200u) >> 10);

    angle = is_steep ? (0x4000u - angle) : angle;
    angle = (x < 0) ? (0x8000u - angle) : angle;
    return ((y < 0) ? (0x10000u - angle) : angle) & 0xFFFFu;
}

int32_t dw1000_micros_until(uint64_t now_ticks, uint64_t then_ticks)
{
    return (int32_t)(((uint32_t)(then_ticks >> 16) - (uint32_t)(now_ticks >> 16)) << 8) >> 8;
}

/* Transactions */

/* Little-endian. */
static uint64_t number(const uint8_t *data, uint32_t octets)
{
    uint64_t value = 0u;

    for (uint32_t at = octets; at > 0u; at--) {
        value = (value << 8) | data[at - 1u];
    }
    return value;
}

static uint32_t sixteen(const uint8_t *data)
{
    return (uint32_t)data[0] | ((uint32_t)data[1] << 8);
}

/* Write the header of a transaction (UM 2.2.1.2); how many octets it has. */
static uint32_t put_header(uint8_t *out, uint32_t first, uint32_t sub)
{
    out[0] = (uint8_t)(first | ((sub > 0u) ? 0x40u : 0u));
    out[1] = (uint8_t)((sub & 0x7Fu) | ((sub >= 0x80u) ? 0x80u : 0u));
    out[2] = (uint8_t)(sub >> 7);
    return (sub == 0u) ? 1u : ((sub < 0x80u) ? 2u : 3u);
}

/* Read a register into a buffer, behind the header; where the data begin. */
static const uint8_t *read_into(struct dw1000 *chip, uint8_t *into, uint32_t file, uint32_t sub, uint32_t octets)
{
    uint32_t head = put_header(chip->out, file, sub);

    (void)memset(&chip->out[head], 0, octets);
    chip->hardware->transfer(chip->out, into, head + octets);
    return &into[head];
}

static const uint8_t *read_register(struct dw1000 *chip, uint32_t file, uint32_t sub, uint32_t octets)
{
    return read_into(chip, chip->into, file, sub, octets);
}

/* Not inlined, which would cost the board half a kilobyte. */
__attribute__((noinline)) static uint64_t read_number(struct dw1000 *chip, uint32_t file, uint32_t octets)
{
    return number(read_register(chip, file, 0u, octets), octets);
}

static void write_bytes(struct dw1000 *chip, uint32_t file, uint32_t sub, const uint8_t *data, uint32_t octets)
{
    uint32_t head = put_header(chip->out, WRITE | file, sub);

    (void)memcpy(&chip->out[head], data, octets);
    chip->hardware->transfer(chip->out, chip->into, head + octets);
}

static void write_register(struct dw1000 *chip, uint32_t file, uint32_t sub, uint32_t octets, uint64_t value)
{
    const uint8_t data[5] = {(uint8_t)value, (uint8_t)(value >> 8), (uint8_t)(value >> 16), (uint8_t)(value >> 24),
                             (uint8_t)(value >> 32)};

    write_bytes(chip, file, sub, data, octets);
}

static void read_status(struct dw1000 *chip)
{
    chip->status = read_number(chip, 0x0Fu, STATUS_OCTETS);
}

static void clear_status(struct dw1000 *chip, uint64_t events)
{
    write_register(chip, 0x0Fu, 0u, STATUS_OCTETS, events);
}

/* Clear what the last reading of SYS_STATUS has shown; what came since stays. */
static void clear_seen(struct dw1000 *chip)
{
    clear_status(chip, chip->status & CLEARED);
}

/* Turn the transceiver off and forget all events. */
static void off_and_clear(struct dw1000 *chip)
{
    write_register(chip, 0x0Du, 0u, 1u, TRXOFF);
    clear_status(chip, CLEARED);
}

/* Starting */

static bool is_there(struct dw1000 *chip)
{
    chip->identifier = (uint32_t)read_number(chip, 0x00u, 4u);
    return chip->identifier == DEVICE_ID;
}

/* Crystal clock; nothing to be restored by the always-on block; SOFTRESET (UM 7.2.50.1, 7.2.45). */
static void soft_reset(struct dw1000 *chip)
{
    write_register(chip, 0x36u, 0x00u, 2u, 0x0201u); /* PMSC_CTRL0: SYSCLKS 1 */
    write_register(chip, 0x2Cu, 0x00u, 2u, 0u);      /* AON_WCFG */
    write_register(chip, 0x2Cu, 0x06u, 1u, 0u);      /* AON_CFG0 */
    write_register(chip, 0x2Cu, 0x02u, 1u, 0u);      /* AON_CTRL */
    write_register(chip, 0x2Cu, 0x02u, 1u, 0x02u);   /* AON_CTRL: SAVE */
    write_register(chip, 0x36u, 0x03u, 1u, 0x00u);
    chip->hardware->pause_us(1000u);
    write_register(chip, 0x36u, 0x03u, 1u, 0xF0u);
    chip->hardware->pause_us(1000u);
    write_register(chip, 0x36u, 0x00u, 2u, 0x0201u);
}

/* UM 6.3.2, 7.2.46 */
uint32_t dw1000_read_otp(struct dw1000 *chip, uint32_t address)
{
    write_register(chip, 0x2Du, 0x04u, 2u, address);
    write_register(chip, 0x2Du, 0x06u, 1u, 0x03u); /* OTP_CTRL: OTPRDEN, OTPREAD */
    write_register(chip, 0x2Du, 0x06u, 1u, 0x00u);
    return (uint32_t)number(read_register(chip, 0x2Du, 0x0Au, 4u), 4u);
}

/* What was measured when the chip or module was made: supply, temperature, crystal (UM 2.5.5.11, 8.1, 6.4). */
static void calibrate(struct dw1000 *chip)
{
    uint32_t trim;

    write_register(chip, 0x24u, 0x00u, 4u, 0x04u); /* EC_CTRL: PLLLDT, or CPLOCK means nothing (UM 7.2.37.1) */
    if ((dw1000_read_otp(chip, OTP_LDOTUNE) & 0xFFu) != 0u) {
        write_register(chip, 0x2Du, 0x12u, 1u, 0x02u); /* OTP_SF: LDO_KICK */
    }
    chip->voltage_33 = dw1000_read_otp(chip, OTP_VOLTAGE) & 0xFFu;
    chip->temperature_23 = dw1000_read_otp(chip, OTP_TEMPERATURE) & 0xFFu;
    trim = dw1000_read_otp(chip, OTP_CRYSTAL_TRIM) & 0x1Fu;
    if (trim == 0u) {
        trim = 0x10u; /* not trimmed: mid-range */
    }
    write_register(chip, 0x2Bu, 0x0Eu, 1u, 0x60u | trim); /* FS_XTALT: upper bits 011 (UM 7.2.44.5) */
}

/* The leading-edge search, without which there are no RX stamps (UM 2.5.5.10, Table 4). */
static void load_microcode(struct dw1000 *chip)
{
    write_register(chip, 0x36u, 0x00u, 2u, 0x0301u);
    write_register(chip, 0x2Du, 0x06u, 2u, 0x8000u); /* OTP_CTRL: LDELOAD */
    chip->hardware->pause_us(LDE_LOAD_US);
}

/* Let the PLL lock, without a transaction while the clock changes (UM 2.3.2). */
static bool lock(struct dw1000 *chip)
{
    write_register(chip, 0x36u, 0x00u, 2u, PMSC_RUNNING);
    for (uint32_t tries = 0u; tries < LOCK_TRIES; tries++) {
        chip->hardware->pause_us(LOCK_TRY_US);
        read_status(chip);
        if ((chip->status & CPLOCK) != 0u) {
            chip->lock_us = (tries + 1u) * LOCK_TRY_US;
            return true;
        }
    }
    return false;
}

void dw1000_init(struct dw1000 *chip, const struct hardware *hardware)
{
    (void)memset(chip, 0, sizeof *chip);
    chip->hardware = hardware;
    chip->state = DW1000_OFF;
    chip->frame = &chip->frame_into[1];
    chip->rx_power_cdbm = DW1000_NOT_MEASURED;
    chip->first_path_cdbm = DW1000_NOT_MEASURED;
    chip->offset_ppb = DW1000_NOT_MEASURED;
    chip->phase = DW1000_NO_PHASE;
    chip->temperature_cc = DW1000_NOT_MEASURED;
}

static void write_config(struct dw1000 *chip, uint32_t more)
{
    write_register(chip, 0x04u, 0u, 4u, HIRQ_POL | (chip->uses_both_buffers ? 0u : DIS_DRXB) | more);
}

/* Configure a chip whose registers are as after a reset. */
static bool configure(struct dw1000 *chip, uint32_t tx_antenna_delay, uint32_t rx_antenna_delay)
{
    calibrate(chip);
    load_microcode(chip);
    chip->start_step = DW1000_NO_LOCK;
    if (!lock(chip)) {
        return false;
    }
    chip->hardware->set_spi_fast(true);
    chip->start_step = DW1000_NO_FAST_ANSWER;
    if (!is_there(chip)) {
        return false;
    }
    write_config(chip, 0u);
    for (uint32_t at = 0u; at < (sizeof CONFIGURATION / sizeof CONFIGURATION[0]); at++) {
        const struct setting *setting = &CONFIGURATION[at];

        write_register(chip, setting->file, setting->sub, setting->octets, setting->value);
    }
    write_register(chip, 0x1Eu, 0u, 4u, TX_POWER);
    write_register(chip, 0x18u, 0u, 2u, tx_antenna_delay);      /* TX_ANTD (UM 7.2.26, p. 103) */
    write_register(chip, 0x2Eu, 0x1804u, 2u, rx_antenna_delay); /* LDE_RXANTD (7.2.47.5) */
    write_register(chip, 0x0Eu, 0u, 4u, SYS_MASK_EVENTS);
    off_and_clear(chip);
    chip->start_step = DW1000_STARTED;
    chip->state = DW1000_IDLE;
    return true;
}

/* Wake a chip that sleeps, by chip select; whether it answers then. */
static bool is_woken(struct dw1000 *chip)
{
    chip->hardware->set_spi_fast(false);
    (void)read_into(chip, chip->frame_into, 0x11u, 0u, WAKE_OCTETS);
    chip->hardware->pause_us(RESET_US);
    return is_there(chip);
}

bool dw1000_start(struct dw1000 *chip, uint32_t tx_antenna_delay, uint32_t rx_antenna_delay)
{
    chip->state = DW1000_OFF;
    chip->start_step = DW1000_NO_ANSWER;
    chip->is_listening = false;
    chip->hardware->set_spi_fast(false);
    if (!is_there(chip)) {
        (void)is_woken(chip); /* its reset pin does not wake it */
    }
    chip->hardware->reset_chip();
    chip->hardware->pause_us(RESET_US);
    if (!is_there(chip)) {
        return false;
    }
    soft_reset(chip);
    return configure(chip, tx_antenna_delay, rx_antenna_delay);
}

/* Sleeping */

void dw1000_sleep(struct dw1000 *chip)
{
    if (chip->state != DW1000_OFF) {
        off_and_clear(chip);
        write_register(chip, 0x2Cu, 0x0Au, 1u, 0u); /* AON_CFG1: no sleep counter */
        write_register(chip, 0x2Cu, 0x00u, 2u, 0u); /* AON_WCFG: nothing is restored; TX_ANTD would be wrong (UM p. 103) */
        write_register(chip, 0x2Cu, 0x06u, 1u, AON_CFG0_SLEEP);
        write_register(chip, 0x2Cu, 0x02u, 1u, 0u);
        write_register(chip, 0x2Cu, 0x02u, 1u, AON_CTRL_SAVE);
        chip->state = DW1000_OFF;
        chip->is_listening = false;
    }
}

bool dw1000_wake(struct dw1000 *chip, uint32_t tx_antenna_delay, uint32_t rx_antenna_delay)
{
    return is_woken(chip) && configure(chip, tx_antenna_delay, rx_antenna_delay);
}

/* Running */

/* Make ready a receiver that was turned off, perhaps in the middle of a frame: it must be reset then, or the next stamp
 * may be wrong (UM 4.1.6, pp. 34-35). Of two buffers the host looks at the one that will be filled (UM 4.3.2, p. 37). */
static void reset_receiver(struct dw1000 *chip)
{
    write_register(chip, 0x36u, 3u, 1u, 0xE0u);
    write_register(chip, 0x36u, 3u, 1u, 0xF0u);
    if (chip->uses_both_buffers) {
        read_status(chip);
        if (((chip->status & BUFFER_POINTERS) != 0u) && ((chip->status & BUFFER_POINTERS) != BUFFER_POINTERS)) {
            write_register(chip, 0x0Du, 3u, 1u, HRBPT);
        }
    }
}

/* Listen, or be IDLE, after the receiver was turned off. */
static void listen_again(struct dw1000 *chip)
{
    if (chip->is_listening) {
        reset_receiver(chip);
        write_register(chip, 0x0Du, 0u, 2u, RXENAB);
        chip->state = DW1000_LISTENING;
    } else {
        chip->state = DW1000_IDLE;
    }
}

static void resume(struct dw1000 *chip)
{
    off_and_clear(chip);
    listen_again(chip);
}

void dw1000_receive(struct dw1000 *chip)
{
    if (chip->state != DW1000_OFF) {
        chip->is_listening = true;
        if ((chip->state == DW1000_IDLE) || (chip->state == DW1000_AWAITING)) {
            write_config(chip, 0u);
            resume(chip);
        }
    }
}

void dw1000_idle(struct dw1000 *chip)
{
    chip->is_listening = false;
    if ((chip->state == DW1000_LISTENING) || (chip->state == DW1000_AWAITING)) {
        resume(chip);
    }
}

enum dw1000_queued dw1000_receive_at(struct dw1000 *chip, uint64_t ticks, uint32_t window)
{
    if (chip->state == DW1000_OFF) {
        return DW1000_NOT_READY;
    }
    if (chip->state == DW1000_SENDING) {
        return DW1000_BUSY;
    }
    chip->is_listening = false;
    off_and_clear(chip);
    reset_receiver(chip);
    write_config(chip, RXWTOE);
    write_register(chip, 0x0Cu, 0u, 2u, window);
    write_register(chip, 0x0Au, 0u, 5u, ticks & ~(uint64_t)0x1FFu);
    write_register(chip, 0x0Du, 0u, 2u, RXENAB_RXDLYE);
    chip->state = DW1000_AWAITING;
    read_status(chip);
    if ((chip->status & HPDWARN) != 0u) {
        dw1000_idle(chip);
        return DW1000_LATE;
    }
    return DW1000_QUEUED;
}

bool dw1000_cancel(struct dw1000 *chip)
{
    if (chip->state == DW1000_SENDING) {
        write_register(chip, 0x0Du, 0u, 1u, TRXOFF);
        read_status(chip);
        if ((chip->status & TXFRS) != 0u) {
            return false;
        }
        resume(chip);
    }
    return true;
}

enum dw1000_queued dw1000_transmit_at(struct dw1000 *chip, uint64_t dx_ticks, const uint8_t *frame, uint32_t frame_bytes)
{
    if (chip->state == DW1000_OFF) {
        return DW1000_NOT_READY;
    }
    if ((chip->state == DW1000_SENDING) || (chip->state == DW1000_AWAITING)) {
        return DW1000_BUSY;
    }

    write_bytes(chip, 0x09u, 0u, frame, frame_bytes - 2u);
    write_register(chip, 0x08u, 0u, 4u, TX_FCTRL | frame_bytes);
    write_register(chip, 0x0Au, 0u, 5u, dx_ticks & ~(uint64_t)0x1FFu);
    off_and_clear(chip);
    write_register(chip, 0x0Du, 0u, 1u, TXSTRT_TXDLYS);
    chip->state = DW1000_SENDING;

    /* Whether it will be sent at its time, or is cancelled (UM pp. 27, 91, 92). HPDWARN: its time has passed. TXPUTE: the
     * transmitter had no time to power up. What is out when TRXOFF comes counts as sent. */
    read_status(chip);
    if (((chip->status & TXFRS) == 0u) && ((chip->status & (HPDWARN | TXPUTE)) != 0u) && dw1000_cancel(chip)) {
        return DW1000_LATE;
    }
    return DW1000_QUEUED;
}

static uint32_t finish_sending(struct dw1000 *chip)
{
    chip->tx_ticks = read_number(chip, 0x17u, 5u);
    chip->sent++;
    clear_seen(chip);
    listen_again(chip);
    return DW1000_SENT;
}

/* Count an error and listen on. */
static uint32_t recover(struct dw1000 *chip)
{
    chip->errors++;
    resume(chip);
    return DW1000_FAILED;
}

/* The carrier's phase at the first path (UM 7.2.22, 7.2.23, 7.2.38): the angle of the accumulator's sample behind FP_INDEX,
 * less RCPHASE of 128 steps a turn; none where the sample is within three standard deviations of the noise. */
static int32_t read_phase(struct dw1000 *chip, uint32_t first_path, uint32_t noise)
{
    uint32_t at = (first_path >> 6) + 1u;

    if (at >= ACC_SAMPLES) {
        return DW1000_NO_PHASE;
    }

    uint32_t turned = read_register(chip, 0x14u, 4u, 1u)[0] & 0x7Fu; /* RCPHASE */

    write_register(chip, 0x36u, 0u, 2u, PMSC_FOR_ACC);

    const uint8_t *sample = read_register(chip, 0x25u, 4u * at, 5u); /* the first octet means nothing */
    int32_t x = (int16_t)sixteen(&sample[1]);
    int32_t y = (int16_t)sixteen(&sample[3]);

    write_register(chip, 0x36u, 0u, 2u, PMSC_RUNNING);
    if (((uint64_t)(x * (int64_t)x) + (uint64_t)(y * (int64_t)y)) <= (9u * (uint64_t)noise * noise)) {
        return DW1000_NO_PHASE;
    }
    return (int32_t)((dw1000_angle(x, y) - (turned << 9)) & 0xFFFFu);
}

/* Powers and phase (UM 4.7, 7.2.18, 7.2.20, 7.2.23); `symbols` that were accumulated, FP_INDEX and FP_AMPL1. */
static void read_measured(struct dw1000 *chip, uint32_t symbols, uint32_t first_path, uint32_t f1)
{
    const uint8_t *data = read_register(chip, 0x12u, 0u, 8u);
    uint32_t noise = sixteen(data);
    uint32_t f2 = sixteen(&data[2]);
    uint32_t f3 = sixteen(&data[4]);
    uint32_t cir_power = sixteen(&data[6]);
    int32_t level = dw1000_accumulated(symbols);

    chip->rx_power_cdbm = dw1000_power_cdbm(cir_power, level);
    chip->first_path_cdbm = dw1000_first_path_cdbm(f1, f2, f3, level);
    chip->phase = chip->reads_phases ? read_phase(chip, first_path, noise) : DW1000_NO_PHASE;
}

/* Read the carrier offset (UM 7.2.40.11); RXPACC_NOSAT. */
static uint32_t read_carrier(struct dw1000 *chip)
{
    const uint8_t *data = read_register(chip, 0x27u, 0x28u, 6u);

    chip->offset_ppb = dw1000_carrier_offset_ppb((int32_t)((uint32_t)number(data, 3u) << 11) >> 11);
    return sixteen(&data[4]);
}

/* Read a frame and all that was measured of it, and listen on; with a second buffer once all is read that has none. */
static uint32_t read_frame(struct dw1000 *chip)
{
    uint32_t tries = LDE_TRIES;

    while ((chip->status & LDEDONE) == 0u) {
        if (tries == 0u) {
            return recover(chip);
        }
        tries--;
        chip->hardware->pause_us(20u);
        read_status(chip);
        if ((chip->status & LDEERR) != 0u) {
            return recover(chip);
        }
    }

    uint32_t unsaturated = read_carrier(chip);
    bool is_early = chip->uses_both_buffers && !chip->reads_phases && (chip->state == DW1000_LISTENING);

    if (is_early) {
        write_register(chip, 0x0Du, 0u, 2u, RXENAB);
    }

    const uint8_t *info = read_register(chip, 0x10u, 0u, 4u);
    uint32_t size = (uint32_t)info[0] & 0x7Fu;
    uint32_t symbols = ((uint32_t)info[2] >> 4) | ((uint32_t)info[3] << 4);

    if (size < DW1000_MIN_PSDU_BYTES) {
        return recover(chip);
    }
    if (symbols == unsaturated) { /* symbols of the SFD are counted, too */
        symbols = (symbols > SFD_ACCUMULATED) ? (symbols - SFD_ACCUMULATED) : 0u;
    }
    (void)read_into(chip, chip->frame_into, 0x11u, 0u, size);

    const uint8_t *time = read_register(chip, 0x15u, 0u, 9u);

    chip->rx_ticks = number(time, 5u);
    chip->frame_bytes = size;
    read_measured(chip, symbols, sixteen(&time[5]), sixteen(&time[7]));
    chip->received++;
    clear_seen(chip);
    if (chip->uses_both_buffers) {
        write_register(chip, 0x0Du, 3u, 1u, HRBPT);
    }
    if (chip->state == DW1000_AWAITING) {
        chip->state = DW1000_IDLE;
    } else if (!is_early) {
        write_register(chip, 0x0Du, 0u, 2u, RXENAB);
    }
    return DW1000_RECEIVED;
}

uint32_t dw1000_poll(struct dw1000 *chip)
{
    uint32_t events = 0u;

    if (chip->state == DW1000_OFF) {
        return DW1000_LOST;
    }
    read_status(chip);

    uint64_t seen = chip->status;

    if ((((seen & CPLOCK) == 0u) || ((seen & (SLP2INIT | NO_EVENT)) != 0u)) && !dw1000_check(chip)) {
        return DW1000_LOST;
    }
    if ((seen & CLKPLL_LL) != 0u) {
        events = DW1000_CLOCK_SLIPPED;
        chip->clock_slips++;
        clear_status(chip, CLKPLL_LL); /* alone: a frame may be coming in */
    }
    if ((seen & RFPLL_LL) != 0u) {
        chip->carrier_slips++;
        clear_status(chip, RFPLL_LL);
    }
    if (chip->state == DW1000_SENDING) {
        events |= ((seen & TXFRS) != 0u) ? finish_sending(chip) : 0u;
    } else if ((chip->state == DW1000_AWAITING) && ((seen & RXRFTO) != 0u)) {
        dw1000_idle(chip);
        events |= DW1000_NOTHING;
    } else if (chip->state != DW1000_IDLE) {
        events |= ((seen & RX_ERRORS) != 0u) ? recover(chip) : (((seen & RXFCG) != 0u) ? read_frame(chip) : 0u);
    }
    return events;
}

bool dw1000_check(struct dw1000 *chip)
{
    if ((chip->state != DW1000_OFF) && (read_number(chip, 0x1Fu, 4u) != CHAN_CTRL)) {
        chip->state = DW1000_OFF;
        chip->is_listening = false;
    }
    return chip->state != DW1000_OFF;
}

uint32_t dw1000_read_times(struct dw1000 *chip, uint32_t file, uint32_t sub, const uint8_t *data, uint8_t *into,
                           uint32_t octets, uint32_t times)
{
    const uint8_t *expected = (data != NULL) ? data : into;
    uint32_t differing = 0u;

    for (uint32_t time = 0u; time < times; time++) {
        bool is_equal = true;

        if (data != NULL) {
            write_bytes(chip, file, sub, data, octets);
        }

        const uint8_t *found = read_register(chip, file, sub, octets);

        if (time == 0u) {
            (void)memcpy(into, found, octets);
        }
        for (uint32_t at = 0u; at < octets; at++) {
            is_equal = is_equal && (found[at] == expected[at]);
        }
        differing += is_equal ? 0u : 1u;
    }
    return differing;
}

uint64_t dw1000_now(struct dw1000 *chip)
{
    return read_number(chip, 0x06u, 5u);
}

bool dw1000_measure(struct dw1000 *chip)
{
    if ((chip->state != DW1000_IDLE) && (chip->state != DW1000_LISTENING)) {
        return false;
    }
    off_and_clear(chip);
    write_register(chip, 0x28u, 0x11u, 1u, 0x80u); /* bias of the temperature sensor (UM 6.4, pp. 158-159) */
    write_register(chip, 0x28u, 0x12u, 1u, 0x0Au); /* bias of the converter */
    write_register(chip, 0x28u, 0x12u, 1u, 0x0Fu); /* outputs */
    write_register(chip, 0x2Au, 0x00u, 1u, 0x00u); /* TC_SARC */
    write_register(chip, 0x2Au, 0x00u, 1u, 0x01u);
    chip->hardware->pause_us(1000u);

    int32_t voltage = read_register(chip, 0x2Au, 0x03u, 1u)[0];
    int32_t temperature = read_register(chip, 0x2Au, 0x04u, 1u)[0];

    /* with typical values where the chip brought none of its own */
    chip->temperature_cc = (chip->temperature_23 != 0u) ? (((temperature - (int32_t)chip->temperature_23) * 114) + 2300)
                                                        : ((temperature * 113) - 11300);
    chip->millivolts = (uint32_t)((chip->voltage_33 != 0u)
                                      ? (floor_divide((voltage - (int32_t)chip->voltage_33) * 1000, 173) + 3300)
                                      : (((voltage * 57) / 10) + 2300));
    write_register(chip, 0x2Au, 0x00u, 1u, 0x00u);
    if (chip->is_listening) {
        resume(chip);
    }
    return true;
}
