"""``Receiver``: the protocol machine of one tag. Bytes and ticks in, fixes out; no I/O, no clock.

It needs nothing but beacons of protocol 2: anchors state their positions, and the common pages of a site the rest.
"""

from typing import Final

import numpy as np

from skyless.core.air.beacon import Beacon
from skyless.core.air.codec import decode_cached, packed_relays
from skyless.core.air.frame import Malformed
from skyless.core.air.instants import period_ticks
from skyless.core.air.local_almanac import MIN_ANCHORS, PRESENT_TICKS, LocalAlmanac
from skyless.core.air.reception import Reception
from skyless.core.fix import Fix, NoFixReason
from skyless.core.integrity import IntegrityRequirement
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.observation import Observation
from skyless.core.tag.beacon_receiver import BeaconReceiver, HeardSite, MethodOptions, variance_factor_of
from skyless.core.tag.factory import ReceiverState, new_method
from skyless.core.tag.joint import Estimation
from skyless.core.tag.selection import MIN_FITTING, AnchorSelection, fitting_relays, is_full
from skyless.core.ticks import from_seconds

MAX_WAITING: Final = 128
"""Beacons that are kept while the site's pages are not complete."""

MOVED_HOLD_TICKS: Final = from_seconds(0.3)
MOVE_TICKS: Final = from_seconds(10.0)
"""A survey moves all anchors of a site, some of them seconds after the others, and positions from before and after it
must not be mixed. So a tag uses either the anchors that have stated another position or those that have not, until none
has moved for ``MOVE_TICKS``. It switches to the moved ones once they are the majority and none has moved for
``MOVED_HOLD_TICKS``."""


