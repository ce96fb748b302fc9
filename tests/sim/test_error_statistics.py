"""Statistics in bounded memory, against NumPy on the whole."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.sim.evaluation.figures import ErrorStatistics, EvenSample


@given(count=st.integers(0, 5000), rows=st.sampled_from([2, 4, 64]))
def test_the_sample_is_every_kth_row_in_order(count, rows):
    sample = EvenSample(1, rows)
    for value in range(count):
        sample.add((float(value),))
    kept = sample.rows[:, 0]
    steps = set(np.diff(kept))
    assert len(kept) == min(count, len(kept)) <= rows
    assert len(steps) <= 1
    if count:
        stride = steps.pop() if steps else 1.0
        assert kept[0] == 0.0
        assert stride == 2 ** round(np.log2(stride))
        assert count - kept[-1] <= max(stride, count / rows * 2)


@given(st.lists(st.tuples(*[st.floats(-1e3, 1e3)] * 3), min_size=1, max_size=60), st.booleans())
def test_sums_equal_those_of_all_errors(errors, planar):
    statistics = ErrorStatistics(planar=planar)
    for error in errors:
        statistics.add(*error)
    values, summary = np.array(errors), statistics.summary()
    lengths = np.linalg.norm(values[:, :2] if planar else values, axis=1)
    assert summary.count == statistics.count == len(errors)
    assert summary.rmse_2d_m == pytest.approx(np.sqrt(np.mean(np.sum(values[:, :2] ** 2, axis=1))), abs=1e-6)
    assert summary.max_m == pytest.approx(lengths.max())
    assert summary.p95_m == pytest.approx(np.percentile(lengths, 95))
    assert summary.bias_m == pytest.approx(values.mean(axis=0), abs=1e-9)
    assert statistics.std() == pytest.approx(values.std(axis=0), abs=1e-4)
    assert (summary.rmse_3d_m is None) == planar


def test_nothing_has_no_figures():
    summary = ErrorStatistics(planar=False).summary()
    assert (summary.count, summary.rmse_2d_m, summary.p95_m, summary.max_m, summary.bias_m) == (0, *[None] * 4)
