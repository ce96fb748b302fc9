"""Both protocols behind one interface: what depends on the protocol of a site, and a tag that detects it."""

from collections import Counter
from statistics import median
from typing import Protocol

from msgspec.structs import replace

from skyless.core.air.almanac import suitable_period_s
from skyless.core.air.beacon import Beacon, decode_cached
from skyless.core.air.frame import Malformed, Reception, Transmission, has_version
from skyless.core.air.site_choice import OF_PROTOCOL_1
from skyless.core.anchor import Anchor, BeaconAuthentication
from skyless.core.fix import Fix, NoFixReason
from skyless.core.geometry import anchors_in_reach
from skyless.core.integrity import IntegrityRequirement
from skyless.core.method_names import DEFAULT_METHOD, FILTERS, METHODS
from skyless.core.motion_sample import MotionSample
from skyless.core.native.records import MAX_SITES
from skyless.core.protocol1 import anchor as protocol1_anchor
from skyless.core.protocol1 import beacon as protocol1_codec
from skyless.core.protocol1 import receiver as protocol1
from skyless.core.protocol1.beacon import Beacon as Protocol1Beacon
from skyless.core.protocol1.beacon import schedule_of
from skyless.core.protocol1.snapshots import Snapshots
from skyless.core.protocol1.translator import Translator
from skyless.core.site import Site
from skyless.core.tag.joint import Estimation
from skyless.core.tag.receiver import HeardSite, Receiver

# The two protocols: what depends on which of them a site uses is asked for here, and nowhere by its mode.

SiteBeacon = Beacon | Protocol1Beacon


def decode_any(frame: bytes) -> SiteBeacon | Malformed:
    """Decode a whole frame (FCS included) of either protocol, or return why it is no beacon; never raises.

    The last 256 frames of each protocol are cached, for programs that run many tags which receive the same bytes.
    """
    if has_version(frame, protocol1_codec.VERSION_1):
        return protocol1_codec.decode_cached(frame)
    return decode_cached(frame)


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

    def clock(self, now_ticks: int | None) -> protocol1_anchor.SiteTimeState | None:
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
        return protocol1_anchor.Anchor(site, anchor_id, lead_s)
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


class AnyReceiver:
    """A listening tag at a site of either protocol. Bytes and ticks in, fixes out; no I/O, no clock."""

    def __init__(
        self,
        method: str = DEFAULT_METHOD,
        *,
        site: int | None = None,
        qa: float = 0.3,
        z_bounds_m: tuple[float, float] | None = None,
        integrity: IntegrityRequirement | None = None,
    ) -> None:
        """Create a tag that has heard nothing, with the options of ``skyless.Receiver``.

        ``method`` is one of ``METHODS``; all but ``joint`` are methods of protocol 1.

        Raises ValueError: there is no such method.
        """
        if method not in METHODS:
            raise ValueError(f"method {method!r} is not one of {', '.join(METHODS)}")
        if method in FILTERS:
            joint = Receiver(site=site, qa=qa, z_bounds_m=z_bounds_m, integrity=integrity)
            self._receiver: Receiver | protocol1.Receiver = joint
        else:
            self._receiver = protocol1.Receiver(method, site=site, z_bounds_m=z_bounds_m)
        self._translators: dict[int, Translator] = {}
        """Of the sites of protocol 1 that ``joint`` hears, the one in use and those received last."""

    @property
    def receiver(self) -> Receiver | protocol1.Receiver:
        """The receiver of the method."""
        return self._receiver

    @property
    def counters(self) -> Counter[str]:
        """Frames by outcome."""
        return self._receiver.counters

    @property
    def reason(self) -> NoFixReason:
        """Why the last frame made no fix."""
        return self._receiver.reason

    @property
    def site(self) -> int | None:
        """Identifier of the site in use; None before the first beacon."""
        return self._receiver.site

    @property
    def method(self) -> Estimation | Snapshots | None:
        """The positioning method in use; None before the almanac is known."""
        return self._receiver.method

    @property
    def multipath_m(self) -> tuple[float, float] | None:
        """Standard deviation and distance of changing range errors, if it exceeds the stated one."""
        return self._receiver.multipath_m

    @property
    def phase_anchors(self) -> tuple[int, ...]:
        """Anchors whose carrier phases are in use."""
        return self._receiver.phase_anchors

    @property
    def heard_site(self) -> HeardSite | None:
        """Anchors and georeference of the site; None before they are known."""
        found = self._receiver.heard_site
        if found is None or not self._receiver.admission.choice.site & OF_PROTOCOL_1:
            return found
        return replace(found, is_complete=found.georeference is not None)

    def hear_height(self, height_m: float, std_m: float) -> bool:
        """Process a reading of the tag's height sensor, as ``Receiver.hear_height`` does."""
        return self._receiver.hear_height(height_m, std_m)

    def hear_motion(self, sample: MotionSample) -> bool:
        """Process what a motion sensor or wheels show, as ``Receiver.hear_motion`` does."""
        return self._receiver.hear_motion(sample)

    @property
    def motion_note(self) -> str | None:
        """What keeps a motion sensor from being used fully, in a sentence; None if nothing does, or there is none."""
        return self._receiver.motion_note

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air. Returns a fix if it made one, otherwise sets ``reason``.

        Unusable frames are counted in ``counters`` and dropped; no frame raises.
        """
        receiver, frame = self._receiver, reception.frame
        if isinstance(receiver, Receiver) and not has_version(frame, protocol1_codec.VERSION_1):
            return receiver.hear(reception)
        beacon = decode_any(frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
            return None
        return self.hear_beacon(beacon, reception)

    def hear_beacon(self, beacon: SiteBeacon, reception: Reception) -> Fix | None:
        """Process a decoded beacon as ``hear`` does; ``reception.frame`` may be empty."""
        receiver = self._receiver
        if isinstance(beacon, Beacon):
            if isinstance(receiver, Receiver):
                return receiver.hear_beacon(beacon, reception)
            receiver.hear_other()
            return None
        if not isinstance(receiver, Receiver):
            return receiver.hear_beacon(beacon, reception)
        translator = self._translator_of(beacon.site)
        report = translator.report(beacon, reception.rx_ticks)
        return receiver.hear_beacon(translator.translated(beacon), reception, report)

    def _translator_of(self, site: int) -> Translator:
        translator = self._translators.pop(site, None) or Translator()
        self._translators[site] = translator
        if len(self._translators) > MAX_SITES:
            del self._translators[next(other for other in self._translators if other != self.site)]
        return translator
