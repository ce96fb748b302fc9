"""The firmware's image on an emulated nRF52832 with the register model of the DW1000. None of it has run on a board.

    python benchmarks/firmware.py site [--slot-ms 2.1 …] [--lead-ms 1.8 …] [--usb] [--pauses] [--room] [--boards host]
    python benchmarks/firmware.py tag [--seeds 3] [--seconds 5] [--fixes 30] [--only awake|asleep]
    python benchmarks/firmware.py cycles [--write]

``site``: the lab's anchors and a tag that walks, behind pseudo-terminals, with the programs of ``skyless anchor`` and
``skyless tag`` on the other side; the first second is not judged. ``--boards host`` takes the same C compiled for this
computer; ``--usb``: through a debugger's probe; ``--pauses``: hosts need time, as a Raspberry Pi with CPython;
``--lead-ms``: anchors keep to this lead instead of adapting theirs; ``--room``: with a real room's errors.

``tag``: a board that is a tag by itself, in a room with errors, among anchors that send at random instants. "Lost" is
what reached the antenna and not the estimator. Asleep, the processor's crystals are 15 ppm off, and that of the chip
jumps by 1 ppm (one sigma) at each wake; charge is that of 134 mA receiving, 18 mA idle and 10 µA asleep.

``cycles``: what each path takes; ``--write`` puts the table into docs/hardware.md.
"""

import argparse
import re
import sys
from functools import partial
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "firmware"))

import numpy as np
from emulator.build import build
from emulator.processor.cycle_table import cycle_table
from emulator.processor.nrf52832 import Image
from emulator.site.emulated_site import EmulatedSite
from emulator.site.host_board import HostBoard
from emulator.site.host_programs import HostLatency
from emulator.site.serial_wire import WireSettings
from emulator.site.tag_world import TagWorld
from msgspec.structs import replace

from skyless.core.site import AnchorSite, ScheduleSite
from skyless.radio.serial.link import BoardSettings, Reader, decode
from skyless.radio.tag_reports import BoardFix, BoardStatus
from skyless.run import anchor
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.evaluation.scenarios import Request, Room, impairments_of, trajectories_of
from skyless.sim.lab import lab_site, paper_lab_site

PAGE = Path(__file__).parents[1] / "docs" / "hardware.md"
PLACE = re.compile(r"(<!-- cycles: benchmarks/firmware.py cycles --write -->\n).*?(<!-- end -->)", re.DOTALL)
AWAKE = (
    ("6 anchors, 400 beacons/s, NMEA 50 Hz", 6, None, {"output": 1, "rate_hz": 50}),
    ("6 anchors, 400 beacons/s, each fix as a record", 6, None, {}),
    ("6 anchors, 400 beacons/s, at predicted instants", 6, None, {"predicts": 1}),
    ("6 anchors, 100 beacons/s", 6, 100.0, {}),
    ("12 anchors, 476 beacons/s", 12, None, {}),
)
ASLEEP = [(sleep_s, superframes, predicts) for sleep_s in (1, 10) for superframes, predicts in ((2, 0), (2, 1), (3, 1))]
WARMUP_S, AWAKE_S = 1.0, 5.0
"""AWAKE_S: after a start."""


def heads(text):
    print(f"| {text} |\n{'|---' * (text.count('|') + 1)}|", flush=True)


def site(asked):
    make = HostBoard if asked.boards == "host" else partial(Image, elf=build("all"))
    wire = WireSettings(
        usb=asked.usb, host=HostLatency() if asked.pauses else None, piece_bytes=64 if asked.boards == "host" else 1
    )
    heads("slot | lead | slots with a frame | late | reported | worst node | wrong | fixes | error")
    lab, room = (lab_site(), Room()) if asked.room else (paper_lab_site(), None)
    for slot_ms in asked.slot_ms:
        schedule = ScheduleSite(slot_s=1e-3 * slot_ms)
        own = replace(lab, anchors=(*lab.anchors, AnchorSite(7, 3.0, 0.0))[: asked.anchors], schedule=schedule)
        for lead_ms in asked.lead_ms:
            if lead_ms is not None:
                anchor.LEAD_GAIN, anchor.LEAD_LOSS = 1.0, 1.0
            results = []
            for seed in range(1, asked.seeds + 1):
                paths = trajectories_of(Request(own, seed=seed, room=room))
                lead_s = None if lead_ms is None else 1e-3 * lead_ms
                running = EmulatedSite(own, paths, make, seed=seed, wire=wire, lead_s=lead_s, room=room)
                running.run(asked.seconds)
                results.append(running.result(WARMUP_S))
            sent, late, slots, got, reported, fixes = (
                sum(getattr(one, name) for one in results)
                for name in ("sent", "late", "slots", "at_antennas", "reported", "fixes")
            )
            rms_m = np.sqrt(np.mean([one.rms_m**2 for one in results]))
            wrong = sum(one.wrong + sum(one.misused.values()) for one in results)
            print(
                f"| {slot_ms:g} ms | {'adapts' if lead_ms is None else f'{lead_ms:g} ms'} "
                f"| {100 * sent / max(slots, 1):.2f} % | {late} | {100 * reported / max(got, 1):.2f} % "
                f"| {100 * min(one.least_reported for one in results):.2f} % | {wrong} | {fixes} "
                f"| {100 * rms_m:.2f} cm |",
                flush=True,
            )


