"""The estimator as a board has it, next to that of a computer. Simulated; nothing of this has run on a board.

    python benchmarks/board.py accuracy [--seeds 10] [--first 1001] [--only WORD …] [--into docs/board.md]
    python benchmarks/board.py accuracy --minutes 10 --seeds 1      # by the minute: errors ought not to grow
    python benchmarks/board.py accuracy --library float --seeds 6   # single precision alone: docs/maths.md
    python benchmarks/board.py levels [--episodes 34]
    python benchmarks/board.py core [--superframes 20]

``accuracy``: both libraries run on this computer and process the same receptions. The board's has the sizes of its
records and single precision. ``levels``: whether its protection levels hold in the study ``integrity``, while one
anchor is wrong in one of 54 ways. ``core``: cycles of a reception on the emulated nRF52832 in the last three
superframes, good to about ±25 %, its flash, RAM and stack.
"""

import argparse
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

sys.path.extend(str(Path(__file__).parents[1] / folder) for folder in ("firmware", "tests/firmware", "tests/core"))

import numpy as np
from estimator_builders import LAB_M, MESH, ROOM_M, begun, episode_of, one_by_one, settings_of
from msgspec.structs import replace

from skyless.core.any_receiver import AnyReceiver
from skyless.core.estimator.state import State
from skyless.core.native.records import PACKED
from skyless.core.tag.receiver import Receiver
from skyless.research.studies import integrity, room
from skyless.research.studies.runner import plan_of
from skyless.research.studies.worlds import Heard, beacons_of, worlds
from skyless.sim.evaluation.scenarios import Request, Room, trajectories_of, wanderers
from skyless.sim.lab import ideal_lab_site, lab_site

HERE = Path(__file__).parents[1]
LAUNCHERS = {
    "board": [HERE / "tests/native/with_sizes.py", "board"],
    "float": [HERE / "tests/native/with_sizes.py", "float"],
}
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
OF_FLOAT = (
    "the room", "hall, 8 anchors", "3-D room, 8 anchors", "past a wall", "one anchor 20 cm off",
    "1 of 6 creeps 5 cm/s for 20 s", "tags' crystals +2 ppm", "nothing lost", "90 % lost everywhere",
    "one anchor +1.5 m in bursts", "rounds at 5 m/s", "still",
)  # fmt: skip
ERRORS = {"survey_std_m": 0.02, "range_std_m": 0.03, "slope_std_m": 0.05, "place_std_m": 0.005}
LAB_S, FEW = 50.0, 4
"""Seconds of the ideal lab; seeds of cases whose limit is 1.10."""
OF_LEVELS = {"fill_fix", "protect", "fault_chi2", "whiten", "integrity_state"}
CORES = [*((LAB_M, 0.0, relays) for relays in (5, 4, 3, 2, 0)), *((ROOM_M, z, n) for z in (0.0, None) for n in (7, 3))]
"""Anchors, the tag's height, and relays with a packet."""


def cases(seed, seconds):
    """Name, largest ratio of the RMSE, and world of each case of ``--library board``."""
    plan = replace(plan_of("joint", seed, study="room"), worlds=1, tags=3, seconds=seconds)
    of_study = {case.name: case.runs[0] for case in room.cases(plan)}
    lab, ideal = lab_site(), ideal_lab_site()
    far = replace(lab, anchors=tuple(replace(one, x_m=one.x_m + FAR_M, y_m=one.y_m - FAR_M) for one in lab.anchors))
    lone = replace(plan, tags=1, seconds=min(LAB_S, 5.0 * seconds))
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
    plan = replace(plan_of("joint", seed, study="room"), worlds=1, tags=1, seconds=60.0 * minutes)
    for place, site, errors in (("ideal lab", ideal_lab_site(), None), ("the room", lab_site(), Room()),
                                ("3-D room", room.room_3d_site(plan.noise_ps), Room())):  # fmt: skip
        for moves, paths in (("at rest", room.still), ("walking", wanderers)):
            yield f"{place}, {moves}", None, worlds(plan, site, partial(paths, site, 1), warmup_s=0.0, room=errors)[0]


def float_cases(seed, seconds):
    """Those of ``--library float``."""
    plan = replace(plan_of("joint", seed, study="room"), worlds=1, tags=3, seconds=2.0 * seconds)
    plans = [replace(plan, conditions=one) for one in ("usual", "loss", "nlos", "motion")]
    found = {case.name: case.runs[0] for one in plans for case in room.cases(one)}
    yield from ((name, None, found[name]) for name in OF_FLOAT)


def asked_cases(asked):
    """Number of the seed, and each case that is asked for."""
    for number in range(asked.seeds):
        seed = asked.first + number
        if asked.minutes:
            every = long_cases(seed, asked.minutes)
        elif asked.library == "float":
            every = float_cases(seed, asked.seconds)
        else:
            every = cases(seed, asked.seconds)
        for name, limit, run in every:
            if any(word in name for word in asked.only) and (number < FEW or limit != 1.10):
                yield number, name, limit, run


