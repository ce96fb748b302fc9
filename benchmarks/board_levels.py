"""Whether the board's protection levels hold while one anchor is wrong: the study ``integrity`` with its library.

    python benchmarks/board_levels.py [--episodes 34] [--seed 1001] [--computer]

34 episodes of each of 54 faults are a million epochs. ``--computer`` uses a computer's library instead. An epoch that
misleads has a level, and an error beyond it. Nothing of this has run on a board.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from skyless.core.native.records import PACKED
from skyless.research.studies import integrity
from skyless.research.studies.common.plan import plan_of

WITH_BOARD_SIZES = Path(__file__).parents[1] / "tests" / "firmware" / "with_board_sizes.py"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=34)
    parser.add_argument("--seed", type=int, default=1001)
    parser.add_argument("--computer", action="store_true")
    asked = parser.parse_args()
    if not PACKED and not asked.computer:
        sys.exit(subprocess.call([sys.executable, WITH_BOARD_SIZES, "float", __file__, *sys.argv[1:]]))
    plan = plan_of("joint", asked.seed, study="integrity", episodes=asked.episodes)
    rows = integrity.rows(plan, [cell.function() for cell in integrity.cells(plan)])
    print("| fault | epochs | with a level | median | RMSE | misleading | 99 % | vertically | 99 % |")
    print("|---|" + "--:|" * 8)
    for row in (row for row in rows if row.hmi or row.hmi_vertical or row is rows[-1] or "clean" in row.case):
        vertical = "| |" if row.hmi_vertical is None else f"{share(row.hmi_vertical, row.hmi_vertical_interval)} |"
        print(
            f"| {row.case} | {row.fixes:,} | {100.0 * row.available:.1f} % | {100.0 * row.hpl_m:.0f} cm "
            f"| {100.0 * row.rmse_m:.1f} cm | {share(row.hmi, row.hmi_interval)} | {vertical}"
        )


def share(found, interval):
    """Of epochs, and where it truly lies."""
    return f"{found:.1e} | {interval[0]:.0e} to {interval[1]:.0e}"


if __name__ == "__main__":
    main()
