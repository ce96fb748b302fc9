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

#endif
