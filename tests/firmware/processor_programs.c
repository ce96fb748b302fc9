/* Small programs for the emulated processor, one of them chosen by PROGRAM. Each shows one peripheral or one behaviour;
 * results go out on the serial line. */
#include <stdbool.h>
#include <stdint.h>

#include "nrf52832.h"

#define START 1
#define RING 2
#define CHIP 3
#define SLEEP 4
#define WATCHDOG 5
#define FAULT 6
#define CONDITIONAL 7
#define LOOP 8
#define SILENT 9

extern uint32_t stack_top[];
extern uint32_t bss_begin[];
extern uint32_t bss_end[];
void reset_handler(void);

static uint8_t out[64];
static uint8_t in[255];
static volatile uint32_t mark __attribute__((section(".noinit")));

static void start_line(void)
{
    UARTE_PSEL_RTS = NOT_CONNECTED;
    UARTE_PSEL_CTS = NOT_CONNECTED;
    UARTE_PSEL_TXD = 5u;
    UARTE_PSEL_RXD = 11u;
    UARTE_BAUDRATE = UARTE_1_MBAUD;
    UARTE_ENABLE = UARTE_ENABLED;
}

static void send(uint32_t size)
{
    UARTE_ENDTX = 0u;
    UARTE_TXD_PTR = (uint32_t)out;
    UARTE_TXD_MAXCNT = size;
    UARTE_STARTTX = 1u;
    while (UARTE_ENDTX == 0u) {
    }
}

static void send_byte(uint32_t value)
{
    out[0] = (uint8_t)value;
    send(1u);
}

static void send_word(uint32_t value)
{
    for (uint32_t at = 0u; at < 4u; at++) {
        out[at] = (uint8_t)(value >> (8u * at));
    }
    send(4u);
}

static void start_timer(void)
{
    TIMER0_BITMODE = TIMER_32_BITS;
    TIMER0_PRESCALER = TIMER_1_MHZ;
    TIMER0_INTENSET = TIMER0_INT_COMPARE0;
    NVIC_ISER0 = 1u << TIMER0_IRQ;
    TIMER0_START = 1u;
}

static uint32_t now_us(void)
{
    TIMER0_CAPTURE1 = 1u;
    return TIMER0_CC1;
}

static void sleep_us(uint32_t microseconds)
{
    TIMER0_COMPARE0 = 0u;
    NVIC_ICPR0 = 1u << TIMER0_IRQ;
    TIMER0_CC0 = now_us() + microseconds;
    __asm volatile("wfi" ::: "memory");
}

static void sleep_for_good(void)
{
    REGISTER(0xE000E180u) = 0xFFFFFFFFu; /* no interrupt ends this sleep, also none that is still pending */
    for (;;) {
        __asm volatile("wfi" ::: "memory");
    }
}

