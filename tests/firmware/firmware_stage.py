"""What tests of the firmware share: its loop on this computer, on the chip's model in an air whose clock a test moves.

And boards for an emulated site.
"""

import re
from binascii import crc_hqx
from functools import cache, partial
from importlib.util import find_spec
from itertools import count

import pytest
from chip_stage import HandClock
from cobs import cobs
from emulator.board_library import CBoard, Processor
from emulator.build import FIRMWARE, HAS_ARM_COMPILER, HAS_HOST_COMPILER, build
from emulator.site.emulated_site import EmulatedSite
from emulator.site.host_board import HostBoard
from emulator.site.serial_wire import WireSettings
from emulator.site.virtual_time import run_on
from msgspec.structs import replace

from skyless.core.air.frame import Diagnostics, after_rmarker_s, fcs
from skyless.core.site import ScheduleSite
from skyless.core.ticks import TICK_RATE_HZ, from_seconds, wrap
from skyless.radio.interface import AntennaDelays
from skyless.radio.serial.link import decode
from skyless.sim.dw1000.chip import Chip
from skyless.sim.evaluation.scenarios import Request, trajectories_of
from skyless.sim.lab import paper_lab_site

DELAYS = AntennaDelays(16_500, 16_300)
TICKS_PER_US = TICK_RATE_HZ / 1e6
DEVICE_ID = b"identity"
SLOW_HZ, FAST_HZ = 2_000_000, 8_000_000

ASK_HELLO, CONFIG, TX_AT, RX_ON, ASK_STATUS = range(0x41, 0x46)
STACK_BYTES = int(re.search(r"^STACK_BYTES = (\d+);", (FIRMWARE / "dwm1001.ld").read_text("utf-8"), re.MULTILINE)[1])

needs_compiler = pytest.mark.skipif(not HAS_HOST_COMPILER, reason="make and gcc are not installed")
needs_processor = pytest.mark.skipif(
    not HAS_ARM_COMPILER or find_spec("unicorn") is None,
    reason="gcc-arm-none-eabi, make or the package unicorn is not installed",
)
HOST, IMAGE = pytest.param("host", marks=needs_compiler), pytest.param("image", marks=needs_processor)


def line_of(kind, body, number=0):
    """A line of the serial link, made by others: the package ``cobs`` and the standard library's CRC."""
    record = bytes((kind, number)) + body
    return cobs.encode(record + crc_hqx(record, 0xFFFF).to_bytes(2, "big")) + b"\0"


def frame_of(body):
    return bytes(body) + fcs(bytes(body))


class Bus(Processor):
    """Hardware on a model of the chip: transfers and pauses take time, the line is two buffers."""

    def __init__(self, air, chip):
        self.air, self.chip = air, chip
        self.hz = SLOW_HZ
        self.to_board, self.from_board = bytearray(), bytearray()
        self.restarts = 0
        self.room = 1 << 30
        self.advertised = []
        self.stuck = None
        """What the interrupt line shows whatever the chip does; None where it works."""
        self.present = True

    def transfer(self, out):
        self.air.pass_s(8 * len(out) / self.hz)
        return self.chip.transfer(out, self.hz) if self.present else bytes(len(out))

    def set_spi_fast(self, fast):
        self.hz = FAST_HZ if fast else SLOW_HZ

    def reset_chip(self):
        self.chip.pull_reset()

    def pause_us(self, microseconds):
        self.air.pass_s(1e-6 * microseconds)

    def now_us(self):
        return int(self.air.ticks / TICKS_PER_US)

    def interrupt_line(self):
        return (self.chip.irq and self.present) if self.stuck is None else self.stuck

    def read_line(self, size):
        data = bytes(self.to_board[:size])
        del self.to_board[:size]
        return data

    def write_line(self, line):
        if len(self.from_board) + len(line) > self.room:
            return False
        self.from_board += line
        return True

    def restart_line(self):
        self.restarts += 1
        self.to_board.clear()

    def sleep_for(self, milliseconds):
        self.air.pass_s(1e-3 * milliseconds)

    def advertise(self, data):
        self.advertised.append(data)
        return True


