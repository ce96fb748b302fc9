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
from skyless.air.followed_master import FollowedMaster
from skyless.air.reception import Diagnostics, Reception
from skyless.clocks.stamps import AnchorStamps, StampTracks
from skyless.kernels.arrays import Array
from skyless.method_names import DEFAULT_METHOD, FILTERS, METHODS
from skyless.positioning.fix import Fix, NoFixReason
from skyless.positioning.fix_time import FixTime
from skyless.positioning.integrity import IntegrityRequirement
from skyless.positioning.methods.factory import MethodOptions, new_method
from skyless.positioning.methods.joint import Estimation, EstimationState
from skyless.positioning.methods.nlos_weighting import variance_factor
from skyless.positioning.methods.observations import Observer
from skyless.positioning.methods.snapshots import Snapshots, SnapshotsState
from skyless.site.almanac_gathering import AlmanacAssembly, AlmanacState
from skyless.site.slots import schedule_from_page
from skyless.ticks import LAST_TICKS, Unwrapper, from_seconds

SITE_SILENCE_TICKS: Final = from_seconds(2.0)
"""A tag that may choose its site leaves one that is silent for so long when it hears another."""

NOT_DROPS: Final = frozenset({"heard", "fixes", "anchor-restart", "counter-jump", "site-change"})
"""Counters of a receiver that do not count dropped frames."""

COUNTER_JUMP_TICKS: Final = from_seconds(1.0)
"""Stamps that go back farther than radios and hosts reorder mean that the tag's own counter has started anew."""


