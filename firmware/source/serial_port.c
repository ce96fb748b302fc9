/* The receiver fills a ring again and again (short from ENDRX to STARTRX), and TIMER1 counts its bytes through PPI. What
 * is sent waits in another ring, from which the transmitter gets one piece after the other. */
#include "nrf52832.h"
#include "peripherals.h"
#include "pins.h"

#define IN_BYTES UARTE_MAX_BYTES
#define OUT_BYTES 1024u /* eight receptions with 100 bytes: 10 ms of the line */
#define DMA_US 1u /* a byte may be counted before it is in RAM (assumed; PS 35 promises nothing) */
#define WAIT_TURNS 5000u /* loops of some 0.15 us: longer than five bytes at 115200 baud, which a receiver needs to stop */

static const struct {
    uint32_t baud;
    uint32_t code;
} RATES[4] = {{115200u, UARTE_115200_BAUD},
              {230400u, UARTE_230400_BAUD},
              {460800u, UARTE_460800_BAUD},
              {1000000u, UARTE_1_MBAUD}};

static uint32_t rate = UARTE_460800_BAUD; /* a new board's, or its debugger could not keep up */
static uint8_t in_ring[IN_BYTES];
static uint32_t in_at;
static uint32_t in_count; /* bytes read since the receiver's start */
static uint8_t out_ring[OUT_BYTES];
static uint32_t out_at;
static uint32_t out_held;
static uint32_t out_sending; /* of these, the piece that the transmitter has */

static void start_receiver(void)
{
    TIMER1_STOP = 1u;
    TIMER1_CLEAR = 1u;
    TIMER1_START = 1u;
    in_at = 0u;
    in_count = 0u;
    UARTE_RXD_PTR = (uint32_t)in_ring;
    UARTE_RXD_MAXCNT = IN_BYTES;
    UARTE_SHORTS = UARTE_SHORT_ENDRX_STARTRX;
    UARTE_STARTRX = 1u;
}

void serial_port_set_rate(uint32_t baud)
{
    serial_port_stop();
    for (uint32_t at = 0u; at < (sizeof RATES / sizeof RATES[0]); at++) {
        if (RATES[at].baud == baud) {
            rate = RATES[at].code;
        }
    }
    serial_port_start();
}

void serial_port_start(void)
{
    GPIO_OUTSET = 1u << PIN_UART_TX;
    GPIO_PIN_CNF(PIN_UART_TX) = PIN_OUTPUT;
    GPIO_PIN_CNF(PIN_UART_RX) = PIN_INPUT_PULL_UP;
    UARTE_PSEL_RTS = NOT_CONNECTED;
    UARTE_PSEL_CTS = NOT_CONNECTED;
    UARTE_PSEL_TXD = PIN_UART_TX;
    UARTE_PSEL_RXD = PIN_UART_RX;
    UARTE_BAUDRATE = rate;
    UARTE_CONFIG = 0u;
    UARTE_ENABLE = UARTE_ENABLED;
    TIMER1_MODE = TIMER_COUNTS;
    TIMER1_BITMODE = TIMER_32_BITS;
    PPI_CH0_EEP = UARTE_RXDRDY_ADDRESS;
    PPI_CH0_TEP = TIMER1_COUNT_ADDRESS;
    PPI_CHENSET = 1u;
    UARTE_INTENSET = UARTE_INT_RXDRDY | UARTE_INT_ENDTX;
    NVIC_ISER0 = 1u << UARTE_IRQ;
    start_receiver();
}

static void wait_for(const volatile uint32_t *event)
{
    for (uint32_t turn = 0u; (turn < WAIT_TURNS) && (*event == 0u); turn++) {
    }
}

/* A receiver that stops keeps up to four bytes more (PS 35), which TIMER1 has counted. They are flushed, or the next
 * start would put them before the bytes that are counted then, and all that comes would be read four bytes late. */
static void stop_receiver(void)
{
    UARTE_SHORTS = 0u;
    UARTE_RXTO = 0u;
    UARTE_STOPRX = 1u;
    wait_for(&UARTE_RXTO);
    UARTE_ENDRX = 0u;
    UARTE_FLUSHRX = 1u;
    wait_for(&UARTE_ENDRX);
}

void serial_port_restart(void)
{
    stop_receiver();
    start_receiver();
}

void serial_port_stop(void)
{
    while (out_held > 0u) {
        serial_port_pump();
    }
    stop_receiver();
    UARTE_TXSTOPPED = 0u;
    UARTE_STOPTX = 1u;
    wait_for(&UARTE_TXSTOPPED);
    UARTE_ENDTX = 0u; /* a transmitter that stops may report an end (PS 35) */
    UARTE_ENABLE = 0u;
    TIMER1_STOP = 1u;
    TIMER1_SHUTDOWN = 1u; /* anomaly 78 */
}

uint32_t serial_port_read(uint8_t *into, uint32_t size)
{
    uint32_t fresh;
    uint32_t count;

    UARTE_RXDRDY = 0u;
    TIMER1_CAPTURE0 = 1u;
    fresh = TIMER1_CC0 - in_count;
    if (fresh > IN_BYTES) { /* overwritten */
        in_at = (in_at + fresh) % IN_BYTES;
        in_count += fresh;
        fresh = 0u;
    }
    count = (fresh < size) ? fresh : size;
    if (count > 0u) {
        clock_pause_us(DMA_US);
    }
    for (uint32_t at = 0u; at < count; at++) {
        into[at] = in_ring[in_at];
        in_at = (in_at + 1u) % IN_BYTES;
    }
    in_count += count;
    return count;
}

void serial_port_pump(void)
{
    uint32_t to_end;

    if (out_sending > 0u) {
        if (UARTE_ENDTX == 0u) {
            return;
        }
        UARTE_ENDTX = 0u;
        out_at = (out_at + out_sending) % OUT_BYTES;
        out_held -= out_sending;
        out_sending = 0u;
    }
    if (out_held > 0u) {
        to_end = OUT_BYTES - out_at;
        out_sending = (out_held < to_end) ? out_held : to_end;
        if (out_sending > UARTE_MAX_BYTES) {
            out_sending = UARTE_MAX_BYTES;
        }
        UARTE_TXD_PTR = (uint32_t)&out_ring[out_at];
        UARTE_TXD_MAXCNT = out_sending;
        UARTE_STARTTX = 1u;
    }
}

bool serial_port_write(const uint8_t *line, uint32_t size)
{
    uint32_t fill = out_at + out_held;

    if (size > (OUT_BYTES - out_held)) {
        return false;
    }
    for (uint32_t at = 0u; at < size; at++) {
        out_ring[(fill + at) % OUT_BYTES] = line[at];
    }
    out_held += size;
    serial_port_pump();
    return true;
}
