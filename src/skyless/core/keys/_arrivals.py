"""When frames arrive by the counters of both ends: a genuine frame that somebody sends again comes too late."""

from collections.abc import Sequence
from enum import Enum, auto
from typing import Final

from msgspec import Struct

from skyless.core.constants import MAX_DRIFT
from skyless.core.ticks import difference, from_seconds

SLACK_TICKS: Final = from_seconds(1e-6)
"""A frame cannot be received whole and sent again in less than 100 times that."""

SILENCE_TICKS: Final = from_seconds(1.0)
"""An anchor none of whose frames has fitted for this time may have a counter that has restarted."""


class Stamps(Struct, frozen=True, gc=False):
    """Stamps of one genuine frame."""

    anchor: int
    rx_ticks: int
    """Own counter, unwrapped."""
    tx_ticks: int
    """The anchor's, 40 bits."""


class Arrival(Enum):
    """How a frame came."""

    IN_TIME = auto()
    FIRST = auto()
    """Nothing shows it yet: no other frame of its anchor agrees with it."""
    LATE = auto()


class _Reference(Struct):
    """The last frame of an anchor that agrees with the earliest one, by both counters."""

    rx_ticks: int
    tx_ticks: int
    frames: int
    """Number of frames that agree."""


class Arrivals:
    """What a listener knows of when frames of each anchor are due."""

    def __init__(self) -> None:
        self._references: dict[int, _Reference] = {}

    def is_plausible(self, one: Stamps) -> bool:
        """Whether a frame that is not verified yet arrived when a frame of its anchor with this stamp would.

        So is any before the first genuine frame of all.
        """
        last = self._references.get(one.anchor)
        if last is None:
            return not self._references
        return not _delay_ticks(last, one)

    def of(self, frames: Sequence[Stamps]) -> list[Arrival]:
        """How genuine frames came that are known together, in the order of their reception.

        Nobody can send a frame before its anchor does. So where two of an anchor do not agree the later one is late.
        """
        references, late = self._references, set[int]()
        for number, one in enumerate(frames):
            last = references.get(one.anchor)
            if last is None:
                references[one.anchor] = _Reference(one.rx_ticks, one.tx_ticks, 1)
                continue
            delay_ticks = _delay_ticks(last, one)
            if not delay_ticks:
                last.frames += 1
                last.rx_ticks, last.tx_ticks = one.rx_ticks, one.tx_ticks
            elif delay_ticks > 0 and one.rx_ticks - last.rx_ticks <= SILENCE_TICKS:
                late.add(number)
            else:
                late.update(before for before in range(number) if frames[before].anchor == one.anchor)
                references[one.anchor] = _Reference(one.rx_ticks, one.tx_ticks, 1)
        if not late and all(references[one.anchor].frames > 1 for one in frames):
            return [Arrival.IN_TIME] * len(frames)
        known = [Arrival.IN_TIME if references[one.anchor].frames > 1 else Arrival.FIRST for one in frames]
        return [Arrival.LATE if number in late else arrival for number, arrival in enumerate(known)]


def _delay_ticks(last: _Reference, one: Stamps) -> int:
    """How much later than due a frame has come; 0 where crystals and noise explain it."""
    elapsed = one.rx_ticks - last.rx_ticks
    delay_ticks = difference(last.tx_ticks + elapsed, one.tx_ticks)
    return 0 if abs(delay_ticks) <= SLACK_TICKS + MAX_DRIFT * abs(elapsed) else delay_ticks
