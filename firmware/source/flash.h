/* A few bytes in the last page of the flash, which a new image leaves as they are. */
#ifndef FLASH_H
#define FLASH_H

#include <stdbool.h>
#include <stdint.h>

/* Read KEPT_BYTES (hardware.h): what was written last, or anything. */
void flash_read(uint8_t *into);

/* Write them in 90 ms, in which the processor stands still. */
void flash_write(const uint8_t *from);

#endif
