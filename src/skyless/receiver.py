"""``Receiver``: the protocol machine of one tag. Bytes and ticks in, fixes out; no I/O, no clock.

It needs nothing but beacons: anchors, schedule and noise figures come from the almanac on the air.
"""

from collections import Counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyless.air.almanac_book import AlmanacBook
from skyless.air.beacon import Beacon, Heard
from skyless.air.claim import claim_of
from skyless.air.codec import decode_cached, packed_relays
from skyless.air.followed_master import FollowedMaster
from skyless.air.reception import Diagnostics, Reception
from skyless.air.schedule import Schedule, schedule_from_page
from skyless.clocks.filter import clock_noise
from skyless.clocks.stamps import AnchorStamps
from skyless.constants import MAX_DRIFT, TICK_M
from skyless.methods import DEFAULT_METHOD, FILTERS, METHODS
from skyless.positioning.first_path import variance_factor
from skyless.positioning.fix import Fix, NoFixReason
from skyless.positioning.fix_time import SLACK_TICKS, FixTime
from skyless.positioning.joint import JointSettings
from skyless.positioning.joint_tracking import JointTracking
from skyless.positioning.observation import Method, Observation
from skyless.positioning.protection import IntegrityRequirement
from skyless.positioning.snapshots import SnapshotMethod, Snapshots, SnapshotSettings
from skyless.positioning.tracker import TrackerSettings
from skyless.positioning.tracking import Tracking
from skyless.ticks import HALF_WRAP_TICKS, LAST_TICKS, TICK_MASK, Unwrapper, from_seconds, nearest, to_seconds
from skyless.uncertainty.tdoa import stamp_variance_m2

SITE_SILENCE_TICKS: Final = from_seconds(2.0)
"""A tag that may choose its site leaves one that is silent for so long when it hears another."""

NOT_DROPS: Final = frozenset({"heard", "fixes", "anchor-restart", "counter-jump", "site-change"})
"""Counters of a receiver that do not count dropped frames."""

COUNTER_JUMP_TICKS: Final = from_seconds(1.0)
"""Stamps that go back farther than radios and hosts reorder mean that the tag's own counter has started anew."""

DROP_S: Final = 2.0
"""An anchor that is silent for longer, or for four superframes, is out of view (``joint``)."""

LONGEST_FOR_JOINT_S: Final = 2.0
"""In longer superframes a tag may be metres away when it hears an anchor again: the tracker serves instead, which needs
no clock of an anchor for longer than a superframe."""