class Receiver(BeaconReceiver[Beacon]):
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
        super().__init__(MethodOptions(DEFAULT_METHOD, qa, z_bounds_m, integrity or IntegrityRequirement()), site)
        self.almanac = LocalAlmanac()
        self._method: Estimation | None = None
        self._method_key: object = None
        self._method_period_ticks = 0
        """Mean time between two beacons of an anchor for which the method was made."""
        self._selection = AnchorSelection()
        self._waiting: list[Observation] = []
        self._moved_ticks: dict[int, int] = {}
        """When anchors stated another position than before, until all are used together again."""
        self._uses_moved = False
        """Whether they are in use, and not the others."""

    def state(self) -> ReceiverState:
        """All that it keeps, as it is now; to be used or encoded before its next frame, as parts are shared."""
        return ReceiverState(
            admission=self._admission_state(),
            method_period_ticks=self._method_period_ticks,
            method=None if self._method is None else self._method.state(),
            almanac=self.almanac.state(),
            selection=self._selection,
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
        made._restore_admission(state.admission)
        made.almanac.restore(state.almanac)
        made._selection = state.selection
        made._waiting = list(state.waiting)
        made._moved_ticks, made._uses_moved = dict(state.moved_ticks), state.uses_moved
        if state.method is not None:
            if made.almanac.pages is None:
                raise ValueError("a receiver without the pages of its site has no method")
            made._choose_method(state.method_period_ticks)
            assert made._method is not None
            made._method.restore(state.method)
        return made

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

    def _decode(self, frame: bytes) -> Beacon | Malformed:
        return decode_cached(frame)

    def _period_ticks(self, beacon: Beacon) -> int:
        return period_ticks(beacon.period_code)

    def _process(self, beacon: Beacon, reception: Reception, rx_ticks: int, tx_ticks: int) -> Fix | NoFixReason:
        """Process a beacon: its own position counts, and whom its relays confirm."""
        anchor, relays = beacon.anchor, packed_relays(beacon)
        diagnostics = reception.diagnostics
        if diagnostics is not None and diagnostics.rx_power_dbm is not None:
            self._selection.add_power(anchor, diagnostics.rx_power_dbm)
        was_starting = self._method is None or self._method.is_starting
        before_m = self.almanac.position_m(anchor)
        if self.almanac.on_beacon(beacon, rx_ticks, self._confirm(anchor, relays, rx_ticks, tx_ticks)):
            self._choose_method()
        anchor_m = self.almanac.position_m(anchor)
        if anchor_m is not before_m and before_m is not None:
            self._separate_moved(anchor, rx_ticks)
        if self._is_kept_apart(anchor, rx_ticks):
            self.counters["moved-anchor"] += 1
            return NoFixReason.ACQUIRING
        if anchor_m is None:
            self.counters["no-position"] += 1
            return NoFixReason.NO_ALMANAC
        observation = Observation(
            anchor, anchor_m, 0, beacon.sequence, rx_ticks, tx_ticks, None, None, None, 0.0, 0.0, (), None,
            variance_factor_of(reception), relays, self.almanac.std_m(anchor),
        )  # fmt: skip
        method = self._method
        if method is None:
            self._waiting = [*self._waiting[1 - MAX_WAITING :], observation]
            return NoFixReason.NO_ALMANAC
        for waiting in self._waiting:
            if self._selection.is_confirmed(waiting.anchor, rx_ticks):
                method.update(waiting)
        self._waiting = []
        if not self._may_join(method, observation):
            return NoFixReason.TOO_FEW_ANCHORS
        result = method.update(observation)
        if was_starting and not method.is_starting:
            self._selection.forget_times()  # from now on what anchors in use have received counts, and what those have
        return result

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

    def _confirm(self, anchor: int, relays: bytes, rx_ticks: int, tx_ticks: int) -> bool:
        """Process which anchors a beacon confirms by its relays; whether other anchors confirm its sender."""
        method = self._method
        is_starting = method is None or method.is_starting
        in_use = method is not None and not is_starting and method.estimator.has_anchor(anchor)
        by_others = self._selection.is_confirmed_by_others(anchor, rx_ticks, in_use=in_use)
        if by_others or is_starting or self._has_too_few(rx_ticks):
            self._selection.add_relays(relays, rx_ticks)
        elif fitting_relays(relays, tx_ticks, rx_ticks, self._packet_in_use) >= MIN_FITTING:
            self._selection.confirm_by_own_relays(anchor, rx_ticks)
        return by_others

    def _packet_in_use(self, anchor: int) -> tuple[int, int] | None:
        """Sequence number and own RX stamp of the last beacon of an anchor in use."""
        track = self._stamps.tracks.of_anchor.get(anchor)
        in_use = self._method is not None and self._method.estimator.has_anchor(anchor)
        return (track.sequence, track.rx_ticks_tag) if track is not None and in_use else None

    def _has_too_few(self, rx_ticks: int) -> bool:
        """Whether fewer anchors in use are still received than a fix takes, so that relays of any anchor confirm.

        A tag may come to where none of its anchors is received, nor receives the next ones: out of a lift.
        """
        assert self._method is not None
        estimator = self._method.estimator
        return estimator.heard_since(rx_ticks - from_seconds(estimator.settings.drop_s)) < MIN_ANCHORS

    def _may_join(self, method: Estimation, observation: Observation) -> bool:
        """Whether an anchor is in use or may be: others have received it, and it is not weaker than 24 in use."""
        estimator, anchor = method.estimator, observation.anchor
        if estimator.has_anchor(anchor) and not method.is_starting:
            return True
        if not self._selection.is_confirmed(anchor, observation.rx_ticks_tag):
            self.counters["unconfirmed-anchor"] += 1
            return False
        in_use = estimator.anchors
        if method.is_starting or not is_full(in_use):
            return True
        position_m = estimator.position_m()
        ranges_m = {anchor: float(np.linalg.norm(observation.anchor_m[: estimator.dim] - position_m))}
        for one in in_use:
            one_m = self.almanac.position_m(one)
            if one_m is not None:
                ranges_m[one] = float(np.linalg.norm(one_m[: estimator.dim] - position_m))
        replaced = self._selection.replaced_by(anchor, ranges_m)
        if replaced is None:
            self.counters["weaker-anchor"] += 1
            return False
        estimator.remove_anchor(replaced)
        return True

    def _forget_site(self) -> None:
        self.almanac = LocalAlmanac()

    def _forget_stamps(self) -> None:
        self.almanac.forget_times()
        self._selection.forget_times()
        self._waiting = []
        self._moved_ticks, self._uses_moved = {}, False
        self._method = self._method_key = None
        if self.almanac.pages is not None:
            self._choose_method()

    def _choose_method(self, method_period_ticks: int | None = None) -> None:
        """Make the method that the common pages require, unless it is in use already.

        ``method_period_ticks``: for which it was made, where it continues from a state.
        """
        pages = self.almanac.pages
        assert pages is not None
        method_key = (pages.site.tag_height_m, pages.noise, pages.accuracy)
        if method_key != self._method_key:
            self._method_key = method_key
            self._method_period_ticks = method_period_ticks or self.almanac.longest_period_ticks()
            self._method = new_method(self._options, pages, self._method_period_ticks, self._time)
