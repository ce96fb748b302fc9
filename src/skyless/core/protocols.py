"""The two protocols: what depends on which of them a site uses is asked for here, and nowhere by its mode."""

from collections import Counter
from statistics import median
from typing import Protocol

from skyless.core.air.beacon import Beacon
from skyless.core.air.codec import decode_cached
from skyless.core.air.frame import Malformed, has_version
from skyless.core.air.instants import suitable_period_s
from skyless.core.air.reception import Reception, Transmission
from skyless.core.anchor.anchor import Anchor
from skyless.core.anchor.authentication import BeaconAuthentication
from skyless.core.geometry import anchors_in_reach
from skyless.core.protocol1 import anchor as protocol1_anchor
from skyless.core.protocol1 import codec as protocol1_codec
from skyless.core.protocol1.beacon import Beacon as Protocol1Beacon
from skyless.core.protocol1.schedule import schedule_of
from skyless.core.site import Site

SiteBeacon = Beacon | Protocol1Beacon


def decode_any(frame: bytes) -> SiteBeacon | Malformed:
    """Return the beacon of either protocol in a whole frame (FCS included), or why there is none; never raises.

    The last 256 frames of each are remembered, for a program that runs many tags which receive the same bytes.
    """
    if has_version(frame, protocol1_codec.VERSION_1):
        return protocol1_codec.decode_cached(frame)
    return decode_cached(frame)


class BeaconSender(Protocol):
    """An anchor as its radio uses it: bytes and ticks in, frames and ticks out; no I/O, no clock."""

    @property
    def id(self) -> int:
        """Identifier of the anchor."""

    def hear(self, reception: Reception) -> None:
        """Process a frame from the air; one that does not belong here is counted and dropped."""

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        """TX stamp (40-bit, own counter) of the next frame that can still be made; None while that is not known."""

    def transmission(self, tx_ticks: int) -> Transmission:
        """The frame for the time that ``next_transmission_ticks`` gave last."""


class AnchorMachine(BeaconSender, Protocol):
    """The protocol machine of an anchor, as its program uses it."""

    counters: Counter[str]

    @property
    def interval_ticks(self) -> float:
        """Time between two frames; 0 where they are at random instants."""

    def clock(self, now_ticks: int | None) -> protocol1_anchor.SiteTimeState | None:
        """What it knows of the site's time at its counter (40 bits); None where a site has no common time."""

    def place(self, site: Site) -> None:
        """Use other positions and antenna delays of the same anchors, and go on."""


def new_anchor(
    site: Site, anchor_id: int, lead_s: float = 1e-3, authentication: BeaconAuthentication | None = None
) -> AnchorMachine:
    """Return the machine of an anchor of a validated site; ``lead_s``: how early its driver needs a frame.

    ``authentication``: its keys; protocol 1 knows none.

    Raises:
        KeyError: the site has no such anchor.
    """
    if site.schedule.needs_master:
        return protocol1_anchor.Anchor(site, anchor_id, lead_s)
    return Anchor(site, anchor_id, lead_s, authentication)


def beacon_period_s(site: Site) -> float:
    """Return the mean time between two beacons of one anchor of a validated site, in seconds (median over anchors).

    Anchors of protocol 2 are supposed to receive the others within the range in the open.
    """
    if site.schedule.needs_master:
        schedule = schedule_of(site)
        return 1.0 / (schedule.superframe_rate_hz * schedule.frames_per_node)
    in_reach = median(anchors_in_reach(site).tolist()) if site.anchors else len(site.unplaced)
    return suitable_period_s(in_reach, site.schedule.rate_hz)


def superframe_s(site: Site) -> float:
    """Return the seconds in which each anchor sends once: the superframe, or the mean time between two beacons."""
    return 1.0 / schedule_of(site).superframe_rate_hz if site.schedule.needs_master else beacon_period_s(site)
