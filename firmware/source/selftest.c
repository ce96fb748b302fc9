#include "selftest.h"

#include <string.h>

/* Ten bits, and 2 % for a port whose rate is that much lower. */
#define BYTE_US_TIMES_BAUD 10200000u
#define NOTHING_DUE_US 1000000u

static void append_facts(struct board *board)
{
    for (uint32_t item = 0u; item < (uint32_t)PROBE_FACTS; item++) {
        link_append(&board->writer, board->hardware->probe((enum probe)item), 4u);
    }
}

static void append_clocks(struct board *board)
{
    const struct hardware *hardware = board->hardware;

    link_append(&board->writer, hardware->now_us(), 4u);
    link_append(&board->writer, hardware->probe(PROBE_SLOW_COUNT), 4u);
    link_append(&board->writer, board->is_configured ? dw1000_now(&board->chip) : 0u, LINK_STAMP_BYTES);
}

static void append_counts(struct board *board)
{
    const struct dw1000 *chip = &board->chip;
    const uint32_t counts[5] = {chip->lock_us, chip->clock_slips, chip->carrier_slips, board->reception_us, board->tested};

    for (uint32_t at = 0u; at < (sizeof counts / sizeof counts[0]); at++) {
        link_append(&board->writer, counts[at], 4u);
    }
}

bool selftest_read(struct board *board, const uint8_t *record, uint32_t length)
{
    struct link_writer *writer = &board->writer;
    uint8_t value[LINK_READ_BYTES] = {0u};
    uint32_t differing = 0u;

    if (length < LINK_READ_DATA_AT) {
        return false;
    }

    uint32_t file = record[2];
    uint32_t sub = (uint32_t)link_number(&record[3], 2u);
    uint32_t octets = record[5];
    uint32_t times = (uint32_t)link_number(&record[6], 2u);
    const uint8_t *data = (length > LINK_READ_DATA_AT) ? &record[LINK_READ_DATA_AT] : NULL;

    /* Only 03:00 is written, an address that no filter uses here. */
    if ((octets == 0u) || (octets > LINK_READ_BYTES) || (times > LINK_READ_TIMES) ||
        ((data != NULL) && ((file != 0x03u) || (sub != 0u) || (length != (LINK_READ_DATA_AT + octets))))) {
        return false;
    }
    if (file < LINK_OTP) {
        board->hardware->set_spi_fast(board->is_configured && ((record[8] & LINK_READ_SLOWLY) == 0u));
        differing = dw1000_read_times(&board->chip, file, sub, data, value, octets, times);
        board->hardware->set_spi_fast(board->is_configured);
    }
    link_begin(writer, LINK_VALUE);
    link_append(writer, file, 1u);
    link_append(writer, sub, 2u);
    link_append(writer, differing, 2u);
    if (file < LINK_OTP) {
        link_append_bytes(writer, value, octets);
    } else if (file == LINK_OTP) {
        link_append(writer, dw1000_read_otp(&board->chip, sub), 4u);
    } else if (file == LINK_FACTS) {
        append_facts(board);
    } else if (file == LINK_CLOCKS) {
        append_clocks(board);
    } else {
        append_counts(board);
    }
    link_send(writer);
    return true;
}

bool selftest_begin_line(struct board *board, const uint8_t *record, uint32_t length)
{
    if ((length < (LINK_BODY_AT + 3u)) || (record[4] < LINK_TEST_OVERHEAD) || (record[4] > LINK_MAX_RECORD_BYTES)) {
        return false;
    }
    board->tested++;
    if (link_number(&record[2], 2u) > 0u) {
        board->tests_left = (uint32_t)link_number(&record[2], 2u);
        board->test_bytes = record[4];
        board->test_due_us = board->hardware->now_us();
    }
    return true;
}

uint32_t selftest_turn(struct board *board, uint32_t now_us)
{
    struct link_writer *writer = &board->writer;
    uint32_t late_us = now_us - board->test_due_us;

    if (board->tests_left == 0u) {
        return NOTHING_DUE_US;
    }
    if (late_us >= 0x80000000u) {
        return 0u - late_us;
    }
    link_begin(writer, LINK_TEST);
    for (uint32_t at = LINK_TEST_OVERHEAD; at < board->test_bytes; at++) {
        link_append(writer, (at * 0x9Du) + board->tests_left, 1u);
    }
    link_send(writer);
    board->tests_left--;
    board->test_due_us += (board->test_bytes * BYTE_US_TIMES_BAUD) / board->settings.baud;
    return 0u;
}
