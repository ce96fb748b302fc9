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
 * asked to write text; numbers follow one another; a frame that the chip is made to send is one whose record came with a
 * right FCS; a fix holds numbers, and follows beacons; and afterwards a board with a sound chip works.
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "board.h"
#include "dw1000_registers.h"
#include "outputs.h"

#define HASHES (1u << 24)
#define MAX_FRAMES 100000u
#define RECEPTION (RXFCG | LDEDONE | 0x2B00u) /* with what the chip shows on the way to it */

/* A frame as the file has it. */
struct heard {
    int32_t length;
    uint8_t bytes[140];
    int64_t rx_ticks;
};

static struct board board;
static uint64_t state = 1u;
static uint32_t clock_us;
static enum { NOISE_TURN, TAG_TURN, SOUND_TURN } stage; /* SOUND_TURN: a chip that works, and a calm host */

/* Counts */
static uint64_t line_bytes; /* and those of frames */
static uint64_t written;
static uint64_t sent;
static uint64_t heard_kinds[LINK_TEST + 1u];
static uint64_t text_lines;

/* The line: what it brings next, and hashes of the frames that it has brought to be sent */
static uint8_t pending[512];
static uint32_t pending_bytes;
static uint32_t pending_at;
static bool is_known[HASHES];

/* The chip */
static uint8_t tx_buffer[256];
static uint8_t flash[KEPT_BYTES];
static struct heard frames[MAX_FRAMES]; /* all of the file */
static size_t frame_count;
static size_t next_frame;
static uint64_t begin_ticks; /* when the chip's counter was last 0, */
static uint64_t now_ticks;   /* and the present time, by the file's stamps */
static struct heard received;
static bool has_received;

static uint32_t any(uint32_t below)
{
    state ^= state << 13; /* Marsaglia, Xorshift RNGs (2003) */
    state ^= state >> 7;
    state ^= state << 17;
    return (uint32_t)(state >> 32) % below;
}

static bool one_in(uint32_t count)
{
    return any(count) == 0u;
}

static void fill(void *data, size_t size)
{
    for (size_t at = 0u; at < size; at++) {
        ((uint8_t *)data)[at] = (uint8_t)any(256u);
    }
}

static void fail(const char *what)
{
    (void)fprintf(stderr, "fuzz: %s after %" PRIu64 " bytes\n", what, line_bytes);
    exit(1);
}

static void put_fcs(uint8_t *frame, uint32_t size)
{
    uint32_t fcs = link_fcs(frame, size - 2u);

    frame[size - 2u] = (uint8_t)fcs;
    frame[size - 1u] = (uint8_t)(fcs >> 8);
}

/* The chip */

/* Of a frame without its FCS, which the chip makes: FNV-1a. */
static uint32_t hash(const uint8_t *frame, uint32_t size)
{
    uint32_t value = 2166136261u ^ size;

    for (uint32_t at = 0u; at < (size - 2u); at++) {
        value = (value ^ frame[at]) * 16777619u;
    }
    return (value ^ (value >> 24)) % HASHES;
}

/* Put the next frame of the file into the chip, as a rule as it is; the time is that of the frame. */
static void let_frame_come(void)
{
    uint64_t before_ticks = now_ticks;

    received = frames[next_frame];
    now_ticks = (uint64_t)received.rx_ticks;
    clock_us += (now_ticks > before_ticks) ? (uint32_t)((now_ticks - before_ticks) / 63898u) : 0u;
    received.rx_ticks -= (int64_t)begin_ticks;
    next_frame += one_in(20u) ? any(4u) : 1u;
    next_frame = (next_frame < frame_count) ? next_frame : 0u;
    has_received = true;
    line_bytes += (uint64_t)received.length;
    if (one_in(50u)) {
        received.rx_ticks ^= (int64_t)1 << any(41u);
    } else if (one_in(50u)) {
        received.length = (int32_t)any(128u);
    } else if (one_in(16u)) {
        fill(&received.bytes[any(one_in(2u) ? 40u : 127u)], any(4u) + 1u);
    }
    if (!one_in(8u) && (received.length >= 2)) {
        put_fcs(received.bytes, (uint32_t)received.length);
    }
}

static uint64_t status(void)
{
    const uint64_t events[4] = {0u, RECEPTION, TXFRS | 0x70u, ((uint64_t)any(256u) << 32) | any(UINT32_MAX)};

    if (stage == TAG_TURN) {
        return CPLOCK | (has_received ? RECEPTION : (one_in(3u) ? RXRFTO : 0u));
    }
    return CPLOCK | events[(stage == SOUND_TURN) ? 0u : any(4u)];
}

