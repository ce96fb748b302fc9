"""A processor with a chip that runs a small program, or the firmware, in an air of its own."""

import subprocess
from importlib.util import find_spec
from pathlib import Path

import pytest
from build import FIRMWARE, HAS_ARM_COMPILER

from skyless.constants import TICK_RATE_HZ
from skyless.radios.interface import AntennaDelays
from skyless.simulation.dw1000.chip import Chip
from skyless.simulation.medium import Timeline
from skyless.ticks import from_seconds, wrap

DELAYS = AntennaDelays(16_500, 16_300)
IDENTITY = b"identity"

needs_processor = pytest.mark.skipif(
    not HAS_ARM_COMPILER or find_spec("unicorn") is None,
    reason="gcc-arm-none-eabi, make or the package unicorn is not installed",
)


def build_program(folder, program, **macros):
    """An ELF file of tests/firmware/processor_programs.c."""
    elf = folder / f"{program}-{abs(hash(frozenset(macros.items()))):x}.elf"
    definitions = [f"-D{name}={value}" for name, value in {"PROGRAM": program, **macros}.items()]
    flags = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=soft", "-O2", "-ffreestanding", "-nostdlib", "-w"]
    paths = ["-I", FIRMWARE / "source", "-T", FIRMWARE / "dwm1001.ld"]
    program_file = Path(__file__).with_name("processor_programs.c")
    subprocess.run(["arm-none-eabi-gcc", *flags, *definitions, *paths, program_file, "-o", elf], check=True)
    return elf


class LoneAir:
    """An air with one antenna, whose counter is true time."""

    def __init__(self):
        self.timeline = Timeline()
        self.sent = []

    def now_ticks(self):
        return wrap(self.timeline.now_ticks)

    def now_s(self):
        return self.timeline.now_ticks / TICK_RATE_HZ

    def transmit(self, frame, leaves_ticks):
        self.sent.append((frame, leaves_ticks))
        return True

    def withdraw(self):
        self.sent.pop()


class Stage:
    """One image on a line of 1 Mbaud."""

    def __init__(self, elf, *, can_transmit=True, clock_ppm=0.0):
        from nrf52832 import Image

        self.air = LoneAir()
        self.timeline = self.air.timeline
        self.chip = Chip(self.air, DELAYS.tx_ticks, DELAYS.rx_ticks, self.air.now_s)
        self.lines = []
        """What has come, with its time in µs."""
        self.image = Image(
            self.timeline,
            self.chip,
            lambda data: self.lines.append((1e6 * self.air.now_s(), data)),
            elf=elf,
            can_transmit=can_transmit,
            identity=IDENTITY,
            clock_ppm=clock_ppm,
        )

    @property
    def sent(self):
        """All bytes that have come."""
        return b"".join(data for _, data in self.lines)

    def run(self, seconds):
        """Let time pass."""
        for _ in self.timeline.run(self.timeline.now_ticks + from_seconds(seconds)):
            pass

    def write(self, data, gap_s=10e-6):
        """Bytes that arrive one after the other from now on; when the last has, in µs."""
        for at, byte in enumerate(data):
            ticks = self.timeline.now_ticks + from_seconds((at + 1) * gap_s)
            self.timeline.at(ticks, lambda one=bytes((byte,)): self.image.receive(one))
        return 1e6 * (self.air.now_s() + len(data) * gap_s)
