/* What a DWM1001 does from its start: it wires the board's loop to the processor, and sleeps between its turns. */
#include <stdbool.h>
#include <stdint.h>

#include "board.h"
#include "hardware.h"
#include "nrf52832.h"
#include "pins.h"
#include "serial_port.h"
#include "startup.h"

#define WATCHDOG_PERIODS (2u * 32768u) /* 2 s; no turn lasts longer than 30 ms, no sleep longer than 0.6 s */
#define RESET_LOW_US 100u /* the chip needs some ns (DW1000 data sheet, RSTn) */
#define PULL_UP_US 20u    /* 13 kOhm load a wire of 100 pF in some us */
#define FAULT_CAUSE 0x80u /* in HELLO: a fault that the firmware noticed */
/* Shorter sleeps are waited for: the compare value must still lie ahead when it is written. */
#define SHORTEST_SLEEP_US 4u

static struct board board; /* in RAM, as the DMA needs its buffers */

/* Time */

static uint32_t now_us(void)
{
    TIMER0_CAPTURE1 = 1u;
    return TIMER0_CC1;
}

static void pause_us(uint32_t microseconds)
{
    uint32_t begin_us = now_us();

    while ((now_us() - begin_us) <= microseconds) {
    }
}

static void start_clocks(void)
{
    NVMC_ICACHECNF = 1u;
    CLOCK_HFCLKSTARTED = 0u;
    CLOCK_HFCLKSTART = 1u; /* the crystal, for the serial line's rate */
    while (CLOCK_HFCLKSTARTED == 0u) {
    }
    TIMER0_BITMODE = TIMER_32_BITS;
    TIMER0_PRESCALER = TIMER_1_MHZ;
    TIMER0_INTENSET = TIMER0_INT_COMPARE0;
    NVIC_ISER0 = 1u << TIMER0_IRQ;
    TIMER0_START = 1u;
}

static void start_watchdog(void)
{
    WDT_CONFIG = WDT_RUNS_IN_SLEEP;
    WDT_CRV = WATCHDOG_PERIODS - 1u;
    WDT_RREN = 1u;
    WDT_START = 1u;
}

/* The chip */

static void set_spi_fast(bool fast)
{
    SPIM_FREQUENCY = fast ? SPIM_8_MHZ : SPIM_2_MHZ;
}

/* Both buffers have two bytes or more: of single ones the SPIM sends two (anomaly 58). */
static void transfer(const uint8_t *out, uint8_t *into, uint32_t size)
{
    SPIM_TXD_PTR = (uint32_t)out;
    SPIM_TXD_MAXCNT = size;
    SPIM_RXD_PTR = (uint32_t)into;
    SPIM_RXD_MAXCNT = size;
    SPIM_END = 0u;
    GPIO_OUTCLR = 1u << PIN_CHIP_SELECT;
    SPIM_START = 1u;
    while (SPIM_END == 0u) {
    }
    GPIO_OUTSET = 1u << PIN_CHIP_SELECT;
}

static void reset_chip(void)
{
    GPIO_OUTCLR = 1u << PIN_CHIP_RESET;
    GPIO_DIRSET = 1u << PIN_CHIP_RESET;
    pause_us(RESET_LOW_US);
    GPIO_DIRCLR = 1u << PIN_CHIP_RESET; /* the chip pulls it up */
}

static bool interrupt_line(void)
{
    return (GPIO_IN & (1u << PIN_CHIP_IRQ)) != 0u;
}

static void start_chip_pins(void)
{
    GPIO_OUTSET = 1u << PIN_CHIP_SELECT;
    GPIO_PIN_CNF(PIN_CHIP_SELECT) = PIN_OUTPUT;
    GPIO_PIN_CNF(PIN_CHIP_SCK) = PIN_FAST_CLOCK;
    GPIO_PIN_CNF(PIN_CHIP_MOSI) = PIN_FAST_OUTPUT;
    GPIO_PIN_CNF(PIN_CHIP_MISO) = PIN_INPUT_PULL_DOWN;
    GPIO_PIN_CNF(PIN_CHIP_IRQ) = PIN_INPUT_PULL_DOWN;
    GPIO_PIN_CNF(PIN_CHIP_RESET) = PIN_DISCONNECTED;
    SPIM_PSEL_SCK = PIN_CHIP_SCK;
    SPIM_PSEL_MOSI = PIN_CHIP_MOSI;
    SPIM_PSEL_MISO = PIN_CHIP_MISO;
    SPIM_CONFIG = 0u; /* mode 0, most significant bit first */
    set_spi_fast(false);
    SPIM_ENABLE = SPIM_ENABLED;
    GPIOTE_CONFIG0 = GPIOTE_RISING_ON(PIN_CHIP_IRQ);
    GPIOTE_INTENSET = 1u;
    NVIC_ISER0 = 1u << GPIOTE_IRQ;
    reset_chip(); /* a frame that waits in it from before a restart of the processor is not sent */
}

