"""What the firmware's work costs: cycles from one wake-up to the next WFI, by what was done between them."""

from collections import Counter
from typing import Final

from msgspec import Struct

from skyless.simulation.dw1000 import registers as r
from skyless.simulation.dw1000.memory import decode_header

IDLE: Final = "idle"
"""Nothing came from the chip or the host; a timer ended the sleep."""
START: Final = "start"
"""From a reset."""
BYTE: Final = "byte"
"""Bytes came from the host, but not a record's end."""
COMMAND: Final = "command"
POLL: Final = "poll"
"""The chip was asked for its state, or set."""
RECEPTION: Final = "reception"
TRANSMISSION: Final = "transmission"
"""A frame was handed to the chip."""
END_OF_TRANSMISSION: Final = "end of transmission"

_ABOVE: Final = {BYTE: {COMMAND, START}, POLL: {RECEPTION, TRANSMISSION, END_OF_TRANSMISSION}}
"""Work that says more than this."""


class PathCost(Struct, frozen=True):
    """Cycles of the 64 MHz clock from wake-ups to the WFI after them."""

    count: int
    least: int
    mean: float
    most: int
    mean_transfer: float
    """Of the mean, what the processor waited for SPI transfers."""

    @property
    def mean_us(self) -> float:
        """Mean time."""
        return self.mean / 64

    @property
    def most_us(self) -> float:
        """Longest time."""
        return self.most / 64


class Paths:
    """Costs of one processor; the time of waking up itself is not in them."""

    def __init__(self) -> None:
        self._work: Counter[str] = Counter()
        self._begin_cycles = 0
        self._transfer_cycles = 0
        self._sums: dict[str, tuple[int, int, int, int, int]] = {}

    def begin(self, cycles: int) -> None:
        """The processor has woken up."""
        self._begin_cycles, self._transfer_cycles = cycles, 0

    def begin_start(self, cycles: int) -> None:
        """The processor begins after a reset."""
        self._work.clear()
        self._work[START] = 1
        self.begin(cycles)

    def note_bytes(self, data: bytes) -> None:
        """These came from the host."""
        self._work[BYTE] += 1
        self._work[COMMAND] += data.count(0)

    def note_transaction(self, sent: bytes) -> None:
        """A transaction with the chip."""
        access = decode_header(sent)
        work = POLL
        if access is not None and access.file == r.RX_BUFFER.file and not access.is_write:
            work = RECEPTION
        elif access is not None and access.file == r.TX_BUFFER.file and access.is_write:
            work = TRANSMISSION
        elif access is not None and access.file == r.TX_TIME.file and not access.is_write:
            work = END_OF_TRANSMISSION
        self._work[work] += 1

    def note_wait(self, cycles: int) -> None:
        """The processor waited for a transfer."""
        self._transfer_cycles += cycles

    def end(self, cycles: int) -> None:
        """The processor goes to sleep."""
        done = {work for work, count in self._work.items() if count}
        kept = [
            f"{count} x {work}" if count > 1 and work in {COMMAND, RECEPTION, TRANSMISSION} else work
            for work, count in sorted(self._work.items())
            if count and not _ABOVE.get(work, set()) & done
        ]
        key = " + ".join(kept) or IDLE
        spent, waited = cycles - self._begin_cycles, self._transfer_cycles
        count, least, total, most, transfers = self._sums.get(key, (0, spent, 0, spent, 0))
        self._sums[key] = count + 1, min(least, spent), total + spent, max(most, spent), transfers + waited
        self._work.clear()

    def costs(self) -> dict[str, PathCost]:
        """Costs by work, several kinds joined by " + "."""
        return {
            key: PathCost(count, least, total / count, most, transfers / count)
            for key, (count, least, total, most, transfers) in sorted(self._sums.items())
        }
