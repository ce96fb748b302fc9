"""``Receiver``: the protocol machine of one tag. Bytes and ticks in, fixes out; no I/O, no clock.

It needs only beacons of protocol 2: anchors state their positions, the site's common pages everything else.
"""

import copy
from abc import ABC, abstractmethod
from collections import Counter
from math import inf, isfinite, nan
from typing import Final, Protocol

from msgspec import Struct

from skyless.core.air.almanac import GeoreferencePage
from skyless.core.air.beacon import FAULTS, Beacon, fields_of
from skyless.core.air.frame import Reception, phase_of, powers_dbm
from skyless.core.air.site_choice import NO_SITE, SITE_MASK
from skyless.core.air.site_pages import LocalAlmanac, encode_page
from skyless.core.estimator.estimator import NO_REPORT, Report
from skyless.core.estimator.settings import TUNING
from skyless.core.fix import Fix, NoFixReason
from skyless.core.integrity import IntegrityRequirement
from skyless.core.motion_sample import MotionSample, SampleClock
from skyless.core.native.library import compiled
from skyless.core.tag.admission import COUNTER_JUMPED, DROP_COUNTERS, SITE_CHANGED, Admission, Tag
from skyless.core.tag.following import FIX
from skyless.core.tag.hearing import (
    MALFORMED,
    MOVED_ANCHOR,
    NO_PAGES,
    NO_POSITION,
    UNCONFIRMED_ANCHOR,
    WEAKER_ANCHOR,
    begin_tag,
    hear_fields,
    hear_frame,
)
from skyless.core.tag.joint import Estimation
from skyless.core.ticks import FixTime

# Common to the receivers of both protocols

NOT_DROPS: Final = frozenset({"heard", "fixes", "anchor-restart", "counter-jump", "site-change"})
"""Counters of a receiver that do not count dropped frames."""


class HeardSite(Struct, frozen=True):
    """What a tag has learnt of its site from beacons, for other parts of the program."""

    anchors_m: dict[int, tuple[float, float, float]]
    """Positions of the anchors."""
    georeference: GeoreferencePage | None
    is_complete: bool
    """Whether no georeference can follow; protocol 1 does not tell whether there is one."""


class SiteListener(Protocol):
    """What programs show of a tag besides its fixes."""

    @property
    def counters(self) -> Counter[str]:
        """Frames by outcome."""

    @property
    def reason(self) -> NoFixReason:
        """Why the last frame made no fix."""

    @property
    def site(self) -> int | None:
        """Identifier of the site in use; None before the first beacon."""

    @property
    def heard_site(self) -> HeardSite | None:
        """The site in use, once a tag knows all that it needs of it."""

    @property
    def multipath_m(self) -> tuple[float, float] | None:
        """Standard deviation and distance of changing range errors, if it exceeds the stated one."""

    @property
    def phase_anchors(self) -> tuple[int, ...]:
        """Anchors whose carrier phases are in use."""

    @property
    def motion_note(self) -> str | None:
        """What keeps a motion sensor from being used fully, in a sentence."""


