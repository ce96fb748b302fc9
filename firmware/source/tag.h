/* A tag by itself: receptions to the estimator, its fixes to the outputs, the receiver off where nothing is expected.
 *
 * The estimator takes up to a few milliseconds for a beacon. Meanwhile it lets the board serve its chip now and then, so
 * that beacons which come then wait here, and not in the chip.
 */
#ifndef TAG_H
#define TAG_H

#include <stdbool.h>
#include <stdint.h>

#include "dw1000.h"
#include "fix.h"
#include "link.h"
#include "outputs.h"
#include "schedule.h"
#include "settings.h"
#include "skyless_core.h"

#define TAG_MAX_WAITING 10u

/* A beacon that waits for the estimator. */
struct tag_reception {
    uint64_t rx_ticks;
    int32_t rx_power_cdbm;
    int32_t first_path_cdbm;
    uint32_t ended_us;
    uint32_t frame_bytes;
    uint8_t frame[DW1000_MAX_PSDU_BYTES];
};

enum tag_receiver { RESTING, ALWAYS_ON, IN_WINDOWS }; /* RESTING: the chip sleeps, or will be started */

struct tag {
    /* What stays when it begins again */
    const struct hardware *hardware;
    const struct settings *settings;
    struct dw1000 *chip;
    struct link_writer *writer;
    int64_t unix_us; /* the host's time at unix_at_us; 0: none */
    uint32_t unix_at_us;

    /* Receptions */
    struct tag_reception waiting[TAG_MAX_WAITING];
    uint32_t first;
    uint32_t count;
    BeaconFields beacon; /* of the newest one */

    /* The receiver */
    struct schedule schedule;
    struct window window;
    enum tag_receiver receiver;
    uint32_t on_since_us; /* all the time */
    uint32_t on_us;       /* of what is not yet in the status */
    uint32_t scanned_us;

    /* Sleep */
    uint64_t rested_ticks; /* the chip's counter when it began to sleep, */
    uint32_t rested_us;    /* and the board's */
    uint32_t awake_since_us;
    uint32_t host_us; /* when the host last said something */
    bool has_started; /* there has been a fix */

    /* The estimator */
    Tag core;
    union {
        State state;
        Acquisition search;
    } shared; /* not used at the same time (core/tag/following.py) */

    /* Fixes */
    struct fix fix;     /* the newest; with a reason while there is none */
    bool has_fix;       /* since the start or the last sleep */
    uint32_t reason;    /* why the newest beacon that counts has made none */
    uint32_t fixed_us;
    uint32_t timed_us;  /* last fix or wake: up to then the estimator has counted time */
    uint32_t said_us;   /* when it last said where it is, or that it does not know */
    int64_t slot;       /* of the output */
    struct tag_status status;
    uint32_t status_us;
    uint32_t places_us;     /* when anchors and georeference were sent last, */
    int64_t places_changes; /* and of which changes */
    uint32_t advertised_us;
};

/* Begin with nothing known but the time; the chip is configured and idle. */
void tag_begin(struct tag *tag);

/* What `dw1000_poll` has returned. */
void tag_on_chip(struct tag *tag, uint32_t events);

/* The host has said something: the tag does not sleep for a while. */
void tag_on_host(struct tag *tag);

/* The host's time, which was `unix_us` just now. */
void tag_set_time(struct tag *tag, int64_t unix_us);

/* Do one thing: the oldest reception, an output, the receiver, or a sleep. For how many microseconds nothing is to be done
 * unless the chip has something. */
uint32_t tag_turn(struct tag *tag);

#endif
