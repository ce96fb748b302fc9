/* The portable files against lines and chips that hold anything, with the sanitizers on.
 *
 *   build/fuzz BYTES [SEED]
 *
 * The line brings noise, records of every kind (right, cut or with wrong contents) and pauses; the chip answers with
 * noise, or looks like a DW1000 that has just received, sent, failed or forgotten something; the interrupt line and the
 * clock do what they like. Checked besides the sanitizers: every line that the board writes is a record with a right
 * check, numbers follow one another, a frame that the chip is made to send is one whose record came with a right FCS, and
 * afterwards a board with a sound chip works.
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "board.h"
#include "dw1000_registers.h"

#define MAX_FRAMES 256u

static uint64_t state = 1u;
static uint64_t line_bytes;
static uint32_t clock_us;
static uint8_t next_number;
static bool has_number;
static bool is_sound;     /* the chip works */
static uint8_t pending[512]; /* what the line brings next */
static uint32_t pending_bytes;
static uint32_t pending_at;
static uint8_t known_frames[MAX_FRAMES][DW1000_MAX_PSDU_BYTES];
static uint32_t known_bytes[MAX_FRAMES];
static uint32_t known_count;
static uint8_t tx_buffer[256];
static uint64_t written;
static uint64_t sent;
static uint64_t heard_kinds[8];
static bool sound_is_configured;

static uint32_t any(uint32_t below)
{
    state ^= state << 13; /* Marsaglia, Xorshift RNGs (2003) */
    state ^= state >> 7;
    state ^= state << 17;
    return (uint32_t)(state >> 32) % below;
}

static void fail(const char *what)
{
    (void)fprintf(stderr, "fuzz: %s after %" PRIu64 " bytes\n", what, line_bytes);
    exit(1);
}

/* The chip */

static void check_sent(uint32_t frame_bytes)
{
    sent++;
    for (uint32_t at = 0u; at < known_count; at++) {
        if ((known_bytes[at] == frame_bytes) && (memcmp(known_frames[at], tx_buffer, frame_bytes - 2u) == 0)) {
            return;
        }
    }
    fail("a frame is sent that nobody asked for");
}

static void answer(uint32_t file, uint8_t *data, uint32_t size)
{
    if (is_sound || (any(8u) != 0u)) {
        (void)memset(data, 0, size);
        if ((file == 0x00u) && (size >= 4u)) {
            data[0] = 0x30u, data[1] = 0x01u, data[2] = 0xCAu, data[3] = 0xDEu;
        } else if ((file == 0x1Fu) && (size >= 4u)) {
            if (is_sound ? sound_is_configured : (any(100u) != 0u)) {
                data[0] = 0x55u, data[2] = 0x48u, data[3] = 0x4Au;
            }
        } else if (file == 0x0Fu) {
            data[0] = 0x02u;
            if (!is_sound && (any(3u) == 0u)) {
                for (uint32_t at = 0u; at < size; at++) {
                    data[at] |= (uint8_t)any(256u);
                }
            } else if (!is_sound && (any(2u) == 0u)) {
                data[1] = 0x6Fu;
            } else if (!is_sound && (any(2u) == 0u)) {
                data[0] = 0xF2u;
            } else {
                /* nothing has happened */
            }
        } else if (!is_sound && ((file == 0x10u) || (any(2u) == 0u))) {
            for (uint32_t at = 0u; at < size; at++) {
                data[at] = (uint8_t)any(256u);
            }
        } else {
            /* zeros */
        }
        return;
    }
    for (uint32_t at = 0u; at < size; at++) {
        data[at] = (uint8_t)any(256u);
    }
}

static void transfer(const uint8_t *out, uint8_t *into, uint32_t size)
{
    static uint32_t frame_bytes;
    uint32_t head = ((out[0] & 0x40u) == 0u) ? 1u : (((out[1] & 0x80u) == 0u) ? 2u : 3u);
    uint32_t file = out[0] & 0x3Fu;

    if ((size < 2u) || (size > DW1000_MAX_TRANSFER_BYTES) || (head >= size)) {
        fail("a transaction of a wrong length");
    }
    (void)memset(into, 0xFF, head);
    if ((out[0] & 0x80u) == 0u) {
        answer(file, &into[head], size - head);
        return;
    }
    if (file == 0x09u) {
        (void)memcpy(tx_buffer, &out[head], size - head);
    } else if ((file == 0x08u) && (head == 1u)) {
        frame_bytes = out[head] & 0x7Fu;
    } else if (file == 0x1Fu) {
        sound_is_configured = true;
    } else if ((file == 0x0Du) && (out[head] == TXSTRT_TXDLYS)) {
        check_sent(frame_bytes);
    } else {
        /* nothing to check */
    }
}

