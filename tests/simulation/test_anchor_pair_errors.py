"""Errors of pairs of anchors, and anchors that move or change: against the plain world of the same seed."""

import math

import msgspec
import numpy as np
import pytest
from metronome import IDEAL, Metronome, sent, staggered

from skyless.core.constants import TICK_M
from skyless.core.ticks import difference
from skyless.sim._anchor_pairs import AnchorPairErrors
from skyless.sim.impairments import AnchorDisplacement, DelayError, PairError
from skyless.sim.lab import lab_site
from skyless.sim.world import World

LAB = lab_site()


def _with(**changes):
    return msgspec.structs.replace(IDEAL, **changes)


def _receptions(impairments, until_s, seed=3):
    """Times and RX stamps by (receiver, sender)."""
    machines, make = {}, staggered()

    def factory(anchor):
        return machines.setdefault(anchor, make(anchor))

    for _ in World(LAB, factory, [], impairments, seed).run(until_s):
        pass
    found = {}
    for receiver, machine in machines.items():
        for reception in machine.heard:
            found.setdefault((receiver, sent(reception.frame)[0]), []).append((reception.host_s, reception.rx_ticks))
    return found


def _late_m(changed, until_s):
    """How much later stamps are than in the ideal world, by (receiver, sender): rows of (time, metres)."""
    plain, other = _receptions(IDEAL, until_s), _receptions(changed, until_s)
    return {
        pair: np.array(
            [
                (t_s, difference(rx, plain_rx) * TICK_M)
                for (t_s, rx), (_, plain_rx) in zip(rows, plain[pair], strict=True)
            ]
        )
        for pair, rows in other.items()
    }


def test_a_late_pair_is_late_in_both_directions_for_its_time_alone():
    error = PairError(2, 5, late_m=1.5, from_s=0.2, to_s=0.4)
    for pair, rows in _late_m(_with(anchor_pair_errors=(error,)), 0.6).items():
        inside = (rows[:, 0] >= 0.201) & (rows[:, 0] < 0.4) if set(pair) == {2, 5} else np.zeros(len(rows), bool)
        outside = (rows[:, 0] < 0.2) | (rows[:, 0] > 0.401) if set(pair) == {2, 5} else ~inside
        assert np.abs(rows[inside, 1] - 1.5).max(initial=0.0) <= TICK_M
        assert np.abs(rows[outside, 1]).max() <= TICK_M


def test_a_blocked_pair_does_not_receive_one_another_and_all_others_do():
    plain = _receptions(IDEAL, 0.3)
    blocked = _receptions(_with(anchor_pair_errors=(PairError(1, 4, blocked=True, from_s=0.1),)), 0.3)
    for pair, rows in plain.items():
        if set(pair) == {1, 4}:
            assert [t_s for t_s, _ in blocked[pair]] == [t_s for t_s, _ in rows if t_s < 0.1]
        else:
            assert blocked[pair] == rows


def test_errors_of_one_pair_add_up():
    errors = AnchorPairErrors((PairError(1, 2, 0.5), PairError(2, 1, 0.25)), {1: 0, 2: 1, 3: 2}, 1)
    present_m = np.zeros((4, 3))
    for t_s in (0.0, 1.0):
        errors.set_present(t_s, present_m)
        assert present_m.tolist() == [[0, 0.75, 0], [0.75, 0, 0], [0, 0, 0], [0, 0, 0]]


def test_a_drift_has_its_size_and_its_correlation_time():
    """Over 400 pairs: variance, and correlation after one time constant; bounds of four standard errors."""
    anchors = range(1, 31)
    pairs = [(a, b) for a in anchors for b in anchors if a < b]
    model = [PairError(a, b, drift_std_m=0.1, drift_time_s=2.0) for a, b in pairs]
    node_of = {anchor: node for node, anchor in enumerate(anchors)}
    errors, present_m = AnchorPairErrors(model, node_of, 11), np.zeros((30, 30))
    values = []
    for t_s in (0.0, 2.0, 20.0, 20.05):
        errors.set_present(t_s, present_m)
        assert np.array_equal(present_m, present_m.T)
        values.append(np.array([present_m[node_of[a], node_of[b]] for a, b in pairs]))
    values = np.array(values)
    assert np.abs(values.std(axis=1) / 0.1 - 1.0).max() < 4.0 / math.sqrt(2 * len(pairs))
    assert abs(np.corrcoef(values[:2])[0, 1] - math.exp(-1.0)) < 4.0 / math.sqrt(len(pairs))
    assert np.corrcoef(values[2:])[0, 1] > 0.95
    again = AnchorPairErrors(model[:5], node_of, 11)
    again.set_present(0.0, present_m)
    assert present_m[0, 1] == values[0, 0], "a pair's drift does not depend on the other pairs"


def test_an_anchor_moves_and_its_delays_change_at_their_times():
    shift = AnchorDisplacement(3, 0.6, -0.8, 0.0, from_s=0.2)
    delay = DelayError(6, tx_ticks=100.0, rx_ticks=-40.0, from_s=0.3)
    position_m = {anchor.id: np.array([anchor.x_m, anchor.y_m, anchor.z_m]) for anchor in LAB.anchors}
    moved_m = position_m | {3: position_m[3] + (0.6, -0.8, 0.0)}
    for (receiver, sender), rows in _late_m(_with(anchor_displacements=(shift,), delay_errors=(delay,)), 0.5).items():
        path_m = [math.dist(where[receiver], where[sender]) for where in (position_m, moved_m)]
        for t_s, late_m in rows:
            want_m = path_m[1] - path_m[0] if t_s > 0.2005 else 0.0
            if t_s > 0.3005:
                want_m += {receiver: -40.0}.get(6, 0.0) * TICK_M + {sender: 100.0}.get(6, 0.0) * TICK_M
            if not (0.2 < t_s < 0.2005 or 0.3 < t_s < 0.3005):
                assert late_m == pytest.approx(want_m, abs=1.01 * TICK_M + 40e-6 * want_m)


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match="anchor_pair_errors names anchor 9; it should be one of the site's"):
        World(LAB, Metronome, [], _with(anchor_pair_errors=(PairError(1, 9),)), 1)
