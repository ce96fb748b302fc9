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

import ctypes
import re
import subprocess
import tempfile
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from emulator.processor.elf import Instruction, instructions_of
from emulator.processor.unicorn_library import stop_engine

CPU_HZ: Final = 64_000_000
PERIPHERAL_WAIT_CYCLES: Final = 3

CACHE_LINES: Final = 128
_LINE_SHIFT: Final = 4
_REFILL_CYCLES: Final = 3
_WAITS_UNCACHED: Final = 2
_WAITS_MISSED: Final = 3
_USES_FPU: Final = 1 << 32
_CYCLES: Final = {r"v(div|sqrt)": 14, r"[us]div": 12, r"(ldr|str)d|v(n?ml|fn?m)[as]": 3, r"ml[as]|tb[bh]": 2}
"""Of instructions by their names; others cost 1, or have registers that count."""
_ARITHMETIC: Final = re.compile(r"v(?!ldr|str|ldm|stm|push|pop|mrs|msr|cmp|mov\w* )\S* s(\d+)")
_NUMBERS: Final = {"sl": 10, "fp": 11, "ip": 12, "sp": 13, "lr": 14, "pc": 15}

CYCLES: Final = 0
LIMIT: Final = 1
"""The processor stops before the first block that would begin at this count or later."""
BLOCK_END: Final = 2
"""Address behind the last block that was executed."""
LAST_LINE: Final = 3
CACHE_ON: Final = 4
CODE_HALFWORDS: Final = 5
FPU: Final = 6
_TAGS: Final = 7
_COSTS: Final = _TAGS + CACHE_LINES
"""Columns of the counter's state: one int64 each, then the cache's tags; then by halfword the costs of all instructions
before it, and behind the code's end the cycles spent in the block that begins there.
"""
FPU_OFF, FPU_ON, FPU_REFUSED = range(3)
"""Refused: the processor stops before a block with instructions of the floating-point unit, which is off."""


def make_state(elf: Path, code_bytes: int) -> NDArray[np.int64]:
    """State of a counter for the code of a file, which stands in flash from address 0."""
    halfwords = (code_bytes + 1) // 2
    state = np.zeros(_COSTS + 2 * halfwords + 1, dtype=np.int64)
    state[CODE_HALFWORDS] = halfwords
    for address, cost in _costs(elf, elf.stat().st_mtime_ns):
        state[_COSTS + (address >> 1) + 1] = cost
    np.cumsum(state[_COSTS : _COSTS + halfwords + 1], out=state[_COSTS : _COSTS + halfwords + 1])
    forget_fetched(state)
    return state


@cache
def _costs(elf: Path, _changed_ns: int) -> list[tuple[int, int]]:
    """Addresses and costs of all instructions of a file; one that another waits for costs a cycle more."""
    pairs = pairwise([*instructions_of(elf), Instruction(0, "", "")])
    return [
        (one.address, cost_of(one) + _has_to_wait(one, behind) + (_USES_FPU if one.name.startswith("v") else 0))
        for one, behind in pairs
    ]


def spent_at(state: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cycles spent in the blocks that begin at each halfword; a view, which may be set to 0."""
    return state[_COSTS + int(state[CODE_HALFWORDS]) + 1 :]


def forget_fetched(state: NDArray[np.int64]) -> None:
    """Empty the cache."""
    state[LAST_LINE] = -1
    state[_TAGS : _TAGS + CACHE_LINES] = -1


def cost_of(one: Instruction) -> int:
    """Cycles of an instruction, if it is a branch: not taken."""
    name, operands = one.name, one.operands
    if re.match(r"v?(ldm|stm|push|pop)", name):
        return 1 + len(_registers(operands[operands.index("{") :]))
    if re.match(r"v?(ldr|str)(?!d)", name):
        return 4 if "[pc" in operands else 2
    if name.startswith("vmov") and len(_registers(operands, "r")) > 1:
        return 2
    return next((cycles for pattern, cycles in _CYCLES.items() if re.match(pattern, name)), 1)


def _registers(text: str, kinds: str = "rsd") -> list[int]:
    """Numbers of the registers of 32 bits in a text, also of those in ranges; of d0 two."""
    text = re.sub(r"\b(sl|fp|ip|sp|lr|pc)\b", lambda found: f"r{_NUMBERS[found[1]]}", text)
    numbers: list[int] = []
    for kind, first, last in re.findall(rf"\b([{kinds}])(\d+)(?:-[{kinds}](\d+))?", text):
        each = 2 if kind == "d" else 1
        numbers += range(each * int(first), each * int(last or first) + each)
    return numbers


def _has_to_wait(one: Instruction, behind: Instruction) -> bool:
    """Whether the instruction behind one of the floating-point unit's arithmetic needs its result."""
    result = _ARITHMETIC.match(f"{one.name} {one.operands}")
    if result is None or not behind.name.startswith("v") or re.match(r"v(ldr|ldm|pop)", behind.name):
        return False
    read = _registers(behind.operands, "sd")
    if re.match(r"s\d", behind.operands) and not re.match(r"v(n?ml|fn?m)[as]|v(cmp|str)", behind.name):
        del read[0]  # it is written
    return int(result[1]) in read


@cache
def block_hook() -> int:
    """Address of Unicorn's block hook (``cycles.c``), compiled at its first use in a process.

    A block before which the processor stops is not charged.
    """
    columns = {name.lstrip("_"): value for name, value in globals().items() if isinstance(value, int)}
    defines = [f"-D{name}={value}" for name, value in columns.items() if name.isupper()]
    source = Path(__file__).with_suffix(".c")
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "cycles.so"
        subprocess.run(["cc", "-O2", "-shared", "-fPIC", *defines, source, "-o", made], check=True)
        hooks = ctypes.CDLL(str(made))
    ctypes.c_void_p.in_dll(hooks, "stop_engine").value = ctypes.cast(stop_engine, ctypes.c_void_p).value
    address = ctypes.cast(hooks.on_block, ctypes.c_void_p).value
    assert address is not None
    return address
