/* For tests in Python: sizes and fields of what the portable files hold. */
#include <string.h>

#include "board.h"

uint32_t host_board_bytes(void);
uint32_t host_chip_bytes(void);
uint32_t host_writer_bytes(void);
uint32_t host_reader_bytes(void);
void host_board_init(struct board *board, const struct hardware *hardware, const uint8_t *device_id, bool can_transmit,
                     uint8_t reset_cause);
struct dw1000 *host_board_chip(struct board *board);
struct settings *host_board_settings(struct board *board);
int64_t host_board_unix_us(const struct board *board);
uint32_t host_board_stage(const struct board *board);
const uint8_t *host_writer_line(const struct link_writer *writer);
uint32_t host_writer_length(const struct link_writer *writer);
const uint8_t *host_reader_record(const struct link_reader *reader);
uint32_t host_reader_number(const struct link_reader *reader, uint32_t which);

uint32_t host_board_bytes(void)
{
    return sizeof(struct board);
}

uint32_t host_chip_bytes(void)
{
    return sizeof(struct dw1000);
}

uint32_t host_writer_bytes(void)
{
    return sizeof(struct link_writer);
}

uint32_t host_reader_bytes(void)
{
    return sizeof(struct link_reader);
}

void host_board_init(struct board *board, const struct hardware *hardware, const uint8_t *device_id, bool can_transmit,
                     uint8_t reset_cause)
{
    struct board_identity identity = {can_transmit, {0u}, reset_cause};

    (void)memcpy(identity.device_id, device_id, sizeof identity.device_id);
    board_init(board, hardware, &identity);
}

struct dw1000 *host_board_chip(struct board *board)
{
    return &board->chip;
}

struct settings *host_board_settings(struct board *board)
{
    return &board->settings;
}

int64_t host_board_unix_us(const struct board *board)
{
    return board->tag.unix_us;
}

uint32_t host_board_stage(const struct board *board)
{
    return (uint32_t)board->stage;
}

const uint8_t *host_writer_line(const struct link_writer *writer)
{
    return writer->line;
}

uint32_t host_writer_length(const struct link_writer *writer)
{
    return writer->length;
}

const uint8_t *host_reader_record(const struct link_reader *reader)
{
    return reader->record;
}

uint32_t host_reader_number(const struct link_reader *reader, uint32_t which)
{
    const uint32_t numbers[] = {reader->length, reader->garbled, reader->overlong};

    return numbers[which];
}
