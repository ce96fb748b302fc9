#include "link.h"

/* COBS: a record has fewer than 254 bytes, so that no block is full and each ends with a 0 that is left out. */

static uint32_t crc_of(uint32_t crc, uint8_t byte)
{
    uint32_t step = (crc >> 8) ^ byte;

    step ^= step >> 4;
    return ((crc << 8) ^ (step << 12) ^ (step << 5) ^ step) & 0xFFFFu;
}

uint32_t link_crc16(const uint8_t *data, uint32_t size)
{
    uint32_t crc = 0xFFFFu;

    for (uint32_t at = 0u; at < size; at++) {
        crc = crc_of(crc, data[at]);
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

static void put(struct link_writer *writer, uint8_t byte)
{
    writer->crc = crc_of(writer->crc, byte);
    writer->line[writer->fill] = byte;
    if (byte == 0u) {
        writer->line[writer->code_at] = (uint8_t)(writer->fill - writer->code_at);
        writer->code_at = writer->fill;
    }
    writer->fill++;
}

void link_begin(struct link_writer *writer, uint32_t kind)
{
    writer->crc = 0xFFFFu;
    writer->code_at = 0u;
    writer->fill = 1u;
    put(writer, (uint8_t)kind);
    put(writer, writer->number);
    writer->number++;
}

void link_append(struct link_writer *writer, uint64_t value, uint32_t size)
{
    for (uint32_t at = 0u; at < size; at++) {
        put(writer, (uint8_t)value);
        value >>= 8;
    }
}

void link_append_bytes(struct link_writer *writer, const void *data, uint32_t size)
{
    for (uint32_t at = 0u; at < size; at++) {
        put(writer, ((const uint8_t *)data)[at]);
    }
}

void link_send(struct link_writer *writer)
{
    const uint8_t zero = 0u;
    uint32_t crc = writer->crc;

    put(writer, (uint8_t)(crc >> 8));
    put(writer, (uint8_t)crc);
    put(writer, 0u);
    if (writer->is_among_text) {
        (void)writer->write_line(&zero, 1u);
    }
    if (!writer->write_line(writer->line, writer->fill)) {
        writer->unsent++;
    }
}

/* A zero has come: are the bytes before it a record? */
static void finish(struct link_reader *reader)
{
    uint32_t size = reader->fill - 1u;

    if (reader->fill > 0u) {
        if ((reader->left == 0u) && (size >= (LINK_BODY_AT + 2u)) && (link_crc16(reader->record, size) == 0u)) {
            reader->length = size - 2u;
        } else {
            reader->garbled++;
        }
    }
    reader->fill = 0u;
    reader->left = 0u;
}

static void take(struct link_reader *reader, uint8_t byte)
{
    bool is_code = reader->left == 0u;

    if (reader->fill > sizeof reader->record) {
        reader->left = UINT32_MAX; /* too long for a record */
        return;
    }
    if (reader->fill > 0u) {
        reader->record[reader->fill - 1u] = is_code ? 0u : byte;
    }
    reader->left = (is_code ? byte : reader->left) - 1u;
    reader->fill++;
}

uint32_t link_read(struct link_reader *reader, const uint8_t *data, uint32_t size)
{
    uint32_t at = 0u;

    reader->length = 0u;
    while ((at < size) && (reader->length == 0u)) {
        if (data[at] == 0u) {
            finish(reader);
        } else {
            take(reader, data[at]);
        }
        at++;
    }
    return at;
}
