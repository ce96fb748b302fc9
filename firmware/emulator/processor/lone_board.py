"""One emulated board with its chip, alone in an air of its own, on a line of 1 Mbaud."""

from functools import partial
from pathlib import Path
from typing import Final

from emulator.processor.nrf52832 import Image
from emulator.seat import Seat
from skyless.core.ticks import TICK_S, from_seconds, wrap
from skyless.radio.interface import AntennaDelays
from skyless.sim.dw1000.chip import Chip
from skyless.sim.medium import Timeline

DELAYS: Final = AntennaDelays(16_500, 16_300)
IDENTITY: Final = b"identity"


class LoneBoard:
    """One image on a line of 1 Mbaud, and the air, whose counter is true time."""

    def __init__(
        self,
        elf: Path,
        *,
        can_transmit: bool = True,
        clock_ppm: float = 0.0,
        revision: int = 5,
        baud: int | None = 1_000_000,
    ) -> None:
        self.timeline: Timeline[None] = Timeline()
        self.chip = Chip(self, DELAYS.tx_ticks, DELAYS.rx_ticks, self.now_s)
        self.frames: list[tuple[bytes, int]] = []
        """What is on the air, with its stamp."""
        self.lines: list[tuple[float, bytes]] = []
        """What has come, with its time in µs."""
        seat = Seat(self.timeline, self.chip, self._note, can_transmit, IDENTITY)
        self.image = Image(seat, elf=elf, clock_ppm=clock_ppm, revision=revision, baud=baud)

    def _note(self, data: bytes) -> None:
        self.lines.append((1e6 * self.now_s(), data))

    @property
    def sent(self) -> bytes:
        """All bytes that have come."""
        return b"".join(data for _, data in self.lines)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        for _ in self.timeline.run(self.timeline.now_ticks + from_seconds(seconds)):
            pass

    def write(self, data: bytes, gap_s: float = 10e-6) -> float:
        """Bytes that arrive one after the other from now on; when the last has, in µs."""
        for at, byte in enumerate(data):
            ticks = self.timeline.now_ticks + from_seconds((at + 1) * gap_s)
            self.timeline.at(ticks, partial(self.image.receive, bytes((byte,))))
        return 1e6 * (self.now_s() + len(data) * gap_s)

    # The chip's air

    def now_ticks(self) -> int:
        """The counter."""
        return wrap(self.timeline.now_ticks)

    def now_s(self) -> float:
        """True time."""
        return self.timeline.now_ticks * TICK_S

    def transmit(self, frame: bytes, leaves_ticks: int) -> bool:
        """Note a frame and its stamp."""
        self.frames.append((frame, leaves_ticks))
        return True

    def withdraw(self) -> None:
        """The last frame will not be sent."""
        self.frames.pop()