class Run:
    """One board that is a tag, and what came of it."""

    def __init__(self, seed, anchors, beacons_hz, **settings):
        lab = lab_site()
        more = [AnchorSite(7 + k, x, y) for k, (x, y) in enumerate([(3, 0), (3, 8), (0, 2), (6, 2), (0, 6), (6, 6)])]
        schedule = ScheduleSite(mode="free", rate_hz=None if beacons_hz is None else beacons_hz / anchors)
        site = replace(lab, anchors=(*lab.anchors, *more)[:anchors], schedule=schedule)
        request = Request(site, seed=seed, room=Room())
        world = world_of(site, trajectories_of(request), replace(impairments_of(request, site), diagnostics=True), seed)
        make, given = partial(Image, elf=build("all"), clock_ppm=15.0), BoardSettings(mode=1, **settings)
        self.fixes, self.status, self._reader = [], None, Reader()
        self.tag = TagWorld(world, make, self._said, given, 1.0)

    def _said(self, now_s, data):
        for record in self._reader.read(data):
            found = decode(record)
            if isinstance(found, BoardFix):
                error_m = (found.fix.position_m - self.tag.truth_m)[:2]
                nees = error_m @ np.linalg.solve(found.fix.covariance_m2[:2, :2], error_m) / 2
                self.fixes.append((now_s, error_m @ error_m, nees))
            elif isinstance(found, BoardStatus):
                self.status = found.counters

    def sums(self, since_s):
        """Count, squared errors and NEES."""
        fixes = np.array([one for one in self.fixes if one[0] >= since_s]).reshape(-1, 3)
        return np.array([len(fixes), fixes[:, 1].sum(), fixes[:, 2].sum()])


def awake(seeds, seconds):
    heads("always on | received a second | lost | dropped by overload | busy | RMSE | NEES per dimension")
    for name, anchors, beacons_hz, settings in AWAKE:
        heard = missed = overload = busy = 0.0
        sums = np.zeros(3)
        for seed in range(1, seeds + 1):
            run = Run(seed, anchors, beacons_hz, **{"output": 0, "rate_hz": 0, **settings})
            run.tag.run(WARMUP_S)
            before, busy_s = dict(run.tag.chip.arrivals), WARMUP_S * run.tag.board.busy_share
            run.tag.run(WARMUP_S + seconds)
            gone = {key: count - before.get(key, 0) for key, count in run.tag.chip.arrivals.items()}
            heard, missed = heard + gone.pop("heard"), missed + sum(gone.values())
            overload += 0 if run.status is None else run.status["overload"]
            busy += ((WARMUP_S + seconds) * run.tag.board.busy_share - busy_s) / seconds / seeds
            sums += run.sums(WARMUP_S)
            assert not +run.tag.board.misuse + run.tag.chip.misuse
        fixes = "- | -" if sums[0] == 0 else f"{100 * (sums[1] / sums[0]) ** 0.5:.2f} cm | {sums[2] / sums[0]:.2f}"
        print(f"| {name} | {heard / seconds / seeds:.0f} | {100 * missed / (heard + missed):.1f} % "
              f"| {overload / seconds / seeds:.0f}/s | {100 * busy:.0f} % | {fixes} |", flush=True)  # fmt: skip


def asleep(seeds, fixes):
    heads("sleep | each anchor | receiver | RMSE | NEES per dimension | receiver on, a fix | charge, a fix | mean")
    for sleep_s, superframes, predicts in ASLEEP:
        sums, on_s, charge_c, took_s = np.zeros(3), 0.0, 0.0, 0.0
        for seed in range(1, seeds + 1):
            run = Run(seed, 6, None, sleep_ms=1000 * sleep_s, superframes=superframes, predicts=predicts)
            since_s = AWAKE_S + 2.5 * sleep_s
            run.tag.run(since_s)
            before = run.tag.chip.receiving_s, run.tag.chip.charge_c
            until_s = since_s + fixes * (sleep_s + 0.08)
            run.tag.run(until_s)
            sums, took_s = sums + run.sums(since_s), took_s + until_s - since_s
            on_s += run.tag.chip.receiving_s - before[0]
            charge_c += run.tag.chip.charge_c - before[1]
        print(f"| {sleep_s} s | {superframes} x | {'at predicted instants' if predicts else 'on throughout'} "
              f"| {100 * (sums[1] / sums[0]) ** 0.5:.1f} cm | {sums[2] / sums[0]:.2f} | {1e3 * on_s / sums[0]:.1f} ms "
              f"| {1e3 * charge_c / sums[0]:.2f} mC | {1e3 * charge_c / took_s:.2f} mA |", flush=True)  # fmt: skip


def tag(asked):
    if asked.only != "asleep":
        awake(asked.seeds, asked.seconds)
    if asked.only != "awake":
        asleep(asked.seeds, asked.fixes)


def cycles(asked):
    table = cycle_table(build("all"))
    print(table, end="")
    if asked.write:
        text, count = PLACE.subn(lambda place: f"{place[1]}\n{table}\n{place[2]}", PAGE.read_text("utf-8"))
        if count != 1:
            sys.exit(f"{PAGE} should have one place for the table, and has {count}")
        PAGE.write_text(text, "utf-8")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("site", "tag", "cycles"))
    parser.add_argument("--boards", choices=("image", "host"), default="image")
    parser.add_argument("--slot-ms", type=float, nargs="+", default=[2.1])
    parser.add_argument("--lead-ms", type=float, nargs="+", default=[None])
    parser.add_argument("--anchors", type=int, choices=(4, 5, 6, 7), default=7)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--fixes", type=int, default=30, help="of each seed of a tag that sleeps")
    parser.add_argument("--only", choices=("awake", "asleep"))
    parser.add_argument("--write", action="store_true")
    for name in ("--usb", "--pauses", "--room"):
        parser.add_argument(name, action="store_true")
    asked = parser.parse_args()
    {"site": site, "tag": tag, "cycles": cycles}[asked.part](asked)


if __name__ == "__main__":
    main()
