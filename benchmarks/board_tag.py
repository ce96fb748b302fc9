"""A tag that is only a board, on the emulated processor: how busy it is, what it loses, and what it draws with sleep.

    python benchmarks/board_tag.py [--seeds 1 2 3] [--seconds 5] [--fixes 30] [--only awake|asleep]

The ARM image on an emulated nRF52832 with the register model of the DW1000, among simulated anchors of protocol 2
that send at random instants, in a room with errors of survey and ranges. Awake: after the first second; "lost" is
what reached the antenna and not the estimator; errors are against the truth at the beacon of the fix. Asleep: the
processor's crystals are 15 ppm off, that of the chip jumps by 1 ppm (one sigma) at each wake; charge is that of a
module with 134 mA receiving, 18 mA idle and 10 µA asleep, which nobody has measured with this firmware; months are
those of 1,500 mAh (CR123A) and 3,000 mAh (18650) without losses of their own. Nothing of this has run on a board.
"""

import argparse
import sys
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "firmware"))

import numpy as np
from emulator.build import build
from emulator.processor.nrf52832 import Image
from emulator.site.tag_world import TagWorld
from msgspec.structs import replace

from skyless.core.site import AnchorSite, ScheduleSite
from skyless.radio.serial.board_settings import BoardSettings
from skyless.radio.serial.link import Reader, decode
from skyless.radio.tag_reports import BoardFix, BoardStatus
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.evaluation.scenarios import Request, Room, impairments_of, trajectories_of
from skyless.sim.lab import lab_site

AWAKE = (
    ("6 anchors, 400 beacons/s, NMEA 50 Hz", 6, None, {"output": 1, "rate_hz": 50}),
    ("6 anchors, 400 beacons/s, each fix as a record", 6, None, {}),
    ("6 anchors, 400 beacons/s, at predicted instants", 6, None, {"predicts": 1}),
    ("6 anchors, 100 beacons/s", 6, 100.0, {}),
    ("12 anchors, 476 beacons/s", 12, None, {}),
)
ASLEEP = [(sleep_s, superframes, predicts) for sleep_s in (1, 10) for superframes, predicts in ((2, 0), (2, 1), (3, 1))]
CLOCK_PPM = 15.0
JUMP_PPM = 1.0
CELLS_C = {"CR123A": 1.5 * 3600, "18650": 3.0 * 3600}
MONTH_S = 30.4 * 86400
WARMUP_S = 1.0


def site_of(anchors, beacons_hz):
    """The lab with more anchors on its walls."""
    lab = lab_site()
    more = [AnchorSite(7 + k, x, y) for k, (x, y) in enumerate([(3, 0), (3, 8), (0, 2), (6, 2), (0, 6), (6, 6)])]
    schedule = ScheduleSite(mode="free", rate_hz=None if beacons_hz is None else beacons_hz / anchors)
    return replace(lab, anchors=(*lab.anchors, *more)[:anchors], schedule=schedule)


class Run:
    """One board and what came of it."""

    def __init__(self, seed, site, **settings):
        request = Request(site, seed=seed, room=Room())
        world = world_of(site, trajectories_of(request), replace(impairments_of(request, site), diagnostics=True), seed)
        make, given = partial(Image, elf=build("all"), clock_ppm=CLOCK_PPM), BoardSettings(mode=1, **settings)
        self.fixes, self.status, self._reader = [], None, Reader()
        self.world = TagWorld(world, 1, make, self._said, given, JUMP_PPM)
        self.tag = self.world.tags[0]

    def _said(self, _tag, now_s, data):
        for record in self._reader.read(data):
            found = decode(record)
            if isinstance(found, BoardFix):
                error_m = (found.fix.position_m - self.tag.truth_m)[:2]
                nees = error_m @ np.linalg.solve(found.fix.covariance_m2[:2, :2], error_m) / 2
                self.fixes.append((now_s, error_m @ error_m, nees))
            elif isinstance(found, BoardStatus):
                self.status = found.counters

    def go(self, until_s):
        for _ in self.world.run(until_s):
            pass

    def figures(self, since_s):
        fixes = np.array([one for one in self.fixes if one[0] >= since_s]).reshape(-1, 3)
        return len(fixes), fixes[:, 1].sum(), fixes[:, 2].sum()


