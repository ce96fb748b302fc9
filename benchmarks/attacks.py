"""Attacks on a site with keys: whether they move a verified fix, and what they cost. Simulated.

    python benchmarks/attacks.py forged [--attack NAME …] [--rate HZ …] [--seconds 8] [--seed 1] [--room]
    python benchmarks/attacks.py relayed [--speed 0.25] [--seconds 12.5] [--seeds 4] [--room]

``forged``: an attacker with its own radios receives everything and knows all but the keys that are not disclosed yet.
From the second second on it sends forged frames to the tag and the anchors; genuine frames that they overlap are lost.
The same run with noise in their place is what fixes are compared with. One tag, which walks, is on from the start,
another one is switched on in the attack. Columns: verified fixes that differ in any bit from those of a plain receiver
with the genuine frames only, and the farthest, of both tags; frames of the attacker that the first tag accepted;
whether the anchors send the same as with noise; verified fixes fewer than with noise; from switching on in the attack
to the first verified fix; with trust open the largest error, that with noise, and the longest time in which errors
were 0.1 m larger than any with noise; processor time for each received frame, and with noise.

``relayed``: codes show who made a frame, not by which way it came. A device near the tag delays the frames of some
anchors, each by its own delay that grows by ``--speed``: of one, of three, or of all, at random speeds up to that one,
or as they would arrive from a place that moves away from the tag. Columns: the largest error of the seeds 1, 3 and
10 s later (in brackets without the delays), the stated standard deviation and level at the end (median), the share of
fixes whose error is above the level without an alert, how many seeds had an alert, and after which time (median).
"""

import argparse
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests"))

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.alert import Alert
from skyless.core.site import ScheduleSite, Site
from skyless.core.ticks import SPEED_OF_LIGHT_MPS
from skyless.core.trusted_receiver import SiteTrust, Trust
from skyless.sim.evaluation.scenarios import Request, Room
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.sim.streams import stream
from support.adversary import FORGERIES, Forgery, any_forgery
from support.keyed_air import (
    Attack,
    AttackedAir,
    Received,
    TagRun,
    compare,
    delayed,
    errors_m,
    key_of,
    made_keys,
    run_tag,
)

ATTACK_FROM_S = 2.0
SWITCHED_ON_S = 3.0
WORSE_M = 0.1
KEYS_BEGIN_S = -60.0
"""Chains of a site in use have begun long before."""

RATES_HZ = {
    "false-page": (95.0, 476.0, 952.0, 1428.0),
    "false-measurement": (476.0, 952.0, 1906.0),
    "restarted-counter": (240.0,),
}
USUAL_RATE_HZ = 477.0
EVERY: dict[str, Forgery] = {**FORGERIES, "any": any_forgery}


def site_of(*, in_room: bool) -> Site:
    """The lab without a master."""
    lab = lab_site() if in_room else paper_lab_site()
    return replace(lab, schedule=ScheduleSite(mode="free", rate_hz=60.0))


def worst_open(tape: list[Received], noise: list[Received], trust: SiteTrust) -> tuple[float, float, float]:
    """Largest errors with trust open, in the attack and with noise, and the longest time in which they were larger."""
    found, expected = errors_m(run_tag(tape, trust), tape), errors_m(run_tag(noise, trust), noise)
    found, expected = found[found[:, 0] > 1.0], expected[expected[:, 0] > 1.0]
    limit_m = expected[:, 1].max() + WORSE_M
    worse_s = longest_s = 0.0
    for (before_s, before_m), (now_s, now_m) in pairwise(found.tolist()):
        worse_s = worse_s + now_s - before_s if now_m > limit_m and before_m > limit_m else 0.0
        longest_s = max(longest_s, worse_s)
    return float(found[:, 1].max()), float(expected[:, 1].max()), longest_s


