#include "outputs.h"

#define LEAST_VARIANCE_M2 1e-4f /* receivers of NMEA reject what claims less than a centimetre */
#define COURSE_SIGMAS_SQUARED 4.0f
#define DAY_US 86400000000

/* The decisions of bridges/nmea.py: quality RTK, heights as the site has them, no position that an alert forbids to use. */

/* A sentence up to hhmmss.ss, which is empty on a board that does not know the time. */
static void begin(struct text *text, const char *name, int64_t unix_us)
{
    int64_t hundredths = ((unix_us + 5000) % DAY_US) / 10000;
    int64_t digits = (hundredths / 360000 * 1000000) + (hundredths / 6000 % 60 * 10000) + (hundredths % 6000);

    text_put(text, name);
    if (unix_us > 0) {
        text_padded(text, "", digits, 2u, 6u);
    }
}

/* The last part of a sentence, and the exclusive or of all bytes after its $. */
static void end(struct text *text, const char *part)
{
    static const char DIGITS[] = "0123456789ABCDEF";
    uint32_t sum = 0u;

    text_put(text, part);
    for (uint32_t at = text->fill; text->data[at - 1u] != '$'; at--) {
        sum ^= (uint8_t)text->data[at - 1u];
    }
    text_put(text, (const char[]){'*', DIGITS[(sum >> 4) & 15u], DIGITS[sum & 15u], '\r', '\n', '\0'});
}

/* ddmmyy. Days to dates: E. G. Richards, Mapping Time (1998), chapter 25, with years that begin in March. */
static void date(struct text *text, int64_t unix_us)
{
    int32_t day = (int32_t)((unix_us + 5000) / DAY_US) + 719468; /* since 1 March of the year 0 */
    int32_t century = ((4 * day) + 3) / 146097;
    int32_t of_century = day - ((146097 * century) / 4);
    int32_t year = ((4 * of_century) + 3) / 1461;
    int32_t of_year = of_century - ((1461 * year) / 4);
    int32_t month = ((5 * of_year) + 2) / 153;
    int32_t of_month = of_year - (((153 * month) + 2) / 5) + 1;

    text_put(text, ",");
    if (unix_us > 0) {
        year += (month >= 10) ? 1 : 0;
        month += (month >= 10) ? -9 : 3;
        text_padded(text, "", (of_month * 10000) + (month * 100) + (year % 100), 0u, 6u);
    }
}

/* dddmm.mmmmmmm,H */
static void angle(struct text *text, int64_t value, const char *positive, const char *negative, uint32_t digits)
{
    int64_t size = (value < 0) ? -value : value;
    int64_t degrees = size / (60 * EARTH_MINUTE);

    text_padded(text, ",", (degrees * 100 * EARTH_MINUTE) + (size - (degrees * 60 * EARTH_MINUTE)), 7u, digits + 2u);
    text_put(text, (value < 0) ? negative : positive);
}

static void place(struct text *text, const struct fix *fix)
{
    int64_t latitude;
    int64_t longitude;

    earth_geodetic(&fix->origin, fix->position_mm, &latitude, &longitude);
    angle(text, latitude, ",N", ",S", 2u);
    angle(text, longitude, ",E", ",W", 3u);
}

static float larger(float one, float other)
{
    return (one > other) ? one : other;
}

/* Speed in knots, and a course where it exceeds two of its standard deviations. */
static void motion(struct text *text, const struct fix *fix, float s, float c)
{
    float x = (float)fix->velocity_mmps[0] * 1e-3f;
    float y = (float)fix->velocity_mmps[1] * 1e-3f;
    float square = (x * x) + (y * y);
    float variance = fix->velocity_covariance[0] + fix->velocity_covariance[3];
    float course_deg = earth_direction_deg((x * c) + (y * s), (y * c) - (x * s));

    text_real(text, ",", fix_root(square) * (3600.0f / 1852.0f), 3u);
    text_put(text, ",");
    if (square > (COURSE_SIGMAS_SQUARED * variance)) {
        text_number(text, "", (text_rounded(course_deg * 100.0f) + 36000) % 36000, 2u);
    }
}

