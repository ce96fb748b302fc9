"""One's own estimator at a site: beacons become time differences, as the anchors' stamps and relays state them."""

from collections import Counter
from collections.abc import Mapping
from typing import Protocol

from skyless.core.air.frame import Malformed
from skyless.core.air.masterless_packets import Packet, PairTdoa, Point, Relay
from skyless.core.air.reception import Reception
from skyless.core.constants import TICK_BITS
from skyless.core.fix import Fix, NoFixReason
from skyless.core.protocols import SiteBeacon, decode_any
from skyless.core.site import Site
from skyless.research.masterless.pair_engine import PairEngine


class OwnEstimator(Protocol):
    """What an estimator of the reader's own has."""

    def hear(self, observation: PairTdoa) -> Fix | None:
        """Process one time difference, which holds both anchors' positions; a fix if it makes one (``Fix.of``)."""


def with_positions(pair: PairTdoa, anchors_m: Mapping[int, Point]) -> PairTdoa | None:
    """The difference with the positions of both anchors; None where one is not known."""
    a_m, b_m = pair.a_m or anchors_m.get(pair.anchor_a), pair.b_m or anchors_m.get(pair.anchor_b)
    if a_m is None or b_m is None:
        return None
    return PairTdoa(pair.time_s, pair.anchor_a, pair.anchor_b, pair.tdoa_m, a_m, b_m)


class OwnReceiver:
    """Receives as a tag of the site does, and gives an estimator one time difference after the other."""

    def __init__(self, estimator: OwnEstimator, site: Site) -> None:
        """``site`` says where the anchors are."""
        self._estimator = estimator
        self._anchors_m = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}
        self._engine = PairEngine(TICK_BITS, anchors_m=dict(self._anchors_m))
        self.counters: Counter[str] = Counter()
        """Frames by what became of them."""
        self.reason = NoFixReason.NO_BEACONS
        """Why the last frame has made no fix."""

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air; the newest fix of its differences."""
        beacon = decode_any(reception.frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
            return None
        return self.hear_beacon(beacon, reception)

    def hear_beacon(self, beacon: SiteBeacon, reception: Reception) -> Fix | None:
        """Process a beacon that is decoded already, as ``hear`` does."""
        relays = tuple(Relay(heard.anchor, heard.sequence, heard.rx_ticks, None) for heard in beacon.heard)
        sent = (beacon.anchor, beacon.sequence, beacon.tx_ticks)
        fix = None
        for pair in self._engine.on_packet(Packet(reception.host_s, *sent, reception.rx_ticks, relays)):
            known = with_positions(pair, self._anchors_m)
            fix = (None if known is None else self._estimator.hear(known)) or fix
        self.reason = NoFixReason.ACQUIRING
        return fix