static void answer(uint32_t file, uint8_t *data, uint32_t size)
{
    bool is_tag_s_turn = stage == TAG_TURN;
    bool is_noise = (stage != SOUND_TURN) && one_in(is_tag_s_turn ? 4096u : 8u);
    uint8_t found[DW1000_MAX_TRANSFER_BYTES] = {0u};
    uint64_t word = 0u;

    switch (file) {
    case 0x00u:
        word = DEVICE_ID;
        break;
    case 0x06u:
        word = is_tag_s_turn ? (now_ticks - begin_ticks) : 0u;
        break;
    case 0x0Fu:
        word = status();
        break;
    case 0x10u:
        word = is_tag_s_turn ? ((uint32_t)received.length | (any(16u) << 24)) : any(128u);
        break;
    case 0x15u:
        word = (uint64_t)received.rx_ticks;
        break;
    case 0x1Fu:
        word = ((stage == SOUND_TURN) || !one_in(50u)) ? CHAN_CTRL : 0u;
        break;
    default:
        is_noise = is_noise || (file == 0x25u) || (is_tag_s_turn && ((file == 0x12u) || (file == 0x27u)));
        break;
    }
    (void)memcpy(found, &word, sizeof word);
    if (file == 0x11u) {
        (void)memcpy(found, received.bytes, sizeof found);
    }
    if (is_noise) {
        fill(found, sizeof found);
    }
    (void)memcpy(data, found, size);
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
    } else if (file == 0x09u) {
        (void)memcpy(tx_buffer, &out[head], size - head);
    } else if (file == 0x0Fu) {
        has_received = false;
    } else if ((file == 0x08u) && (head == 1u)) {
        frame_bytes = out[head] & 0x7Fu;
    } else if ((file == 0x0Du) && (out[head] == TXSTRT_TXDLYS)) {
        sent++;
        if (!is_known[hash(tx_buffer, frame_bytes)]) {
            fail("a frame is sent that nobody asked for");
        }
    }
}

static void set_word(uint32_t word)
{
    (void)word;
}

static void set_spi_fast(bool fast)
{
    (void)fast;
}

static void do_nothing(void)
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
    return ((stage == TAG_TURN) && has_received) || ((stage != SOUND_TURN) && one_in(3u));
}

/* The line to the board */

/* Any that a tag can have, as a rule. */
static void choose_settings(struct settings *settings)
{
    static const uint32_t SLEEPS_MS[6] = {0u, 0u, 0u, 0u, 100u, 1000u};
    uint32_t word = any((uint32_t)sizeof *settings / 4u) * 4u;

    *settings = SETTINGS_DEFAULT;
    settings->mode = one_in(8u) ? MODE_RADIO : MODE_TAG;
    settings->output = any(2u) * (any(3u) + 1u);
    settings->rate_hz = any(2u) * any(51u);
    settings->bluetooth_ms = any(2u) * 100u;
    settings->predicts = any(2u);
    settings->sleep_ms = SLEEPS_MS[any(6u)];
    settings->has_bounds = any(2u);
    settings->low_mm = -1000;
    settings->high_mm = 2000;
    fill((uint8_t *)settings + word, any(3u) * any(3u)); /* one word is any */
}

static bool bring(const uint8_t *line, uint32_t size)
{
    (void)memcpy(pending, line, size);
    pending_bytes = size;
    return true;
}

