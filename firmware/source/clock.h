#ifndef CLOCK_H
#define CLOCK_H

#include <stdint.h>

/* Start crystals and counter; it returns when the fast crystal runs. */
void clock_start(void);

/* Microseconds, which wrap at 32 bits. */
uint32_t clock_now_us(void);

void clock_pause_us(uint32_t microseconds);

/* Sleep until the time is over or an interrupt that is enabled is pending. */
void clock_sleep_us(uint32_t microseconds);

/* Sleep for so long on the slow crystal alone, up to 49 days; `clock_now_us` goes on. Every other peripheral must be off. */
void clock_sleep_ms(uint32_t milliseconds);

#endif
