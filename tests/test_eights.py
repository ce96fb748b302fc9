"""Eight numbers at a time: compiled as written, and as plain Python."""

import numpy as np
import pytest

from skyless.compiled import kernel
from skyless.eights import EIGHT, add, load, repeated, scaled, store, zeros


def plain(matrix, vector, factor):
    for row in range(len(matrix)):
        for column in range(1, matrix.shape[1] - EIGHT + 1, EIGHT):
            eight = add(load(matrix, (row, column)), factor, load(vector, column))
            eight = add(eight, scaled(matrix[row, 0], repeated(2.0)), eight)
            store(matrix, (row, column), eight)
    store(vector, 1, repeated(factor))


compiled = kernel(plain)


@pytest.mark.parametrize("columns", [9, 17, 20])
def test_compiled_and_plain_agree_with_arithmetic_on_whole_arrays(columns):
    """On whole numbers, which no rounding touches; beside the eights nothing changes."""
    random = np.random.default_rng(columns)
    matrix = random.integers(-50, 50, (3, columns)).astype(float)
    vector = random.integers(-50, 50, columns).astype(float)
    end = 1 + (columns - 1) // EIGHT * EIGHT
    expected = matrix.copy()
    expected[:, 1:end] += 3.0 * vector[1:end]
    expected[:, 1:end] *= 1.0 + 2.0 * matrix[:, :1]
    for function in (plain, compiled):
        ours, line = matrix.copy(), vector.copy()
        function(ours, line, 3.0)
        np.testing.assert_array_equal(ours, expected)
        assert (line[1:9] == 3.0).all()
        np.testing.assert_array_equal(np.delete(line, range(1, 9)), np.delete(vector, range(1, 9)))


@pytest.mark.parametrize("shape", [(8,), (3, 8), (5, 16)])
def test_zeros_begin_on_a_cache_line(shape):
    array = zeros(*shape)
    assert array.shape == shape
    assert array.flags.c_contiguous
    assert array.ctypes.data % 64 == 0
    assert not array.any()