static void set_spi_fast(bool fast)
{
    (void)fast;
}

static void reset_chip(void)
{
}

static void pause_us(uint32_t microseconds)
{
    clock_us += microseconds;
}

static uint32_t now_us(void)
{
    clock_us += any(4u);
    return clock_us;
}

static bool interrupt_line(void)
{
    return !is_sound && (any(3u) == 0u);
}

/* The line */

static uint32_t put_record(uint8_t *out, const uint8_t *record, uint32_t size)
{
    uint8_t whole[LINK_MAX_RECORD_BYTES + 2u];
    uint32_t crc = link_crc16(record, size);
    uint32_t code_at = 0u;
    uint32_t fill = 1u;

    (void)memcpy(whole, record, size);
    whole[size] = (uint8_t)(crc >> 8);
    whole[size + 1u] = (uint8_t)crc;
    for (uint32_t at = 0u; at < (size + 2u); at++) {
        if (whole[at] == 0u) {
            out[code_at] = (uint8_t)(fill - code_at);
            code_at = fill;
        } else {
            out[fill] = whole[at];
        }
        fill++;
    }
    out[code_at] = (uint8_t)(fill - code_at);
    out[fill] = 0u;
    return fill + 1u;
}

static void know(const uint8_t *frame, uint32_t size)
{
    uint32_t at = known_count % MAX_FRAMES;

    if (known_count >= MAX_FRAMES) {
        at = any(MAX_FRAMES / 2u); /* a younger one may wait to be sent */
        (void)memmove(&known_frames[at], &known_frames[at + 1u], sizeof known_frames[0] * (MAX_FRAMES - 1u - at));
        (void)memmove(&known_bytes[at], &known_bytes[at + 1u], sizeof known_bytes[0] * (MAX_FRAMES - 1u - at));
        at = MAX_FRAMES - 1u;
    } else {
        known_count++;
    }
    (void)memcpy(known_frames[at], frame, size);
    known_bytes[at] = size;
}

/* What the host sends next. */
static void refill(bool is_calm)
{
    static const uint8_t KINDS[7] = {LINK_ASK_HELLO, LINK_CONFIG, LINK_TX_AT, LINK_RX_ON, LINK_ASK_STATUS, LINK_TX_AT, 0x77u};
    static uint8_t number;
    uint8_t record[LINK_MAX_RECORD_BYTES];
    uint32_t size = any(140u) + 2u;
    uint32_t kind = KINDS[any(7u)];

    pending_at = 0u;
    if (!is_calm && (any(4u) == 0u)) {
        pending_bytes = any(sizeof pending) + 1u;
        for (uint32_t at = 0u; at < pending_bytes; at++) {
            pending[at] = (uint8_t)((any(6u) == 0u) ? 0u : any(256u));
        }
        return;
    }
    for (uint32_t at = 0u; at < sizeof record; at++) {
        record[at] = (uint8_t)any(256u);
    }
    record[0] = (uint8_t)kind;
    record[1] = number;
    number++;
    if ((kind == LINK_CONFIG) && (any(4u) != 0u)) {
        const uint8_t usual[6] = {5u, 64u, 2u, 9u, 128u, 0u};

        (void)memcpy(&record[2], usual, sizeof usual);
        size = LINK_CONFIG_BYTES;
    } else if ((kind == LINK_TX_AT) && (any(4u) != 0u)) {
        uint32_t frame_bytes = any(125u) + 3u;
        uint8_t *frame = &record[LINK_TX_FRAME_AT];
        uint32_t fcs = link_fcs(frame, frame_bytes - 2u);

        (void)memset(&record[2], 0, 5u); /* soon */
        record[4] = (uint8_t)any(256u);
        frame[frame_bytes - 2u] = (uint8_t)fcs;
        frame[frame_bytes - 1u] = (uint8_t)(fcs >> 8);
        size = LINK_TX_FRAME_AT + frame_bytes;
    } else {
        /* random contents */
    }
    if ((kind == LINK_TX_AT) && (size > (LINK_TX_FRAME_AT + 2u)) &&
        (link_fcs(&record[LINK_TX_FRAME_AT], size - LINK_TX_FRAME_AT) == 0u)) {
        know(&record[LINK_TX_FRAME_AT], size - LINK_TX_FRAME_AT); /* now and then of random contents, too */
    }
    pending_bytes = put_record(pending, record, size);
    if (!is_calm && (any(8u) == 0u)) {
        pending[any(pending_bytes)] ^= (uint8_t)(1u << any(8u)); /* one bit is wrong */
    }
    if (!is_calm && (any(16u) == 0u)) {
        pending_bytes = any(pending_bytes) + 1u; /* cut */
    }
}

