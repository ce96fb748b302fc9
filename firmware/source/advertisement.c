#include "outputs.h"

#define MANUFACTURER_SPECIFIC 0xFFu
#define NO_COMPANY 0xFFFFu /* of those without a number of the Bluetooth SIG */
#define MARK 0x4B53u /* "SK" */
#define VERSION 1u
#define HAS_FIX 0x01u
#define ALERT_SHIFT 1u
#define IS_VERIFIED 0x10u
#define IS_HEIGHT_KNOWN 0x20u
#define NO_LENGTH 0xFFFF

static uint8_t *put(uint8_t *data, int64_t value, uint32_t size)
{
    for (uint32_t at = 0u; at < size; at++) {
        data[at] = (uint8_t)((uint64_t)value >> (8u * at));
    }
    return &data[size];
}

static int64_t centimetres(float length_m)
{
    return ((length_m >= 0.0f) && (length_m < 655.0f)) ? text_rounded(length_m * 100.0f) : NO_LENGTH;
}

void advertisement_write(const struct fix *fix, uint32_t age_ms, uint8_t *data)
{
    bool has_fix = fix->reason == 0u;
    uint32_t flags = HAS_FIX | (fix_alert(fix) << ALERT_SHIFT);
    uint8_t *at = data;

    flags |= (fix->is_verified != 0u) ? IS_VERIFIED : 0u;
    flags |= (fix->is_height_known != 0u) ? IS_HEIGHT_KNOWN : 0u;
    at = put(at, ADVERTISEMENT_BYTES - 1u, 1u);
    at = put(at, MANUFACTURER_SPECIFIC, 1u);
    at = put(at, NO_COMPANY, 2u);
    at = put(at, MARK, 2u);
    at = put(at, VERSION, 1u);
    at = put(at, fix->site, 2u);
    at = put(at, fix->tag, 2u);
    at = put(at, has_fix ? flags : 0u, 1u);
    at = put(at, (age_ms < 655350u) ? (age_ms / 10u) : 0xFFFFu, 2u);
    for (uint32_t axis = 0u; axis < 3u; axis++) {
        at = put(at, has_fix ? (fix->position_mm[axis] / 10) : 0, 3u);
    }
    at = put(at, has_fix ? centimetres(fix_std_m(fix)) : NO_LENGTH, 2u);
    (void)put(at, has_fix ? centimetres(fix_hpl_m(fix)) : NO_LENGTH, 2u);
}
