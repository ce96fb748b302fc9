"""Anchors' claims on a graph: the real state machines (``skyless.slot_claims``), and nothing of radios but losses.

Time is counted in ticks, a superframe in ``SUPERFRAME_TICKS``. Every anchor sends once in each superframe of its own
slot time, in its slot; each frame reaches each neighbour that is on with one probability. Clocks are exact, so a slot
time is one number: the true time at which its superframe 0 began.
"""

from collections.abc import Sequence
from heapq import heapify, heappop, heappush
from typing import Final

import numpy as np
from msgspec import Struct
from scipy.spatial import cKDTree

from skyless.air.beacon2 import SlotTime
from skyless.kernels.arrays import Array, Integers, Mask
from skyless.slot_claims import (
    ClaimVerdict,
    Lead,
    SlotClaim,
    SlotClaims,
    first_wait_superframes,
)

SUPERFRAME_TICKS: Final = 1 << 16
GUARD_TICKS: Final = 2
"""Slot times that differ by more are other phases."""

_NUMBERS: Final = 0xFFFFFFFF


class Sent(Struct):
    """An anchor's last frame."""

    ticks: int
    epoch_ticks: int
    """The slot time that it was sent in."""


class ClaimGraph:
    """Anchors as nodes of a graph, numbered from 0; their identifiers are these numbers."""

    def __init__(self, links: Sequence[Sequence[int]], slots: Sequence[int], reception: float, seed: int) -> None:
        """``links``: the neighbours of each; ``slots``: of each, as ticks from the start of a superframe."""
        self.links = [np.array(sorted(others), dtype=np.int64) for others in links]
        self.slots = list(slots)
        self.reception = reception
        self.superframe = 0
        """True superframes that have passed."""
        self.machines: list[SlotClaims | None] = [None] * len(links)
        self.epochs: list[int | None] = [None] * len(links)
        self.sent: list[Sent | None] = [None] * len(links)
        self.boots = [0] * len(links)
        self.changes = 0
        """Changes of claim of anchors that had one."""
        self.last_change = 0
        """Superframe of the last one."""
        self.phase_changes = 0
        self._due: list[tuple[int, int]] = []
        self._end_ticks = 0
        self._draw = np.random.default_rng(seed)
        self._polls = self._draw.integers(0, SUPERFRAME_TICKS, len(links)).tolist()

    def switch_on(self, node: int, claim: SlotClaim | None = None) -> None:
        """Start a node; ``claim``: it leads that one already, in a slot time of its own."""
        wait = first_wait_superframes(node)
        machine = self.machines[node] = SlotClaims(node, SUPERFRAME_TICKS, wait)
        self.epochs[node] = self.sent[node] = None
        self.boots[node] += 1
        if claim is not None:
            machine.lead(claim)
            self.epochs[node] = int(self._draw.integers(-(1 << 40), 0))

    def switch_off(self, node: int) -> None:
        """Take a node's power."""
        self.machines[node] = self.epochs[node] = self.sent[node] = None

    def cut(self, side: Sequence[bool]) -> list[Integers]:
        """Remove all links between both sides; returns the links as they were, for ``join``."""
        before, of = self.links, np.asarray(side)
        self.links = [others[of[others] == of[node]] for node, others in enumerate(before)]
        return before

    def join(self, links: list[Integers]) -> None:
        """Give links back."""
        self.links = links

    def run(self, superframes: int) -> None:
        """Let true time pass."""
        for _ in range(superframes):
            self._run_superframe()

    def run_until_one(self, most: int, groups: Sequence[Sequence[int]] | None = None) -> int | None:
        """Superframes until each group (all nodes that are on) follows one claim; None if ``most`` do not suffice."""
        for passed in range(most + 1):
            if self.is_one(groups):
                return passed
            self._run_superframe()
        return None

    def is_one(self, groups: Sequence[Sequence[int]] | None = None) -> bool:
        """Whether each group's nodes that are on follow one claim in one phase, whose root is on and leads it."""
        for group in groups or (range(len(self.machines)),):
            on = [node for node in group if self.machines[node] is not None]
            found = {(self.machines[node].claim, self.epochs[node]) for node in on}  # type: ignore[union-attr]
            if len(found) > 1:
                return False
            claim = found.pop()[0] if found else None
            if on and (claim is None or claim.root not in on or self.machines[claim.root].hop):  # type: ignore[union-attr]
                return False
        return True

    def claims(self) -> set[SlotClaim | None]:
        """Claims that are followed at present."""
        return {machine.claim for machine in self.machines if machine is not None}

    def number(self, node: int, ticks: int) -> int:
        """A node's superframe number at a true time."""
        epoch = self.epochs[node]
        assert epoch is not None
        return (ticks - epoch) // SUPERFRAME_TICKS

    def _run_superframe(self) -> None:
        """Every node that is on acts once, in the order of the instants of their slots."""
        start = self.superframe * SUPERFRAME_TICKS
        end = start + SUPERFRAME_TICKS
        self._due = [(self._next_turn(node, start), node) for node in range(len(self.machines))]
        heapify(self._due)
        self._end_ticks = end
        most = max((len(others) for others in self.links), default=0)
        received = self._draw.random((len(self.machines), most)) < self.reception
        while self._due:
            ticks, node = heappop(self._due)
            machine = self.machines[node]
            if machine is not None and self._next_turn(node, ticks) == ticks:  # else it has another slot by now
                self._act(node, machine, ticks, received[node])
        self.superframe += 1

    def _next_turn(self, node: int, ticks: int) -> int:
        """First start of a node's slot at or after a time; of one without a slot time, when it is polled."""
        epoch = self.epochs[node]
        turn = self._polls[node] if epoch is None else epoch + self.slots[node]
        return ticks + (turn - ticks) % SUPERFRAME_TICKS

    def _act(self, node: int, machine: SlotClaims, ticks: int, received: Mask) -> None:
        lead = machine.advance(ticks)
        if lead is Lead.FIRST:
            self.epochs[node] = ticks - self.slots[node]
        elif lead is Lead.TAKEOVER:
            self._count_change()
        epoch = self.epochs[node]
        if epoch is None or not machine.may_send(ticks):
            return
        machine.choose_parents(ticks)
        following = machine.claim
        assert following is not None
        number = (ticks - epoch) // SUPERFRAME_TICKS & _NUMBERS
        stated = SlotTime(number, 0, following.root, following.term, machine.hop, machine.pulse_age(number), 0.0)
        machine.on_sent(ticks)
        self.sent[node] = Sent(ticks, epoch)
        others = self.links[node]
        for other in others[received[: len(others)]].tolist():
            listener = self.machines[other]
            if listener is not None:
                self._receive(other, listener, node, stated, ticks, epoch)

    def _receive(self, other: int, listener: SlotClaims, node: int, stated: SlotTime, ticks: int, epoch: int) -> None:
        own = self.epochs[other]
        off_phase = own is not None and abs(own - epoch) > GUARD_TICKS
        verdict = listener.on_beacon(node, stated, ticks, off_phase)
        if verdict is ClaimVerdict.ADOPTED or verdict is ClaimVerdict.ADOPTED_OTHER_PHASE:
            self._count_change()
            self.phase_changes += verdict is ClaimVerdict.ADOPTED_OTHER_PHASE
            if own != epoch:
                self.epochs[other] = epoch
                turn = self._next_turn(other, ticks + 1)
                if turn < self._end_ticks:
                    heappush(self._due, (turn, other))

    def _count_change(self) -> None:
        self.changes += 1
        self.last_change = self.superframe


