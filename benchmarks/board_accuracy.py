"""The board's estimator against ``joint``: the same receptions of protocol 2, with what both of them ought to reach.

    python benchmarks/board_accuracy.py [--seeds 10] [--first 1001] [--only WORD …] [--into docs/board.md]
    python benchmarks/board_accuracy.py --minutes 10 --seeds 1

With ``--minutes`` tags stay so long, and errors and levels are those of single minutes: they ought not to grow.

The board's is its own library of the core, with the sizes of its records and in single precision, on this computer;
``joint`` has a computer's sizes and double precision. Nothing of this has run on a board.
"""

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from float_core import file_of, fixes_of, key, written
from msgspec.structs import replace

from skyless.research.studies import room
from skyless.research.studies.common.plan import plan_of
from skyless.research.studies.common.worlds import Heard, beacons_of, worlds
from skyless.sim.evaluation.scenarios import Request, Room, trajectories_of, wanderers
from skyless.sim.lab import ideal_lab_site, lab_site

WITH_BOARD_SIZES = Path(__file__).parents[1] / "tests" / "firmware" / "with_board_sizes.py"
MARKS = "<!-- accuracy -->\n", "<!-- end of accuracy -->\n"
FAR_M = 8000.0
DAMAGED = {"1 % of stamps off, by less than 1 s": 36, "1 % of stamps off, by anything": 40}
"""One of how many bits is wrong in those stamps."""
LATE = [f"{count} of 6 late, {span} m" for span in ("0.1–0.4", "0.5–2") for count in (1, 2, 3)]
CRYSTALS = ["tags' crystals +2 ppm", "all anchors' crystals ±0.5–3 ppm", "all anchors' crystals ±0.01–0.03 ppm/s",
            "all anchors' crystals ±0.03–0.1 ppm/s"]  # fmt: skip
OF_STUDY = {
    **dict.fromkeys((room.BASE, "hall, 8 anchors", "3-D room, 8 anchors"), 1.03),
    **dict.fromkeys(("past a wall", "a body", *LATE, *CRYSTALS), 1.10),
}
LAB_S = 50.0
"""20,000 receptions."""
FEW = 4
"""Seeds of all cases but those with a limit below 1.10."""


def cases(seed):
    """Name, largest ratio of the RMSE, and world of each case."""
    plan = replace(plan_of("joint", seed, study="room"), worlds=1, tags=3)
    of_study = {case.name: case.runs[0] for case in room.cases(plan)}
    lab, ideal, far = lab_site(), ideal_lab_site(), far_site()
    lone = replace(plan, tags=1, seconds=LAB_S)
    in_room = partial(worlds, plan, warmup_s=1.5, room=Room())
    yield "ideal lab, at rest", 1.01, worlds(lone, ideal, partial(room.still, ideal, 1))[0]
    yield "ideal lab, walking", 1.01, worlds(lone, ideal, lambda one: trajectories_of(Request(ideal, seed=one)))[0]
    for name, limit in OF_STUDY.items():
        yield name, limit, of_study[name]
    yield "50 % lost", 1.10, in_room(lab, partial(wanderers, lab, 3), loss=0.5)[0]
    for name in DAMAGED:
        yield name, 1.05, of_study[room.BASE]
    yield f"the room {FAR_M / 1000.0:g} km away", 1.03, in_room(far, partial(wanderers, far, 3))[0]


def long_cases(seed, minutes):
    """Name, and world of each case that lasts."""
    plan = replace(plan_of("joint", seed, study="room"), worlds=1, tags=1, seconds=60.0 * minutes)
    for place, site, errors in (("ideal lab", ideal_lab_site(), None), ("the room", lab_site(), Room()),
                                ("3-D room", room.room_3d_site(plan.noise_ps), Room())):  # fmt: skip
        for motion, paths in (("at rest", room.still), ("walking", wanderers)):
            yield f"{place}, {motion}", None, worlds(plan, site, partial(paths, site, 1), warmup_s=0.0, room=errors)[0]


def far_site():
    """The lab, far from its origin."""
    lab = lab_site()
    return replace(lab, anchors=tuple(replace(one, x_m=one.x_m + FAR_M, y_m=one.y_m - FAR_M) for one in lab.anchors))


