"""Claims on the slot time of protocol 2: whose counter leads it, as one anchor sees it.

Every beacon states the claim that its sender follows: term and root. Claims are in a total order, and the greatest one
received is followed at once. Within a claim the root's superframe numbers, the pulses, show that it lives: they flood
from anchor to anchor, and each anchor knows by which hop they come. Whoever receives none for long enough leads
itself, in the next term; neighbours of the dead root are the first, as they wait for the fewest hops.

A pure state machine: no clock, no randomness. Times are the own counter's, unwrapped.
"""

import math
from collections.abc import Iterable
from enum import StrEnum
from typing import Final

from msgspec import Struct

from skyless.air.beacon2 import MOST_PULSE_AGE, SlotTime

LISTENING_SUPERFRAMES: Final = 3
"""For how many an anchor listens before it sends, or leads if it has received no claim."""

FIRST_STEP: Final = 8
MOST_TERM: Final = (1 << 32) - 1
MOST_HOP: Final = 0xFF

NEWS_CHANCE: Final = 1e-8
"""Chance of a silence, were the root alive, beyond which waiting for hops and identifier begins."""
NEWS_MEMORY: Final = 256
"""Superframes over which the share of those with news is averaged."""
LEARNED_GAPS: Final = 32
"""Before this many the regularity of gaps is not relied on."""
SUPPOSED_MISSES: Final = 3
"""Superframes without news that are counted on top of those seen, so that few superframes prove little."""
LEAST_PATIENCE: Final = 4
MOST_PATIENCE: Final = 128
"""Limits of the wait that is learned, in superframes."""
HOP_PATIENCE: Final = 2
"""Further superframes for each hop from the root."""
TURNS: Final = 3
"""The wait ends up to two superframes later by identifier, so that fewer anchors lead at once."""

MOST_PARENTS: Final = 3
FRESH_SUPERFRAMES: Final = 32
"""A neighbour that was not received for longer is no parent."""
DEPTH_GAIN: Final = 0.25
DEPTH_STEP: Final = 0.5
"""A parent is nearer to the root by at least this, in averaged hops; so are hops compared between candidates."""
PARENT_BONUS_HOPS: Final = 0.5
PARENT_BONUS_DB: Final = 6.0
"""A parent is replaced only by a neighbour that is better by more than one of these."""

SILENCE_SUPERFRAMES: Final = 0.5
"""From the last frame in one phase to the first in another, at least; what spreads waits for it at each hop."""
MISFITS_BEFORE_CHANGE: Final = 3
"""After this many beacons of the own claim in a row that are out of phase and have news, the own phase is wrong."""
MOST_CHANGES: Final = 8.0
CHANGES_PER_SUPERFRAME: Final = 1.0 / 16.0
"""Changes of phase that an anchor makes at once, and on average: each costs a frame or two, and forged claims must not
silence the site."""

_PULSE_BITS: Final = 32
_PULSE_HALF: Final = 1 << (_PULSE_BITS - 1)
_PULSE_MASK: Final = (1 << _PULSE_BITS) - 1


class SlotClaim(Struct, frozen=True, gc=False):
    """Whose counter leads the slot time. A greater claim has the higher term, or in one term the lower root."""

    term: int
    """Counts the takeovers, 32 bits."""
    root: int
    """Identifier of the anchor that leads."""

    def __lt__(self, other: "SlotClaim") -> bool:
        return (self.term, -self.root) < (other.term, -other.root)


class SlotRole(StrEnum):
    """What an anchor is."""

    LISTENING = "listening"
    """Without a claim."""
    FOLLOWER = "follower"
    ROOT = "root"


class ClaimVerdict(StrEnum):
    """What a beacon's claim is to the anchor that received it."""

    SAME = "same-claim"
    """The own one, in the own phase."""
    ADOPTED = "adopted-claim"
    """Followed from now on, with its numbers; the phase is the own one, or there was none."""
    ADOPTED_OTHER_PHASE = "adopted-claim-other-phase"
    """Followed from now on; the own phase changes, after a silence."""
    LESSER = "lesser-claim"
    OFF_PHASE = "off-phase"
    """The own claim, but not in the own phase: it does not count."""
    EXPIRED = "expired-claim"
    """Its root is dead: its newest pulse is too old, or it was given up here."""
    HELD = "held-claim"
    """It would change the phase once more within too short a time."""


class Lead(StrEnum):
    """How an anchor comes to lead."""

    FIRST = "first"
    """With a slot time of its own."""
    TAKEOVER = "takeover"
    """The slot time that it followed goes on by its own counter."""


