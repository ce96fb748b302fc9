/* How a tag on a board works: kept in flash, and sent over the serial link (docs/serial.md), as the same bytes. */
#ifndef SETTINGS_H
#define SETTINGS_H

#include <stdbool.h>
#include <stdint.h>

#define SETTINGS_VERSION 1u
#define SETTINGS_BYTES 78u /* words and CRC */

enum settings_mode { MODE_RADIO, MODE_TAG };
enum settings_output { OUTPUT_RECORDS, OUTPUT_NMEA, OUTPUT_JSON, OUTPUT_NONE };

/* Whole words, whose bytes are those that are kept. */
struct settings {
    uint32_t version;
    uint32_t mode;
    uint32_t output;
    uint32_t rate_hz; /* 0: each beacon */
    uint32_t baud;
    uint32_t bluetooth_ms; /* interval of the advertisements; 0: none */
    uint32_t site;         /* FIX_NO_SITE: the first one heard */
    uint32_t tag;
    uint32_t tx_delay_ticks;
    uint32_t rx_delay_ticks;
    uint32_t has_bounds; /* of the height */
    int32_t low_mm;
    int32_t high_mm;
    uint32_t sleep_ms;    /* between two fixes; 0: always on */
    uint32_t superframes; /* listened to after each sleep */
    uint32_t predicts;    /* whether it receives only at the instants at which beacons are due */
    float qa_m2ps3;
    float integrity_risk;
    float alert_limit_m; /* 0: none */
};

extern const struct settings SETTINGS_DEFAULT;

/* Whether a tag can work with them. */
bool settings_check(const struct settings *settings);

void settings_pack(const struct settings *settings, uint8_t *data);

/* False for what no firmware of this version has packed, or has been damaged; it is not checked. */
bool settings_unpack(const uint8_t *data, uint32_t size, struct settings *settings);

#endif
