/* What a board needs of its processor. The driver, and the files of the firmware that know no processor, use nothing else. */
#ifndef HARDWARE_H
#define HARDWARE_H

#include <stdbool.h>
#include <stdint.h>

/* Lights, as a sum in `show`: bits in the order of main.c. */
#define LIGHT_READY 0x01u   /* on: receiving; blinking: waits for its host */
#define LIGHT_RECEIVED 0x02u /* changes every 16 receptions */
#define LIGHT_SENT 0x04u    /* changes every 4 frames sent */
#define LIGHT_FAULT 0x08u   /* the chip does not answer, or its interrupt line does not follow its events */

#define KEPT_BYTES 80u /* of settings, in flash */

/* What `probe` returns. */
enum probe {
    PROBE_PART, /* and the next two: as the processor identifies itself */
    PROBE_VARIANT,
    PROBE_REVISION,
    PROBE_RESET_PIN, /* the first of the two registers that choose it */
    PROBE_DEBUG_LOCK,
    PROBE_STACK_BYTES,
    PROBE_STACK_USED, /* at most, since power-on */
    PROBE_FACTS,      /* how many of those above */
    PROBE_SLOW_COUNT = PROBE_FACTS /* periods of the slow crystal, modulo 2^24; 0 while it does not run */
};

/* Only `transfer`, `pause_us`, `restart_line`, `set_rate`, `sleep_for` and `write_settings` wait. The driver of the DW1000
 * uses the first four functions only. */
struct hardware {
    /* One SPI transaction (mode 0) in both directions, 2 to 132 bytes. */
    void (*transfer)(const uint8_t *out, uint8_t *into, uint32_t size);
    /* At most 3 MHz while the chip's PLL has no lock, or at most 20 MHz (UM 2.3.2). */
    void (*set_spi_fast)(bool fast);
    /* Pull RSTn low for a moment and let go; it is never driven high. */
    void (*reset_chip)(void);
    void (*pause_us)(uint32_t microseconds);
    /* A clock that wraps at 32 bits. */
    uint32_t (*now_us)(void);
    /* Whether the chip's interrupt line is high. */
    bool (*interrupt_line)(void);
    /* Bytes that have come from the host, at most `size`; how many. */
    uint32_t (*read_line)(uint8_t *into, uint32_t size);
    /* Queue a line for the host; false where it does not fit as a whole, and nothing of it is sent. */
    bool (*write_line)(const uint8_t *line, uint32_t size);
    /* Start the receiver of the serial line again: it may have lost count. */
    void (*restart_line)(void);
    /* Send the lines that are queued, then go on at another rate. */
    void (*set_rate)(uint32_t baud);
    /* Switch the lights. */
    void (*show)(uint32_t lights);
    /* Sleep with everything off but RAM; `now_us` goes on. Lines to be sent are sent before, what comes is lost, and a
     * chip that is to sleep does so already. */
    void (*sleep_for)(uint32_t milliseconds);
    /* The KEPT_BYTES that were written last, or anything. */
    void (*read_settings)(uint8_t *into);
    /* Keep settings when the supply fails; nothing else happens for 90 ms. */
    void (*write_settings)(const uint8_t *from);
    /* A fact of the processor. */
    uint32_t (*probe)(enum probe item);
    /* Begin to send a Bluetooth advertisement of up to 31 bytes; false while the last is on its way. */
    bool (*advertise)(const uint8_t *data, uint32_t size);
};

#endif
