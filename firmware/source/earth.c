#include "outputs.h"

#define QUADRANT 900000000 /* 10^-7 degrees */
#define RADIAN 1.74532925e-9f
#define RADIAN_UNITS 3.43774677e10f /* units of 10^-7 minutes */
#define DEGREES 57.2957795f
#define EQUATOR_M 6378137.0f
#define FLATTENED 6.69437999e-3f /* the first eccentricity squared, WGS 84 */
#define HALF_CIRCLE (180LL * 60 * EARTH_MINUTE)

void earth_turn(int64_t angle_e7, float *sine, float *cosine)
{
    int64_t quarter = ((angle_e7 + (QUADRANT / 2) + (1000LL * QUADRANT)) / QUADRANT) - 1000; /* the nearest */
    float x = (float)(int32_t)(angle_e7 - (quarter * QUADRANT)) * RADIAN;
    float square = x * x;
    float tail = 1.0f - (square / 42.0f) * (1.0f - (square / 72.0f)); /* of Taylor's series */
    float s = x * (1.0f - (square / 6.0f) * (1.0f - (square / 20.0f) * tail));
    float c = 1.0f - (square / 2.0f) * (1.0f - (square / 12.0f) * (1.0f - (square / 30.0f) * (1.0f - (square / 56.0f))));
    bool is_odd = (quarter % 2) != 0;
    bool is_back = ((uint64_t)quarter & 2u) != 0u;

    *sine = (is_back ? -1.0f : 1.0f) * (is_odd ? c : s);
    *cosine = ((is_back != is_odd) ? -1.0f : 1.0f) * (is_odd ? s : c);
}

/* Polynomial: M. Abramowitz, I. Stegun, Handbook of Mathematical Functions (1964), 4.4.49, right to 10^-5. */
float earth_direction_deg(float y, float x)
{
    float width = (x < 0.0f) ? -x : x;
    float height = (y < 0.0f) ? -y : y;
    float ratio = (height < width) ? (height / width) : ((height > 0.0f) ? (width / height) : 0.0f);
    float square = ratio * ratio;
    float angle = 0.1801410f - (square * (0.0851330f - (square * 0.0208351f)));

    angle = DEGREES * ratio * (0.9998660f - (square * (0.3302995f - (square * angle))));
    angle = (height < width) ? angle : (90.0f - angle);
    angle = (x < 0.0f) ? (180.0f - angle) : angle;
    return (y < 0.0f) ? -angle : angle;
}

/* The point lies in the plane that touches the Earth at the origin, north of it first and then east; terms to the third
 * order of the distance. */
void earth_geodetic(const struct fix_origin *origin, const int32_t *position_mm, int64_t *latitude, int64_t *longitude)
{
    float s;
    float c;
    float sine;
    float cosine;
    float x_m = (float)position_mm[0] * 1e-3f;
    float y_m = (float)position_mm[1] * 1e-3f;
    float height_m = ((float)origin->height_mm + (float)position_mm[2]) * 1e-3f; /* their sum may have 33 bits */

    earth_turn(origin->heading_e7, &s, &c);
    float east_m = (x_m * c) + (y_m * s);
    float north_m = (y_m * c) - (x_m * s);

    earth_turn(origin->latitude_e7, &sine, &cosine);
    float prime_m = EQUATOR_M / fix_root(1.0f - (FLATTENED * sine * sine));
    float bend = (1.0f - FLATTENED) / (1.0f - (FLATTENED * sine * sine)); /* the meridian's radius against `prime_m` */
    float turned = north_m / ((bend * prime_m) + height_m);
    float middle = 1.5f * FLATTENED * sine * cosine * turned; /* half way the meridian's radius is larger by this share */
    float shift = turned * (1.0f - middle - (turned * turned / 3.0f));
    float sine_there = sine + (cosine * shift) - (0.5f * sine * shift * shift);
    float axis_m = ((prime_m + height_m) * cosine) - (north_m * sine);
    float across = east_m / axis_m;
    float back = 0.5f * sine_there * across * east_m / ((bend * prime_m) + height_m);

    *latitude = (origin->latitude_e7 * 60LL) + text_rounded((shift - back) * RADIAN_UNITS);
    *longitude = (origin->longitude_e7 * 60LL) + text_rounded(across * (1.0f - (across * across / 3.0f)) * RADIAN_UNITS);
    *longitude += (*longitude < -HALF_CIRCLE) ? (2 * HALF_CIRCLE) : ((*longitude >= HALF_CIRCLE) ? (-2 * HALF_CIRCLE) : 0);
}
