#include "flash.h"

#include "hardware.h"
#include "link.h"
#include "nrf52832.h"

/* The page: the settings, their check, and this mark with the version of their layout, which is written last. */
#define MARK 0x534B0001u
#define WORDS (KEPT_BYTES / 4u)
#define CHECK_AT WORDS
#define MARK_AT (WORDS + 1u)

extern volatile uint32_t settings_page[]; /* from the linker script */

static void wait_until_ready(void)
{
    while (NVMC_READY == 0u) {
    }
}

static void write_word(uint32_t at, uint32_t word)
{
    settings_page[at] = word;
    wait_until_ready();
}

bool flash_read(uint8_t *into)
{
    for (uint32_t at = 0u; at < KEPT_BYTES; at++) {
        into[at] = (uint8_t)(settings_page[at / 4u] >> (8u * (at % 4u)));
    }
    return (settings_page[MARK_AT] == MARK) && (settings_page[CHECK_AT] == link_fcs(into, KEPT_BYTES));
}

void flash_write(const uint8_t *from)
{
    NVMC_CONFIG = NVMC_ERASES;
    NVMC_ERASEPAGE = (uint32_t)settings_page;
    wait_until_ready();
    NVMC_CONFIG = NVMC_WRITES;
    for (uint32_t at = 0u; at < WORDS; at++) {
        write_word(at, (uint32_t)link_number(&from[4u * at], 4u));
    }
    write_word(CHECK_AT, link_fcs(from, KEPT_BYTES));
    write_word(MARK_AT, MARK);
    NVMC_CONFIG = NVMC_READS;
}