MOST_REPEATS: Final = 4
"""Beyond this beacons of an anchor that has lost the master weigh no less: what changes between them is still true."""


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
        self.almanac = AlmanacBook()
        self._method_name = method
        self._site = site
        self._may_change_site = site is None
        self._site_heard_ticks = 0
        self._time = FixTime()
        self._qa = qa
        self._z_bounds_m = z_bounds_m
        self._integrity = integrity or IntegrityRequirement()
        self._own_ticks = Unwrapper()
        self._stamps = AnchorStamps(self.counters)
        self._master_scale: tuple[int, int] | None = None
        self._method: Method | None = None
        self._made_of: object = None
        self._schedule: Schedule | None = None
        self._superframe_ticks = 0
        self._followed = FollowedMaster()
        self._master: int | None = None
        self._master_slot = 0
        self._positions: dict[int, NDArray[np.float64]] = {}
        self._synchronised: dict[int, tuple[Heard, int]] = {}

    @property
    def site(self) -> int | None:
        """Identifier of the site that it listens to, None before the first beacon."""
        return self._site

    @property
    def method(self) -> Method | None:
        """The positioning method at work, None before the almanac is known."""
        return self._method

    def hear(self, reception: Reception) -> Fix | None:
        """Take a frame off the air; a fix if it made one, else ``reason`` says why not.

        What does not belong here is counted in ``counters`` and dropped; nothing on the air raises.
        """
        beacon = decode_cached(reception.frame)
        if not isinstance(beacon, Beacon):
            self.counters[beacon] += 1
            return None
        rx_ticks = self._unwrap(reception)
        if rx_ticks is None or not self._belongs(beacon, rx_ticks):
            return None
        tx_ticks = self._stamps.unwrap(beacon, rx_ticks)
        if tx_ticks is None or not self._is_of_this_reign(beacon, rx_ticks):
            return None
        self.counters["heard"] += 1
        self._read_almanac(beacon)
        anchor_m = self._positions.get(beacon.anchor)
        if self._method is None or self._schedule is None or anchor_m is None:
            self.reason = NoFixReason.NO_ALMANAC
            return None
        frame, diagnostics = reception.frame, reception.diagnostics
        factor = 1.0 if diagnostics is None else _trust(diagnostics)
        told = self._observation(frame, beacon, self._schedule, anchor_m, rx_ticks, tx_ticks, factor)
        result = self._method.hear(told)
        if isinstance(result, Fix):
            self.counters["fixes"] += 1
            return result
        self.reason = result
        if result is NoFixReason.RESIDUALS:
            self.counters["outlier"] += 1
        return None

    def _unwrap(self, reception: Reception) -> int | None:
        """The tag's own stamp, unwrapped; None, and a new beginning, where the host's clock was set by ages."""
        rx_ticks = self._own_ticks.unwrap(reception.rx_ticks, reception.host_s)
        if abs(rx_ticks) <= LAST_TICKS:
            return rx_ticks
        self.counters["impossible-host-time"] += 1
        self._own_ticks, self._site_heard_ticks = Unwrapper(), 0
        self._forget_stamps()
        return None

    def _belongs(self, beacon: Beacon, rx_ticks: int) -> bool:
        """Whether a beacon is of the site and of an anchor that the almanac, once complete, knows."""
        newest = self._stamps.newest_rx_ticks
        if newest is not None and rx_ticks < newest - COUNTER_JUMP_TICKS:
            self.counters["counter-jump"] += 1
            self._forget_stamps()
            self._site_heard_ticks = rx_ticks
        if beacon.site != self._site and not self._change_site(beacon.site, rx_ticks):
            self.counters["foreign-site"] += 1
            return False
        if beacon.anchor not in self._positions and self.almanac.complete:
            self.counters["unknown-anchor"] += 1
            return False
        return True

    def _is_of_this_reign(self, beacon: Beacon, rx_ticks: int) -> bool:
        """Whether a beacon goes by the present master, not by one that is no more."""
        self._site_heard_ticks = rx_ticks
        if self._followed.hear(beacon, rx_ticks, self._superframe_ticks):
            return True
        self.counters["stale-master"] += 1
        return False

    def _change_site(self, site: int, rx_ticks: int) -> bool:
        """Whether to listen to this site from now on: the first one, or another when the present one is silent."""
        if not self._may_change_site:
            return False
        if self._site is not None:
            if rx_ticks - self._site_heard_ticks < SITE_SILENCE_TICKS:
                return False
            self.counters["site-change"] += 1
            self.almanac = AlmanacBook()
            self._positions = {}
            self._forget_stamps()
        self._site, self._site_heard_ticks = site, rx_ticks
        return True

    def _forget_stamps(self) -> None:
        """Start anew in all but the almanac."""
        self._stamps.forget()
        self._synchronised.clear()
        self._master_scale = None
        self._followed = FollowedMaster()
        self._method = self._made_of = None

    def _read_almanac(self, beacon: Beacon) -> None:
        """Keep the page; another issue, schedule or noise makes the method anew.

        So does another master where the method rests on the master's own stamps; the filters ride on.
        """
        book, claim = self.almanac, self._followed.claim
        master = None if claim is None else claim.master
        if book.hear(beacon.almanac_issue, beacon.page):
            self._positions = {anchor: np.array(place) for anchor, place in book.anchors_m.items()}
        elif self._method is not None and master == self._master:
            return
        self._master, self._master_slot = master, book.slot_of(master) or 0
        made_of = (book.issue, book.schedule, book.noise, None if self._method_name in FILTERS else master)
        if made_of != self._made_of:
            self._made_of, self._method = made_of, None
            if book.schedule is not None and book.noise is not None:
                self._schedule = schedule_from_page(book.schedule)
                self._superframe_ticks = self._schedule.superframe_ticks
                self._method = self._new_method()

    def _new_method(self) -> Method:
        schedule, noise = self.almanac.schedule, self.almanac.noise
        assert schedule is not None
        assert noise is not None
        assert self._master is not None
        tx_variance = stamp_variance_m2(noise.tx_stamp_s, rounded=False)
        rx_variance = stamp_variance_m2(noise.rx_stamp_s, rounded=True)
        if self._method_name not in FILTERS:
            settings = SnapshotSettings(
                self._master, schedule.anchors, tx_variance, rx_variance, schedule.tag_height_m, self._z_bounds_m
            )
            return Snapshots(SnapshotMethod(self._method_name), settings, self._time)
        superframe_s = to_seconds(schedule.slot_ticks * schedule.slots)
        if self._method_name == "joint" and superframe_s <= LONGEST_FOR_JOINT_S:
            own = clock_noise(noise.white_fm, noise.random_walk_fm, clocks=1)
            joint = JointSettings(
                qa=self._qa,
                white=own.white,
                walk=own.walk,
                tx_variance_m2=tx_variance,
                rx_variance_m2=rx_variance,
                height_m=schedule.tag_height_m,
                drop_s=max(DROP_S, 4.0 * superframe_s),
                integrity_risk=self._integrity.risk,
                alert_limit_m=self._integrity.alert_limit_m,
            )
            return JointTracking(joint, self._z_bounds_m, self._time, superframe_s)
        clock = clock_noise(noise.white_fm, noise.random_walk_fm)
        return Tracking(
            TrackerSettings(
                qa=self._qa,
                white=clock.white,
                walk=clock.walk,
                stamp_variance_m2=tx_variance + rx_variance,
                height_m=schedule.tag_height_m,
            ),
            self._z_bounds_m,
            self._time,
            superframe_s,
        )

    def _observation(
        self,
        frame: bytes,
        beacon: Beacon,
        schedule: Schedule,
        anchor_m: NDArray[np.float64],
        rx_ticks: int,
        tx_ticks: int,
        rx_variance_factor: float,
    ) -> Observation:
        heard = beacon.master_heard if beacon.master == self._master else None
        ticks_master, fraction, variance_m2 = self._master_time(beacon, rx_ticks)
        sync_variance_m2, joint = variance_m2, self._method_name == "joint"
        if heard is not None:
            repeats = self._repeats(beacon.anchor, heard)
            variance_m2 *= repeats * repeats
        count, master_sequence, master_rx_ticks = 0, None, None
        if self._method_name not in FILTERS:
            count, (master_sequence, master_rx_ticks) = self._round(beacon, schedule), _stamp_of(heard, tx_ticks)
        return Observation(
            beacon.anchor,
            anchor_m,
            count,
            beacon.sequence,
            rx_ticks,
            tx_ticks,
            master_sequence,
            master_rx_ticks,
            ticks_master,
            fraction,
            variance_m2,
            (),
            claim_of(beacon) if joint and ticks_master is not None else None,
            sync_variance_m2,
            rx_variance_factor,
            packed_relays(frame, beacon) if joint else b"",
        )

    def _repeats(self, anchor: int, heard: Heard) -> int:
        """How many beacons of an anchor, this one included, rest on the same beacon of the master.

        They share one clock error, which filters take for independent ones: their variances count times the square
        of this number (``docs/maths.md`` section 6).
        """
        last, count = self._synchronised.get(anchor, (heard, 0))
        if last.rx_ticks != heard.rx_ticks or last != heard:
            count = 1
        elif count < MOST_REPEATS:
            count += 1
        self._synchronised[anchor] = (heard, count)
        return count

    def _round(self, beacon: Beacon, schedule: Schedule) -> int:
        """Round of a frame, counted from the master's slot: what follows a frame of the master refers to it."""
        superframe, slot = beacon.superframe, beacon.slot - self._master_slot
        if not 0 <= slot < schedule.slots:
            steps, slot = divmod(slot, schedule.slots)
            superframe += steps
        return superframe if schedule.frames_per_node == 1 else schedule.round_of(superframe, slot)

    def _master_time(self, beacon: Beacon, rx_ticks: int) -> tuple[int | None, float, float]:
        """TX time on the master's scale: unwrapped whole ticks, fraction, variance in m².

        Only the master, and anchors that agree with what was heard before, lead the scale on.
        """
        time = beacon.master_time
        if time is None:
            return None, 0.0, 0.0
        subticks, std_m = time.tx_subticks_master, time.std_ticks * TICK_M
        whole, fraction = subticks >> 8, subticks & 0xFF
        follow = beacon.anchor == self._master
        if self._master_scale is None:
            follow = True
        else:
            last_whole, last_rx = self._master_scale
            elapsed = rx_ticks - last_rx
            least = last_whole + elapsed - HALF_WRAP_TICKS
            whole = least + ((whole - least) & TICK_MASK)
            follow = follow or abs(whole - last_whole - elapsed) <= MAX_DRIFT * elapsed + SLACK_TICKS
        if follow:
            self._master_scale = (whole, rx_ticks)
        return whole, fraction / 256.0, std_m**2


def _trust(told: Diagnostics) -> float:
    """Factor on the variance of a reception by what the radio told of it."""
    return variance_factor(told.rx_power_dbm, told.first_path_power_dbm)


def _stamp_of(heard: Heard | None, tx_ticks: int) -> tuple[int, int] | tuple[None, None]:
    """Sequence number and unwrapped RX stamp of what the sender of a beacon heard before that."""
    return (None, None) if heard is None else (heard.sequence, nearest(heard.rx_ticks, tx_ticks))
