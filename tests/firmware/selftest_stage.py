"""Two boards that run the firmware's C in virtual time, 1.5 m apart, with planted faults; and their self-test."""

import math
import os
import random
import termios
from functools import partial

from emulator.build import build
from emulator.site.emulated_site import EmulatedSite
from emulator.site.host_board import HostBoard
from emulator.site.serial_wire import WireSettings
from emulator.site.virtual_time import run_on
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.ticks import TICK_S
from skyless.radio.serial.link import BoardSettings, pack
from skyless.run.selftest.facts import judge
from skyless.run.selftest.measure import Amounts, Bench, measure, report_of
from skyless.sim.dw1000 import registers as r
from skyless.sim.dw1000.chip import Sensors
from skyless.sim.lab import paper_lab_site

FEW = Amounts(records=8, readings=40, alone_frames=10, alone_s=0.3, pair_s=1.5)
DISTANCE_M = 1.5
FACTS = (0x52832, 0x41414530, 0x50, 21, 0xFFFFFFFF, 12_288, 6_100)
RATES = {getattr(termios, f"B{baud}"): baud for baud in (115_200, 230_400, 460_800, 1_000_000)}
TRANSFER_S = 12e-6
"""What each transfer to the chip takes on the processor besides its bits: with that a reception takes 275 µs."""


class Fault(Struct, frozen=True, kw_only=True):
    """What is wrong with board A, or with the air; nothing by default."""

    carries: int = 1_000_000
    """Highest rate that the ports carry."""
    baud: int = 460_800
    tag: bool = False
    """It is a tag that sleeps and writes JSON."""
    facts: tuple[int, ...] = FACTS
    cause: int = 0
    slow_hz: float = 32_768.0
    processor_ppm: float = 0.0
    chip: str = ""
    sensors: Sensors = Sensors()
    transfer_s: float = TRANSFER_S
    lost: float = 0.0
    weaker_db: float = 0.0
    crystals_ppm: float | None = None
    """Of the boards' crystals, A too fast and B too slow; None: within 10 ppm."""
    offset_bias_ppm: float = 0.0
    stamp_ps: float = 100.0
    delay_ticks: int = 0


class FaultyBoard(HostBoard):
    """A board whose processor and line have faults."""

    def __init__(self, seat, fault, generator):
        self.fault, self.random = fault, generator
        self.ppm = fault.processor_ppm + generator.uniform(-25.0, 25.0)
        self.slow_hz = fault.slow_hz * (1.0 + 1e-6 * generator.uniform(-60.0, 60.0))
        self.baud = 0
        self.reset_cause = fault.cause
        self.settings = pack(BoardSettings(baud=fault.baud, mode=fault.tag, output=2, sleep_ms=5000)) + b"\0\0"
        super().__init__(seat)

    def now_us(self):
        return int(super().now_us() * (1.0 + 1e-6 * self.ppm))

    def transfer(self, out):
        self.process.sleep(self.fault.transfer_s)
        answer = super().transfer(out)
        if self.fault.chip == "spi" and self._hz > 3e6 and out[0] in (0x00, 0x03) and self.random.random() < 0.2:
            answer = answer[:-1] + bytes((answer[-1] ^ 1,))
        if self.fault.chip == "stamp" and out[0] == 0x17:
            answer = answer[:2] + bytes((answer[2] + 2 & 0xFF,)) + answer[3:]
        return answer

    def probe(self, item):
        if item < len(self.fault.facts):
            return self.fault.facts[item]
        return int(self._timeline.now_ticks * TICK_S * self.slow_hz) & 0xFFFFFF

    def set_rate(self, baud):
        """After what waits has left."""
        self.process.sleep(max(self._unsent_ticks - self._timeline.now_ticks, 0) * TICK_S + 1e-6)
        self.baud, self.byte_s = baud, 10.0 / baud

    def noise(self, wire):
        """What becomes of bytes on the line: nothing where the rates differ, and some are damaged above its limit."""

        def change(data):
            port = os.open(wire.path, os.O_RDWR | os.O_NOCTTY)
            rate = RATES.get(termios.tcgetattr(port)[4])
            os.close(port)
            if rate != self.baud:
                return b""
            if self.baud > self.fault.carries:
                return bytes(byte ^ (0x10 if self.random.random() < 0.01 else 0) for byte in data)
            return data

        return change


