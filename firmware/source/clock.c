/* The fast crystal gives the time while the board works, through TIMER0, and the slow one while it sleeps for long,
 * through RTC1. */
#include "nrf52832.h"
#include "peripherals.h"

#define PIECE_PERIODS 49152u /* 1.5 s: the watchdog must be fed after 2 s at the latest */
#define LEAST_PERIODS 3u     /* the counter may miss a comparison that is closer (PS 25) */
#define COUNTER_MASK 0xFFFFFFu

static uint32_t offset_us; /* of the time to TIMER0's count */
static bool is_slow_counting;

/* Anomaly 87: a flag of the floating-point unit, or its interrupt, would end each sleep at once. */
static void wait_for_event(void)
{
    __asm volatile("vmsr fpscr, %0" : : "r"(0));
    NVIC_ICPR1 = FPU_IRQ_IN_ICPR1;
    __asm volatile("dsb\n\twfi" ::: "memory");
}

static void start_crystal(void)
{
    CLOCK_HFCLKSTARTED = 0u;
    CLOCK_HFCLKSTART = 1u; /* for the rates of the serial line and of Bluetooth */
    while (CLOCK_HFCLKSTARTED == 0u) {
    }
}

/* The module's slow crystal takes some 0.25 s to start, and is off by some 100 ppm, as its users report. Anomaly 132, a
 * clock that stops when it is started within 66 us of a reset, is not met: clearing the RAM takes longer. */
void clock_start_slow(void)
{
    CLOCK_LFCLKSRC = LFCLK_CRYSTAL;
    CLOCK_LFCLKSTART = 1u;
}

void clock_start(void)
{
    start_crystal();
    TIMER0_BITMODE = TIMER_32_BITS;
    TIMER0_PRESCALER = TIMER_1_MHZ;
    TIMER0_INTENSET = TIMER0_INT_COMPARE0;
    NVIC_ISER0 = 1u << TIMER0_IRQ;
    TIMER0_START = 1u;
}

uint32_t clock_now_us(void)
{
    TIMER0_CAPTURE1 = 1u;
    return TIMER0_CC1 + offset_us;
}

void clock_pause_us(uint32_t microseconds)
{
    uint32_t begin_us = clock_now_us();

    while ((clock_now_us() - begin_us) <= microseconds) {
    }
}

void clock_sleep_us(uint32_t microseconds)
{
    TIMER0_CC0 = clock_now_us() - offset_us + microseconds;
    wait_for_event();
}

/* Before RTC1 is used the slow clock must run and STOP be given, or its registers are wrong (anomaly 20). */
static void start_slow_counter(void)
{
    RTC1_STOP = 1u;
    RTC1_CLEAR = 1u;
    while (RTC1_COUNTER != 0u) { /* it is cleared up to 46 us later (PS 25) */
    }
    RTC1_START = 1u;
    is_slow_counting = true;
}

uint32_t clock_slow_count(void)
{
    if (!is_slow_counting && (CLOCK_LFCLKSTARTED != 0u)) {
        start_slow_counter();
    }
    return is_slow_counting ? RTC1_COUNTER : 0u;
}

/* The watchdog runs on, or a sleep whose end is lost would never end. So the processor wakes for some us now and then. */
void clock_sleep_ms(uint32_t milliseconds)
{
    uint64_t periods = ((uint64_t)milliseconds * 4096u) / 125u;
    uint64_t passed = 0u;
    uint32_t begin_us;

    while (CLOCK_LFCLKSTARTED == 0u) {
    }
    start_slow_counter();
    RTC1_INTENSET = RTC_INT_COMPARE0;
    NVIC_ISER0 = 1u << RTC1_IRQ;
    begin_us = clock_now_us();
    TIMER0_STOP = 1u;
    TIMER0_SHUTDOWN = 1u; /* one that is only stopped draws current (anomaly 78) */
    TIMER0_COMPARE0 = 0u;
    CLOCK_HFCLKSTOP = 1u;
    while ((passed + LEAST_PERIODS) < periods) {
        uint64_t left = periods - passed;

        WDT_RR0 = WDT_RELOAD;
        RTC1_CC0 = (uint32_t)(passed + ((left < PIECE_PERIODS) ? left : PIECE_PERIODS)) & COUNTER_MASK;
        wait_for_event();
        RTC1_COMPARE0 = 0u;
        (void)RTC1_COMPARE0; /* the write has arrived before the interrupt is cleared (PS 15) */
        NVIC_ICPR0 = (1u << RTC1_IRQ) | (1u << TIMER0_IRQ);
        passed += (RTC1_COUNTER - (uint32_t)passed) & COUNTER_MASK;
    }
    start_crystal();
    passed += (RTC1_COUNTER - (uint32_t)passed) & COUNTER_MASK;
    RTC1_STOP = 1u;
    RTC1_INTENCLR = RTC_INT_COMPARE0;
    is_slow_counting = false;
    TIMER0_CLEAR = 1u; /* whatever its shutdown has left of its count */
    TIMER0_START = 1u;
    offset_us = begin_us + (uint32_t)((passed * 15625u) / 512u);
}
