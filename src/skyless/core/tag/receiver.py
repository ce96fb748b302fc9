"""``Receiver``: the protocol machine of one tag. Bytes and ticks in, fixes out; no I/O, no clock.

It needs nothing but beacons of protocol 2: anchors state their positions, and the common pages of a site the rest.
"""

from math import nan
from typing import Final, cast

import numpy as np

from skyless.core.air.almanac import Page
from skyless.core.air.beacon import Beacon
from skyless.core.air.codec import FAULTS, fields_of, page_of
from skyless.core.air.first_path import powers_dbm
from skyless.core.air.local_almanac import MIN_ANCHORS, PRESENT_TICKS, LocalAlmanac
from skyless.core.air.neighbours import find_neighbour, is_confirmed
from skyless.core.air.reception import Reception, phase_of
from skyless.core.air.site_choice import NO_SITE, note_fix
from skyless.core.estimator.state import State
from skyless.core.fix import Fix, NoFixReason
from skyless.core.integrity import IntegrityRequirement
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.native.library import compiled
from skyless.core.native.records import packed, unpacked
from skyless.core.native.views import view
from skyless.core.observation import Observation
from skyless.core.tag.admission import DROP_COUNTERS, Admission
from skyless.core.tag.beacon_receiver import BeaconReceiver, HeardSite, MethodOptions
from skyless.core.tag.course import FIX, Course
from skyless.core.tag.factory import ReceiverState, new_method
from skyless.core.tag.hearing import IS_RARE, MALFORMED, NO_ISSUE, Hearing, hear_fields, hear_frame
from skyless.core.tag.joint import Estimation
from skyless.core.tag.selection import is_full, replaced_by
from skyless.core.ticks import NEVER, from_seconds

MAX_WAITING: Final = 128
"""Beacons that are kept while the site's pages are not complete."""

MOVED_HOLD_TICKS: Final = from_seconds(0.3)
MOVE_TICKS: Final = from_seconds(10.0)
"""A survey moves all anchors of a site, some of them seconds after the others, and positions from before and after it
must not be mixed. So a tag uses either the anchors that have stated another position or those that have not, until none
has moved for ``MOVE_TICKS``. It switches to the moved ones once they are the majority and none has moved for
``MOVED_HOLD_TICKS``."""

