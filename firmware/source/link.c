#include "link.h"

#include <string.h>

#define FULL_BLOCK 255u /* COBS: 254 bytes without a zero after the code */

uint32_t link_crc16(const uint8_t *data, uint32_t size)
{
    uint32_t crc = 0xFFFFu;

    for (uint32_t at = 0u; at < size; at++) {
        uint32_t step = (crc >> 8) ^ data[at];

        step ^= step >> 4;
        crc = ((crc << 8) ^ (step << 12) ^ (step << 5) ^ step) & 0xFFFFu;
    }
    return crc;
}

uint32_t link_fcs(const uint8_t *data, uint32_t size)
{
    uint32_t fcs = 0u;

    for (uint32_t at = 0u; at < size; at++) {
        uint32_t step = (fcs ^ data[at]) & 0xFFu;

        step = (step ^ (step << 4)) & 0xFFu;
        fcs = (fcs >> 8) ^ (step << 8) ^ (step << 3) ^ (step >> 4);
    }
    return fcs;
}

uint64_t link_number(const uint8_t *data, uint32_t size)
{
    uint64_t value = 0u;

    for (uint32_t at = size; at > 0u; at--) {
        value = (value << 8) | data[at - 1u];
    }
    return value;
}

/* Writing */

static void begin(struct link_writer *writer, uint32_t kind)
{
    writer->record[0] = (uint8_t)kind;
    writer->record[1] = writer->number;
    writer->number++;
    writer->fill = LINK_BODY_AT;
}

/* Append a number, little-endian; negative ones as their complement. */
static void append(struct link_writer *writer, uint64_t value, uint32_t size)
{
    for (uint32_t at = 0u; at < size; at++) {
        writer->record[writer->fill] = (uint8_t)(value & 0xFFu);
        writer->fill++;
        value >>= 8;
    }
}

static void append_bytes(struct link_writer *writer, const uint8_t *data, uint32_t size)
{
    (void)memcpy(&writer->record[writer->fill], data, size);
    writer->fill += size;
}

/* Write the record without zeros (COBS) and a 0 after it. */
static void stuff(struct link_writer *writer)
{
    uint32_t code_at = 0u;
    uint32_t code = 1u;
    uint32_t fill = 1u;

    for (uint32_t at = 0u; at < writer->fill; at++) {
        uint8_t byte = writer->record[at];

        if (byte != 0u) {
            writer->line[fill] = byte;
            fill++;
            code++;
        } else {
            writer->line[code_at] = (uint8_t)code;
            code_at = fill;
            fill++;
            code = 1u;
        }
    }
    writer->line[code_at] = (uint8_t)code;
    writer->line[fill] = 0u;
    writer->length = fill + 1u;
}

/* Finish a record: check, COBS. A record has at most 250 bytes, so that no block is ever full. */
static void end(struct link_writer *writer)
{
    uint32_t crc = link_crc16(writer->record, writer->fill);

    append(writer, crc >> 8, 1u);
    append(writer, crc & 0xFFu, 1u);
    stuff(writer);
}

void link_write_hello(struct link_writer *writer, const struct link_hello *hello)
{
    begin(writer, LINK_HELLO);
    append(writer, LINK_MAJOR, 1u);
    append(writer, LINK_MINOR, 1u);
    append_bytes(writer, hello->firmware, sizeof hello->firmware);
    append_bytes(writer, hello->identity, sizeof hello->identity);
    append(writer, LINK_RATE_KHZ, 4u);
    append(writer, LINK_COUNTER_BITS, 1u);
    append(writer, hello->capabilities, 1u);
    append(writer, hello->reset_cause, 1u);
    end(writer);
}

void link_write_rx(struct link_writer *writer, uint64_t rx_ticks, const struct link_measured *measured,
                   const uint8_t *frame, uint32_t frame_bytes)
{
    begin(writer, (measured->phase < 0) ? LINK_RX : LINK_RX_PHASE);
    append(writer, rx_ticks, LINK_STAMP_BYTES);
    append(writer, (uint32_t)measured->rx_power_cdbm, 2u);
    append(writer, (uint32_t)measured->first_path_cdbm, 2u);
    append(writer, (uint32_t)measured->offset_ppb, 2u);
    append(writer, (uint32_t)measured->phase, (measured->phase < 0) ? 0u : 2u);
    append_bytes(writer, frame, frame_bytes);
    end(writer);
}