static uint32_t read_line(uint8_t *into, uint32_t size)
{
    uint32_t count;

    if (pending_at == pending_bytes) {
        return 0u;
    }
    count = any(size) + 1u;
    if (count > (pending_bytes - pending_at)) {
        count = pending_bytes - pending_at;
    }
    (void)memcpy(into, &pending[pending_at], count);
    pending_at += count;
    line_bytes += count;
    return count;
}

static bool write_line(const uint8_t *line, uint32_t size)
{
    static struct link_reader reader;
    uint32_t used;

    written += size;
    if ((size == 1u) && (line[0] == 0u)) {
        return true;
    }
    used = link_read(&reader, line, size);
    if ((used != size) || (reader.length < 2u) || (reader.garbled != 0u) || (reader.overlong != 0u)) {
        fail("the board wrote a line that is no record");
    }
    if (has_number && (reader.record[1] != next_number)) {
        fail("the board's numbers do not follow one another");
    }
    if ((reader.record[0] < LINK_HELLO) || (reader.record[0] > LINK_RX_PHASE)) {
        fail("the board wrote a record of an unknown kind");
    }
    heard_kinds[reader.record[0]]++;
    has_number = true;
    next_number = (uint8_t)(reader.record[1] + 1u);
    return any(50u) != 0u;
}

static void restart_line(void)
{
    pending_at = pending_bytes;
}

static void show(uint32_t lights)
{
    (void)lights;
}

int main(int count, char **words)
{
    static struct board board;
    const struct hardware hardware = {transfer,  set_spi_fast, reset_chip, pause_us,     now_us,
                                      interrupt_line, read_line, write_line, restart_line, show};
    const struct board_identity identity = {true, {1u, 2u, 3u, 4u, 5u, 6u, 7u, 8u}, 0u};
    uint64_t bytes = (count > 1) ? strtoull(words[1], NULL, 10) : 0u;

    if (bytes == 0u) {
        (void)fprintf(stderr, "fuzz: say how many bytes, as: build/fuzz 10000000 [SEED]\n");
        return 2;
    }
    state = (count > 2) ? (strtoull(words[2], NULL, 10) * 2654435761u) + 1u : 1u;
    board_init(&board, &hardware, &identity);
    board_begin(&board);
    while (line_bytes < bytes) {
        if ((pending_at == pending_bytes) && (any(3u) == 0u)) {
            refill(false);
        }
        clock_us += any(20u) == 0u ? any(100000u) : any(300u);
        (void)board_turn(&board);
    }

    /* A sound chip and a calm host again. */
    bool receives = false;

    is_sound = true;
    sound_is_configured = false;
    for (uint32_t turn = 0u; turn < 100000u; turn++) {
        if (pending_at == pending_bytes) {
            refill(true);
        }
        clock_us += any(300u);
        (void)board_turn(&board);
        receives = receives || (board.is_configured && board.is_receiving && (turn > 50000u));
    }
    if (!receives) {
        fail("the board does not work again");
    }
    (void)printf("%" PRIu64 " bytes in, %" PRIu64 " out; %" PRIu64 " frames to the chip; records:", line_bytes, written, sent);
    for (uint32_t kind = LINK_HELLO; kind <= LINK_RX_PHASE; kind++) {
        (void)printf(" %" PRIu64, heard_kinds[kind]);
        if (heard_kinds[kind] == 0u) {
            fail("a kind of record never came");
        }
    }
    (void)printf("\n");
    return 0;
}
