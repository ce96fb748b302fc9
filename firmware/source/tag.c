#include "tag.h"

#include <stddef.h>
#include <string.h>

#define SECOND_US 1000000u
/* How often places of anchors and the georeference are repeated. */
#define REPEAT_US 10000000u
/* Without a fix for this time the tag says why, once a second. */
#define SILENT_US 1000000u
/* Before the receiver is switched off between beacons it stays on for this time, to hear all anchors, */
#define LEARN_US 100000u
/* and again after each of these periods, to find anchors that have come into reach. */
#define SCAN_EVERY_US 10000000u
/* With fewer anchors expected it stays on. */
#define LEAST_EXPECTED 3u
/* Without a fix for this time, after its start and after a sleep, a tag that may sleep does so, for LOST_SLEEP_MS at least. */
#define FIRST_SEARCH_US 10000000u
#define SEARCH_US 500000u
#define LOST_SLEEP_MS 10000u
/* After a sleep it trusts its predictions for this time. */
#define SURE_US 200000u
/* All relays of a beacon are used where no other beacon waits; where one does, this number, and one fewer for each more. */
#define RELAYS_IF_LATE 3u
/* After its start and after a word of the host it stays awake, so that a host can reach it. */
#define HOST_US 5000000u
/* Without anything to do it looks again after this. */
#define TURN_US 10000u
#define NOT_SENT INT64_MIN

/* Why there is no fix, as the places in NoFixReason (core/fix.py), from 1. */
enum reason {
    REASON_NO_BEACONS = 1,
    REASON_NO_ALMANAC,
    REASON_TOO_FEW_ANCHORS,
    REASON_BAD_GEOMETRY,
    REASON_MIRROR,
    REASON_NOT_CONVERGED,
    REASON_RESIDUALS,
    REASON_ACQUIRING
};

static uint32_t now_us(const struct tag *tag)
{
    return tag->hardware->now_us();
}

static bool is_over(uint32_t period_us, uint32_t since_us, uint32_t at_us)
{
    return (at_us - since_us) >= period_us;
}

/* The receiver */

/* Count how long the receiver has been on all the time, and change what it does. */
static void set_receiver(struct tag *tag, enum tag_receiver next)
{
    uint32_t at_us = now_us(tag);

    tag->on_us += (tag->receiver == ALWAYS_ON) ? (at_us - tag->on_since_us) : 0u;
    tag->on_since_us = at_us;
    tag->receiver = next;
}

static void listen_all_the_time(struct tag *tag)
{
    set_receiver(tag, ALWAYS_ON);
    dw1000_receive(tag->chip);
}

/* Ask the chip to listen at the next instant at which a beacon is due. */
static void listen_at_next(struct tag *tag)
{
    while (schedule_next(&tag->schedule, dw1000_now(tag->chip), &tag->window)) {
        if (dw1000_receive_at(tag->chip, tag->window.begin_ticks, tag->window.length_us) == DW1000_QUEUED) {
            return;
        }
        schedule_miss(&tag->schedule, tag->window.row);
    }
    listen_all_the_time(tag);
}

static void listen_in_windows(struct tag *tag)
{
    set_receiver(tag, IN_WINDOWS);
    listen_at_next(tag);
}

static void expect_next(struct tag *tag, struct tag_reception *one)
{
    int32_t site = tag->core.admission.choice.site;

    if ((skyless_read_frame(one->frame, (int32_t)one->frame_bytes, &tag->beacon) == INTACT) &&
        ((site == NO_SITE) || (site == tag->beacon.site))) {
        schedule_note(&tag->schedule, (uint32_t)tag->beacon.anchor, (uint32_t)tag->beacon.sequence,
                      (uint32_t)tag->beacon.period_code, one->rx_ticks);
    }
}

/* Keep a reception; where too many wait, all that do are dropped, which a busy estimator gets over best. */
static void keep(struct tag *tag)
{
    const struct dw1000 *chip = tag->chip;
    struct tag_reception *one;

    if (tag->count == (TAG_MAX_WAITING - 1u)) { /* one more is at the estimator */
        tag->status.overload_frames += tag->count;
        tag->status.overload_superframes++;
        tag->count = 0u;
    }
    one = &tag->waiting[(tag->first + tag->count) % TAG_MAX_WAITING];
    tag->count++;
    one->rx_ticks = chip->rx_ticks;
    one->rx_power_cdbm = chip->rx_power_cdbm;
    one->first_path_cdbm = chip->first_path_cdbm;
    one->ended_us = now_us(tag);
    one->frame_bytes = chip->frame_bytes;
    (void)memcpy(one->frame, chip->frame, chip->frame_bytes);
    expect_next(tag, one);
}