def damaged(run, bits):
    """What the tags of a world receive, one stamp in a hundred with a wrong bit."""
    draw = np.random.default_rng(run.seed)
    for beacon in beacons_of(run):
        flips = np.where(draw.random(len(beacon.receptions)) < 0.01, 1 << draw.integers(bits), 0).tolist()
        yield Heard(beacon.end_s, [
            (tag, replace(one, rx_ticks=one.rx_ticks ^ flip), truth_m)
            for flip, (tag, one, truth_m) in zip(flips, beacon.receptions, strict=True)
        ])  # fmt: skip


def fixes_of(run, beacons):
    """Of each judged fix: tag, time, squared error, its normalised square, horizontal level or NaN, and if exceeded."""
    receivers = [AnyReceiver(run.method) for _ in run.trajectories]
    dim, rows = 2 if run.site.tags.height_m is not None else 3, []
    for beacon in beacons:
        for tag, reception, truth_m in beacon.receptions:
            fix, inner = receivers[tag].hear(reception), receivers[tag].receiver
            if fix is not None and beacon.end_s >= run.warmup_s:
                # A library with the board's sizes has positions from a place near the first anchor.
                origin_m = np.array(inner.tag.origin_mm[:]) / 1000.0 if isinstance(inner, Receiver) else 0.0
                error_m = (fix.position_m + origin_m - truth_m)[:dim]
                nees = error_m @ np.linalg.solve(fix.covariance_m2[:dim, :dim], error_m) / dim
                level_m = np.nan if fix.hpl_m is None else fix.hpl_m
                exceeded = np.hypot(error_m[0], error_m[1]) > level_m
                rows.append((tag, beacon.end_s, error_m @ error_m, nees, level_m, exceeded))
    return np.array(rows)


def file_of(folder, name, number):
    return folder / f"{name} {number}.npy".replace("/", " per ")


def key(fixes):
    """A number for each tag and time."""
    return np.round(fixes[:, 1] * 1e9).astype(np.int64) * 16 + fixes[:, 0].astype(np.int64)


def row_of(name, limit, joint, other, clean):
    """A line of the table; ``clean`` is that of which the ratio is."""
    _, at_joint, at_other = np.intersect1d(key(joint), key(other), return_indices=True)
    ratios = other[at_other, 4] / joint[at_joint, 4]
    ratios = ratios[np.isfinite(ratios)]
    rmse_cm = [100.0 * one[:, 2].mean() ** 0.5 for one in (joint, other)]
    nees = [one[:, 3].mean() for one in (joint, other)]
    fixes = f"| {name} | {len(joint):,} | {len(other) - len(joint):+,} | {rmse_cm[0]:.2f}"
    if limit is None:
        beyond = 100.0 * np.mean(np.abs(ratios - 1.0) > 0.03)
        return (f"{fixes} | {rmse_cm[1] / rmse_cm[0]:.3f} | {nees[0]:.2f} | {nees[1] / nees[0]:.3f} "
                f"| {np.median(ratios):.3f} | {beyond:.2f} % | {ratios.max():.3f} |")  # fmt: skip
    beyond = [f"{one[:, 5].mean():.0e}" if one[:, 5].any() else "0" for one in (joint, other)]
    ratio = rmse_cm[1] / (100.0 * clean[:, 2].mean() ** 0.5)
    return (
        f"{fixes} | {rmse_cm[1]:.2f} | {ratio:.3f}{'' if ratio <= limit else ' (!)'} | {limit:.2f} | {nees[0]:.2f} "
        f"| {nees[1]:.2f} | {100.0 * np.nanmedian(joint[:, 4]):.1f} | {np.median(ratios):.3f} "
        f"| {beyond[0]} | {beyond[1]} |"
    )