class Pair(EmulatedSite):
    """Both boards without programs; the first has the fault."""

    def __init__(self, fault=None, seed=1, boards=2, image=False, other=None):
        self.fault, self.random = fault or Fault(), random.Random(seed)
        lab = paper_lab_site()
        delays = [16_436 + self.fault.delay_ticks + round(self.random.gauss(0.0, 40.0)) for _ in range(4)]
        anchors = tuple(
            replace(
                lab.anchors[n], x_m=DISTANCE_M * n, y_m=0.0, z_m=1.0,
                tx_antenna_delay_ticks=delays[2 * n], rx_antenna_delay_ticks=delays[2 * n + 1],
            )
            for n in range(2)
        )  # fmt: skip
        noise = replace(lab.noise, tx_stamp_ps=self.fault.stamp_ps, rx_stamp_ps=self.fault.stamp_ps)
        faults = self.fault, other or Fault()
        self.faults, self.image, self.boards = iter(faults), image, boards
        site, wire = replace(lab, anchors=anchors, noise=noise), WireSettings(piece_bytes=128)
        super().__init__(site, [], self.make, seed=seed, wire=wire)
        if self.fault.crystals_ppm is not None:
            for clock, sign in zip(self.medium.clocks, (1.0, -1.0), strict=True):
                clock.rate = sign * 1e-6 * self.fault.crystals_ppm
        for node, fault in zip(self.nodes, faults, strict=True):
            node.chip.absent = fault.chip == "absent"
            if fault.chip == "no lock":
                node.chip.clocking.restart = lambda clocking=node.chip.clocking: setattr(clocking, "_lock_s", math.inf)
            node.chip.clocking.sensors = replace(
                fault.sensors,
                temperature_c=fault.sensors.temperature_c + self.random.uniform(-5.0, 5.0),
                supply_v=fault.sensors.supply_v + self.random.uniform(-0.1, 0.1),
            )
            node.chip.receive = partial(self.hear, node.chip.receive, node.air.node)
            if image:
                continue
            node.wire.noise_to_host = node.wire.noise_to_board = node.board.noise(node.wire)

    def make(self, seat):
        if self.image:
            from emulator.processor.nrf52832 import Image

            return Image(seat, elf=build("all"), baud=None)
        return FaultyBoard(seat, next(self.faults), random.Random(self.random.random()))

    def start_host(self, node):
        """There are no programs."""

    def hear(self, receive, number, frame, rx_ticks, measured, fault, **more):
        """A frame at a board's antenna."""
        asked, is_b = self.fault, number == 1
        offset_ppm = measured.carrier_offset_ppm + asked.offset_bias_ppm * is_b
        power_dbm = measured.rx_power_dbm - asked.weaker_db * is_b
        if not (is_b and self.random.random() < asked.lost):
            found = replace(measured, rx_power_dbm=power_dbm, carrier_offset_ppm=offset_ppm)
            receive(frame, rx_ticks, found, fault, **more)
        if asked.chip == "slips" and self.random.random() < 0.05:
            self.nodes[0].chip.transceiver.raise_bits(r.CLKPLL_LL)

    def test(self, amounts=FEW):
        """The report of the self-test."""

        async def whole():
            async with self:
                benches = [Bench(name, node.wire.path) for name, node in zip("AB", self.nodes, strict=True)]
                await measure(benches[: self.boards], amounts)
                return report_of(benches[: self.boards], DISTANCE_M)

        return run_on(self.medium.timeline, whole())


def sentences(report):
    """What has failed, without the names of the checks."""
    return [check.finding for check in judge(report) if check.result in ("failed", "warning")]
