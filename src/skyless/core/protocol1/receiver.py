"""``Receiver``: the protocol machine of one tag of protocol 1. Bytes and ticks in, fixes out; no I/O, no clock.

It needs only beacons: anchors, schedule and noise figures come from the almanac on the air.
"""

from math import nan
from typing import Final

import numpy as np

from skyless.core.air.frame import Heard, Malformed, Reception
from skyless.core.air.site_choice import NO_SITE, note_fix
from skyless.core.arrays import Array
from skyless.core.clock_filter import stamp_variances_m2
from skyless.core.fix import Fix, NoFixReason
from skyless.core.native.library import compiled
from skyless.core.protocol1.almanac import AlmanacAssembly
from skyless.core.protocol1.beacon import Beacon, Schedule, decode_cached, schedule_from_page
from skyless.core.protocol1.clock import FollowedMaster
from skyless.core.protocol1.snapshots import Observation, SnapshotMethod, Snapshots, SnapshotSettings
from skyless.core.tag.admission import ADMITTED, SITE_CHANGED, Admission, admit_sender, admit_stamp
from skyless.core.tag.receiver import BeaconReceiver, HeardSite
from skyless.core.ticks import nearest


class Receiver(BeaconReceiver):
    """One listening tag of protocol 1 with one of the paper's methods; ``joint`` hears it through ``Translator``."""

    def __init__(self, method: str, *, site: int | None = None, z_bounds_m: tuple[float, float] | None = None) -> None:
        """Create a tag that has heard nothing. ``method``: one of ``SNAPSHOTS``; the rest as for ``skyless.Receiver``.

        Raises ValueError: there is no such method.
        """
        super().__init__()
        self._method_name, self._z_bounds_m = SnapshotMethod(method), z_bounds_m
        self._admission = Admission()
        self._admission.choice.only_site = NO_SITE if site is None else site
        self.almanac = AlmanacAssembly()
        self._schedule: Schedule | None = None
        self._method: Snapshots | None = None
        self._method_key: object = None
        self._superframe_ticks = 0
        self._followed = FollowedMaster()
        self._master: int | None = None
        self._positions: dict[int, Array] = {}
        self._positions_issue: int | None = None

    @property
    def admission(self) -> Admission:
        """What the tag knows of its own counter, of the sites and of the anchors."""
        return self._admission

    @property
    def method(self) -> Snapshots | None:
        """The positioning method in use; None before the almanac is known."""
        return self._method

    @property
    def heard_site(self) -> HeardSite | None:
        """Known anchor positions and the georeference, once the almanac is complete."""
        almanac = self.almanac
        if not almanac.complete:
            return None
        return HeardSite(almanac.anchors_m, almanac.georeference, is_complete=almanac.georeference is not None)

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air. Returns a fix if it made one, otherwise sets ``reason``.

        Unusable frames are counted in ``counters`` and dropped; no frame raises.
        """
        beacon = decode_cached(reception.frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
            return None
        return self.hear_beacon(beacon, reception)

    def hear_beacon(self, beacon: Beacon, reception: Reception) -> Fix | None:
        """Process a decoded beacon as ``hear`` does."""
        if not self._admit(beacon, reception):
            return None
        self.counters["heard"] += 1
        result = self._process(beacon)
        if isinstance(result, Fix):
            note_fix(self._admission.choice, self._admission.rx_ticks)
        return self._judge(result)

    def _admit(self, beacon: Beacon, reception: Reception) -> bool:
        """Check a beacon's site, anchor, stamps and master. Returns True if it is admitted; otherwise counts it."""
        admission, host_s = self._admission, reception.host_s
        outcome = _admit_sender(
            admission, beacon.site, beacon.anchor, reception.rx_ticks, nan if host_s is None else host_s
        )
        events, admission.events = admission.events, 0
        self._count_events(events)
        if events & SITE_CHANGED:
            self.almanac = AlmanacAssembly()
            self._positions, self._superframe_ticks = {}, 0
        if events:
            self._forget_stamps()
        if outcome == ADMITTED:
            if beacon.anchor not in self._positions and self.almanac.complete:
                self.counters["unknown-anchor"] += 1
                return False
            stamps = beacon.anchor, beacon.sequence, beacon.tx_ticks
            outcome = _admit_stamp(admission, *stamps, self._superframe_ticks)
        if outcome != ADMITTED:
            self._count_drop(outcome)
            return False
        if self._followed.on_beacon(beacon, admission.rx_ticks, self._superframe_ticks):
            return True
        self.counters["stale-master"] += 1
        return False

    def _process(self, beacon: Beacon) -> Fix | NoFixReason:
        neighbours, rx_ticks = self._admission.neighbours, self._admission.rx_ticks
        tx_ticks = neighbours.rows[neighbours.row].tx_ticks
        self._read_almanac(beacon)
        method, anchor_m = self._method, self._positions.get(beacon.anchor)
        if method is None or anchor_m is None:
            return NoFixReason.NO_ALMANAC
        return method.update(self._observation(beacon, anchor_m, rx_ticks, tx_ticks))

    def hear_other(self) -> None:
        """Count a beacon of protocol 2, which has no master."""
        self.counters["other-version"] += 1
        if not self.counters["heard"]:
            self.reason = NoFixReason.NO_MASTER

    def _observation(self, beacon: Beacon, anchor_m: Array, rx_ticks: int, tx_ticks: int) -> Observation:
        """The observation of a beacon, with its round and the master's stamp."""
        heard = beacon.master_heard if beacon.master == self._master else None
        master_sequence, master_rx_ticks = _stamp_of(heard, tx_ticks)
        stamps = rx_ticks, tx_ticks, master_sequence, master_rx_ticks
        return Observation(beacon.anchor, anchor_m, self._round(beacon), beacon.sequence, *stamps)

    def _round(self, beacon: Beacon) -> int:
        """Round of a frame, counted from the master's slot: what follows a frame of the master refers to it."""
        schedule = self._schedule
        assert schedule is not None
        superframe, slot = beacon.superframe, beacon.slot - (self.almanac.slot_of(self._master) or 0)
        if not 0 <= slot < schedule.slots:
            steps, slot = divmod(slot, schedule.slots)
            superframe += steps
        return superframe if schedule.frames_per_node == 1 else schedule.round_of(superframe, slot)

    def _forget_stamps(self) -> None:
        self._followed = FollowedMaster()
        self._method = self._method_key = None

    def _read_almanac(self, beacon: Beacon) -> None:
        """Add the page. Another issue, schedule, noise or master replaces the method."""
        almanac, master = self.almanac, self._followed.master
        if almanac.add_page(beacon.almanac_issue, beacon.page):
            before, issue = self._positions, self._positions_issue
            self._read_positions()
            if issue == almanac.issue and any(tuple(before[a]) != almanac.anchors_m.get(a) for a in before):
                self._method_key = None  # other positions happen to have the same issue
        elif self._method is not None and master == self._master:
            return
        self._master = master
        self._choose_method()

    def _read_positions(self) -> None:
        self._positions_issue = self.almanac.issue
        self._positions = {anchor: np.array(point) for anchor, point in self.almanac.anchors_m.items()}

    def _choose_method(self) -> None:
        """Create the method that almanac and master require, unless it is in use already."""
        almanac, master, schedule, noise = self.almanac, self._master, self.almanac.schedule, self.almanac.noise
        method_key = (almanac.issue, schedule, noise, master)
        if method_key == self._method_key:
            return
        self._method_key, self._method = method_key, None
        if master is not None and schedule is not None and noise is not None:
            self._schedule = schedule_from_page(schedule)
            self._superframe_ticks = self._schedule.superframe_ticks
            heights = schedule.tag_height_m, self._z_bounds_m
            variances_m2 = stamp_variances_m2(noise.tx_stamp_s, noise.rx_stamp_s)
            settings = SnapshotSettings(master, schedule.anchors, *variances_m2, *heights)
            self._method = Snapshots(self._method_name, settings, self._admission.time)


def _stamp_of(heard: Heard | None, tx_ticks: int) -> tuple[int, int] | tuple[None, None]:
    """Sequence number and unwrapped RX stamp of what the sender of a beacon received before that."""
    return (None, None) if heard is None else (heard.sequence, nearest(heard.rx_ticks, tx_ticks))


_admit_sender: Final = compiled(admit_sender)
_admit_stamp: Final = compiled(admit_stamp)
