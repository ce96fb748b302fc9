"""``Receiver``: the protocol machine of one tag. Bytes and ticks in, fixes out; no I/O, no clock.

It needs nothing but beacons: anchors, schedule and noise figures come from the almanac on the air.
"""

from collections import Counter
from math import inf, isfinite
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.air.beacon import Beacon
from skyless.air.codec import decode_cached
from skyless.air.master_term import FollowedMaster
from skyless.air.reception import Diagnostics, Reception
from skyless.kernels.arrays import Array
from skyless.method_names import DEFAULT_METHOD, FILTERS, METHODS
from skyless.positioning.fix import Fix, NoFixReason
from skyless.positioning.integrity import IntegrityRequirement
from skyless.positioning.methods.factory import MethodOptions, new_method
from skyless.positioning.methods.joint import Estimation, EstimationState
from skyless.positioning.methods.observations import AnchorStamps, FixTime, Observer, StampTracks, variance_factor
from skyless.positioning.methods.snapshots import Snapshots, SnapshotsState
from skyless.site.almanac_pages import AlmanacAssembly, AlmanacState
from skyless.site.slots import schedule_from_page
from skyless.ticks import LAST_TICKS, Unwrapper, from_seconds

SITE_SILENCE_TICKS: Final = from_seconds(2.0)
"""A tag that may choose its site leaves one that has been silent for this time when it hears another."""

NOT_DROPS: Final = frozenset({"heard", "fixes", "anchor-restart", "counter-jump", "site-change"})
"""Counters of a receiver that do not count dropped frames."""

COUNTER_JUMP_TICKS: Final = from_seconds(1.0)
"""Stamps that go back farther than radios and hosts reorder them mean that the tag's own counter has restarted."""


