/* Gives packets to the estimator, some of them damaged: damaged COUNT SEED < input (as RUNNER in core_build.py reads).
 *
 * Bits of stamps, sequence numbers, identifiers, reports and of the packed relays are flipped. After each packet that was
 * accepted the fix has to be finite. Every few thousand packets the state is what it was at the beginning, as the method
 * around the estimator begins again when it is lost. Prints how many were damaged, accepted, and not finite. */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "skyless_core.h"

static uint64_t state_of_draw;

static uint64_t draw(void) { /* xorshift64*, Vigna 2016 */
    state_of_draw ^= state_of_draw >> 12;
    state_of_draw ^= state_of_draw << 25;
    state_of_draw ^= state_of_draw >> 27;
    return state_of_draw * UINT64_C(2685821657736338717);
}

static void *read_bytes(size_t size) {
    char *bytes = calloc(1, size ? size : 1);
    if (fread(bytes, 1, size, stdin) != size) exit(2);
    return bytes;
}

static int64_t flipped(int64_t value, int bits) {
    return (int64_t)((uint64_t)value ^ (UINT64_C(1) << (draw() % (unsigned)bits)));
}

static int is_finite(const State *s) {
    for (int row = 0; row < 10; row++) {
        for (int axis = 0; axis < 3; axis++) {
            if (!(s->fix[row][axis] - s->fix[row][axis] == 0)) return 0;
        }
    }
    return 1;
}

int main(int count, char **words) {
    if (count != 3) return 2;
    const long total = atol(words[1]);
    state_of_draw = strtoull(words[2], NULL, 10) * 2 + 1;
    int32_t *sizes = read_bytes(4 * sizeof(int32_t));
    State *first = read_bytes(sizeof(State)), *s = malloc(sizeof(State));
    Place *places = read_bytes(sizes[0] * sizeof(Place));
    BatchPacket *packets = read_bytes(sizes[1] * sizeof(BatchPacket));
    Relay *relays = read_bytes(sizes[2] * sizeof(Relay));
    long damaged = 0, accepted = 0, not_finite = 0;
    for (long n = 0; n < total; n++) {
        const int32_t k = (int32_t)(n % sizes[1]);
        if (k == 0) memcpy(s, first, sizeof(State));
        Packet packet = {0};
        Relays taken = {0};
        const BatchPacket *given = &packets[k];
        packet.place = places[given->place];
        packet.sequence = given->sequence;
        packet.rx_ticks = given->rx_ticks;
        packet.tx_ticks = given->tx_ticks;
        packet.variance_factor = 1;
        packet.master = -1;
        const int32_t begin = k ? packets[k - 1].end : 0;
        for (int32_t r = begin; r < given->end && taken.count < MAX_RELAYS; r++) {
            taken.rows[taken.count++] = relays[r];
        }
        uint8_t packed[104];
        int32_t packed_bytes = 0;
        if (draw() % 3 == 0) {
            damaged++;
            switch (draw() % 7) {
                case 0: packet.rx_ticks = flipped(packet.rx_ticks, 60); break;
                case 1: packet.tx_ticks = flipped(packet.tx_ticks, 60); break;
                case 2: packet.sequence = (int32_t)flipped(packet.sequence, 8); break;
                case 3: packet.place.anchor = (int32_t)(draw() % 70000); break;
                case 4: packet.place.position_m[draw() % 3] += (real)(draw() % 2000) - 1000; break;
                case 5:
                    if (taken.count > 0) {
                        Relay *relay = &taken.rows[draw() % (unsigned)taken.count];
                        relay->rx_ticks = flipped(relay->rx_ticks, 60);
                        relay->sequence = (int32_t)flipped(relay->sequence, 8);
                        relay->anchor = (int32_t)(draw() % 10);
                        relay->listener = (int32_t)(draw() % 10);
                    }
                    break;
                default:
                    packet.master = (int32_t)(draw() % 10);
                    packet.subticks = (int64_t)(draw() >> 16);
                    packet.report_variance_m2 = (real)1e-3;
                    packed_bytes = (int32_t)(draw() % 14) * 8;
                    for (int32_t b = 0; b < packed_bytes; b++) packed[b] = (uint8_t)draw();
            }
        }
        const int32_t outcome = skyless_process_frame(s, &packet, &taken, packed, packed_bytes);
        accepted += outcome == ACCEPTED;
        not_finite += !is_finite(s);
    }
    printf("%ld %ld %ld\n", damaged, accepted, not_finite);
    return 0;
}
