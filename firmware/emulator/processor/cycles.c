/* Counts the cycles of blocks of instructions: Unicorn's block hook. cycles.py makes the state and names its columns. */

#include <stdbool.h>
#include <stdint.h>

void (*stop_engine)(void *engine);

/* Adds the cycles of a block that is about to be executed; false, and nothing, if the processor must not execute it. */
static bool charge(int64_t *state, int64_t address, int64_t size) {
    const int64_t refill = address != state[BLOCK_END] ? REFILL_CYCLES : 0;
    int64_t cost = (size >> 1) + refill; /* code in RAM */
    if ((address + size) >> 1 <= state[CODE_HALFWORDS]) {
        cost = state[COSTS + ((address + size) >> 1)] - state[COSTS + (address >> 1)];
        if (cost >= USES_FPU && state[FPU] != FPU_ON) {
            state[FPU] = FPU_REFUSED;
            return false;
        }
        cost = (cost & (USES_FPU - 1)) + refill;
        for (int64_t line = address >> LINE_SHIFT; line <= (address + size - 1) >> LINE_SHIFT; line++) {
            if (state[CACHE_ON]) {
                if (state[TAGS + line % CACHE_LINES] != line) {
                    state[TAGS + line % CACHE_LINES] = line;
                    cost += WAITS_MISSED;
                }
            } else if (state[LAST_LINE] != line) {
                state[LAST_LINE] = line;
                cost += WAITS_UNCACHED;
            }
        }
        state[COSTS + state[CODE_HALFWORDS] + 1 + (address >> 1)] += cost;
    }
    state[BLOCK_END] = address + size;
    state[CYCLES] += cost;
    return true;
}

void on_block(void *engine, uint64_t address, uint32_t size, int64_t *state) {
    if (state[CYCLES] >= state[LIMIT] || !charge(state, (int64_t)address, size)) {
        stop_engine(engine);
    }
}
