"""An anchor of either protocol behind one interface, and how often anchors send.

What depends on a site's protocol is asked for here, and nowhere by the schedule's mode.
"""

from collections import Counter
from statistics import median
from typing import Protocol

from skyless.core.air.almanac import suitable_period_s
from skyless.core.air.frame import Reception, Transmission
from skyless.core.anchor import Anchor
from skyless.core.geometry import anchors_in_reach
from skyless.core.keys.authentication import BeaconAuthentication
from skyless.core.protocol1 import anchor as protocol1
from skyless.core.protocol1.beacon import schedule_of
from skyless.core.site import Site


class BeaconSender(Protocol):
    """An anchor as its radio sees it: bytes and ticks in, frames and ticks out; no I/O, no clock."""

    @property
    def id(self) -> int:
        """Identifier of the anchor."""

    def hear(self, reception: Reception) -> None:
        """Process a frame from the air. Frames of others are counted and dropped."""

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        """TX stamp (40-bit, own counter) of the next frame that can still be prepared; None if unknown so far."""

    def transmission(self, tx_ticks: int) -> Transmission:
        """The frame for the time last returned by ``next_transmission_ticks``."""


class AnchorMachine(BeaconSender, Protocol):
    """The protocol machine of an anchor as its program sees it."""

    counters: Counter[str]

    @property
    def interval_ticks(self) -> float:
        """Time between two frames; 0 if they are at random instants."""

    def clock(self, now_ticks: int | None) -> protocol1.SiteTimeState | None:
        """Its estimate of the site time at its 40-bit counter; None if the site has no common time."""

    def place(self, site: Site) -> None:
        """Continue with other positions and antenna delays of the same anchors."""


def new_anchor(
    site: Site, anchor_id: int, lead_s: float = 1e-3, authentication: BeaconAuthentication | None = None
) -> AnchorMachine:
    """Create the machine of an anchor of a validated site; ``lead_s``: how early its driver needs a frame.

    ``authentication``: the anchor's keys; protocol 1 has none.

    Raises KeyError: the site has no such anchor.
    """
    if site.schedule.needs_master:
        return protocol1.Anchor(site, anchor_id, lead_s)
    return Anchor(site, anchor_id, lead_s, authentication)


def beacon_period_s(site: Site) -> float:
    """Mean time between two beacons of one anchor of a validated site, in seconds (median over anchors).

    Assumes that anchors of protocol 2 receive all others within the open-air range.
    """
    if site.schedule.needs_master:
        schedule = schedule_of(site)
        return 1.0 / (schedule.superframe_rate_hz * schedule.frames_per_node)
    in_reach = median(anchors_in_reach(site).tolist()) if site.anchors else len(site.unplaced)
    return suitable_period_s(in_reach, site.schedule.rate_hz)


def superframe_s(site: Site) -> float:
    """Time in which each anchor sends once, in seconds: the superframe, or the mean time between two beacons."""
    return 1.0 / schedule_of(site).superframe_rate_hz if site.schedule.needs_master else beacon_period_s(site)