/* Residuals, the ellipse of one standard deviation and the azimuth of its longer axis, then north, east, up. */
static void write_errors(struct text *text, const struct fix *fix, float s, float c)
{
    const float *m2 = fix->covariance_m2;
    float east = larger((c * c * m2[0]) + (2.0f * c * s * m2[1]) + (s * s * m2[3]), LEAST_VARIANCE_M2);
    float north = larger((s * s * m2[0]) - (2.0f * c * s * m2[1]) + (c * c * m2[3]), LEAST_VARIANCE_M2);
    float both = (((c * c) - (s * s)) * m2[1]) + (c * s * (m2[3] - m2[0]));
    float middle = 0.5f * (east + north);
    float half = 0.5f * (east - north);
    float radius = fix_root((half * half) + (both * both));
    float azimuth_deg = 90.0f - (0.5f * earth_direction_deg(both, half));

    begin(text, "$GNGST,", fix->unix_us);
    text_real(text, ",", fix_root(fix->mean_square_m2), 4u);
    text_real(text, ",", fix_root(middle + radius), 4u);
    text_real(text, ",", fix_root(larger(middle - radius, 0.0f)), 4u);
    text_real(text, ",", (azimuth_deg < 180.0f) ? azimuth_deg : 0.0f, 2u);
    text_real(text, ",", fix_root(north), 4u);
    text_real(text, ",", fix_root(east), 4u);
    text_real(text, ",", fix_root(larger(m2[5], LEAST_VARIANCE_M2)), 4u);
    end(text, "");
}

/* The position on the Earth, as receivers of satellites say it. */
static void write_global(struct text *text, const struct fix *fix)
{
    float s;
    float c;

    earth_turn(fix->origin.heading_e7, &s, &c);
    begin(text, "$GNRMC,", fix->unix_us);
    text_put(text, ",A");
    place(text, fix);
    motion(text, fix, s, c);
    date(text, fix->unix_us);
    end(text, ",,,R");
    begin(text, "$GNGGA,", fix->unix_us);
    place(text, fix);
    text_padded(text, ",4,", fix->anchor_count, 0u, 2u);
    text_real(text, ",", fix_dops(fix).hdop, 2u);
    text_number(text, ",", (int64_t)fix->origin.height_mm + fix->position_mm[2], 3u);
    end(text, ",M,0.000,M,,");
    write_errors(text, fix, s, c);
}

/* That there is none. */
static void write_void(struct text *text, int64_t unix_us)
{
    begin(text, "$GNRMC,", unix_us);
    text_put(text, ",V,,,,,,");
    date(text, unix_us);
    end(text, ",,,N");
    begin(text, "$GNGGA,", unix_us);
    end(text, ",,,,,0,00,,,M,,M,,");
}

/* The project's own sentence: time since the first fix, site, tag, position, sigma, levels, alert, V for verified. */
static void write_local(struct text *text, const struct fix *fix)
{
    bool has_fix = fix->reason == 0u;

    text_put(text, "$PSKY,");
    if (has_fix) {
        text_number(text, "", fix_time_us(fix) / 1000, 3u);
    }
    text_put(text, ",");
    if (fix->site != FIX_NO_SITE) {
        text_number(text, "", fix->site, 0u);
    }
    text_number(text, ",", fix->tag, 0u);
    if (has_fix) {
        for (uint32_t axis = 0u; axis < 3u; axis++) {
            text_number(text, ",", fix->position_mm[axis], 3u);
        }
        text_real(text, ",", fix_std_m(fix), 3u);
        text_real(text, ",", fix_hpl_m(fix), 3u);
        text_real(text, ",", fix_vpl_m(fix), 3u);
        text_number(text, ",", fix_alert(fix), 0u);
    } else {
        text_put(text, ",,,,,,,");
    }
    end(text, (fix->is_verified != 0u) ? ",V" : ",U");
}

uint32_t nmea_write(const struct fix *fix, char *data)
{
    struct text text = {data, 0u, ""};
    uint32_t alert = fix_alert(fix);

    if (fix->has_origin) {
        if ((fix->reason == 0u) && (alert != ALERT_NOT_EXCLUDED) && (alert != ALERT_LIMIT)) {
            write_global(&text, fix);
        } else {
            write_void(&text, fix->unix_us);
        }
    }
    write_local(&text, fix);
    return text.fill;
}
