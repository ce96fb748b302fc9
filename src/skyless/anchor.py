"""``Anchor``: the protocol machine of one anchor. Bytes and ticks in, frames and ticks out; no I/O, no clock.

A driver (simulator, daemon) hands it every reception, asks when its next frame is due, and fetches that frame as late
as its radio allows, so that it carries the latest receptions.
"""

import math
from collections import Counter
from typing import Final

from msgspec import Struct

from skyless.air.almanac import Page
from skyless.air.beacon import Beacon, Heard, MasterTime
from skyless.air.codec import decode_cached, encode, heard_capacity
from skyless.air.malformed import Malformed
from skyless.air.reception import Reception, Transmission
from skyless.air.rotation import almanac_issue, page_for, pages_of
from skyless.air.schedule import first_slots, schedule_of
from skyless.clocks.filter import ClockFilter, clock_noise
from skyless.constants import DELAYED_TX_GRANULARITY_TICKS, MAX_DRIFT, TICK_M, TICK_RATE_HZ
from skyless.site.model import AnchorSite, Site
from skyless.ticks import Unwrapper, nearest, wrap
from skyless.uncertainty.tdoa import stamp_variance_m2

MAX_OFFSET_STD_M: Final = 0.3
"""An anchor speaks only while its offset is known better than this (``docs/maths.md`` section 6)."""

REJECTIONS_BEFORE_RESTART: Final = 3
"""So many master beacons in a row that do not fit mean that the master's clock, or the own one, has jumped."""

DRIFT_SLACK_TICKS: Final = 64

MAX_RELAY_AGE_S: Final = 1.0
"""Older stamps are not relayed: sequence numbers come around after 256 frames, and then name another frame."""

SUBTICKS: Final = 256


class Synchronisation(Struct, frozen=True):
    """How well an anchor knows the master's time."""

    beacons: int
    """Master beacons taken since the clock filter's last start."""
    rate_ppm: float
    offset_std_m: float
    """After the last beacon, in metres of light."""