void link_write_tx_done(struct link_writer *writer, uint64_t dx_ticks, uint64_t tx_ticks)
{
    begin(writer, LINK_TX_DONE);
    append(writer, dx_ticks, LINK_STAMP_BYTES);
    append(writer, tx_ticks, LINK_STAMP_BYTES);
    end(writer);
}

void link_write_tx_late(struct link_writer *writer, uint64_t dx_ticks, uint32_t reason)
{
    begin(writer, LINK_TX_LATE);
    append(writer, dx_ticks, LINK_STAMP_BYTES);
    append(writer, reason, 1u);
    end(writer);
}

void link_write_status(struct link_writer *writer, const struct link_status *status)
{
    begin(writer, LINK_STATUS);
    append(writer, status->now_ticks, LINK_STAMP_BYTES);
    append(writer, status->state, 1u);
    append(writer, status->received & LINK_COUNT_MASK, 4u);
    append(writer, status->errors & LINK_COUNT_MASK, 4u);
    append(writer, status->sent & LINK_COUNT_MASK, 4u);
    append(writer, status->late & LINK_COUNT_MASK, 4u);
    append(writer, status->garbled & LINK_COUNT_MASK, 4u);
    append(writer, status->unsent & LINK_COUNT_MASK, 4u);
    append(writer, (uint32_t)status->temperature_cc, 2u);
    append(writer, status->millivolts, 2u);
    end(writer);
}

void link_write_refused(struct link_writer *writer, uint32_t kind, uint32_t reason)
{
    begin(writer, LINK_REFUSED);
    append(writer, kind, 1u);
    append(writer, reason, 1u);
    end(writer);
}

void link_write_words(struct link_writer *writer, uint32_t kind, const void *words, uint32_t size)
{
    begin(writer, kind);
    append_bytes(writer, words, size);
    end(writer);
}

void link_write_fix(struct link_writer *writer, const struct fix *fix)
{
    begin(writer, LINK_FIX);
    append_bytes(writer, (const uint8_t *)fix, FIX_SENT_BYTES);
    for (uint32_t at = 0u; at < fix->anchor_count; at++) {
        append(writer, fix->anchors[at].id, 2u);
    }
    end(writer);
}

void link_write_tag_config(struct link_writer *writer, const struct settings *settings, bool is_in_flash)
{
    begin(writer, LINK_TAG_CONFIG);
    append(writer, is_in_flash ? LINK_IN_FLASH : 0u, 1u);
    settings_pack(settings, &writer->record[writer->fill]);
    writer->fill += SETTINGS_BYTES;
    end(writer);
}

/* Reading */

/* The inverse of COBS for `line`, which holds no zeros; false where a block lacks its end. */
static bool unstuff(const uint8_t *line, uint32_t size, uint8_t *out, uint32_t *out_size)
{
    uint32_t at = 0u;
    uint32_t fill = 0u;

    while (at < size) {
        uint32_t code = line[at];
        uint32_t stop = at + code;

        if (stop > size) {
            return false;
        }
        at++;
        while (at < stop) {
            out[fill] = line[at];
            fill++;
            at++;
        }
        if ((code != FULL_BLOCK) && (at < size)) {
            out[fill] = 0u;
            fill++;
        }
    }
    *out_size = fill;
    return true;
}

/* A zero has come: are the bytes before it a record? */
static void finish(struct link_reader *reader)
{
    uint32_t fill = reader->fill;
    uint32_t size = 0u;

    reader->fill = 0u;
    if (reader->is_skipping) {
        reader->is_skipping = false;
    } else if (fill > 0u) {
        if (unstuff(reader->line, fill, reader->record, &size) && (size >= (LINK_BODY_AT + 2u)) &&
            (link_crc16(reader->record, size) == 0u)) {
            reader->length = size - 2u;
        } else {
            reader->garbled++;
        }
    } else {
        /* an empty line means nothing */
    }
}

uint32_t link_read(struct link_reader *reader, const uint8_t *data, uint32_t size)
{
    uint32_t at = 0u;

    reader->length = 0u;
    while ((at < size) && (reader->length == 0u)) {
        uint8_t byte = data[at];

        at++;
        if (byte == 0u) {
            finish(reader);
        } else if (reader->fill < sizeof reader->line) {
            reader->line[reader->fill] = byte;
            reader->fill++;
        } else if (!reader->is_skipping) {
            reader->overlong++;
            reader->is_skipping = true;
        } else {
            /* the rest of a line that is too long */
        }
    }
    return at;
}
