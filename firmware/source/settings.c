#include "settings.h"

#include <string.h>

#include "fix.h"
#include "link.h"

#define WORDS_BYTES (uint32_t)sizeof(struct settings)

_Static_assert(sizeof(struct settings) + 2u == SETTINGS_BYTES, "a word is missing");

const struct settings SETTINGS_DEFAULT = {
    .version = SETTINGS_VERSION,
    .mode = MODE_RADIO,
    .output = OUTPUT_RECORDS,
    .rate_hz = 10u,
    .baud = 460800u,
    .site = FIX_NO_SITE,
    .tag = 1u,
    .tx_delay_ticks = 16436u,
    .rx_delay_ticks = 16436u,
    .superframes = 3u,
    .qa_m2ps3 = 0.3f,
    .integrity_risk = 1e-4f,
};

bool settings_check(const struct settings *settings)
{
    uint32_t baud = settings->baud;

    return (settings->mode <= MODE_TAG) && (settings->output <= OUTPUT_NONE) && (settings->rate_hz <= 50u) &&
           ((baud == 115200u) || (baud == 230400u) || (baud == 460800u) || (baud == 1000000u)) &&
           ((settings->bluetooth_ms == 0u) || ((settings->bluetooth_ms >= 100u) && (settings->bluetooth_ms <= 10240u))) &&
           (settings->site <= FIX_NO_SITE) && (settings->tag <= 0xFFFFu) && (settings->tx_delay_ticks <= 0xFFFFu) &&
           (settings->rx_delay_ticks <= 0xFFFFu) && (settings->has_bounds <= 1u) &&
           ((settings->has_bounds == 0u) || (settings->low_mm < settings->high_mm)) && (settings->sleep_ms <= 3600000u) &&
           (settings->superframes >= 1u) && (settings->superframes <= 100u) && (settings->predicts <= 1u) &&
           (settings->qa_m2ps3 >= 1e-9f) && (settings->qa_m2ps3 <= 1000.0f) && (settings->integrity_risk >= 1e-9f) &&
           (settings->integrity_risk <= 0.1f) && (settings->alert_limit_m >= 0.0f) && (settings->alert_limit_m <= 1000.0f);
}

void settings_pack(const struct settings *settings, uint8_t *data)
{
    (void)memcpy(data, settings, WORDS_BYTES);
    uint32_t crc = link_crc16(data, WORDS_BYTES);

    data[WORDS_BYTES] = (uint8_t)(crc >> 8);
    data[WORDS_BYTES + 1u] = (uint8_t)crc;
}

bool settings_unpack(const uint8_t *data, uint32_t size, struct settings *settings)
{
    if ((size < SETTINGS_BYTES) || (link_crc16(data, SETTINGS_BYTES) != 0u)) {
        return false;
    }
    (void)memcpy(settings, data, WORDS_BYTES);
    return settings->version == SETTINGS_VERSION;
}