def row_of(attack: str, rate_hz: float, asked: argparse.Namespace) -> str:
    """A line of the table."""
    site = site_of(in_room=asked.room)
    keys = made_keys(site.id, KEYS_BEGIN_S)
    request = Request(site, seed=asked.seed, room=Room() if asked.room else None)
    tapes = []
    for is_noise in (False, True):
        air = AttackedAir(request, keys, Attack(EVERY[attack], rate_hz, ATTACK_FROM_S, is_noise))
        tapes.append(list(air.run(asked.seconds or 8.0)))
    tape, noise = tapes
    genuine = [[one.reception for one in each if one.is_genuine] for each in tapes]
    trust = SiteTrust(site.id, keys.public, trust=Trust.VERIFIED)
    runs, costs_us = [], []
    for each in tapes:
        begun_s = time.process_time()
        runs.append(run_tag(each, trust))
        costs_us.append(1e6 * (time.process_time() - begun_s) / len(each))
    found = compare(runs[0], tape, site.id)
    later = [one for one in tape if (one.reception.host_s or 0.0) > SWITCHED_ON_S]
    cold = run_tag(later, trust)
    open_m, open_noise_m, worse_s = worst_open(tape, noise, replace(trust, trust=Trust.OPEN))
    after = compare(cold, later, site.id)
    reasons = ", ".join(f"{reason} {count}" for reason, count in runs[0].counters.most_common(3))
    first = f"{cold.given[0].given_s - SWITCHED_ON_S:.2f} s" if cold.given else "none"
    moved = (f"{one.moved} ({1000 * one.most_moved_m:.1f} mm)" for one in (found, after))
    return (
        f"| {attack} | {rate_hz:g} | {found.fixes} | {', '.join(moved)} | {found.forged} "
        f"| {'same' if genuine[0] == genuine[1] else 'other'} "
        f"| {100 * (1.0 - found.fixes / len(runs[1].given)):.1f} % | {first} | {open_m:.2f} m ({open_noise_m:.2f}), "
        f"{worse_s:.2f} s | {costs_us[0]:.0f} ({costs_us[1]:.0f}) | {reasons} |"
    )


def run_tag_once() -> None:
    """Load what the first fixes load, so that it is not measured."""
    site = site_of(in_room=False)
    keys = made_keys(site.id, KEYS_BEGIN_S)
    run_tag(list(AttackedAir(Request(site), keys).run(1.0)), SiteTrust(site.id, keys.public))


def forged(asked):
    run_tag_once()
    heads = "attack | rate/s | fixes | moved | forged | anchors | lost | first | open | µs | counted"
    print(f"| {heads} |\n{'|---' * (heads.count('|') + 1)}|", flush=True)
    for attack in asked.attack:
        for rate_hz in asked.rate or RATES_HZ.get(attack, (USUAL_RATE_HZ,)):
            print(row_of(attack, rate_hz, asked), flush=True)


LATER_S = (1.0, 3.0, 10.0)
CASES = ("none", "1 anchor", "3 anchors", "all, at random", "all, consistent")
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
        later_s = max((one.reception.host_s or 0.0) - ATTACK_FROM_S, 0.0)
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
        times_s.append((original.reception.host_s or 0.0) - ATTACK_FROM_S)
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


def relayed_line(case: str, trials: list[Trial], baseline: list[Trial]) -> str:
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


def relayed(asked):
    heads = "delayed | " + " | ".join(f"{one:g} s later" for one in LATER_S)
    heads += " | stated std | level | missed | noticed"
    print(f"| {heads} |\n{'|---' * (heads.count('|') + 1)}|", flush=True)
    site = site_of(in_room=asked.room)
    keys = made_keys(site.id, KEYS_BEGIN_S)
    trust = SiteTrust(site.id, keys.public, trust=Trust.VERIFIED)
    trials: dict[str, list[Trial]] = {case: [] for case in CASES}
    for seed in range(1, asked.seeds + 1):
        request = Request(site, seed=seed, room=Room() if asked.room else None)
        tape = list(AttackedAir(request, keys).run(asked.seconds or 12.5))
        for case, found in trials.items():
            later = delayed(tape, delay_of(case, site, asked.speed, seed))
            found.append(judged(run_tag(later, trust), later))
    for case in CASES[1:]:
        print(relayed_line(case, trials[case], trials["none"]), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("forged", "relayed"))
    parser.add_argument("--attack", choices=tuple(EVERY), nargs="+", default=list(EVERY))
    parser.add_argument("--rate", type=float, nargs="+", help="forged frames a second; by default some for each attack")
    parser.add_argument("--speed", type=float, default=0.25, help="growth of the delays in m/s")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--room", action="store_true", help="with a real room's errors of survey and ranges")
    asked = parser.parse_args()
    {"forged": forged, "relayed": relayed}[asked.what](asked)


if __name__ == "__main__":
    main()