/* What the host sends next. */
static void refill(void)
{
    static const uint8_t KINDS[12] = {LINK_ASK_HELLO,      LINK_CONFIG,         LINK_TX_AT,    LINK_TX_AT,
                                      LINK_RX_ON,          LINK_ASK_STATUS,     LINK_READ,     LINK_TEST_LINE,
                                      LINK_SET_TAG_CONFIG, LINK_ASK_TAG_CONFIG, LINK_SET_TIME, 0x77u};
    static const uint8_t USUAL[6] = {5u, 64u, 2u, 9u, 128u, 0u};
    static struct link_writer host = {.write_line = bring};
    struct settings settings;
    uint8_t body[160]; /* a record without kind and number */
    uint8_t *frame = &body[LINK_STAMP_BYTES];
    uint32_t size = any(140u);
    uint32_t kind = KINDS[any(12u)];
    bool is_right = !one_in(4u);

    if ((stage == TAG_TURN) && ((kind == LINK_CONFIG) || (kind == LINK_SET_TAG_CONFIG)) && !one_in(50u)) {
        kind = LINK_ASK_HELLO;
    }
    pending_at = 0u;
    if ((stage != SOUND_TURN) && one_in(4u)) {
        pending_bytes = any(sizeof pending) + 1u;
        for (uint32_t at = 0u; at < pending_bytes; at++) {
            pending[at] = (uint8_t)(one_in(6u) ? 0u : any(256u));
        }
        return;
    }
    fill(body, sizeof body);
    if (is_right && (kind == LINK_CONFIG)) {
        (void)memcpy(body, USUAL, sizeof USUAL);
        size = LINK_CONFIG_BYTES - LINK_BODY_AT;
    } else if (is_right && (kind == LINK_TX_AT)) {
        uint32_t frame_bytes = any(125u) + 3u;

        put_fcs(frame, frame_bytes);
        (void)memset(body, 0, LINK_STAMP_BYTES); /* soon */
        body[2] = (uint8_t)any(256u);
        size = LINK_STAMP_BYTES + frame_bytes;
    } else if (is_right && (kind == LINK_READ)) {
        size = LINK_READ_DATA_AT - LINK_BODY_AT;
        body[3] = (uint8_t)(any(LINK_READ_BYTES) + 1u);
        body[5] = 0u; /* of two bytes of times: at most 255 */
    } else if (is_right && (kind == LINK_SET_TAG_CONFIG)) {
        choose_settings(&settings);
        settings_pack(&settings, &body[LINK_SETTINGS_AT - LINK_BODY_AT]);
        size = LINK_SETTINGS_AT - LINK_BODY_AT + SETTINGS_BYTES;
    }
    if ((kind == LINK_TX_AT) && (size > (LINK_STAMP_BYTES + 2u)) && (link_fcs(frame, size - LINK_STAMP_BYTES) == 0u)) {
        is_known[hash(frame, size - LINK_STAMP_BYTES)] = true; /* now and then of random contents, too */
    }
    link_begin(&host, kind);
    link_append_bytes(&host, body, size);
    link_send(&host);
    if ((stage != SOUND_TURN) && one_in(8u)) {
        pending[any(pending_bytes)] ^= (uint8_t)(1u << any(8u)); /* one bit is wrong */
    }
    if ((stage != SOUND_TURN) && one_in(16u)) {
        pending_bytes = any(pending_bytes) + 1u; /* cut */
    }
}

static uint32_t read_line(uint8_t *into, uint32_t size)
{
    uint32_t left = pending_bytes - pending_at;
    uint32_t count = any(size) + 1u;

    count = (count < left) ? count : left;
    (void)memcpy(into, &pending[pending_at], count);
    pending_at += count;
    line_bytes += count;
    return count;
}

static void restart_line(void)
{
    pending_at = pending_bytes;
}

/* The line from the board */

static void check_fix(const uint8_t *record, uint32_t size)
{
    float values[16]; /* from the covariance to the levels */

    if ((size < FIX_SENT_BYTES) || (frame_count == 0u) || (board.tag.status.heard < 3u)) {
        fail("a fix from nothing");
    }
    (void)memcpy(values, &record[offsetof(struct fix, covariance_m2)], sizeof values);
    for (uint32_t at = 0u; at < 16u; at++) {
        if (!(values[at] * 0.0f >= 0.0f)) {
            fail("a fix holds what is no number");
        }
    }
}

/* A line of text ends as such, and has nothing but characters that are seen. */
static void check_text(const uint8_t *line, uint32_t size)
{
    text_lines++;
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
}

static void check_record(const uint8_t *line, uint32_t size)
{
    static struct link_reader reader;
    static uint8_t number;

    if ((link_read(&reader, line, size) != size) || (reader.length < 2u) || (reader.garbled != 0u)) {
        fail("the board wrote a line that is no record");
    }
    if ((reader.record[0] == LINK_HELLO) && (reader.record[1] == 0u)) {
        number = 0u; /* a board that has started */
    }
    if (reader.record[1] != number) {
        fail("the board's numbers do not follow one another");
    }
    if ((reader.record[0] < LINK_HELLO) || (reader.record[0] > LINK_TEST)) {
        fail("the board wrote a record of an unknown kind");
    }
    if (reader.record[0] == LINK_FIX) {
        check_fix(&reader.record[LINK_BODY_AT], reader.length - LINK_BODY_AT);
    }
    heard_kinds[reader.record[0]]++;
    number++;
}

static bool write_line(const uint8_t *line, uint32_t size)
{
    written += size;
    if (line[size - 1u] != 0u) {
        check_text(line, size);
    } else if (size > 1u) {
        check_record(line, size);
    }
    return !one_in(50u);
}

/* What a tag needs besides */

/* The chip's counter begins again, and frames are missed. */
static void sleep_for(uint32_t milliseconds)
{
    clock_us += 1000u * milliseconds;
    now_ticks += 63897600u * (uint64_t)milliseconds;
    while ((next_frame + 1u < frame_count) && ((uint64_t)frames[next_frame].rx_ticks < now_ticks)) {
        next_frame++;
    }
    begin_ticks = now_ticks;
}

static void read_settings(uint8_t *into)
{
    (void)memcpy(into, flash, KEPT_BYTES);
}