def grid_m(length_m: float, width_m: float, step_m: float) -> Array:
    """Positions of anchors on a square grid, column by column from x = 0, shape (n, 2)."""
    x, y = np.arange(0.0, length_m + 0.1, step_m), np.arange(0.0, width_m + 0.1, step_m)
    return np.array([(across, along) for across in x for along in y])


def links_within(positions_m: Array, reach_m: float) -> list[list[int]]:
    """Neighbours of each position within a distance."""
    near = cKDTree(positions_m).query_ball_point(positions_m, reach_m)
    return [[other for other in found if other != node] for node, found in enumerate(near)]


def components(graph: ClaimGraph) -> list[list[int]]:
    """Nodes that are on, by connected component."""
    left = {node for node, machine in enumerate(graph.machines) if machine is not None}
    found = []
    while left:
        edge, group = [min(left)], []
        left.discard(edge[0])
        while edge:
            node = edge.pop()
            group.append(node)
            near = [other for other in graph.links[node].tolist() if other in left]
            left.difference_update(near)
            edge += near
        found.append(sorted(group))
    return found


def hops_between(graph: ClaimGraph, root: int) -> list[int | None]:
    """Least number of links from a node to each that is on."""
    hops: list[int | None] = [None] * len(graph.links)
    hops[root], edge = 0, [root]
    while edge:
        following = []
        for node in edge:
            for other in graph.links[node].tolist():
                if hops[other] is None and graph.machines[other] is not None:
                    hops[other] = (hops[node] or 0) + 1
                    following.append(other)
        edge = following
    return hops