def awake(seeds, seconds):
    print("| always on | received a second | lost | dropped by overload | busy | RMSE | NEES per dimension |")
    print("|---|---|---|---|---|---|---|")
    for name, anchors, beacons_hz, settings in AWAKE:
        heard = missed = overload = busy = 0.0
        sums = np.zeros(3)
        for seed in seeds:
            run = Run(seed, site_of(anchors, beacons_hz), **{"output": 0, "rate_hz": 0, **settings})
            run.go(WARMUP_S)
            before, busy_s = dict(run.tag.chip.arrivals), WARMUP_S * run.tag.board.busy_share
            run.go(WARMUP_S + seconds)
            gone = {key: count - before.get(key, 0) for key, count in run.tag.chip.arrivals.items()}
            heard += gone.pop("heard")
            missed += sum(gone.values())
            overload += 0 if run.status is None else run.status["overload"]
            busy += ((WARMUP_S + seconds) * run.tag.board.busy_share - busy_s) / seconds / len(seeds)
            sums += run.figures(WARMUP_S)
            assert not +run.tag.board.misuse + run.tag.chip.misuse
        fixes = "- | -" if sums[0] == 0 else f"{100 * (sums[1] / sums[0]) ** 0.5:.2f} cm | {sums[2] / sums[0]:.2f}"
        print(f"| {name} | {heard / seconds / len(seeds):.0f} | {100 * missed / (heard + missed):.1f} % "
              f"| {overload / seconds / len(seeds):.0f}/s | {100 * busy:.0f} % | {fixes} |", flush=True)  # fmt: skip


def asleep(seeds, fixes):
    print("| sleep | each anchor | receiver | RMSE | NEES per dimension | receiver on, a fix | charge, a fix | mean "
          "| CR123A | 18650 |\n|---|---|---|---|---|---|---|---|---|---|")  # fmt: skip
    for sleep_s, superframes, predicts in ASLEEP:
        sums, on_s, charge_c, took_s = np.zeros(3), 0.0, 0.0, 0.0
        for seed in seeds:
            settings = {"sleep_ms": 1000 * sleep_s, "superframes": superframes, "predicts": predicts}
            run = Run(seed, site_of(6, None), **settings)
            since_s = 5.0 + 2.5 * sleep_s  # what sets a board up keeps it awake for 5 s
            run.go(since_s)
            before = run.tag.chip.receiving_s, run.tag.chip.charge_c
            until_s = since_s + fixes * (sleep_s + 0.08)
            run.go(until_s)
            sums += run.figures(since_s)
            on_s += run.tag.chip.receiving_s - before[0]
            charge_c += run.tag.chip.charge_c - before[1]
            took_s += until_s - since_s
        mean_a = charge_c / took_s
        months = " | ".join(f"{capacity_c / mean_a / MONTH_S:.1f} months" for capacity_c in CELLS_C.values())
        print(f"| {sleep_s} s | {superframes} x | {'at predicted instants' if predicts else 'on throughout'} "
              f"| {100 * (sums[1] / sums[0]) ** 0.5:.1f} cm | {sums[2] / sums[0]:.2f} | {1e3 * on_s / sums[0]:.1f} ms "
              f"| {1e3 * charge_c / sums[0]:.2f} mC | {1e3 * mean_a:.2f} mA | {months} |", flush=True)  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--fixes", type=int, default=30, help="of each seed")
    parser.add_argument("--only", choices=("awake", "asleep"))
    asked = parser.parse_args()
    if asked.only != "asleep":
        awake(asked.seeds, asked.seconds)
    if asked.only != "awake":
        asleep(asked.seeds, asked.fixes)


if __name__ == "__main__":
    main()
