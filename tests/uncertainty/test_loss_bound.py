"""Bounds with losses: against those without, and that the loss study's limits lie below them."""

import numpy as np
import pytest

from skyless.research.studies import lab
from skyless.research.studies.runner import Plan
from skyless.research.uncertainty import BoundSettings, Sendings, known_receptions, received_bound, tracking_bound
from skyless.sim.lab import lab_site

LAB_M = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in lab_site().anchors])
PATH_M = np.tile([2.0, 3.0, 0.0], (600, 1))


def settings(mesh):
    return BoundSettings(
        1e-10, white_fm=2e-11, random_walk_fm=1e-9, qa=0.3, slot_s=2.5e-3, speed_std_mps=0.4, mesh=mesh
    )


def known(frames, tags, anchors, mesh, seed=1):
    draw = np.random.default_rng(seed)
    return known_receptions(draw, frames, 6, lost_at_tags=tags, lost_at_anchors=anchors, mesh=mesh)


@pytest.mark.parametrize("mesh", [False, True])
@pytest.mark.site
def test_where_nothing_is_lost_it_is_the_bound_of_all(mesh):
    bound = received_bound(LAB_M, PATH_M, settings(mesh), known(600, 0.0, 0.0, mesh))
    np.testing.assert_allclose(bound[5::6], tracking_bound(LAB_M, PATH_M, settings(mesh)), rtol=1e-9)


def test_what_is_known():
    frames = 60_000
    rows = known(frames, 0.5, 0.4, True)
    senders = np.arange(frames) % 6
    told = 0.5 / (1.0 - 0.5 * 0.4)
    assert not rows[np.arange(frames), senders].any()
    assert rows[:, -1].mean() == pytest.approx(0.5, abs=0.01)
    assert rows[senders == 0, 1:6].mean() == pytest.approx(0.6, abs=0.01)
    assert rows[senders == 2, 4].mean() == pytest.approx(0.6 * 0.5 * told, abs=0.02)
    assert not rows[(senders == 2) & ~rows[:, -1], :6].any()
    assert not known(frames, 0.5, 0.4, False)[senders == 2, :6].any()


def test_its_shapes_are_checked():
    with pytest.raises(ValueError, match=r"\(12, 7\)"):
        received_bound(LAB_M, PATH_M[:12], settings(True), known(6, 0.0, 0.0, True))


@pytest.mark.statistical
def test_the_limits_of_the_study_lie_below_the_bound():
    """With mesh 1.40 and 3.26 at tags, 1.46 and 3.9 everywhere; limits are 1.3 and 2.5."""
    plan = Plan(seed=1, worlds=4)
    bounds = {
        (case.series, case.x): lab.bound_m(case.runs, plan) for case in lab.loss_cases(plan) if case.x in (0, 0.5, 0.9)
    }
    clean = bounds[lab.AT_TAGS, 0.0]
    for share, limit in lab.MAX_RATIOS.items():
        at_tags, everywhere = (bounds[kind, share] / clean for kind in (lab.AT_TAGS, lab.EVERYWHERE))
        assert limit < at_tags < everywhere
        assert everywhere < 1.9 * limit


@pytest.mark.site
def test_sendings_in_turn_are_the_superframe():
    plain = received_bound(LAB_M, PATH_M, settings(True), known(600, 0.2, 0.1, True))
    in_turn = Sendings(np.arange(600) % 6, np.arange(600) * 2.5e-3)
    again = received_bound(LAB_M, PATH_M, settings(True), known(600, 0.2, 0.1, True), in_turn)
    np.testing.assert_allclose(again, plain, rtol=1e-9)


@pytest.mark.statistical
def test_sendings_in_any_order_are_those_of_another_numbering():
    """The first anchor, against which clocks are counted, is nothing special."""
    order = np.array([3, 1, 4, 0, 5, 2])
    rows = known(600, 0.0, 0.0, True)
    times_s = np.arange(600) * 2.5e-3
    expected = received_bound(LAB_M, PATH_M, settings(True), rows, Sendings(np.tile(np.arange(6), 100), times_s))
    renamed = np.argsort(order)
    found = received_bound(
        LAB_M[order],
        PATH_M,
        settings(True),
        rows[:, [*order, 6]],
        Sendings(np.tile(renamed, 100), times_s),
    )
    np.testing.assert_allclose(found[-1], expected[-1], rtol=1e-3)


def test_there_is_one_sending_for_each_position():
    with pytest.raises(ValueError, match="600"):
        received_bound(
            LAB_M, PATH_M, settings(True), known(600, 0.0, 0.0, True), Sendings(np.zeros(5, int), np.zeros(5))
        )
