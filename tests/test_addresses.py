import copy
import pickle

import numpy as np
import pytest

from skyless.addresses import Addresses, integer_blocks, integer_matrix, integers, matrix, vector
from skyless.compiled import kernel
from skyless.positioning.joint import JointFilter
from skyless.positioning.joint_settings import JointSettings

ARRAYS = (
    np.arange(3.0),
    np.arange(6.0).reshape(2, 3),
    np.arange(4),
    np.arange(6).reshape(3, 2),
    np.arange(24).reshape(2, 3, 4),
)


def last_ones(table):
    a, b, c = vector(table, 0), matrix(table, 1), integers(table, 2)
    d, e = integer_matrix(table, 3), integer_blocks(table, 4)
    return a[2], b[1, 2], c[3], d[2, 1], e[1, 2, 3], a.size, b.shape, c.size, d.shape, e.shape


@pytest.mark.parametrize("read", [last_ones, kernel(last_ones)])
def test_arrays_are_found_by_their_addresses(read):
    assert read(Addresses(ARRAYS).table) == (2.0, 5.0, 3, 5, 23, 3, (2, 3), 4, (3, 2), (2, 3, 4))


def test_what_compiled_code_cannot_take_is_refused():
    for array in (ARRAYS[1].T, np.zeros(3, np.float32)):
        with pytest.raises(ValueError, match="nothing for compiled code"):
            Addresses([array])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda joint: pickle.loads(pickle.dumps(joint))])
def test_a_copied_filter_goes_on_by_itself(copied):
    joint = JointFilter(JointSettings(height_m=1.0), np.array([[0.0, 0.0, 2.0]]))
    joint.start(0, np.zeros(2), np.eye(2), 1.0)
    joint.hear(0, 0, 10, 5)
    other = copied(joint)
    before = joint.arrays.x.copy()
    other.hear(0, 1, 1 << 30, 1 << 30)
    assert np.array_equal(joint.arrays.x, before)
    assert not np.array_equal(other.arrays.x, before)
