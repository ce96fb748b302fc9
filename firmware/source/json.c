#include "outputs.h"
#include "text.h"

static const char *const ALERTS[] = {"none", "detected-excluded", "detected-not-excluded", "unavailable",
                                     "alert-limit-exceeded"};
static const char *const REASONS[] = {"no-beacons", "no-almanac", "too-few-anchors", "bad-geometry", "mirror-ambiguity",
                                      "not-converged", "residuals-too-large", "acquiring", "no-master"};

static void key(struct text *text, const char *name)
{
    text_put(text, (text->fill == 0u) ? "{\"" : ",\"");
    text_put(text, name);
    text_put(text, "\":");
}

static void whole(struct text *text, const char *name, int64_t value, uint32_t decimals)
{
    key(text, name);
    text_number(text, value, decimals);
}

static void real(struct text *text, const char *name, float value, uint32_t decimals)
{
    key(text, name);
    text_real(text, value, decimals);
}

static void word(struct text *text, const char *name, const char *value)
{
    key(text, name);
    text_put(text, "\"");
    text_put(text, value);
    text_put(text, "\"");
}

static void vector(struct text *text, const char *name, const int32_t *values)
{
    key(text, name);
    for (uint32_t at = 0u; at < 3u; at++) {
        text_put(text, (at == 0u) ? "[" : ",");
        text_number(text, values[at], 3u);
    }
    text_put(text, "]");
}

static void matrix(struct text *text, const char *name, const float *values)
{
    static const uint8_t PLACES[9] = {0u, 1u, 2u, 1u, 3u, 4u, 2u, 4u, 5u};

    key(text, name);
    for (uint32_t at = 0u; at < 9u; at++) {
        text_put(text, (at == 0u) ? "[" : ",");
        text_real(text, values[PLACES[at]], 7u);
    }
    text_put(text, "]");
}

static void tag(struct text *text, uint32_t number)
{
    key(text, "tag");
    text_put(text, "\"tag");
    text_number(text, number, 0u);
    text_put(text, "\"");
}

static void write_fix(struct text *text, const struct fix *fix)
{
    struct fix_dops dops = fix_dops(fix);
    bool has_vpl = fix_has_levels(fix) && (fix->is_height_known == 0u);
    float none = __builtin_nanf("");

    tag(text, fix->tag);
    whole(text, "serial", fix->serial, 0u);
    whole(text, "unix_s", fix->unix_us, 6u);
    whole(text, "time_s", fix_time_us(fix), 6u);
    vector(text, "position_m", fix->position_mm);
    matrix(text, "covariance_m2", fix->covariance_m2);
    vector(text, "velocity_mps", fix->velocity_mmps);
    matrix(text, "velocity_covariance", fix->velocity_covariance);
    real(text, "std_m", fix_std_m(fix), 4u);
    real(text, "gdop", dops.gdop, 3u);
    real(text, "pdop", dops.pdop, 3u);
    real(text, "hdop", dops.hdop, 3u);
    real(text, "vdop", dops.vdop, 3u);
    key(text, "anchors");
    text_put(text, "[");
    for (uint32_t at = 0u; at < fix->anchor_count; at++) {
        text_put(text, (at == 0u) ? "" : ",");
        text_number(text, fix->anchors[at].id, 0u);
    }
    text_put(text, "]");
    real(text, "chi2", fix->chi2, 4u);
    whole(text, "dof", 1, 0u);
    real(text, "residual_rms_m", fix_root(fix->mean_square_m2), 5u);
    word(text, "method", "joint");
    key(text, "height_known");
    text_put(text, (fix->is_height_known != 0u) ? "true" : "false");
    whole(text, "latency_s", fix->latency_us, 6u);
    real(text, "hpl_m", fix_has_levels(fix) ? fix->hpl_m : none, 4u);
    real(text, "vpl_m", has_vpl ? fix->vpl_m : none, 4u);
    real(text, "integrity_risk", fix->risk, 9u);
    word(text, "alert", ALERTS[fix_alert(fix)]);
    if (fix->is_verified != 0u) {
        whole(text, "verified_until_s", fix_time_us(fix), 6u);
    } else {
        real(text, "verified_until_s", none, 0u);
    }
    whole(text, "unverified", (fix->is_verified != 0u) ? 0 : 1, 0u);
}

uint32_t json_write(const struct fix *fix, char *data)
{
    struct text text = {data, OUTPUT_MAX_BYTES, 0u, "null"};

    if (fix->reason == 0u) {
        write_fix(&text, fix);
    } else {
        word(&text, "type", "no_fix");
        tag(&text, fix->tag);
        whole(&text, "unix_s", fix->unix_us, 6u);
        word(&text, "reason", REASONS[fix->reason - 1u]);
    }
    text_put(&text, "}\n");
    return text.fill;
}