class ReceiverState(Struct, frozen=True):
    """All that a ``Receiver`` remembers; to be used or encoded before it hears more, as they share some parts."""

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
    has_key: bool
    """Whether the almanac has been looked at for a method."""
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
        ``qa`` the tag's agility in m²/s³ (filters); ``z_bounds_m`` decides between mirror solutions; ``integrity``
        is asked of the protection levels (``joint``).

        Raises:
            ValueError: there is no such method.
        """
        if method not in METHODS:
            raise ValueError(f"method {method!r} is not one of {', '.join(METHODS)}")
        self.counters: Counter[str] = Counter()
        self.reason: NoFixReason = NoFixReason.NO_BEACONS
        self.almanac = AlmanacAssembly()
        self._wanted = MethodOptions(method, qa, z_bounds_m, integrity or IntegrityRequirement())
        self._site = site
        self._may_change_site = site is None
        self._site_heard_ticks = 0
        self._time = FixTime()
        self._own_ticks = Unwrapper()
        self._stamps = AnchorStamps(self.counters)
        self._observer = Observer()
        self._method: Estimation | Snapshots | None = None
        self._made_of: object = None
        self._superframe_ticks = 0
        self._followed = FollowedMaster()
        self._master: int | None = None
        self._positions: dict[int, Array] = {}

    def state(self) -> ReceiverState:
        """All that it remembers, as it is now."""
        return ReceiverState(
            options=self._wanted,
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
            has_key=self._made_of is not None,
            method=None if self._method is None else self._method.state(),
        )

    @classmethod
    def from_state(cls, state: ReceiverState) -> "Receiver":
        """A receiver that goes on with the same bits as the one whose state it is.

        Raises:
            ValueError: no receiver has such a state.
        """
        asked = state.options
        made = cls(asked.method, qa=asked.qa, z_bounds_m=asked.z_bounds_m, integrity=asked.integrity)
        made._site, made._may_change_site = state.site, state.may_change_site
        made._site_heard_ticks, made._superframe_ticks = state.site_heard_ticks, state.superframe_ticks
        made.counters.update(state.counters)
        made.reason = state.reason
        made._time, made._own_ticks, made._followed = state.time, state.own_ticks, state.followed
        made._stamps = AnchorStamps(made.counters, state.stamps)
        made.almanac.restore(state.almanac)
        made._read_positions()
        made._master, made._observer.scale = state.master, state.master_scale
        made._observer.follow(state.master, made.almanac.slot_of(state.master) or 0)
        if state.has_key:
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
        """Identifier of the site that it listens to, None before the first beacon."""
        return self._site

    @property
    def method(self) -> Estimation | Snapshots | None:
        """The positioning method at work, None before the almanac is known."""
        return self._method

    def hear(self, reception: Reception) -> Fix | None:
        """Take a frame off the air; a fix if it made one, else ``reason`` says why not.

        What does not belong here is counted in ``counters`` and dropped; nothing on the air raises.
        """
        frame, told = reception.frame, reception.diagnostics
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
        factor, claim = 1.0 if told is None else _trust(told), self._followed.claim
        result = method.hear(self._observer.observe(frame, beacon, anchor_m, rx_ticks, tx_ticks, factor, claim))
        if isinstance(result, Fix):
            self.counters["fixes"] += 1
            return result
        self.reason = result
        if result is NoFixReason.RESIDUALS:
            self.counters["outlier"] += 1
        return None

    def hear_height(self, height_m: float, std_m: float) -> bool:
        """Take a reading of the tag's height sensor, above the site's origin, at the present; True if it was used.

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
        return isinstance(method, Estimation) and method.hear_height(height_m, std_m)

    def _admit(self, beacon: Beacon, rx_ticks: int) -> int | None:
        """TX stamp, unwrapped, of a beacon of the site, by the present master, and of an anchor that may be there."""
        newest = self._stamps.tracks.newest_rx_ticks
        jumped = newest is not None and rx_ticks < newest - COUNTER_JUMP_TICKS
        if (jumped or not -LAST_TICKS <= rx_ticks <= LAST_TICKS) and not self._begin_anew(rx_ticks):
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
        if self._followed.hear(beacon, rx_ticks, self._superframe_ticks):
            return tx_ticks
        self.counters["stale-master"] += 1
        return None

    def _begin_anew(self, rx_ticks: int) -> bool:
        """Forget all stamps, as the tag's counter started anew; False where the host's clock was set by ages."""
        self._forget_stamps()
        if abs(rx_ticks) <= LAST_TICKS:
            self.counters["counter-jump"] += 1
            self._site_heard_ticks = rx_ticks
            return True
        self.counters["impossible-host-time"] += 1
        self._own_ticks, self._site_heard_ticks = Unwrapper(), 0
        return False

    def _change_site(self, site: int, rx_ticks: int) -> bool:
        """Whether to listen to this site from now on: the first one, or another when the present one is silent."""
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
        """Start anew in all but the almanac."""
        self._stamps.forget()
        self._observer.forget()
        self._followed = FollowedMaster()
        self._method = self._made_of = None

    def _read_almanac(self, beacon: Beacon) -> None:
        """Keep the page; another issue, schedule, noise or accuracy makes the method anew.

        So does another master where the method rests on the master's own stamps; the filters ride on.
        """
        book, claim = self.almanac, self._followed.claim
        master = None if claim is None else claim.master
        if book.hear(beacon.almanac_issue, beacon.page):
            self._read_positions()
        elif self._method is not None and master == self._master:
            return
        self._master = master
        self._observer.follow(master, book.slot_of(master) or 0)
        self._choose_method()

    def _read_positions(self) -> None:
        self._positions = {anchor: np.array(position_m) for anchor, position_m in self.almanac.anchors_m.items()}

    def _choose_method(self) -> None:
        """Make the method that almanac and master ask for, unless it is at work already."""
        book, master = self.almanac, self._master
        method_master = None if self._wanted.method in FILTERS else master
        method_key = (book.issue, book.schedule, book.noise, book.accuracy, method_master)
        if method_key != self._made_of:
            self._made_of, self._method = method_key, None
            if master is not None and book.schedule is not None and book.noise is not None:
                schedule = schedule_from_page(book.schedule)
                self._superframe_ticks = schedule.superframe_ticks
                self._method = new_method(self._wanted, master, book.schedule, book.noise, book.accuracy, self._time)
                self._observer.serve(self._method, schedule)


def _trust(told: Diagnostics) -> float:
    """Factor on the variance of a reception by what the radio told of it."""
    return variance_factor(told.rx_power_dbm, told.first_path_power_dbm)
