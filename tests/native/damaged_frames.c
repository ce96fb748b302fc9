/* Gives frames to a tag, some of them damaged: damaged_frames COUNT SEED < input (test_damaged_packets.py writes it).
 *
 * Bytes are changed, as a rule with the right check sequence afterwards, frames are cut, prolonged, repeated and forged,
 * and stamps, host times and powers are wrong. Each frame lies in memory of its own size. A fix has to be finite, and
 * of a frame whose check sequence is right. After all frames the tag is what it was at the beginning, or has just been
 * switched on, or has slept. Prints how many frames were damaged, made a fix, made a start, and how many fixes were not
 * finite or of a frame with a wrong check sequence. */

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "skyless_core.h"

enum { LONGEST = 140 };

typedef struct {
    int32_t length;
    uint8_t bytes[LONGEST];
    int64_t rx_ticks;
} Heard;

static uint64_t state_of_draw;

static uint64_t draw(void) { /* xorshift64*, Vigna 2016 */
    state_of_draw ^= state_of_draw >> 12;
    state_of_draw ^= state_of_draw << 25;
    state_of_draw ^= state_of_draw >> 27;
    return state_of_draw * UINT64_C(2685821657736338717);
}

static void *read_bytes(size_t size) {
    char *bytes = calloc(1, size);
    if (fread(bytes, 1, size, stdin) != size) exit(2);
    return bytes;
}

static unsigned crc(const uint8_t *bytes, int32_t length) {
    unsigned value = 0;
    for (int32_t at = 0; at < length; at++) {
        value ^= bytes[at];
        for (int bit = 0; bit < 8; bit++) value = value & 1 ? value >> 1 ^ 0x8408 : value >> 1;
    }
    return value;
}

static void damage(Heard *one, double *host_s, double *power_dbm) {
    switch (draw() % 8) {
        case 0: one->rx_ticks ^= INT64_C(1) << (draw() % 63); break;
        case 1: *host_s = (double[]){1e300, -1e300, INFINITY, 0, 1e9}[draw() % 5]; break;
        case 2: *power_dbm = (double[]){NAN, INFINITY, -INFINITY, 1e308, -20}[draw() % 5]; break;
        case 3: one->length = (int32_t)(draw() % LONGEST); break;
        default:
            for (unsigned changes = 1 + draw() % 4; changes > 0; changes--) {
                one->bytes[draw() % (draw() % 2 ? 40 : LONGEST)] = (uint8_t)draw();
            }
    }
    if (draw() % 8 && one->length >= 2) {
        const unsigned value = crc(one->bytes, one->length - 2);
        one->bytes[one->length - 2] = (uint8_t)value;
        one->bytes[one->length - 1] = (uint8_t)(value >> 8);
    }
}

static int is_finite(real rows[10][3]) {
    for (int row = 0; row < 10; row++) {
        for (int axis = 0; axis < 3; axis++) {
            if (!(rows[row][axis] - rows[row][axis] == 0)) return 0;
        }
    }
    return 1;
}

int main(int count, char **words) {
    if (count != 3) return 2;
    const long total = atol(words[1]);
    state_of_draw = strtoull(words[2], NULL, 10) * 2 + 1;
    const int32_t frames = *(int32_t *)read_bytes(sizeof(int32_t));
    const Tag *first = read_bytes(sizeof(Tag));
    const State *first_state = read_bytes(sizeof(State));
    const Heard *heard = read_bytes(frames * sizeof(Heard));
    Tag *t = malloc(sizeof(Tag));
    State *s = malloc(sizeof(State));
    Acquisition *q = malloc(sizeof(Acquisition));
    long damaged = 0, fixes = 0, starts = 0, wrong = 0;
    int32_t next = frames;
    for (long n = 0; n < total; n++) {
        if (next == frames) {
            next = 0;
            memcpy(t, first, sizeof(Tag));
            memcpy(s, first_state, sizeof(State));
            memset(q, 0, sizeof(Acquisition));
            switch (draw() % 3) {
                case 0: skyless_begin_tag(t, NO_SITE, (real)0.3, -INFINITY, INFINITY, 0, (real)1e-4, NAN); break;
                case 1: skyless_wake(t, s, q, heard[0].rx_ticks, (real)(draw() % 100));
            }
        }
        Heard one = heard[next++];
        double host_s = NAN, power_dbm = -80;
        if (draw() % 3 == 0) {
            damaged++;
            damage(&one, &host_s, &power_dbm);
        }
        uint8_t *frame = malloc(one.length ? one.length : 1);
        memcpy(frame, one.bytes, one.length);
        const bool was_starting = t->course.is_starting;
        const int32_t outcome =
            skyless_hear_frame(t, s, q, frame, one.length, one.rx_ticks, (real)host_s, (real)power_dbm, -85,
                               (real)(one.rx_ticks % 997) / 997);
        free(frame);
        if (outcome == FIX || outcome == START_FIX) {
            fixes++;
            starts += was_starting;
            wrong += !is_finite(outcome == FIX ? s->fix : t->course.alone) || crc(one.bytes, one.length) != 0;
        }
    }
    printf("%ld %ld %ld %ld\n", damaged, fixes, starts, wrong);
    return 0;
}
