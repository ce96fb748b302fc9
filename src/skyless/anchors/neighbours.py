"""What an anchor of protocol 2 receives of the others: what is dropped, what it relays, how far they are."""

import math
from collections import Counter
from typing import Final

from msgspec import Struct

from skyless.air.beacon import Heard, Malformed
from skyless.air.beacon2 import Beacon2, StatedPosition
from skyless.air.frames import AnyBeacon, decode_any
from skyless.air.reception import Reception
from skyless.anchor import MAX_RELAY_AGE_S, anchor_of
from skyless.anchors.authentication import BeaconAuthentication
from skyless.constants import DELAYED_TX_GRANULARITY_TICKS, TICK_M, TICK_RATE_HZ
from skyless.positioning.methods.observations import AnchorStamps, is_weak_first_path
from skyless.site.local_almanac import stated_position
from skyless.site.model import Site, UnplacedAnchor
from skyless.site.slots import superframe_ticks_of
from skyless.ticks import Unwrapper, nearest

_SENT_KEPT: Final = 64
_RANGE_GAIN: Final = 1.0 / 16.0
_MOST_RANGE_M: Final = 300.0
_LONGEST_EXCHANGE_S: Final = 0.2
"""Of the own frame, the other's reception and its reply: what the rate is off by counts for that long."""


class Admitted(Struct, frozen=True, gc=False):
    """A beacon of another anchor of the site."""

    beacon: Beacon2
    rx_ticks: int
    """RX stamp in the own counter, unwrapped."""
    tx_ticks: int
    """TX stamp in the sender's, unwrapped."""
    fits: bool
    """Whether its stamps fit an earlier frame of that anchor; False for the first of each."""
    power_dbm: float


