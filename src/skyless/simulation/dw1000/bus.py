"""The wires between a host and a chip, and the time that a host takes for them."""

import random
from collections.abc import Callable
from typing import Final

from msgspec import Struct

from skyless.firmware.dw1000 import Bus
from skyless.simulation.dw1000.chip import Chip

SLOW_HZ: Final = 2_000_000
FAST_HZ: Final = 16_000_000


class HostLatency(Struct, frozen=True):
    """What a transfer costs a host, in s, beside its bits: evenly between two values, and now and then a long pause.

    The defaults are those of CPython on a Raspberry Pi over spidev.
    """

    least_s: float = 20e-6
    most_s: float = 100e-6
    spike_probability: float = 2e-4
    """Chance that a transfer takes up to ``spike_s``: another process, a page fault."""
    spike_s: float = 5e-3
    work_s: float = 0.2e-3
    """What Python takes to understand a frame, or to make one (assumed)."""

    @classmethod
    def none(cls) -> "HostLatency":
        """A host that takes no time but for the bits."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0)

    def draw(self, generator: random.Random) -> float:
        """One transfer's time."""
        if generator.random() < self.spike_probability:
            return generator.uniform(self.most_s, self.spike_s)
        return generator.uniform(self.least_s, self.most_s)


class ModelBus(Bus):
    """What the driver asks of its hardware, on a model.

    ``spend`` lets the host's time pass; a transfer reaches the chip when its time is over.
    """

    def __init__(
        self, chip: Chip, spend: Callable[[float], None] | None = None, latency_s: Callable[[], float] | None = None
    ) -> None:
        self.chip = chip
        self._spend, self._latency_s = spend, latency_s
        self._hz = SLOW_HZ

    def _exchange(self, out: bytes) -> bytes:
        if self._spend is not None:
            self._spend((0.0 if self._latency_s is None else self._latency_s()) + 8 * len(out) / self._hz)
        return self.chip.transfer(out, self._hz)

    def transfer(self, out: memoryview, into: memoryview) -> None:
        """One transaction in both directions."""
        into[:] = self._exchange(bytes(out))

    def write(self, header: memoryview, data: memoryview) -> None:
        """One transaction that only sends."""
        self._exchange(bytes(header) + bytes(data))

    def slow(self) -> None:
        """Clock slowly from now on."""
        self._hz = SLOW_HZ

    def fast(self) -> None:
        """Clock fast from now on."""
        self._hz = FAST_HZ

    def reset(self) -> bool:
        """Pull RSTn low for a moment."""
        self.chip.pull_reset()
        return True

    def pause_us(self, microseconds: int) -> None:
        """Wait."""
        if self._spend is not None:
            self._spend(1e-6 * microseconds)
