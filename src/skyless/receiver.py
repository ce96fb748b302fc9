"""``Receiver``: the protocol machine of one tag. Bytes and ticks in, fixes out; no I/O, no clock.

It needs nothing but beacons: anchors, schedule and noise figures come from the almanac on the air.
"""

from collections import Counter
from math import inf, isfinite
from typing import TYPE_CHECKING, Final, cast

import numpy as np

from skyless.air.beacon import Beacon, Malformed
from skyless.air.beacon2 import Beacon2
from skyless.air.codec2 import packed_relays_2
from skyless.air.frames import AnyBeacon, decode_any
from skyless.air.master_term import FollowedMaster
from skyless.air.reception import Diagnostics, Reception
from skyless.air.site_choice import SiteChoice, SiteKey, SiteUse
from skyless.constants import TICK_S
from skyless.kernels.arrays import Array
from skyless.method_names import DEFAULT_METHOD, FILTERS, METHODS
from skyless.positioning.fix import Fix, NoFixReason
from skyless.positioning.integrity import IntegrityRequirement
from skyless.positioning.methods.observations import (
    AnchorStamps,
    FixTime,
    Observer,
    observe_2,
    variance_factor,
)
from skyless.positioning.methods.selection import (
    LEAST_FITTING,
    AnchorSelection,
    fitting_relays,
    is_full,
)
from skyless.positioning.observation import Observation
from skyless.site.almanac_pages import AlmanacAssembly
from skyless.site.local_almanac import LEAST_ANCHORS, PRESENT_TICKS, LocalAlmanac
from skyless.site.slots import schedule_from_page
from skyless.ticks import LAST_TICKS, Unwrapper, from_seconds

if TYPE_CHECKING:
    # These load Numba and all kernels: only who makes a receiver waits for that, not who imports its class.
    from skyless.positioning.methods.joint import Estimation
    from skyless.positioning.methods.snapshots import Snapshots
    from skyless.receiver_state import ReceiverState

MOST_WAITING: Final = 128
"""Beacons that are kept while the site's pages are not complete (protocol 2)."""

MOVED_HOLD_TICKS: Final = from_seconds(0.3)
MOVE_TICKS: Final = from_seconds(10.0)
"""A survey moves all anchors of a site, some of them seconds after the others, and positions from before and after it
must not be mixed. So a tag uses either the anchors that have stated another position or those that have not, until none
has done so for the latter time. It goes over to those that have when they are the more, and none has for the former
time."""

NOT_DROPS: Final = frozenset({"heard", "fixes", "anchor-restart", "counter-jump", "site-change"})
"""Counters of a receiver that do not count dropped frames."""

COUNTER_JUMP_TICKS: Final = from_seconds(1.0)
"""Stamps that go back farther than radios and hosts reorder them mean that the tag's own counter has restarted."""


