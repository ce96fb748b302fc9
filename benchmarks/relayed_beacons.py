"""Genuine beacons that somebody disturbs and repeats a little later: how far verified fixes go. Simulated.

    python benchmarks/relayed_beacons.py [--room] [--speed 0.25] [--seconds 12] [--seeds 4] [--json]

Codes show who made a frame, not by which way it came. From the second second on a device near the tag delays the frames
of some anchors, each by its own delay that grows by ``--speed``: of one, of three, or of all, at random speeds up to
that one ("all, at random"), or as they would arrive from a place that moves away from the tag ("all, consistent"). The
tag walks and has trust verified. Columns: the largest error of the seeds 1, 3 and 10 s later (in brackets without the
delays), the stated standard deviation and protection level at the end (median), the share of fixes whose error is
above the level without an alert, how many seeds had an alert or an excluded anchor, and after which time (median).

At the end: what a delay of all frames by a constant time does, to a tag that is on and one that is switched on.
"""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
from forged_beacons import KEYS_BEGIN_S, site_of
from msgspec import Struct, to_builtins

from skyless.core.integrity import Alert
from skyless.core.site import Site
from skyless.core.ticks import SPEED_OF_LIGHT_MPS
from skyless.core.trusted_receiver import SiteTrust, Trust
from skyless.sim.compile_ahead import compile_kernels
from skyless.sim.evaluation.scenarios import Request, Room
from skyless.sim.streams import stream
from support.keyed_air import AttackedAir, Received, TagRun, delayed, key_of, made_keys, run_tag

FROM_S = 2.0
LATER_S = (1.0, 3.0, 10.0)
CASES = ("none", "1 anchor", "3 anchors", "all, at random", "all, consistent")
CONSTANT_S = (1e-6, 1e-3, 0.05, 0.15, 0.25, 0.5)
_STREAM = 77

DelayOf = Callable[[Received], float]


class Trial(Struct, frozen=True):
    """A seed of a case."""

    errors_m: list[float]
    """At ``LATER_S``."""
    std_m: float
    hpl_m: float | None
    missed: float
    """Share of fixes whose error is above the level without an alert."""
    noticed_s: float | None


def delay_of(case: str, site: Site, speed_mps: float, seed: int) -> DelayOf:
    """The delay of each frame in a case."""
    draw = stream(seed, _STREAM, 0)
    ids = [anchor.id for anchor in site.anchors]
    positions_m = {anchor.id: np.array([anchor.x_m, anchor.y_m, anchor.z_m]) for anchor in site.anchors}
    angle = draw.uniform(0.0, 2.0 * np.pi)
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    some = {"none": 0, "1 anchor": 1, "3 anchors": 3}.get(case, len(ids))
    speeds_mps = dict.fromkeys(draw.permutation(ids).tolist()[:some], speed_mps)
    if case == "all, at random":
        speeds_mps = {anchor: speed_mps * draw.uniform() for anchor in ids}

    def delay_s(one: Received) -> float:
        later_s = max((one.reception.host_s or 0.0) - FROM_S, 0.0)
        if case == "all, consistent":  # as long as needed for none to be negative
            moved_m = speed_mps * later_s
            at_m, from_m = one.position_m, positions_m[one.anchor]
            away_m = np.linalg.norm(at_m + moved_m * direction - from_m) - np.linalg.norm(at_m - from_m)
            return float(moved_m + away_m) / SPEED_OF_LIGHT_MPS
        return speeds_mps.get(one.anchor, 0.0) * later_s / SPEED_OF_LIGHT_MPS

    return delay_s


def judged(run: TagRun, received: list[Received]) -> Trial:
    """Errors and what the fixes stated."""
    truth = {key_of(one.reception): one for one in received}
    times_s, errors_m, fixes = [], [], []
    for one in run.given:
        original = truth[one.key]
        times_s.append((original.reception.host_s or 0.0) - FROM_S)
        errors_m.append(float(np.linalg.norm((one.fix.position_m - original.position_m)[:2])))
        fixes.append(one.fix)
    attacked = [number for number, time_s in enumerate(times_s) if time_s > 0.0]
    at = [max(number for number, time_s in enumerate(times_s) if time_s <= later_s) for later_s in LATER_S]
    missed = [fixes[n].alert is Alert.NONE and errors_m[n] > (fixes[n].hpl_m or 0.0) for n in attacked]
    noticed_s = [times_s[n] for n in attacked if fixes[n].alert is not Alert.NONE]
    last = fixes[at[-1]]
    return Trial(
        [errors_m[n] for n in at], last.std_m, last.hpl_m, float(np.mean(missed)), min(noticed_s, default=None)
    )


