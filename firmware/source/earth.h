/* From the site's frame to the Earth in single precision, without losing millimetres within 5 km of the origin and below 80
 * degrees of latitude: only differences to the origin are floats. Angles in units of 10^-7 minutes of arc, 0.2 mm. */
#ifndef EARTH_H
#define EARTH_H

#include "fix.h"

#define EARTH_MINUTE 10000000 /* units of a minute */

/* Sine and cosine of an angle in 10^-7 degrees. */
void earth_turn(int64_t angle_e7, float *sine, float *cosine);

/* Direction of a vector in degrees from x to y, in [-180, 180]. */
float earth_direction_deg(float y, float x);

/* Latitude and longitude of a point of the site. */
void earth_geodetic(const struct fix_origin *origin, const int32_t *position_mm, int64_t *latitude, int64_t *longitude);

#endif
