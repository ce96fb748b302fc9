"""Differences of pairs that tell no height, because tag and anchors lie in one plane."""

from collections import Counter

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.core.air.masterless_packets import PairTdoa
from skyless.core.fix import NoFixReason
from skyless.core.integrity import Alert
from skyless.research.masterless.difference_tracking import DIFFERENCES, DifferenceTracking

SEEN_FROM_ABOVE = ((0.0, 0.0), (8.0, 0.0), (8.0, 6.0), (0.0, 6.0), (4.0, 0.0), (4.0, 6.0))


@pytest.mark.parametrize("height_m", [None, 2.0])
def test_no_level_where_the_anchors_do_not_tell_the_height(height_m):
    """To first order the height is in no difference."""
    generator, reasons, std_m = np.random.default_rng(1), Counter(), []
    anchors_m = {n: (x, y, 2.0) for n, (x, y) in enumerate(SEEN_FROM_ABOVE)}
    tracking, place = DifferenceTracking(replace(DIFFERENCES, height_m=height_m), anchors_m), np.array([3.0, 2.0, 2.0])
    for k in range(12_000):
        a, b = k % 6, (k + 1 + k // 6 % 5) % 6
        true_m = np.linalg.norm(place - anchors_m[b]) - np.linalg.norm(place - anchors_m[a])
        if tracking.update([PairTdoa(k / 400.0, a, b, float(true_m + generator.normal(0.0, 0.1)))]):
            fix = tracking.fix()
            std_m.append(fix.covariance_m2[2, 2] ** 0.5)
            assert np.linalg.norm(fix.position_m - place) < 5.0 * fix.std_m
        elif k > 1000:
            reasons[tracking.reason] += 1
    if height_m is None:
        assert max(std_m) > 0.5
        assert tracking.fix().alert == Alert.UNAVAILABLE
        assert tracking.fix().vpl_m is None
    else:
        assert tracking.fix().hpl_m is not None
        assert len(std_m) > 11_000
        assert set(reasons) <= {NoFixReason.RESIDUALS}
