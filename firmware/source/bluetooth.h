/* Bluetooth advertisements that nobody can connect to: ADV_NONCONN_IND on channels 37, 38 and 39, at 0 dBm. The radio
 * sends by itself, 0.4 ms a channel; the processor only starts it. */
#ifndef BLUETOOTH_H
#define BLUETOOTH_H

#include <stdbool.h>
#include <stdint.h>

/* Begin to send up to 31 bytes, which are structures of AD (Core Specification, vol. 3, part C, 11); false while the last
 * ones are on their way. The fast crystal must run. */
bool bluetooth_advertise(const uint8_t *data, uint32_t size);

/* Go on with the next channel; in every turn of the loop. Whether anything is on its way. */
bool bluetooth_pump(void);

#endif
