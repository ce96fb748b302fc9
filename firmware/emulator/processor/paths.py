"""What the firmware's work costs: the cycles of each turn of its loop, by what was done in it.

A turn begins with a wake-up or where the watchdog is fed, and ends where it is fed again or with WFI. Bytes belong to
the turn that reads their number.
"""

from collections import Counter
from typing import Final

from msgspec import Struct

from skyless.sim.dw1000 import registers as r
from skyless.sim.dw1000.registers import decode_header

IDLE: Final = "idle"
"""Neither the chip nor the host had anything."""
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

_WORK: Final = {
    (r.RX_BUFFER.file, False): RECEPTION,
    (r.TX_BUFFER.file, True): TRANSMISSION,
    (r.TX_STAMP.file, False): END_OF_TRANSMISSION,
}
"""By what is read or written of the chip; all else is POLL."""
_ABOVE: Final = {BYTE: {COMMAND, START}, POLL: {RECEPTION, TRANSMISSION, END_OF_TRANSMISSION}}
"""Work that says more than this."""


class PathCost(Struct):
    """Turns of one kind; in µs, of cycles of the 64 MHz clock."""

    count: int = 0
    most_cycles: int = 0
    spi_cycles: int = 0
    """What all of them together waited for SPI transfers."""

    @property
    def most_us(self) -> float:
        """Of the longest."""
        return self.most_cycles / 64

    @property
    def spi_us(self) -> float:
        """What one waited for SPI transfers, on average."""
        return self.spi_cycles / 64 / self.count


class Paths:
    """Costs of one processor; the time of waking up itself is not in them."""

    def __init__(self) -> None:
        self._work: Counter[str] = Counter()
        self._unread = 0
        self._unread_ends = 0
        """Bytes, and zeros among them, that have come since their number was read."""
        self._begin_cycles = 0
        self._just_woken = False
        self._transfer_cycles = 0
        self.costs: dict[str, PathCost] = {}
        """By work, several kinds joined by " + "."""

    def begin(self, cycles: int) -> None:
        """The processor has woken up."""
        self._begin_cycles, self._transfer_cycles, self._just_woken = cycles, 0, True

    def begin_start(self, cycles: int) -> None:
        """The processor begins after a reset."""
        self._work.clear()
        self._work[START] = 1
        self.begin(cycles)
        self._just_woken = False

    def note_bytes(self, data: bytes) -> None:
        """These came from the host."""
        self._unread += len(data)
        self._unread_ends += data.count(0)

    def note_count_of_bytes(self) -> None:
        """The firmware reads how many bytes have come."""
        self._work[BYTE] += self._unread
        self._work[COMMAND] += self._unread_ends
        self._unread = self._unread_ends = 0

    def note_transaction(self, sent: bytes) -> None:
        """A transaction with the chip begins, with these first bytes."""
        access = decode_header(sent)
        self._work[POLL if access is None else _WORK.get((access.file, access.is_write), POLL)] += 1

    def note_wait(self, cycles: int) -> None:
        """The processor waited for a transfer."""
        self._transfer_cycles += cycles

    def end_turn(self, cycles: int) -> None:
        """The watchdog is fed: the loop begins again, unless the processor has just woken up before its beginning."""
        if not self._just_woken:
            self.end(cycles)
            self.begin(cycles)
        self._just_woken = False

    def end(self, cycles: int) -> None:
        """The processor goes to sleep."""
        done = {work for work, count in self._work.items() if count}
        kept = [
            f"{count} x {work}" if count > 1 and work in {COMMAND, RECEPTION, TRANSMISSION} else work
            for work, count in sorted(self._work.items())
            if count and not _ABOVE.get(work, set()) & done
        ]
        key = " + ".join(kept) or IDLE
        cost = self.costs.setdefault(key, PathCost())
        cost.count += 1
        cost.most_cycles = max(cost.most_cycles, cycles - self._begin_cycles)
        cost.spi_cycles += self._transfer_cycles
        self._work.clear()