void tag_on_chip(struct tag *tag, uint32_t events)
{
    const uint32_t *turns = &tag->schedule.anchors[tag->window.row].turns;
    uint32_t before = *turns;

    if ((events & DW1000_RECEIVED) != 0u) {
        keep(tag);
    }
    if ((tag->receiver == IN_WINDOWS) && ((events & (DW1000_RECEIVED | DW1000_NOTHING | DW1000_FAILED)) != 0u)) {
        tag->on_us += tag->window.length_us;
        if (*turns == before) { /* nothing came in its window, or another one */
            schedule_miss(&tag->schedule, tag->window.row);
        }
        listen_at_next(tag);
    }
}

/* Turn the receiver off between beacons, or leave it on, as the tag knows enough. */
static void choose_listening(struct tag *tag, uint32_t at_us)
{
    bool is_near = tag->has_fix || ((tag->settings->sleep_ms > 0u) && tag->has_started &&
                                    !is_over(SURE_US, tag->awake_since_us, at_us));
    bool may_predict = (tag->settings->predicts != 0u) && is_near && (tag->schedule.count >= LEAST_EXPECTED);

    if (tag->receiver == ALWAYS_ON) {
        if (may_predict && is_over(LEARN_US, tag->on_since_us, at_us)) {
            tag->scanned_us = at_us;
            listen_in_windows(tag);
        }
    } else if (!may_predict || ((tag->settings->sleep_ms == 0u) && is_over(SCAN_EVERY_US, tag->scanned_us, at_us)) ||
               (tag->has_fix && is_over(SILENT_US, tag->fixed_us, at_us))) {
        listen_all_the_time(tag);
    }
}

/* Fixes */

static int32_t millimetres(float length_m)
{
    return (int32_t)text_rounded(length_m * 1000.0f);
}

static float metres(int32_t length_mm)
{
    return (float)length_mm / 1000.0f;
}

static float dbm(int32_t power_cdbm)
{
    return (power_cdbm == DW1000_NOT_MEASURED) ? __builtin_nanf("") : ((float)power_cdbm / 100.0f);
}

static int64_t unix_us_at(const struct tag *tag, uint32_t at_us)
{
    return (tag->unix_us == 0) ? 0 : (tag->unix_us + (int32_t)(at_us - tag->unix_at_us));
}

void tag_set_time(struct tag *tag, int64_t unix_us)
{
    tag->unix_us = unix_us;
    tag->unix_at_us = now_us(tag);
}

/* The upper half of rows that the estimator leaves. */
static void fill_covariance(float *into, real (*rows)[AXES])
{
    for (uint32_t row = 0u; row < AXES; row++) {
        for (uint32_t axis = row; axis < AXES; axis++) {
            *into = rows[row][axis];
            into++;
        }
    }
}

static void fill_anchors(struct fix *fix, const struct tag *tag)
{
    const Course *course = &tag->core.course;

    fix->anchor_count = (uint32_t)course->count;
    for (uint32_t at = 0u; at < fix->anchor_count; at++) {
        fix->anchors[at].id = (uint32_t)course->used[at].anchor;
        for (uint32_t axis = 0u; axis < AXES; axis++) {
            fix->anchors[at].position_mm[axis] =
                tag->core.origin_mm[axis] + millimetres(course->used[at].position_m[axis]);
        }
    }
}

