"""The site's time in protocol 1: an anchor's clock against it, the master's term, life and scale."""

import math
from collections import Counter
from typing import Final

from msgspec import Struct, field

from skyless.core.clock_filter import ClockFilter
from skyless.core.protocol1.beacon import Beacon, Schedule
from skyless.core.ticks import (
    DELAYED_TX_GRANULARITY_TICKS,
    SUBTICKS,
    TICK_M,
    TICK_MASK,
    continued,
    from_seconds,
    nearest,
)

MISFITS_BEFORE_RESTART: Final = 3
"""After this many consecutive misfits of master beacons, the site's time or the own clock has jumped."""

GRID_SLACK_TICKS: Final = 8 * DELAYED_TX_GRANULARITY_TICKS
"""Largest distance of a master's frames, which are on its radio's grid, from their slots."""

MASTER_CHANGE_INFLATION: Final = 2.0
"""A new master's clock was as uncertain as the own one: their difference has at most twice the variance."""

PLACEMENT_STD_M: Final = 1.0
"""Standard deviation of the offset's change when a survey has corrected positions and antenna delays."""


class SiteClock:
    """Conversion between own time and site time, and the phase of the superframes."""

    def __init__(self, clock: ClockFilter, schedule: Schedule, counters: Counter[str]) -> None:
        self.epoch_ticks: int | None = None
        """Unwrapped site time at the start of superframe 0; None while unknown."""
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
        """Master beacons used since the filter's last start."""
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
        """Synchronise to another master at this distance; ``restart``: forget the site's time."""
        self._range_m = range_m
        self._last_raw = self._last_frame = None
        self._misfits = 0
        self._own_site_time = None
        if restart:
            self._last = None
        else:
            self._clock.inflate_covariance(MASTER_CHANGE_INFLATION)

    def correct_range(self, range_m: float) -> None:
        """Use another distance to the same master, whose antenna delay may have been corrected too."""
        self._range_m = range_m
        self._clock.add_offset_variance(PLACEMENT_STD_M**2)

    def become_master(self, ticks_own: int) -> None:
        """Become the master: continue the site's time if it is known, otherwise start it from the own counter."""
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
        """Site time of an own time in 1/256 tick, both unwrapped."""
        if self._own_site_time is not None:
            return self._own_site_time.subticks(ticks_own)
        ticks, fraction, _ = self._clock.to_master(ticks_own)
        return ticks * SUBTICKS + round(fraction * SUBTICKS)

    def variance_m2(self, ticks_own: int) -> float:
        """Variance of the site time of an own time."""
        return 0.0 if self._own_site_time is not None else self._clock.to_master(ticks_own)[2]

    def ticks_own(self, ticks_site: int) -> int:
        """Own time nearest to a site time."""
        return (
            self._clock.from_master(ticks_site)
            if self._own_site_time is None
            else self._own_site_time.ticks_own(ticks_site)
        )

    def on_master_beacon(self, beacon: Beacon, rx_ticks: int) -> bool:
        """Process a beacon of the master. A misfit changes nothing unless others like it follow. True if used."""
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
        """Update the filter with a beacon. Returns unwrapped site time and superframe, or None for a misfit."""
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
    """The unwrapped time of a 40-bit counter that has run along with the own clock since the last one; None if not."""
    elapsed = rx_ticks - last_rx_ticks
    return continued(counter, last_ticks, elapsed) if elapsed > 0 else None


_RATE_BITS: Final = 64


