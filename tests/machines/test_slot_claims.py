"""Claims on the slot time: what must hold on random graphs (``docs/protocol2.md``), and what forged frames do."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.air.beacon2 import MOST_PULSE_AGE, SlotTime
from skyless.slot_claims import (
    HOP_PATIENCE,
    LEAST_PATIENCE,
    LISTENING_SUPERFRAMES,
    MOST_CHANGES,
    MOST_PARENTS,
    MOST_PATIENCE,
    MOST_TERM,
    SILENCE_SUPERFRAMES,
    TURNS,
    ClaimVerdict,
    Lead,
    NewsWatch,
    SlotClaim,
    SlotClaims,
    SlotRole,
    first_wait_superframes,
)
from skyless.evaluation.claim_graphs import SUPERFRAME_TICKS, ClaimGraph, components

S = SUPERFRAME_TICKS
TERMS = st.one_of(st.integers(0, 3), st.integers(0, MOST_TERM), st.just(MOST_TERM))
CLAIMS = st.builds(SlotClaim, TERMS, st.integers(0, 0xFFFF))


# The order


@given(CLAIMS, CLAIMS, CLAIMS)
def test_the_order_is_total_and_transitive(one, other, third):
    assert (one < other) + (other < one) + (one == other) == 1
    if one < other and other < third:
        assert one < third


def test_the_higher_term_wins_and_in_one_term_the_lower_root():
    assert SlotClaim(1, 9) < SlotClaim(2, 9)
    assert SlotClaim(1, 9) < SlotClaim(1, 8)


# Graphs


class CheckedGraph(ClaimGraph):
    """Checks after every turn what must hold at every moment."""

    def __init__(self, *arguments):
        self.kept = {}
        """Of each node and boot: claim and pulse last seen."""
        self.root_boots = {}
        self.epoch_of = {}
        self.source_boots = {}
        super().__init__(*arguments)

    def _act(self, node, machine, ticks, received):
        before, last = self.sent[node], machine.claim
        super()._act(node, machine, ticks, received)
        if machine.role is SlotRole.ROOT and machine.claim != last:
            self.root_boots[machine.claim] = self.boots[node]
        sent = self.sent[node]
        if sent is before:
            return
        if before is not None and sent.epoch_ticks != before.epoch_ticks:
            assert sent.ticks - before.ticks >= SILENCE_SUPERFRAMES * S, "no silence before another phase"
        claim = machine.claim
        if self.root_boots.get(claim) == self.boots[claim.root] == 1:  # else it may lead the same claim once more
            assert self.epoch_of.setdefault(claim, sent.epoch_ticks) == sent.epoch_ticks, "two phases in one claim"

    def _receive(self, other, listener, node, stated, ticks, epoch):
        before = (listener.claim, listener.pulse, listener.hop)
        super()._receive(other, listener, node, stated, ticks, epoch)
        if before != (listener.claim, listener.pulse, listener.hop):
            self.source_boots[other] = self.boots[node]

    def _run_superframe(self):
        super()._run_superframe()
        for node, machine in enumerate(self.machines):
            if machine is None or machine.claim is None:
                continue
            key, now = (node, self.boots[node]), (machine.claim, machine.pulse)
            claim, pulse = self.kept.get(key, now)
            assert claim.term <= machine.claim.term or claim.term == MOST_TERM
            assert not machine.claim < claim or claim.term == MOST_TERM
            if claim == machine.claim and machine.role is SlotRole.FOLLOWER:
                assert (machine.pulse - pulse) % 2**32 < 2**31, "the pulse fell"
            self.kept[key] = now
            self._check_way(node)

    def _check_way(self, node):
        """Along the sources pulses do not fall, and with one pulse hops do: so there is no circle."""
        passed = {node}
        while True:
            machine = self.machines[node]
            source = machine.source
            if source is None or self.source_boots.get(node) != self.boots[source]:
                return
            nearer = self.machines[source]
            if nearer is None or nearer.claim != machine.claim:
                return
            if nearer.role is not SlotRole.ROOT:
                ahead = (nearer.pulse - machine.pulse) % 2**32
                assert ahead < 2**31
                assert ahead > 0 or nearer.hop < machine.hop
            assert source not in passed
            passed.add(source)
            node = source


@st.composite
def graphs(draw):
    """Up to nine nodes on a line, with further links at random, slots, and a reception of at least a fifth."""
    count = draw(st.integers(2, 9))
    links = [set() for _ in range(count)]
    for one, other in pairwise(range(count)):
        links[one].add(other)
        links[other].add(one)
    for one, other in draw(st.lists(st.tuples(st.integers(0, count - 1), st.integers(0, count - 1)), max_size=8)):
        if one != other:
            links[one].add(other)
            links[other].add(one)
    slots = [slot * (S // 16) for slot in draw(st.lists(st.integers(0, 15), min_size=count, max_size=count))]
    return CheckedGraph(
        [sorted(others) for others in links], slots, draw(st.floats(0.2, 1.0)), draw(st.integers(0, 99))
    )


EVENTS = st.tuples(st.sampled_from(("off", "on", "restart", "cut", "join", "lead")), st.integers(0, 8), TERMS)


@settings(max_examples=30, deadline=None)
@given(graphs(), st.lists(st.tuples(EVENTS, st.integers(0, 40)), max_size=6))
def test_one_claim_is_left_whatever_happens(graph, events):
    """Deaths, restarts, cuts and islands of any terms in any order; then peace: one claim, and no change."""
    count = len(graph.machines)
    links = None
    for node in range(count):
        graph.switch_on(node)
    graph.run(10)
    for (event, number, term), superframes in events:
        node = number % count
        if event in {"off", "restart"}:
            graph.switch_off(node)
        if event in {"on", "restart"} and graph.machines[node] is None:
            graph.switch_on(node)
        if event == "lead" and graph.machines[node] is None:
            graph.switch_on(node, SlotClaim(term, node))
        if event == "cut" and links is None:
            links = graph.cut([other < number for other in range(count)])
        if event == "join" and links is not None:
            graph.join(links)
            links = None
        graph.run(superframes)
    bound = MOST_PATIENCE + (HOP_PATIENCE + 20) * count + TURNS + 100
    assert graph.run_until_one(2 * bound, components(graph)) is not None
    graph.run(300)  # in which waits are learned where reception is poor
    assert graph.run_until_one(2 * bound, components(graph)) is not None
    before = graph.changes
    graph.run(300)
    assert graph.changes == before


@settings(max_examples=30, deadline=None)
@given(graphs(), st.integers(0, 60))
def test_no_claim_outlives_its_root_for_long(graph, lived):
    count = len(graph.machines)
    for node in range(count):
        graph.switch_on(node)
    graph.run(10 + lived)
    for claim in graph.claims() - {None}:
        graph.switch_off(claim.root)
        on_the_way = 20 * count  # the last pulse takes up to this where one frame of five is received
        graph.run(MOST_PATIENCE + HOP_PATIENCE * count + TURNS + on_the_way)
        assert all(one is None or one.claim != claim for one in graph.machines)


def test_a_root_that_restarts_loses_and_nothing_else_changes():
    graph = line(5, reception=1.0)
    graph.run(60)
    (claim,) = graph.claims()
    graph.switch_off(claim.root)
    assert graph.run_until_one(60) is not None
    graph.run(50)
    (later,) = graph.claims()
    assert later.term == claim.term + 1
    before = graph.changes
    graph.switch_on(claim.root)
    graph.run(200)
    assert graph.claims() == {later}
    assert graph.changes == before + 1


def test_halves_that_were_cut_and_joined_are_one_again():
    graph = line(12, reception=0.9)
    graph.run(100)
    links = graph.cut([node < 6 for node in range(12)])
    assert graph.run_until_one(100, [range(6), range(6, 12)]) is not None
    graph.run(50)
    graph.join(links)
    assert graph.run_until_one(20) is not None
    before = graph.changes
    graph.run(2_000)
    assert graph.changes == before


@pytest.mark.parametrize("terms", [(0, 100, 200), (200, 0, 100), (MOST_TERM, 7, MOST_TERM - 1), (3, 3, 3)])
def test_three_islands_of_any_terms_settle(terms):
    graph = line(9, reception=0.8, on=False)
    for node in range(9):
        graph.switch_on(node, SlotClaim(terms[node // 3], node) if node % 3 == 1 else None)
    links = graph.cut([node // 3 == 0 for node in range(9)])
    graph.run(40)
    graph.join(links)
    assert graph.run_until_one(60) is not None
    expected = max(SlotClaim(term, 3 * island + 1) for island, term in enumerate(terms))
    assert graph.claims() == {expected}
    before = graph.changes
    graph.run(2_000)
    assert graph.changes == before


def line(count, reception, *, on=True, seed=3):
    links = [
        [other for other in (node - 2, node - 1, node + 1, node + 2) if 0 <= other < count] for node in range(count)
    ]
    graph = CheckedGraph(links, [(7 * node % count) * (S // count) for node in range(count)], reception, seed)
    for node in range(count if on else 0):
        graph.switch_on(node)
    return graph


# One machine


def stated(superframe, *, root=1, term=0, hop=0, age=0):
    return SlotTime(superframe, 0, root, term, hop, age, 0.0)


def follower(own=9, superframes=40, term=0):
    """An anchor that follows anchor 1, whose frames it receives each superframe; and the last of them."""
    machine = SlotClaims(own, S)
    for number in range(superframes):
        machine.advance(number * S)
        machine.on_beacon(1, stated(number, term=term), number * S + 5, off_phase=False)
        if machine.may_send(number * S + S // 2):
            machine.on_sent(number * S + S // 2)
        machine.choose_parents(number * S + 9)
    return machine, superframes


def test_it_listens_then_leads_or_joins():
    alone = SlotClaims(7, S, wait_superframes=2)
    assert [alone.advance(number * S) for number in range(6)] == [None] * 5 + [Lead.FIRST]
    assert (alone.role, alone.claim, alone.may_send(6 * S)) == (SlotRole.ROOT, SlotClaim(0, 7), True)
    joins = SlotClaims(7, S)
    joins.advance(0)
    assert joins.on_beacon(3, stated(500, root=2, term=4, hop=2, age=1), S, off_phase=False) is ClaimVerdict.ADOPTED
    assert (joins.claim, joins.hop, joins.pulse, joins.source) == (SlotClaim(4, 2), 3, 499, 3)
    assert not joins.may_send(2 * S)
    assert joins.may_send(LISTENING_SUPERFRAMES * S)
    assert joins.pulse_age(503) == 4


def test_low_identifiers_wait_least():
    waits = [first_wait_superframes(rank) for rank in range(10_000)]
    assert waits == sorted(waits)
    assert (waits[0], waits[-1]) == (0, 8 * 14)


def test_a_silent_root_is_replaced_in_the_next_term():
    machine, number = follower(own=9)
    patience = machine.patience_superframes
    assert patience >= LEAST_PATIENCE + HOP_PATIENCE + 9 % TURNS
    last = (number - 1) * S + 5
    assert [machine.advance(last + passed * S) for passed in range(1, patience + 1)] == [None] * patience
    assert machine.advance(last + (patience + 1) * S) is Lead.TAKEOVER
    assert (machine.role, machine.claim, machine.hop) == (SlotRole.ROOT, SlotClaim(1, 9), 0)
    assert machine.pulse_age(number) == 0
    assert machine.parents == ()


def test_at_the_last_term_the_order_begins_again_and_the_dead_claim_does_not_return():
    machine, number = follower(term=MOST_TERM)
    late = (number + MOST_PATIENCE) * S
    assert machine.advance(late) is Lead.TAKEOVER
    assert machine.claim == SlotClaim(0, 9)
    expired = stated(number - 1, term=MOST_TERM)
    assert machine.on_beacon(2, expired, late + 1, off_phase=False) is ClaimVerdict.EXPIRED
    alive = stated(number + MOST_PATIENCE, term=MOST_TERM)
    assert machine.on_beacon(2, alive, late + 2, off_phase=False) is ClaimVerdict.ADOPTED


@pytest.mark.parametrize("age", [MOST_PULSE_AGE, MOST_PATIENCE + 10])
def test_a_claim_whose_pulse_is_too_old_is_not_adopted(age):
    machine, number = follower()
    old = stated(number, term=5, age=age)
    assert machine.on_beacon(2, old, number * S, off_phase=True) is ClaimVerdict.EXPIRED
    assert machine.claim == SlotClaim(0, 1)


def test_forged_claims_cannot_silence_it():
    """A false master states a higher term and another phase with every frame, fifty times a superframe."""
    machine, number = follower()
    sent = changes = 0
    for superframe in range(number, number + 400):
        for part in range(50):
            forged = stated(superframe * 977 + part * 12_345 & 0xFFFFFFFF, root=3, term=superframe * 50 + part)
            verdict = machine.on_beacon(3, forged, superframe * S + part * S // 50, off_phase=True)
            changes += verdict is ClaimVerdict.ADOPTED_OTHER_PHASE
        tx_ticks = (superframe + 1) * S - 1
        if machine.may_send(tx_ticks):
            machine.on_sent(tx_ticks)
            sent += 1
    assert changes <= MOST_CHANGES + 400 / 16 + 1
    assert sent >= 400 - 2 * changes


def test_news_in_another_phase_does_not_count_until_there_is_no_other():
    machine, number = follower()
    for superframe in range(number, number + 50):
        forged = stated(superframe, age=0)
        assert machine.on_beacon(2, forged, superframe * S, off_phase=True) is ClaimVerdict.OFF_PHASE
        assert machine.on_beacon(1, stated(superframe), superframe * S + 5, off_phase=False) is ClaimVerdict.SAME
    verdicts = [
        machine.on_beacon(2, stated(superframe), superframe * S, off_phase=True)
        for superframe in range(number + 50, number + 53)
    ]
    assert verdicts == [ClaimVerdict.OFF_PHASE] * 2 + [ClaimVerdict.ADOPTED_OTHER_PHASE]


def test_parents_are_the_nearest_and_change_only_for_better_ones():
    machine = SlotClaims(9, S)
    chosen = []
    for number in range(60):
        machine.advance(number * S)
        for anchor, hop, power in ((1, 2, -80.0), (2, 2, -70.0), (3, 2, -75.0), (4, 2, -78.0), (5, 3, -60.0)):
            louder = power + (4.0 if anchor == 4 and number > 30 else 0.0)
            machine.on_beacon(anchor, stated(number, root=8, hop=hop), number * S + anchor, False, louder)
        chosen.append(machine.choose_parents(number * S + 9))
    assert set(chosen[10]) == {2, 3, 4}
    assert len(chosen[10]) == MOST_PARENTS
    assert set(chosen[-1]) == {2, 3, 4}
    assert machine.hop == 3


@given(st.lists(st.integers(1, 30), min_size=1, max_size=200))
def test_the_wait_is_within_its_limits_and_longer_than_usual_gaps(gaps):
    watch = NewsWatch()
    assert watch.patience == MOST_PATIENCE
    for gap in gaps:
        watch.update(gap)
    assert LEAST_PATIENCE <= watch.patience <= MOST_PATIENCE
    assert watch.patience >= sum(gaps) / len(gaps)
