"""``Receiver``: the protocol machine of one tag. Bytes and ticks in, fixes out; no I/O, no clock.

It needs nothing but beacons of protocol 2: anchors state their positions, and the common pages of a site the rest.
"""

import ctypes
from math import inf, nan
from typing import Final

from skyless.core.air.beacon import Beacon
from skyless.core.air.codec import FAULTS, fields_of
from skyless.core.air.first_path import powers_dbm
from skyless.core.air.local_almanac import LocalAlmanac
from skyless.core.air.page_check import is_possible_page
from skyless.core.air.page_codec import encode_page
from skyless.core.air.reception import Reception, phase_of
from skyless.core.air.site_choice import NO_SITE
from skyless.core.air.site_pages import NO_ISSUE
from skyless.core.estimator.settings import TUNING
from skyless.core.fix import Fix, NoFixReason
from skyless.core.integrity import IntegrityRequirement
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.native.library import compiled
from skyless.core.native.records import packed, unpacked
from skyless.core.native.sizes import MAX_PAGES, MAX_SENDERS
from skyless.core.tag.admission import DROP_COUNTERS, Admission
from skyless.core.tag.beacon_receiver import BeaconReceiver, HeardSite, MethodOptions
from skyless.core.tag.changes import (
    MOVED_ANCHOR,
    NO_PAGES,
    NO_POSITION,
    UNCONFIRMED_ANCHOR,
    WEAKER_ANCHOR,
    begin_here,
    begin_tag,
)
from skyless.core.tag.course import FIX
from skyless.core.tag.factory import ReceiverState
from skyless.core.tag.hearing import MALFORMED, hear_fields, hear_frame
from skyless.core.tag.joint import Estimation
from skyless.core.tag.tag import Tag

_UNUSED: Final = {
    NO_PAGES: (NoFixReason.NO_ALMANAC, None),
    MOVED_ANCHOR: (NoFixReason.ACQUIRING, "moved-anchor"),
    NO_POSITION: (NoFixReason.NO_ALMANAC, "no-position"),
    UNCONFIRMED_ANCHOR: (NoFixReason.TOO_FEW_ANCHORS, "unconfirmed-anchor"),
    WEAKER_ANCHOR: (NoFixReason.TOO_FEW_ANCHORS, "weaker-anchor"),
}
"""Why there is no fix of a beacon that is admitted, and by what it is counted."""


class Receiver(BeaconReceiver):
    """One listening tag of protocol 2; its positioning method is ``joint``."""

    def __init__(
        self,
        *,
        site: int | None = None,
        qa: float = 0.3,
        z_bounds_m: tuple[float, float] | None = None,
        integrity: IntegrityRequirement | None = None,
    ) -> None:
        """Make a tag that knows nothing yet.

        ``site`` is the only site to listen to, by default that with most anchors; ``qa`` the tag's process noise in
        m²/s³; ``z_bounds_m`` decides between mirror solutions; ``integrity`` is the requirement for the protection
        levels.
        """
        super().__init__(MethodOptions(DEFAULT_METHOD, qa, z_bounds_m, integrity or IntegrityRequirement()))
        self._begin(NO_SITE if site is None else site)

    def _begin(self, site: int) -> None:
        """Be a tag with these options that knows nothing yet."""
        options, required = self._options, self._options.integrity
        limit_m = nan if required.alert_limit_m is None else required.alert_limit_m
        bounds_m = options.z_bounds_m or (-inf, inf)
        levels = required.height_std_m, required.max_acceleration_mps2, required.risk, limit_m
        self._tag = Tag()
        _begin_tag(self._tag, site, options.qa, *bounds_m, *levels)
        self._tag.course.tuning = TUNING
        self._method = Estimation(self._tag.owner, course=self._tag.course)

    def state(self) -> ReceiverState:
        """All that it keeps, as it is now; to be used or encoded before its next frame, as parts are shared."""
        return ReceiverState(self._admission_state(), packed(self._tag), self._method.state())

    @classmethod
    def from_state(cls, state: ReceiverState) -> "Receiver":
        """A receiver that continues with the same bits as the one with this state.

        Raises:
            ValueError: no receiver has such a state.
        """
        made, kept = cls(), unpacked(Tag, state.tag)
        _check(kept)
        made._options = state.admission.options
        made._begin(NO_SITE)
        kept.owner, kept.course = made._tag.owner, made._tag.course
        ctypes.pointer(made._tag)[0] = kept
        if kept.has_settings:
            _begin_here(made._tag, made._method.search)
        elif state.method.start is None:
            raise ValueError("a receiver without the pages of its site has no method")
        made._method.restore(state.method)
        made._restore_admission(state.admission)
        return made

    @property
    def tag(self) -> Tag:
        """What it keeps beside its filter, and the beacon at hand."""
        return self._tag

    @property
    def admission(self) -> Admission:
        """What it knows of its own counter, of sites and of anchors."""
        return self._tag.admission

    @property
    def almanac(self) -> LocalAlmanac:
        """What it knows of its site."""
        return LocalAlmanac(self._tag.pages, self._tag.admission.neighbours)

    @property
    def method(self) -> Estimation | None:
        """The positioning method, None before the pages of the site are known."""
        return self._method if self._tag.has_settings else None

    @property
    def _estimation(self) -> Estimation | None:
        return self.method

    @property
    def heard_site(self) -> HeardSite | None:
        """Positions of the anchors so far, and the georeference, once the pages of the site are known."""
        pages = self.almanac.pages
        return None if pages is None else HeardSite(self.almanac.points_m(), pages.georeference, is_complete=True)

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air; a fix if it made one, else ``reason`` is set.

        What does not belong here is counted in ``counters`` and dropped; nothing on the air raises.
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

    def hear_beacon(self, beacon: Beacon, reception: Reception) -> Fix | None:
        """Process a beacon that is decoded already, as ``hear`` does; the frame itself may be empty."""
        page, self._tag.beacon = b"", fields_of(beacon)
        if beacon.page is not None:
            page, self._tag.beacon.page_at = b"\0" + encode_page(beacon.page), 1
        host_s = nan if reception.host_s is None else reception.host_s
        measured = *powers_dbm(reception.diagnostics), phase_of(reception)
        state, search = self._method.estimator.state, self._method.search
        outcome = _hear_fields(self._tag, state, search, page, reception.rx_ticks, host_s, *measured)
        return self._after(outcome)

    def _after(self, outcome: int) -> Fix | None:
        """What has become of a beacon."""
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
_begin_here: Final = compiled(begin_here)
_hear_frame: Final = compiled(hear_frame)
_hear_fields: Final = compiled(hear_fields)


def _check(t: Tag) -> None:
    """Check what compiled functions use as an index, and the pages, in a record that may come from anywhere.

    Raises:
        ValueError: one is beyond its table, or a page is damaged.
    """
    pages = [*t.pages.used, *t.pages.collected]
    senders = [one.sender_count for one in t.pages.collected]
    if not 0 <= t.pages.count <= MAX_PAGES or min(senders) < 0 or max(senders) > MAX_SENDERS:
        raise ValueError("the receiver's state has more pages than there can be")
    if (t.has_settings and t.pages.issue == NO_ISSUE) or not all(is_possible_page(one.contents, 0) for one in pages):
        raise ValueError("a page of the receiver's state is damaged")
