/* A board that receives and sends for its host, or is a tag by itself: the chip's driver on one side, the serial link on
 * the other.
 *
 * The host decides (docs/serial.md). The board holds at most one frame until shortly before its time, because the
 * receiver is off from then on.
 */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stdint.h>

#include "dw1000.h"
#include "hardware.h"
#include "link.h"
#include "tag.h"

enum frame_stage { NO_FRAME, FRAME_HELD, FRAME_HANDED_OVER };

/* What a board is. */
struct board_identity {
    bool can_transmit;
    uint8_t device_id[LINK_IDENTITY_BYTES];
    uint8_t reset_cause; /* as in HELLO */
};

struct board {
    const struct hardware *hardware;
    struct board_identity identity;
    struct dw1000 chip;
    struct link_writer writer;
    struct link_reader reader;
    bool is_configured;
    bool is_receiving;
    bool was_refused; /* the chip did not start when it was last configured */

    /* The frame that the host wants to be sent */
    enum frame_stage stage;
    uint64_t dx_ticks;
    uint32_t frame_bytes;
    uint8_t frame[DW1000_MAX_PSDU_BYTES];

    /* A tag by itself */
    struct settings settings;
    bool is_in_flash; /* they are what flash holds */
    uint32_t kept_baud; /* of flash, or of a new board */
    uint32_t understood_us; /* when a record of the host was understood */
    uint32_t tried_us; /* when the chip was last started for it */
    struct tag tag;

    /* Counts since the start, as in STATUS */
    uint32_t late;
    uint32_t unknown;
    uint32_t understood_until; /* garbled lines up to the last record */

    /* For `skyless selftest` */
    uint32_t reception_us; /* that the last reception took, from the look at the chip until its record was queued */
    uint32_t tested;       /* records TEST_LINE that have come */
    uint32_t tests_left;   /* records TEST to send */
    uint32_t test_bytes;   /* of one on the line */
    uint32_t test_due_us;

    /* The interrupt line */
    bool line_was_high;
    uint32_t disagreements; /* with polls, in a row */
    bool is_polled;         /* it is stuck */

    /* Times of `now_us` */
    uint32_t due_us;      /* when the frame is looked at again */
    uint32_t polled_us;
    uint32_t busy_us;     /* last event of chip or host */
    uint32_t checked_us;
    uint32_t measured_us;
    bool is_own_slot;     /* the own frame has just left */
};

void board_init(struct board *board, const struct hardware *hardware, const struct board_identity *identity);

/* Send the identity, after a 0 that ends whatever was on the line. */
void board_begin(struct board *board);

/* Serve chip, host and time once. For how many microseconds nothing is to be done unless the interrupt line rises or
 * bytes come; 0: call it again at once. */
uint32_t board_turn(struct board *board);

/* What the estimator calls now and then while it computes: serve the chip, if it has something. */
void board_pause(void);

#endif
