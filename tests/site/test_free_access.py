"""Random instants: one in each window, the same compiled or not, and no two anchors' alike."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from skyless.kernels.compiled import kernel
from skyless.site.free_access import FREE_MARGIN_TICKS, free_instant_ticks, free_window_ticks
from skyless.ticks import from_seconds

IDS = st.integers(0, 0xFFFF)


@kernel
def compiled_instants(anchor: int, first: int, window_ticks: int, out: np.ndarray) -> None:
    for number in range(len(out)):
        out[number] = free_instant_ticks(anchor, first + number, window_ticks)


@given(IDS, st.integers(0, 1 << 30), st.floats(0.2, 500.0))
def test_an_instant_lies_in_its_window_and_leaves_the_margin(anchor, number, rate_hz):
    window = free_window_ticks(rate_hz)
    into = free_instant_ticks(anchor, number, window) - number * window
    assert 0 <= into < window - FREE_MARGIN_TICKS


@given(IDS, st.integers(0, 1 << 30))
def test_kernels_have_the_same_instants(anchor, number):
    window = free_window_ticks(30.0)
    out = np.zeros(8, dtype=np.int64)
    compiled_instants(anchor, number, window, out)
    assert out.tolist() == [free_instant_ticks(anchor, number + step, window) for step in range(8)]


def test_instants_are_uniform_and_independent():
    """4 σ of the mean of 4,000, and of correlations from window to window and between neighbours in number."""
    window, count = free_window_ticks(30.0), 4_000
    parts = np.array(
        [
            [(free_instant_ticks(anchor, k, window) - k * window) / (window - FREE_MARGIN_TICKS) for k in range(count)]
            for anchor in (1, 2, 3, 65_000)
        ]
    )
    limit = 4.0 / np.sqrt(count)
    assert np.all(np.abs(parts.mean(axis=1) - 0.5) < limit / np.sqrt(12.0))
    assert np.all(np.abs(np.corrcoef(parts) - np.eye(4)) < limit)
    assert all(abs(np.corrcoef(row[1:], row[:-1])[0, 1]) < limit for row in parts)


def test_windows_of_fast_sites_hold_a_frame():
    assert free_window_ticks(30.0) == round(from_seconds(1 / 30) / 512) * 512
    assert free_window_ticks(1e6) == 2 * FREE_MARGIN_TICKS