def line_of(case: str, trials: list[Trial], baseline: list[Trial]) -> str:
    """A line of the table."""
    errors, plain = (np.array([one.errors_m for one in each]).max(axis=0) for each in (trials, baseline))
    cells = " | ".join(f"{one:.2f} m ({other:.2f})" for one, other in zip(errors, plain, strict=True))
    levels = [one.hpl_m for one in trials if one.hpl_m is not None]
    level = f"{np.median(levels):.2f} m" if levels else "none"
    noticed = [one.noticed_s for one in trials if one.noticed_s is not None]
    after = f", {np.median(noticed):.1f} s" if noticed else ""
    return (
        f"| {case} | {cells} | {np.median([one.std_m for one in trials]):.3f} m | {level} "
        f"| {100 * np.mean([one.missed for one in trials]):.0f} % | {len(noticed)} of {len(trials)}{after} |"
    )


def constant_lines(tape: list[Received], trust: SiteTrust) -> list[str]:
    """What a constant delay of all frames does."""
    lines = []
    for constant_s in CONSTANT_S:
        cells = []
        for begins_s in (FROM_S, 0.0):
            later = delayed(tape, lambda one: constant_s if (one.reception.host_s or 0.0) > begins_s else 0.0)  # noqa: B023
            run = run_tag(later, trust)
            truth = {key_of(one.reception): one for one in later}
            after = [one for one in run.given if (truth[one.key].reception.host_s or 0.0) > begins_s + constant_s]
            error = max(
                (float(np.linalg.norm((one.fix.position_m - truth[one.key].position_m)[:2])) for one in after),
                default=None,
            )
            frames = sum((one.reception.host_s or 0.0) > begins_s + constant_s for one in later)
            used = sum((truth[key].reception.host_s or 0.0) > begins_s + constant_s for key in run.accepted)
            cells.append(f"{100 * used / frames:.0f} %, {'no fix' if error is None else f'{error:.2f} m'}")
        lines.append(f"| {1e3 * constant_s:g} ms | {' | '.join(cells)} |")
    return lines


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--room", action="store_true", help="with a real room's errors of survey and ranges")
    parser.add_argument("--speed", type=float, default=0.25, help="growth of the delays in m/s")
    parser.add_argument("--seconds", type=float, default=12.5)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--json", action="store_true", help="a JSON object for each trial instead of the tables")
    asked = parser.parse_args()
    if asked.seeds < 1 or not asked.seconds >= FROM_S + LATER_S[-1] + 0.5:
        parser.error(f"argument --seeds should be 1 or more, --seconds {FROM_S + LATER_S[-1] + 0.5:g} or more")
    compile_kernels()
    if not asked.json:
        heads = "delayed | " + " | ".join(f"{one:g} s later" for one in LATER_S)
        heads += " | stated std | level | missed | noticed"
        print(f"| {heads} |\n{'|---' * (heads.count('|') + 1)}|", flush=True)
    site = site_of(in_room=asked.room)
    keys = made_keys(site.id, KEYS_BEGIN_S)
    trust = SiteTrust(site.id, keys.public, trust=Trust.VERIFIED)
    trials: dict[str, list[Trial]] = {case: [] for case in CASES}
    for seed in range(1, asked.seeds + 1):
        request = Request(site, seed=seed, room=Room() if asked.room else None)
        tape = list(AttackedAir(request, keys).run(asked.seconds))
        for case in CASES:
            later = delayed(tape, delay_of(case, site, asked.speed, seed))
            trial = judged(run_tag(later, trust), later)
            trials[case].append(trial)
            if asked.json:
                print(json.dumps({"case": case, "seed": seed} | to_builtins(trial)), flush=True)
    if not asked.json:
        for case in CASES[1:]:
            print(line_of(case, trials[case], trials["none"]), flush=True)
    if not asked.json:
        print("\n| all frames later by | frames used, largest error: on | switched on |\n|---|---|---|")
        print("\n".join(constant_lines(tape, trust)))


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
