/* The portable files against lines and chips that hold anything, with the sanitizers on.
 *
 *   build/fuzz BYTES [SEED [FRAMES]]
 *
 * The line brings noise, records of every kind (right, cut or with wrong contents) and pauses; the chip answers with
 * noise, or looks like a DW1000 that has just received, sent, failed or forgotten something; the interrupt line and the
 * clock do what they like. In between the board is a tag by itself. What it receives then is of the file FRAMES
 * (tests/firmware/test_fuzz.py makes one), now and then damaged, repeated, lost, or with a wrong stamp or power.
 *
 * Checked besides the sanitizers: every line that the board writes is a record with a right check, or text where it was
 * told to write text; numbers follow one another; a frame that the chip is made to send is one whose record came with a
 * right FCS; a fix holds numbers, and follows beacons; and afterwards a board with a sound chip works.
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "board.h"
#include "dw1000_registers.h"
#include "outputs.h"

#define MAX_FRAMES 256u

/* A frame as the file has it. */
struct heard {
    int32_t length;
    uint8_t bytes[140];
    int64_t rx_ticks;
};

static struct board board;
static uint64_t state = 1u;
static uint64_t line_bytes; /* and those of frames */
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
static uint64_t heard_kinds[LINK_TAG_CONFIG + 1u];
static uint64_t text_lines;
static bool sound_is_configured;

/* A tag by itself */
static bool is_tag_s_turn;
static uint8_t flash[KEPT_BYTES];
static bool has_flash;
static struct heard *frames; /* all of the file, */
static size_t frame_count;
static size_t next_frame;
static uint64_t begin_ticks;  /* when the chip's counter was last 0, */
static uint64_t now_ticks;    /* the present time, both by the file's stamps, */
static struct heard received; /* and what the chip holds. */
static bool has_received;

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

/* Put the next frame of the file into the chip, if it is well-tempered as it is; the time is that of the frame. */
static void let_frame_come(void)
{
    uint64_t before_ticks = now_ticks;

    if (next_frame == frame_count) {
        next_frame = 0u;
    }
    received = frames[next_frame];
    now_ticks = (uint64_t)received.rx_ticks;
    clock_us += (now_ticks > before_ticks) ? (uint32_t)((now_ticks - before_ticks) / 63898u) : 0u;
    received.rx_ticks -= (int64_t)begin_ticks;
    next_frame += (any(20u) == 0u) ? any(4u) : 1u;
    next_frame = (next_frame < frame_count) ? next_frame : 0u;
    has_received = true;
    if (any(10u) != 0u) {
        return;
    }
    switch (any(5u)) {
    case 0u:
        received.rx_ticks ^= (int64_t)1 << any(41u);
        break;
    case 1u:
        received.length = (int32_t)any(128u);
        break;
    default:
        for (uint32_t changes = any(4u) + 1u; changes > 0u; changes--) {
            received.bytes[any((any(2u) == 0u) ? 40u : 127u)] = (uint8_t)any(256u);
        }
    }
    if ((any(8u) != 0u) && (received.length >= 2)) {
        uint32_t size = (uint32_t)received.length - 2u;
        uint32_t fcs = link_fcs(received.bytes, size);

        received.bytes[size] = (uint8_t)fcs;
        received.bytes[size + 1u] = (uint8_t)(fcs >> 8);
    }
}

/* What a chip that works says of a frame. */
static bool answer_soundly(uint32_t file, uint8_t *data, uint32_t size)
{
    uint64_t word = (file == 0x06u) ? (now_ticks - begin_ticks) : (uint64_t)received.rx_ticks;

    (void)memset(data, 0, size);
    switch (file) {
    case 0x0Fu: /* what was received, or else that the window has passed */
        data[0] = 0x02u;
        data[1] = has_received ? 0x6Fu : 0u;
        if ((size > 2u) && !has_received && (any(3u) == 0u)) {
            data[2] = 0x02u;
        }
        return true;
    case 0x10u:
        data[0] = (uint8_t)received.length;
        data[3] = (uint8_t)any(16u);
        return true;
    case 0x11u:
        (void)memcpy(data, received.bytes, (size < sizeof received.bytes) ? size : sizeof received.bytes);
        return true;
    case 0x06u:
    case 0x15u:
        (void)memcpy(data, &word, 5u);
        return true;
    case 0x12u:
    case 0x27u:
        for (uint32_t at = 0u; at < size; at++) {
            data[at] = (uint8_t)any(256u);
        }
        return true;
    default:
        return false;
    }
}