#if PROGRAM == START
/* Send the cause of the reset; then every byte that comes, plus one. */
static void run(void)
{
    start_line();
    send_byte(POWER_RESETREAS);
    UARTE_INTENSET = UARTE_INT_RXDRDY;
    NVIC_ISER0 = 1u << UARTE_IRQ;
    UARTE_RXD_PTR = (uint32_t)in;
    UARTE_RXD_MAXCNT = 255u;
    UARTE_STARTRX = 1u;
    for (uint32_t at = 0u; at < 255u; at++) {
        __asm volatile("wfi" ::: "memory");
        UARTE_RXDRDY = 0u;
        NVIC_ICPR0 = 1u << UARTE_IRQ;
        send_byte(in[at] + 1u);
    }
}
#elif PROGRAM == RING
/* The receiver fills a ring without the processor; at each 0 send how many bytes came and which were the last three. */
static void run(void)
{
    start_line();
    TIMER1_MODE = TIMER_COUNTS;
    TIMER1_BITMODE = TIMER_32_BITS;
    PPI_CH0_EEP = UARTE_RXDRDY_ADDRESS;
    PPI_CH0_TEP = TIMER1_COUNT_ADDRESS;
    PPI_CHENSET = 1u;
    TIMER1_CLEAR = 1u;
    TIMER1_START = 1u;
    UARTE_INTENSET = UARTE_INT_RXDRDY;
    NVIC_ISER0 = 1u << UARTE_IRQ;
    UARTE_RXD_PTR = (uint32_t)in;
    UARTE_RXD_MAXCNT = 255u;
    UARTE_SHORTS = UARTE_SHORT_ENDRX_STARTRX;
    UARTE_STARTRX = 1u;
    for (;;) {
        uint32_t count;

        __asm volatile("wfi" ::: "memory");
        UARTE_RXDRDY = 0u;
        NVIC_ICPR0 = 1u << UARTE_IRQ;
        TIMER1_CAPTURE0 = 1u;
        count = TIMER1_CC0;
        if (in[(count - 1u) % 255u] == 0u) {
            for (uint32_t at = 0u; at < 3u; at++) {
                out[4u + at] = in[(count - 3u + at) % 255u];
            }
            for (uint32_t at = 0u; at < 4u; at++) {
                out[at] = (uint8_t)(count >> (8u * at));
            }
            send(7u);
        }
    }
}
#elif PROGRAM == CHIP
/* Reset the chip, read its identifier, wait for its interrupt line, and read its status. */
static void transfer(uint32_t header, uint32_t size)
{
    out[0] = (uint8_t)header;
    SPIM_TXD_PTR = (uint32_t)out;
    SPIM_TXD_MAXCNT = size;
    SPIM_RXD_PTR = (uint32_t)in;
    SPIM_RXD_MAXCNT = size;
    SPIM_END = 0u;
    GPIO_OUTCLR = 1u << 17;
    SPIM_START = 1u;
    while (SPIM_END == 0u) {
    }
    GPIO_OUTSET = 1u << 17;
}

