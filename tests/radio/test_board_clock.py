"""The host's idea of a board's counter, against counters whose truth is known."""

import numpy as np
import pytest

from skyless.core.ticks import TICK_RATE_HZ, difference, wrap
from skyless.radio.serial.serial_port import MAX_BOARD_DRIFT, BoardClock


@pytest.mark.parametrize("drift_ppm", [-45.0, 0.0, 45.0])
def test_it_lags_by_the_shortest_way_and_never_leads(drift_ppm):
    """Ways of 0.4 ms and an exponential 1 ms more, 200 a second: each second some are within 50 µs of the shortest."""
    random, clock = np.random.default_rng(5), BoardClock()
    errors_s = []
    for arrival in range(4000):
        host_s = 5.0 + arrival * 5e-3
        way_s = 0.4e-3 + random.exponential(1e-3)
        counter = 2**40 - 10**11 + (host_s - way_s) * TICK_RATE_HZ * (1.0 + drift_ppm * 1e-6)
        clock.update(wrap(round(counter)), host_s)
        true = wrap(round(2**40 - 10**11 + host_s * TICK_RATE_HZ * (1.0 + drift_ppm * 1e-6)))
        errors_s.append(difference(clock.read(host_s), true) / TICK_RATE_HZ)
    settled_s = np.array(errors_s[200:])
    assert settled_s.max() <= -0.4e-3 + MAX_BOARD_DRIFT * 1.0  # none is kept for longer than a second
    assert np.quantile(settled_s, 0.01) > -0.4e-3 - 0.5e-3


def test_it_follows_a_counter_that_began_again_and_knows_nothing_at_first():
    clock = BoardClock()
    assert clock.read(1.0) is None
    clock.update(10**11 * 5, 1.0)
    clock.update(100, 2.0)
    assert clock.read(2.0) == 100
    assert clock.read(2.5) == round(0.5 * TICK_RATE_HZ) + 100
    clock.reset()
    assert clock.read(2.5) is None
