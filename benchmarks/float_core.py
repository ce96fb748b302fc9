"""The estimator's C for ``float`` against that for ``double``: the same receptions, fix by fix.

    python benchmarks/float_core.py [--seeds 1 2 3] [--seconds 30] [--rest 3600] [--only WORD …] [--board]

Cases of the studies, three tags each; then a tag that lies still for ``--rest`` seconds, from stamps alone. Each row
holds the fixes of all seeds; "float" is that over double.
"""

import argparse
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from msgspec import structs

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "positioning"))

from estimator_builders import LAB_M, MESH, ROOM_M, begun, episode_of, late, settings_of, tracked

from skyless.core.any_receiver import AnyReceiver
from skyless.core.tag.receiver import Receiver
from skyless.research.studies import loss, motion, nlos, room
from skyless.research.studies.common.plan import plan_of
from skyless.research.studies.common.worlds import beacons_of

WITH_BOARD_SIZES = Path(__file__).parents[1] / "tests" / "firmware" / "with_board_sizes.py"
WITH_FLOAT = Path(__file__).parents[1] / "tests" / "native" / "with_float.py"
STUDIES = (
    "the room", "hall, 8 anchors", "3-D room, 8 anchors", "past a wall", "one anchor 20 cm off",
    "1 of 6 creeps 5 cm/s for 20 s", "tags' crystals +2 ppm", "nothing lost", "90 % lost everywhere",
    "one anchor +1.5 m in bursts", "rounds at 5 m/s", "still",
)  # fmt: skip
ERRORS = {"survey_std_m": 0.02, "range_std_m": 0.03, "slope_std_m": 0.05, "place_std_m": 0.005}
AT_REST = {
    "at rest, exact": (LAB_M, 0.0, {}),
    "at rest, the room": (ROOM_M, 0.0, ERRORS),
    "at rest, 3-D": (ROOM_M, None, ERRORS),
}
SLOT_S = 0.01
"""Between two packets at a tag at rest."""


def worlds(asked):
    """Name, seed and world of the studies' cases that are asked for."""
    for seed in asked.seeds:
        plan = structs.replace(plan_of("joint", seed, study="room"), worlds=1, tags=3, seconds=asked.seconds)
        for case in (case for study in (room, motion, loss, nlos) for case in study.cases(plan)):
            if case.name in STUDIES and is_asked(case.name, asked):
                yield case.name, seed, case.runs[0]


def is_asked(name, asked):
    return any(word in name for word in asked.only)


def fixes_of(run, beacons=None):
    """Of each judged fix: tag, time, squared error, its normalised square, horizontal level and whether it is exceeded.

    The level is NaN where there is none; ``beacons`` are those that the run has, unless others are given.
    """
    receivers = [AnyReceiver(run.method, qa=run.qa, integrity=run.integrity) for _ in run.trajectories]
    dim, rows = 2 if run.site.tags.height_m is not None else 3, []
    for beacon in beacons or beacons_of(run):
        for tag, reception, truth_m in beacon.receptions:
            fix = receivers[tag].hear(reception)
            if fix is not None and beacon.end_s >= run.warmup_s:
                error_m = (fix.position_m + origin_m(receivers[tag].receiver) - truth_m)[:dim]
                nees = error_m @ np.linalg.solve(fix.covariance_m2[:dim, :dim], error_m) / dim
                level_m = np.nan if fix.hpl_m is None else fix.hpl_m
                across_m = np.hypot(error_m[0], error_m[1])
                rows.append((tag, beacon.end_s, error_m @ error_m, nees, level_m, across_m > level_m))
    return np.array(rows)


def origin_m(receiver):
    """To be added to positions, which a library with the board's sizes has from a place near the first anchor."""
    return np.array(receiver.tag.origin_mm[:]) / 1000.0 if isinstance(receiver, Receiver) else 0.0