class Anchor:
    """One anchor of a site."""

    def __init__(self, site: Site, anchor_id: int, lead_s: float = 1e-3) -> None:
        """``lead_s``: how long before its RMARKER a frame must be in the driver's hands."""
        self.id = anchor_id
        self.counters: Counter[str] = Counter()
        self._site = site
        self._anchors = {anchor.id: anchor for anchor in site.anchors}
        self._own = self._anchors[anchor_id]
        self._lead_ticks = round(lead_s * TICK_RATE_HZ)
        self._schedule = schedule_of(site)
        self._slots = self._schedule.slots_of(first_slots(site)[anchor_id])
        self._pages: tuple[Page, ...] = pages_of(site)
        self._issue = almanac_issue(self._pages)
        self._own_ticks = Unwrapper()
        self._clock = _filter_of(site)
        self._range_to_master_m = _distance_m(self._own, self._anchors[site.master])
        self._epoch_master: int | None = None
        self._master_last: tuple[int, int, tuple[int, int]] | None = None
        self._misfits = 0
        self._master_heard: Heard | None = None
        self._heard: dict[int, tuple[Heard, int]] = {}
        self._pending: dict[int, tuple[int, int]] = {}
        self._sequence = 0

    @property
    def is_master(self) -> bool:
        """Whether this anchor's clock is the site's time."""
        return self.id == self._site.master

    @property
    def synchronisation(self) -> Synchronisation:
        """State of the own clock against the master's; exact for the master itself."""
        if self.is_master:
            return Synchronisation(0, 0.0, 0.0)
        return Synchronisation(self._clock.updates, self._clock.rate * 1e6, self._clock.offset_std_m)

    def hear(self, reception: Reception) -> None:
        """Take a frame off the air; what does not belong here is counted and dropped."""
        beacon = decode_cached(reception.frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
        elif beacon.site != self._site.id:
            self.counters["foreign-site"] += 1
        elif beacon.anchor == self.id or beacon.anchor not in self._anchors:
            self.counters["unknown-anchor"] += 1
        else:
            self.counters["heard"] += 1
            rx_ticks = self._own_ticks.unwrap(reception.rx_ticks, reception.host_s)
            heard = Heard(beacon.anchor, beacon.sequence, reception.rx_ticks)
            if beacon.anchor == self._site.master:
                self._hear_master(beacon, heard, rx_ticks)
            else:
                self._heard.pop(beacon.anchor, None)
                self._heard[beacon.anchor] = (heard, rx_ticks)

    def _hear_master(self, beacon: Beacon, heard: Heard, rx_ticks: int) -> None:
        """Follow the master; a beacon that does not fit changes nothing, unless others like it follow."""
        if self._master_last is not None and (beacon.tx_ticks, beacon.sequence) == self._master_last[2]:
            self.counters["duplicate"] += 1
            return
        tx_ticks = self._take_master(beacon, rx_ticks)
        if tx_ticks is None:
            self._misfits += 1
            if self._misfits < REJECTIONS_BEFORE_RESTART:
                return
            self.counters["clock-restart"] += 1
            tx_ticks = beacon.tx_ticks
            self._clock.restart(tx_ticks, rx_ticks, self._range_to_master_m)
        self._misfits = 0
        self._master_last = (tx_ticks, rx_ticks, (beacon.tx_ticks, beacon.sequence))
        self._master_heard = heard
        since_epoch = self._schedule.slot_start_ticks(beacon.superframe, beacon.slot)
        self._epoch_master = tx_ticks - since_epoch

    def _take_master(self, beacon: Beacon, rx_ticks: int) -> int | None:
        """Give a beacon to the clock filter; its unwrapped TX stamp, or None where it does not fit."""
        if self._master_last is None:
            self._clock.restart(beacon.tx_ticks, rx_ticks, self._range_to_master_m)
            return beacon.tx_ticks
        last_tx, last_rx, _ = self._master_last
        elapsed = rx_ticks - last_rx
        tx_ticks = nearest(beacon.tx_ticks, last_tx + elapsed)
        if elapsed <= 0 or abs(tx_ticks - last_tx - elapsed) > MAX_DRIFT * elapsed + DRIFT_SLACK_TICKS:
            self.counters["impossible-stamp"] += 1
            return None
        self._clock.hear(tx_ticks, rx_ticks, self._range_to_master_m)
        if self._clock.rejected:
            self.counters["clock-outlier"] += 1
            return None
        return tx_ticks

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        """TX stamp (40-bit, own counter) of the next frame that can still be made; None while the clock is unknown."""
        now = self._own_ticks.unwrap(now_ticks)
        earliest = now + self._lead_ticks
        if self.is_master and self._epoch_master is None:
            self._epoch_master = earliest
        if self._epoch_master is None or not self._clock_known(earliest):
            return None
        since_epoch = self._to_master(earliest)[0] - self._epoch_master
        superframe, slot = self._schedule.next_slot(since_epoch + DELAYED_TX_GRANULARITY_TICKS, self._slots)
        start_master = self._epoch_master + self._schedule.slot_start_ticks(superframe, slot)
        tx_ticks = self._on_radio_grid(start_master if self.is_master else self._clock.from_master(start_master))
        self._pending = {wrap(tx_ticks): (superframe, slot)}
        return wrap(tx_ticks)

    def transmission(self, tx_ticks: int) -> Transmission:
        """The frame for a time that ``next_transmission_ticks`` gave.

        Raises:
            KeyError: the time is not the one that was given last.
        """
        superframe, slot = self._pending.pop(tx_ticks)
        beacon = self._beacon(tx_ticks, superframe, slot)
        self._sequence = (self._sequence + 1) & 0xFF
        self.counters["sent"] += 1
        return Transmission(encode(beacon), tx_ticks)

    def _beacon(self, tx_ticks: int, superframe: int, slot: int) -> Beacon:
        superframe &= 0xFFFFFFFF  # as the frame shows it: whoever reads it can tell the page
        page = page_for(self._pages, superframe, slot)
        room = heard_capacity(master_heard=self._master_heard is not None, master_time=True, page=True)
        return Beacon(
            site=self._site.id,
            anchor=self.id,
            sequence=self._sequence,
            superframe=superframe,
            slot=slot,
            tx_ticks=tx_ticks,
            almanac_issue=self._issue,
            master=self._site.master,
            master_heard=self._master_heard,
            master_time=self._master_time(tx_ticks),
            heard=self._relayed(self._own_ticks.expect(tx_ticks))[:room],
            page=page,
        )

    def _relayed(self, ticks_own: int) -> tuple[Heard, ...]:
        """What was heard of late of the other anchors, the most recent first."""
        oldest = ticks_own - round(MAX_RELAY_AGE_S * TICK_RATE_HZ)
        return tuple(heard for heard, rx_ticks in reversed(self._heard.values()) if rx_ticks > oldest)

    def _master_time(self, tx_ticks: int) -> MasterTime:
        ticks, fraction, variance_m2 = self._to_master(self._own_ticks.expect(tx_ticks))
        subticks = ticks * SUBTICKS + round(fraction * SUBTICKS)
        return MasterTime(wrap(subticks, 48), math.sqrt(variance_m2) / TICK_M)

    def _to_master(self, ticks_own: int) -> tuple[int, float, float]:
        return (ticks_own, 0.0, 0.0) if self.is_master else self._clock.to_master(ticks_own)

    def _clock_known(self, ticks_own: int) -> bool:
        if self.is_master:
            return True
        return self._clock.updates > 1 and self._to_master(ticks_own)[2] < MAX_OFFSET_STD_M**2

    def _on_radio_grid(self, ticks_own: int) -> int:
        """The radio starts on multiples of 512 of its raw counter; the antenna's delay comes on top."""
        raw = ticks_own - self._own.tx_antenna_delay_ticks
        return raw - raw % DELAYED_TX_GRANULARITY_TICKS + self._own.tx_antenna_delay_ticks


def _filter_of(site: Site) -> ClockFilter:
    noise = site.noise
    variance = stamp_variance_m2(noise.tx_stamp_ps * 1e-12, rounded=False)
    variance += stamp_variance_m2(noise.rx_stamp_ps * 1e-12, rounded=True)
    return ClockFilter(clock_noise(noise.white_fm, noise.random_walk_fm), variance)


def _distance_m(one: AnchorSite, other: AnchorSite) -> float:
    return math.dist((one.x_m, one.y_m, one.z_m), (other.x_m, other.y_m, other.z_m))
