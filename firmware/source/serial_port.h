/* The serial line to the host: 1 Mbaud, 8N1, both directions by DMA. */
#ifndef SERIAL_PORT_H
#define SERIAL_PORT_H

#include <stdbool.h>
#include <stdint.h>

void serial_port_start(void);

/* Send what is queued, and go on at another rate. */
void serial_port_set_rate(uint32_t baud);

/* Send what is queued, then switch the port off until the next start; what comes is lost. */
void serial_port_stop(void);

/* Bytes that have come, at most `size`; how many. Those that were overwritten are missing, which the link's check shows. */
uint32_t serial_port_read(uint8_t *into, uint32_t size);

/* Queue a line; false where it does not fit as a whole. */
bool serial_port_write(const uint8_t *line, uint32_t size);

/* Start the receiver again, empty. */
void serial_port_restart(void);

/* Send the next piece of what is queued, if the last one is out. */
void serial_port_pump(void);

#endif