def first_wait_superframes(rank: int) -> int:
    """For how many superframes longer an anchor listens before it leads: by its rank in the order of identifiers.

    The lowest does not wait, as it would win anyway; the more there are that wait as long, the later they begin.
    """
    return FIRST_STEP * rank.bit_length()


class NewsWatch:
    """Learns in which gaps a living root's pulses bring news, and so how long to wait for them.

    Two models, of which the shorter wait counts. Where each superframe brings news with one chance, gaps are geometric.
    After many lossy hops pulses have caught up with each other: gaps are longer but regular (a gamma distribution).
    """

    def __init__(self) -> None:
        self._misses = self._turns = 0.0
        """Superframes without news, and all, each with the weight of its age."""
        self._gaps = 0
        self._mean, self._square = 2.0, 8.0
        """Of gaps in superframes."""
        self.patience = MOST_PATIENCE
        """Superframes without news that next to never happen while the root lives."""

    def update(self, superframes: int) -> None:
        """Process news that came this number of superframes after the last; those between brought none."""
        gap = min(superframes, NEWS_MEMORY)
        kept = 1.0 - gap / NEWS_MEMORY
        self._misses, self._turns = kept * self._misses + gap - 1, kept * self._turns + gap
        self._gaps = min(self._gaps + 1, NEWS_MEMORY)
        self._mean += (gap - self._mean) / (self._gaps + 1)
        self._square += (gap * gap - self._square) / (self._gaps + 1)
        share = (self._misses + SUPPOSED_MISSES) / (self._turns + SUPPOSED_MISSES + 1)
        longest = math.log(NEWS_CHANCE) / math.log(share)
        if self._gaps >= LEARNED_GAPS:
            longest = min(longest, self._regular_gap())
        self.patience = min(max(math.ceil(longest), LEAST_PATIENCE), MOST_PATIENCE)

    def _regular_gap(self) -> float:
        """Gap beyond which the bound of Chernoff for a gamma distribution of that mean and scatter has the chance."""
        variance = max(self._square - self._mean * self._mean, 1e-3)
        shape = max(self._mean * self._mean / variance, 1.0)
        ratio = 1.0 - math.log(NEWS_CHANCE) / shape
        for _ in range(4):
            ratio = 1.0 + math.log(ratio) - math.log(NEWS_CHANCE) / shape
        return self._mean * ratio


class _Neighbour(Struct):
    """An anchor that follows the own claim, as received last."""

    rx_ticks: int
    depth: float
    """Its hops from the root, averaged."""
    power_dbm: float


