"""What instructions cost on the nRF52832, counted block by block while Unicorn runs them.

Costs are those of the Cortex-M4 Technical Reference Manual (Arm 100166, "Instruction set summary"), where a range is
given its upper end: 1 for arithmetic and branches, 3 more for a branch that is taken, 2 for a load or store (pairs of
them can be faster on hardware), 1 + n for n registers at once, 12 for a division. An instruction inside an IT block is
charged whether it is executed or not. The floating-point unit, after the same manual ("FPU instruction set"): 1 for
arithmetic, 3 for a product that is accumulated, 14 for a division or root, 2 for a load or store, 1 + n for n registers
at once, and one more where the next instruction needs a result of arithmetic. Memory, after the nRF52832's product
specification (CPU, "Electrical specification"; NVMC, "Cache"): RAM has no wait states. Flash, without the cache: 2 for
each 16-byte line that is not the one fetched last. With the cache: none for a line that it holds, 3 for another one.
Literals, which come over another bus, cost 2 waits with and without the cache. Not known, so assumed: the cache has 2
kB and is mapped directly; loads of constant tables cost no waits; each access to a peripheral costs 3 cycles more
(``PERIPHERAL_WAIT_CYCLES``); the DMA of SPIM and UARTE never delays the processor. Altogether the counts are good to
about ±25 %.
"""

from typing import Final

import numpy as np
from numba import carray, cfunc, njit, types
from numpy.typing import NDArray

from emulator.processor.unicorn_library import stop_engine

CPU_HZ: Final = 64_000_000
PERIPHERAL_WAIT_CYCLES: Final = 3

FLASH_BYTES: Final = 512 * 1024
CACHE_LINES: Final = 128
_LINE_SHIFT: Final = 4
_REFILL_CYCLES: Final = 3
_WAITS_UNCACHED: Final = 2
_WAITS_MISSED: Final = 3
_WAITS_LITERAL: Final = 2
_DIVISION_CYCLES: Final = 12
_REAL_DIVISION_CYCLES: Final = 14
_REAL_ACCUMULATION_CYCLES: Final = 3
_USES_FPU: Final = 1 << 31

CYCLES: Final = 0
LIMIT: Final = 1
"""The processor stops before the first block that would begin at this count or later."""
BLOCK_END: Final = 2
"""Address behind the last block that was executed."""
LAST_LINE: Final = 3
CACHE_ON: Final = 4
BLOCKS: Final = 5
CODE_HALFWORDS: Final = 6
FPU: Final = 7
_TAGS: Final = 8
_COSTS: Final = _TAGS + CACHE_LINES
"""Columns of the counter's state: one int64 each, then the cache's tags; then by halfword costs of blocks, the code,
and the cycles spent in each block.
"""
FPU_OFF, FPU_ON, FPU_REFUSED = range(3)
"""Refused: the processor stops before a block with instructions of the floating-point unit, which is off."""


def make_state(code: bytes) -> NDArray[np.int64]:
    """State of a counter for the code that stands in flash from address 0."""
    halfwords = np.frombuffer(code + bytes(-len(code) % 2), dtype="<u2")
    state = np.zeros(_COSTS + 3 * len(halfwords), dtype=np.int64)
    state[CODE_HALFWORDS] = len(halfwords)
    state[_COSTS + len(halfwords) : _COSTS + 2 * len(halfwords)] = halfwords
    forget_fetched(state)
    return state


