"""Time differences without a master: any anchor that relays when it received another is a reference for it.

Anchor b relays that it received anchor a's packet at ``r`` of its own clock. That packet left a one time of flight
earlier, so if b had sent at ``r - tof``, both packets would have left simultaneously, and the interval between their
receptions at the tag is the time difference of arrival. The tag knows b's clock from b's packets (``BroadcastClock``),
and so the time at which it would have received a packet sent by b at ``r - tof``:

    TDoA = c·[(rx_b + phase_b − rx_a) − (1 + rate_b)·(tof + tx_b − r)]

This is the textbook formula, in which ``phase_b`` is zero, with the noise of ``rx_b`` filtered. As the rate includes
the tag's own motion, the TDoA applies to the moment at which the tag received a.
"""

from collections import Counter
from math import dist
from typing import Final

from msgspec import Struct

from skyless.core.air.masterless_packets import Packet, PairTdoa, Point, Relay
from skyless.core.clock_filter import MAX_RELATIVE_RATE, TwoState, predict, update
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_RATE_HZ, TICK_S, Unwrapper, difference, nearest
from skyless.site.survey.anchor_errors import distance_ticks
from skyless.site.survey.legs import AnchorFlights

PAIR_RELAY_MAX_AGE_S: Final = 0.25
"""Greatest age of a relayed packet. Older ones cost accuracy, and a 7-bit sequence number recurs."""

MAX_ANCHORS: Final = 256
"""Further identifiers are ignored, so that memory stays bounded."""

PAIR_PACKETS_KEPT: Final = 64
"""Packets of each anchor that are kept for later relays."""

MARGIN_M: Final = 1.0
"""Margin by which a TDoA may exceed the distance of its anchors."""

LONGEST_M: Final = 1500.0
"""Limit of a TDoA if the anchors' positions are unknown."""

MAX_CLOCK_ERROR_M: Final = 0.15
"""A clock is used once the error due to its rate, over the time to be bridged, is below this."""

Pair = tuple[int, int]


# The clock of an anchor, packet by packet, relative to the listener's clock


STAMP_TICKS: Final = 150e-12 / TICK_S
"""Noise of TX and RX stamp together; a DW1000 has 100 to 163 ps on a reception."""

BROADCAST_WALK_FM: Final = 3e-9
"""Random walk of each clock's rate in 1/√s. On captures of TDoA3 anchors the filter starts to lag with 1e-9."""

ACCELERATION_M2PS3: Final = 4.0
"""Power of the listener's acceleration, m²/s³: a change of 2 m/s in a second."""

WHITE_FM: Final = 2e-11
GATE: Final = 5.0
RESTART_AFTER: Final = 3
"""After this number of consecutive rejected packets that agree with each other, the clock has restarted."""

_WALK: Final = (2 * BROADCAST_WALK_FM**2 + ACCELERATION_M2PS3 / SPEED_OF_LIGHT_MPS**2) * TICK_S
_WHITE: Final = 2 * WHITE_FM**2 / TICK_S
_STAMP_VARIANCE: Final = STAMP_TICKS**2
_START_RATE_VARIANCE: Final = (MAX_RELATIVE_RATE / 2) ** 2