_NOT_STARTED: Final = cast("tuple[Course, State]", (None, None))
"""Null pointers: neither is used while a tag is starting."""


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
        self._hearing = Hearing()
        self.admission.choice.only_site = NO_SITE if site is None else site
        self.almanac = LocalAlmanac(self.admission.neighbours)
        self._method: Estimation | None = None
        self._method_key: object = None
        self._method_period_ticks = 0
        """Mean time between two beacons of an anchor for which the method was made."""
        self._course, self._state = _NOT_STARTED
        """The method's course, and the state of its filter."""
        self._waiting: list[Observation] = []
        self._moved_ticks: dict[int, int] = {}
        """When anchors stated another position than before, until all are used together again."""
        self._uses_moved = False
        """Whether they are in use, and not the others."""

    def state(self) -> ReceiverState:
        """All that it keeps, as it is now; to be used or encoded before its next frame, as parts are shared."""
        return ReceiverState(
            admission=self._admission_state(),
            hearing=packed(self._hearing),
            method_period_ticks=self._method_period_ticks,
            method=None if self._method is None else self._method.state(),
            almanac=self.almanac.state(),
            waiting=tuple(self._waiting),
            moved_ticks=dict(self._moved_ticks),
            uses_moved=self._uses_moved,
        )

    @classmethod
    def from_state(cls, state: ReceiverState) -> "Receiver":
        """A receiver that continues with the same bits as the one with this state.

        Raises:
            ValueError: no receiver has such a state.
        """
        made = cls()
        made._hearing = unpacked(Hearing, state.hearing)
        made._restore_admission(state.admission)
        made.almanac = LocalAlmanac(made.admission.neighbours)
        made.almanac.restore(state.almanac)
        made._waiting = list(state.waiting)
        made._moved_ticks, made._uses_moved = dict(state.moved_ticks), state.uses_moved
        if state.method is not None:
            if made.almanac.pages is None:
                raise ValueError("a receiver without the pages of its site has no method")
            made._choose_method(state.method_period_ticks)
            assert made._method is not None
            made._method.restore(state.method)
        made._note_method()
        return made

    @property
    def hearing(self) -> Hearing:
        """What it keeps beside its filter, and the beacon at hand."""
        return self._hearing

    @property
    def admission(self) -> Admission:
        """What it knows of its own counter, of sites and of anchors."""
        return self._hearing.admission

    @property
    def method(self) -> Estimation | None:
        """The positioning method, None before the pages of the site are known."""
        return self._method

    @property
    def _estimation(self) -> Estimation | None:
        return self._method

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
            self._hearing,
            self._course,
            self._state,
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
            return method.fix()  # type: ignore[union-attr]  # a fix is of a method
        if outcome > MALFORMED:
            self.counters[FAULTS[outcome - MALFORMED - 1]] += 1
            return None
        return self._after(outcome, frame, None)

    def hear_beacon(self, beacon: Beacon, reception: Reception) -> Fix | None:
        """Process a beacon that is decoded already, as ``hear`` does; the frame itself may be empty."""
        self._hearing.beacon = fields_of(beacon)
        host_s = nan if reception.host_s is None else reception.host_s
        powers = powers_dbm(reception.diagnostics)
        outcome = _hear_fields(
            self._hearing, self._course, self._state, reception.rx_ticks, host_s, *powers, phase_of(reception)
        )
        return self._after(outcome, b"", beacon.page)

    def hear_height(self, height_m: float, std_m: float) -> bool:
        """Process a reading of the tag's height sensor; see ``BeaconReceiver``."""
        used = super().hear_height(height_m, std_m)
        self._note_method()
        return used

    def _after(self, outcome: int, frame: bytes, page: Page | None) -> Fix | None:
        """What has become of a beacon; the page in it stands in its frame, or is given."""
        if self.admission.events:
            self._handle_events()
            self._note_method()
        if outcome < len(DROP_COUNTERS):
            self._count_drop(outcome)
            return None
        self.counters["heard"] += 1
        if outcome == IS_RARE:
            result = self._process(frame, page)
            if isinstance(result, Fix):
                note_fix(self.admission.choice, self.admission.rx_ticks)
        else:
            assert self._method is not None
            result = self._method.result_of(outcome)
        self._note_method()
        return self._judge(result)

    def _note_method(self) -> None:
        """Let the compiled part know whether the tag knows where it is, and by which pages."""
        method = self._method
        is_starting = method is None or method.is_starting
        self._hearing.is_starting, self._hearing.is_moving = is_starting, bool(self._moved_ticks)
        self._hearing.almanac_issue = NO_ISSUE if self.almanac.issue is None else self.almanac.issue
        self._course, self._state = _NOT_STARTED if method is None else (method.course, method.estimator.state)

    def _process(self, frame: bytes, page: Page | None) -> Fix | NoFixReason:
        """Process a beacon that is admitted, with its pages, its position, and a method that may be starting."""
        hearing, beacon = self._hearing, self._hearing.beacon
        anchor, rx_ticks = beacon.anchor, self.admission.rx_ticks
        was_starting = self._method is None or self._method.is_starting
        if beacon.almanac_issue != self.almanac.issue and page is None:
            page = page_of(frame, beacon)
        if self.almanac.on_beacon(page, rx_ticks):
            self._choose_method()
        if hearing.has_moved:
            self._separate_moved(anchor, rx_ticks)
        if self._is_kept_apart(anchor, rx_ticks):
            self.counters["moved-anchor"] += 1
            return NoFixReason.ACQUIRING
        neighbour = self.almanac.newest
        if not neighbour.has_place:
            self.counters["no-position"] += 1
            return NoFixReason.NO_ALMANAC
        packet = hearing.packet
        relays = bytes(beacon.relays)[: beacon.relay_bytes]
        observation = Observation(
            anchor, view(packet.place.position_m).copy(), 0, beacon.sequence, rx_ticks, packet.tx_ticks, None, None,
            None, 0.0, 0.0, (), None, packet.variance_factor, relays, packet.place.std_m,
            packet.phase_cycles if packet.has_phase else -1.0, (), beacon.has_phases,
        )  # fmt: skip
        method = self._method
        if method is None:
            self._waiting = [*self._waiting[1 - MAX_WAITING :], observation]
            return NoFixReason.NO_ALMANAC
        for waiting in self._waiting:
            if self._is_confirmed(waiting.anchor):
                method.update(waiting)
        self._waiting = []
        if not self._may_join(method, observation):
            return NoFixReason.TOO_FEW_ANCHORS
        result = method.update(observation)
        if was_starting and not method.is_starting:
            self._begin(method)
        return result

    def _begin(self, method: Estimation) -> None:
        """From now on what anchors in use have received counts, and what those have."""
        misfits = method.estimator.misfits
        for row in self.almanac.rows:
            row.relayed_ticks = row.own_relays_ticks = NEVER
            row.is_misfit = row.anchor in misfits

    def _separate_moved(self, anchor: int, rx_ticks: int) -> None:
        """An anchor states another position: it leaves, and where too few are left that have not, all begin again."""
        if self._uses_moved and anchor in self._moved_ticks:  # those in use move a second time
            self._moved_ticks, self._uses_moved = {}, False
        self._moved_ticks[anchor] = rx_ticks
        self._waiting = [one for one in self._waiting if one.anchor != anchor]
        method = self._method
        if method is not None:
            was_starting, remaining = method.is_starting, method.remove_anchor(anchor)
            if not was_starting and remaining < MIN_ANCHORS:
                self._renew_method()

    def _is_kept_apart(self, anchor: int, rx_ticks: int) -> bool:
        """Whether an anchor states its position before a move while the anchors in use have moved, or the reverse."""
        moved = self._moved_ticks
        if not moved:
            return False
        calm_ticks = rx_ticks - max(moved.values())
        if calm_ticks >= MOVE_TICKS:
            self._moved_ticks, self._uses_moved = {}, False
            return False
        if not self._uses_moved and anchor in moved and calm_ticks >= MOVED_HOLD_TICKS:
            present = self.almanac.placed_since(rx_ticks - PRESENT_TICKS)
            if 2 * len(present & moved.keys()) > len(present):
                self._uses_moved = True
                self._waiting = [one for one in self._waiting if one.anchor in moved]
                self._renew_method()
        return (anchor in moved) is not self._uses_moved

    def _renew_method(self) -> None:
        """Begin again with the same pages."""
        self._method_key = None
        self._choose_method()

    def _is_confirmed(self, anchor: int) -> bool:
        """Whether other anchors have recently received an anchor, or its own relays have fitted."""
        row = find_neighbour(self.admission.neighbours, anchor)
        return row >= 0 and is_confirmed(self.admission.neighbours.rows[row], self.admission.rx_ticks)

    def _may_join(self, method: Estimation, observation: Observation) -> bool:
        """Whether an anchor is in use or may be: others have received it, and it is not weaker than 24 in use."""
        estimator, anchor = method.estimator, observation.anchor
        if estimator.has_anchor(anchor) and not method.is_starting:
            return True
        if not self._is_confirmed(anchor):
            self.counters["unconfirmed-anchor"] += 1
            return False
        in_use = estimator.anchors
        if method.is_starting or not is_full(in_use):
            return True
        position_m, points_m = estimator.position_m(), self.almanac.points_m()
        ranges_m = {
            one: float(np.linalg.norm(np.array(points_m[one][: estimator.dim]) - position_m))
            for one in (anchor, *in_use)
            if one in points_m
        }
        powers_dbm = {row.anchor: row.power_dbm for row in self.almanac.rows if row.has_power}
        replaced = replaced_by(anchor, powers_dbm, ranges_m)
        if replaced is None:
            self.counters["weaker-anchor"] += 1
            return False
        estimator.remove_anchor(replaced)
        return True

    def _forget_site(self) -> None:
        self.almanac = LocalAlmanac(self.admission.neighbours)

    def _forget_stamps(self) -> None:
        self.almanac.forget_times()
        self._waiting = []
        self._moved_ticks, self._uses_moved = {}, False
        self._method = self._method_key = None
        if self.almanac.pages is not None:
            self._choose_method(self._method_period_ticks)

    def _choose_method(self, method_period_ticks: int | None = None) -> None:
        """Make the method that the common pages require, unless it is in use already.

        ``method_period_ticks``: for which it was made, where it continues from a state, or begins again at the site.
        """
        pages = self.almanac.pages
        assert pages is not None
        method_key = (pages.site.tag_height_m, pages.noise, pages.accuracy)
        if method_key != self._method_key:
            self._method_key = method_key
            if method_period_ticks is None:
                method_period_ticks = self.almanac.longest_period_ticks()
            self._method_period_ticks = method_period_ticks
            self._method = new_method(self._options, pages, self._method_period_ticks, self.admission.time)


_hear_frame: Final = compiled(hear_frame)
_hear_fields: Final = compiled(hear_fields)
