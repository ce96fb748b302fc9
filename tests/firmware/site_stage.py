"""Boards for an emulated site, and what tests ask of it."""

import asyncio
from functools import cache, partial
from importlib.util import find_spec

import pytest
from emulator.build import HAS_ARM_COMPILER, HAS_HOST_COMPILER, build
from emulator.site.emulated_site import EmulatedSite
from emulator.site.host_board import HostBoard
from emulator.site.serial_wire import WireSettings
from emulator.site.virtual_time import run_on
from msgspec.structs import replace

from skyless.core.site import ScheduleSite
from skyless.sim.evaluation.scenarios import Request, trajectories_of
from skyless.sim.lab import paper_lab_site

LAB = paper_lab_site()

HAS_ARM = HAS_ARM_COMPILER and find_spec("unicorn") is not None
HOST = pytest.param("host", marks=pytest.mark.skipif(not HAS_HOST_COMPILER, reason="make and gcc are not installed"))
IMAGE = pytest.param("image", marks=pytest.mark.skipif(not HAS_ARM, reason="gcc-arm-none-eabi or unicorn is missing"))
KINDS = [HOST, IMAGE]


@cache
def boards(kind):
    """What makes boards: the C on this computer, or the ARM image on an emulated processor."""
    if kind == "host":
        return HostBoard
    from emulator.processor.nrf52832 import Image

    return partial(Image, elf=build("all"))


def wire_of(kind):
    """The host's C gets bytes in pieces, because each wakes its thread."""
    return WireSettings(piece_bytes=64 if kind == "host" else 1)


def site_of(kind, slot_ms, seed=1, trajectories=None):
    lab = replace(LAB, schedule=ScheduleSite(slot_s=1e-3 * slot_ms))
    paths = trajectories or trajectories_of(Request(lab, seed=seed))
    return EmulatedSite(lab, paths, boards(kind), seed=seed, wire=wire_of(kind))


def play(site, script):
    """Run ``script(site)`` with everything started, until it ends."""

    async def whole():
        async with site:
            await script(site)

    run_on(site.medium.timeline, whole())


async def until(true, most_s=10.0):
    """Wait in virtual time."""
    async with asyncio.timeout(most_s):
        while not true():
            await asyncio.sleep(5e-3)