def spent_at(state: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cycles spent in the blocks that begin at each halfword; a view, which may be set to 0."""
    return state[_COSTS + 2 * int(state[CODE_HALFWORDS]) :]


def forget_fetched(state: NDArray[np.int64]) -> None:
    """Empty the cache."""
    state[LAST_LINE] = -1
    state[_TAGS : _TAGS + CACHE_LINES] = -1


@njit(inline="always")
def _count_bits(bits):  # noqa: ANN001, ANN202 - Numba infers them
    count = 0
    while bits:
        bits &= bits - 1
        count += 1
    return count


@njit
def cost_16(code):  # noqa: ANN001, ANN201
    """Cycles of a 16-bit instruction, if it is a branch: not taken."""
    if 0x4800 <= code < 0x5000:
        return 2 + _WAITS_LITERAL
    if 0x5000 <= code < 0xA000:
        return 2
    if code & 0xF600 == 0xB400:  # push, pop
        return 1 + _count_bits(code & 0x1FF)
    if 0xC000 <= code < 0xD000:  # stm, ldm
        return 1 + _count_bits(code & 0xFF)
    return 1


@njit
def cost_32(first, second):  # noqa: ANN001, ANN201, PLR0911
    """Cycles of a 32-bit instruction, if it is a branch: not taken."""
    if first & 0xFE40 == 0xE800:  # stm, ldm, push, pop
        return 1 + _count_bits(second)
    if first & 0xFE40 == 0xE840:
        if first & 0xFFF0 == 0xE8D0:  # tbb, tbh, and loads for exclusive access
            return 2
        return 2 if first & 0xFFE0 == 0xE840 else 3  # strd, ldrd
    if first & 0xFE00 == 0xF800:
        return 2 + (_WAITS_LITERAL if first & 0x1F == 0x1F else 0)
    if first & 0xFFF0 == 0xFB00:  # mul; mla and mls
        return 1 if second & 0xF000 == 0xF000 else 2
    if first & 0xFFD0 == 0xFB90 and second & 0xF0 == 0xF0:
        return _DIVISION_CYCLES
    if first & 0xFE00 == 0xEC00:
        return _cost_real_transfer(first, second)
    return _cost_real(first, second) if _is_real_arithmetic(first, second) else 1


@njit
def _cost_real_transfer(first, second):  # noqa: ANN001, ANN202
    """Loads and stores of the floating-point unit, and its registers to and from two of the processor."""
    if first & 0xFFE0 == 0xEC40:
        return 2
    if first & 0xFF20 == 0xED00:  # vldr, vstr
        return 2 + (_WAITS_LITERAL if first & 0x1F == 0x1F else 0)
    return 1 + (second & 0xFF)  # vldm, vstm, vpush, vpop


@njit
def _is_real_arithmetic(first, second):  # noqa: ANN001, ANN202
    return first & 0xFF00 == 0xEE00 and second & 0xF10 == 0xA00


@njit
def _cost_real(first, second):  # noqa: ANN001, ANN202
    operation = first & 0xB0
    if operation == 0x80 or (first & 0xBF == 0xB1 and second & 0xC0 == 0xC0):  # vdiv, vsqrt
        return _REAL_DIVISION_CYCLES
    if operation in (0x00, 0x10, 0x90, 0xA0):  # vmla, vmls, vnmla, vnmls, vfma, vfms, vfnma, vfnms
        return _REAL_ACCUMULATION_CYCLES
    return 1


@njit
def _needs(first, second, result):  # noqa: ANN001, ANN202
    """Whether an instruction reads the single-precision register that the one before it has computed."""
    d = (second >> 11 & 0x1E) | (first >> 6 & 1)
    n = (first << 1 & 0x1E) | (second >> 7 & 1)
    m = (second << 1 & 0x1E) | (second >> 5 & 1)
    if first & 0xFE00 == 0xEC00:  # stores read what they store
        if first & 0xFFE0 == 0xEC40 or first & 0x10:
            return False
        count = 1 if first & 0xFF20 == 0xED00 else second & 0xFF
        return d <= result < d + count
    if first & 0xFF00 != 0xEE00:
        return False
    if second & 0x10:  # vmov to a register of the processor
        return first & 0x10 != 0 and n == result
    operation = first & 0xB0
    if operation == 0xB0:
        is_comparison = first & 0xE == 0x4
        is_constant = second & 0x40 == 0
        return (m == result and not is_constant) or (is_comparison and d == result)
    accumulates = operation in (0x00, 0x10, 0x90, 0xA0)
    return result in (m, n) or (accumulates and d == result)


@njit
def _is_real(first, second):  # noqa: ANN001, ANN202
    """Whether an instruction of 32 bits is one of the floating-point unit (coprocessors 10 and 11)."""
    return first & 0xEC00 == 0xEC00 and second & 0xE00 == 0xA00


@njit
def _cost(state, address, size):  # noqa: ANN001, ANN202
    """Cycles of a block without waits for fetches, its last branch not taken; ``_USES_FPU`` more if it does."""
    code = _COSTS + state[CODE_HALFWORDS]
    at, end, cost, result, uses_fpu = address >> 1, (address + size) >> 1, 0, -1, 0
    while at < end:
        first = state[code + at]
        if first >> 11 >= 0b11101:
            second = state[code + at + 1]
            uses_fpu |= _USES_FPU if _is_real(first, second) else 0
            cost += cost_32(first, second) + (1 if result >= 0 and _needs(first, second, result) else 0)
            is_arithmetic = _is_real_arithmetic(first, second) and first & 0xBE != 0xB4  # comparisons have no result
            result = (second >> 11 & 0x1E) | (first >> 6 & 1) if is_arithmetic else -1
            at += 2
        else:
            cost += cost_16(first)
            at += 1
            result = -1
    return cost | uses_fpu


@njit
def charge(state, address, size):  # noqa: ANN001, ANN201
    """Add the cycles of a block of ``size`` bytes that is about to be executed."""
    refill = _REFILL_CYCLES if address != state[BLOCK_END] else 0
    if (address + size) >> 1 > state[CODE_HALFWORDS]:
        cost = (size >> 1) + refill  # code in RAM
    else:
        entry = state[_COSTS + (address >> 1)]
        if entry >> 32 != size:
            entry = (size << 32) | _cost(state, address, size)
            state[_COSTS + (address >> 1)] = entry
        if entry & _USES_FPU and state[FPU] != FPU_ON:
            state[FPU] = FPU_REFUSED
            return
        cost = (entry & (_USES_FPU - 1)) + refill
        for line in range(address >> _LINE_SHIFT, ((address + size - 1) >> _LINE_SHIFT) + 1):
            if state[CACHE_ON]:
                if state[_TAGS + line % CACHE_LINES] != line:
                    state[_TAGS + line % CACHE_LINES] = line
                    cost += _WAITS_MISSED
            elif state[LAST_LINE] != line:
                state[LAST_LINE] = line
                cost += _WAITS_UNCACHED
        state[_COSTS + 2 * state[CODE_HALFWORDS] + (address >> 1)] += cost
    state[BLOCK_END] = address + size
    state[CYCLES] += cost
    state[BLOCKS] += 1


@cfunc(types.void(types.voidptr, types.uint64, types.uint32, types.voidptr))
def on_block(engine, address, size, data):  # noqa: ANN001, ANN201
    """Unicorn's block hook; a block before which the processor stops is not charged."""
    head = carray(data, (_COSTS,), np.int64)
    if head[CYCLES] >= head[LIMIT]:
        stop_engine(engine)
        return
    state = carray(data, (_COSTS + 3 * head[CODE_HALFWORDS],), np.int64)
    charge(state, np.int64(address), np.int64(size))
    if head[FPU] == FPU_REFUSED:
        stop_engine(engine)
