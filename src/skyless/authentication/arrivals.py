"""When frames arrive by the counters of both ends: a genuine frame that somebody sends again comes too late."""

from collections.abc import Sequence
from enum import Enum, auto
from typing import Final

from msgspec import Struct

from skyless.constants import MAX_DRIFT
from skyless.ticks import difference, from_seconds, wrap

SLACK_TICKS: Final = from_seconds(1e-6)
"""A frame cannot be received whole and sent again in less than 100 times that."""

SILENCE_TICKS: Final = from_seconds(1.0)
"""An anchor none of whose frames has fitted for this time may have a counter that has restarted."""


class Stamps(Struct, frozen=True, gc=False):
    """Of one genuine frame."""

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
    """The earliest frame of an anchor, by both counters, or the last one that agrees with it."""

    rx_ticks: int
    tx_ticks: int
    frames: int = 0
    """Frames that agree."""


class Arrivals:
    """What a listener knows of when frames of each anchor are due."""

    def __init__(self) -> None:
        self._references: dict[int, _Reference] = {}

    def of(self, frames: Sequence[Stamps]) -> list[Arrival]:
        """How genuine frames came that are known together, in the order of their reception.

        Nobody can send a frame before its anchor does. So where two of an anchor do not agree the later one is late.
        """
        for one in frames:
            last = self._references.get(one.anchor)
            if last is None or _replaces(one, last):
                self._references[one.anchor] = _Reference(one.rx_ticks, one.tx_ticks)
        late = [not self._agrees(one) for one in frames]
        return [
            Arrival.LATE if is_late else (Arrival.IN_TIME if self._references[one.anchor].frames > 1 else Arrival.FIRST)
            for one, is_late in zip(frames, late, strict=True)
        ]

    def _agrees(self, one: Stamps) -> bool:
        last = self._references[one.anchor]
        if _delay_ticks(last, one) > _limit_ticks(last, one):
            return False
        last.frames += 1
        if one.rx_ticks > last.rx_ticks:
            last.rx_ticks, last.tx_ticks = one.rx_ticks, one.tx_ticks
        return True


def _replaces(one: Stamps, last: _Reference) -> bool:
    """Whether a frame came too early for those before it, or does not agree with them after a silence."""
    delay_ticks, limit_ticks = _delay_ticks(last, one), _limit_ticks(last, one)
    return delay_ticks < -limit_ticks or (delay_ticks > limit_ticks and one.rx_ticks - last.rx_ticks > SILENCE_TICKS)


def _delay_ticks(last: _Reference, one: Stamps) -> int:
    """How much later a frame came than by the one that was in time."""
    elapsed = one.rx_ticks - last.rx_ticks
    return difference(wrap(last.tx_ticks + elapsed), one.tx_ticks)


def _limit_ticks(last: _Reference, one: Stamps) -> int:
    """How much the counters may differ by then."""
    return SLACK_TICKS + round(MAX_DRIFT * abs(one.rx_ticks - last.rx_ticks))