static void run(void)
{
    start_line();
    GPIO_OUTSET = 1u << 17;
    GPIO_PIN_CNF(16) = PIN_FAST_CLOCK;
    GPIO_PIN_CNF(17) = PIN_OUTPUT;
    GPIO_PIN_CNF(19) = PIN_INPUT;
    SPIM_PSEL_SCK = 16u;
    SPIM_PSEL_MOSI = 20u;
    SPIM_PSEL_MISO = 18u;
    SPIM_FREQUENCY = SPIM_2_MHZ;
    SPIM_ENABLE = SPIM_ENABLED;
    GPIOTE_CONFIG0 = GPIOTE_RISING_ON(19);
    GPIOTE_INTENSET = 1u;
    NVIC_ISER0 = 1u << GPIOTE_IRQ;
    GPIO_OUTCLR = 1u << 24;
    GPIO_DIRSET = 1u << 24;
    GPIO_DIRCLR = 1u << 24;
    transfer(0x00u, 5u);
    for (uint32_t at = 0u; at < 4u; at++) {
        out[at] = in[1u + at];
    }
    send(4u);
    __asm volatile("wfi" ::: "memory");
    out[1] = (uint8_t)(GPIO_IN >> 19 & 1u);
    out[0] = (uint8_t)GPIOTE_IN0;
    send(2u);
    for (uint32_t at = 0u; at < 5u; at++) {
        out[at] = 0u;
    }
    transfer(0x0Fu, 6u);
    for (uint32_t at = 0u; at < 5u; at++) {
        out[at] = in[1u + at];
    }
    send(5u);
    sleep_for_good();
}
#elif PROGRAM == SLEEP
/* Send the timer before and after sleeps of 1 ms and of 50 us. */
static void run(void)
{
    uint32_t before_us;
    uint32_t between_us;

    start_line();
    start_timer();
    before_us = now_us();
    sleep_us(1000u);
    between_us = now_us();
    sleep_us(50u);
    send_word(between_us - before_us);
    send_word(now_us() - between_us);
    sleep_for_good();
}
#elif PROGRAM == WATCHDOG
/* Send the causes of the reset, feed the watchdog of 10 ms three times, and forget it; the timer wakes in between. */
static void run(void)
{
    start_line();
    start_timer();
    send_byte(POWER_RESETREAS);
    POWER_RESETREAS = 0xFFFFFFFFu;
    WDT_CONFIG = WDT_RUNS_IN_SLEEP;
    WDT_CRV = 327u;
    WDT_RREN = 1u;
    WDT_START = 1u;
    for (uint32_t turn = 0u; turn < 3u; turn++) {
        sleep_us(9000u);
        WDT_RR0 = WDT_RELOAD;
    }
#ifdef AWAKE
    for (;;) {
    }
#endif
    sleep_for_good();
}
#elif PROGRAM == FAULT
/* Send the cause of the reset and a mark that the handler leaves, then do what is forbidden. */
static void run(void)
{
    start_line();
    out[0] = (uint8_t)POWER_RESETREAS;
    out[1] = (uint8_t)mark;
    send(2u);
    POWER_RESETREAS = 0xFFFFFFFFu;
    if (mark == 0x77u) {
        sleep_for_good();
    }
    FORBIDDEN;
}
#elif PROGRAM == CONDITIONAL
/* A thousand times: three conditional instructions of which two reach a peripheral. */
static void run(void)
{
    uint32_t taken = 0u;
    uint32_t other = 0u;

    start_line();
    for (uint32_t turn = 0u; turn < 1000u; turn++) {
        uint32_t scratch;

        __asm volatile("tst %[turn], #3\n\t"
                       "itte eq\n\t"
                       "addeq %[taken], %[taken], #1\n\t"
                       "ldreq %[scratch], [%[address]]\n\t"
                       "addne %[other], %[other], #1\n\t"
                       "tst %[turn], #1\n\t"
                       "ite ne\n\t"
                       "strne %[turn], [%[address]]\n\t"
                       "ldreq %[scratch], [%[address]]\n\t"
                       : [taken] "+r"(taken), [other] "+r"(other), [scratch] "=&r"(scratch)
                       : [turn] "r"(turn), [address] "r"(&TIMER0_CC1)
                       : "cc", "memory");
    }
    send_word(taken);
    send_word(other);
    send_word(TIMER0_CC1);
    sleep_for_good();
}
#elif PROGRAM == LOOP
/* Between two sleeps a number of turns of a loop, for a count of its cycles; the loop stands in one line of the flash. */
static void run(void)
{
#ifdef CACHED
    NVMC_ICACHECNF = 1u;
#endif
#ifdef FPU
    SCB_CPACR |= CPACR_FPU;
#endif
    start_timer();
    sleep_us(100u);
    __asm volatile("ldr r0, =" COUNT "\n\t"
                   "mov r1, #100\n\t"
                   "mov r2, #7\n\t"
                   "ldr r3, =0x20000800\n\t"
                   ".balign 16\n"
                   "1: " BODY "\n\t"
                   "subs r0, r0, #1\n\t"
                   "bne 1b\n\t" ::: "r0", "r1", "r2", "r3", "r4", "r5", "s0", "s1", "s2", "s3", "s4", "cc", "memory");
    sleep_for_good();
}
#elif PROGRAM == SILENT
static void run(void)
{
    FORBIDDEN;
    sleep_for_good();
}
#endif

static void on_fault(void)
{
#ifdef FAULT_IN_HANDLER
    if (mark != 0x76u) {
        mark = 0x77u;
        (void)REGISTER(0x70000000u);
    }
#endif
    mark = 0x77u;
    SCB_AIRCR = AIRCR_RESET;
    for (;;) {
    }
}

void reset_handler(void)
{
    __asm volatile("cpsid i");
    for (uint32_t *to = bss_begin; to < bss_end; to++) {
        *to = 0u;
    }
    run();
    (void)start_timer;
    (void)sleep_us;
    (void)send_word;
    sleep_for_good();
}

typedef void (*handler)(void);

__attribute__((section(".vectors"), used)) static const struct {
    const uint32_t *stack;
    handler handlers[3];
} VECTORS = {stack_top, {reset_handler, on_fault, on_fault}};