class BroadcastClock:
    """One anchor's clock relative to the listener's: TX counters of ``tx_bits``, RX stamps already unwrapped.

    A two-state filter (phase and rate) over pairs of TX and RX stamps, all in ticks. The rate must contain the Doppler
    shift of a moving listener, so that the phase, extrapolated back by a few milliseconds, applies to the position at
    that time.

    ``tx_ticks`` and ``rx_ticks`` are the unwrapped stamps of the last accepted packet. According to the filter it was
    received ``phase`` ticks later than stamped; ``rate`` is the gain of the listener's clock on the anchor's.
    """

    __slots__ = ("_covariance", "_rejected", "_streak", "_tx_bits", "phase", "rate", "restarts", "rx_ticks", "tx_ticks")

    def __init__(self, tx_bits: int, tx_ticks: int, rx_ticks: int) -> None:
        self._tx_bits = tx_bits
        self.restarts = 0
        self._begin(tx_ticks, rx_ticks)

    def _begin(self, tx_ticks: int, rx_ticks: int) -> None:
        self.tx_ticks = tx_ticks
        self.rx_ticks = rx_ticks
        self.phase = 0.0
        self.rate = 0.0
        self._covariance: TwoState = (_STAMP_VARIANCE, 0.0, _START_RATE_VARIANCE)
        self._rejected: tuple[int, int] | None = None
        self._streak = 0

    def unwrap(self, counter: int, rx_ticks: int) -> int:
        """Unwrapped time of the anchor's counter at about the listener's time ``rx_ticks``.

        The listener's 40 bits determine how often the anchor's 32 bits wrapped since the last packet. This is right for
        gaps of minutes, while 32 bits alone are ambiguous beyond 67 ms (``docs/maths.md`` section 3).
        """
        elapsed = rx_ticks - self.rx_ticks
        guess = self.tx_ticks + elapsed - int(self.rate * elapsed)
        return nearest(counter, guess, self._tx_bits)

    def update(self, tx_counter: int, rx_ticks: int) -> bool:
        """Process one packet. Returns False if it does not fit the clock and was rejected."""
        tx_ticks = self.unwrap(tx_counter, rx_ticks)
        span = tx_ticks - self.tx_ticks
        if span > 0 and rx_ticks > self.rx_ticks and self._filter(span, rx_ticks - self.rx_ticks - span):
            self.tx_ticks = tx_ticks
            self.rx_ticks = rx_ticks
            self._rejected = None
            self._streak = 0
            return True
        self._reject(tx_counter, rx_ticks)
        return False

    def _filter(self, span: int, gained: int) -> bool:
        """Predict over ``span`` ticks of the anchor, and update with the gain of the listener's clock."""
        covariance = predict(self._covariance, span, _WHITE, _WALK)
        innovation = gained - (self.phase + self.rate * span)
        if innovation * innovation > GATE * GATE * (covariance[0] + _STAMP_VARIANCE):
            return False
        gain, rate_gain, self._covariance = update(covariance, _STAMP_VARIANCE)
        self.rate += rate_gain * innovation
        self.phase = (gain - 1.0) * innovation
        return True

    def _reject(self, tx_counter: int, rx_ticks: int) -> None:
        """Note a rejected packet; restart if several in a row agree with each other."""
        agrees = False
        if self._rejected is not None:
            tx_before, rx_before = self._rejected
            elapsed = rx_ticks - rx_before
            gained = difference(elapsed - (tx_counter - tx_before), 0, self._tx_bits)
            agrees = elapsed > 0 and abs(gained) < MAX_RELATIVE_RATE * elapsed + GATE * STAMP_TICKS
        self._streak = self._streak + 1 if agrees else 1
        self._rejected = (tx_counter, rx_ticks)
        if self._streak >= RESTART_AFTER:
            self.restarts += 1
            self._begin(tx_counter, rx_ticks)

    def uncertainty_ticks(self, span: float) -> float:
        """Standard deviation in ticks of the rate's effect over ``span`` ticks."""
        return float(abs(span) * self._covariance[2] ** 0.5)


# Time differences


class _Anchor(Struct):
    """One anchor at the tag: its clock, and its latest packets by sequence number."""

    clock: BroadcastClock
    packets: dict[int, tuple[int, int]] = {}
    """Sequence number → unwrapped (tx_ticks of the anchor, rx_ticks of the tag)."""


def remember(packets: dict[int, tuple[int, int]], sequence: int, tx_ticks: int, rx_ticks: int) -> None:
    """Keep an anchor's packet by its sequence number for later relays."""
    packets.pop(sequence, None)
    if len(packets) >= PAIR_PACKETS_KEPT:
        del packets[next(iter(packets))]
    packets[sequence] = (tx_ticks, rx_ticks)


