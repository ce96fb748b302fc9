#include "outputs.h"

static const char *const ALERTS[] = {"none", "detected-excluded", "detected-not-excluded", "unavailable",
                                     "alert-limit-exceeded"};
static const char *const REASONS[] = {"no-beacons", "no-almanac", "too-few-anchors", "bad-geometry", "mirror-ambiguity",
                                      "not-converged", "residuals-too-large", "acquiring", "no-master"};

static void vector(struct text *text, const char *before, const int32_t *values)
{
    for (uint32_t at = 0u; at < 3u; at++) {
        text_number(text, (at == 0u) ? before : ",", values[at], 3u);
    }
}

static void matrix(struct text *text, const char *before, const float *values)
{
    static const uint8_t PLACES[9] = {0u, 1u, 2u, 1u, 3u, 4u, 2u, 4u, 5u};

    for (uint32_t at = 0u; at < 9u; at++) {
        text_real(text, (at == 0u) ? before : ",", values[PLACES[at]], 7u);
    }
}

static void write_fix(struct text *text, const struct fix *fix)
{
    struct fix_dops dops = fix_dops(fix);
    bool is_verified = fix->is_verified != 0u;

    text_number(text, "{\"tag\":\"tag", fix->tag, 0u);
    text_number(text, "\",\"serial\":", fix->serial, 0u);
    text_number(text, ",\"unix_s\":", fix->unix_us, 6u);
    text_number(text, ",\"time_s\":", fix_time_us(fix), 6u);
    vector(text, ",\"position_m\":[", fix->position_mm);
    matrix(text, "],\"covariance_m2\":[", fix->covariance_m2);
    vector(text, "],\"velocity_mps\":[", fix->velocity_mmps);
    matrix(text, "],\"velocity_covariance\":[", fix->velocity_covariance);
    text_real(text, "],\"std_m\":", fix_std_m(fix), 4u);
    text_real(text, ",\"gdop\":", dops.gdop, 3u);
    text_real(text, ",\"pdop\":", dops.pdop, 3u);
    text_real(text, ",\"hdop\":", dops.hdop, 3u);
    text_real(text, ",\"vdop\":", dops.vdop, 3u);
    text_put(text, ",\"anchors\":[");
    for (uint32_t at = 0u; at < fix->anchor_count; at++) {
        text_number(text, (at == 0u) ? "" : ",", fix->anchors[at].id, 0u);
    }
    text_real(text, "],\"chi2\":", fix->chi2, 4u);
    text_real(text, ",\"dof\":1,\"residual_rms_m\":", fix_root(fix->mean_square_m2), 5u);
    text_put(text, ",\"method\":\"joint\",\"height_known\":");
    text_put(text, (fix->is_height_known != 0u) ? "true" : "false");
    text_number(text, ",\"latency_s\":", fix->latency_us, 6u);
    text_real(text, ",\"hpl_m\":", fix_hpl_m(fix), 4u);
    text_real(text, ",\"vpl_m\":", fix_vpl_m(fix), 4u);
    text_real(text, ",\"integrity_risk\":", fix->risk, 9u);
    text_put(text, ",\"alert\":\"");
    text_put(text, ALERTS[fix_alert(fix)]);
    text_put(text, "\",\"verified_until_s\":");
    if (is_verified) {
        text_number(text, "", fix_time_us(fix), 6u);
    }
    text_put(text, is_verified ? ",\"unverified\":0}\n" : "null,\"unverified\":1}\n");
}

uint32_t json_write(const struct fix *fix, char *data)
{
    struct text text = {data, 0u, "null"};

    if (fix->reason == 0u) {
        write_fix(&text, fix);
    } else {
        text_number(&text, "{\"type\":\"no_fix\",\"tag\":\"tag", fix->tag, 0u);
        text_number(&text, "\",\"unix_s\":", fix->unix_us, 6u);
        text_put(&text, ",\"reason\":\"");
        text_put(&text, REASONS[fix->reason - 1u]);
        text_put(&text, "\"}\n");
    }
    return text.fill;
}