static void answer(uint32_t file, uint8_t *data, uint32_t size)
{
    if (is_tag_s_turn && (any(4096u) != 0u) && answer_soundly(file, data, size)) {
        return;
    }
    if (is_sound || (any(8u) != 0u)) {
        (void)memset(data, 0, size);
        if ((file == 0x00u) && (size >= 4u)) {
            data[0] = 0x30u, data[1] = 0x01u, data[2] = 0xCAu, data[3] = 0xDEu;
        } else if ((file == 0x1Fu) && (size >= 4u)) {
            if (is_sound ? sound_is_configured : (is_tag_s_turn || (any(100u) != 0u))) {
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
    } else if (file == 0x0Fu) {
        has_received = false;
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
    return (is_tag_s_turn && has_received) || (!is_sound && (any(3u) == 0u));
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

/* Any that a tag can have, as a rule. */
static void choose_settings(struct settings *settings)
{
    static const uint32_t SLEEPS_MS[6] = {0u, 0u, 0u, 0u, 100u, 1000u};
    uint32_t word = any((uint32_t)sizeof *settings / 4u) * 4u;

    *settings = SETTINGS_DEFAULT;
    settings->mode = (any(8u) == 0u) ? MODE_RADIO : MODE_TAG;
    settings->output = any(2u) * any(4u);
    settings->rate_hz = any(2u) * any(51u);
    settings->bluetooth_ms = any(2u) * 100u;
    settings->predicts = any(2u);
    settings->sleep_ms = SLEEPS_MS[any(6u)];
    settings->has_bounds = any(2u);
    settings->low_mm = -1000;
    settings->high_mm = 2000;
    for (uint32_t at = 0u; at < any(3u) * any(3u); at++) { /* one word is any */
        ((uint8_t *)settings)[word + at] = (uint8_t)any(256u);
    }
}

/* What the host sends next. */
static void refill(bool is_calm)
{
    static const uint8_t KINDS[10] = {LINK_ASK_HELLO,      LINK_CONFIG,         LINK_TX_AT,    LINK_RX_ON, LINK_ASK_STATUS, LINK_TX_AT,
                                      LINK_SET_TAG_CONFIG, LINK_ASK_TAG_CONFIG, LINK_SET_TIME, 0x77u};
    static uint8_t number;
    uint8_t record[LINK_MAX_RECORD_BYTES];
    uint32_t size = any(140u) + 2u;
    uint32_t kind = KINDS[any(10u)];

    if (is_tag_s_turn && ((kind == LINK_CONFIG) || (kind == LINK_SET_TAG_CONFIG)) && (any(50u) != 0u)) {
        kind = LINK_ASK_HELLO;
    }
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
    } else if ((kind == LINK_SET_TAG_CONFIG) && (any(4u) != 0u)) {
        struct settings settings;

        choose_settings(&settings);
        settings_pack(&settings, &record[LINK_SETTINGS_AT]);
        size = LINK_SETTINGS_AT + SETTINGS_BYTES;
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

static void check_fix(const uint8_t *record, uint32_t size)
{
    struct fix fix;
    float sum = 0.0f;

    if ((size < FIX_SENT_BYTES) || (frame_count == 0u) || (board.tag.status.heard < 3u)) {
        fail("a fix from nothing");
    }
    (void)memcpy(&fix, record, FIX_SENT_BYTES);
    for (uint32_t at = 0u; at < 6u; at++) {
        sum += (fix.covariance_m2[at] * 0.0f) + (fix.velocity_covariance[at] * 0.0f);
    }
    sum += (fix.chi2 + fix.mean_square_m2 + fix.hpl_m + fix.vpl_m) * 0.0f;
    if ((sum < 0.0f) || (sum > 0.0f) || (sum != sum) || (fix.anchor_count > FIX_MAX_ANCHORS)) {
        fail("a fix holds what is no number");
    }
}

/* A line of text ends as such, and has nothing but characters that are seen. */
static void check_text(const uint8_t *line, uint32_t size)
{
    if ((board.settings.output != OUTPUT_NMEA) && (board.settings.output != OUTPUT_JSON)) {
        fail("the board wrote text that nobody asked for");
    }
    for (uint32_t at = 0u; at < size; at++) {
        if (((line[at] < 0x20u) && (line[at] != '\r') && (line[at] != '\n')) || (line[at] > 0x7Eu)) {
            fail("the board wrote text that is none");
        }
    }
    if (line[size - 1u] != '\n') {
        fail("the board wrote half a line of text");
    }
    text_lines++;
}

static bool write_line(const uint8_t *line, uint32_t size)
{
    static struct link_reader reader;
    uint32_t used;

    written += size;
    if ((size == 1u) && (line[0] == 0u)) {
        return true;
    }
    if ((line[0] == '$') || (line[0] == '{')) {
        check_text(line, size);
        return any(50u) != 0u;
    }
    used = link_read(&reader, line, size);
    if ((used != size) || (reader.length < 2u) || (reader.garbled != 0u) || (reader.overlong != 0u)) {
        fail("the board wrote a line that is no record");
    }
    if (has_number && (reader.record[1] != next_number)) {
        fail("the board's numbers do not follow one another");
    }
    if ((reader.record[0] < LINK_HELLO) || (reader.record[0] > LINK_TAG_CONFIG)) {
        fail("the board wrote a record of an unknown kind");
    }
    heard_kinds[reader.record[0]]++;
    if (reader.record[0] == LINK_FIX) {
        check_fix(&reader.record[LINK_BODY_AT], reader.length - LINK_BODY_AT);
    }
    has_number = true;
    next_number = (uint8_t)(reader.record[1] + 1u);
    return any(50u) != 0u;
}

static void set_rate(uint32_t baud)
{
    (void)baud;
}

static void restart_line(void)
{
    pending_at = pending_bytes;
}

static void show(uint32_t lights)
{
    (void)lights;
}

/* The chip's counter begins again, and frames are missed. */
static void sleep_for(uint32_t milliseconds)
{
    clock_us += 1000u * milliseconds;
    now_ticks += 63897600u * (uint64_t)milliseconds;
    while ((next_frame < frame_count) && ((uint64_t)frames[next_frame].rx_ticks < now_ticks)) {
        next_frame++;
    }
    begin_ticks = now_ticks;
}

static bool read_settings(uint8_t *into)
{
    (void)memcpy(into, flash, KEPT_BYTES);
    return has_flash;
}

static void write_settings(const uint8_t *from)
{
    (void)memcpy(flash, from, KEPT_BYTES);
    has_flash = true;
    if (any(16u) == 0u) {
        flash[any(KEPT_BYTES)] ^= 1u;
    }
}

static bool advertise(const uint8_t *data, uint32_t size)
{
    (void)data;
    return size <= any(64u);
}

/* A fix that holds anything but for what counts or names something. */
static void write_any_fix(void)
{
    static char data[OUTPUT_MAX_BYTES];
    struct fix fix;

    for (uint32_t at = 0u; at < sizeof fix; at++) {
        ((uint8_t *)&fix)[at] = (uint8_t)any(256u);
    }
    fix.reason = any(3u) * any(6u) * any(2u) % 10u;
    fix.levels = any(4u);
    fix.anchor_count = any(FIX_MAX_ANCHORS + 1u);
    fix.has_origin = any(2u) != 0u;
    fix.position_mm[2] /= 2; /* a sum with the origin's height fits */
    fix.origin.height_mm /= 2;
    (void)json_write(&fix, data);
    if (nmea_write(&fix, data) == OUTPUT_MAX_BYTES) {
        fail("sentences of a fix are too long");
    }
    advertisement_write(&fix, any(1000000u), (uint8_t *)data);
}

static void check_tag(void)
{
    if (!settings_check(&board.settings)) {
        fail("the board has settings that are not right");
    }
    write_any_fix();
}

/* Read all frames of a file. */
static void read_frames(const char *path)
{
    FILE *file = fopen(path, "rb");
    long size = -1;

    if ((file != NULL) && (fseek(file, 0, SEEK_END) == 0)) {
        size = ftell(file);
        rewind(file);
    }
    frame_count = (size > 0) ? ((size_t)size / sizeof *frames) : 0u;
    frames = calloc(frame_count + 1u, sizeof *frames);
    if ((frame_count == 0u) || (fread(frames, sizeof *frames, frame_count, file) != frame_count)) {
        (void)fprintf(stderr, "fuzz: %s has no frames; tests/firmware/test_fuzz.py makes a file that has\n", path);
        exit(2);
    }
    (void)fclose(file);
}

/* The supply fails, and the board starts with what its flash holds. */
static void restart(const struct hardware *hardware, const struct board_identity *identity)
{
    has_number = false;
    begin_ticks = now_ticks;
    board_init(&board, hardware, identity);
    board_begin(&board);
}

int main(int count, char **words)
{
    const struct hardware hardware = {transfer,  set_spi_fast, reset_chip, pause_us,     now_us,
                                      interrupt_line, read_line, write_line, restart_line, set_rate, show,
                                      sleep_for, read_settings, write_settings, advertise};
    const struct board_identity identity = {true, {1u, 2u, 3u, 4u, 5u, 6u, 7u, 8u}, 0u};
    uint64_t bytes = (count > 1) ? strtoull(words[1], NULL, 10) : 0u;

    if (bytes == 0u) {
        (void)fprintf(stderr, "fuzz: say how many bytes, as: build/fuzz 10000000 [SEED [FRAMES]]\n");
        return 2;
    }
    state = (count > 2) ? (strtoull(words[2], NULL, 10) * 2654435761u) + 1u : 1u;
    if (count > 3) {
        read_frames(words[3]);
    }
    restart(&hardware, &identity);
    while (line_bytes < bytes) {
        bool is_on_air = is_tag_s_turn && (frame_count > 0u);

        if (any(is_tag_s_turn ? 20000u : 2000u) == 0u) {
            is_tag_s_turn = !is_tag_s_turn;
            if (is_tag_s_turn) {
                struct settings settings;

                choose_settings(&settings);
                settings_pack(&settings, flash);
                has_flash = true;
            }
            if (any(4u) != 0u) {
                restart(&hardware, &identity);
            }
        }
        if ((pending_at == pending_bytes) && (any(is_tag_s_turn ? 200u : 3u) == 0u)) {
            refill(false);
        }
        if (is_on_air && !has_received && (any(3u) == 0u)) {
            let_frame_come();
            line_bytes += (uint64_t)received.length;
        }
        clock_us += any(is_on_air ? 2000u : 20u) == 0u ? any(100000u) : any(is_on_air ? 5u : 300u);
        (void)board_turn(&board);
        if (any(16u) == 0u) {
            check_tag();
        }
    }

    /* A sound chip and a calm host again. */
    uint64_t fuzzed_bytes = line_bytes;
    bool receives = false;

    is_sound = true;
    is_tag_s_turn = false;
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
    (void)printf("%" PRIu64 " bytes in, %" PRIu64 " out; %" PRIu64 " frames to the chip; records:", fuzzed_bytes, written, sent);
    for (uint32_t kind = LINK_HELLO; kind <= LINK_TAG_CONFIG; kind++) {
        bool is_of_a_fix = (kind == LINK_FIX) || (kind == LINK_ANCHOR_PLACE) || (kind == LINK_GEOREFERENCE);

        (void)printf(" %" PRIu64, heard_kinds[kind]);
        if ((heard_kinds[kind] == 0u) && ((frame_count > 0u) || !is_of_a_fix)) {
            fail("a kind of record never came");
        }
    }
    (void)printf("; %" PRIu64 " lines of text\n", text_lines);
    return 0;
}
