/* Driver of the DW1000, integers only, for boards and for computers (driver.py, which has this struct's fields, too).
 * Written from the DW1000 User Manual v2.12 ("UM"); docs/dw1000.md lists which value was compared with which other
 * source. It has never run on a chip.
 *
 * States:
 *   OFF        nothing is known of the chip, or it sleeps. `dw1000_start` resets and configures it in either case,
 *              `dw1000_wake` one that sleeps; both leave it IDLE.
 *   IDLE       the radio is off. `dw1000_receive` turns the receiver on, `dw1000_receive_at` for a while.
 *   LISTENING  the receiver is on, and stays on: after each frame, after each error, after each transmission.
 *   AWAITING   the receiver goes on at its time, and off with the first frame, or where none comes in its window. Ends
 *              with DW1000_RECEIVED, DW1000_FAILED or DW1000_NOTHING from `dw1000_poll`, and IDLE.
 *   SENDING    a frame waits for its time or is on its way; the receiver is off (one DX_TIME, one transceiver), so
 *              `dw1000_transmit_at` is to be called as late as it safely can. Ends with DW1000_SENT from `dw1000_poll`,
 *              or with `dw1000_cancel`, to be called if SENT does not come within 1 ms after the frame's time.
 */
#ifndef DW1000_H
#define DW1000_H

#include <stdbool.h>
#include <stdint.h>

#include "hardware.h"

enum dw1000_state { DW1000_OFF, DW1000_IDLE, DW1000_LISTENING, DW1000_SENDING, DW1000_AWAITING };

/* What `dw1000_poll` returns, as a sum. */
#define DW1000_RECEIVED 0x01u
#define DW1000_SENT 0x02u
#define DW1000_FAILED 0x04u
#define DW1000_CLOCK_SLIPPED 0x08u
#define DW1000_LOST 0x10u
#define DW1000_NOTHING 0x20u

/* What `dw1000_transmit_at` and `dw1000_receive_at` return; the reasons have the link's numbers. */
enum dw1000_queued { DW1000_QUEUED = 0, DW1000_LATE = 1, DW1000_BUSY = 2, DW1000_NOT_READY = 3 };

/* How far `dw1000_start` came. */
enum dw1000_start_step {
    DW1000_STARTED,
    DW1000_NO_ANSWER,     /* no DW1000 answered after its reset */
    DW1000_NO_LOCK,       /* the clock's PLL did not lock */
    DW1000_NO_FAST_ANSWER /* it did not answer at the fast SPI clock */
};

#define DW1000_NOT_MEASURED (-32768)
#define DW1000_NO_PHASE (-1)
#define DW1000_MIN_PSDU_BYTES 3u
#define DW1000_MAX_PSDU_BYTES 127u
#define DW1000_MAX_TRANSFER_BYTES 132u

struct dw1000 {
    const struct hardware *hardware;
    enum dw1000_state state;
    bool is_listening;
    bool reads_phases; /* set by the caller: receptions have a phase, which takes four more transactions */
    bool uses_both_buffers; /* set by the caller before the chip's start: the receiver is on again before a frame is read,
                               unless phases are; for a radio that only listens */
    uint32_t received;
    uint32_t errors;
    uint32_t sent;

    /* Of the last frame that was received, until the next `dw1000_poll` */
    uint64_t rx_ticks;
    const uint8_t *frame;
    uint32_t frame_bytes;
    int32_t rx_power_cdbm;
    int32_t first_path_cdbm;
    int32_t offset_ppb;
    int32_t phase; /* of the carrier at the first path, in 2^-16 turns from 0 to 65535; DW1000_NO_PHASE where there is none */

    /* Of the last frame that was sent */
    uint64_t tx_ticks;

    /* Of the last `dw1000_measure` */
    int32_t temperature_cc;
    uint32_t millivolts;

    /* Of the last start, and since */
    enum dw1000_start_step start_step;
    uint32_t identifier; /* as it was read last */
    uint32_t lock_us;    /* until the clock's PLL had locked */
    uint32_t clock_slips;   /* polls that found it losing lock */
    uint32_t carrier_slips; /* the same of the carrier's PLL */

