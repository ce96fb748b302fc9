"""Ranges from simulated air: as good as their stamps, from all anchors and from one listener alike."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from skyless.research.studies.surveyed_rooms import stamps_of
from skyless.sim.impairments import lab_impairments
from skyless.sim.lab import lab_site

pytestmark = pytest.mark.site

LAB = lab_site()


def test_ranges_of_the_lab_have_the_errors_that_they_state():
    """5 pieces of 1 s: squared errors over the stated covariance, shared TX noise included, are chi square."""
    position_m = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in LAB.anchors}
    squares, pieces = 0.0, 5
    for seed in range(pieces):
        ranges = stamps_of(LAB, lab_impairments(100.0), 1.0, seed, settle_s=0.5).ranges()
        assert len(ranges.pairs) == 15
        assert ranges.duration_s == pytest.approx(1.0, abs=0.02)
        ends = np.array([[anchor in {pair.a, pair.b} for anchor in ranges.anchors] for pair in ranges.pairs], float)
        shared = ends @ np.diag([ranges.tx_std_m[anchor] ** 2 for anchor in ranges.anchors]) @ ends.T
        error = np.array([pair.range_m - math.dist(position_m[pair.a], position_m[pair.b]) for pair in ranges.pairs])
        squares += error @ np.linalg.solve(np.diag([pair.std_m**2 for pair in ranges.pairs]) + shared, error)
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 15 * pieces)
    assert low < squares < high
