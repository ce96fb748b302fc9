"""Bounds of the receptions that a tag knows: with all of them, and in any order."""

import numpy as np
import pytest
from textbook_bound import LAB, settings_of

from skyless.research.uncertainty import Sendings, received_bound, tracking_bound

PATH_M = np.tile([2.0, 3.0, 0.0], (600, 1))


def known(frames, lost, mesh=True, seed=1):
    """Receptions known to a tag, of anchors that send in turn: its own, the reference's, and with ``mesh`` all."""
    senders = np.arange(frames) % 6
    rows = np.random.default_rng(seed).random((frames, 7)) >= lost
    rows[:, :-1] &= (senders == 0)[:, None] | mesh
    rows[np.arange(frames), senders] = False
    return rows


@pytest.mark.parametrize("mesh", [False, True])
@pytest.mark.site
def test_where_nothing_is_lost_it_is_the_bound_of_all(mesh):
    bound = received_bound(LAB, PATH_M, settings_of(mesh=mesh), known(600, 0.0, mesh))
    np.testing.assert_allclose(bound[5::6], tracking_bound(LAB, PATH_M, settings_of(mesh=mesh)), rtol=1e-9)


def test_its_shapes_are_checked():
    with pytest.raises(ValueError, match=r"\(12, 7\)"):
        received_bound(LAB, PATH_M[:12], settings_of(), known(6, 0.0))


@pytest.mark.site
def test_sendings_in_turn_are_the_superframe():
    plain = received_bound(LAB, PATH_M, settings_of(), known(600, 0.2))
    in_turn = Sendings(np.arange(600) % 6, np.arange(600) * 2.5e-3)
    again = received_bound(LAB, PATH_M, settings_of(), known(600, 0.2), in_turn)
    np.testing.assert_allclose(again, plain, rtol=1e-9)


@pytest.mark.statistical
def test_sendings_in_any_order_are_those_of_another_numbering():
    """The first anchor, against which clocks are counted, is nothing special."""
    order = np.array([3, 1, 4, 0, 5, 2])
    rows = known(600, 0.0)
    times_s = np.arange(600) * 2.5e-3
    expected = received_bound(LAB, PATH_M, settings_of(), rows, Sendings(np.tile(np.arange(6), 100), times_s))
    renamed = np.argsort(order)
    found = received_bound(
        LAB[order], PATH_M, settings_of(), rows[:, [*order, 6]], Sendings(np.tile(renamed, 100), times_s)
    )
    np.testing.assert_allclose(found[-1], expected[-1], rtol=1e-3)


def test_there_is_one_sending_for_each_position():
    with pytest.raises(ValueError, match="600"):
        received_bound(LAB, PATH_M, settings_of(), known(600, 0.0), Sendings(np.zeros(5, int), np.zeros(5)))
