/* What a DWM1001 does from its start: it wires the board's loop to the processor, and sleeps between its turns. */
#include <stdbool.h>
#include <stdint.h>

#include "board.h"
#include "hardware.h"
#include "nrf52832.h"
#include "peripherals.h"
#include "pins.h"

#define WATCHDOG_PERIODS (2u * 32768u) /* 2 s; no turn lasts longer than 0.3 s, no sleep between turns than 0.6 s */
#define RESET_LOW_US 100u /* the chip needs some ns (DW1000 data sheet, RSTn) */
#define SELECTED_US 600u  /* longer than the 500 that wake it (UM 2.3) */
#define PULL_UP_US 20u    /* 13 kOhm load a wire of 100 pF in some us */
#define FAULT_CAUSE 0x80u /* in HELLO: a fault that the firmware noticed */
/* Shorter sleeps are waited for: the compare value must still lie ahead when it is written. */
#define SHORTEST_SLEEP_US 4u

static struct board board; /* in RAM, as the DMA needs its buffers */

static void start_watchdog(void)
{
    WDT_CONFIG = WDT_RUNS_IN_SLEEP;
    WDT_CRV = WATCHDOG_PERIODS - 1u;
    WDT_RREN = 1u;
    WDT_START = 1u;
}

/* The chip */

static uint32_t spi_frequency = SPIM_2_MHZ;

static void set_spi_fast(bool fast)
{
    spi_frequency = fast ? SPIM_8_MHZ : SPIM_2_MHZ;
    SPIM_FREQUENCY = spi_frequency;
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
    clock_pause_us(RESET_LOW_US);
    GPIO_DIRCLR = 1u << PIN_CHIP_RESET; /* the chip pulls it up */
}

static bool interrupt_line(void)
{
    return (GPIO_IN & (1u << PIN_CHIP_IRQ)) != 0u;
}

static void connect_chip(void)
{
    GPIOTE_CONFIG0 = GPIOTE_RISING_ON(PIN_CHIP_IRQ);
    SPIM_PSEL_SCK = PIN_CHIP_SCK;
    SPIM_PSEL_MOSI = PIN_CHIP_MOSI;
    SPIM_PSEL_MISO = PIN_CHIP_MISO;
    SPIM_CONFIG = 0u; /* mode 0, most significant bit first */
    SPIM_FREQUENCY = spi_frequency;
    SPIM_ENABLE = SPIM_ENABLED;
}

/* Anomaly 89: a SPIM that has worked beside GPIOTE draws some 400 uA until its block was without power. */
static void disconnect_chip(void)
{
    GPIOTE_CONFIG0 = 0u;
    SPIM_ENABLE = 0u;
    SPIM_POWER = 0u;
    (void)SPIM_POWER;
    SPIM_POWER = 1u;
}

/* Chip select low wakes a chip that sleeps from before a restart of the processor; its reset pin does not. It is ready
 * when the host asks for it. */
static void wake_chip(void)
{
    GPIO_OUTCLR = 1u << PIN_CHIP_SELECT;
    clock_pause_us(SELECTED_US);
    GPIO_OUTSET = 1u << PIN_CHIP_SELECT;
}

static void start_chip_pins(bool may_sleep)
{
    GPIO_OUTSET = 1u << PIN_CHIP_SELECT;
    GPIO_PIN_CNF(PIN_CHIP_SELECT) = PIN_OUTPUT;
    GPIO_PIN_CNF(PIN_CHIP_SCK) = PIN_FAST_CLOCK;
    GPIO_PIN_CNF(PIN_CHIP_MOSI) = PIN_FAST_OUTPUT;
    GPIO_PIN_CNF(PIN_CHIP_MISO) = PIN_INPUT_PULL_DOWN;
    GPIO_PIN_CNF(PIN_CHIP_IRQ) = PIN_INPUT_PULL_DOWN;
    GPIO_PIN_CNF(PIN_CHIP_RESET) = PIN_DISCONNECTED;
    connect_chip();
    GPIOTE_INTENSET = 1u;
    NVIC_ISER0 = 1u << GPIOTE_IRQ;
    if (may_sleep) {
        wake_chip();
    }
    reset_chip(); /* a frame that waits in it from before a restart of the processor is not sent */
}

/* Lights and role */

static const uint8_t LIGHTS[4] = {PIN_LIGHT_READY, PIN_LIGHT_RECEIVED, PIN_LIGHT_SENT, PIN_LIGHT_FAULT};

static void show(uint32_t lights)
{
    for (uint32_t at = 0u; at < sizeof LIGHTS; at++) {
        if (((lights >> at) & 1u) != 0u) {
            GPIO_OUTCLR = 1u << LIGHTS[at];
        } else {
            GPIO_OUTSET = 1u << LIGHTS[at];
        }
    }
}

