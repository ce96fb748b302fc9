"""Who is the master: an anchor's view of it, and when it takes the role itself (``docs/protocol.md``, "The master")."""

from enum import StrEnum
from typing import Final

from skyless.air.beacon import Beacon
from skyless.air.master_term import TERMS, Confirmations, MasterTerm, is_newer, master_term_of
from skyless.clocks.watch import MasterWatch
from skyless.site.model import Site
from skyless.site.slots import Schedule
from skyless.ticks import from_seconds

SILENT_SUPERFRAMES: Final = 3
"""So many superframes without news of the master may be its death; a master that cannot send for so long resigns."""

HEARING_TICKS: Final = from_seconds(0.5e-3)
"""From the RMARKER of a frame until the listener's host has it."""

FIRST_LISTENING_SUPERFRAMES: Final = 3
"""So long the first in the succession listens before it starts the site's time."""

LISTENING_TICKS: Final = from_seconds(0.5)
LISTENING_STEP_TICKS: Final = from_seconds(0.25)
"""The others listen so long, and so much longer each; on slow sites 8 superframes, and 4 more each."""

CONFIRMED_WITHIN_SUPERFRAMES: Final = 16
"""A newer claim is believed when it is heard twice within this."""


class Role(StrEnum):
    """What an anchor is."""

    LISTENING = "listening"
    """Without a master, and not yet one itself."""
    FOLLOWER = "follower"
    MASTER = "master"


class Verdict(StrEnum):
    """What a beacon is to the anchor that heard it."""

    FROM_MASTER = "from-master"
    """Of the master that it follows."""
    FROM_NEW_MASTER = "from-new-master"
    """Of a master that it follows from now on; its clock may go on."""
    FROM_FIRST_MASTER = "from-first-master"
    """The same, but what was known of the site's time no longer counts."""
    STALE = "stale-master"
    """It goes by a master that is no more."""
    STRANGE = "unknown-master"
    """It goes by a master that the site has not."""
    OTHER = "other"


