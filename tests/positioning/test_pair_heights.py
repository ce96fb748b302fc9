"""Differences of pairs that tell no height, because tag and anchors lie in one plane."""

from collections import Counter

import numpy as np
import pytest

from skyless.air.packet import PairTdoa
from skyless.positioning.fix import NoFixReason
from skyless.positioning.pair_state import PairSettings
from skyless.positioning.pair_tracking import PairTracking

SEEN_FROM_ABOVE = ((0.0, 0.0), (8.0, 0.0), (8.0, 6.0), (0.0, 6.0), (4.0, 0.0), (4.0, 6.0))


@pytest.mark.parametrize("height_m", [None, 2.0])
def test_no_fix_where_the_height_is_less_well_known_than_the_anchors_are_wide(height_m):
    """To first order the height is in no difference, so that its deviation grows without a bound."""
    generator, reasons, std_m = np.random.default_rng(1), Counter(), []
    anchors_m = {n: (x, y, 2.0) for n, (x, y) in enumerate(SEEN_FROM_ABOVE)}
    tracking, place = PairTracking(PairSettings(height_m=height_m), anchors_m), np.array([3.0, 2.0, 2.0])
    for k in range(12_000):
        a, b = k % 6, (k + 1 + k // 6 % 5) % 6
        true_m = np.linalg.norm(place - anchors_m[b]) - np.linalg.norm(place - anchors_m[a])
        if tracking.hear([PairTdoa(k / 400.0, a, b, float(true_m + generator.normal(0.0, 0.1)))]):
            fix = tracking.fix()
            std_m.append(fix.covariance_m2[2, 2] ** 0.5)
            assert np.linalg.norm(fix.position_m - place) < 5.0 * fix.std_m
        elif k > 1000:
            reasons[tracking.reason] += 1
    if height_m is None:
        assert 1.0 < max(std_m) < 8.0
        assert reasons[NoFixReason.BAD_GEOMETRY] > 5000
    else:
        assert len(std_m) > 11_000
        assert set(reasons) <= {NoFixReason.RESIDUALS}