class ReceiverState(Struct, frozen=True):
    """All that a ``Receiver`` keeps; to be used or encoded before its next frame, as they share some parts."""

    options: MethodOptions
    site: int | None
    may_change_site: bool
    site_heard_ticks: int
    counters: dict[str, int]
    reason: NoFixReason
    almanac: AlmanacState
    time: FixTime
    own_ticks: Unwrapper
    stamps: StampTracks
    followed: FollowedMaster
    master: int | None
    master_scale: tuple[int, int] | None
    superframe_ticks: int
    has_method_key: bool
    """Whether a method has been looked for since stamps were forgotten."""
    method: EstimationState | SnapshotsState | None


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

        ``method`` is one of ``METHODS``; ``site`` the only site to listen to, by default the first that is heard;
        ``qa`` the tag's process noise in m²/s³ (filters); ``z_bounds_m`` decides between mirror solutions;
        ``integrity`` is the requirement for the protection levels (``joint``).

        Raises:
            ValueError: there is no such method.
        """
        if method not in METHODS:
            raise ValueError(f"method {method!r} is not one of {', '.join(METHODS)}")
        self.counters: Counter[str] = Counter()
        self.reason: NoFixReason = NoFixReason.NO_BEACONS
        self.almanac = AlmanacAssembly()
        self._options = MethodOptions(method, qa, z_bounds_m, integrity or IntegrityRequirement())
        self._site = site
        self._may_change_site = site is None
        self._site_heard_ticks = 0
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

    def state(self) -> ReceiverState:
        """All that it keeps, as it is now."""
        return ReceiverState(
            options=self._options,
            site=self._site,
            may_change_site=self._may_change_site,
            site_heard_ticks=self._site_heard_ticks,
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
        )

    @classmethod
    def from_state(cls, state: ReceiverState) -> "Receiver":
        """A receiver that continues with the same bits as the one with this state.

        Raises:
            ValueError: no receiver has such a state.
        """
        options = state.options
        made = cls(options.method, qa=options.qa, z_bounds_m=options.z_bounds_m, integrity=options.integrity)
        made._site, made._may_change_site = state.site, state.may_change_site
        made._site_heard_ticks, made._superframe_ticks = state.site_heard_ticks, state.superframe_ticks
        made.counters.update(state.counters)
        made.reason = state.reason
        made._time, made._own_ticks, made._followed = state.time, state.own_ticks, state.followed
        made._stamps = AnchorStamps(made.counters, state.stamps)
        made.almanac.restore(state.almanac)
        made._read_positions()
        made._master, made._observer.scale = state.master, state.master_scale
        made._observer.set_master(state.master, made.almanac.slot_of(state.master) or 0)
        if state.has_method_key:
            made._choose_method()
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
        return self._site

    @property
    def method(self) -> Estimation | Snapshots | None:
        """The positioning method in use, None before the almanac is known."""
        return self._method

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air; a fix if it made one, else ``reason`` is set.

        What does not belong here is counted in ``counters`` and dropped; nothing on the air raises.
        """
        frame, diagnostics = reception.frame, reception.diagnostics
        beacon = decode_cached(frame)
        if not isinstance(beacon, Beacon):
            self.counters[beacon] += 1
            return None
        rx_ticks = self._own_ticks.unwrap(reception.rx_ticks, reception.host_s)
        tx_ticks = self._admit(beacon, rx_ticks)
        if tx_ticks is None:
            return None
        self.counters["heard"] += 1
        self._read_almanac(beacon)
        method, anchor_m = self._method, self._positions.get(beacon.anchor)
        if method is None or anchor_m is None:
            self.reason = NoFixReason.NO_ALMANAC
            return None
        scale, master_term = 1.0 if diagnostics is None else _variance_scale(diagnostics), self._followed.master_term
        result = method.update(self._observer.observe(frame, beacon, anchor_m, rx_ticks, tx_ticks, scale, master_term))
        if isinstance(result, Fix):
            self.counters["fixes"] += 1
            return result
        self.reason = result
        if result is NoFixReason.RESIDUALS:
            self.counters["outlier"] += 1
        return None

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
        method = self._method
        return isinstance(method, Estimation) and method.update_height(height_m, std_m)

    def _admit(self, beacon: Beacon, rx_ticks: int) -> int | None:
        """TX stamp, unwrapped, of a beacon of the site, by the present master, and of an anchor that may be there."""
        newest = self._stamps.tracks.newest_rx_ticks
        jumped = newest is not None and rx_ticks < newest - COUNTER_JUMP_TICKS
        if (jumped or not -LAST_TICKS <= rx_ticks <= LAST_TICKS) and not self._restart(rx_ticks):
            return None
        if beacon.site != self._site and not self._change_site(beacon.site, rx_ticks):
            self.counters["foreign-site"] += 1
            return None
        if beacon.anchor not in self._positions and self.almanac.complete:
            self.counters["unknown-anchor"] += 1
            return None
        tx_ticks = self._stamps.unwrap(beacon, rx_ticks)
        if tx_ticks is None:
            return None
        self._site_heard_ticks = rx_ticks
        if self._followed.on_beacon(beacon, rx_ticks, self._superframe_ticks):
            return tx_ticks
        self.counters["stale-master"] += 1
        return None

    def _restart(self, rx_ticks: int) -> bool:
        """Forget all stamps, as the tag's counter restarted; False where the host's clock jumped by over a year."""
        self._forget_stamps()
        if abs(rx_ticks) <= LAST_TICKS:
            self.counters["counter-jump"] += 1
            self._site_heard_ticks = rx_ticks
            return True
        self.counters["impossible-host-time"] += 1
        self._own_ticks, self._site_heard_ticks = Unwrapper(), 0
        return False

    def _change_site(self, site: int, rx_ticks: int) -> bool:
        """Whether to use this site from now on: the first one, or another when the present one is silent."""
        if not self._may_change_site:
            return False
        if self._site is not None:
            if rx_ticks - self._site_heard_ticks < SITE_SILENCE_TICKS:
                return False
            self.counters["site-change"] += 1
            self.almanac = AlmanacAssembly()
            self._positions = {}
            self._forget_stamps()
        self._site, self._site_heard_ticks = site, rx_ticks
        return True

    def _forget_stamps(self) -> None:
        """Restart everything but the almanac."""
        self._stamps.forget()
        self._observer.forget()
        self._followed = FollowedMaster()
        self._method = self._method_key = None

    def _read_almanac(self, beacon: Beacon) -> None:
        """Add the page; another issue, schedule, noise or accuracy replaces the method.

        So does another master where the method uses the master's own stamps; filters continue.
        """
        almanac, master = self.almanac, self._followed.master
        if almanac.add_page(beacon.almanac_issue, beacon.page):
            self._read_positions()
        elif self._method is not None and master == self._master:
            return
        self._master = master
        self._observer.set_master(master, almanac.slot_of(master) or 0)
        self._choose_method()

    def _read_positions(self) -> None:
        self._positions = {anchor: np.array(point) for anchor, point in self.almanac.anchors_m.items()}

    def _choose_method(self) -> None:
        """Make the method that almanac and master require, unless it is in use already."""
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


def _variance_scale(diagnostics: Diagnostics) -> float:
    """Factor on the variance of a reception, from what the radio measured of it."""
    return variance_factor(diagnostics.rx_power_dbm, diagnostics.first_path_power_dbm)