static void fill_fix(struct tag *tag, const struct tag_reception *one, bool is_alone)
{
    struct fix *fix = &tag->fix;
    const uint8_t *page = tag->core.pages.used[EARTH_KIND].contents;
    real (*rows)[AXES] = is_alone ? tag->core.course.alone : tag->shared.state.fix;
    uint32_t at_us = now_us(tag);

    fix->reason = 0u;
    fix->time_ticks = tag->core.course.time_ticks;
    fix->unix_us = unix_us_at(tag, one->ended_us);
    fix->rx_ticks = one->rx_ticks;
    fix->latency_us = at_us - one->ended_us;
    fix->serial++;
    fix->is_height_known = (tag->core.course.dim < AXES) ? 1u : 0u;
    for (uint32_t axis = 0u; axis < AXES; axis++) {
        fix->position_mm[axis] = tag->core.origin_mm[axis] + millimetres(rows[POSITION][axis]);
        fix->velocity_mmps[axis] = millimetres(rows[VELOCITY][axis]);
    }
    fill_covariance(fix->covariance_m2, &rows[POSITION + 1]);
    fill_covariance(fix->velocity_covariance, &rows[VELOCITY + 1]);
    fix->chi2 = rows[QUALITY][0];
    fix->mean_square_m2 = rows[QUALITY][1];
    fix->hpl_m = rows[PROTECTION][HPL];
    fix->vpl_m = rows[PROTECTION][VPL];
    fix->levels = (uint32_t)rows[PROTECTION][STATE];
    fill_anchors(fix, tag);
    fix->has_origin = page[0] != 0u;
    (void)memcpy(&fix->origin, &page[1], sizeof fix->origin);
    tag->has_fix = true;
    tag->has_started = true;
    tag->fixed_us = one->ended_us;
    tag->timed_us = one->ended_us;
}

/* Why outcomes of the estimator are no fix; REASON_ACQUIRING of the others. */
static const uint8_t REASONS[MALFORMED + 1] = {
    [NO_PAGES] = REASON_NO_ALMANAC,
    [NO_POSITION] = REASON_NO_ALMANAC,
    [HAS_TOO_FEW] = REASON_TOO_FEW_ANCHORS,
    [UNCONFIRMED_ANCHOR] = REASON_TOO_FEW_ANCHORS,
    [WEAKER_ANCHOR] = REASON_TOO_FEW_ANCHORS,
    [BAD_GEOMETRY] = REASON_BAD_GEOMETRY,
    [IS_MIRRORED] = REASON_MIRROR,
    [IS_UNSETTLED] = REASON_NOT_CONVERGED,
    [OUTLIER] = REASON_RESIDUALS,
    [LOST] = REASON_RESIDUALS,
};

/* Serial port and Bluetooth */

static bool sends_records(const struct tag *tag)
{
    return tag->settings->output == OUTPUT_RECORDS;
}

/* The bytes of a struct of fix.h. */
static void send_record(struct tag *tag, uint32_t kind, const void *words, uint32_t size)
{
    link_begin(tag->writer, kind);
    link_append_bytes(tag->writer, words, size);
    link_send(tag->writer);
}

static void send_fix(struct tag *tag)
{
    link_begin(tag->writer, LINK_FIX);
    link_append_bytes(tag->writer, &tag->fix, FIX_SENT_BYTES);
    for (uint32_t at = 0u; at < tag->fix.anchor_count; at++) {
        link_append(tag->writer, tag->fix.anchors[at].id, 2u);
    }
    link_send(tag->writer);
}

/* Say where the tag is, or why it does not know. */
static void say_position(struct tag *tag, uint32_t at_us)
{
    char text[OUTPUT_MAX_BYTES];
    uint32_t size = 0u;

    tag->said_us = at_us;
    if (tag->settings->output == OUTPUT_NMEA) {
        size = nmea_write(&tag->fix, text);
    } else if (tag->settings->output == OUTPUT_JSON) {
        size = json_write(&tag->fix, text);
    } else if (sends_records(tag) && (tag->fix.reason == 0u)) {
        send_fix(tag);
    }
    if ((size > 0u) && (size < OUTPUT_MAX_BYTES)) { /* a line that was cut says nothing */
        (void)tag->hardware->write_line((const uint8_t *)text, size);
    }
}

static void send_places(struct tag *tag, uint32_t at_us)
{
    tag->places_us = at_us;
    tag->places_changes = tag->core.course.changes;
    for (uint32_t at = 0u; at < tag->fix.anchor_count; at++) {
        send_record(tag, LINK_ANCHOR_PLACE, &tag->fix.anchors[at], sizeof tag->fix.anchors[at]);
    }
    if (tag->fix.has_origin) {
        send_record(tag, LINK_GEOREFERENCE, &tag->fix.origin, sizeof tag->fix.origin);
    }
}

static void send_status(struct tag *tag, uint32_t at_us)
{
    struct tag_status *status = &tag->status;

    tag->status_us = at_us;
    status->site = tag->fix.site;
    status->reason = tag->fix.reason;
    set_receiver(tag, tag->receiver);
    status->receiver_on_ms += tag->on_us / 1000u;
    tag->on_us %= 1000u;
    send_record(tag, LINK_TAG_STATUS, status, sizeof *status);
}

