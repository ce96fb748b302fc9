"""``Anchor``: the protocol machine of one anchor of protocol 1. Bytes and ticks in, frames and ticks out; no I/O.

A driver (simulator, daemon) passes it every reception, asks when its next frame is due, at least every 5 ms while there
is none, and fetches that frame as late as its radio allows, so that it carries the latest receptions.
"""

import math
from collections import Counter
from enum import StrEnum
from typing import Final

from msgspec import Struct

from skyless.core.air.almanac import Page
from skyless.core.air.frame import Heard, Malformed, Reception, Transmission
from skyless.core.anchor import MAX_RELAY_AGE_TICKS, delay_change_ticks, on_radio_grid
from skyless.core.clock_filter import ClockFilter, clock_noise, stamp_variances_m2
from skyless.core.protocol1.almanac import almanac_issue, page_for, pages_of
from skyless.core.protocol1.beacon import (
    Beacon,
    MasterTime,
    Schedule,
    decode_cached,
    encode,
    first_slots,
    heard_capacity,
    schedule_of,
)
from skyless.core.protocol1.clock import (
    TERMS,
    Confirmations,
    MasterTerm,
    MasterWatch,
    SiteClock,
    is_newer,
    master_term_of,
)
from skyless.core.site import AnchorSite, Site
from skyless.core.ticks import (
    DELAYED_TX_GRANULARITY_TICKS,
    SUBTICKS,
    TICK_M,
    TICK_RATE_HZ,
    TICK_S,
    Unwrapper,
    difference,
    from_seconds,
    wrap,
)

# The election of the master, as one anchor sees it and takes part in it (``docs/protocol.md``, "The master").

SILENT_SUPERFRAMES: Final = 3
"""Without news for this many, the master may have failed; a master that cannot send for as long resigns."""

PROCESSING_TICKS: Final = from_seconds(0.5e-3)
"""Time from a frame's RMARKER until the receiving host has it."""

FIRST_LISTENING_SUPERFRAMES: Final = 3
"""Superframes for which the anchor of the highest rank listens before it starts the site's time."""

LISTENING_TICKS: Final = from_seconds(0.5)
LISTENING_STEP_TICKS: Final = from_seconds(0.25)
"""Time for which the others listen, and the step from rank to rank; on slow sites 8 superframes, and 4 more each."""

CONFIRMATION_SUPERFRAMES: Final = 16
"""A newer master term is accepted once it is received twice within this time."""


class Role(StrEnum):
    """An anchor's role."""

    LISTENING = "listening"
    """Without a master, and not yet one itself."""
    FOLLOWER = "follower"
    MASTER = "master"


class Verdict(StrEnum):
    """Meaning of a beacon to the anchor that received it."""

    FROM_MASTER = "from-master"
    """From the present master."""
    FROM_NEW_MASTER = "from-new-master"
    """From an anchor that is the master from now on. The clock may continue."""
    FROM_FIRST_MASTER = "from-first-master"
    """The same, but previous knowledge of the site's time is void."""
    STALE = "stale-master"
    """Its master has been replaced."""
    UNKNOWN = "unknown-master"
    """Its master is no anchor of the site."""
    OTHER = "other"


