/* What a tag knows of its position. Lengths in mm, speeds in mm/s, the site's frame.
 *
 * Structs of whole words, whose bytes are those of the serial link's records (docs/serial.md): both ends are little-endian.
 */
#ifndef FIX_H
#define FIX_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define FIX_MAX_ANCHORS 8u
#define FIX_NO_SITE 0xFFFFu

/* As in core/integrity.py. The first four are states of the levels (core/integrity.py); in the first two there are levels. */
enum fix_alert { ALERT_NONE, ALERT_EXCLUDED, ALERT_NOT_EXCLUDED, ALERT_UNAVAILABLE, ALERT_LIMIT };

struct fix_anchor {
    uint32_t id;
    int32_t position_mm[3];
};

/* Where the site's origin is on the Earth (WGS 84), as on the air. */
struct fix_origin {
    int32_t latitude_e7;
    int32_t longitude_e7;
    int32_t height_mm;
    uint32_t heading_e7; /* azimuth of the y axis, clockwise from north */
};

/* Covariances: xx, xy, xz, yy, yz, zz. */
struct fix {
    int64_t time_ticks;  /* since the first fix */
    int64_t unix_us;     /* when its last frame ended; 0 where the host has given no time */
    uint64_t rx_ticks;   /* RX stamp of that frame */
    uint32_t latency_us; /* from the frame's end to the fix */
    uint32_t serial;     /* number of the fix since the start */
    uint32_t reason;     /* 0; without a fix its place in NoFixReason of core/fix.py, from 1, and no number below counts */
    uint32_t site;
    uint32_t tag;
    uint32_t is_height_known;
    uint32_t is_verified;
    int32_t position_mm[3];
    int32_t velocity_mmps[3];
    float covariance_m2[6];
    float velocity_covariance[6];
    float chi2;
    float mean_square_m2; /* of the residuals */
    float hpl_m;
    float vpl_m;
    uint32_t levels;
    float risk;
    float alert_limit_m; /* 0: none */
    uint32_t anchor_count;
    struct fix_anchor anchors[FIX_MAX_ANCHORS]; /* FIX ends before them, and with their identifiers */
    bool has_origin;
    struct fix_origin origin;
};

#define FIX_SENT_BYTES offsetof(struct fix, anchors)

/* Once a second. Counts since the start. */
struct tag_status {
    uint32_t site; /* or FIX_NO_SITE */
    uint32_t reason;
    uint32_t is_verified;
    uint32_t heard;
    uint32_t fixes;
    uint32_t overload_frames;
    uint32_t overload_superframes;
    uint32_t dropped;
    uint32_t receiver_on_ms;
    uint32_t asleep_ms;
};

struct fix_dops {
    float gdop;
    float pdop;
    float hdop;
    float vdop;
};

uint32_t fix_alert(const struct fix *fix);
/* NaN where there is none. */
float fix_hpl_m(const struct fix *fix);
float fix_vpl_m(const struct fix *fix);
float fix_std_m(const struct fix *fix);
int64_t fix_time_us(const struct fix *fix);

/* Whether an output gives it: at most `rate_hz` a second, evenly spaced in the fixes' own time; all where that is 0.
 * `slot` is the output's own, INT64_MIN at first. */
bool fix_is_due(const struct fix *fix, uint32_t rate_hz, int64_t *slot);

/* Dilutions of precision; infinite where the geometry is singular. */
struct fix_dops fix_dops(const struct fix *fix);

/* By the processor's instruction; NaN below 0. */
static inline float fix_root(float value)
{
    return __builtin_sqrtf(value);
}

#endif
