"""One's own estimator at a site: beacons become time differences, as the anchors' stamps and relays state them."""

from collections import Counter
from collections.abc import Mapping
from traceback import extract_tb
from typing import Protocol

from msgspec import structs

from skyless.core.air.frame import SHORT_BITS, Malformed, Reception
from skyless.core.air.masterless_packets import Packet, PairTdoa, Point, Relay
from skyless.core.any_receiver import SiteBeacon, decode_any
from skyless.core.errors import SkylessError
from skyless.core.fix import Fix, NoFixReason
from skyless.core.site import Site
from skyless.core.ticks import TICK_BITS
from skyless.research.masterless.pair_engine import PairEngine


class OwnEstimator(Protocol):
    """What an estimator of the reader's own has."""

    def hear(self, observation: PairTdoa) -> Fix | None:
        """Process one time difference, which holds both anchors' positions; a fix if it makes one (``Fix.of``)."""


def heard(estimator: OwnEstimator, pair: PairTdoa, anchors_m: Mapping[int, Point], drops: Counter[str]) -> Fix | None:
    """Give an estimator one difference, with the positions that it lacks; unknown anchors are counted.

    Raises SkylessError where the estimator fails or returns anything but a fix or None.
    """
    a_m, b_m = pair.a_m or anchors_m.get(pair.anchor_a), pair.b_m or anchors_m.get(pair.anchor_b)
    if a_m is None or b_m is None:
        drops["unknown-anchor"] += 1
        return None
    name = f"{type(estimator).__name__}.hear"
    try:
        fix = estimator.hear(structs.replace(pair, a_m=a_m, b_m=b_m))
    except Exception as error:
        *_, place = extract_tb(error.__traceback__)
        failed = f"{type(error).__name__}: {error} ({place.filename}, line {place.lineno})"
        raise SkylessError(f"{name} has failed: {failed}") from error
    if not isinstance(fix, Fix | None):
        raise SkylessError(
            f"{name} has returned {type(fix).__name__}; it should be None or a fix, as of skyless.Fix.of"
        )
    return fix


class OwnReceiver:
    """Receives as a tag of the site does, and gives an estimator one time difference after the other."""

    def __init__(self, estimator: OwnEstimator, site: Site) -> None:
        """``site`` says where the anchors are."""
        self._estimator = estimator
        self._anchors_m = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}
        bits = SHORT_BITS if site.schedule.sends_phases else TICK_BITS
        self._engine = PairEngine(bits, anchors_m=dict(self._anchors_m))
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
            fix = heard(self._estimator, pair, self._anchors_m, self.counters) or fix
        self.reason = NoFixReason.ACQUIRING
        return fix