static void advertise(struct tag *tag, uint32_t at_us)
{
    uint8_t data[ADVERTISEMENT_BYTES];

    advertisement_write(&tag->fix, (at_us - tag->fixed_us) / 1000u, data);
    if (tag->hardware->advertise(data, sizeof data)) {
        tag->advertised_us = at_us;
    }
}

/* What is due by the clock; whether anything was. */
static bool say(struct tag *tag, uint32_t at_us)
{
    if (is_over(SILENT_US, tag->said_us, at_us) && is_over(SILENT_US, tag->fixed_us, at_us)) {
        tag->fix.reason = tag->reason;
        tag->fix.unix_us = unix_us_at(tag, at_us);
        tag->has_fix = false;
        say_position(tag, at_us);
    } else if (sends_records(tag) && is_over(SECOND_US, tag->status_us, at_us)) {
        send_status(tag, at_us);
    } else if (sends_records(tag) && tag->has_fix &&
               (is_over(REPEAT_US, tag->places_us, at_us) || (tag->places_changes != tag->core.course.changes))) {
        send_places(tag, at_us);
    } else if ((tag->settings->bluetooth_ms > 0u) && tag->has_started && (tag->has_fix || (tag->fix.reason != 0u)) &&
               is_over(1000u * tag->settings->bluetooth_ms, tag->advertised_us, at_us)) {
        advertise(tag, at_us);
    } else {
        return false;
    }
    return true;
}

/* The estimator */

/* Not while a host speaks to it: until then it says fixes as a tag that never sleeps. */
static bool may_sleep(const struct tag *tag, uint32_t at_us)
{
    return (tag->settings->sleep_ms > 0u) && is_over(HOST_US, tag->host_us, at_us);
}

static void estimate(struct tag *tag)
{
    struct tag_reception *one = &tag->waiting[tag->first];
    uint32_t if_late;
    int32_t outcome;

    tag->first = (tag->first + 1u) % TAG_MAX_WAITING;
    tag->count--;
    if_late = (tag->count <= RELAYS_IF_LATE) ? ((RELAYS_IF_LATE + 1u) - tag->count) : 0u;
    tag->core.most_relays = (tag->count == 0u) ? MAX_HEARD : (int32_t)if_late;
    outcome = skyless_hear_frame(
        &tag->core, &tag->shared.state, &tag->shared.search, one->frame, (int32_t)one->frame_bytes,
        (int64_t)one->rx_ticks, __builtin_nanf(""), dbm(one->rx_power_cdbm), dbm(one->first_path_cdbm), -1.0f);
    if ((outcome < FIX) || (outcome > MALFORMED)) {
        tag->status.dropped++;
    } else {
        tag->status.heard++;
        tag->fix.site = (uint32_t)tag->core.admission.choice.site;
        if ((outcome == FIX) || (outcome == START_FIX)) {
            tag->status.fixes++;
            fill_fix(tag, one, outcome == START_FIX);
            if (!may_sleep(tag, now_us(tag)) && fix_is_due(&tag->fix, tag->settings->rate_hz, &tag->slot)) {
                say_position(tag, now_us(tag));
            }
        } else {
            tag->reason = (REASONS[outcome] == 0u) ? REASON_ACQUIRING : REASONS[outcome];
        }
    }
}

/* Sleep */

static bool has_heard_all(const struct tag *tag)
{
    return schedule_is_done(&tag->schedule, tag->settings->superframes);
}

static bool is_done(const struct tag *tag, uint32_t at_us)
{
    uint32_t most_us = tag->has_started ? SEARCH_US : FIRST_SEARCH_US;

    return (tag->receiver == RESTING) || (tag->has_fix && has_heard_all(tag)) ||
           is_over(most_us, tag->awake_since_us, at_us);
}

/* The chip has nothing more to do, whatever the estimator makes of what was received. */
static void rest(struct tag *tag)
{
    set_receiver(tag, RESTING);
    tag->rested_ticks = dw1000_now(tag->chip);
    tag->rested_us = now_us(tag);
    dw1000_sleep(tag->chip);
}

/* Awake from now on. */
static void begin_anew(struct tag *tag)
{
    tag->awake_since_us = now_us(tag);
    tag->timed_us = tag->awake_since_us;
    tag->said_us = tag->awake_since_us;
    tag->status_us = tag->awake_since_us;
}

