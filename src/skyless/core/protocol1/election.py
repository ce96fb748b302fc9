"""The election of the master, as one anchor sees it and takes part in it (``docs/protocol.md``, "The master")."""

from enum import StrEnum
from typing import Final

from skyless.core.protocol1._master_term import TERMS, Confirmations, MasterTerm, is_newer, master_term_of
from skyless.core.protocol1._watch import MasterWatch
from skyless.core.protocol1.beacon import Beacon
from skyless.core.protocol1.schedule import Schedule
from skyless.core.site import Site
from skyless.core.ticks import from_seconds

SILENT_SUPERFRAMES: Final = 3
"""After this many without news the master may have failed; a master that cannot send for that long resigns."""

PROCESSING_TICKS: Final = from_seconds(0.5e-3)
"""From the RMARKER of a frame until the receiving host has it."""

FIRST_LISTENING_SUPERFRAMES: Final = 3
"""For how many the anchor of the highest rank listens before it starts the site's time."""

LISTENING_TICKS: Final = from_seconds(0.5)
LISTENING_STEP_TICKS: Final = from_seconds(0.25)
"""For how long the others listen, and how much longer each next rank; on slow sites 8 superframes, and 4 more each."""

CONFIRMATION_SUPERFRAMES: Final = 16
"""A newer master term is accepted when it is received twice within this."""


class Role(StrEnum):
    """What an anchor is."""

    LISTENING = "listening"
    """Without a master, and not yet one itself."""
    FOLLOWER = "follower"
    MASTER = "master"


class Verdict(StrEnum):
    """What a beacon is to the anchor that received it."""

    FROM_MASTER = "from-master"
    """It is from the present master."""
    FROM_NEW_MASTER = "from-new-master"
    """It is from an anchor that is the master from now on. The clock may go on."""
    FROM_FIRST_MASTER = "from-first-master"
    """The same, but what was known of the site's time no longer counts."""
    STALE = "stale-master"
    """Its master has been replaced."""
    UNKNOWN = "unknown-master"
    """Its master is no anchor of the site."""
    OTHER = "other"


class MasterElection:
    """Tracks the master terms of the beacons received. Times are the own counter's, unwrapped.

    An anchor's rank is 0 for the site's first master, then it counts in the order of the site file.
    """

    def __init__(self, site: Site, anchor_id: int, schedule: Schedule) -> None:
        order = [site.master, *(anchor.id for anchor in site.anchors if anchor.id != site.master)]
        self.role = Role.LISTENING
        self.master_term: MasterTerm | None = None
        """The last one that was accepted; that of the anchor itself while it is the master."""
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
        """A master of an older term is better than none: a follower does not take over, and accepts it in the end."""
        if self.role is Role.MASTER:
            return Verdict.STALE
        self._waits_from_ticks = rx_ticks
        if rx_ticks - self._watch.news_ticks < self._isolation_ticks():
            return Verdict.STALE
        return self._accept(master_term, rx_ticks, Verdict.FROM_FIRST_MASTER)

    def _on_newer(self, master_term: MasterTerm, by_master: bool, rx_ticks: int) -> Verdict:
        """Leave the present master, or the own role, for a newer term; a master known by others is waited for."""
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
        """Whether the anchor has to take the role now; ``clock_is_good``: it can carry the site's time on."""
        if self._waits_from_ticks is None:
            self._waits_from_ticks = now_ticks
        if self.role is Role.LISTENING:
            return now_ticks - self._waits_from_ticks >= self._listening_ticks()
        return self.role is Role.FOLLOWER and self._must_take_over(now_ticks, clock_is_good)

    def _must_take_over(self, now_ticks: int, clock_is_good: bool) -> bool:
        """Whether the master has failed, and all anchors of higher rank had their time to take over."""
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
        """Anchors received after a time, except the master."""
        master = None if self.master_term is None else self.master_term.master
        return [other for other, heard in self._heard_ticks.items() if heard > ticks and other != master]

    def _listening_ticks(self) -> int:
        """How long to listen before starting the site's time."""
        first = self._rank[self._own] == 0
        return FIRST_LISTENING_SUPERFRAMES * self._superframe if first else self._takeover_ticks()

    def _takeover_ticks(self) -> int:
        """How long to wait without any other anchor: the lower the rank, the longer."""
        step = max(LISTENING_STEP_TICKS, 4 * self._superframe)
        return self._isolation_ticks() + max(self._rank[self._own] - 1, 0) * step

    def _isolation_ticks(self) -> int:
        return max(LISTENING_TICKS, 8 * self._superframe)

    def become_master(self, now_ticks: int) -> None:
        """Take the role, in a term of its own."""
        term = 0 if self.master_term is None else (self.master_term.term + 1) % TERMS
        self.role, self.master_term = Role.MASTER, MasterTerm(term, self._own)
        self._sent_ticks = now_ticks

    def on_sent(self, tx_ticks: int) -> None:
        """Note that a frame was made."""
        self._sent_ticks = tx_ticks

    def resign_if_silent(self, now_ticks: int) -> None:
        """A master that could not send for longer than others wait before they take over listens before it sends."""
        silence = now_ticks - self._sent_ticks
        if self.role is Role.MASTER and silence > SILENT_SUPERFRAMES * self._superframe:
            self.role, self._waits_from_ticks = Role.LISTENING, now_ticks