class TagReceiver(SiteListener, Protocol):
    """A tag as programs, replays and simulations see it. Bytes and ticks in, fixes out; no I/O, no clock."""

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air. Returns a fix if it made one, otherwise sets ``reason``."""

    def hear_motion(self, sample: MotionSample) -> bool:
        """Process what a motion sensor or wheels of the tag show. Returns True if it was used."""


class BeaconReceiver(ABC):
    """A listening tag that understands one protocol."""

    def __init__(self) -> None:
        """Create a tag that has heard nothing."""
        self.counters: Counter[str] = Counter()
        self.reason: NoFixReason = NoFixReason.NO_BEACONS
        self._sample_clock = SampleClock()

    @property
    @abstractmethod
    def admission(self) -> Admission:
        """What the tag knows of its own counter, of the sites and of the anchors."""

    @property
    def site(self) -> int | None:
        """Identifier of the site in use; None before the first beacon."""
        choice = self.admission.choice
        return _site_of(choice.only_site if choice.site == NO_SITE else choice.site)

    @property
    @abstractmethod
    def heard_site(self) -> HeardSite | None:
        """The site in use, once a tag knows all that it needs of it."""

    @property
    def _estimation(self) -> Estimation | None:
        """The estimator, if the method is ``joint`` and in use."""
        return None

    @property
    def multipath_m(self) -> tuple[float, float] | None:
        """Standard deviation and distance of changing range errors, if it exceeds the stated one."""
        return None if self._estimation is None else self._estimation.estimator.multipath_m

    @property
    def phase_anchors(self) -> tuple[int, ...]:
        """Anchors whose carrier phases are in use."""
        return () if self._estimation is None else self._estimation.estimator.phase_anchors

    def hear_height(self, height_m: float, std_m: float) -> bool:
        """Process a reading of the tag's height sensor above the site's origin. Returns True if it was used.

        Only ``joint`` uses it. Before the first fix it bounds the search. Recordings lack these readings, and so do
        replays.

        Raises:
            ValueError: the height is not finite, or its standard deviation is not a positive length.
        """
        if not (isfinite(height_m) and 0.0 < std_m < inf):
            raise ValueError(
                f"height_m is {height_m!r} and std_m is {std_m!r}; both should be finite numbers, std_m above 0"
            )
        method = self._estimation
        return method is not None and method.update_height(height_m, std_m)

    def hear_motion(self, sample: MotionSample) -> bool:
        """Process what a motion sensor or wheels of the tag show. Returns True if it was used.

        Samples are in order of time; receptions must have the host's time. Only ``joint`` uses them, and only while
        they are no older than 0.3 s: without them the tag moves by its motion model.

        Raises:
            ValueError: a number is not finite.
        """
        sample.check()
        method = self._estimation
        ticks = None if method is None else self._sample_clock.ticks(self.admission.own, sample.time_s)
        if method is None or ticks is None:
            return False
        is_used = method.estimator.hear_motion(ticks, sample)
        self.counters["late-motion"] += not is_used
        return is_used

    @property
    def motion_note(self) -> str | None:
        """What keeps a motion sensor from being used fully, in a sentence; None if nothing does, or there is none."""
        return None if self._estimation is None else self._estimation.estimator.motion_note

    def continue_time_of(self, other: "BeaconReceiver", fix_time: FixTime) -> None:
        """Continue another receiver's counter, and count the time of fixes with ``fix_time``."""
        self.admission.time, self.admission.own = fix_time, other.admission.own

    def _count_events(self, events: int) -> None:
        """Count restarts of the tag's counter and changes of site."""
        if events & COUNTER_JUMPED:
            self.counters["counter-jump"] += 1
        if events & SITE_CHANGED:
            self.counters["site-change"] += 1

    def _count_drop(self, outcome: int) -> None:
        """Count a frame that is not used."""
        for name in DROP_COUNTERS[outcome]:
            self.counters[name] += 1

    def _judge(self, result: Fix | NoFixReason) -> Fix | None:
        """Count the result of a beacon that is used. Returns it if it is a fix."""
        if isinstance(result, Fix):
            self.counters["fixes"] += 1
            return result
        self.reason = result
        if result is NoFixReason.RESIDUALS:
            self.counters["outlier"] += 1
        return None


def _site_of(site: int) -> int | None:
    return None if site == NO_SITE else site & SITE_MASK


_UNUSED: Final = {
    NO_PAGES: (NoFixReason.NO_ALMANAC, None),
    MOVED_ANCHOR: (NoFixReason.ACQUIRING, "moved-anchor"),
    NO_POSITION: (NoFixReason.NO_ALMANAC, "no-position"),
    UNCONFIRMED_ANCHOR: (NoFixReason.TOO_FEW_ANCHORS, "unconfirmed-anchor"),
    WEAKER_ANCHOR: (NoFixReason.TOO_FEW_ANCHORS, "weaker-anchor"),
}
"""Reason for no fix, and counter, of an admitted beacon."""


