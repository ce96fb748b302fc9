/* Bluetooth advertisements that nobody can connect to: ADV_NONCONN_IND on channels 37, 38 and 39, at 0 dBm. The radio sends
 * by itself, 0.4 ms a channel; the processor only starts it.
 *
 * Formats: Bluetooth Core Specification, vol. 6, part B, 1.4.1 (channels), 2.1 and 2.3 (packets), 3 (check, whitening).
 * The nRF52832's anomalies 102, 106, 107 and 143 concern a radio that receives. */
#include "nrf52832.h"
#include "peripherals.h"

#define MAX_BYTES 31u
#define ADDRESS_BYTES 6u
#define ADV_NONCONN_IND 0x42u /* its sender has a random address (TxAdd) */
#define RANDOM_STATIC 0xC0u   /* the address's highest bits */
#define CHANNELS 3u

/* MHz above 2400, and number */
static const uint8_t CHANNEL[CHANNELS][2] = {{2u, 37u}, {26u, 38u}, {80u, 39u}};

static uint8_t packet[2u + ADDRESS_BYTES + MAX_BYTES]; /* in RAM, as the DMA needs it */
static uint32_t next = CHANNELS;
static bool is_sending;

static void set_up(void)
{
    RADIO_MODE = RADIO_BLE_1_MBIT;
    RADIO_MODECNF0 = 0x201u; /* ramp-up in 40 us */
    RADIO_TXPOWER = 0u;      /* dBm */
    RADIO_BASE0 = 0x89BED600u;
    RADIO_PREFIX0 = 0x8Eu;
    RADIO_TXADDRESS = 0u;
    RADIO_PCNF0 = 0x108u;                                    /* a byte before the length, which has 8 bits */
    RADIO_PCNF1 = 0x02030000u | (ADDRESS_BYTES + MAX_BYTES); /* whitened, low bits first, three bytes of BASE0 */
    RADIO_CRCCNF = 0x103u;                                   /* three bytes, without the access address */
    RADIO_CRCPOLY = 0x00065Bu;
    RADIO_CRCINIT = 0x555555u;
    RADIO_PACKETPTR = (uint32_t)packet;
    RADIO_SHORTS = RADIO_READY_START_END_DISABLE;
    RADIO_INTENSET = RADIO_INT_DISABLED;
    NVIC_ISER0 = 1u << RADIO_IRQ;
}

static void start_channel(void)
{
    RADIO_FREQUENCY = CHANNEL[next][0];
    RADIO_DATAWHITEIV = CHANNEL[next][1];
    RADIO_DISABLED = 0u;
    RADIO_TXEN = 1u;
    next++;
}

bool bluetooth_advertise(const uint8_t *data, uint32_t size)
{
    if (is_sending || (size > MAX_BYTES)) {
        return false;
    }
    packet[0] = ADV_NONCONN_IND;
    packet[1] = (uint8_t)(ADDRESS_BYTES + size);
    for (uint32_t at = 0u; at < ADDRESS_BYTES; at++) {
        packet[2u + at] = (uint8_t)(FICR_DEVICEADDR[at / 4u] >> (8u * (at % 4u)));
    }
    packet[1u + ADDRESS_BYTES] |= RANDOM_STATIC;
    for (uint32_t at = 0u; at < size; at++) {
        packet[2u + ADDRESS_BYTES + at] = data[at];
    }
    set_up();
    next = 0u;
    is_sending = true;
    start_channel();
    return true;
}

bool bluetooth_pump(void)
{
    if (is_sending && (RADIO_DISABLED != 0u)) {
        RADIO_DISABLED = 0u;
        is_sending = next < CHANNELS;
        if (is_sending) {
            start_channel();
        }
    }
    return is_sending;
}