class SlotClaims:
    """Which claim an anchor follows, how far it is from the root, and when it must lead or be silent."""

    def __init__(self, anchor_id: int, superframe_ticks: int, wait_superframes: int = 0) -> None:
        """``wait_superframes``: how much longer it listens before it leads (``first_wait_superframes``)."""
        self.role = SlotRole.LISTENING
        self.claim: SlotClaim | None = None
        self.hop = 0
        """Links from the root by which the newest pulse came; 0 for the root."""
        self.pulse = 0
        """Newest superframe in which the root is known to have sent, 32 bits; without meaning for the root itself."""
        self.source: int | None = None
        """The anchor that brought that pulse by the fewest hops."""
        self.parents: tuple[int, ...] = ()
        """Up to three neighbours nearer to the root, the best first; as ``choose_parents`` left them."""
        self.watch = NewsWatch()
        self._own = anchor_id
        self._superframe_ticks = superframe_ticks
        self._wait_ticks = (LISTENING_SUPERFRAMES + wait_superframes) * superframe_ticks
        self._started_ticks: int | None = None
        self._sent_ticks: int | None = None
        self._silent_until_ticks: int | None = None
        self._news_ticks = 0
        self._depth = 0.0
        self._neighbours: dict[int, _Neighbour] = {}
        self._misfits = 0
        self._changes = MOST_CHANGES
        self._changed_ticks = 0
        self._expired: tuple[SlotClaim, int] | None = None

    def on_beacon(
        self, anchor: int, stated: SlotTime, rx_ticks: int, off_phase: bool, power_dbm: float = 0.0
    ) -> ClaimVerdict:
        """Process the claim of a beacon of another known anchor, whose stamps fit those before.

        ``off_phase``: the sender's superframe of that number does not begin when the own one of that number does;
        False where there is no own one yet.
        """
        self._start(rx_ticks)
        claim = self.claim
        if claim is None or stated.term > claim.term or (stated.term == claim.term and stated.root < claim.root):
            return self._consider(anchor, stated, rx_ticks, off_phase, power_dbm)
        if stated.root != claim.root or stated.term != claim.term:
            return ClaimVerdict.LESSER
        pulse = (stated.superframe - stated.pulse_age) & _PULSE_MASK
        ahead = ((pulse - self.pulse + _PULSE_HALF) & _PULSE_MASK) - _PULSE_HALF
        has_news = ahead > 0 and stated.pulse_age < MOST_PULSE_AGE and self.role is not SlotRole.ROOT
        if off_phase:
            return self._misfit(anchor, stated, rx_ticks, power_dbm) if has_news else ClaimVerdict.OFF_PHASE
        self._misfits = 0
        neighbour = self._neighbours.get(anchor)
        if neighbour is None:
            self._neighbours[anchor] = _Neighbour(rx_ticks, float(stated.hop), power_dbm)
        else:
            neighbour.rx_ticks, neighbour.power_dbm = rx_ticks, power_dbm
            neighbour.depth += (stated.hop - neighbour.depth) * DEPTH_GAIN
        if has_news:
            self._on_news(anchor, stated, pulse, rx_ticks)
        elif ahead == 0 and stated.hop + 1 < self.hop:
            self.hop, self.source = stated.hop + 1, anchor
        return ClaimVerdict.SAME

    def advance(self, now_ticks: int) -> Lead | None:
        """Lead if the time has come; how, if so."""
        started_ticks = self._start(now_ticks)
        if self.role is SlotRole.ROOT:
            return None
        claim = self.claim
        if claim is None:
            if now_ticks - started_ticks < self._wait_ticks:
                return None
            self.lead(SlotClaim(0, self._own))
            return Lead.FIRST
        if now_ticks - self._news_ticks <= self.patience_superframes * self._superframe_ticks:
            return None
        if claim.term < MOST_TERM:
            self.lead(SlotClaim(claim.term + 1, self._own))
        else:  # no term is left: the claim is given up, and the order begins again
            self._expired = (claim, self.pulse)
            self.lead(SlotClaim(0, self._own))
        return Lead.TAKEOVER

    @property
    def patience_superframes(self) -> int:
        """For how many superframes without news this follower waits before it leads."""
        return max(self.watch.patience, LEAST_PATIENCE + HOP_PATIENCE * self.hop) + self._own % TURNS

    def lead(self, claim: SlotClaim) -> None:
        """Become the root of a claim; ``advance`` does it when it is time."""
        self.role, self.claim = SlotRole.ROOT, claim
        self.hop, self.source, self.parents = 0, None, ()
        self._depth = 0.0
        self._misfits = 0
        self._neighbours.clear()

    def may_send(self, tx_ticks: int) -> bool:
        """Whether it may send in its slot at this time."""
        if self.claim is None or (self._silent_until_ticks is not None and tx_ticks < self._silent_until_ticks):
            return False
        return tx_ticks - self._start(tx_ticks) >= LISTENING_SUPERFRAMES * self._superframe_ticks

    def on_sent(self, tx_ticks: int) -> None:
        """Note a frame of its own."""
        self._sent_ticks = tx_ticks
        if self._silent_until_ticks is not None and tx_ticks < self._silent_until_ticks:
            self._begin_silence(tx_ticks)  # it was on its way when the phase changed

    def pulse_age(self, superframe: int) -> int:
        """Superframes since the newest pulse, as a beacon in ``superframe`` (32 bits or unwrapped) states it."""
        if self.role is SlotRole.ROOT:
            return 0
        return min((superframe - self.pulse) & _PULSE_MASK, MOST_PULSE_AGE)

    def choose_parents(self, now_ticks: int) -> tuple[int, ...]:
        """Choose the neighbours whose time is followed; meant for once in a superframe. None of them for the root."""
        oldest = now_ticks - FRESH_SUPERFRAMES * self._superframe_ticks
        self._neighbours = {name: one for name, one in self._neighbours.items() if one.rx_ticks >= oldest}
        if self.role is not SlotRole.FOLLOWER:
            self.parents = ()
            return ()
        present = set(self.parents)
        nearer = [(name, one) for name, one in self._neighbours.items() if one.depth <= self._depth - DEPTH_STEP]
        nearer.sort(key=lambda item: _rank(item[0], item[1], item[0] in present))
        self.parents = tuple(name for name, _ in nearer[:MOST_PARENTS]) or self._only_source()
        return self.parents

    def _only_source(self) -> tuple[int, ...]:
        """Where averages show no neighbour as nearer: the one by which the newest pulse came."""
        return () if self.source not in self._neighbours else (self.source,)

    def _start(self, now_ticks: int) -> int:
        if self._started_ticks is None:
            self._started_ticks = self._changed_ticks = now_ticks
        return self._started_ticks

    def _consider(
        self, anchor: int, stated: SlotTime, rx_ticks: int, off_phase: bool, power_dbm: float
    ) -> ClaimVerdict:
        """Adopt a greater claim, unless its root is dead or the phase changed too often."""
        offered = SlotClaim(stated.term, stated.root)
        pulse = (stated.superframe - stated.pulse_age) & _PULSE_MASK
        overdue = stated.pulse_age - HOP_PATIENCE * (stated.hop + 1)
        if overdue > MOST_PATIENCE or stated.pulse_age == MOST_PULSE_AGE or self._was_given_up(offered, pulse):
            return ClaimVerdict.EXPIRED
        if off_phase and not self._may_change(rx_ticks):
            return ClaimVerdict.HELD
        self.role, self.claim = SlotRole.FOLLOWER, offered
        self._neighbours.clear()
        self.parents = ()
        self._depth = stated.hop + 1.0
        self._join(anchor, stated, pulse, rx_ticks, power_dbm)
        self._news_ticks = rx_ticks - max(overdue, 0) * self._superframe_ticks
        if not off_phase:
            return ClaimVerdict.ADOPTED
        self._change_phase()
        return ClaimVerdict.ADOPTED_OTHER_PHASE

    def _misfit(self, anchor: int, stated: SlotTime, rx_ticks: int, power_dbm: float) -> ClaimVerdict:
        """Count news of the own claim in another phase; when there are no others, that phase is the right one."""
        self._misfits += 1
        if self._misfits < MISFITS_BEFORE_CHANGE or not self._may_change(rx_ticks):
            return ClaimVerdict.OFF_PHASE
        self._neighbours.clear()
        self._join(anchor, stated, (stated.superframe - stated.pulse_age) & _PULSE_MASK, rx_ticks, power_dbm)
        self._news_ticks = rx_ticks
        self._change_phase()
        return ClaimVerdict.ADOPTED_OTHER_PHASE

    def _join(self, anchor: int, stated: SlotTime, pulse: int, rx_ticks: int, power_dbm: float) -> None:
        self._misfits = 0
        self._neighbours[anchor] = _Neighbour(rx_ticks, float(stated.hop), power_dbm)
        self.pulse, self.hop, self.source = pulse, min(stated.hop + 1, MOST_HOP), anchor

    def _on_news(self, anchor: int, stated: SlotTime, pulse: int, rx_ticks: int) -> None:
        """A greater pulse: the hops of this one count, also if they are more, so that no circle can form."""
        superframes = round((rx_ticks - self._news_ticks) / self._superframe_ticks)
        if superframes > 0:
            self.watch.update(superframes)
            self._news_ticks = rx_ticks
        self.pulse, self.hop, self.source = pulse, min(stated.hop + 1, MOST_HOP), anchor
        self._depth += (self.hop - self._depth) * DEPTH_GAIN

    def _was_given_up(self, offered: SlotClaim, pulse: int) -> bool:
        if self._expired is None or self._expired[0] != offered:
            return False
        return (self._expired[1] - pulse) & _PULSE_MASK < _PULSE_HALF

    def _may_change(self, now_ticks: int) -> bool:
        """Whether the phase may change now."""
        elapsed = (now_ticks - self._changed_ticks) / self._superframe_ticks
        self._changes = min(self._changes + elapsed * CHANGES_PER_SUPERFRAME, MOST_CHANGES)
        self._changed_ticks = now_ticks
        return self._changes >= 1.0

    def _change_phase(self) -> None:
        """Be silent after the last frame in the old phase; where there was none, the change costs nothing."""
        if self._sent_ticks is not None:
            self._changes -= 1.0
            self._begin_silence(self._sent_ticks)

    def _begin_silence(self, sent_ticks: int) -> None:
        self._silent_until_ticks = sent_ticks + round(SILENCE_SUPERFRAMES * self._superframe_ticks)


def _rank(name: int, one: _Neighbour, is_parent: bool) -> tuple[int, float, int]:
    """Order of candidates: nearer to the root in steps, then stronger; present parents with a bonus."""
    depth = one.depth - PARENT_BONUS_HOPS * is_parent
    return math.ceil(depth / DEPTH_STEP), -(one.power_dbm + PARENT_BONUS_DB * is_parent), name


def rank_of(anchor_id: int, anchors: Iterable[int]) -> int:
    """How many of the site's anchors have a lower identifier."""
    return sum(other < anchor_id for other in anchors)
