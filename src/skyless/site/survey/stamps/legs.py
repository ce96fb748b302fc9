"""What anchors receive of one another, as anyone who receives their beacons can know it.

A beacon states its TX stamp, and relays when its sender received which frame of which other anchor. A listener that has
received that frame, too, knows both stamps of the leg. An anchor's own receptions are legs as they are.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Final

from msgspec import Struct

from skyless.core.air.frame import Heard, Malformed, Reception
from skyless.core.air.masterless_packets import Relay
from skyless.core.any_receiver import decode_any
from skyless.core.ticks import TICK_BITS, TICK_RATE_HZ, Unwrapper, difference, to_seconds
from skyless.site.survey.two_way import MAX_BRACKET_RATE, MAX_FLIGHT_TICKS

_LONGEST_AGE_TICKS: Final = round(2.0 * TICK_RATE_HZ)
"""Anchors relay stamps of the last second; what is older belongs to another frame of that sequence number."""

_MAX_FRAMES: Final = 1 << 14
"""More than fit on the air in ``_LONGEST_AGE_TICKS``."""
_MAX_LEGS: Final = 1 << 16


class AnchorLeg(Struct, frozen=True, gc=False):
    """One broadcast of an anchor and its reception by another."""

    sender: int
    receiver: int
    tx_ticks: int
    """In the counter of the sender."""
    rx_ticks: int
    """In the counter of the receiver."""
    t_s: float
    """When the listener received the same broadcast, on its own clock."""
    carrier_phase_cycles: float | None = None
    """Phase of the carrier as the receiver heard it, where it was measured and relayed."""


class _Received(Struct, frozen=True, gc=False):
    tx_ticks: int
    listener_ticks: int
    """Unwrapped."""
    t_s: float


class RelayMatcher:
    """Finds the frames that relays name, among those that one listener has received.

    Memory is bounded by the frames of two seconds. ``counters``: ``legs``, and relays without one:
    ``frame-not-received`` (the listener missed the frame that it names), ``other-frame`` (it names a frame before that
    of this sequence number, or a counter has restarted).
    """

    def __init__(self, bits: int = TICK_BITS) -> None:
        """``bits``: of the anchors' counters."""
        self.counters: Counter[str] = Counter()
        self._bits = bits
        self._frames: dict[tuple[int, int], _Received] = {}
        """By anchor and sequence number, in the order of reception."""
        self._last: dict[tuple[int, int], int] = {}
        """RX stamp of each directed pair's last leg: a stamp is relayed until there is another."""

    def add(
        self, anchor: int, sequence: int, tx_ticks: int, relays: Iterable[Relay | Heard], now_ticks: int, t_s: float
    ) -> list[AnchorLeg]:
        """The legs that a frame's relays complete. ``now_ticks``: the listener's counter, unwrapped, and its clock."""
        legs = []
        for relay in relays:
            leg = self._leg(anchor, tx_ticks, relay, now_ticks)
            if leg is not None:
                legs.append(leg)
        self._frames.pop((anchor, sequence), None)
        self._frames[anchor, sequence] = _Received(tx_ticks, now_ticks, t_s)
        self._prune(now_ticks)
        return legs

    def _leg(self, anchor: int, tx_ticks: int, relay: Relay | Heard, now_ticks: int) -> AnchorLeg | None:
        """The leg that a relay describes, if the listener has received the same frame."""
        pair = (relay.anchor, anchor)
        if relay.anchor == anchor or self._last.get(pair) == relay.rx_ticks:
            return None
        frame = self._frames.get((relay.anchor, relay.sequence))
        if frame is None:
            self.counters["frame-not-received"] += 1
            return None
        # Between the two frames the listener's counter and that of the anchor that relays advance alike: a check that
        # another frame of the same sequence number, or a counter that has restarted, does not pass.
        age_ticks = now_ticks - frame.listener_ticks
        rx_ticks = relay.rx_ticks_near(tx_ticks - age_ticks) if isinstance(relay, Heard) else relay.rx_ticks
        apart_ticks = abs(difference(tx_ticks, rx_ticks + age_ticks, self._bits))
        if not 0 < age_ticks <= _LONGEST_AGE_TICKS or apart_ticks > 2 * MAX_FLIGHT_TICKS + MAX_BRACKET_RATE * age_ticks:
            self.counters["other-frame"] += 1
            return None
        self._last.pop(pair, None)
        self._last[pair] = relay.rx_ticks
        self.counters["legs"] += 1
        phase_cycles = relay.phase_cycles if isinstance(relay, Heard) else relay.carrier_phase_cycles
        return AnchorLeg(relay.anchor, anchor, frame.tx_ticks, rx_ticks, frame.t_s, phase_cycles)

    def _prune(self, now_ticks: int) -> None:
        """Remove frames that no relay can name any more."""
        oldest_ticks = now_ticks - _LONGEST_AGE_TICKS
        while self._frames:
            key = next(iter(self._frames))
            if len(self._frames) <= _MAX_FRAMES and oldest_ticks <= self._frames[key].listener_ticks:
                break
            del self._frames[key]
        while len(self._last) > _MAX_LEGS:
            del self._last[next(iter(self._last))]


class LegCollector:
    """The legs between the anchors of one site, from the beacons (of either protocol) that one listener receives.

    ``counters``: those of ``RelayMatcher``, ``foreign-site``, and the reasons of ``decode_any``.
    """

    def __init__(self, site_id: int) -> None:
        self._site_id = site_id
        self._ticks = Unwrapper()
        self._matcher = RelayMatcher()
        self.counters = self._matcher.counters

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
        return self._matcher.add(beacon.anchor, beacon.sequence, beacon.tx_ticks, beacon.relayed, now_ticks, t_s)
