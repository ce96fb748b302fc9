"""Errors of pairs of anchors, and anchors that move or change: against the plain world of the same seed."""

import math

import numpy as np
import pytest
from metronome import IDEAL, Metronome, faulty, sent, staggered

from skyless.core.ticks import TICK_M, difference
from skyless.sim.impairments import AnchorDisplacement, DelayError, PairError
from skyless.sim.lab import lab_site
from skyless.sim.world import World

LAB = lab_site()


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


def test_a_late_pair_is_late_in_both_directions():
    for pair, rows in _late_m(faulty(anchor_pair_errors=(PairError(2, 5, late_m=1.5),)), 0.3).items():
        want_m = 1.5 if set(pair) == {2, 5} else 0.0
        assert np.abs(rows[:, 1] - want_m).max() <= TICK_M


def test_a_blocked_pair_does_not_receive_one_another_and_all_others_do():
    plain = _receptions(IDEAL, 0.3)
    blocked = _receptions(faulty(anchor_pair_errors=(PairError(1, 4, blocked=True),)), 0.3)
    assert blocked == {pair: rows for pair, rows in plain.items() if set(pair) != {1, 4}}


def test_errors_of_one_pair_add_up():
    for pair, rows in _late_m(faulty(anchor_pair_errors=(PairError(1, 2, 0.5), PairError(2, 1, 0.25))), 0.3).items():
        want_m = 0.75 if set(pair) == {1, 2} else 0.0
        assert np.abs(rows[:, 1] - want_m).max() <= TICK_M


def test_an_anchor_moves_and_its_delays_change_at_their_times():
    shift = AnchorDisplacement(3, 0.6, -0.8, 0.0, from_s=0.2)
    delay = DelayError(6, tx_ticks=100.0, rx_ticks=-40.0, from_s=0.3)
    position_m = {anchor.id: np.array([anchor.x_m, anchor.y_m, anchor.z_m]) for anchor in LAB.anchors}
    moved_m = position_m | {3: position_m[3] + (0.6, -0.8, 0.0)}
    for (receiver, sender), rows in _late_m(faulty(anchor_displacements=(shift,), delay_errors=(delay,)), 0.5).items():
        path_m = [math.dist(where[receiver], where[sender]) for where in (position_m, moved_m)]
        for t_s, late_m in rows:
            want_m = path_m[1] - path_m[0] if t_s > 0.2005 else 0.0
            if t_s > 0.3005:
                want_m += {receiver: -40.0}.get(6, 0.0) * TICK_M + {sender: 100.0}.get(6, 0.0) * TICK_M
            if not (0.2 < t_s < 0.2005 or 0.3 < t_s < 0.3005):
                assert late_m == pytest.approx(want_m, abs=1.01 * TICK_M + 40e-6 * want_m)


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match="anchor_pair_errors names anchor 9; it should be one of the site's"):
        World(LAB, Metronome, [], faulty(anchor_pair_errors=(PairError(1, 9),)), 1)