/* Wake the chip; nothing is known from now on but the site, when its anchors send, and how high the tag was. */
static void wake(struct tag *tag)
{
    bool was_lost = !tag->has_fix;
    uint64_t now_ticks;

    set_receiver(tag, IN_WINDOWS);
    if (!dw1000_wake(tag->chip, tag->settings->tx_delay_ticks, tag->settings->rx_delay_ticks)) {
        return; /* the board finds it lost, and starts it again */
    }
    now_ticks = dw1000_now(tag->chip);
    schedule_wake(&tag->schedule, tag->rested_ticks, now_ticks, now_us(tag) - tag->rested_us);
    skyless_wake(&tag->core, &tag->shared.state, &tag->shared.search, (int64_t)now_ticks,
                 (float)(now_us(tag) - tag->timed_us) * 1e-6f);
    tag->count = 0u;
    tag->has_fix = false;
    begin_anew(tag);
    if ((tag->settings->predicts != 0u) && !was_lost && (tag->schedule.count >= LEAST_EXPECTED)) {
        listen_in_windows(tag);
    } else {
        listen_all_the_time(tag);
    }
}

/* Say what was found, and sleep. */
static void sleep_now(struct tag *tag, uint32_t at_us)
{
    uint32_t sleep_ms = tag->settings->sleep_ms;

    if (tag->receiver != RESTING) {
        sleep_ms = (!tag->has_fix && (sleep_ms < LOST_SLEEP_MS)) ? LOST_SLEEP_MS : sleep_ms;
        rest(tag);
    }
    tag->fix.reason = tag->has_fix ? 0u : tag->reason;
    say_position(tag, at_us);
    if (sends_records(tag)) {
        send_status(tag, at_us);
    }
    if (tag->settings->bluetooth_ms > 0u) {
        advertise(tag, at_us);
    }
    tag->hardware->sleep_for(sleep_ms);
    tag->status.asleep_ms += sleep_ms;
    tag->host_us = now_us(tag) - HOST_US; /* before the clock wraps */
    wake(tag);
}

void tag_begin(struct tag *tag)
{
    const struct settings *settings = tag->settings;
    float limit_m = (settings->alert_limit_m > 0.0f) ? settings->alert_limit_m : __builtin_nanf("");
    bool has_bounds = settings->has_bounds != 0u;

    (void)memset((uint8_t *)tag + offsetof(struct tag, waiting), 0, sizeof *tag - offsetof(struct tag, waiting));
    tag->fix.tag = settings->tag;
    tag->fix.site = FIX_NO_SITE;
    tag->fix.risk = settings->integrity_risk;
    tag->fix.alert_limit_m = settings->alert_limit_m;
    tag->reason = REASON_NO_BEACONS;
    tag->fix.reason = tag->reason;
    tag->slot = NOT_SENT;
    begin_anew(tag);
    tag->fixed_us = tag->awake_since_us;
    tag->host_us = tag->awake_since_us;
    skyless_begin_tag(&tag->core, (settings->site == FIX_NO_SITE) ? NO_SITE : (int32_t)settings->site,
                      settings->qa_m2ps3, has_bounds ? metres(settings->low_mm) : -__builtin_inff(),
                      has_bounds ? metres(settings->high_mm) : __builtin_inff(), 0.0f, settings->integrity_risk,
                      limit_m);
    listen_all_the_time(tag);
}

void tag_on_host(struct tag *tag)
{
    tag->host_us = now_us(tag);
}

uint32_t tag_turn(struct tag *tag)
{
    uint32_t at_us = now_us(tag);

    tag->unix_us += (tag->unix_us == 0) ? 0u : (at_us - tag->unix_at_us);
    tag->unix_at_us = at_us;
    if ((tag->receiver == IN_WINDOWS) && tag->has_started && has_heard_all(tag) && may_sleep(tag, at_us)) {
        rest(tag);
    }
    if (tag->count > 0u) {
        estimate(tag);
        return 0u;
    }
    if (may_sleep(tag, at_us) && is_done(tag, at_us)) {
        sleep_now(tag, at_us);
        return 0u;
    }
    if (tag->receiver == RESTING) { /* the host has spoken since */
        wake(tag);
        return 0u;
    }
    choose_listening(tag, at_us);
    return say(tag, at_us) ? 0u : TURN_US;
}
