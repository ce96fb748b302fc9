#include "schedule.h"

#define COUNTER_MASK 0xFFFFFFFFFFu
#define TICKS_PER_US 63898u /* 1.5 ppm too many */
#define UNIT_STEPS 31200u   /* a quarter of a millisecond in steps of the delayed transmission */
#define STEP_TICKS 512u
#define STEPS_PER_DOUBLING 16u
#define LONGEST_PERIOD_CODE 0x9Fu

/* Before an RMARKER: preamble of 128 symbols and SFD, 139 us (docs/radio.md), and the receiver's start, 16 us. */
#define PREAMBLE_US 155u
/* Of the preamble the receiver may miss this. */
#define SPARE_US 60u
/* After an RMARKER: 127 bytes, at most (`core/air/frame.py`). */
#define FRAME_US 190u
/* To each side: what a hand-over over the SPI and stamps need, */
#define GUARD_US 10u
/* what two crystals gain on each other, 40 ppm (`core/ticks.py`), */
#define DRIFT_PPM 40u
/* and over a sleep, that is counted by 32768 Hz and begins and ends within a period each. Users have measured that crystal
 * 100 to 120 ppm off; once known, its rate changes by less. */
#define SLEEP_GUARD_US 65u
#define SLOW_DRIFT_PPM 150u
#define KNOWN_DRIFT_PPM 4u
/* From a decision until the chip has it. */
#define SETTING_US 40
/* For beacons that did not come, as others were on the air, this number of later ones is waited for. */
#define SPARE_TURNS 3u
/* An anchor that was missed more often is no longer expected. */
#define MOST_MISSED 8u

static int64_t from_to(uint64_t earlier_ticks, uint64_t later_ticks)
{
    return (int64_t)((later_ticks - earlier_ticks) << 24) >> 24;
}

/* 32 bits that depend on all bits of 32 (Wellons' lowbias32). */
static uint32_t mixed(uint32_t value)
{
    value = ((value >> 16) ^ value) * 0x7FEB352Du;
    value = ((value >> 15) ^ value) * 0x846CA68Bu;
    return (value >> 16) ^ value;
}

uint64_t schedule_gap_ticks(uint32_t anchor, uint32_t sequence, uint32_t period_code)
{
    uint32_t drawn = mixed(mixed(anchor) ^ (sequence & 0xFFu));
    uint32_t steps = ((STEPS_PER_DOUBLING + (period_code & 15u)) << (period_code >> 4)) * UNIT_STEPS;

    return (uint64_t)((steps / 2u) + (uint32_t)(((uint64_t)steps * drawn) >> 32)) * STEP_TICKS;
}

/* Expect an anchor's next beacon. */
static void advance(struct expected *one)
{
    uint64_t gap_ticks = schedule_gap_ticks(one->anchor, one->sequence, one->period_code);

    one->due_ticks = (one->due_ticks + gap_ticks) & COUNTER_MASK;
    one->age_us += gap_ticks / TICKS_PER_US;
    one->sequence++;
}

/* The row of an anchor; of one that is new a fresh one, if need be in place of the one that was missed most. */
static struct expected *row_of(struct schedule *schedule, uint32_t anchor)
{
    uint32_t weakest = 0u;

    for (uint32_t row = 0u; row < schedule->count; row++) {
        if (schedule->anchors[row].anchor == anchor) {
            return &schedule->anchors[row];
        }
        weakest = (schedule->anchors[row].missed > schedule->anchors[weakest].missed) ? row : weakest;
    }
    if (schedule->count < SCHEDULE_ANCHORS) {
        weakest = schedule->count;
        schedule->count++;
    }
    schedule->anchors[weakest] = (struct expected){.anchor = (uint16_t)anchor};
    return &schedule->anchors[weakest];
}

/* What a prediction over a sleep was wrong by shows how the board counts time asleep. */
static void learn_rate(struct expected *one, uint64_t rx_ticks)
{
    int64_t late_ticks = from_to(one->due_ticks, rx_ticks);

    if (one->age_us > 0u) {
        int64_t wrong_ppb = (late_ticks * 15650) / (int64_t)one->age_us; /* 1e9 / 63897.6 ticks a us */

        one->rate_ppb += (int32_t)(one->has_rate ? (wrong_ppb / 2) : wrong_ppb);
        one->has_rate = true;
    }
}

void schedule_note(struct schedule *schedule, uint32_t anchor, uint32_t sequence, uint32_t period_code, uint64_t rx_ticks)
{
    if (period_code > LONGEST_PERIOD_CODE) {
        return;
    }

    struct expected *one = row_of(schedule, anchor);

    if (one->has_slept && (one->sequence == (uint8_t)sequence)) {
        learn_rate(one, rx_ticks);
    }
    one->has_slept = false;
    one->missed = 0u;
    one->sequence = (uint8_t)sequence;
    one->period_code = (uint8_t)period_code;
    one->due_ticks = rx_ticks;
    one->age_us = 0u;
    one->turns++;
    one->received++;
    advance(one);
}