static void start_lights(void)
{
    show(LIGHT_FAULT); /* until the crystal runs; if it never does the watchdog starts all again */
    for (uint32_t at = 0u; at < sizeof LIGHTS; at++) {
        GPIO_PIN_CNF(LIGHTS[at]) = PIN_OUTPUT;
    }
}

static bool can_transmit(void)
{
    bool is_high;

    GPIO_PIN_CNF(PIN_ROLE) = PIN_INPUT_PULL_UP;
    clock_pause_us(PULL_UP_US);
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
    POWER_KEEP_RAM = FICR_KEEP_RAM;
    POWER_DCDCEN = 1u; /* the module has the coil */
    GPIO_OUTSET = 1u << PIN_AWAKE;
    GPIO_PIN_CNF(PIN_AWAKE) = PIN_OUTPUT;
}

static void clear_events(void)
{
    GPIOTE_IN0 = 0u;
    UARTE_RXDRDY = 0u;
    TIMER0_COMPARE0 = 0u;
    (void)TIMER0_COMPARE0; /* the writes have arrived before the interrupts are cleared (PS 15) */
    NVIC_ICPR0 = (1u << RADIO_IRQ) | (1u << UARTE_IRQ) | (1u << GPIOTE_IRQ) | (1u << TIMER0_IRQ);
}

/* Sleep with everything off but RAM and the slow clock. An input that is watched, the serial line's receiver, and what
 * counts would keep the fast clock on. */
static void sleep_for(uint32_t milliseconds)
{
    while (bluetooth_pump()) {
    }
    serial_port_stop();
    disconnect_chip();
    clear_events();
    GPIO_OUTCLR = 1u << PIN_AWAKE;
    clock_sleep_ms(milliseconds);
    GPIO_OUTSET = 1u << PIN_AWAKE;
    connect_chip();
    serial_port_start();
}

static uint32_t probe(enum probe item)
{
    static const uint32_t WORDS[PROBE_STACK_BYTES] = {FICR_INFO_PART_ADDRESS, FICR_INFO_VARIANT_ADDRESS,
                                                      CHIP_REVISION_ADDRESS, UICR_PSELRESET0_ADDRESS,
                                                      UICR_APPROTECT_ADDRESS};

    if (item < PROBE_STACK_BYTES) {
        return REGISTER(WORDS[item]);
    }
    return (item == PROBE_SLOW_COUNT) ? clock_slow_count() : startup_stack_bytes(item == PROBE_STACK_USED);
}

static const struct hardware HARDWARE = {
    .transfer = transfer,
    .set_spi_fast = set_spi_fast,
    .reset_chip = reset_chip,
    .pause_us = clock_pause_us,
    .now_us = clock_now_us,
    .interrupt_line = interrupt_line,
    .read_line = serial_port_read,
    .write_line = serial_port_write,
    .restart_line = serial_port_restart,
    .set_rate = serial_port_set_rate,
    .show = show,
    .sleep_for = sleep_for,
    .read_settings = flash_read,
    .write_settings = flash_write,
    .probe = probe,
    .advertise = bluetooth_advertise,
};

int main(void)
{
    struct board_identity identity = {0};

    identity.reset_cause = (uint8_t)reset_cause();
    clock_start_slow(); /* first: the watchdog would start another source of the slow clock */
    start_watchdog();
    start_lights();
    clock_start();
    show(0u);
    prepare_sleep();
    start_chip_pins(identity.reset_cause != 0u);
    for (uint32_t at = 0u; at < sizeof identity.device_id; at++) {
        identity.device_id[at] = (uint8_t)(FICR_DEVICEID[at / 4u] >> (8u * (at % 4u)));
    }
    identity.can_transmit = can_transmit();
    serial_port_start();
    board_init(&board, &HARDWARE, &identity);
    board_begin(&board);
    /* A sleep ends when its time is over, the chip's interrupt line has risen, a byte has come or the transmitter is free.
     * Events that came since they were cleared have left their interrupts pending, so that it ends at once. */
    for (;;) {
        uint32_t idle_us;

        WDT_RR0 = WDT_RELOAD;
        (void)bluetooth_pump();
        clear_events();
        serial_port_pump();
        idle_us = board_turn(&board);
        if (idle_us >= SHORTEST_SLEEP_US) {
            GPIO_OUTCLR = 1u << PIN_AWAKE;
            clock_sleep_us(idle_us);
            GPIO_OUTSET = 1u << PIN_AWAKE;
        }
    }
}