static void write_settings(const uint8_t *from)
{
    (void)memcpy(flash, from, KEPT_BYTES);
    if (one_in(16u)) {
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

    fill(&fix, sizeof fix);
    fix.reason = any(3u) * any(6u) * any(2u) % 10u;
    fix.levels = any(4u);
    fix.anchor_count = any(FIX_MAX_ANCHORS + 1u);
    fix.has_origin = one_in(2u);
    fix.position_mm[2] /= 2; /* a sum with the origin's height fits */
    fix.origin.height_mm /= 2;
    (void)json_write(&fix, data);
    if (nmea_write(&fix, data) == OUTPUT_MAX_BYTES) {
        fail("sentences of a fix are too long");
    }
    advertisement_write(&fix, any(1000000u), (uint8_t *)data);
}

/* Read all frames of a file. */
static void read_frames(const char *path)
{
    FILE *file = fopen(path, "rb");

    frame_count = (file == NULL) ? 0u : fread(frames, sizeof *frames, MAX_FRAMES, file);
    if (frame_count == 0u) {
        (void)fprintf(stderr, "fuzz: %s has no frames; tests/firmware/test_fuzz.py makes a file that has\n", path);
        exit(2);
    }
    (void)fclose(file);
}

static uint32_t probe(enum probe item)
{
    return (uint32_t)item;
}

/* The supply fails, and the board starts with what its flash holds. */
static void restart(void)
{
    static const struct hardware HARDWARE = {transfer,       set_spi_fast, do_nothing, pause_us,     now_us,
                                             interrupt_line, read_line,    write_line, restart_line, set_word, set_word,
                                             sleep_for,      read_settings, write_settings, probe,
                                             advertise};
    const struct board_identity identity = {true, {1u, 2u, 3u, 4u, 5u, 6u, 7u, 8u}, 0u};

    begin_ticks = now_ticks;
    board_init(&board, &HARDWARE, &identity);
    board_begin(&board);
}

/* From a host's radio to a tag by itself, or back. */
static void change_turns(void)
{
    struct settings settings;

    stage = (stage == NOISE_TURN) ? TAG_TURN : NOISE_TURN;
    if (stage == TAG_TURN) {
        choose_settings(&settings);
        settings_pack(&settings, flash);
    }
    if ((stage == TAG_TURN) || !one_in(4u)) {
        restart();
    }
}

static void fuzz(uint64_t bytes)
{
    while (line_bytes < bytes) {
        bool is_tag_s_turn = stage == TAG_TURN;
        bool is_on_air = is_tag_s_turn && (frame_count > 0u);

        if (one_in(is_tag_s_turn ? 4000u : 1000u)) {
            change_turns();
        }
        if ((pending_at == pending_bytes) && one_in(is_tag_s_turn ? 200u : 3u)) {
            refill();
        }
        if (is_on_air && !has_received && one_in(3u)) {
            let_frame_come();
        }
        clock_us += one_in(is_on_air ? 2000u : 20u) ? any(100000u) : any(is_on_air ? 5u : 300u);
        (void)board_turn(&board);
        if (!settings_check(&board.settings)) {
            fail("the board has settings that are not right");
        }
        if (one_in(16u)) {
            write_any_fix();
        }
    }
}

/* A sound chip and a calm host again. */
static void calm_down(void)
{
    bool receives = false;

    stage = SOUND_TURN;
    for (uint32_t turn = 0u; turn < 100000u; turn++) {
        if (pending_at == pending_bytes) {
            refill();
        }
        clock_us += any(300u);
        (void)board_turn(&board);
        receives = receives || (board.is_configured && board.is_receiving && (turn > 50000u));
    }
    if (!receives) {
        fail("the board does not work again");
    }
}

int main(int count, char **words)
{
    uint64_t bytes = (count > 1) ? strtoull(words[1], NULL, 10) : 0u;

    if (bytes == 0u) {
        (void)fprintf(stderr, "fuzz: say how many bytes, as: build/fuzz 10000000 [SEED [FRAMES]]\n");
        return 2;
    }
    state = (count > 2) ? (strtoull(words[2], NULL, 10) * 2654435761u) + 1u : 1u;
    if (count > 3) {
        read_frames(words[3]);
    }
    restart();
    fuzz(bytes);
    bytes = line_bytes;
    calm_down();
    (void)printf("%" PRIu64 " bytes in, %" PRIu64 " out; %" PRIu64 " frames to the chip; records:", bytes, written, sent);
    for (uint32_t kind = LINK_HELLO; kind <= LINK_TEST; kind++) {
        bool is_of_a_fix = (kind == LINK_FIX) || (kind == LINK_ANCHOR_PLACE) || (kind == LINK_GEOREFERENCE);

        (void)printf(" %" PRIu64, heard_kinds[kind]);
        if ((heard_kinds[kind] == 0u) && ((frame_count > 0u) || !is_of_a_fix)) {
            fail("a kind of record never came");
        }
    }
    (void)printf("; %" PRIu64 " lines of text\n", text_lines);
    return 0;
}