class PairEngine:
    """Turns the packets that one tag receives into TDoAs of pairs of anchors. No I/O; unusable data are counted.

    ``tx_bits``: width of the anchors' TX and relay stamps; the tag's have 40 bits. ``anchors_m`` (identifier → x, y, z)
    limits TDoAs to what is physically possible; for other anchors positions in packets are used.
    """

    def __init__(self, tx_bits: int = 32, anchors_m: dict[int, Point] | None = None) -> None:
        self.drops: Counter[str] = Counter()
        self._tx_bits = tx_bits
        self._tag_clock = Unwrapper()
        self._first_ticks: int | None = None
        self._anchors: dict[int, _Anchor] = {}
        self._carried_m: dict[int, Point] = {}
        self._anchors_m = dict(anchors_m or {})
        self._limits_m: dict[Pair, float] = {}
        self._flights = AnchorFlights()

    def on_packet(self, packet: Packet) -> list[PairTdoa]:
        """Process one packet. Returns the TDoAs that it completes, in the order of its relays.

        Their ``time_s`` is when the tag received this packet; each applies to the moment of the relayed packet, at most
        ``PAIR_RELAY_MAX_AGE_S`` earlier.
        """
        sender = self._anchors.get(packet.anchor)
        if sender is None and len(self._anchors) >= MAX_ANCHORS:
            self.drops["too-many-anchors"] += 1
            return []
        rx_ticks = self._tag_clock.unwrap(packet.rx_ticks, packet.host_s)
        if self._first_ticks is None:
            self._first_ticks = rx_ticks
        if packet.position_m is not None:
            self._keep_position(packet.anchor, packet.position_m)
        if sender is None:
            clock = BroadcastClock(self._tx_bits, packet.tx_ticks, rx_ticks)
            sender = self._anchors[packet.anchor] = _Anchor(clock)
        elif not self._update_clock(sender, packet, rx_ticks):
            return []
        remember(sender.packets, packet.sequence, sender.clock.tx_ticks, rx_ticks)
        tdoas = []
        time_s = (rx_ticks - self._first_ticks) * TICK_S
        for relay in packet.relays:
            tdoa_m = self._tdoa_m(packet.anchor, sender.clock, relay, rx_ticks)
            if isinstance(tdoa_m, str):
                self.drops[tdoa_m] += 1
            else:
                tdoas.append(PairTdoa(time_s, relay.anchor, packet.anchor, tdoa_m))
        return tdoas

    def _update_clock(self, sender: _Anchor, packet: Packet, rx_ticks: int) -> bool:
        """Update the sender's clock. Returns False for an unusable packet."""
        known = sender.packets.get(packet.sequence)
        if known is not None and known[1] == rx_ticks:
            self.drops["duplicate"] += 1
            return False
        clock = sender.clock
        restarts = clock.restarts
        if clock.update(packet.tx_ticks, rx_ticks):
            return True
        self.drops["stamp-off-its-clock"] += 1
        if clock.restarts != restarts:
            self.drops["clock-restarted"] += 1
            sender.packets.clear()
            self._flights.forget(packet.anchor)
            remember(sender.packets, packet.sequence, clock.tx_ticks, rx_ticks)
        return False

    def _tdoa_m(self, b: int, clock: BroadcastClock, relay: Relay, rx_b: int) -> float | str:
        """One TDoA in metres, or the reason why there is none."""
        a = relay.anchor
        anchor = self._anchors.get(a)
        heard = None if anchor is None else anchor.packets.get(relay.sequence)
        if heard is None or a == b:
            return "relay-of-unheard-packet"
        tx_a, rx_a = heard
        between = rx_b - rx_a
        if not 0 < between < PAIR_RELAY_MAX_AGE_S * TICK_RATE_HZ:
            return "relay-too-old"
        relayed = clock.unwrap(relay.rx_ticks, rx_a)
        flight = self._flights.update(a, b, tx_a, relayed, relay.tof_ticks)
        if flight is None:
            flight = distance_ticks(self._anchors_m, a, b)
        if flight is None:
            return "time-of-flight-unknown"
        reply = clock.tx_ticks - relayed
        if clock.uncertainty_ticks(reply) * TICK_M > MAX_CLOCK_ERROR_M:
            return "clock-unsettled"
        tdoa_m = ((between - reply) + clock.phase - flight - clock.rate * (reply + flight)) * TICK_M
        if abs(tdoa_m) > self._limit_m(a, b):
            return "beyond-anchors"
        return tdoa_m

    def _limit_m(self, a: int, b: int) -> float:
        limit = self._limits_m.get((a, b))
        if limit is None:
            known = self._carried_m | self._anchors_m
            limit = dist(known[a], known[b]) + MARGIN_M if a in known and b in known else LONGEST_M
            self._limits_m[a, b] = limit
        return limit

    def _keep_position(self, anchor: int, position_m: Point) -> None:
        """Keep the position in a packet, and reset the limits of the anchor's pairs if it is new."""
        if self._carried_m.get(anchor) != position_m:
            self._carried_m[anchor] = position_m
            self._limits_m = {pair: limit for pair, limit in self._limits_m.items() if anchor not in pair}
