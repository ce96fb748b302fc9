"""What a recording can tell: the height, and whether the tag flies."""

import numpy as np
import pytest

from skyless.core.geometry import plane_height_m
from skyless.sim.evaluation.figures import flies
from skyless.site.tables import Truth

CORNERS = [(0.0, 0.0), (8.0, 0.0), (8.0, 6.0), (0.0, 6.0)]


def ring(*heights_m):
    return {n: (*corner, height_m) for n, (corner, height_m) in enumerate(zip(CORNERS, heights_m, strict=False))}


def truth_of(heights_m):
    heights_m = np.array(heights_m, dtype=float)
    return Truth(np.arange(len(heights_m), dtype=float), np.stack([0 * heights_m, 0 * heights_m, heights_m], 1), None)


@pytest.mark.parametrize(
    ("anchors_m", "height_m"),
    [
        (ring(2.0, 2.0, 2.0, 2.0), 2.0),  # a plane through the tag says nothing of its height
        (ring(0.9, 0.9, 1.2, 1.5), 1.125),
        (ring(0.2, 2.8, 0.2, 2.8), None),
        ({**ring(0.2, 0.2, 0.2, 0.2), **{n + 4: (*corner, 3.0) for n, corner in enumerate(CORNERS)}}, None),
        (ring(2.0, 2.0), None),
        ({}, None),
    ],
)
def test_flat_anchors_do_not_tell_the_height(anchors_m, height_m):
    assert plane_height_m(anchors_m) == (None if height_m is None else pytest.approx(height_m))


@pytest.mark.parametrize(
    ("heights_m", "flying"),
    [
        ([0.0, 0.1, 1.0, 1.5, 1.5, 1.5, 0.1], True),
        ([0.0, 0.0, 0.0, 0.0, 1.5, 1.5], False),  # mostly on the floor
        ([1.0, 1.5, 1.5, 1.5], False),  # carried at that height from the beginning
        ([0.2, 0.2, 0.2], False),
    ],
)
def test_a_flight_begins_on_the_floor(heights_m, flying):
    assert flies(truth_of(heights_m)) is flying
