"""An anchor's own counter against the site's time: by the master's beacons, or, as the master, by its own counter."""

from collections import Counter
from typing import Final

from msgspec import Struct

from skyless.core.clock_filter import ClockFilter
from skyless.core.constants import DELAYED_TX_GRANULARITY_TICKS, SUBTICKS, TICK_M
from skyless.core.protocol1.beacon import Beacon
from skyless.core.protocol1.schedule import Schedule
from skyless.core.ticks import continued, nearest

MISFITS_BEFORE_RESTART: Final = 3
"""If this number of master beacons in a row do not fit, the site's time, or the own clock, has jumped."""

GRID_SLACK_TICKS: Final = 8 * DELAYED_TX_GRANULARITY_TICKS
"""By how much a master's frames, which lie on its radio's grid, may be off their slots."""

MASTER_CHANGE_INFLATION: Final = 2.0
"""A new master's clock was known as well as the own one: their difference has at most twice the variance."""

PLACEMENT_STD_M: Final = 1.0
"""By which the offset may change when a survey has corrected positions and antenna delays."""


class SiteClock:
    """Own time to site time and back, and where the superframes lie."""

    def __init__(self, clock: ClockFilter, schedule: Schedule, counters: Counter[str]) -> None:
        self.epoch_ticks: int | None = None
        """Site time at which superframe 0 began, unwrapped as the site time is; None before that is known."""
        self._clock = clock
        self._schedule = schedule
        self._counters = counters
        self._own_site_time: SiteTime | None = None
        self._range_m = 0.0
        self._last: tuple[int, int] | None = None
        self._last_raw: tuple[int, int] | None = None
        self._last_frame: tuple[int, int] | None = None
        self._misfits = 0

    @property
    def updates(self) -> int:
        """Master beacons filtered since the filter's last start."""
        return self._clock.updates if self._last is not None else 0

    @property
    def rate(self) -> float:
        """Fractional rate of the own counter against the site's time."""
        return self._clock.rate if self._own_site_time is None else self._own_site_time.rate

    @property
    def offset_std_m(self) -> float:
        """Standard deviation of the offset at the last beacon, in metres of light; 0 for the master."""
        return self._clock.offset_std_m if self._own_site_time is None else 0.0

    def track_master(self, range_m: float, restart: bool) -> None:
        """Synchronise to another master at this distance; ``restart``: forget what was known of the site's time."""
        self._range_m = range_m
        self._last_raw = self._last_frame = None
        self._misfits = 0
        self._own_site_time = None
        if restart:
            self._last = None
        else:
            self._clock.inflate_covariance(MASTER_CHANGE_INFLATION)

    def correct_range(self, range_m: float) -> None:
        """Use another distance to the same master, whose antenna delay may have been corrected with it."""
        self._range_m = range_m
        self._clock.add_offset_variance(PLACEMENT_STD_M**2)

    def become_master(self, ticks_own: int) -> None:
        """Become the master: the site's time goes on from here as far as it is known, else the own counter is it."""
        if self._own_site_time is None:
            if self.updates > 1:
                self._own_site_time = SiteTime.onwards(
                    ticks_own, *self._clock.to_master(ticks_own)[:2], self._clock.rate
                )
            else:
                self._own_site_time, self.epoch_ticks = OWN_COUNTER, None
        if self.epoch_ticks is None:
            self.epoch_ticks = self._own_site_time.subticks(ticks_own) // SUBTICKS

    def subticks(self, ticks_own: int) -> int:
        """Site time of an own reading in 1/256 tick, both unwrapped."""
        if self._own_site_time is not None:
            return self._own_site_time.subticks(ticks_own)
        ticks, fraction, _ = self._clock.to_master(ticks_own)
        return ticks * SUBTICKS + round(fraction * SUBTICKS)

    def variance_m2(self, ticks_own: int) -> float:
        """Variance of the site time of an own reading."""
        return 0.0 if self._own_site_time is not None else self._clock.to_master(ticks_own)[2]

    def ticks_own(self, ticks_site: int) -> int:
        """Nearest own reading of a site time."""
        return (
            self._clock.from_master(ticks_site)
            if self._own_site_time is None
            else self._own_site_time.ticks_own(ticks_site)
        )

    def on_master_beacon(self, beacon: Beacon, rx_ticks: int) -> bool:
        """Process a beacon of the master; one that does not fit changes nothing, unless others like it come."""
        if self._last_frame == (beacon.tx_ticks, beacon.sequence):
            self._counters["duplicate"] += 1
            return False
        if beacon.master_time is None:
            self._counters["no-master-time"] += 1
            return False
        whole, fraction = divmod(beacon.master_time.tx_subticks_master, SUBTICKS)
        range_m = self._range_m + fraction * TICK_M / SUBTICKS
        filtered = self._filter(beacon, whole, rx_ticks, range_m)
        if filtered is None:
            self._misfits += 1
            if self._misfits < MISFITS_BEFORE_RESTART:
                return False
            self._counters["clock-restart"] += 1
            filtered = self._begin(beacon, whole, rx_ticks, range_m)
        self._misfits = 0
        ticks_site, superframe = filtered
        self._last, self._last_raw = (ticks_site, rx_ticks), (beacon.tx_ticks, rx_ticks)
        self._last_frame = (beacon.tx_ticks, beacon.sequence)
        self.epoch_ticks = ticks_site - self._schedule.slot_start_ticks(superframe, beacon.slot)
        return True

    def _begin(self, beacon: Beacon, ticks_site: int, rx_ticks: int, range_m: float) -> tuple[int, int]:
        self._clock.restart(ticks_site, rx_ticks, range_m)
        return ticks_site, beacon.superframe

    def _filter(self, beacon: Beacon, whole: int, rx_ticks: int, range_m: float) -> tuple[int, int] | None:
        """Process a beacon by the filter; its site time and superframe, unwrapped, or None where it does not fit."""
        if self._last is None or self.epoch_ticks is None:
            return self._begin(beacon, whole, rx_ticks, range_m)
        ticks_site = _unwrapped(whole, *self._last, rx_ticks)
        raw_fits = self._last_raw is None or _unwrapped(beacon.tx_ticks, *self._last_raw, rx_ticks) is not None
        if ticks_site is None or not raw_fits:
            self._counters["impossible-stamp"] += 1
            return None
        superframe_ticks = self._schedule.superframe_ticks
        superframe = nearest(beacon.superframe, (ticks_site - self.epoch_ticks) // superframe_ticks, 32)
        late = ticks_site - self.epoch_ticks - self._schedule.slot_start_ticks(superframe, beacon.slot)
        if abs(late) > GRID_SLACK_TICKS:
            self._counters["impossible-stamp"] += 1
            return None
        self._clock.update(ticks_site, rx_ticks, range_m)
        if self._clock.rejected:
            self._counters["clock-outlier"] += 1
            return None
        return ticks_site, superframe


def _unwrapped(counter: int, last_ticks: int, last_rx_ticks: int, rx_ticks: int) -> int | None:
    """The unwrapped time of a 40-bit counter that ran on by the own clock since the last one; None if it did not."""
    elapsed = rx_ticks - last_rx_ticks
    return continued(counter, last_ticks, elapsed) if elapsed > 0 else None


_RATE_BITS: Final = 64


class SiteTime(Struct, frozen=True):
    """Own counter to site time and back, exact to 1/256 tick at any distance (``docs/maths.md`` section 6)."""

    epoch_own_ticks: int
    epoch_subticks: int
    """Site time at that reading, in 1/256 tick."""
    subticks_per_tick: int
    """Site time that passes in one own tick, in 2⁻⁶⁴ of 1/256 tick."""

    def subticks(self, ticks_own: int) -> int:
        """Site time of an own reading, in 1/256 tick, both unwrapped."""
        return self.epoch_subticks + ((ticks_own - self.epoch_own_ticks) * self.subticks_per_tick >> _RATE_BITS)

    def ticks_own(self, ticks_site: int) -> int:
        """Nearest own reading of a site time in whole ticks."""
        elapsed = (ticks_site * SUBTICKS - self.epoch_subticks) << _RATE_BITS
        return self.epoch_own_ticks + (elapsed + self.subticks_per_tick // 2) // self.subticks_per_tick

    @property
    def rate(self) -> float:
        """Fractional rate of the own counter against the site's time."""
        return (SUBTICKS << _RATE_BITS) / self.subticks_per_tick - 1.0

    @classmethod
    def onwards(cls, ticks_own: int, ticks_site: int, fraction_ticks: float, rate: float) -> "SiteTime":
        """The map that goes on from a reading and the site time known for it; ``rate`` is the own clock's."""
        subticks_per_tick = int(SUBTICKS / (1.0 + rate) * 2.0**_RATE_BITS)
        return cls(ticks_own, ticks_site * SUBTICKS + round(fraction_ticks * SUBTICKS), subticks_per_tick)


OWN_COUNTER: Final = SiteTime(0, 0, SUBTICKS << _RATE_BITS)
"""The time of a site that its first master starts is the master's own counter."""
