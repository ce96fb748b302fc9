"""Error statistics against exact fractions and numpy."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.sim.evaluation.figures import ErrorStatistics, ErrorSummary, EvenSample

pytestmark = pytest.mark.site

metres = st.floats(-1e3, 1e3)
vectors = st.lists(st.tuples(metres, metres, metres), min_size=1, max_size=60)


def filled(rows, planar):
    statistics = ErrorStatistics(planar=planar)
    for row in rows:
        statistics.add(*row)
    return statistics


@given(vectors, st.booleans())
def test_sums_are_those_of_exact_arithmetic(rows, planar):
    statistics = filled(rows, planar)
    summary, count = statistics.summary(), len(rows)
    exact = [[Fraction(row[axis]) for row in rows] for axis in range(3)]
    means = [sum(column) / count for column in exact]
    squares = [sum(value * value for value in column) / count for column in exact]
    tolerance = {"rel": 1e-9, "abs": 1e-9}
    assert summary.count == statistics.count == count
    assert summary.bias_m == pytest.approx([float(mean) for mean in means], **tolerance)
    assert summary.rmse_2d_m == pytest.approx(float(squares[0] + squares[1]) ** 0.5, **tolerance)
    if planar:
        assert summary.rmse_3d_m is None
    else:
        assert summary.rmse_3d_m == pytest.approx(float(sum(squares)) ** 0.5, **tolerance)


@given(vectors, st.booleans())
def test_percentile_and_maximum_are_numpys(rows, planar):
    errors = np.linalg.norm(np.array(rows)[:, : 2 if planar else 3], axis=1)
    summary = filled(rows, planar).summary()
    assert summary.p95_m == pytest.approx(np.percentile(errors, 95), rel=1e-12)
    assert summary.max_m == pytest.approx(errors.max(), rel=1e-12)


def test_nothing_to_judge():
    assert ErrorStatistics(planar=True).summary() == ErrorSummary(0, None, None, None, None, None)


@given(st.integers(1, 64), st.integers(0, 2000))
def test_a_sample_is_every_kth_row_and_bounded(rows, count):
    sample = EvenSample(2, rows)
    for value in range(count):
        sample.add((float(value), -float(value)))
    kept = sample.rows
    assert len(kept) <= max(rows, 1)
    assert np.array_equal(kept[:, 1], -kept[:, 0])
    if count:
        steps = np.diff(kept[:, 0])
        stride = steps[0] if len(steps) else count
        assert kept[0, 0] == 0.0
        assert np.all(steps == stride)
        assert not len(steps) or stride == 2 ** round(np.log2(stride))
        assert count - kept[-1, 0] <= stride
        assert rows < 2 or len(kept) >= min(count, rows // 2)
        if count <= rows:
            assert kept[:, 0].tolist() == list(range(count))
