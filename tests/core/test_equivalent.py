"""What a filter has learned: fused by another, it gives the same; and what a vehicle is given of it."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from skyless.bridges.vehicle import OUTAGE_S, NewInformation
from skyless.core.equivalent import CORRELATION, equivalent_measurement, predicted
from support.bridged_values import FIX, a_fix


def moved(x, P, dt, q):
    F, Q = np.eye(6) + dt * np.eye(6, k=3), np.kron([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]], q * np.eye(3))
    return F @ x, F @ P @ F.T + Q


def fused(x, P, z, R):
    K = P[:, :3] @ np.linalg.inv(P[:3, :3] + R)
    return x + K @ (z - x[:3]), P - K @ P[:3]


@given(seed=st.integers(0, 2**32), q=st.floats(0.1, 30.0), noise=st.floats(0.02, 0.2))
def test_a_filter_that_fuses_what_is_new_has_the_same_posterior(seed, q, noise):
    draw, one, two = np.random.default_rng(seed), (np.zeros(6), np.eye(6)), (np.zeros(6), np.eye(6))
    for _ in range(20):
        (x0, P0), two = moved(*one, 0.1, q), moved(*two, 0.1, q)
        root = noise * (np.eye(3) + 0.1 * draw.normal(size=(3, 3)))
        one = fused(x0, P0, draw.normal(size=3), root @ root.T)
        two = fused(*two, *equivalent_measurement(x0[:3], P0[:3, :3], one[0][:3], one[1][:3, :3]))
    np.testing.assert_allclose(two[0], one[0], atol=1e-6)
    np.testing.assert_allclose(two[1], one[1], atol=1e-6)


def test_the_prediction_is_that_of_a_steady_filter():
    x, P = np.zeros(6), np.eye(6)
    for _ in range(3000):
        x, P = fused(*moved(x, P, 0.01, 0.5), np.zeros(3), 0.04 * np.eye(3))
    assert abs(P[0, 3] / np.sqrt(P[0, 0] * P[3, 3]) - CORRELATION) < 0.02
    _, found = predicted(np.zeros((2, 3)), np.array([P[:3, :3], P[3:, 3:]]), 0.03)
    np.testing.assert_allclose(found, moved(x, P, 0.03, 0.5)[1][:3, :3], rtol=0.005, atol=1e-12)


def test_where_nothing_is_new_the_posterior_counts_for_next_to_nothing():
    z, R = equivalent_measurement(np.zeros(2), np.eye(2), np.array([1.0, 3.0]), np.diag([0.5, 2.0]))
    np.testing.assert_allclose([*z, *R.ravel()], [2.0, 3.0, 1.0, 0.0, 0.0, 20.0], atol=1e-12)


def test_a_vehicle_is_given_what_is_new_and_eased_back_after_an_outage():
    times_s, was = (0.0, 0.1, 0.2 + OUTAGE_S), np.diag(np.reshape(FIX.covariance_m2, (3, 3)))
    for height_known, wider in ((False, [True] * 3), (True, [True, True, False])):
        handed = NewInformation()
        fixes = [a_fix(serial=k, unix_s=FIX.unix_s + t, height_known=height_known) for k, t in enumerate(times_s)]
        first, second, back = (np.diag(np.reshape(handed.of(fix).covariance_m2, (3, 3))) for fix in fixes)
        np.testing.assert_array_equal(first, was)
        assert (second > 2.0 * was).tolist() == wider, "with the lasting errors, which the fix's own covariance has"
        assert (back > 0.5).all()
