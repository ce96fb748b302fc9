/* When the next beacons come. Those of protocol 2 leave at random instants that a receiver of one of them can predict
 * (docs/protocol2.md), so that a tag's receiver can be off between them, and over a sleep.
 *
 * Times are of the chip's counter, modulo 2^40; a sleep, after which it begins again, is carried over in microseconds.
 */
#ifndef SCHEDULE_H
#define SCHEDULE_H

#include <stdbool.h>
#include <stdint.h>

#define SCHEDULE_ANCHORS 12u

/* An anchor whose next beacon is expected. */
struct expected {
    uint16_t anchor;
    uint8_t sequence;    /* of that beacon */
    uint8_t period_code; /* as the last one that was received states */
    uint8_t missed;      /* in a row */
    bool has_rate;
    bool has_slept;     /* the board, since the last one that was received */
    uint32_t turns;     /* beacons that were due since the last sleep, */
    uint32_t received;  /* and those of them that came */
    uint64_t due_ticks; /* RMARKER of the next one */
    uint64_t age_us;    /* from the last one that was received to that */
    int32_t rate_ppb;   /* by how much of a sleep beacons come later than the board has counted */
};

struct schedule {
    uint32_t count;
    struct expected anchors[SCHEDULE_ANCHORS];
};

/* When the receiver is to be on. */
struct window {
    uint32_t row;         /* of the anchor that is expected */
    uint64_t begin_ticks; /* the receiver goes on */
    uint32_t length_us;   /* until the frame has ended for sure */
};

/* A beacon was received. */
void schedule_note(struct schedule *schedule, uint32_t anchor, uint32_t sequence, uint32_t period_code, uint64_t rx_ticks);

/* The window of the next beacon that can still be received; others count as missed. False where none is expected: then
 * the receiver has to stay on. */
bool schedule_next(struct schedule *schedule, uint64_t now_ticks, struct window *window);

/* No beacon came in a window. */
void schedule_miss(struct schedule *schedule, uint32_t row);

/* Whether this number of beacons of each expected anchor has come, or can hardly be expected any more. */
bool schedule_is_done(const struct schedule *schedule, uint32_t beacons);

/* The counter, which was at `before_ticks`, has begun again and is at `now_ticks`, `slept_us` later; turns are counted
 * from now on. */
void schedule_wake(struct schedule *schedule, uint64_t before_ticks, uint64_t now_ticks, uint64_t slept_us);

/* Time from a beacon to its anchor's next one, by the anchor's counter (`core/air/almanac.py`). */
uint64_t schedule_gap_ticks(uint32_t anchor, uint32_t sequence, uint32_t period_code);

#endif
