import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_S
from skyless.run.masterless.pair_engine import (
    ACCELERATION_M2PS3,
    BROADCAST_WALK_FM,
    RESTART_AFTER,
    STAMP_TICKS,
    WHITE_FM,
    BroadcastClock,
)

pytestmark = pytest.mark.site

SECOND = 63_897_600_000
PERIOD = SECOND // 50


def stamps(times, rate, offset_tx, bits=32):
    """TX counter and unwrapped RX ticks of packets sent at those ticks of true time, the listener's clock true."""
    return [((round(time * (1 - rate)) + offset_tx) % (1 << bits), time) for time in times]


@given(st.floats(-19e-6, 19e-6), st.integers(0, 2**32 - 1), st.integers(1, 300), st.integers(1, 300))
def test_32_bit_counters_are_followed_across_gaps_of_seconds(rate, offset, first_gap, second_gap):
    times = [0, 1, 2, 3, 4, 4 + first_gap, 5 + first_gap, 5 + first_gap + second_gap]
    heard = stamps([time * PERIOD for time in times], rate, offset)
    clock = BroadcastClock(32, *heard[0])
    assert all(clock.update(*packet) for packet in heard[1:])
    assert clock.tx_ticks - heard[0][0] == pytest.approx(times[-1] * PERIOD * (1 - rate), abs=2)
    assert clock.rate == pytest.approx(rate / (1 - rate), abs=1e-9)
    assert abs(clock.phase) < 2


def test_the_phase_is_as_good_as_an_optimal_filter_of_that_noise():
    rng = np.random.default_rng(4)
    walk = (2 * BROADCAST_WALK_FM**2 + ACCELERATION_M2PS3 / SPEED_OF_LIGHT_MPS**2) * TICK_S
    white = 2 * WHITE_FM**2 / TICK_S
    step = np.array([[1.0, PERIOD], [0.0, 1.0]])
    noise = np.array(
        [[white * PERIOD + walk * PERIOD**3 / 3, walk * PERIOD**2 / 2], [walk * PERIOD**2 / 2, walk * PERIOD]]
    )
    phase = np.array([[1.0], [0.0]])
    prior = solve_discrete_are(step.T, phase, noise, [[STAMP_TICKS**2]])[0, 0]  # SciPy's word on the steady state
    posterior = prior * STAMP_TICKS**2 / (prior + STAMP_TICKS**2)
    state = np.zeros(2)
    clock = BroadcastClock(32, 0, 0)
    errors = []
    for number in range(1, 20_000):
        state = step @ state + rng.multivariate_normal([0.0, 0.0], noise)
        sent = number * PERIOD
        rx_ticks = sent + round(state[0] + rng.normal(0.0, STAMP_TICKS))
        clock.update(sent % 2**32, rx_ticks)
        errors.append(rx_ticks + clock.phase - sent - state[0])
    # 20 000 errors that are alike over some 6 packets: standard error of the deviation 1.2 %, of the mean 1.7 %.
    assert np.std(errors[100:]) == pytest.approx(np.sqrt(posterior), rel=0.05)
    assert abs(np.mean(errors[100:])) < 0.07 * np.sqrt(posterior)


def test_single_wild_stamps_are_left_out_and_change_nothing():
    times = [number * PERIOD for number in range(200)]
    clean = BroadcastClock(32, 0, 0)
    wild = BroadcastClock(32, 0, 0)
    for number, (tx, rx) in enumerate(stamps(times, 5e-6, 0)[1:]):
        if number % 10 == 9:
            assert not wild.update(tx, rx + 20_000)
        else:
            assert clean.update(tx, rx)
            assert wild.update(tx, rx)
    assert (wild.rate, wild.phase) == (clean.rate, clean.phase)


def test_a_restarted_anchor_is_followed_after_three_packets():
    before = stamps([number * PERIOD for number in range(50)], 5e-6, 123)
    after = stamps([number * PERIOD for number in range(50, 100)], 5e-6, 3_000_000_000)
    clock = BroadcastClock(32, *before[0])
    assert all(clock.update(*packet) for packet in before[1:])
    taken = [clock.update(*packet) for packet in after]
    assert taken == [False] * RESTART_AFTER + [True] * (50 - RESTART_AFTER)
    assert clock.restarts == 1
    assert clock.rate == pytest.approx(5e-6, abs=2e-9)


def test_packets_out_of_order_are_refused():
    heard = stamps([number * PERIOD for number in range(20)], 0.0, 0)
    clock = BroadcastClock(32, *heard[0])
    for packet in heard[1:]:
        assert clock.update(*packet)
    assert not clock.update(*heard[10])
    assert clock.tx_ticks == 19 * PERIOD
