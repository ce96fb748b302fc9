"""What authentication costs where nobody attacks: accuracy, time to the first verified fix, processor time. Simulated.

    python benchmarks/trusted_site.py [--room] [--seeds 6] [--seconds 8] [--json]

The lab with keys and without, the same tag that walks, several seeds: root mean square of the horizontal errors after
the first second, and the ratio. Codes make frames longer, certificates take the place of relays. The receiver is the
plain one at both. Then how long after switching on the first verified fix is there, without any certificate and with
those of an earlier run, at the lab and at a sparse site (three anchors of 8 beacons a second, half of them lost):
median and largest of several instants. Last the processor time of a beacon: decoding, and verification alone.
"""

import argparse
import json
import sys
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
from forged_beacons import KEYS_BEGIN_S, site_of
from msgspec.structs import replace

from skyless.core.air.beacon import Beacon, decode
from skyless.core.any_receiver import AnyReceiver
from skyless.core.keys.chain import public_key
from skyless.core.keys.verifier import Verifier
from skyless.core.site import ScheduleSite, Site
from skyless.core.trusted_receiver import SiteTrust, Trust
from skyless.sim.compile_ahead import compile_kernels
from skyless.sim.evaluation.scenarios import Request, Room
from support.keyed_air import START_UNIX_S, AttackedAir, MadeKeys, Received, made_keys, run_tag

WARMUP_S = 1.0
STARTS = 12
NO_KEYS = MadeKeys(b"", ())
NOISE_OF_TIMES = 5


def rms_m(received: list[Received], site: int) -> float:
    """Of the plain receiver's fixes."""
    receiver, squares = AnyReceiver(site=site), []
    for one in received:
        fix = receiver.hear(one.reception)
        if fix is not None and (one.reception.host_s or 0.0) > WARMUP_S:
            squares.append(np.sum((fix.position_m - one.position_m)[:2] ** 2))
    return float(np.sqrt(np.mean(squares)))


def sparse_site() -> Site:
    """Three anchors, 8 beacons a second each."""
    site = site_of("free", in_room=False)
    return replace(site, anchors=site.anchors[::2], schedule=ScheduleSite(mode="free", rate_hz=8.0))


def first_fixes_s(site: Site, keys: MadeKeys, request: Request, *, warm: bool) -> list[float | None]:
    """From switching on to the first verified fix, from several instants on."""
    tape = list(AttackedAir(request, keys).run(16.0))
    trust = SiteTrust(site.id, keys.public, trust=Trust.VERIFIED)
    beacons = [beacon for one in tape if isinstance(beacon := decode(one.reception.frame), Beacon)]
    certificates = tuple({one.certificate: None for one in beacons if one.certificate is not None}) if warm else ()
    found: list[float | None] = []
    for start_s in np.linspace(1.0, 8.0, STARTS).tolist():
        later = [one for one in tape if start_s < (one.reception.host_s or 0.0) < start_s + 8.0]
        given = run_tag(later, trust, certificates).given
        found.append(given[0].given_s - start_s if given else None)
    return found


def costs_us(tape: list[Received], site: int, public: bytes) -> tuple[float, float]:
    """Processor time of decoding a beacon, and of verifying it: the least of some runs."""
    decoding, verifying = [], []
    for _ in range(NOISE_OF_TIMES):
        begun_s = time.process_time()
        beacons = [decode(one.reception.frame) for one in tape]
        decoding.append(time.process_time() - begun_s)
        verifier = Verifier(site, public_key(public), 0.1, Counter())
        pairs = [
            (beacon, one.reception) for beacon, one in zip(beacons, tape, strict=True) if isinstance(beacon, Beacon)
        ]
        begun_s = time.process_time()
        for beacon, reception in pairs:
            verifier.add(beacon, reception, START_UNIX_S + (reception.host_s or 0.0))
            verifier.decided()
        verifying.append(time.process_time() - begun_s)
    return 1e6 * min(decoding) / len(tape), 1e6 * min(verifying) / len(tape)


def described(times_s: list[float | None]) -> str:
    """Median and largest."""
    present = [one for one in times_s if one is not None]
    missing = f", {len(times_s) - len(present)} of {len(times_s)} without" if len(present) < len(times_s) else ""
    return f"{np.median(present):.2f} s, {max(present):.2f} s{missing}" if present else "none"


def main() -> None:
    """Print all of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--room", action="store_true", help="with a real room's errors of survey and ranges")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--json", action="store_true", help="a JSON object for each line")
    asked = parser.parse_args()
    if asked.seeds < 1 or not asked.seconds > WARMUP_S:
        parser.error(f"argument --seeds should be 1 or more, --seconds more than {WARMUP_S:g}")
    compile_kernels()
    room = Room() if asked.room else None
    site = site_of(in_room=asked.room)
    keys = made_keys(site.id, KEYS_BEGIN_S)
    pairs, tape = [], []
    for seed in range(1, asked.seeds + 1):
        request = Request(site, seed=seed, room=room)
        without = list(AttackedAir(request, NO_KEYS).run(asked.seconds))
        tape = list(AttackedAir(request, keys).run(asked.seconds))
        pairs.append((rms_m(tape, site.id), rms_m(without, site.id)))
    errors = np.sqrt(np.mean(np.square(pairs), axis=0))
    ratios = [one / other for one, other in pairs]
    decoding_us, verifying_us = costs_us(tape, site.id, keys.public)
    show(
        asked.json,
        f"lab: {100 * errors[0]:.2f} cm with keys, {100 * errors[1]:.2f} cm without, ratio "
        f"{errors[0] / errors[1]:.3f} (seeds {min(ratios):.3f} to {max(ratios):.3f}); a beacon is decoded in "
        f"{decoding_us:.1f} µs and verified in {verifying_us:.1f} µs",
        rms_m=errors[0], rms_without_m=errors[1], ratios=ratios, decoding_us=decoding_us,
        verifying_us=verifying_us,
    )  # fmt: skip
    for name, each, request in (
        ("lab", site, Request(site, seed=1, room=room)),
        ("sparse", sparse_site(), Request(sparse_site(), seed=1, loss=0.5)),
    ):
        for warm in (False, True):
            times_s = first_fixes_s(each, keys, request, warm=warm)
            with_or_without = "with certificates of an earlier run" if warm else "without any certificate"
            show(
                asked.json,
                f"{name}: first verified fix {with_or_without} after {described(times_s)} (median, largest)",
                site=name, warm=warm, first_s=times_s,
            )  # fmt: skip


def show(as_json: bool, line: str, **values: object) -> None:
    """Print a line, or its values."""
    print(json.dumps(values) if as_json else line, flush=True)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