class Receiver:
    """One listening tag."""

    def __init__(
        self,
        method: str = DEFAULT_METHOD,
        *,
        site: int | None = None,
        qa: float = 0.3,
        z_bounds_m: tuple[float, float] | None = None,
        integrity: IntegrityRequirement | None = None,
    ) -> None:
        """Make a tag that knows nothing yet.

        ``method`` is one of ``METHODS``; ``site`` the only site to listen to, by default that with most anchors;
        ``qa`` the tag's process noise in m²/s³ (filters); ``z_bounds_m`` decides between mirror solutions;
        ``integrity`` is the requirement for the protection levels (``joint``).

        Raises:
            ValueError: there is no such method.
        """
        from skyless.positioning.methods.factory import MethodOptions  # noqa: PLC0415 - loads the kernels

        if method not in METHODS:
            raise ValueError(f"method {method!r} is not one of {', '.join(METHODS)}")
        self.counters: Counter[str] = Counter()
        self.reason: NoFixReason = NoFixReason.NO_BEACONS
        self.almanac = AlmanacAssembly()
        """Of a site of protocol 1."""
        self.local_almanac = LocalAlmanac()
        """Of a site of protocol 2."""
        self._options = MethodOptions(method, qa, z_bounds_m, integrity or IntegrityRequirement())
        self._choice = SiteChoice(site)
        self._time = FixTime()
        self._own_ticks = Unwrapper()
        self._stamps = AnchorStamps(self.counters)
        self._observer = Observer()
        self._method: Estimation | Snapshots | None = None
        self._method_key: object = None
        self._superframe_ticks = 0
        self._followed = FollowedMaster()
        self._master: int | None = None
        self._positions: dict[int, Array] = {}
        self._positions_issue: int | None = None
        self._selection = AnchorSelection()
        self._waiting: list[Observation] = []
        self._moved_ticks: dict[int, int] = {}
        """When anchors of protocol 2 stated another position than before, until all are used together again."""
        self._uses_moved = False
        """Whether they are in use, and not the others."""

    def state(self) -> "ReceiverState":
        """All that it keeps, as it is now."""
        from skyless.receiver_state import ReceiverState  # noqa: PLC0415 - its types load the kernels

        return ReceiverState(
            options=self._options,
            choice=self._choice,
            counters=dict(self.counters),
            reason=self.reason,
            almanac=self.almanac.state(),
            time=self._time,
            own_ticks=self._own_ticks,
            stamps=self._stamps.tracks,
            followed=self._followed,
            master=self._master,
            master_scale=self._observer.scale,
            superframe_ticks=self._superframe_ticks,
            has_method_key=self._method_key is not None,
            method=None if self._method is None else self._method.state(),
            local_almanac=self.local_almanac.state(),
            selection=self._selection.state(),
            waiting=tuple(self._waiting),
            moved_ticks=dict(self._moved_ticks),
            uses_moved=self._uses_moved,
        )

    @classmethod
    def from_state(cls, state: "ReceiverState") -> "Receiver":
        """A receiver that continues with the same bits as the one with this state.

        Raises:
            ValueError: no receiver has such a state.
        """
        from skyless.positioning.methods.joint import Estimation, EstimationState  # noqa: PLC0415 - kernels
        from skyless.positioning.methods.snapshots import Snapshots, SnapshotsState  # noqa: PLC0415 - kernels

        options = state.options
        made = cls(options.method, qa=options.qa, z_bounds_m=options.z_bounds_m, integrity=options.integrity)
        made._choice, made._superframe_ticks = state.choice, state.superframe_ticks
        made.local_almanac.restore(state.local_almanac)
        made._selection.restore(state.selection)
        made._waiting = list(state.waiting)
        made._moved_ticks, made._uses_moved = dict(state.moved_ticks), state.uses_moved
        made.counters.update(state.counters)
        made.reason = state.reason
        made._time, made._own_ticks, made._followed = state.time, state.own_ticks, state.followed
        made._stamps = AnchorStamps(made.counters, state.stamps)
        made.almanac.restore(state.almanac)
        made._read_positions()
        made._master, made._observer.scale = state.master, state.master_scale
        made._observer.set_master(state.master, made.almanac.slot_of(state.master) or 0)
        if state.has_method_key and state.choice.key is not None:
            if state.choice.key.version == 1:
                made._choose_method()
            else:
                made._choose_method_2(state.superframe_ticks)
        match made._method, state.method:
            case Estimation() as method, EstimationState() as saved:
                method.restore(saved)
            case Snapshots() as method, SnapshotsState() as saved:
                method.restore(saved)
            case None, None:
                pass
            case other, saved:
                raise ValueError(f"{type(saved).__name__} is not a state of {type(other).__name__}")
        return made

    @property
    def site(self) -> int | None:
        """Identifier of the site that it receives, None before the first beacon."""
        return self._choice.only_site if self._choice.key is None else self._choice.key.site

    @property
    def method(self) -> "Estimation | Snapshots | None":
        """The positioning method in use, None before the almanac is known."""
        return self._method

    @property
    def _joint(self) -> "Estimation | None":
        """The method in use where it is ``joint``, the only one that protocol 2 has."""
        return cast("Estimation | None", self._method) if self._options.method in FILTERS else None

    @property
    def multipath_m(self) -> tuple[float, float] | None:
        """Standard deviation by which ranges change, and over which distance, where it exceeds what the site states."""
        return None if self._joint is None else self._joint.estimator.multipath_m

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air; a fix if it made one, else ``reason`` is set.

        What does not belong here is counted in ``counters`` and dropped; nothing on the air raises.
        """
        beacon = decode_any(reception.frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
            return None
        return self.hear_beacon(beacon, reception)

    def hear_beacon(self, beacon: AnyBeacon, reception: Reception) -> Fix | None:
        """Process a beacon that is decoded already, as ``hear`` does; of protocol 2 the frame itself may be empty."""
        rx_ticks = self._own_ticks.unwrap(reception.rx_ticks, reception.host_s)
        tx_ticks = self._admit(beacon, rx_ticks)
        if tx_ticks is None:
            return None
        self.counters["heard"] += 1
        if isinstance(beacon, Beacon2):
            result = self._process_2(beacon, rx_ticks, tx_ticks, reception.diagnostics)
        else:
            result = self._process(beacon, reception, rx_ticks, tx_ticks)
        if isinstance(result, Fix):
            self.counters["fixes"] += 1
            self._choice.on_fix(rx_ticks)
            return result
        self.reason = result
        if result is NoFixReason.RESIDUALS:
            self.counters["outlier"] += 1
        return None

    def _process(self, beacon: Beacon, reception: Reception, rx_ticks: int, tx_ticks: int) -> Fix | NoFixReason:
        """Process a beacon of protocol 1."""
        self._read_almanac(beacon)
        method, anchor_m = self._method, self._positions.get(beacon.anchor)
        if method is None or anchor_m is None:
            return NoFixReason.NO_ALMANAC
        frame, diagnostics = reception.frame, reception.diagnostics
        scale, master_term = 1.0 if diagnostics is None else _variance_scale(diagnostics), self._followed.master_term
        return method.update(self._observer.observe(frame, beacon, anchor_m, rx_ticks, tx_ticks, scale, master_term))

    def _process_2(
        self, beacon: Beacon2, rx_ticks: int, tx_ticks: int, diagnostics: Diagnostics | None
    ) -> Fix | NoFixReason:
        """Process a beacon of protocol 2: the claims in it do not matter, its own position does."""
        anchor, relays = beacon.anchor, packed_relays_2(beacon)
        if diagnostics is not None and diagnostics.rx_power_dbm is not None:
            self._selection.add_power(anchor, diagnostics.rx_power_dbm)
        was_starting = self._joint is None or self._joint.is_starting
        before_m = self.local_almanac.position_m(anchor)
        if self.local_almanac.on_beacon(beacon, rx_ticks, self._confirm(anchor, relays, rx_ticks, tx_ticks)):
            self._choose_method_2()
        anchor_m = self.local_almanac.position_m(anchor)
        if anchor_m is not before_m and before_m is not None:
            self._separate_moved(anchor, rx_ticks)
        if self._is_kept_apart(anchor, rx_ticks):
            self.counters["moved-anchor"] += 1
            return NoFixReason.ACQUIRING
        if anchor_m is None:
            self.counters["no-position"] += 1
            return NoFixReason.NO_ALMANAC
        scale = 1.0 if diagnostics is None else _variance_scale(diagnostics)
        std_m = self.local_almanac.std_m(anchor)
        observation = observe_2(beacon, relays, anchor_m, std_m, rx_ticks, tx_ticks, scale)
        method = self._joint
        if method is None:
            self._waiting = [*self._waiting[1 - MOST_WAITING :], observation]
            return NoFixReason.NO_ALMANAC if self.local_almanac.pages is None else NoFixReason.NO_MASTER
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
        method = self._joint
        if method is not None:
            was_starting, remaining = method.is_starting, method.remove_anchor(anchor)
            if not was_starting and remaining < LEAST_ANCHORS:
                self._renew_method()

    def _is_kept_apart(self, anchor: int, rx_ticks: int) -> bool:
        """Whether an anchor states its position of before a move while those in use have moved, or the reverse."""
        moved = self._moved_ticks
        if not moved:
            return False
        calm_ticks = rx_ticks - max(moved.values())
        if calm_ticks >= MOVE_TICKS:
            self._moved_ticks, self._uses_moved = {}, False
            return False
        if not self._uses_moved and anchor in moved and calm_ticks >= MOVED_HOLD_TICKS:
            present = self.local_almanac.placed_since(rx_ticks - PRESENT_TICKS)
            if 2 * len(present & moved.keys()) > len(present):
                self._uses_moved = True
                self._waiting = [one for one in self._waiting if one.anchor in moved]
                self._renew_method()
        return (anchor in moved) is not self._uses_moved

    def _renew_method(self) -> None:
        """Begin again with the same pages."""
        self._method_key = None
        self._choose_method_2(self._superframe_ticks)

    def _confirm(self, anchor: int, relays: bytes, rx_ticks: int, tx_ticks: int) -> bool:
        """Process which anchors a beacon confirms by its relays; whether other anchors confirm its sender."""
        method = self._joint
        is_starting = method is None or method.is_starting
        in_use = method is not None and not is_starting and method.estimator.has_anchor(anchor)
        by_others = self._selection.is_confirmed_by_others(anchor, rx_ticks, in_use=in_use)
        if by_others or is_starting or self._has_too_few(rx_ticks):
            self._selection.add_relays(relays, rx_ticks)
        elif fitting_relays(relays, tx_ticks, rx_ticks, self._packet_in_use) >= LEAST_FITTING:
            self._selection.confirm_by_own_relays(anchor, rx_ticks)
        return by_others

    def _packet_in_use(self, anchor: int) -> tuple[int, int] | None:
        """Sequence number and own RX stamp of the last beacon of an anchor in use."""
        track = self._stamps.tracks.of_anchor.get(anchor)
        in_use = self._joint is not None and self._joint.estimator.has_anchor(anchor)
        return (track.sequence, track.rx_ticks_tag) if track is not None and in_use else None

    def _has_too_few(self, rx_ticks: int) -> bool:
        """Whether fewer anchors in use are still received than a fix takes, so that relays of any anchor confirm.

        A tag may come to where none of its anchors is received, nor receives the next ones: out of a lift.
        """
        assert self._joint is not None
        state = self._joint.estimator.state
        is_present = (rx_ticks - state.anchors["rx_ticks"]) * TICK_S <= state.settings[0]["drop_s"]
        return int(np.count_nonzero(is_present & (state.anchors["packets"] > 0))) < LEAST_ANCHORS

    def _may_join(self, method: "Estimation", observation: Observation) -> bool:
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
        position_m = estimator.state.x[: estimator.dim]
        ranges_m = {anchor: float(np.linalg.norm(observation.anchor_m[: estimator.dim] - position_m))}
        for one in in_use:
            one_m = self.local_almanac.position_m(one)
            if one_m is not None:
                ranges_m[one] = float(np.linalg.norm(one_m[: estimator.dim] - position_m))
        replaced = self._selection.replaced_by(anchor, ranges_m)
        if replaced is None:
            self.counters["weaker-anchor"] += 1
            return False
        estimator.remove_anchor(replaced)
        return True

    def hear_height(self, height_m: float, std_m: float) -> bool:
        """Process a reading of the tag's height sensor, above the site's origin, at the present; True if it was used.

        Only ``joint`` uses it. Before the first fix it limits the heights at which a position is sought. Recordings do
        not hold these readings, so a replay lacks them.

        Raises:
            ValueError: the height is not finite, or its standard deviation not a length.
        """
        if not (isfinite(height_m) and 0.0 < std_m < inf):
            raise ValueError(
                f"height_m is {height_m!r} and std_m is {std_m!r}; both should be finite numbers, std_m above 0"
            )
        method = self._joint
        return method is not None and method.update_height(height_m, std_m)

    def _admit(self, beacon: AnyBeacon, rx_ticks: int) -> int | None:
        """TX stamp, unwrapped, of a beacon of the site, by the present master, and of an anchor that may be there."""
        newest = self._stamps.tracks.newest_rx_ticks
        jumped = newest is not None and rx_ticks < newest - COUNTER_JUMP_TICKS
        if (jumped or not -LAST_TICKS <= rx_ticks <= LAST_TICKS) and not self._restart(rx_ticks):
            return None
        if not self._is_of_site(beacon, rx_ticks):
            self.counters["foreign-site"] += 1
            return None
        if isinstance(beacon, Beacon) and beacon.anchor not in self._positions and self.almanac.complete:
            self.counters["unknown-anchor"] += 1
            return None
        tx_ticks = self._stamps.unwrap(beacon, rx_ticks, self._superframe_ticks)
        if tx_ticks is None:
            return None
        self._choice.heard_ticks = rx_ticks
        if isinstance(beacon, Beacon2) or self._followed.on_beacon(beacon, rx_ticks, self._superframe_ticks):
            return tx_ticks
        self.counters["stale-master"] += 1
        return None

    def _restart(self, rx_ticks: int) -> bool:
        """Forget all stamps, as the tag's counter restarted; False where the host's clock jumped by over a year."""
        self._forget_stamps()
        if abs(rx_ticks) <= LAST_TICKS:
            self.counters["counter-jump"] += 1
            self._choice.restart(rx_ticks)
            return True
        self.counters["impossible-host-time"] += 1
        self._own_ticks = Unwrapper()
        self._choice.restart(0)
        return False

    def _is_of_site(self, beacon: AnyBeacon, rx_ticks: int) -> bool:
        """Whether a beacon is of the site in use, which may be another one from now on."""
        key = SiteKey(beacon.site, 1 if isinstance(beacon, Beacon) else 2)
        had_site = self._choice.key is not None
        use = self._choice.on_beacon(key, beacon.anchor, rx_ticks)
        if use is SiteUse.CHANGED and had_site:
            self.counters["site-change"] += 1
            self.almanac, self.local_almanac = AlmanacAssembly(), LocalAlmanac()
            self._positions, self._superframe_ticks = {}, 0
            self._forget_stamps()
        return use is not SiteUse.FOREIGN

    def _forget_stamps(self) -> None:
        """Restart everything but the almanac."""
        self._stamps.forget()
        self._observer.forget()
        self._followed = FollowedMaster()
        self.local_almanac.forget_times()
        self._selection.forget_times()
        self._waiting = []
        self._moved_ticks, self._uses_moved = {}, False
        self._method = self._method_key = None
        if self.local_almanac.pages is not None:
            self._choose_method_2()

    def _read_almanac(self, beacon: Beacon) -> None:
        """Add the page; another issue, schedule, noise or accuracy replaces the method.

        So does another master where the method uses the master's own stamps; filters continue.
        """
        almanac, master = self.almanac, self._followed.master
        if almanac.add_page(beacon.almanac_issue, beacon.page):
            before, issue = self._positions, self._positions_issue
            self._read_positions()
            if issue == almanac.issue and any(tuple(before[a]) != almanac.anchors_m.get(a) for a in before):
                self._method_key = None  # other positions happen to have the same issue
        elif self._method is not None and master == self._master:
            return
        self._master = master
        self._observer.set_master(master, almanac.slot_of(master) or 0)
        self._choose_method()

    def _read_positions(self) -> None:
        self._positions_issue = self.almanac.issue
        self._positions = {anchor: np.array(point) for anchor, point in self.almanac.anchors_m.items()}

    def _choose_method(self) -> None:
        """Make the method that almanac and master require, unless it is in use already."""
        from skyless.positioning.methods.factory import new_method  # noqa: PLC0415 - loads the kernels

        almanac, options, master = self.almanac, self._options, self._master
        method_master = None if options.method in FILTERS else master
        schedule_page, noise, accuracy = almanac.schedule, almanac.noise, almanac.accuracy
        method_key = (almanac.issue, schedule_page, noise, accuracy, method_master)
        if method_key != self._method_key:
            self._method_key, self._method = method_key, None
            if master is not None and schedule_page is not None and noise is not None:
                schedule = schedule_from_page(schedule_page)
                self._superframe_ticks = schedule.superframe_ticks
                self._method = new_method(options, master, schedule_page, noise, accuracy, self._time)
                self._observer.set_method(self._method, schedule)

    def _choose_method_2(self, superframe_ticks: int | None = None) -> None:
        """Make the method that the common pages require, unless it is in use already; the schedule is no matter.

        ``superframe_ticks``: that with which the method was made, where it continues from a state.
        """
        from skyless.positioning.methods.factory import new_method_2  # noqa: PLC0415 - loads the kernels

        pages = self.local_almanac.pages
        assert pages is not None
        method_key = (pages.site.tag_height_m, pages.noise, pages.accuracy)
        if method_key != self._method_key:
            self._method_key = method_key
            self._superframe_ticks = superframe_ticks or pages.site.superframe_ticks
            self._method = new_method_2(self._options, pages, self._superframe_ticks, self._time)


def _variance_scale(diagnostics: Diagnostics) -> float:
    """Factor on the variance of a reception, from what the radio measured of it."""
    return variance_factor(diagnostics.rx_power_dbm, diagnostics.first_path_power_dbm)