class MasterElection:
    """Tracks the master terms in received beacons. Times are the own counter's, unwrapped.

    The site's first master has rank 0, the others follow in the order of the site file.
    """

    def __init__(self, site: Site, anchor_id: int, schedule: Schedule) -> None:
        order = [site.master, *(anchor.id for anchor in site.anchors if anchor.id != site.master)]
        self.role = Role.LISTENING
        self.master_term: MasterTerm | None = None
        """The last accepted term; its own while the anchor is the master."""
        self._own = anchor_id
        self._rank = {anchor: rank for rank, anchor in enumerate(order)}
        self._superframe = schedule.superframe_ticks
        self._turn = schedule.superframe_ticks // schedule.frames_per_node
        self._watch = MasterWatch()
        self._heard_ticks: dict[int, int] = {}
        self._waits_from_ticks: int | None = None
        self._confirmations = Confirmations()
        self._sent_ticks = 0

    def on_beacon(self, beacon: Beacon, rx_ticks: int) -> Verdict:
        """Update the master and its term from a beacon of another anchor of the site."""
        master_term, by_master = master_term_of(beacon), beacon.anchor == beacon.master
        self._heard_ticks[beacon.anchor] = rx_ticks
        if master_term.master not in self._rank:
            return Verdict.UNKNOWN
        if self.role is Role.LISTENING:
            self._waits_from_ticks = rx_ticks
            return self._accept(master_term, rx_ticks, Verdict.FROM_FIRST_MASTER) if by_master else Verdict.OTHER
        if master_term == self.master_term:
            if by_master:
                self._watch.update(beacon.anchor, beacon.sequence, rx_ticks)
            elif beacon.master_heard is not None:
                self._watch.update(beacon.anchor, beacon.master_heard.sequence, rx_ticks)
            return Verdict.FROM_MASTER if by_master else Verdict.OTHER
        if not self._is_newer(master_term):
            return self._on_older(master_term, rx_ticks) if by_master else Verdict.STALE
        self._waits_from_ticks = rx_ticks
        if by_master or self.role is Role.MASTER:
            within = CONFIRMATION_SUPERFRAMES * self._superframe
            if self._confirmations.confirm(master_term, rx_ticks, within):
                return self._on_newer(master_term, by_master, rx_ticks)
        return Verdict.OTHER

    def _on_older(self, master_term: MasterTerm, rx_ticks: int) -> Verdict:
        """Handle a master of an older term, which is better than none: do not take over, and accept it in the end."""
        if self.role is Role.MASTER:
            return Verdict.STALE
        self._waits_from_ticks = rx_ticks
        if rx_ticks - self._watch.news_ticks < self._isolation_ticks():
            return Verdict.STALE
        return self._accept(master_term, rx_ticks, Verdict.FROM_FIRST_MASTER)

    def _on_newer(self, master_term: MasterTerm, by_master: bool, rx_ticks: int) -> Verdict:
        """Leave the present master, or the own role, for a newer term; a master known only from others is awaited."""
        if not by_master:
            self.role, self.master_term = Role.LISTENING, master_term
            return Verdict.OTHER
        was_master = self.role is Role.MASTER
        return self._accept(master_term, rx_ticks, Verdict.FROM_FIRST_MASTER if was_master else Verdict.FROM_NEW_MASTER)

    def _accept(self, master_term: MasterTerm, rx_ticks: int, verdict: Verdict) -> Verdict:
        self.role, self.master_term = Role.FOLLOWER, master_term
        self._watch.begin(rx_ticks)
        return verdict

    def _is_newer(self, master_term: MasterTerm) -> bool:
        assert self.master_term is not None
        if master_term.term == self.master_term.term:
            return self._rank[master_term.master] < self._rank[self.master_term.master]
        return is_newer(master_term.term, self.master_term.term)

    def must_become_master(self, now_ticks: int, clock_is_good: bool) -> bool:
        """Whether the anchor has to take the role now; ``clock_is_good``: it can continue the site's time."""
        if self._waits_from_ticks is None:
            self._waits_from_ticks = now_ticks
        if self.role is Role.LISTENING:
            return now_ticks - self._waits_from_ticks >= self._listening_ticks()
        return self.role is Role.FOLLOWER and self._must_take_over(now_ticks, clock_is_good)

    def _must_take_over(self, now_ticks: int, clock_is_good: bool) -> bool:
        """Whether the master has failed and all anchors of higher rank had time to take over."""
        silent_from = max(self._watch.news_ticks, self._waits_from_ticks or 0)
        silence = now_ticks - silent_from - PROCESSING_TICKS
        if silence < SILENT_SUPERFRAMES * self._superframe:
            return False
        if not self._others_since(silent_from + self._superframe):
            return silence >= self._takeover_ticks()  # the own receiver, rather than the master, unless it lasts
        if not clock_is_good:
            if silence >= self._takeover_ticks():
                self.role, self._waits_from_ticks = Role.LISTENING, now_ticks
            return False
        others = self._others_since(silent_from - self._superframe)
        silence -= sum(self._rank[other] < self._rank[self._own] for other in others) * self._superframe
        return silence >= SILENT_SUPERFRAMES * self._superframe and self._watch.is_dead(silence // self._turn)

    def _others_since(self, ticks: int) -> list[int]:
        """Anchors other than the master received after a time."""
        master = None if self.master_term is None else self.master_term.master
        return [other for other, heard in self._heard_ticks.items() if heard > ticks and other != master]

    def _listening_ticks(self) -> int:
        """Time to listen before starting the site's time."""
        first = self._rank[self._own] == 0
        return FIRST_LISTENING_SUPERFRAMES * self._superframe if first else self._takeover_ticks()

    def _takeover_ticks(self) -> int:
        """Time to wait without any other anchor: the lower the rank, the longer."""
        step = max(LISTENING_STEP_TICKS, 4 * self._superframe)
        return self._isolation_ticks() + max(self._rank[self._own] - 1, 0) * step

    def _isolation_ticks(self) -> int:
        return max(LISTENING_TICKS, 8 * self._superframe)

    def become_master(self, now_ticks: int) -> None:
        """Take the role in a new term."""
        term = 0 if self.master_term is None else (self.master_term.term + 1) % TERMS
        self.role, self.master_term = Role.MASTER, MasterTerm(term, self._own)
        self._sent_ticks = now_ticks

    def on_sent(self, tx_ticks: int) -> None:
        """Record that a frame was made."""
        self._sent_ticks = tx_ticks

    def resign_if_silent(self, now_ticks: int) -> None:
        """Listen again if this master could not send for longer than others wait before they take over."""
        silence = now_ticks - self._sent_ticks
        if self.role is Role.MASTER and silence > SILENT_SUPERFRAMES * self._superframe:
            self.role, self._waits_from_ticks = Role.LISTENING, now_ticks


MAX_OFFSET_STD_M: Final = 0.3
"""An anchor sends only while its offset's standard deviation is below this (``docs/maths.md`` section 6)."""

MAX_TAKEOVER_STD_M: Final = 3.0
"""An anchor takes the master's role only while its offset's standard deviation is below this, by which the site's time
may jump, on sites whose superframes last a second."""


class SiteTimeState(Struct, frozen=True):
    """An anchor's knowledge of the site's time."""

    role: Role
    master: int | None
    """The present master, possibly the anchor itself; None before it has received one."""
    term: int | None
    """Number of takeovers of the master's role, modulo 256."""
    beacons: int
    """Master beacons used since the clock filter's last start."""
    is_known: bool
    rate_ppm: float
    offset_std_m: float
    """After the last beacon, in metres of light; 0 for the master."""
    offset_s: float | None
    """Own counter minus site time, modulo the wrap; None while unknown."""
    superframe: int | None


class Anchor:
    """One anchor of a site."""

    def __init__(self, site: Site, anchor_id: int, lead_s: float = 1e-3) -> None:
        """``lead_s``: how long before its RMARKER the driver needs a frame.

        The radio is configured with the antenna delays of ``site`` and keeps them.
        """
        self.id = anchor_id
        self.counters: Counter[str] = Counter()
        self._site = site
        self._anchors = {anchor.id: anchor for anchor in site.anchors}
        self._radio_delay_ticks = self._anchors[anchor_id].tx_antenna_delay_ticks
        self._correction_ticks = 0
        """Correction of the radio's TX stamps in frames, if another site corrects its delays."""
        self._lead_ticks = round(lead_s * TICK_RATE_HZ)
        self._schedule = schedule_of(site)
        self._slots = self._schedule.slots_of(first_slots(site)[anchor_id])
        self._pages: tuple[Page, ...] = pages_of(site)
        self._issue = almanac_issue(self._pages)
        self._own_ticks = Unwrapper()
        self._election = MasterElection(site, anchor_id, self._schedule)
        self._clock = SiteClock(_filter_of(site), self._schedule, self.counters)
        self._master_heard: Heard | None = None
        self._heard: dict[int, tuple[Heard, int]] = {}
        self._pending: dict[int, tuple[int, int]] = {}
        self._sequence = 0

    def place(self, site: Site) -> None:
        """Continue with other positions and antenna delays of the same anchors, with the same schedule.

        The radio's own stamps do not change; frames state them corrected.
        """
        self._anchors = {anchor.id: anchor for anchor in site.anchors}
        self._correction_ticks = delay_change_ticks(self._site, site, self.id)
        self._pages = pages_of(site)
        self._issue = almanac_issue(self._pages)
        master_term = self._election.master_term
        if self._election.role is Role.FOLLOWER and master_term is not None:
            self._clock.correct_range(_distance_m(self._anchors[self.id], self._anchors[master_term.master]))

    @property
    def is_master(self) -> bool:
        """Whether this anchor keeps the site's time at present."""
        return self._election.role is Role.MASTER

    @property
    def interval_ticks(self) -> float:
        """Time between two frames."""
        return self._schedule.superframe_ticks / self._schedule.frames_per_node

    def clock(self, now_ticks: int | None) -> SiteTimeState:
        """State of the own clock against the site's time; ``now_ticks``: the own counter, 40 bits."""
        master_term, clock, role = self._election.master_term, self._clock, self._election.role
        offset_s = superframe = None
        if now_ticks is not None and clock.epoch_ticks is not None and (self.is_master or clock.updates > 1):
            own_ticks = self._own_ticks.expect(now_ticks)
            site_ticks, fraction = divmod(clock.subticks(own_ticks), SUBTICKS)
            offset_s = (difference(wrap(own_ticks), wrap(site_ticks)) - fraction / SUBTICKS) * TICK_S
            superframe = (site_ticks - clock.epoch_ticks) // self._schedule.superframe_ticks
        return SiteTimeState(
            role=role,
            master=None if master_term is None else master_term.master,
            term=None if master_term is None else master_term.term,
            beacons=0 if self.is_master else clock.updates,
            is_known=self.is_master or (role is Role.FOLLOWER and clock.updates > 1),
            rate_ppm=clock.rate * 1e6,
            offset_std_m=0.0 if self.is_master else clock.offset_std_m,
            offset_s=offset_s,
            superframe=superframe,
        )

    def hear(self, reception: Reception) -> None:
        """Process a frame from the air. Frames of others are counted and dropped."""
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
            self._heard.pop(beacon.anchor, None)
            self._heard[beacon.anchor] = (heard, rx_ticks)
            self._update_master(beacon, heard, rx_ticks)

    def _update_master(self, beacon: Beacon, heard: Heard, rx_ticks: int) -> None:
        """Track which anchor is the master, and set the clock from the master's own beacons."""
        verdict = self._election.on_beacon(beacon, rx_ticks)
        if verdict in {Verdict.STALE, Verdict.UNKNOWN}:
            self.counters[verdict] += 1
        if verdict in {Verdict.FROM_NEW_MASTER, Verdict.FROM_FIRST_MASTER}:
            self._master_heard = None
            range_m = _distance_m(self._anchors[self.id], self._anchors[beacon.anchor])
            self._clock.track_master(range_m, restart=verdict is Verdict.FROM_FIRST_MASTER)
        elif verdict is not Verdict.FROM_MASTER:
            return
        if self._clock.on_master_beacon(beacon, rx_ticks):
            self._master_heard = heard

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        """TX stamp (40-bit, own counter) of the next frame that can still be prepared; None if the clock is unknown."""
        now = self._own_ticks.unwrap(now_ticks)
        self._election.resign_if_silent(now)
        self._take_over_if_due(now)
        earliest = now + self._lead_ticks
        epoch = self._clock.epoch_ticks
        if epoch is None or not self._may_send(earliest):
            return None
        since_epoch = self._clock.subticks(earliest) // SUBTICKS - epoch
        superframe, slot = self._schedule.next_slot(since_epoch + DELAYED_TX_GRANULARITY_TICKS, self._slots)
        tx_ticks = on_radio_grid(
            self._clock.ticks_own(epoch + self._schedule.slot_start_ticks(superframe, slot)), self._radio_delay_ticks
        )
        self._pending = {wrap(tx_ticks): (superframe, slot)}
        return wrap(tx_ticks)

    def transmission(self, tx_ticks: int) -> Transmission:
        """The frame for the time last returned by ``next_transmission_ticks``. Raises KeyError: it was another time."""
        superframe, slot = self._pending.pop(tx_ticks)
        unwrapped = self._own_ticks.expect(tx_ticks)
        self._take_over_if_due(unwrapped - self._lead_ticks)
        beacon = self._beacon(tx_ticks, superframe, slot)
        self._election.on_sent(unwrapped)
        self._sequence = (self._sequence + 1) & 0xFF
        self.counters["sent"] += 1
        return Transmission(encode(beacon), tx_ticks)

    def _take_over_if_due(self, now: int) -> None:
        """Take the master's role if no anchor has it: the site's time continues on the own clock."""
        good = self._clock.updates > 1 and self._clock.variance_m2(now) < MAX_TAKEOVER_STD_M**2
        if self._election.must_become_master(now, good):
            self.counters["takeover"] += self._election.master_term is not None
            self._election.become_master(now)
            self._clock.become_master(now)
            self._master_heard = None

    def _beacon(self, tx_ticks: int, superframe: int, slot: int) -> Beacon:
        superframe &= 0xFFFFFFFF  # as the frame shows it: its reader can compute the page
        page = page_for(self._pages, superframe, slot)
        master_term = self._election.master_term or MasterTerm(0, self.id)
        capacity = heard_capacity(master_heard=self._master_heard is not None, master_time=True, page=True)
        return Beacon(
            site=self._site.id,
            anchor=self.id,
            sequence=self._sequence,
            superframe=superframe,
            slot=slot,
            tx_ticks=wrap(tx_ticks + self._correction_ticks),
            almanac_issue=self._issue,
            master=master_term.master,
            term=master_term.term,
            master_heard=self._master_heard,
            master_time=self._master_time(self._own_ticks.expect(tx_ticks) + self._correction_ticks),
            heard=self._relayed(self._own_ticks.expect(tx_ticks), master_term.master)[:capacity],
            page=page,
        )

    def _relayed(self, ticks_own: int, master: int) -> tuple[Heard, ...]:
        """Recent receptions of anchors other than the master, the most recent first."""
        oldest = ticks_own - MAX_RELAY_AGE_TICKS
        return tuple(
            heard for heard, rx_ticks in reversed(self._heard.values()) if rx_ticks > oldest and heard.anchor != master
        )

    def _master_time(self, ticks_own: int) -> MasterTime | None:
        """Site time of a frame; None if its sender has just lost its master."""
        role = self._election.role
        if role is Role.LISTENING or (role is Role.FOLLOWER and self._clock.updates < 2):
            return None
        std_ticks = math.sqrt(self._clock.variance_m2(ticks_own)) / TICK_M
        return MasterTime(wrap(self._clock.subticks(ticks_own), 48), std_ticks)

    def _may_send(self, ticks_own: int) -> bool:
        """Whether the own clock is accurate enough for sending."""
        if self.is_master:
            return True
        following = self._election.role is Role.FOLLOWER and self._clock.updates > 1
        return following and self._clock.variance_m2(ticks_own) < MAX_OFFSET_STD_M**2


def _filter_of(site: Site) -> ClockFilter:
    noise = site.noise
    variance = sum(stamp_variances_m2(noise.tx_stamp_ps * 1e-12, noise.rx_stamp_ps * 1e-12))
    return ClockFilter(clock_noise(noise.white_fm, noise.random_walk_fm), variance)


def _distance_m(one: AnchorSite, other: AnchorSite) -> float:
    return math.dist((one.x_m, one.y_m, one.z_m), (other.x_m, other.y_m, other.z_m))
