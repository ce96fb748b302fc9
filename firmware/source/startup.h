#ifndef STARTUP_H
#define STARTUP_H

#include <stdbool.h>

/* Whether a fault caused the last reset; asked once. */
bool startup_take_fault(void);

/* Reset the processor. */
void startup_reset(void) __attribute__((noreturn));

#endif