class MasterElection:
    """Follows the claims that are heard. Times are the own counter's, unwrapped."""

    def __init__(self, site: Site, anchor_id: int, schedule: Schedule) -> None:
        order = [site.master, *(anchor.id for anchor in site.anchors if anchor.id != site.master)]
        self.role = Role.LISTENING
        self.claim: MasterTerm | None = None
        """The last one that was believed; that of the anchor itself while it is the master."""
        self._own = anchor_id
        self._place = {anchor: place for place, anchor in enumerate(order)}
        self._superframe = schedule.superframe_ticks
        self._turn = schedule.superframe_ticks // schedule.frames_per_node
        self._watch = MasterWatch()
        self._heard_ticks: dict[int, int] = {}
        self._waits_from_ticks: int | None = None
        self._sightings = Confirmations()
        self._sent_ticks = 0

    def hear(self, beacon: Beacon, rx_ticks: int) -> Verdict:
        """Take what a beacon of another anchor of the site says of the master."""
        claim, from_claimant = master_term_of(beacon), beacon.anchor == beacon.master
        self._heard_ticks[beacon.anchor] = rx_ticks
        if claim.master not in self._place:
            return Verdict.STRANGE
        if self.role is Role.LISTENING:
            self._waits_from_ticks = rx_ticks
            return self._follow(claim, rx_ticks, Verdict.FROM_FIRST_MASTER) if from_claimant else Verdict.OTHER
        if claim == self.claim:
            if from_claimant:
                self._watch.update(beacon.anchor, beacon.sequence, rx_ticks)
            elif beacon.master_heard is not None:
                self._watch.update(beacon.anchor, beacon.master_heard.sequence, rx_ticks)
            return Verdict.FROM_MASTER if from_claimant else Verdict.OTHER
        if not self._is_newer(claim):
            return self._hear_stale(claim, rx_ticks) if from_claimant else Verdict.STALE
        self._waits_from_ticks = rx_ticks
        if from_claimant or self.role is Role.MASTER:
            within = CONFIRMED_WITHIN_SUPERFRAMES * self._superframe
            if self._sightings.again(claim, rx_ticks, within):
                return self._depose(claim, from_claimant, rx_ticks)
        return Verdict.OTHER

    def _hear_stale(self, claim: MasterTerm, rx_ticks: int) -> Verdict:
        """A master of an older claim is better than none: a follower does not take over, and follows it in the end."""
        if self.role is Role.MASTER:
            return Verdict.STALE
        self._waits_from_ticks = rx_ticks
        if rx_ticks - self._watch.news_ticks < self._lonely_ticks():
            return Verdict.STALE
        return self._follow(claim, rx_ticks, Verdict.FROM_FIRST_MASTER)

    def _depose(self, claim: MasterTerm, from_claimant: bool, rx_ticks: int) -> Verdict:
        """Leave the present master, or the own role, for a newer claim; one known by hearsay is yet to be heard."""
        if not from_claimant:
            self.role, self.claim = Role.LISTENING, claim
            return Verdict.OTHER
        was_master = self.role is Role.MASTER
        return self._follow(claim, rx_ticks, Verdict.FROM_FIRST_MASTER if was_master else Verdict.FROM_NEW_MASTER)

    def _follow(self, claim: MasterTerm, rx_ticks: int, verdict: Verdict) -> Verdict:
        self.role, self.claim = Role.FOLLOWER, claim
        self._watch.begin(rx_ticks)
        return verdict

    def _is_newer(self, claim: MasterTerm) -> bool:
        assert self.claim is not None
        if claim.term == self.claim.term:
            return self._place[claim.master] < self._place[self.claim.master]
        return is_newer(claim.term, self.claim.term)

    def must_lead(self, now_ticks: int, clock_is_good: bool) -> bool:
        """Whether the anchor has to take the role now; ``clock_is_good``: it can carry the site's time on."""
        if self._waits_from_ticks is None:
            self._waits_from_ticks = now_ticks
        if self.role is Role.LISTENING:
            return now_ticks - self._waits_from_ticks >= self._listening_ticks()
        return self.role is Role.FOLLOWER and self._must_succeed(now_ticks, clock_is_good)

    def _must_succeed(self, now_ticks: int, clock_is_good: bool) -> bool:
        """Whether the master is dead, and all that come before the own place had their time to take over."""
        silent_from = max(self._watch.news_ticks, self._waits_from_ticks or 0)
        silence = now_ticks - silent_from - HEARING_TICKS
        if silence < SILENT_SUPERFRAMES * self._superframe:
            return False
        if not self._others_since(silent_from + self._superframe):
            return silence >= self._patience_ticks()  # deafness, rather than the master's death, unless it lasts
        if not clock_is_good:
            if silence >= self._patience_ticks():
                self.role, self._waits_from_ticks = Role.LISTENING, now_ticks
            return False
        others = self._others_since(silent_from - self._superframe)
        silence -= sum(self._place[other] < self._place[self._own] for other in others) * self._superframe
        return silence >= SILENT_SUPERFRAMES * self._superframe and self._watch.is_dead(silence // self._turn)

    def _others_since(self, ticks: int) -> list[int]:
        """Whom the anchor has heard after a time, the master apart."""
        master = None if self.claim is None else self.claim.master
        return [other for other, heard in self._heard_ticks.items() if heard > ticks and other != master]

    def _listening_ticks(self) -> int:
        """How long to listen before starting the site's time."""
        first = self._place[self._own] == 0
        return FIRST_LISTENING_SUPERFRAMES * self._superframe if first else self._patience_ticks()

    def _patience_ticks(self) -> int:
        """How long to bear the loss of all others: the later in the succession, the longer."""
        step = max(LISTENING_STEP_TICKS, 4 * self._superframe)
        return self._lonely_ticks() + max(self._place[self._own] - 1, 0) * step

    def _lonely_ticks(self) -> int:
        return max(LISTENING_TICKS, 8 * self._superframe)

    def lead(self, now_ticks: int) -> None:
        """Become the master, in a term of its own."""
        term = 0 if self.claim is None else (self.claim.term + 1) % TERMS
        self.role, self.claim = Role.MASTER, MasterTerm(term, self._own)
        self._sent_ticks = now_ticks

    def sent(self, tx_ticks: int) -> None:
        """Note that a frame was made."""
        self._sent_ticks = tx_ticks

    def resign_if_silent(self, now_ticks: int) -> None:
        """A master that could not send for so long that others may have taken over listens before it speaks again."""
        silence = now_ticks - self._sent_ticks
        if self.role is Role.MASTER and silence > SILENT_SUPERFRAMES * self._superframe:
            self.role, self._waits_from_ticks = Role.LISTENING, now_ticks
