"""The two-state clock filter against the Riccati equation and against a simulated pair of oscillators."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from skyless.core.clock_filter import ClockFilter, ClockNoise, clock_noise
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_RATE_HZ

NOISE = clock_noise(2e-11, 1e-9)
VARIANCE_M2 = 2 * (0.03**2)
PERIOD_TICKS = round(15e-3 * TICK_RATE_HZ)


def transition(dt):
    F = np.array([[1.0, dt], [0.0, 1.0]])
    Q = np.array([[NOISE.white * dt + NOISE.walk * dt**3 / 3, NOISE.walk * dt**2 / 2], [0.0, NOISE.walk * dt]])
    Q[1, 0] = Q[0, 1]
    return F, Q


def test_steady_covariance_solves_the_riccati_equation():
    clock = ClockFilter(NOISE, VARIANCE_M2)
    for k in range(5000):
        clock.update(k * PERIOD_TICKS, 10**12 + k * PERIOD_TICKS, 0.0)
    F, Q = transition(PERIOD_TICKS / TICK_RATE_HZ)
    H = np.array([[1.0, 0.0]])
    predicted = solve_discrete_are(F.T, H.T, Q, np.array([[VARIANCE_M2]]))
    updated = predicted - predicted @ H.T @ H @ predicted / (predicted[0, 0] + VARIANCE_M2)
    filtered = np.array(clock.covariance)
    np.testing.assert_allclose(filtered, [updated[0, 0], updated[0, 1], updated[1, 1]], rtol=1e-6)


def run_pair(seed, beacons, gate=6.0):
    """Return the normalised innovations and the normalised errors of own time on the master's scale."""
    generator = np.random.default_rng(seed)
    clock = ClockFilter(NOISE, VARIANCE_M2, gate)
    dt = PERIOD_TICKS / TICK_RATE_HZ
    F, Q = transition(dt)
    root = np.linalg.cholesky(Q)
    truth = np.array([0.0, 5e-6 * SPEED_OF_LIGHT_MPS])
    innovations, errors = [], []
    base, range_m = 2**39, 12.0
    for k in range(beacons):
        tx = k * PERIOD_TICKS
        noise = np.sqrt(VARIANCE_M2) * generator.standard_normal()
        whole = round((truth[0] + range_m + noise) / TICK_M)
        innovations.append(clock.update(tx, base + tx + whole, range_m))
        if k > 50:
            own = base + tx + round(truth[0] / TICK_M)
            ticks, fraction, variance = clock.to_master(own)
            errors.append(((ticks - tx + fraction) * TICK_M) ** 2 / (variance + TICK_M**2 / 6))
        truth = F @ truth + root @ generator.standard_normal(2)
    return np.array(innovations[50:]), np.array(errors)


def test_innovations_and_errors_are_as_large_as_the_filter_says():
    innovations, errors = run_pair(seed=3, beacons=20_000)
    assert innovations.mean() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / len(innovations)))
    independent = len(errors) / 20
    assert errors.mean() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / independent))


@given(st.integers(0, 2**60), st.integers(-(2**50), 2**50), st.floats(-20e-6, 20e-6))
def test_times_convert_there_and_back(epoch, offset, rate):
    clock = ClockFilter(NOISE, VARIANCE_M2)
    for k in range(20):
        elapsed = k * PERIOD_TICKS
        clock.update(epoch + elapsed, epoch + offset + elapsed + round(rate * elapsed), 0.0)
    for later in (-PERIOD_TICKS, 0, PERIOD_TICKS // 3, 5 * PERIOD_TICKS):
        master = epoch + 19 * PERIOD_TICKS + later
        ticks, fraction, _ = clock.to_master(clock.from_master(master))
        assert abs(ticks - master + fraction) <= 0.51


def test_hours_of_drift_lose_nothing():
    """20 ppm over 24 h moves the offset by 1.1e11 ticks; the remainder stays below one tick."""
    clock = ClockFilter(ClockNoise(1e-12, 1e-12), 1e-6, gate=1e9)
    step = 60 * round(TICK_RATE_HZ)
    for k in range(24 * 60):
        drift = k * step // 50_000
        clock.update(k * step, k * step + drift, 0.0)
    own = (24 * 60 - 1) * step + (24 * 60 - 1) * step // 50_000
    ticks, fraction, _ = clock.to_master(own)
    assert abs(ticks - (24 * 60 - 1) * step + fraction) < 1.0


def test_an_outlier_is_refused_and_counted():
    clock = ClockFilter(NOISE, VARIANCE_M2)
    for k in range(100):
        clock.update(k * PERIOD_TICKS, k * PERIOD_TICKS, 0.0)
    before = clock.to_master(100 * PERIOD_TICKS)
    assert clock.update(100 * PERIOD_TICKS, 100 * PERIOD_TICKS + 5000, 0.0) > 36.0
    assert clock.rejected == 1
    after = clock.to_master(100 * PERIOD_TICKS)
    assert after[0] + after[1] == pytest.approx(before[0] + before[1], abs=1e-6)
    clock.update(101 * PERIOD_TICKS, 101 * PERIOD_TICKS, 0.0)
    assert clock.rejected == 0
