"""The emulated FiRa tag's errors, next to what ``skyless plan`` predicts for the site (``tests/support/fira_site.py``).

    python benchmarks/fira_accuracy.py [--worlds 20] [--seeds 3]

``both ways``: two frames of each anchor in a superframe, so that rounds end with a final message and initiator and
responders relay each other. ``one way``: one frame, so that only responders relay the poll. JSON lines: RMSE over all
worlds and points; that of ``skyless plan`` for the same site; what the plan's own arithmetic gives for the messages
and relays of rounds alone; the ratio of the first to each of both. Air and board are emulated.
"""

import argparse
import json
import math
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests"))

from support.fira_site import ROUNDS, UNTIL_S, Measured, measure


def main():
    """Print the table."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--worlds", type=int, default=20)
    asked.add_argument("--seeds", type=int, default=3)
    asked.add_argument("--seconds", type=float, default=UNTIL_S)
    arguments = asked.parse_args()
    for name, frames in ROUNDS.items():
        all_found = []
        for number in range(arguments.seeds):
            all_found.append(measure(frames, arguments.worlds, 1 + 1000 * number, until_s=arguments.seconds))
            show(name, 1 + 1000 * number, all_found[-1])
        show(name, "all", together(all_found))


def together(found):
    """All seeds as one."""
    fixes = sum(one.fixes for one in found)
    rmse_m = math.sqrt(sum(one.fixes * one.rmse_m**2 for one in found) / fixes)
    planned_m, round_planned_m = found[0].planned_m, found[0].round_planned_m
    return Measured(rmse_m, planned_m, round_planned_m, rmse_m / planned_m, rmse_m / round_planned_m, fixes)


def show(name, seed, found):
    print(json.dumps({"rounds": name, "seed": seed, **found._asdict()}), flush=True)


if __name__ == "__main__":
    main()