class Neighbours:
    """Receptions of the site's other anchors."""

    def __init__(
        self, site: Site, anchor_id: int, counters: Counter[str], authentication: BeaconAuthentication | None
    ) -> None:
        """With ``authentication`` only what it verifies is admitted."""
        self.own_ticks = Unwrapper()
        self.position = position_of(site, anchor_id)
        """The own one; None for an anchor without."""
        self._site_id, self._own = site.id, anchor_id
        self._known = frozenset(anchor.id for anchor in site.all_anchors) - {anchor_id}
        self._counters, self._authentication = counters, authentication
        self._stamps = AnchorStamps(counters)
        self._superframe_ticks = superframe_ticks_of(site)
        self._heard: dict[int, tuple[Heard, int, bool]] = {}
        """Last reception of each, its unwrapped stamp, and whether its first path was weak; the newest last."""
        self._sent: dict[int, int] = {}
        self._ranges_m: dict[int, float] = {}
        """Measured by two-way exchanges, to anchors where a position is missing."""

    def place(self, site: Site) -> None:
        """Use the own position in another file of the same anchors; ranges by exchanges begin again."""
        self.position = position_of(site, self._own)
        self._ranges_m.clear()
        self._sent.clear()

    def admit(self, reception: Reception) -> Admitted | None:
        """The beacon of a reception; one that does not belong here is counted and dropped."""
        beacon = decode_any(reception.frame)
        if not isinstance(beacon, Beacon2) or beacon.site != self._site_id or beacon.anchor not in self._known:
            self._counters[self._foreign(beacon)] += 1
            return None
        fault = None if self._authentication is None else self._authentication.fault_of(beacon, reception)
        if fault is not None:
            self._counters[fault] += 1
            return None
        rx_ticks = self.own_ticks.unwrap(reception.rx_ticks, reception.host_s)
        fits = beacon.anchor in self._stamps.tracks.of_anchor
        tx_ticks = self._stamps.unwrap(beacon, rx_ticks, self._superframe_ticks)
        if tx_ticks is None:
            return None
        self._counters["heard"] += 1
        measured = reception.diagnostics
        power_dbm = None if measured is None else measured.rx_power_dbm
        weak = measured is not None and is_weak_first_path(power_dbm, measured.first_path_power_dbm)
        self._heard.pop(beacon.anchor, None)
        self._heard[beacon.anchor] = (Heard(beacon.anchor, beacon.sequence, reception.rx_ticks), rx_ticks, weak)
        return Admitted(beacon, rx_ticks, tx_ticks, fits, power_dbm or 0.0)

    def _foreign(self, beacon: AnyBeacon | Malformed) -> str:
        """What a frame is that is no beacon of another anchor of the site."""
        if isinstance(beacon, Malformed):
            return beacon
        if beacon.site != self._site_id:
            return "foreign-site"
        return "unknown-anchor" if isinstance(beacon, Beacon2) else "other-version"

    def relayed(self, tx_ticks: int, capacity: int) -> tuple[tuple[Heard, ...], int]:
        """Receptions for a frame at that own time, the most recent first, and the bit mask of the weak ones."""
        oldest = tx_ticks - round(MAX_RELAY_AGE_S * TICK_RATE_HZ)
        recent = [(heard, weak) for heard, rx_ticks, weak in reversed(self._heard.values()) if rx_ticks > oldest]
        recent = recent[:capacity]
        return tuple(heard for heard, _ in recent), sum(weak << place for place, (_, weak) in enumerate(recent))

    def on_sent(self, sequence: int, tx_ticks: int) -> None:
        """Note an own frame and the stamp that it states, unwrapped, for two-way exchanges; who needs none does not."""
        self._sent.pop(sequence, None)
        self._sent[sequence] = tx_ticks
        if len(self._sent) > _SENT_KEPT:
            del self._sent[next(iter(self._sent))]

    def range_m(self, admitted: Admitted, rate: float | None) -> float:
        """Distance to the sender: by both positions, else by two-way exchanges, else 0.

        ``rate``: fractional rate of the own counter against the sender's; None while it is not known.
        """
        beacon = admitted.beacon
        other = beacon.position
        if self.position is not None and other is not None:
            own = self.position
            return math.dist((own.x_m, own.y_m, own.z_m), (other.x_m, other.y_m, other.z_m))
        measured_m = None if rate is None else self._exchanged_m(admitted, rate)
        known_m = self._ranges_m.get(beacon.anchor)
        if measured_m is not None:
            known_m = measured_m if known_m is None else known_m + _RANGE_GAIN * (measured_m - known_m)
            self._ranges_m[beacon.anchor] = known_m
        return 0.0 if known_m is None else known_m

    def _exchanged_m(self, admitted: Admitted, rate: float) -> float | None:
        """Range by an own frame that the sender relays and the reply that this beacon is."""
        heard = next((one for one in admitted.beacon.heard if one.anchor == self._own), None)
        sent_ticks = None if heard is None else self._sent.get(heard.sequence)
        if heard is None or sent_ticks is None:
            return None
        around = admitted.rx_ticks - sent_ticks
        there = admitted.tx_ticks - nearest(heard.rx_ticks, admitted.tx_ticks)
        if not 0 < around < _LONGEST_EXCHANGE_S * TICK_RATE_HZ:
            return None
        range_m = 0.5 * ((around - there) - there * rate) * TICK_M
        return range_m if 0.0 <= range_m <= _MOST_RANGE_M else None


def position_of(site: Site, anchor_id: int) -> StatedPosition | None:
    """What an anchor states of its position; None while the site file has none."""
    anchor = anchor_of(site, anchor_id)
    return None if isinstance(anchor, UnplacedAnchor) else stated_position(site, anchor)


def on_radio_grid(ticks_own: int, tx_antenna_delay_ticks: int) -> int:
    """The radio starts on multiples of 512 of its raw counter; the antenna's delay comes on top."""
    raw = ticks_own - tx_antenna_delay_ticks
    return raw - raw % DELAYED_TX_GRANULARITY_TICKS + tx_antenna_delay_ticks