def minute_rows(name, minutes, joint, board):
    """Lines of the table of minutes: of the second, in the middle and of the last."""
    for minute in sorted({min(2, minutes), -(-minutes // 2), minutes}):
        figures = []
        for fixes in (joint, board):
            own = fixes[fixes[:, 1] // 60 == minute - 1]
            figures.append((100.0 * own[:, 2].mean() ** 0.5, own[:, 3].mean(), 100.0 * np.nanmedian(own[:, 4])))
        cells = (f"{one:.2f} | {other:.2f}" for one, other in zip(*figures, strict=True))
        yield f"| {name} | {minute} | {' | '.join(cells)} |"


def table(asked):
    """Each library computes in a process of its own, and writes its fixes."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        places, runs = [Path(folder) / kind for kind in ("joint", "other")], []
        for place, words in zip(places, ([], LAUNCHERS[asked.library]), strict=True):
            place.mkdir()
            runs.append(subprocess.Popen([sys.executable, *words, __file__, *sys.argv[1:], "--write", place]))
        codes = [run.wait() for run in runs]
        if any(codes):
            sys.exit("a run failed")
        for number, name, limit, _ in asked_cases(asked):
            found.setdefault(name, (limit, [], []))
            for kept, place in zip(found[name][1:], places, strict=True):
                kept.append(np.load(file_of(place, name, number)))
    together = {name: [np.concatenate(own) for own in both] for name, (_, *both) in found.items()}
    names = ["", "fixes", asked.library, "RMSE, `joint`"]
    if asked.minutes:
        names = ["", "minute", "RMSE, `joint`", "board", "NEES, `joint`", "board", "HPL, `joint`", "board"]
        rows = [line for name, both in together.items() for line in minute_rows(name, asked.minutes, *both)]
    else:
        if asked.library == "float":
            names += ["float", "NEES", "float", "HPL's median, float", "levels beyond 3 %", "largest"]
        else:
            names += ["board", "ratio", "at most", "NEES, `joint`", "board", "HPL, `joint`", "board",
                      "exceeded, `joint`", "board"]  # fmt: skip
        rows = [
            row_of(name, found[name][0], *both, together.get(room.BASE, both)[1] if name in DAMAGED else both[0])
            for name, both in together.items()
        ]
    return [f"| {' | '.join(names)} |".replace("|  |", "| |"), "|---" + "|--:" * (len(names) - 1) + "|", *rows]


def accuracy(asked):
    if asked.write:
        for number, name, _, run in asked_cases(asked):
            beacons = damaged(run, DAMAGED[name]) if name in DAMAGED else beacons_of(run)
            np.save(file_of(asked.write, name, number), fixes_of(run, beacons))
        return
    lines = "\n".join(table(asked)) + "\n"
    print(lines)
    if asked.into:
        before, rest = asked.into.read_text().split(MARKS[0])
        asked.into.write_text(before + MARKS[0] + lines + MARKS[1] + rest.split(MARKS[1])[1])


def levels(asked):
    """An epoch that misleads has a level, and an error beyond it."""
    plan = plan_of("joint", asked.first, study="integrity", episodes=asked.episodes)
    rows = integrity.rows(plan, [cell.function() for cell in integrity.cells(plan)])
    print(
        "| fault | epochs | with a level | median | RMSE | misleading, 99 % | vertically, 99 % |\n|---"
        + "|--:" * 6
        + "|"
    )
    for row in (row for row in rows if row.hmi or row.hmi_vertical or row is rows[-1] or "clean" in row.case):
        sideways, upwards = (
            "" if found is None else f"{found:.1e}, {interval[0]:.0e} to {interval[1]:.0e}"
            for found, interval in ((row.hmi, row.hmi_interval), (row.hmi_vertical, row.hmi_vertical_interval))
        )
        print(f"| {row.case} | {row.fixes:,} | {100.0 * row.available:.1f} % | {100.0 * row.hpl_m:.0f} cm "
              f"| {100.0 * row.rmse_m:.1f} cm | {sideways} | {upwards} |")  # fmt: skip


def core(asked):
    from core_stage import BoardCore  # noqa: PLC0415 - needs unicorn

    print("| anchors | dimensions | relays | states | cycles, mean | most | ms | of levels |\n|---" + "|--:" * 7 + "|")
    stack = 0
    for anchors_m, height_m, relays in CORES:
        episode = episode_of(MESH, asked.superframes, 1, anchors_m)
        estimator = begun(episode, settings_of(height_m=height_m, **ERRORS), anchors_m, std_m=0.1)
        chip, counts, first = BoardCore(), [], len(episode.packets.anchors) - 3 * len(anchors_m)
        chip.put_state(estimator.state)
        for number, (*stamps, heard) in enumerate(one_by_one(episode.packets)):
            if number == first:
                chip.cycles_by_function()
            counts.append(chip.process(*estimator.packet_of(*stamps, heard[:relays]))[1])
        counts, state, by_function = np.array(counts[first:]), chip.state(State), chip.cycles_by_function()
        of_levels = sum(by_function.get(name, 0) for name in OF_LEVELS) / len(counts)
        print(f"| {len(anchors_m)} | {state.dim} | {relays} | {state.used} | {counts.mean():,.0f} "
              f"| {counts.max():,} | {counts.mean() / 64_000:.2f} | {of_levels:,.0f} |", flush=True)  # fmt: skip
        stack = max(stack, chip.stack_bytes)
    size = subprocess.run(["arm-none-eabi-size", chip.elf], capture_output=True, text=True, check=True).stdout
    text, data, bss = map(int, size.splitlines()[1].split()[:3])
    print(f"\nflash {text + data:,} bytes; RAM {data + bss:,}, of which the stack may have 2,048 and has had {stack:,}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("accuracy", "levels", "core"))
    parser.add_argument("--library", choices=("board", "float"), default="board")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=1001, help="the first seed")
    parser.add_argument("--seconds", type=float, default=15.0, help="of a case; twice that with --library float")
    parser.add_argument("--minutes", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[""], help="words of cases")
    parser.add_argument("--into", type=Path, help="a page whose table is replaced")
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--episodes", type=int, default=34)
    parser.add_argument("--superframes", type=int, default=20)
    asked = parser.parse_args()
    if asked.part != "accuracy" and not PACKED:
        sys.exit(subprocess.call([sys.executable, *LAUNCHERS["board"], __file__, *sys.argv[1:]]))
    {"accuracy": accuracy, "levels": levels, "core": core}[asked.part](asked)


if __name__ == "__main__":
    main()