def fixes_at_rest(seconds, seed, anchors_m, height_m, errors):
    """The same of a tag that lies still, from its tenth second on."""
    draw, count = np.random.default_rng(seed), len(anchors_m)
    superframes = round(seconds / SLOT_S / count)
    place_m = np.append(anchors_m[:, :2].mean(axis=0) + draw.uniform(-1.0, 1.0, 2), 0.0)
    path_m = np.broadcast_to(place_m, (superframes * count, 3))
    episode = episode_of(MESH, superframes, seed, anchors_m, path_m=path_m, slot_s=SLOT_S)
    late_m = draw.normal(0.0, errors.get("range_std_m", 0.0), count)
    estimator = begun(episode, settings_of(height_m=height_m, **errors), anchors_m, std_m=0.1)
    run = tracked(estimator, late(episode.packets, late_m[episode.packets.anchors]))
    error = run.errors(episode)
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(run.covariances, error[..., None])[..., 0]) / error.shape[1]
    time_s = SLOT_S * np.arange(len(error))
    table = np.column_stack([np.zeros(len(error)), time_s, np.square(error).sum(axis=1), nees, run.levels[:, 0]])
    return table[time_s > 10.0]


def write(folder, asked):
    """What a process computes, with one of the libraries."""
    for name, seed, run in worlds(asked):
        np.save(file_of(folder, name, seed), fixes_of(run))
    for name, case in AT_REST.items():
        for seed in asked.seeds if is_asked(name, asked) else ():
            np.save(file_of(folder, name, seed), fixes_at_rest(asked.rest, seed, *case))


@contextmanager
def written(script, launcher):
    """Two folders with what a script computes for its arguments: as it is, and run by the words of a launcher."""
    with tempfile.TemporaryDirectory() as folder:
        places = [Path(folder) / kind for kind in ("double", "float")]
        runs = []
        for place, words in zip(places, ([], launcher), strict=True):
            place.mkdir()
            runs.append(subprocess.Popen([sys.executable, *words, script, *sys.argv[1:], "--write", place]))
        codes = [run.wait() for run in runs]
        if any(codes):
            sys.exit("a run failed")
        yield places


def file_of(folder, name, seed):
    return folder / f"{name} {seed}.npy".replace("/", " per ")


def row_of(name, double, single):
    """A line of the table."""
    _, at_double, at_single = np.intersect1d(key(double), key(single), return_indices=True)
    ratio = single[at_single, 4] / double[at_double, 4]
    ratio = ratio[np.isfinite(ratio)]
    squared, nees = (single[:, column].mean() / double[:, column].mean() for column in (2, 3))
    rmse_cm, level_m = 100.0 * double[:, 2].mean() ** 0.5, np.nanmedian(double[:, 4])
    beyond = 100.0 * np.mean(np.abs(ratio - 1.0) > 0.03)
    return (
        f"| {name} | {len(double)} | {len(single) - len(double):+d} | {rmse_cm:.2f} cm | {squared**0.5:.4f} "
        f"| {double[:, 3].mean():.2f} | {nees:.4f} | {level_m:.2f} m | {np.median(ratio):.4f} | {beyond:.2f} % "
        f"| {ratio.max():.3f} | {np.isnan(single[:, :4]).sum()} |"
    )


def key(fixes):
    """A number for each tag and time."""
    return np.round(fixes[:, 1] * 1e9).astype(np.int64) * 16 + fixes[:, 0].astype(np.int64)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rest", type=float, default=3600.0)
    parser.add_argument("--only", nargs="*", default=[""], help="words of cases")
    parser.add_argument("--board", action="store_true", help="the board's library, which speaks protocol 2 alone")
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.write:
        write(asked.write, asked)
        return
    with written(__file__, [WITH_BOARD_SIZES, "float"] if asked.board else [WITH_FLOAT]) as places:
        print("| | fixes | float | RMSE | float | NEES | float | HPL, median | float | beyond 3 % | largest | NaN |")
        print("|---|---|---|---|---|---|---|---|---|---|---|---|")
        for name in (name for name in (*STUDIES, *AT_REST) if is_asked(name, asked)):
            files = [[file_of(place, name, seed) for seed in asked.seeds] for place in places]
            print(row_of(name, *(np.concatenate([np.load(file) for file in own]) for own in files)))


if __name__ == "__main__":
    main()
