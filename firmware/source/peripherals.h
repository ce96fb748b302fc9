/* What main.c wires together on the nRF52832. */
#ifndef PERIPHERALS_H
#define PERIPHERALS_H

#include <stdbool.h>
#include <stdint.h>

/* Whether a fault caused the last reset; asked once. */
bool startup_take_fault(void);

/* The size of the stack, or how much of it was used at most since power-on. */
uint32_t startup_stack_bytes(bool used);

/* Start the slow crystal, which runs some 0.25 s later. */
void clock_start_slow(void);
/* Periods of the slow crystal, modulo 2^24, from the first call after a sleep on; 0 until it runs. */
uint32_t clock_slow_count(void);
/* Start the fast crystal and the counter; it returns when the fast crystal runs. */
void clock_start(void);
/* Microseconds, which wrap at 32 bits. */
uint32_t clock_now_us(void);
void clock_pause_us(uint32_t microseconds);
/* Sleep until the time is over or an interrupt that is enabled is pending. */
void clock_sleep_us(uint32_t microseconds);
/* Sleep on the slow crystal alone, for up to 49 days; `clock_now_us` goes on. Every other peripheral must be off. */
void clock_sleep_ms(uint32_t milliseconds);

void serial_port_start(void);
/* Send what is queued, then switch the port off until the next start; what comes is lost. */
void serial_port_stop(void);
/* Send what is queued, and go on at another rate. */
void serial_port_set_rate(uint32_t baud);
/* Start the receiver again, empty. */
void serial_port_restart(void);
/* Bytes that have come, at most `size`; how many. Those that were overwritten are missing, which the link's check shows. */
uint32_t serial_port_read(uint8_t *into, uint32_t size);
/* Queue a line; false where it does not fit as a whole. */
bool serial_port_write(const uint8_t *line, uint32_t size);
/* Send the next piece of what is queued, if the last one is out. */
void serial_port_pump(void);

/* Read KEPT_BYTES (hardware.h) of the flash's last page, which a new image leaves as it is. */
void flash_read(uint8_t *into);
/* Write them in 90 ms, in which the processor stands still. */
void flash_write(const uint8_t *from);

/* Begin to send an advertisement of up to 31 bytes, which are structures of AD (Core Specification, vol. 3, part C, 11);
 * false while the last one is on its way. The fast crystal must run. */
bool bluetooth_advertise(const uint8_t *data, uint32_t size);
/* Go on with the next channel; in every turn of the loop. Whether anything is on its way. */
bool bluetooth_pump(void);

#endif
