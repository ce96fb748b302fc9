"""What is left without noise: the formulas against the algorithm on ideal clocks, with moving tags."""

import numpy as np
import pytest
from systematic import (
    bracketed_motion_error_m,
    literal_motion_error_m,
    motion_seen,
    scale_error_m,
    smoothed_rate_motion_error_m,
    synchronisation_error_m,
)

from skyless.core.protocol1.snapshots import bracketed_tdoa, literal_tdoa
from skyless.core.ticks import TICK_M, TICK_RATE_HZ, TICK_S
from skyless.research.paper.plan import Quantity, ideal_values
from support.random_chain import random_chain

MASTER, ANCHORS = np.array([0.0, 0.0, 0.5]), np.array([(6, 0, 2.5), (6, 8, 0.5), (0, 8, 2.5)], float)
SPACING_S = 15e-3
DELAYS_S = np.array([2.5e-3, 7.5e-3, 12.5e-3])
PLACE, VELOCITY = np.array([2.0, 3.0, 1.0]), np.array([4.0, -3.0, 0.5])
"""5 m/s."""
STEADY = np.zeros(3)


def ranges(t, accelerating):
    p = PLACE + VELOCITY * t + accelerating * t * t / 2.0
    return np.linalg.norm(p - ANCHORS, axis=1), np.linalg.norm(p - MASTER)


def moved_tdoas(accelerating=STEADY):
    """First, delayed and bracketed TDoAs of ideal clocks (ν = 1) in metres, minus the true ones; shape (3, n).

    Motion within the flight time, 5 m/s × 30 ns, is left out of the truth and out of the stamps. Stamps are floats.
    """
    errors = []
    for i, delay in enumerate(DELAYS_S):
        t = np.array([delay, delay + SPACING_S])
        tof = np.linalg.norm(ANCHORS[i] - MASTER) / TICK_M
        a = t * TICK_RATE_HZ
        r = [t[k] * TICK_RATE_HZ + ranges(t[k], accelerating)[0][i] / TICK_M for k in (0, 1)]
        m = [0.0, SPACING_S * TICK_RATE_HZ]
        rm = [m[k] + ranges(k * SPACING_S, accelerating)[1] / TICK_M for k in (0, 1)]
        s = [m[k] + tof for k in (0, 1)]
        first, delayed = literal_tdoa(*m, *s, *a, *r, *rm, tof)
        bracketed = bracketed_tdoa(*m, *s, *a, *r, rm[1], tof)
        truth = [own[i] - master for own, master in (ranges(k * SPACING_S, accelerating) for k in (0, 1))]
        errors.append(np.array([first, delayed, bracketed]) * TICK_M - [truth[0], truth[1], truth[1]])
    return np.array(errors).T


@pytest.mark.parametrize("acceleration", [(0.0, 0.0, 0.0), (3.0, 2.0, 0.0)])
def test_motion_leaves_its_curvature_in_the_papers_tdoas(acceleration):
    """Millimetres; the formulas hold to the next order, 5 m/s × 15 ms of a few metres."""
    accelerating = np.array(acceleration)
    first, delayed, bracketed = moved_tdoas(accelerating)
    seen = motion_seen(ANCHORS, PLACE, VELOCITY, accelerating)
    # The curvature is taken in the middle of the stretch over which the ranges are compared.
    middle = [
        motion_seen(ANCHORS, PLACE + VELOCITY * t + accelerating * t * t / 2, VELOCITY + accelerating * t, accelerating)
        for t in (SPACING_S, 1.5 * SPACING_S)
    ]
    expected = literal_motion_error_m(middle[0], DELAYS_S, SPACING_S)
    np.testing.assert_allclose(first, expected, rtol=0.03)
    np.testing.assert_allclose(delayed, bracketed_motion_error_m(middle[1], DELAYS_S, SPACING_S), rtol=0.06)
    np.testing.assert_allclose(bracketed, delayed, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(literal_motion_error_m(seen, DELAYS_S, SPACING_S), expected, rtol=0.1)
    assert np.abs(first).max() < 3e-3
    assert np.abs(bracketed).max() < np.abs(first).max() / 2.0


def test_a_smoothed_rate_keeps_the_velocity():
    """With the tag's true rate in place of the pair's, the range at t_i is taken for the one at t_m."""
    seen = motion_seen(ANCHORS, PLACE, VELOCITY)
    error = [ranges(delay, 0.0)[0][i] - ranges(0.0, 0.0)[0][i] for i, delay in enumerate(DELAYS_S)]
    np.testing.assert_allclose(smoothed_rate_motion_error_m(seen, DELAYS_S), error, rtol=0.02, atol=2e-4)
    assert np.abs(error).max() > 30.0 * np.abs(moved_tdoas()[0]).max()


def test_what_the_ideal_chain_leaves_is_e_and_the_tags_scale():
    """``eq:GPSTDoA`` without noise, through the program's functions, to a ten-thousandth of a tick."""
    chain = random_chain(10, seed=6)
    left_m = ideal_values(chain)[Quantity.LAMBDA] * TICK_M
    left_m -= (chain.tag_tof_s - chain.tag_master_tof_s) / TICK_S * TICK_M  # the true difference
    np.testing.assert_allclose(left_m, synchronisation_error_m(chain) + scale_error_m(chain), atol=1e-4 * TICK_M)


def test_the_sizes_that_the_documents_tell():
    """e: 0.2 mm at 10 m and 20 ppm; E11: 18 µm at 3 ppm and 6 m, 200 µm at 20 ppm and 10 m."""
    light = TICK_M / TICK_S

    def one(**changes):
        chain = random_chain(1)
        return type(chain)(**({name: getattr(chain, name) for name in type(chain).__slots__} | changes))

    far = one(anchor_rate=np.array([1 + 20e-6]), anchor_tof_s=np.array([10.0 / light]))
    assert abs(synchronisation_error_m(far)[0]) == pytest.approx(0.2e-3, rel=0.01)
    for ppm, metres, micrometres in ((3, 6.0, 18.0), (20, 10.0, 200.0)):
        moved = one(tag_rate=1 + ppm * 1e-6, tag_tof_s=np.array([metres / light]), tag_master_tof_s=0.0)
        assert scale_error_m(moved)[0] == pytest.approx(micrometres * 1e-6, rel=1e-3)
