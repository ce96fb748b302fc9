/* The serial link between a board and its host, to the byte (docs/serial.md): framing, check, records.
 *
 * A record is kind | number | body | CRC-16, made free of zeros (COBS) and ended by a 0 byte. The host's end is
 * src/skyless/radio/serial/link.py; a test compares both.
 */
#ifndef LINK_H
#define LINK_H

#include <stdbool.h>
#include <stdint.h>

#define LINK_MAJOR 1u
#define LINK_MINOR 4u

/* From the board */
#define LINK_HELLO 0x01u
#define LINK_RX 0x02u
#define LINK_TX_DONE 0x03u
#define LINK_TX_LATE 0x04u
#define LINK_STATUS 0x05u
#define LINK_REFUSED 0x06u
#define LINK_RX_PHASE 0x07u
#define LINK_FIX 0x08u
#define LINK_TAG_STATUS 0x09u
#define LINK_ANCHOR_PLACE 0x0Au
#define LINK_GEOREFERENCE 0x0Bu
#define LINK_TAG_CONFIG 0x0Cu
#define LINK_VALUE 0x0Du
#define LINK_TEST 0x0Eu

/* From the host */
#define LINK_ASK_HELLO 0x41u
#define LINK_CONFIG 0x42u
#define LINK_TX_AT 0x43u
#define LINK_RX_ON 0x44u
#define LINK_ASK_STATUS 0x45u
#define LINK_SET_TAG_CONFIG 0x46u
#define LINK_ASK_TAG_CONFIG 0x47u
#define LINK_SET_TIME 0x48u
#define LINK_READ 0x49u
#define LINK_TEST_LINE 0x4Au

#define LINK_BODY_AT 2u /* after kind and number */
#define LINK_TX_FRAME_AT 7u
#define LINK_CONFIG_BYTES 13u
#define LINK_SETTINGS_AT 3u /* in both records of settings, after flags */
#define LINK_IDENTITY_BYTES 8u
#define LINK_STAMP_BYTES 5u
#define LINK_STATUS_OCTETS 5u /* of SYS_STATUS in REFUSED */

#define LINK_NO_VOLTAGE 0xFFFFu

#define LINK_CAN_TRANSMIT 0x01u
#define LINK_HAS_PHASES 0x02u
#define LINK_CAN_COMPUTE 0x04u
#define LINK_WANTS_PHASES 0x01u /* flag in CONFIG */
#define LINK_IN_FLASH 0x01u      /* flag in the records of settings: to be kept, or kept */

/* What READ reads: a register file of the chip, or one of these */
#define LINK_OTP 0x40u    /* a word of the chip's one-time programmable memory, at `sub` */
#define LINK_FACTS 0x80u  /* of the processor (enum probe) */
#define LINK_CLOCKS 0x81u /* microseconds, periods of the slow crystal, the chip's counter */
#define LINK_COUNTS 0x82u
#define LINK_READ_DATA_AT 9u
#define LINK_READ_BYTES 16u /* of a register, at most */
#define LINK_READ_TIMES 1000u /* at most */
#define LINK_READ_SLOWLY 0x01u /* flag in READ: at the slow SPI clock */
#define LINK_TEST_OVERHEAD 6u /* bytes of a record on the line besides its body */

/* State in STATUS */
#define LINK_IS_CONFIGURED 0x01u
#define LINK_IS_RECEIVING 0x02u
#define LINK_HAS_FRAME_WAITING 0x04u
#define LINK_IS_POLLED 0x08u /* the chip's interrupt line does not follow its events */

/* Why a frame was not sent */
#define LINK_LATE_FOR_RADIO 1u
#define LINK_LATE_BUSY 2u
#define LINK_LATE_NOT_READY 3u

/* Why a command was refused */
#define LINK_REFUSED_SETTING 1u
#define LINK_REFUSED_MALFORMED 2u
#define LINK_REFUSED_RADIO 3u

#define LINK_RATE_KHZ 63897600u
#define LINK_COUNTER_BITS 40u
#define LINK_COUNT_MASK 0x3FFFFFFFu

#define LINK_MAX_RECORD_BYTES 250u /* with its check */
#define LINK_MAX_LINE_BYTES 252u   /* with code and 0 */

/* Writes records: begin, append, send. */
struct link_writer {
    bool (*write_line)(const uint8_t *line, uint32_t size);
    bool is_among_text; /* each record begins with a 0, or the text before it would belong to it */
    uint8_t number;
    uint32_t unsent; /* records that the line did not take */
    uint32_t crc;
    uint32_t code_at; /* of the block that is being filled */
    uint32_t fill;
    uint8_t line[LINK_MAX_LINE_BYTES];
};

void link_begin(struct link_writer *writer, uint32_t kind);
/* A number, little-endian; negative ones as their complement. */
void link_append(struct link_writer *writer, uint64_t value, uint32_t size);
void link_append_bytes(struct link_writer *writer, const void *data, uint32_t size);
void link_send(struct link_writer *writer);

/* Finds records in bytes that may hold anything. `record[0..length)` is the one that was found, without its check;
 * `length` is 0 where there is none. */
struct link_reader {
    uint32_t length;
    uint32_t garbled; /* stretches between two zeros that are no record */
    uint32_t left;    /* bytes until the next code of COBS */
    uint32_t fill;    /* bytes since the last 0 */
    uint8_t record[LINK_MAX_RECORD_BYTES];
};

/* Process `data` up to the end of the next record; how many bytes that were. */
uint32_t link_read(struct link_reader *reader, const uint8_t *data, uint32_t size);

/* CRC-16/IBM-3740: x^16 + x^12 + x^5 + 1 from 0xFFFF; 0 over what ends with its own, high byte first. */
uint32_t link_crc16(const uint8_t *data, uint32_t size);

/* The frame check sequence of IEEE 802.15.4 (7.2.10): the same polynomial, reflected, from 0. */
uint32_t link_fcs(const uint8_t *data, uint32_t size);

/* Little-endian number of up to eight bytes. */
uint64_t link_number(const uint8_t *data, uint32_t size);

#endif
