"""Free access: one random instant a window, the same from Python and from kernels."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest

from skyless.kernels.compiled import kernel
from skyless.site.free_access import FREE_REST_TICKS, first_free_window, free_instant_ticks, free_window_ticks
from skyless.ticks import LAST_TICKS, from_seconds

WINDOW_TICKS = free_window_ticks(30.0)
ANCHORS = st.integers(0, 0xFFFF)
WINDOWS = st.integers(0, 1 << 34)


@kernel
def compiled_instant(anchor_id, window_number, window_ticks):
    return free_instant_ticks(anchor_id, window_number, window_ticks)


@given(ANCHORS, WINDOWS, st.sampled_from([1.0, 8.0, 30.0, 300.0]))
def test_python_and_kernels_agree(anchor_id, window, rate_hz):
    ticks = free_window_ticks(rate_hz)
    window %= LAST_TICKS // ticks
    assert compiled_instant(anchor_id, window, ticks) == free_instant_ticks(anchor_id, window, ticks)


@given(ANCHORS, WINDOWS)
def test_frames_of_successive_windows_are_a_rest_apart(anchor_id, window):
    one, other = (free_instant_ticks(anchor_id, number, WINDOW_TICKS) for number in (window, window + 1))
    assert window * WINDOW_TICKS <= one <= (window + 1) * WINDOW_TICKS - FREE_REST_TICKS
    assert other - one >= FREE_REST_TICKS
    assert from_seconds(1.3e-3) < FREE_REST_TICKS, "the driver's lead time, and a frame after its RMARKER"


@given(ANCHORS, st.integers(0, 1 << 55))
def test_the_first_window_is_the_first_whose_instant_is_not_past(anchor_id, earliest):
    window = first_free_window(anchor_id, earliest, WINDOW_TICKS)
    assert free_instant_ticks(anchor_id, window, WINDOW_TICKS) >= earliest
    assert window == 0 or free_instant_ticks(anchor_id, window - 1, WINDOW_TICKS) < earliest


def test_instants_are_uniform_over_windows_and_anchors_and_independent():
    count = 20_000
    span = WINDOW_TICKS - FREE_REST_TICKS
    of_one = np.array([free_instant_ticks(7, k, WINDOW_TICKS) - k * WINDOW_TICKS for k in range(count)]) / span
    of_all = np.array([free_instant_ticks(k, 7, WINDOW_TICKS) - 7 * WINDOW_TICKS for k in range(count)]) / span
    for drawn in (of_one, of_all):
        assert kstest(drawn, "uniform").pvalue > 1e-6
        assert abs(np.corrcoef(drawn[1:], drawn[:-1])[0, 1]) < 5.0 / np.sqrt(count)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, 400.0])
def test_rates_that_leave_no_room_are_refused(rate_hz):
    with pytest.raises(ValueError, match="rate_hz is"):
        free_window_ticks(rate_hz)