class Receiver(BeaconReceiver):
    """A listening tag of protocol 2, with the method ``joint``."""

    def __init__(
        self,
        *,
        site: int | None = None,
        qa: float = 0.3,
        z_bounds_m: tuple[float, float] | None = None,
        integrity: IntegrityRequirement | None = None,
    ) -> None:
        """Create a tag that has heard nothing.

        ``site``: the only site to listen to, by default the one with most anchors. ``qa``: process noise in m²/s³.
        ``z_bounds_m``: height bounds that choose between mirror solutions. ``integrity``: requirements for the
        protection levels.
        """
        super().__init__()
        required = integrity or IntegrityRequirement()
        limit_m = nan if required.alert_limit_m is None else required.alert_limit_m
        levels = required.height_std_m, required.risk, limit_m
        self._tag = Tag()
        _begin_tag(self._tag, NO_SITE if site is None else site, qa, *(z_bounds_m or (-inf, inf)), *levels)
        self._tag.course.tuning = TUNING
        self._method = Estimation(self._tag.owner, course=self._tag.course)

    def copied(self) -> "Receiver":
        """A copy that continues with the same bits as this receiver would."""
        made = copy.deepcopy(self)
        made._method.course = made._tag.course
        return made

    @property
    def tag(self) -> Tag:
        """The tag's state beside its filter, with the current beacon."""
        return self._tag

    @property
    def admission(self) -> Admission:
        """What the tag knows of its own counter, of the sites and of the anchors."""
        return self._tag.admission

    @property
    def almanac(self) -> LocalAlmanac:
        """What the tag knows of its site."""
        return LocalAlmanac(self._tag.pages, self._tag.admission.neighbours)

    @property
    def method(self) -> Estimation | None:
        """The estimator; None before the pages of the site are known."""
        return self._method if self._tag.has_settings else None

    @property
    def _estimation(self) -> Estimation | None:
        return self.method

    @property
    def heard_site(self) -> HeardSite | None:
        """Known anchor positions and the georeference, once the pages of the site are known."""
        pages = self.almanac.pages
        return None if pages is None else HeardSite(self.almanac.points_m(), pages.georeference, is_complete=True)

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air. Returns a fix if it made one, otherwise sets ``reason``.

        Unusable frames are counted in ``counters`` and dropped; no frame raises.
        """
        frame, diagnostics, host_s = reception.frame, reception.diagnostics, reception.host_s
        rx_dbm, first_path_dbm = (nan, nan) if diagnostics is None else powers_dbm(diagnostics)
        outcome = _hear_frame(
            self._tag,
            self._method.estimator.state,
            self._method.search,
            frame,
            len(frame),
            reception.rx_ticks,
            nan if host_s is None else host_s,
            rx_dbm,
            first_path_dbm,
            phase_of(reception),
        )
        if outcome == FIX:
            counters, method = self.counters, self._method
            counters["heard"] += 1
            counters["fixes"] += 1
            return method.fix(method.estimator.rows)
        if outcome > MALFORMED:
            self.counters[FAULTS[outcome - MALFORMED - 1]] += 1
            return None
        return self._after(outcome)

    def hear_beacon(self, beacon: Beacon, reception: Reception, report: Report = NO_REPORT) -> Fix | None:
        """Process a decoded beacon as ``hear`` does; ``reception.frame`` may be empty.

        ``report``: what an anchor of protocol 1 knows of its clock.
        """
        page, packet, self._tag.beacon = b"", self._tag.packet, fields_of(beacon)
        packet.master, packet.subticks, packet.report_variance_m2 = report.master, report.subticks, report.variance_m2
        if beacon.page is not None:
            page, self._tag.beacon.page_at = b"\0" + encode_page(beacon.page), 1
        host_s = nan if reception.host_s is None else reception.host_s
        measured = *powers_dbm(reception.diagnostics), phase_of(reception)
        state, search = self._method.estimator.state, self._method.search
        outcome = _hear_fields(self._tag, state, search, page, reception.rx_ticks, host_s, *measured)
        return self._after(outcome)

    def _after(self, outcome: int) -> Fix | None:
        """Count a beacon by its outcome. Returns the fix, if it made one."""
        self._count_events(self._tag.events)
        if outcome < len(DROP_COUNTERS):
            self._count_drop(outcome)
            return None
        self.counters["heard"] += 1
        if outcome not in _UNUSED:
            return self._judge(self._method.result_of(outcome))
        self.reason, counter = _UNUSED[outcome]
        if counter is not None:
            self.counters[counter] += 1
        return None


_begin_tag: Final = compiled(begin_tag)
_hear_frame: Final = compiled(hear_frame)
_hear_fields: Final = compiled(hear_fields)