class SiteTime(Struct, frozen=True):
    """Conversion between own counter and site time, exact to 1/256 tick at any distance (``docs/maths.md`` 6)."""

    epoch_own_ticks: int
    epoch_subticks: int
    """Site time at that own time, in 1/256 tick."""
    subticks_per_tick: int
    """Site time per own tick, in 2⁻⁶⁴ of 1/256 tick."""

    def subticks(self, ticks_own: int) -> int:
        """Site time of an own time, in 1/256 tick, both unwrapped."""
        return self.epoch_subticks + ((ticks_own - self.epoch_own_ticks) * self.subticks_per_tick >> _RATE_BITS)

    def ticks_own(self, ticks_site: int) -> int:
        """Own time nearest to a site time in whole ticks."""
        elapsed = (ticks_site * SUBTICKS - self.epoch_subticks) << _RATE_BITS
        return self.epoch_own_ticks + (elapsed + self.subticks_per_tick // 2) // self.subticks_per_tick

    @property
    def rate(self) -> float:
        """Fractional rate of the own counter against the site's time."""
        return (SUBTICKS << _RATE_BITS) / self.subticks_per_tick - 1.0

    @classmethod
    def onwards(cls, ticks_own: int, ticks_site: int, fraction_ticks: float, rate: float) -> "SiteTime":
        """Continue from an own time and its site time; ``rate`` is the own clock's."""
        subticks_per_tick = int(SUBTICKS / (1.0 + rate) * 2.0**_RATE_BITS)
        return cls(ticks_own, ticks_site * SUBTICKS + round(fraction_ticks * SUBTICKS), subticks_per_tick)


OWN_COUNTER: Final = SiteTime(0, 0, SUBTICKS << _RATE_BITS)
"""A site's time starts as its first master's own counter."""


# The master term of a beacon, which of two terms is the newer, and which one a tag uses.

TERMS: Final = 256

_CONFIRMATION_TICKS: Final = from_seconds(0.5)
"""A newer term is accepted once two beacons carry it within this time."""

_OLDER_AFTER_TICKS: Final = from_seconds(0.5)
"""A whole site that was switched off and on counts its terms from 0 again."""


class MasterTerm(Struct, frozen=True, gc=False):
    """A master, and the number of takeovers of its role so far, modulo 256."""

    term: int
    master: int


def master_term_of(beacon: Beacon) -> MasterTerm:
    """Return the master term that a beacon carries."""
    return MasterTerm(beacon.term, beacon.master)


def is_newer(term: int, other: int) -> bool:
    """Whether one term came after another: serial arithmetic (RFC 1982), correct up to 127 takeovers apart."""
    return 0 < (term - other) % TERMS < TERMS // 2


class Confirmations(Struct):
    """Master terms received once: two frames are required, so that a single corrupted one makes no new master."""

    seen: dict[MasterTerm, int] = {}

    def confirm(self, master_term: MasterTerm, rx_ticks: int, within_ticks: int) -> bool:
        """Add a master term. Returns True if it was received before within this time."""
        self.seen = {other: ticks for other, ticks in self.seen.items() if 0 < rx_ticks - ticks < within_ticks}
        confirmed = master_term in self.seen
        self.seen[master_term] = rx_ticks
        return confirmed


class FollowedMaster(Struct):
    """The master term that a tag uses: the newest one, or another one once that has fallen silent."""

    master_term: MasterTerm | None = None
    rx_ticks: int = 0
    confirmations: Confirmations = field(default_factory=Confirmations)

    @property
    def master(self) -> int | None:
        """The present master, None before the first beacon."""
        return None if self.master_term is None else self.master_term.master

    def on_beacon(self, beacon: Beacon, rx_ticks: int, superframe_ticks: int) -> bool:
        """Update the master term from a beacon. Returns False if the beacon's master has been replaced.

        A newer term counts from its second beacon on; the first one may be used, as the site's time continues. Another
        master of the same term counts after a superframe and a half without the present one, an older term after three
        superframes and at least half a second. ``superframe_ticks`` is 0 before the schedule is known.
        """
        present = self.master_term
        if present is not None and beacon.term == present.term and beacon.master == present.master:
            self.rx_ticks = rx_ticks
            return True
        received = master_term_of(beacon)
        if present is not None and is_newer(received.term, present.term):
            if self.confirmations.confirm(received, rx_ticks, _CONFIRMATION_TICKS):
                self.master_term, self.rx_ticks = received, rx_ticks
            return True
        if present is not None:
            silence_ticks = max(_OLDER_AFTER_TICKS, 3 * superframe_ticks)
            if received.term == present.term and superframe_ticks:
                silence_ticks = 3 * superframe_ticks // 2
            if 0 <= rx_ticks - self.rx_ticks < silence_ticks:
                return False
        self.master_term, self.rx_ticks = received, rx_ticks
        return True


# Whether the master still lives, from its own beacons and from what others relay of them.
#
# Every listener estimates how often each link brings news of the master. A silent master is declared dead once its
# silence is almost impossible on those links; lost frames alone do not replace a master.

MAX_CHANCE: Final = 1e-10
"""Chance of a silence, were the master alive, below which it is declared dead."""

MEMORY: Final = 64
"""Turns of the master over which a link's share is averaged."""

RECENT_TURNS: Final = 8
"""A link that has brought nothing for this number of turns does not count."""

SEQUENCES: Final = 256


class _Link(Struct):
    """A source of news of the master: itself, or an anchor that receives it."""

    sequence: int
    """Sequence number of the master's last beacon that it reported."""
    turns: int = 0
    share: float = 0.5
    """Part of the master's turns that it reports before the next one."""


class MasterWatch:
    """Tracks the sequence numbers of one master's beacons; a turn is one beacon that it should send."""

    def __init__(self) -> None:
        self.news_ticks = 0
        """Own time of the last news, unwrapped."""
        self._sequence: int | None = None
        self._links: dict[int, _Link] = {}

    def begin(self, now_ticks: int) -> None:
        """Watch another master, which lives at this time."""
        self.news_ticks, self._sequence = now_ticks, None
        self._links.clear()

    def update(self, source: int, sequence: int, now_ticks: int) -> None:
        """Process the sequence number of the master's last beacon, from itself or an anchor that received it."""
        if self._sequence is None or 0 < (sequence - self._sequence) % SEQUENCES < SEQUENCES // 2:
            self._sequence, self.news_ticks = sequence, now_ticks
        link = self._links.get(source)
        if link is None:
            self._links[source] = _Link(sequence)
            return
        turns = (sequence - link.sequence) % SEQUENCES
        if not 0 < turns < SEQUENCES // 2:
            return
        for turn in range(1, turns + 1):
            link.turns = min(link.turns + 1, MEMORY)
            link.share += ((turn == turns) - link.share) / (link.turns + 2)
        link.sequence = sequence

    def is_dead(self, missed_turns: int) -> bool:
        """Whether this number of turns without news shows that the master is dead."""
        return missed_turns * self._surprise() > -math.log(MAX_CHANCE)

    def _surprise(self) -> float:
        """Negative logarithm of the chance that a turn of a living master brings no news."""
        least = 1.0 / (MEMORY + 2)
        return sum(
            -math.log(max(1.0 - link.share, least))
            for link in self._links.values()
            if self._sequence is not None and (self._sequence - link.sequence) % SEQUENCES < RECENT_TURNS
        )


# The master's own counter against the site's time, which it may continue at another rate than its own.

FARTHEST_LENGTHS: Final = 16  # lines are extended by this number of times their length
MISFIT_SUBTICKS: Final = 64  # by which a master's packets may lie off the line: roundings, extended that far

SITE_TIME_MASK: Final = SUBTICKS * (TICK_MASK + 1) - 1


class MasterScale(Struct):
    """A straight line through the first and the last packet of a master's term."""

    master_term: MasterTerm | None = None
    points: tuple[tuple[int, int, int, int], ...] = ()
    """Site time and its lead over the master's counter, each in ticks and subticks: 64 bits cannot hold subticks."""

    def update(self, master_term: MasterTerm, site_subticks: int, tx_ticks: int) -> None:
        """Process a packet of the master."""
        lead = site_subticks - tx_ticks * SUBTICKS
        point = (*divmod(site_subticks, SUBTICKS), *divmod(lead, SUBTICKS))
        if master_term != self.master_term:
            self.master_term, self.points = master_term, (point,)
        elif point > self.points[-1]:
            expected = self._lead(site_subticks)
            fits = len(self.points) < 2 or (expected is not None and abs(expected - lead) <= MISFIT_SUBTICKS)
            self.points = (self.points[0], point) if fits else (point,)

    def difference(self, master_term: MasterTerm | None, site_subticks: int, tx_ticks: int) -> int | None:
        """An anchor's time minus the master's at its TX stamp, in subticks modulo 2⁴⁸; None if unknown."""
        lead = self._lead(site_subticks) if master_term == self.master_term else None
        return None if lead is None else (lead - site_subticks + tx_ticks * SUBTICKS) & SITE_TIME_MASK

    def _lead(self, site_subticks: int) -> int | None:
        """Lead of the site's time over the master's counter, on the line; None too far beyond it."""
        if len(self.points) < 2:
            return None
        (first, before), (last, lead) = ((a * SUBTICKS + b, c * SUBTICKS + d) for a, b, c, d in self.points)
        length, beyond = last - first, site_subticks - last
        return lead + (lead - before) * beyond // length if 0 <= beyond <= FARTHEST_LENGTHS * length else None