    uint32_t temperature_23; /* from the one-time programmable memory, like the next */
    uint32_t voltage_33;

    uint64_t status; /* SYS_STATUS as it was read last */
    uint8_t out[DW1000_MAX_TRANSFER_BYTES];
    uint8_t into[DW1000_MAX_TRANSFER_BYTES];
    uint8_t frame_into[DW1000_MAX_TRANSFER_BYTES];
};

void dw1000_init(struct dw1000 *chip, const struct hardware *hardware);

/* Reset and configure the chip, which is woken if it sleeps; antenna delays in ticks. False where no DW1000 answers, or
 * its clock does not lock: `start_step` says which. */
bool dw1000_start(struct dw1000 *chip, uint32_t tx_antenna_delay, uint32_t rx_antenna_delay);

/* Listen from now on; a frame that waits to be sent is sent before. */
void dw1000_receive(struct dw1000 *chip);

/* Turn the receiver off and forget what it has; a frame that waits to be sent is sent before. */
void dw1000_idle(struct dw1000 *chip);

/* Listen for one frame when the counter is at `ticks`, whose low nine bits are ignored, for at most `window` times 65536
 * ticks (1.026 us; 1 to 65535), in which the frame must have ended (UM 4.2, p. 79). Ends any reception. DW1000_LATE: that
 * time has passed, and the receiver is off. */
enum dw1000_queued dw1000_receive_at(struct dw1000 *chip, uint64_t ticks, uint32_t window);

/* Let the chip sleep deeply until it is woken: it draws some uA, forgets its settings and its counter, and is OFF. */
void dw1000_sleep(struct dw1000 *chip);

/* Wake and configure a chip that sleeps, as `dw1000_start` does one that is awake, in 6.5 ms (SPI at 2 MHz until then). */
bool dw1000_wake(struct dw1000 *chip, uint32_t tx_antenna_delay, uint32_t rx_antenna_delay);

/* Send a PSDU of 3 to 127 bytes when the counter is at `dx_ticks`, whose low nine bits are ignored (UM p. 26); the chip
 * makes the last two bytes, its FCS. Poll before, or a frame that has just come is lost. */
enum dw1000_queued dw1000_transmit_at(struct dw1000 *chip, uint64_t dx_ticks, const uint8_t *frame, uint32_t frame_bytes);

/* Cancel a frame that has not been sent; false where it has, which the next `dw1000_poll` returns. */
bool dw1000_cancel(struct dw1000 *chip);

/* What has happened since: to be called when the interrupt line is high, or periodically. */
uint32_t dw1000_poll(struct dw1000 *chip);

/* Whether the chip still has its configuration; if not it is OFF. */
bool dw1000_check(struct dw1000 *chip);

/* The counter now. */
uint64_t dw1000_now(struct dw1000 *chip);

/* Measure temperature and supply in some 1.1 ms, in which nothing is received; false where it cannot. */
bool dw1000_measure(struct dw1000 *chip);

/* Read a register several times, after writing `data` to it each time unless that is NULL. The first reading is in `into`;
 * returns how many readings differ from `data`, or from the first. */
uint32_t dw1000_read_times(struct dw1000 *chip, uint32_t file, uint32_t sub, const uint8_t *data, uint8_t *into,
                           uint32_t octets, uint32_t times);

/* A word of the one-time programmable memory. */
uint32_t dw1000_read_otp(struct dw1000 *chip, uint32_t address);

/* From one reading of the counter to another in 65536 ticks (1.026 us), negative if it was before; at most 8.6 s. */
int32_t dw1000_micros_until(uint64_t now_ticks, uint64_t then_ticks);

/* The arithmetic, for tests. */
int32_t dw1000_log10(uint32_t value);
int32_t dw1000_accumulated(uint32_t symbols);
int32_t dw1000_power_cdbm(uint32_t cir_power, int32_t level);
int32_t dw1000_first_path_cdbm(uint32_t f1, uint32_t f2, uint32_t f3, int32_t level);
int32_t dw1000_carrier_offset_ppb(int32_t integrator);
uint32_t dw1000_angle(int32_t x, int32_t y);

#endif
