"""Millions of forged and altered frames at a tag that verifies beacons, and at an anchor: none may count.

    python benchmarks/forged_frames.py [--frames 1e7] [--seed 1] [--seconds 4]

Frames of all kinds are made from what a simulated site sends (``tests/support/adversary.py``), further altered by
random bits and bytes, with a right check sequence, and processed between the genuine frames, over and over again with
other draws. Prints how many were refused for which reason. Exit status 1 if one moved a verified fix or an anchor
admitted one.
"""

import argparse
import sys
import time
from bisect import bisect_right
from collections import Counter
from itertools import pairwise
from pathlib import Path
from random import Random

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from forged_beacons import KEYS_BEGIN_S, site_of
from msgspec.structs import replace

from skyless.core.air.frame import Reception, fcs
from skyless.core.anchor import Anchor, BeaconAuthentication
from skyless.core.site import Site
from skyless.core.ticks import from_seconds, wrap
from skyless.core.trusted_receiver import SiteTrust, Trust
from skyless.sim.compile_ahead import compile_kernels
from skyless.sim.evaluation.scenarios import Request
from support.adversary import FORGERIES
from support.keyed_air import START_UNIX_S, AttackedAir, MadeKeys, Received, compare, made_keys, run_tag

FORGED_EACH = 2
"""Of each kind, for a genuine frame; each is used several times, altered in other ways."""
FLAGS_AT = 11
LATELY = 1500
"""Forged frames of the last 0.1 s, of which the next ones are drawn: the intervals of most still hold."""
ROUND = 100_000


def recorded(
    site: Site, keys: MadeKeys, seconds: float, seed: int
) -> tuple[list[Received], list[float], list[bytes], set[bytes]]:
    """What a tag receives; forged frames, and from when on each may be sent; and all frames that anchors sent."""
    air = AttackedAir(Request(site, seed=seed), keys)
    tape, times_s, forged = [], [], []
    for one in air.run(seconds):
        tape.append(one)
        now_s = one.reception.host_s or 0.0
        for forgery in FORGERIES.values():
            for _ in range(FORGED_EACH):
                air.adversary.now_s = now_s + 1e-5
                times_s.append(now_s)
                forged.append(forgery(air.adversary))
    return tape, times_s, forged, {one.frame for one in air.adversary.recent}


def altered(frame: bytes, draw: Random) -> bytes:
    """The frame as it is, or with some other bits or bytes."""
    kind = draw.random()
    if kind < 0.3 or len(frame) <= FLAGS_AT + 2:
        return frame
    body = bytearray(frame[:-2])
    if kind < 0.7:
        body[draw.randrange(len(body))] ^= 1 << draw.randrange(8)
    elif kind < 0.95:
        for at in draw.sample(range(len(body)), min(len(body), 4)):
            body[at] = draw.randrange(256)
    else:
        body[FLAGS_AT] ^= draw.randrange(256)
    return bytes(body) + fcs(bytes(body))


def with_forged(
    tape: list[Received], times_s: list[float], forged: list[bytes], sent: set[bytes], count: int, draw: Random
) -> list[Received]:
    """The tape with about that many frames in the gaps; no repetition of one that the tag has lost."""
    received = {one.reception.frame for one in tape}
    each = count // (len(tape) - 1)
    mixed = []
    for one, after in pairwise(tape):
        mixed.append(one)
        begin_s, end_s = one.reception.host_s or 0.0, after.reception.host_s or 0.0
        step_s = (end_s - begin_s) / (each + 1)
        last = bisect_right(times_s, begin_s)
        first = max(0, last - LATELY)
        for number in range(1, each + 1):
            frame = altered(forged[draw.randrange(first, last)], draw)
            if frame in sent and frame not in received:
                continue
            later_s = step_s * number
            rx_ticks = wrap(one.reception.rx_ticks + from_seconds(later_s))
            mixed.append(replace(one, is_genuine=False, reception=Reception(frame, rx_ticks, begin_s + later_s)))
    return mixed


def admitted_by_anchor(
    site: Site, keys: MadeKeys, mixed: list[Received], sent: set[bytes], counters: Counter[str]
) -> tuple[int, int]:
    """Forged frames that an anchor admits, and repetitions of genuine ones."""
    authentication = BeaconAuthentication(keys.chains)
    anchor = Anchor(site, site.anchors[0].id, authentication=authentication)
    forged = repeated = 0
    for one in mixed:
        authentication.set_time(one.reception.rx_ticks, START_UNIX_S + (one.reception.host_s or 0.0))
        heard = anchor.counters["heard"]
        anchor.hear(one.reception)
        if anchor.counters["heard"] > heard and not one.is_genuine:
            forged += one.reception.frame not in sent
            repeated += one.reception.frame in sent
    counters.update(anchor.counters)
    return forged, repeated


def main() -> int:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=float, default=1e7)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=4.0, help="of air, which is used over and over again")
    asked = parser.parse_args()
    if not asked.frames >= 1000 or not asked.seconds >= 1.0:
        parser.error("argument --frames should be 1000 or more, --seconds 1 or more")
    compile_kernels()
    site = site_of(in_room=False)
    keys = made_keys(site.id, KEYS_BEGIN_S)
    trust = SiteTrust(site.id, keys.public, trust=Trust.VERIFIED)
    tape, times_s, forged, sent = recorded(site, keys, asked.seconds, asked.seed)
    draw, at_tag, at_anchor = Random(asked.seed), Counter[str](), Counter[str]()
    done = moved = accepted = lost = by_anchor = repeated = fixes = 0
    begun_s = time.perf_counter()
    while done < asked.frames:
        mixed = with_forged(tape, times_s, forged, sent, int(min(ROUND, asked.frames - done)) + len(tape), draw)
        run = run_tag(mixed, trust)
        found = compare(run, mixed, site.id)
        at_tag += run.counters
        fixes, moved, accepted = fixes + found.fixes, moved + found.moved, accepted + found.forged
        lost += found.refused
        wrong, again = admitted_by_anchor(site, keys, mixed, sent, at_anchor)
        by_anchor, repeated = by_anchor + wrong, repeated + again
        done += sum(not one.is_genuine for one in mixed)
        if sys.stderr.isatty():
            print(f"\r\033[K{done} of {asked.frames:.0f}", end="", file=sys.stderr, flush=True)
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr)
    print(f"{done} frames of an attacker, {fixes} verified fixes, {time.perf_counter() - begun_s:.0f} s")
    print(f"tag: {accepted} accepted, {moved} fixes moved, {lost} genuine frames refused")
    print(f"anchor: {by_anchor} admitted, and {repeated} repetitions")
    for name, counters in (("tag", at_tag), ("anchor", at_anchor)):
        print(f"{name}: " + ", ".join(f"{reason} {count}" for reason, count in counters.most_common()))
    return 1 if moved or accepted or by_anchor else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