static void remove_row(struct schedule *schedule, uint32_t row)
{
    schedule->count--;
    schedule->anchors[row] = schedule->anchors[schedule->count];
}

void schedule_miss(struct schedule *schedule, uint32_t row)
{
    struct expected *one = &schedule->anchors[row];

    one->missed++;
    one->turns++;
    advance(one);
    if (one->missed > MOST_MISSED) {
        remove_row(schedule, row);
    }
}

/* How far a prediction may be wrong. */
static uint32_t guard_us(const struct expected *one)
{
    uint64_t asleep_ppm = one->has_rate ? KNOWN_DRIFT_PPM : SLOW_DRIFT_PPM;
    uint64_t drift_ppm = one->has_slept ? asleep_ppm : DRIFT_PPM;

    return GUARD_US + (uint32_t)((one->age_us * drift_ppm) / 1000000u) + (one->has_slept ? SLEEP_GUARD_US : 0u);
}

static int64_t ticks_of(int64_t microseconds)
{
    return microseconds * (int64_t)TICKS_PER_US;
}

bool schedule_next(struct schedule *schedule, uint64_t now_ticks, struct window *window)
{
    while (schedule->count > 0u) {
        int64_t soonest_ticks = INT64_MAX;
        uint32_t guard = 0u;

        for (uint32_t row = 0u; row < schedule->count; row++) {
            const struct expected *one = &schedule->anchors[row];
            uint32_t own_us = guard_us(one);
            int64_t begin_ticks = from_to(now_ticks, one->due_ticks) - ticks_of(PREAMBLE_US + own_us);

            if (begin_ticks < soonest_ticks) {
                soonest_ticks = begin_ticks;
                window->row = row;
                guard = own_us;
            }
        }
        if ((soonest_ticks + ticks_of(SPARE_US + guard)) >= ticks_of(SETTING_US)) {
            int64_t begin_ticks = (soonest_ticks > ticks_of(SETTING_US)) ? soonest_ticks : ticks_of(SETTING_US);

            window->begin_ticks = (now_ticks + (uint64_t)begin_ticks) & COUNTER_MASK;
            window->length_us = PREAMBLE_US + (2u * guard) + FRAME_US;
            return true;
        }
        schedule_miss(schedule, window->row);
    }
    return false;
}

bool schedule_is_done(const struct schedule *schedule, uint32_t beacons)
{
    for (uint32_t row = 0u; row < schedule->count; row++) {
        const struct expected *one = &schedule->anchors[row];

        if ((one->received < beacons) && (one->turns < (beacons + SPARE_TURNS))) {
            return false;
        }
    }
    return schedule->count > 0u;
}

/* All gaps of an anchor one after the other, with which its sequence numbers begin again. */
static int64_t round_ticks(const struct expected *one)
{
    uint64_t total_ticks = 0u;

    for (uint32_t sequence = 0u; sequence < 256u; sequence++) {
        total_ticks += schedule_gap_ticks(one->anchor, sequence, one->period_code);
    }
    return (int64_t)total_ticks;
}

static void carry_over(struct expected *one, uint64_t before_ticks, uint64_t now_ticks, uint64_t slept_us)
{
    int64_t slept_ticks = (int64_t)(slept_us * 638976u) / 10;
    int64_t left_ticks = from_to(before_ticks, one->due_ticks) - slept_ticks + ((slept_ticks / 1000000) * one->rate_ppb) / 1000;
    int64_t all_ticks = round_ticks(one);

    one->has_slept = true;
    while (left_ticks + all_ticks < 0) {
        left_ticks += all_ticks;
        one->age_us += (uint64_t)all_ticks / TICKS_PER_US;
    }
    while (left_ticks < 0) {
        uint64_t due_ticks = one->due_ticks;

        advance(one);
        left_ticks += from_to(due_ticks, one->due_ticks);
    }
    one->due_ticks = (now_ticks + (uint64_t)left_ticks) & COUNTER_MASK;
}

void schedule_wake(struct schedule *schedule, uint64_t before_ticks, uint64_t now_ticks, uint64_t slept_us)
{
    for (uint32_t row = schedule->count; row > 0u; row--) {
        struct expected *one = &schedule->anchors[row - 1u];

        carry_over(one, before_ticks, now_ticks, slept_us);
        one->turns = 0u;
        one->received = 0u;
        if (ticks_of(2 * (int64_t)guard_us(one)) > (round_ticks(one) / 512)) {
            remove_row(schedule, row - 1u);
        }
    }
}
