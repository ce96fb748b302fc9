#include "hardware.h"
#include "link.h"
#include "nrf52832.h"
#include "peripherals.h"

extern volatile uint32_t settings_page[]; /* from the linker script */

static void wait_until_ready(void)
{
    while (NVMC_READY == 0u) {
    }
}

void flash_read(uint8_t *into)
{
    for (uint32_t at = 0u; at < KEPT_BYTES; at++) {
        into[at] = (uint8_t)(settings_page[at / 4u] >> (8u * (at % 4u)));
    }
}

void flash_write(const uint8_t *from)
{
    NVMC_CONFIG = NVMC_ERASES;
    NVMC_ERASEPAGE = (uint32_t)settings_page;
    wait_until_ready();
    NVMC_CONFIG = NVMC_WRITES;
    for (uint32_t at = 0u; at < (KEPT_BYTES / 4u); at++) {
        settings_page[at] = (uint32_t)link_number(&from[4u * at], 4u);
        wait_until_ready();
    }
    NVMC_CONFIG = NVMC_READS;
}
