"""A site on the firmware: frames in time, receptions that reach the hosts, errors. Emulated, in virtual time.

python benchmarks/firmware_site.py [--boards image|host] [--slot-ms 2.1 ...] [--seconds 5] [--seeds 4]
    [--anchors 7] [--usb] [--pauses] [--lead-ms 1.8 ...] [--room]

``image`` is the ARM image on an emulated nRF52832, ``host`` the same C compiled for this computer. The lab's six
anchors, a seventh in the middle of a short wall, and a tag that walks; the programs are those of ``skyless anchor`` and
``skyless tag``. The first second is not judged. ``--usb``: through a debugger's probe. ``--pauses``: hosts need time,
as a Raspberry Pi with CPython. ``--lead-ms``: anchors keep to this lead instead of adapting theirs. ``--room``: with a
real room's errors of survey and ranges, and a tag that wanders.
"""

import argparse
import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "firmware"))

import numpy as np
from emulator.build import build
from emulator.seat import MakeBoard
from emulator.site.emulated_site import EmulatedSite, SiteResult
from emulator.site.host_board import HostBoard
from emulator.site.host_programs import HostLatency
from emulator.site.serial_wire import WireSettings
from msgspec.structs import replace

from skyless.core.errors import SkylessError
from skyless.core.site import AnchorSite, ScheduleSite, Site
from skyless.run import anchor
from skyless.sim.compile_ahead import compile_kernels
from skyless.sim.evaluation.scenarios import Request, Room, trajectories_of
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.site.file.check import check_site

_WARMUP_S = 1.0


def make_boards(kind: str) -> MakeBoard:
    """What makes the boards of a site; the firmware is built."""
    if kind == "host":
        return HostBoard
    from emulator.processor.nrf52832 import Image  # noqa: PLC0415 - needs unicorn

    return partial(Image, elf=build("all"))


@contextlib.contextmanager
def fixed_lead(*, fixed: bool) -> Iterator[None]:
    """Let anchors not adapt their lead."""
    before = anchor.LEAD_GAIN, anchor.LEAD_LOSS
    if fixed:
        anchor.LEAD_GAIN, anchor.LEAD_LOSS = 1.0, 1.0  # type: ignore[misc]
    try:
        yield
    finally:
        anchor.LEAD_GAIN, anchor.LEAD_LOSS = before  # type: ignore[misc]


def lab_of(slot_ms: float, anchors: int, *, in_room: bool) -> Site:
    """The lab with this slot length and number of anchors."""
    lab = lab_site() if in_room else paper_lab_site()
    return replace(
        lab, anchors=(*lab.anchors, AnchorSite(7, 3.0, 0.0))[:anchors], schedule=ScheduleSite(slot_s=1e-3 * slot_ms)
    )


def site_of(
    lab: Site, make: MakeBoard, seed: int, wire: WireSettings, lead_ms: float | None, room: Room | None
) -> EmulatedSite:
    """The lab, and a tag that walks."""
    lead_s = None if lead_ms is None else 1e-3 * lead_ms
    paths = trajectories_of(Request(lab, seed=seed, room=room))
    return EmulatedSite(lab, paths, make, seed=seed, wire=wire, lead_s=lead_s, room=room)


def more_than(least: float, kind: type = float) -> Callable[[str], float]:
    """Reads an argument that must be a number above another."""

    def number(text: str) -> float:
        with contextlib.suppress(ValueError):
            value = kind(text)
            if least < value < math.inf:
                return value
        raise argparse.ArgumentTypeError(
            f"{text!r} should be {'an integer' if kind is int else 'a number'} above {least:g}"
        )

    return number


def row(slot_ms: float, lead_ms: float | None, results: list[SiteResult], wall_s: float) -> str:
    """A line of the table."""
    sent, late, slots, got, reported, fixes = (
        sum(getattr(result, name) for result in results)
        for name in ("sent", "late", "slots", "at_antennas", "reported", "fixes")
    )
    rms_m = np.sqrt(np.mean([result.rms_m**2 for result in results]))
    wrong = sum(result.wrong + sum(result.misused.values()) for result in results)
    lead = "as it adapts" if lead_ms is None else f"{lead_ms:g} ms"
    return (
        f"| {slot_ms:g} ms | {lead} | {100 * sent / max(slots, 1):.2f} % | {late} "
        f"| {100 * reported / max(got, 1):.2f} % | {100 * min(result.least_reported for result in results):.2f} % "
        f"| {wrong} | {fixes} | {100 * rms_m:.2f} cm | {wall_s:.0f} s |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--boards", choices=("image", "host"), default="image")
    parser.add_argument("--slot-ms", type=more_than(0), nargs="+", default=[2.1])
    parser.add_argument("--lead-ms", type=more_than(0), nargs="+", default=[None])
    parser.add_argument("--anchors", type=int, choices=(4, 5, 6, 7), default=7)
    parser.add_argument("--seconds", type=more_than(_WARMUP_S), default=5.0)
    parser.add_argument("--seeds", type=more_than(0, int), default=4)
    parser.add_argument("--usb", action="store_true")
    parser.add_argument("--pauses", action="store_true")
    parser.add_argument("--room", action="store_true")
    asked = parser.parse_args()
    for slot_ms in asked.slot_ms:
        try:
            check_site(lab_of(slot_ms, asked.anchors, in_room=asked.room), Path("the lab"))
        except SkylessError as error:
            parser.error(f"argument --slot-ms: {error}")
    compile_kernels()
    make = make_boards(asked.boards)
    pieces = 64 if asked.boards == "host" else 1
    wire = WireSettings(usb=asked.usb, host=HostLatency() if asked.pauses else None, piece_bytes=pieces)
    heads = "slot | lead | slots with a frame | late | reported | worst node | wrong | fixes | error | time"
    print(f"| {heads} |\n{'|---' * (heads.count('|') + 1)}|")
    for slot_ms in asked.slot_ms:
        lab = lab_of(slot_ms, asked.anchors, in_room=asked.room)
        for lead_ms in asked.lead_ms:
            results, begun_s = [], time.perf_counter()
            for seed in range(1, asked.seeds + 1):
                with fixed_lead(fixed=lead_ms is not None):
                    site = site_of(lab, make, seed, wire, lead_ms, Room() if asked.room else None)
                    site.run(asked.seconds)
                    results.append(site.result(_WARMUP_S))
            print(row(slot_ms, lead_ms, results, time.perf_counter() - begun_s), flush=True)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