class BoardStage:
    """A board, its chip and a host that writes commands."""

    def __init__(self, *, ticks=10**12, **kind):
        self.air = HandClock(ticks)
        self.chip = Chip(self.air, DELAYS.tx_ticks, DELAYS.rx_ticks, self.air.now_s)
        self.bus = Bus(self.air, self.chip)
        self.board = CBoard(self.bus, **{"can_transmit": True, "device_id": DEVICE_ID} | kind)
        self._numbers = count()

    def send(self, kind, body=b""):
        self.bus.to_board += line_of(kind, body, next(self._numbers) & 0xFF)

    def ask(self, kind, body=b"", turns=8):
        """What the board says to a command."""
        self.send(kind, body)
        self.turn(turns)
        return self.reports()

    def config(self, flags=0):
        words = (128).to_bytes(2, "little"), *(d.to_bytes(2, "little") for d in (DELAYS.tx_ticks, DELAYS.rx_ticks))
        self.send(CONFIG, bytes((5, 64, 2, 9)) + b"".join(words) + bytes((flags,)))

    def tx_at(self, ahead_us, frame):
        """Ask for a frame; the tick of its RMARKER at the antenna."""
        dx = wrap(self.air.ticks + round(ahead_us * TICKS_PER_US))
        self.send(TX_AT, dx.to_bytes(5, "little") + frame)
        return wrap((dx & ~0x1FF) + DELAYS.tx_ticks)

    def turn(self, turns=1, step_us=5):
        """Let the board turn; between two turns time passes, and what waits for the air's clock happens."""
        for _ in range(turns):
            self.board.turn()
            self.air.pass_s(1e-6 * step_us)

    def pass_us(self, microseconds):
        """Turn as a board does that sleeps as long as it may: until its deadline, an interrupt, or a byte."""
        until = self.air.ticks + round(microseconds * TICKS_PER_US)
        while self.air.ticks < until:
            idle_us = self.board.turn()
            before = self.air.ticks
            while self.air.ticks < min(until, before + idle_us * TICKS_PER_US):
                self.air.pass_s(min(5e-6, 1e-6 * idle_us))
                if self.bus.interrupt_line() or self.bus.to_board:
                    break
            self.air.pass_s(1e-6)

    def reports(self):
        """Values of the records that the board has written since."""
        data = bytes(self.bus.from_board)
        self.bus.from_board.clear()
        assert not data or data[-1] == 0
        records = [cobs.decode(piece) for piece in data.split(b"\0") if piece]
        assert all(crc_hqx(record, 0xFFFF) == 0 for record in records)
        return [decode(record[:-2]) for record in records]

    def ready(self):
        """As a host finds it."""
        self.board.begin()
        self.config()
        self.send(RX_ON)
        self.turn(8)
        self.reports()
        return self

    def arrive(self, frame, *, fault=None, power_dbm=-80.0, phase_cycles=None):
        """A frame whose end is now; its RX stamp."""
        stamp = wrap(self.air.ticks - from_seconds(after_rmarker_s(len(frame))))
        told = Diagnostics(power_dbm, power_dbm - 3.0, 1.0)
        self.outcome = self.chip.receive(frame, stamp, told, fault, carrier_phase_cycles=phase_cycles)
        return stamp


# Whole sites


def site_of(kind, slot_ms, seed=1, trajectories=None, site=None, made=EmulatedSite):
    """A site of boards: the C on this computer, or the ARM image on an emulated processor.

    The host's C gets bytes in pieces, because each wakes its thread.
    """
    site = site or replace(paper_lab_site(), schedule=ScheduleSite(slot_s=1e-3 * slot_ms))
    paths = trajectories or trajectories_of(Request(site, seed=seed))
    return made(site, paths, boards(kind), seed=seed, wire=WireSettings(piece_bytes=64 if kind == "host" else 1))


@cache
def boards(kind):
    if kind == "host":
        return HostBoard
    from emulator.processor.nrf52832 import Image

    return partial(Image, elf=build("all"))


def play(site, script):
    """Run ``script(site)`` with everything started, until it ends."""

    async def whole():
        async with site:
            await script(site)

    run_on(site.medium.timeline, whole())
