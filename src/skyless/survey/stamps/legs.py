"""What anchors receive of one another, as anyone who receives their beacons can know it.

A beacon states its TX stamp, and relays when its sender received which frame of which other anchor. A listener that has
received that frame, too, knows both stamps of the leg. An anchor's own receptions are legs as they are.
"""

from collections import Counter
from typing import Final

from msgspec import Struct

from skyless.air.beacon import Beacon, Heard, Malformed
from skyless.air.frames import AnyBeacon, decode_any
from skyless.air.reception import Reception
from skyless.clocks.two_way import MAX_BRACKET_RATE, MAX_FLIGHT_TICKS
from skyless.constants import TICK_RATE_HZ
from skyless.ticks import Unwrapper, difference, to_seconds

_LONGEST_AGE_TICKS: Final = round(2.0 * TICK_RATE_HZ)
"""Anchors relay stamps of the last second; what is older belongs to another frame of that sequence number."""

_MOST_FRAMES: Final = 1 << 14
"""More than fit on the air in ``_LONGEST_AGE_TICKS``."""
_MOST_LEGS: Final = 1 << 16


class AnchorLeg(Struct, frozen=True, gc=False):
    """One broadcast of an anchor and its reception by another."""

    sender: int
    receiver: int
    tx_ticks: int
    """In the counter of the sender, 40 bits."""
    rx_ticks: int
    """In the counter of the receiver, 40 bits."""
    t_s: float
    """On the listener's clock, when it received the frame that relays the leg."""


class _Received(Struct, frozen=True, gc=False):
    tx_ticks: int
    listener_ticks: int
    """Unwrapped."""


class LegCollector:
    """The legs between the anchors of one site, from all that one listener receives.

    Memory is bounded by the frames of two seconds. What cannot be used is counted in ``counters``:
    ``frame-not-received`` (the listener missed the frame that a relay names), ``other-frame`` (the relay names a frame
    before that of this sequence number, or a counter has restarted) and the reasons of ``decode_any``.
    """

    def __init__(self, site_id: int) -> None:
        self.counters: Counter[str] = Counter()
        self._site_id = site_id
        self._ticks = Unwrapper()
        self._frames: dict[tuple[int, int], _Received] = {}
        """By anchor and sequence number, in the order of reception."""
        self._last: dict[tuple[int, int], int] = {}
        """RX stamp of each directed pair's last leg: a stamp is relayed until there is another."""

    def add(self, reception: Reception) -> list[AnchorLeg]:
        """The legs that a reception completes."""
        beacon = decode_any(reception.frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
            return []
        if beacon.site != self._site_id:
            self.counters["foreign-site"] += 1
            return []
        now_ticks = self._ticks.unwrap(reception.rx_ticks, reception.host_s)
        t_s = to_seconds(now_ticks) if reception.host_s is None else reception.host_s
        legs = [leg for heard in _relayed(beacon) if (leg := self._leg(beacon, heard, now_ticks, t_s)) is not None]
        self._frames.pop((beacon.anchor, beacon.sequence), None)
        self._frames[beacon.anchor, beacon.sequence] = _Received(beacon.tx_ticks, now_ticks)
        self._prune(now_ticks)
        return legs

    def _leg(self, beacon: AnyBeacon, heard: Heard, now_ticks: int, t_s: float) -> AnchorLeg | None:
        """The leg that a relay describes, if the listener has received the same frame."""
        pair = (heard.anchor, beacon.anchor)
        if self._last.get(pair) == heard.rx_ticks:
            return None
        frame = self._frames.get((heard.anchor, heard.sequence))
        if frame is None:
            self.counters["frame-not-received"] += 1
            return None
        # Between the two frames the listener's counter and that of the anchor that relays advance alike: a check that
        # another frame of the same sequence number, or a counter that has restarted, does not pass.
        age_ticks = now_ticks - frame.listener_ticks
        apart = abs(difference(beacon.tx_ticks, heard.rx_ticks) - age_ticks)
        if not 0 < age_ticks <= _LONGEST_AGE_TICKS or apart > 2 * MAX_FLIGHT_TICKS + MAX_BRACKET_RATE * age_ticks:
            self.counters["other-frame"] += 1
            return None
        self._last.pop(pair, None)
        self._last[pair] = heard.rx_ticks
        self.counters["legs"] += 1
        return AnchorLeg(heard.anchor, beacon.anchor, frame.tx_ticks, heard.rx_ticks, t_s)

    def _prune(self, now_ticks: int) -> None:
        """Remove frames that no relay can name any more."""
        oldest_ticks = now_ticks - _LONGEST_AGE_TICKS
        while self._frames:
            key = next(iter(self._frames))
            if len(self._frames) <= _MOST_FRAMES and oldest_ticks <= self._frames[key].listener_ticks:
                break
            del self._frames[key]
        if len(self._last) > _MOST_LEGS:
            del self._last[next(iter(self._last))]


def _relayed(beacon: AnyBeacon) -> list[Heard]:
    relayed = list(beacon.heard)
    if isinstance(beacon, Beacon) and beacon.master_heard is not None:
        relayed.append(beacon.master_heard)
    return relayed
