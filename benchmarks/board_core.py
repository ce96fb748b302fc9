"""What the estimator takes on the emulated nRF52832: cycles of a reception, flash, RAM and stack.

    python benchmarks/board_core.py [--superframes 20]

A tag walks in a room whose ranges, survey and slope are estimated; the chip processes each packet with its relays,
faults and levels. Records have the sizes of ``firmware/source/core_sizes.h``, which leave out carrier phases. Cycles
are those of the last three superframes, good to about ±25 % (``firmware/emulator/processor/cycles.py``): mean, most,
and the part that levels have of the mean. Nothing of this has run on a board.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "firmware"))
sys.path.append(str(Path(__file__).parents[1] / "tests" / "firmware"))
sys.path.append(str(Path(__file__).parents[1] / "tests" / "positioning"))

from core_stage import BoardCore
from estimator_builders import LAB_M, MESH, ROOM_M, begun, episode_of, one_by_one, settings_of

from skyless.core.estimator.state import State
from skyless.core.native.records import PACKED

WITH_BOARD_SIZES = Path(__file__).parents[1] / "tests" / "firmware" / "with_board_sizes.py"
ERRORS = {"survey_std_m": 0.02, "range_std_m": 0.03, "slope_std_m": 0.05, "place_std_m": 0.005}
ROWS = [
    *((LAB_M, 0.0, relays) for relays in (5, 4, 3, 2, 0)),
    *((ROOM_M, 0.0, relays) for relays in (7, 3)),
    *((ROOM_M, None, relays) for relays in (7, 3)),
]
"""Anchors, the tag's height, and relays with a packet."""
OF_LEVELS = {"fill_fix", "protect", "fault_chi2", "whiten", "integrity_state"}
MEASURED = 3
"""Superframes."""
MS = 64_000


def measured(anchors_m, height_m, relays, superframes):
    """The image after a run, the state, and cycles by packet; by function their sum."""
    episode = episode_of(MESH, superframes, 1, anchors_m)
    estimator = begun(episode, settings_of(height_m=height_m, **ERRORS), anchors_m, std_m=0.1)
    chip, counts = BoardCore(), []
    chip.put_state(estimator.state)
    first = len(episode.packets.anchors) - MEASURED * len(anchors_m)
    for number, (*stamps, heard) in enumerate(one_by_one(episode.packets)):
        if number == first:
            chip.cycles_by_function()
        counts.append(chip.process(*estimator.packet_of(*stamps, heard[:relays]))[1])
    return chip, chip.state(State), np.array(counts[first:])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--superframes", type=int, default=20)
    asked = parser.parse_args()
    print("| anchors | dimensions | relays | states | cycles, mean | most | ms | of levels |")
    print("|---|---|---|---|---|---|---|---|")
    stack = 0
    for anchors_m, height_m, relays in ROWS:
        chip, state, counts = measured(anchors_m, height_m, relays, asked.superframes)
        by_function = chip.cycles_by_function()
        levels = sum(by_function.get(name, 0) for name in OF_LEVELS) / len(counts)
        figures = (f"{one:,.0f}" for one in (counts.mean(), counts.max()))
        print(f"| {len(anchors_m)} | {state.dim} | {relays} | {state.used} | {' | '.join(figures)} "
              f"| {counts.mean() / MS:.2f} | {levels:,.0f} |", flush=True)  # fmt: skip
        stack = max(stack, chip.stack_bytes)
    size = subprocess.run(["arm-none-eabi-size", chip.elf], capture_output=True, text=True, check=True).stdout
    text, data, bss = map(int, size.splitlines()[1].split()[:3])
    print(f"\nflash {text + data:,} bytes; RAM {data + bss:,}, of which the stack may have 2,048 and has had {stack:,}")


if __name__ == "__main__":
    if PACKED:
        main()
    else:
        sys.exit(subprocess.call([sys.executable, WITH_BOARD_SIZES, "float", __file__, *sys.argv[1:]]))
