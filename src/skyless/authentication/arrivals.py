"""When frames arrive by the counters of both ends: a genuine frame that somebody sends again comes too late."""

from collections.abc import Iterable
from typing import Final

from msgspec import Struct

from skyless.constants import MAX_DRIFT
from skyless.ticks import difference, from_seconds, wrap

SLACK_TICKS: Final = from_seconds(1e-6)
"""A frame cannot be received whole and sent again in less than 100 times that."""

SILENCE_TICKS: Final = from_seconds(1.0)
"""An anchor none of whose frames has fitted for this time may have a counter that has restarted."""


class _Arrival(Struct):
    """The last frame of an anchor that was in time."""

    rx_ticks: int
    tx_ticks: int


class Stamps(Struct, frozen=True, gc=False):
    """Of one genuine frame."""

    anchor: int
    rx_ticks: int
    """Own counter, unwrapped."""
    tx_ticks: int
    """The anchor's, 40 bits."""


class Arrivals:
    """What a listener knows of when frames of each anchor are due."""

    def __init__(self) -> None:
        self._last: dict[int, _Arrival] = {}

    def in_time(self, frames: Iterable[Stamps]) -> list[bool]:
        """Of genuine frames in the order of their reception, whether each came without delay.

        Nobody can send a frame before its anchor does. So where two of an anchor do not agree the later one is late.
        """
        frames = list(frames)
        for one in frames:  # the earliest of all is right, also where the first ones are late
            last = self._last.get(one.anchor)
            if (
                last is None
                or one.rx_ticks - last.rx_ticks > SILENCE_TICKS
                or _delay_ticks(last, one) < -_limit(last, one)
            ):
                self._last[one.anchor] = _Arrival(one.rx_ticks, one.tx_ticks)
        return [self._is_in_time(one) for one in frames]

    def _is_in_time(self, one: Stamps) -> bool:
        last = self._last[one.anchor]
        if _delay_ticks(last, one) > _limit(last, one):
            return False
        if one.rx_ticks > last.rx_ticks:
            last.rx_ticks, last.tx_ticks = one.rx_ticks, one.tx_ticks
        return True


def _delay_ticks(last: _Arrival, one: Stamps) -> int:
    """How much later a frame came than by the one that was in time."""
    elapsed = one.rx_ticks - last.rx_ticks
    return difference(wrap(last.tx_ticks + elapsed), one.tx_ticks)


def _limit(last: _Arrival, one: Stamps) -> int:
    """How much the counters may differ by then."""
    return SLACK_TICKS + round(MAX_DRIFT * abs(one.rx_ticks - last.rx_ticks))