/* Lights and role */

static const struct {
    uint32_t light;
    uint32_t pin;
} LIGHTS[4] = {
    {LIGHT_READY, PIN_LIGHT_READY},
    {LIGHT_RECEIVED, PIN_LIGHT_RECEIVED},
    {LIGHT_SENT, PIN_LIGHT_SENT},
    {LIGHT_FAULT, PIN_LIGHT_FAULT},
};

static uint32_t shown;

static void show(uint32_t lights)
{
    if (lights != shown) {
        shown = lights;
        for (uint32_t at = 0u; at < 4u; at++) {
            if ((lights & LIGHTS[at].light) != 0u) {
                GPIO_OUTCLR = 1u << LIGHTS[at].pin;
            } else {
                GPIO_OUTSET = 1u << LIGHTS[at].pin;
            }
        }
    }
}

static void start_lights(void)
{
    for (uint32_t at = 0u; at < 4u; at++) {
        GPIO_OUTSET = 1u << LIGHTS[at].pin;
        GPIO_PIN_CNF(LIGHTS[at].pin) = PIN_OUTPUT;
    }
}

static bool can_transmit(void)
{
    bool is_high;

    GPIO_PIN_CNF(PIN_ROLE) = PIN_INPUT_PULL_UP;
    pause_us(PULL_UP_US);
    is_high = (GPIO_IN & (1u << PIN_ROLE)) != 0u;
    GPIO_PIN_CNF(PIN_ROLE) = PIN_DISCONNECTED; /* a pull-up to ground draws current */
    return is_high;
}

/* The loop */

static uint32_t reset_cause(void)
{
    uint32_t cause = POWER_RESETREAS & RESETREAS_MASK;

    if ((cause & RESETREAS_PIN) != 0u) {
        cause = RESETREAS_PIN; /* the others may be set with it (anomaly 136) */
    }
    POWER_RESETREAS = 0xFFFFFFFFu; /* each bit is cleared by writing it */
    return startup_take_fault() ? (cause | FAULT_CAUSE) : cause;
}

static void prepare_sleep(void)
{
    if (CHIP_REVISION <= REVISION_1) {
        POWER_KEEP_RAM = FICR_KEEP_RAM;
    }
    GPIO_OUTSET = 1u << PIN_AWAKE;
    GPIO_PIN_CNF(PIN_AWAKE) = PIN_OUTPUT;
}

/* Sleep until the time is over, the chip's interrupt line has risen, a byte has come or the transmitter is free. Events
 * that came since they were cleared have left their interrupts pending, so that the sleep ends at once. */
static void sleep_us(uint32_t microseconds)
{
    TIMER0_CC0 = now_us() + microseconds;
    GPIO_OUTCLR = 1u << PIN_AWAKE;
    __asm volatile("dsb\n\twfi" ::: "memory");
    GPIO_OUTSET = 1u << PIN_AWAKE;
}

static void clear_events(void)
{
    GPIOTE_IN0 = 0u;
    TIMER0_COMPARE0 = 0u;
    UARTE_RXDRDY = 0u;
    (void)TIMER0_COMPARE0; /* the writes have arrived before the interrupts are cleared (PS 15) */
    NVIC_ICPR0 = (1u << UARTE_IRQ) | (1u << GPIOTE_IRQ) | (1u << TIMER0_IRQ);
}

static const struct hardware HARDWARE = {
    .transfer = transfer,
    .set_spi_fast = set_spi_fast,
    .reset_chip = reset_chip,
    .pause_us = pause_us,
    .now_us = now_us,
    .interrupt_line = interrupt_line,
    .read_line = serial_port_read,
    .write_line = serial_port_write,
    .restart_line = serial_port_restart,
    .show = show,
};

int main(void)
{
    struct board_identity identity = {0};

    identity.reset_cause = (uint8_t)reset_cause();
    start_watchdog();
    start_lights();
    show(LIGHT_FAULT); /* until the crystal runs; if it never does the watchdog starts all again */
    start_clocks();
    show(0u);
    prepare_sleep();
    start_chip_pins();
    for (uint32_t at = 0u; at < sizeof identity.device_id; at++) {
        identity.device_id[at] = (uint8_t)(FICR_DEVICEID[at / 4u] >> (8u * (at % 4u)));
    }
    identity.can_transmit = can_transmit();
    serial_port_start();
    board_init(&board, &HARDWARE, &identity);
    board_begin(&board);
    for (;;) {
        uint32_t idle_us;

        WDT_RR0 = WDT_RELOAD;
        clear_events();
        serial_port_pump();
        idle_us = board_turn(&board);
        if (idle_us >= SHORTEST_SLEEP_US) {
            sleep_us(idle_us);
        }
    }
}
