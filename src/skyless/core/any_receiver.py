"""Both protocols behind one door: what depends on which a site uses, and a tag that finds it out."""

from collections import Counter
from collections.abc import Callable
from functools import partial
from statistics import median
from typing import Any, Final, Protocol

from msgspec import Struct

from skyless.core.air.almanac import suitable_period_s
from skyless.core.air.beacon import VERSION_2, Beacon, decode_cached
from skyless.core.air.frame import Malformed, Reception, Transmission, has_version
from skyless.core.anchor import Anchor, BeaconAuthentication
from skyless.core.fix import Fix, NoFixReason
from skyless.core.geometry import anchors_in_reach
from skyless.core.integrity import IntegrityRequirement
from skyless.core.method_names import DEFAULT_METHOD, FILTERS
from skyless.core.protocol1 import anchor as protocol1_anchor
from skyless.core.protocol1 import beacon as protocol1_codec
from skyless.core.protocol1 import receiver as protocol1
from skyless.core.protocol1.beacon import Beacon as Protocol1Beacon
from skyless.core.protocol1.beacon import schedule_of
from skyless.core.protocol1.snapshots import Snapshots
from skyless.core.site import Site
from skyless.core.tag.joint import Estimation
from skyless.core.tag.receiver import HeardSite, Receiver, ReceiverState

# The two protocols: what depends on which of them a site uses is asked for here, and nowhere by its mode.

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


class AnyReceiverState(Struct, frozen=True, tag="any"):
    """All that an ``AnyReceiver`` keeps."""

    receiver: ReceiverState | protocol1.ReceiverState
    others: int


MAX_OTHERS: Final = 200
"""Beacons of the other protocol, without a fix meanwhile, after which a tag listens to that one."""


class AnyReceiver:
    """One listening tag, at a site of either protocol. Bytes and ticks in, fixes out; no I/O, no clock.

    It listens to the protocol of its first beacon, and to the other one once it receives that and has no fixes.
    """

    def __init__(
        self,
        method: str = DEFAULT_METHOD,
        *,
        site: int | None = None,
        qa: float = 0.3,
        z_bounds_m: tuple[float, float] | None = None,
        integrity: IntegrityRequirement | None = None,
    ) -> None:
        """Make a tag that knows nothing yet, with the options of ``skyless.Receiver``.

        ``method`` is one of ``METHODS``; all but ``joint`` are methods of protocol 1.

        Raises:
            ValueError: there is no such method.
        """
        options: Any = {"site": site, "qa": qa, "z_bounds_m": z_bounds_m, "integrity": integrity}
        self._new: Callable[[], Receiver] = partial(Receiver, **options)
        self._new_1: Callable[[], protocol1.Receiver] = partial(protocol1.Receiver, method, **options)
        self._may_change = method in FILTERS
        self._receiver: Receiver | protocol1.Receiver = self._new() if self._may_change else self._new_1()
        self._others = 0
        """Beacons of the other protocol since the last fix."""

    def state(self) -> AnyReceiverState:
        """All that it keeps, as it is now; to be used or encoded before its next frame, as parts are shared."""
        return AnyReceiverState(self._receiver.state(), self._others)

    @classmethod
    def from_state(cls, state: AnyReceiverState | ReceiverState) -> "AnyReceiver":
        """A receiver that continues with the same bits as the one with this state, which may be a ``Receiver``.

        Raises:
            ValueError: no receiver has such a state.
        """
        state = AnyReceiverState(state, 0) if isinstance(state, ReceiverState) else state
        admission = state.receiver.admission
        options = admission.options
        made = cls(
            options.method,
            site=admission.only_site,
            qa=options.qa,
            z_bounds_m=options.z_bounds_m,
            integrity=options.integrity,
        )
        saved = state.receiver
        if isinstance(saved, ReceiverState):
            made._receiver = Receiver.from_state(saved)
        else:
            made._receiver = protocol1.Receiver.from_state(saved)
        made._others = state.others
        return made

    @property
    def receiver(self) -> Receiver | protocol1.Receiver:
        """The receiver of the protocol in use."""
        return self._receiver

    @property
    def counters(self) -> Counter[str]:
        """Frames by what became of them."""
        return self._receiver.counters

    @property
    def reason(self) -> NoFixReason:
        """Why the last frame has made no fix."""
        if not self._may_change and self.counters["other-version"] and not self.counters["heard"]:
            return NoFixReason.NO_MASTER
        return self._receiver.reason

    @property
    def site(self) -> int | None:
        """Identifier of the site that it receives, None before the first beacon."""
        return self._receiver.site

    @property
    def method(self) -> Estimation | Snapshots | None:
        """The positioning method in use, None before the almanac is known."""
        return self._receiver.method

    @property
    def multipath_m(self) -> tuple[float, float] | None:
        """Standard deviation by which ranges change, and over which distance, where it exceeds what the site states."""
        return self._receiver.multipath_m

    @property
    def phase_anchors(self) -> tuple[int, ...]:
        """Identifiers of the anchors the phases of whose carriers are in use."""
        return self._receiver.phase_anchors

    @property
    def heard_site(self) -> HeardSite | None:
        """Anchors and georeference of the site, None before they are known."""
        return self._receiver.heard_site

    def hear_height(self, height_m: float, std_m: float) -> bool:
        """Process a reading of the tag's height sensor, as ``Receiver.hear_height`` does."""
        return self._receiver.hear_height(height_m, std_m)

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air; a fix if it made one, else ``reason`` is set.

        What does not belong here is counted in ``counters`` and dropped; nothing on the air raises.
        """
        receiver, frame = self._receiver, reception.frame
        if isinstance(receiver, Receiver) and has_version(frame, VERSION_2):
            fix = receiver.hear(reception)
            if fix is not None:
                self._others = 0
            return fix
        beacon = decode_any(frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
            return None
        return self.hear_beacon(beacon, reception)

    def hear_beacon(self, beacon: SiteBeacon, reception: Reception) -> Fix | None:
        """Process a beacon that is decoded already, as ``hear`` does; of protocol 2 the frame itself may be empty."""
        if isinstance(beacon, Beacon) is not isinstance(self._receiver, Receiver) and not self._change():
            self.counters["other-version"] += 1
            return None
        fix = self._receiver.hear_beacon(beacon, reception)  # type: ignore[arg-type]  # it is of its protocol
        if fix is not None:
            self._others = 0
        return fix

    def _change(self) -> bool:
        """Listen to the other protocol, unless the present one gives fixes, or may still."""
        if not self._may_change:
            return False
        self._others += 1
        if self.counters["heard"] and self._others <= MAX_OTHERS:
            return False
        counters = self.counters
        self._receiver = self._new_1() if isinstance(self._receiver, Receiver) else self._new()
        self._receiver.counters.update(counters)
        self._others = 0
        return True
