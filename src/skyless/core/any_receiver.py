"""Beacons of either protocol, and a tag that hears both."""

from collections import Counter

from msgspec.structs import replace

from skyless.core.air.beacon import Beacon, decode_cached
from skyless.core.air.frame import Malformed, Reception, has_version
from skyless.core.air.site_choice import OF_PROTOCOL_1
from skyless.core.fix import Fix, NoFixReason
from skyless.core.integrity import IntegrityRequirement
from skyless.core.method_names import DEFAULT_METHOD, FILTERS, METHODS
from skyless.core.motion_sample import MotionSample
from skyless.core.native.records import MAX_SITES
from skyless.core.protocol1 import beacon as protocol1_codec
from skyless.core.protocol1 import receiver as protocol1
from skyless.core.protocol1.beacon import Beacon as Protocol1Beacon
from skyless.core.protocol1.snapshots import Snapshots
from skyless.core.protocol1.translator import Translator
from skyless.core.tag.joint import Estimation
from skyless.core.tag.receiver import HeardSite, Receiver

SiteBeacon = Beacon | Protocol1Beacon


def decode_any(frame: bytes) -> SiteBeacon | Malformed:
    """Decode a whole frame (FCS included) of either protocol, or return why it is no beacon; never raises.

    The last 256 frames of each protocol are cached, for programs that run many tags which receive the same bytes.
    """
    if has_version(frame, protocol1_codec.VERSION_1):
        return protocol1_codec.decode_cached(frame)
    return decode_cached(frame)


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
