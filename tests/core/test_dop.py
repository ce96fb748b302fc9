"""Dilutions of precision against closed forms and numpy."""

import math
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.geometry import Dops, dilution_of_precision, dops_at


def _polygon(corners, radius):
    angle = 2 * np.pi * np.arange(corners) / corners
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(corners)])


@pytest.mark.parametrize("corners", [3, 4, 5, 6, 12])
def test_regular_polygon_seen_from_its_centre(corners):
    dops = dilution_of_precision(_polygon(corners, 5.0), [0, 0, 0], height_known=True)
    expected = [math.sqrt(5 / corners), 2 / math.sqrt(corners), 2 / math.sqrt(corners), 0, 1 / math.sqrt(corners)]
    assert [dops.gdop, dops.pdop, dops.hdop, dops.vdop, dops.tdop] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    "solid", [np.vstack([np.eye(3), -np.eye(3)]), 2.0 * np.indices((2, 2, 2)).reshape(3, 8).T - 1.0]
)
def test_octahedron_and_cube_seen_from_their_centre(solid):
    n = len(solid)
    dops = dilution_of_precision(np.add(solid, [10.0, -20.0, 30.0]), [10, -20, 30], height_known=False)
    expected = [math.sqrt(10 / n), 3 / math.sqrt(n), math.sqrt(6 / n), math.sqrt(3 / n), 1 / math.sqrt(n)]
    assert [dops.gdop, dops.pdop, dops.hdop, dops.vdop, dops.tdop] == pytest.approx(expected, rel=1e-12)


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(4, 12), height_known=st.booleans())
def test_random_geometries_against_numpy(seed, n, height_known):
    draw = np.random.default_rng(seed)
    anchors, position = draw.uniform(-10, 10, (n, 3)), draw.uniform(-10, 10, 3)
    unit = (position - anchors) / np.linalg.norm(position - anchors, axis=1)[:, None]
    H = np.column_stack([unit[:, :2] if height_known else unit, np.ones(n)])
    if np.linalg.cond(H) > 1e4:
        return
    q = np.diag(np.linalg.inv(H.T @ H))
    expected = np.sqrt([q.sum(), q[:-1].sum(), q[:2].sum(), q[2:-1].sum(), q[-1]])
    np.testing.assert_allclose(dops_at(anchors, position, height_known=height_known)[0], expected, rtol=1e-7)


@pytest.mark.parametrize(
    ("anchors", "position", "height_known"),
    [
        (np.empty((0, 3)), [0, 0, 0], True),
        (_polygon(6, 5.0)[:2], [0, 0, 0], True),
        ([[1, 1, 1], [1, -1, -1], [-1, 1, -1]], [0, 0, 0], False),
        (_polygon(6, 5.0), [1, 1, 0], False),  # in the anchors' plane
        (_polygon(6, 5.0), [0, 0, 2], False),  # on the axis of a circle: every direction has one elevation
        ([[i, 0, 0] for i in range(5)], [9, 0, 0], True),  # all in one direction
        (np.ones((5, 3)), [0, 0, 0], False),
        (_polygon(6, 5.0), [5, 0, 0], True),  # on an anchor
        (_polygon(6, 5.0), [math.nan, 0, 0], True),
        (_polygon(6, 5.0), [math.inf, 0, 0], False),
        (np.full((5, 3), math.nan), [0, 0, 0], False),
        (np.full((5, 3), math.inf), [0, 0, 0], False),
    ],
)
def test_singular_geometry_is_infinite_and_silent(anchors, position, height_known):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dops = dilution_of_precision(anchors, position, height_known=height_known)
    assert dops == Dops(math.inf, math.inf, math.inf, math.inf, math.inf)


def test_many_positions_equal_one_at_a_time():
    draw = np.random.default_rng(5)
    anchors, positions = draw.uniform(0, 8, (7, 3)), draw.uniform(0, 8, (20, 3))
    positions[3] = anchors[0]
    together = dops_at(anchors, positions, height_known=False)
    for row, position in zip(together, positions, strict=True):
        assert Dops(*row) == dilution_of_precision(anchors, position, height_known=False)
    assert np.isinf(together[3]).all()
    assert np.isfinite(np.delete(together, 3, axis=0)).all()
