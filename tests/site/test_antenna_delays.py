import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.site.survey.anchor_errors import ANTENNA_DELAY_STD_M, BLOCKED_M, EXCESS_STD_M, antenna_delays_m

pytestmark = pytest.mark.site

delays = st.lists(st.floats(-0.2, 0.2), min_size=2, max_size=9)


def excesses(delays_m, common_m=154.5):
    n = len(delays_m)
    return {(i, j): 2 * common_m + delays_m[i] + delays_m[j] for i in range(n) for j in range(i + 1, n)}


@given(delays, st.floats(0.0, 200.0))
def test_what_all_have_in_common_is_nobodys(delays_m, common_m):
    ours = antenna_delays_m(excesses(delays_m))
    other = antenna_delays_m(excesses(delays_m, common_m))
    assert other == pytest.approx(ours, abs=1e-9)
    assert sum(ours.values()) == pytest.approx(0.0, abs=1e-9)


@given(st.lists(st.floats(-0.05, 0.05), min_size=2, max_size=9), st.integers(0, 99))
def test_it_is_the_conditional_mean_of_a_gaussian(delays_m, seed):
    """The same by covariances instead of information, with a common part of which nothing was known.

    Delays and noise are too small for any pair to pass for blocked.
    """
    told = excesses(delays_m)
    noise = np.random.default_rng(seed).normal(0.0, 0.03, len(told))
    told = {pair: value + error for (pair, value), error in zip(told.items(), noise, strict=True)}
    n = len(delays_m)
    H = np.array([[float(i in pair) for i in range(n)] for pair in told])
    prior = ANTENNA_DELAY_STD_M**2 * np.eye(n)
    spread = H @ prior @ H.T + EXCESS_STD_M**2 * np.eye(len(told)) + 1e6
    values = np.array(list(told.values()))
    expected = prior @ H.T @ np.linalg.solve(spread, values - values.mean())
    assert list(antenna_delays_m(told).values()) == pytest.approx(expected, abs=1e-6)


def test_many_exact_flights_are_believed_a_pair_alone_says_nothing():
    true_m = np.random.default_rng(1).normal(0.0, ANTENNA_DELAY_STD_M, 30)
    found = antenna_delays_m(excesses(true_m))
    assert list(found.values()) == pytest.approx(true_m - true_m.mean(), abs=0.02)
    assert antenna_delays_m({(1, 2): 154.0}) == pytest.approx({1: 0.0, 2: 0.0})
    assert antenna_delays_m({}) == {}


def test_a_blocked_pair_is_left_out():
    true_m = [0.05, -0.05, 0.1, -0.1, 0.0]
    told = excesses(true_m)
    blocked = dict(told)
    blocked[0, 1] += 2 * BLOCKED_M
    del told[0, 1]
    assert antenna_delays_m(blocked) == pytest.approx(antenna_delays_m(told), abs=0.01)
