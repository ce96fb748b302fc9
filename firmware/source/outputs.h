/* What a tag says of its fixes without a program on a host: lines of JSON, NMEA 0183, a Bluetooth advertisement.
 *
 * Each states a fix, or with its `reason` that there is none, which is to be called once a second.
 */
#ifndef OUTPUTS_H
#define OUTPUTS_H

#include "fix.h"

#define OUTPUT_MAX_BYTES 896u
#define ADVERTISEMENT_BYTES 27u

/* At most OUTPUT_MAX_BYTES; how many. */
uint32_t json_write(const struct fix *fix, char *data);
uint32_t nmea_write(const struct fix *fix, char *data); /* one epoch; without a georeference the local position only */

/* ADVERTISEMENT_BYTES (docs/howto/board_tag.md); `age_ms` is the time since the last frame of the fix. */
void advertisement_write(const struct fix *fix, uint32_t age_ms, uint8_t *data);

/* Text out of integers, in text.c. What does not fit is left out. */
struct text {
    char *data; /* OUTPUT_MAX_BYTES */
    uint32_t fill;
    const char *none; /* what stands for a number that there is not */
};

void text_put(struct text *text, const char *part);

/* A part, and behind it a number in units of 10^-decimals, of at least this number of digits before the point. */
void text_padded(struct text *text, const char *before, int64_t value, uint32_t decimals, uint32_t digits);
void text_number(struct text *text, const char *before, int64_t value, uint32_t decimals);

/* The same with a float rounded to that number of decimals; `none` for what is no number or no measurement. */
void text_real(struct text *text, const char *before, float value, uint32_t decimals);

/* The nearest whole number, of at most 10^15. */
int64_t text_rounded(float value);

/* From the site's frame to the Earth in single precision, in earth.c, without losing millimetres within 5 km of the origin
 * and below 80 degrees of latitude: only differences to the origin are floats. Angles in units of 10^-7 minutes of arc,
 * 0.2 mm. */
#define EARTH_MINUTE 10000000 /* units of a minute */

/* Sine and cosine of an angle in 10^-7 degrees. */
void earth_turn(int64_t angle_e7, float *sine, float *cosine);

/* Direction of a vector in degrees from x to y, in [-180, 180]. */
float earth_direction_deg(float y, float x);

/* Latitude and longitude of a point of the site. */
void earth_geodetic(const struct fix_origin *origin, const int32_t *position_mm, int64_t *latitude, int64_t *longitude);

#endif
