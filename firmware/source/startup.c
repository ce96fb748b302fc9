/* From reset to main, and from any fault back to reset. */
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "nrf52832.h"
#include "peripherals.h"

#define FAULT_MARK 0x0FA17ED0u
#define UNUSED_STACK 0xA5A5A5A5u
#define STACK_OF_RESET 64u /* bytes that `reset_handler` itself may use */

/* From the linker script */
extern uint32_t data_in_flash[];
extern uint32_t data_begin[];
extern uint32_t data_end[];
extern uint32_t bss_begin[];
extern uint32_t bss_end[];
extern uint32_t stack_bottom[];
extern uint32_t stack_top[];

int main(void);
void reset_handler(void);

/* Survives a reset: whether a fault caused it. */
static volatile uint32_t fault_mark __attribute__((section(".noinit")));

bool startup_take_fault(void)
{
    bool was_fault = fault_mark == FAULT_MARK;

    fault_mark = 0u;
    return was_fault;
}

uint32_t startup_stack_bytes(bool used)
{
    const uint32_t *from = stack_bottom;

    while (used && (from < stack_top) && (*from == UNUSED_STACK)) {
        from++;
    }
    return (uint32_t)stack_top - (uint32_t)from;
}

/* There is no place for an error message: the serial line carries the link. HELLO reports the cause. */
static void on_fault(void)
{
    fault_mark = FAULT_MARK;
    __asm volatile("dsb" ::: "memory"); /* it has been written */
    SCB_AIRCR = AIRCR_RESET;
    for (;;) {
    }
}

/* From revision 3 on UICR must hold this value, and the firmware write it after each reset. On earlier ones every value
 * but that of erased flash would lock the port, so the image cannot bring it. */
static void open_debug_port(void)
{
    if (CHIP_REVISION < REVISION_3) {
        return;
    }
    if (UICR_APPROTECT == 0xFFFFFFFFu) {
        NVMC_CONFIG = NVMC_WRITES;
        UICR_APPROTECT = 0xFFFFFF00u | APPROTECT_OPEN;
        while (NVMC_READY == 0u) {
        }
        NVMC_CONFIG = NVMC_READS;
        SCB_AIRCR = AIRCR_RESET; /* it counts from the next start on */
        for (;;) {
        }
    }
    APPROTECT_DISABLE = APPROTECT_OPEN;
}

void reset_handler(void)
{
    const uint32_t *from = data_in_flash;

    __asm volatile("cpsid i"); /* for good: interrupts only end the processor's sleep */
    NVMC_ICACHECNF = 1u;
    open_debug_port();
    SCB_CPACR |= CPACR_FPU;
    FPU_FPCCR = 0u; /* faults keep none of its registers: their handler has no floats */
    __asm volatile("dsb\n\tisb" ::: "memory");
    for (uint32_t *to = stack_bottom; (uint32_t)to < ((uint32_t)stack_top - STACK_OF_RESET); to++) {
        *to = UNUSED_STACK;
    }
    for (uint32_t *to = data_begin; to < data_end; to++) {
        *to = *from;
        from++;
    }
    for (uint32_t *to = bss_begin; to < bss_end; to++) {
        *to = 0u;
    }
    (void)main();
}

#define IMAGE_NAME "skyless-dwm1001 " SKYLESS_VERSION

/* The system exceptions of the Armv7-M; interrupts are never taken. Where their vectors would be, `skyless flash` reads
 * the name of the image. */
typedef void (*handler)(void);

__attribute__((section(".vectors"), used)) static const struct {
    const uint32_t *stack;
    handler handlers[15];
    char name[sizeof(IMAGE_NAME)];
} VECTORS = {
    stack_top,
    {reset_handler, on_fault, on_fault, on_fault, on_fault, on_fault, NULL, NULL, NULL, NULL, on_fault, on_fault, NULL,
     on_fault, on_fault},
    IMAGE_NAME,
};

/* PSELRESET: the board's reset button, which a full erase takes away. */
__attribute__((section(".uicr"), used)) static const uint32_t UICR[2] = {PIN_RESET, PIN_RESET};

/* What the compiler may call. */

void *memcpy(void *restrict to, const void *restrict from, size_t size)
{
    uint8_t *out = to;
    const uint8_t *in = from;
    size_t at = 0u;

    if ((((uintptr_t)to | (uintptr_t)from) & 3u) == 0u) {
        for (; at + 4u <= size; at += 4u) {
            *(uint32_t *)(void *)&out[at] = *(const uint32_t *)(const void *)&in[at];
        }
    }
    for (; at < size; at++) {
        out[at] = in[at];
    }
    return to;
}

void *memset(void *to, int value, size_t size)
{
    uint8_t *out = to;
    size_t at = 0u;

    if (((uintptr_t)to & 3u) == 0u) {
        for (; at + 4u <= size; at += 4u) {
            *(uint32_t *)(void *)&out[at] = 0x01010101u * (uint8_t)value;
        }
    }
    for (; at < size; at++) {
        out[at] = (uint8_t)value;
    }
    return to;
}