def damaged(run, bits):
    """What the tags of a world receive, one stamp in a hundred with a wrong bit."""
    draw = np.random.default_rng(run.seed)
    for beacon in beacons_of(run):
        flips = np.where(draw.random(len(beacon.receptions)) < 0.01, 1 << draw.integers(bits), 0).tolist()
        yield Heard(beacon.end_s, [
            (tag, replace(one, rx_ticks=one.rx_ticks ^ flip), truth_m)
            for flip, (tag, one, truth_m) in zip(flips, beacon.receptions, strict=True)
        ])  # fmt: skip


def asked_cases(asked):
    """Number of the seed, and each case that is asked for."""
    for number in range(asked.seeds):
        seed = asked.first + number
        for name, limit, run in long_cases(seed, asked.minutes) if asked.minutes else cases(seed):
            if any(word in name for word in asked.only) and (number < FEW or limit != 1.10):
                yield number, name, limit, run


def row_of(name, limit, joint, board, clean):
    """A line of the table; ``clean`` is that of which the ratio is."""
    _, at_joint, at_board = np.intersect1d(key(joint), key(board), return_indices=True)
    levels = np.nanmedian(board[at_board, 4] / joint[at_joint, 4])
    rmse_cm = [100.0 * one[:, 2].mean() ** 0.5 for one in (joint, board)]
    nees = [one[:, 3].mean() for one in (joint, board)]
    beyond = [f"{one[:, 5].mean():.0e}" if one[:, 5].any() else "0" for one in (joint, board)]
    ratio = rmse_cm[1] / (100.0 * clean[:, 2].mean() ** 0.5)
    return (
        f"| {name} | {len(joint):,} | {len(board) - len(joint):+,} | {rmse_cm[0]:.2f} | {rmse_cm[1]:.2f} "
        f"| {ratio:.3f}{'' if ratio <= limit else ' (!)'} | {limit:.2f} | {nees[0]:.2f} | {nees[1]:.2f} "
        f"| {100.0 * np.nanmedian(joint[:, 4]):.1f} | {levels:.3f} | {beyond[0]} | {beyond[1]} |"
    )


def minute_rows(name, minutes, joint, board):
    """Lines of the table of minutes: of the second, in the middle and of the last."""
    for minute in sorted({2, minutes // 2, minutes}):
        figures = []
        for fixes in (joint, board):
            own = fixes[fixes[:, 1] // 60 == minute - 1]
            figures.append((100.0 * own[:, 2].mean() ** 0.5, own[:, 3].mean(), 100.0 * np.nanmedian(own[:, 4])))
        cells = (f"{one:.2f} | {other:.2f}" for one, other in zip(*figures, strict=True))
        yield f"| {name} | {minute} | {' | '.join(cells)} |"


def table(asked):
    """The whole of it."""
    with written(__file__, [WITH_BOARD_SIZES, "float"]) as places:
        found = {}
        for number, name, limit, _ in asked_cases(asked):
            files = [np.load(file_of(place, name, number)) for place in places]
            found.setdefault(name, (limit, [], []))
            for kept, one in zip(found[name][1:], files, strict=True):
                kept.append(one)
    together = {name: [np.concatenate(own) for own in both] for name, (_, *both) in found.items()}
    if asked.minutes:
        return [
            "| | minute | RMSE, `joint` | board | NEES, `joint` | board | HPL, `joint` | board |",
            "|---" + "|--:" * 7 + "|",
            *(line for name, both in together.items() for line in minute_rows(name, asked.minutes, *both)),
        ]
    return [
        "| | fixes | board | RMSE, `joint` | board | ratio | at most | NEES, `joint` | board | HPL, `joint` | board "
        "| exceeded, `joint` | board |",
        "|---" + "|--:" * 12 + "|",
        *(
            row_of(name, found[name][0], *both, together.get(room.BASE, both)[1] if name in DAMAGED else both[0])
            for name, both in together.items()
        ),
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=1001)
    parser.add_argument("--minutes", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[""], help="words of cases")
    parser.add_argument("--into", type=Path, help="a page whose table is replaced")
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.write:
        for number, name, _, run in asked_cases(asked):
            beacons = damaged(run, DAMAGED[name]) if name in DAMAGED else None
            np.save(file_of(asked.write, name, number), fixes_of(run, beacons))
        return
    lines = "\n".join(table(asked)) + "\n"
    print(lines)
    if asked.into:
        before, rest = asked.into.read_text().split(MARKS[0])
        asked.into.write_text(before + MARKS[0] + lines + MARKS[1] + rest.split(MARKS[1])[1])


if __name__ == "__main__":
    main()
