"""Forged beacons at a site with keys: whether any moves a verified fix, and what they cost. Simulated.

    python benchmarks/forged_beacons.py [--attack NAME ...] [--rate HZ ...] [--seconds 8] [--seed 1]
        [--room] [--json]

An attacker with its own radios receives everything and knows all but the keys that are not disclosed yet. From the
second second on it sends forged frames to the tag and the anchors; genuine frames that they overlap are lost. The same
run with noise in their place is what fixes are compared with. One tag, which walks, is on from the start, another one
is switched on in the attack. Columns:

- moved: verified fixes that differ in any bit from those of a plain receiver that gets the genuine frames only, and in
  brackets the farthest; of the tag that is on from the start, then of the other one.
- forged: frames of the attacker that the first tag accepted: repetitions of frames that it had lost.
- anchors: whether what the anchors send is the same, bit for bit, as with noise.
- lost: verified fixes fewer than with noise; first: from switching on in the attack to the first verified fix.
- open: largest error of the fixes with trust open, that with noise in brackets, and the longest time in which errors
  were more than 0.1 m larger than any with noise.
- µs: processor time for each received frame, with noise in brackets.
"""

import argparse
import json
import sys
import time
from itertools import pairwise
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from msgspec import Struct, to_builtins
from msgspec.structs import replace

from skyless.core.site import ScheduleSite, Site
from skyless.core.trusted_receiver import SiteTrust, Trust
from skyless.sim.compile_ahead import compile_kernels
from skyless.sim.evaluation.scenarios import Request, Room
from skyless.sim.lab import lab_site, paper_lab_site
from support.adversary import FORGERIES, Forgery, any_forgery
from support.keyed_air import Attack, AttackedAir, Received, compare, errors_m, made_keys, run_tag

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


class Row(Struct, frozen=True):
    """What an attack did."""

    attack: str
    rate_hz: float
    fixes: int
    moved: int
    most_moved_m: float
    forged: int
    same_anchors: bool
    lost: float
    first_s: float | None
    cold_moved: int
    """As ``moved``, of the tag that is switched on in the attack."""
    cold_most_moved_m: float
    open_m: float
    open_noise_m: float
    open_worse_s: float
    cost_us: float
    noise_cost_us: float
    faults: dict[str, int]


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


def row_of(attack: str, rate_hz: float, asked: argparse.Namespace) -> Row:
    """Run an attack."""
    site = site_of(in_room=asked.room)
    keys = made_keys(site.id, KEYS_BEGIN_S)
    request = Request(site, seed=asked.seed, room=Room() if asked.room else None)
    tapes = []
    for is_noise in (False, True):
        air = AttackedAir(request, keys, Attack(EVERY[attack], rate_hz, ATTACK_FROM_S, is_noise))
        tapes.append(list(air.run(asked.seconds)))
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
    return Row(
        attack, rate_hz, found.fixes, found.moved, found.most_moved_m, found.forged, genuine[0] == genuine[1],
        1.0 - found.fixes / len(runs[1].given), cold.given[0].given_s - SWITCHED_ON_S if cold.given else None,
        after.moved, after.most_moved_m, open_m, open_noise_m, worse_s, *costs_us, dict(runs[0].counters),
    )  # fmt: skip


def line_of(row: Row) -> str:
    """A line of the table."""
    faults = ", ".join(f"{reason} {count}" for reason, count in sorted(row.faults.items(), key=lambda one: -one[1])[:3])
    first = "none" if row.first_s is None else f"{row.first_s:.2f} s"
    anchors = "same" if row.same_anchors else "other"
    moved = f"{row.moved} ({1000 * row.most_moved_m:.1f} mm), {row.cold_moved} ({1000 * row.cold_most_moved_m:.1f} mm)"
    return (
        f"| {row.attack} | {row.rate_hz:g} | {row.fixes} | {moved} | {row.forged} | {anchors} "
        f"| {100 * row.lost:.1f} % | {first} | {row.open_m:.2f} m ({row.open_noise_m:.2f}), {row.open_worse_s:.2f} s "
        f"| {row.cost_us:.0f} ({row.noise_cost_us:.0f}) | {faults} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--attack", choices=tuple(EVERY), nargs="+", default=list(EVERY))
    parser.add_argument("--rate", type=float, nargs="+", help="forged frames a second; by default some for each attack")
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--room", action="store_true", help="with a real room's errors of survey and ranges")
    parser.add_argument("--json", action="store_true", help="a JSON object for each attack instead of the table")
    asked = parser.parse_args()
    if not asked.seconds > SWITCHED_ON_S + 1.0:
        parser.error(f"argument --seconds: {asked.seconds:g} should be more than {SWITCHED_ON_S + 1.0:g}")
    if asked.seed < 0 or any(not 0.1 <= rate <= 3000.0 for rate in asked.rate or ()):
        parser.error("argument --seed should be 0 or more, --rate from 0.1 to 3000")
    compile_kernels()
    run_tag_once()
    if not asked.json:
        heads = "attack | rate/s | fixes | moved | forged | anchors | lost | first | open | µs | counted"
        print(f"| {heads} |\n{'|---' * (heads.count('|') + 1)}|", flush=True)
    for attack in asked.attack:
        for rate_hz in asked.rate or RATES_HZ.get(attack, (USUAL_RATE_HZ,)):
            row = row_of(attack, rate_hz, asked)
            print(json.dumps(to_builtins(row)) if asked.json else line_of(row), flush=True)


def run_tag_once() -> None:
    """Load what the first fixes load, so that it is not measured."""
    site = site_of(in_room=False)
    keys = made_keys(site.id, KEYS_BEGIN_S)
    run_tag(list(AttackedAir(Request(site), keys).run(1.0)), SiteTrust(site.id, keys.public))


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
