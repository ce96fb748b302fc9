"""Fixes from time differences whose anchors are off, with and without their calibration."""

from math import dist, log

import numpy as np
import pytest

from skyless.core.air.masterless_packets import PairTdoa
from skyless.research.masterless.difference_tracking import DIFFERENCES, DifferenceTracking
from skyless.site.survey.anchor_errors import AnchorCalibration, DifferenceCalibration

PLACES = {k: (6.0 * (k % 2), 8.0 * (k // 2 % 2), 0.2 + 2.5 * ((k + k // 4) % 2)) for k in range(8)}
PLACES |= {k: (x + 3.0, y - 4.0, z) for k, (x, y, z) in PLACES.items() if k > 3}
BIAS_M = (-0.2, 0.3, 0.0, -0.25, 0.15, 0.1, -0.3, 0.2)
KNOWN = DifferenceCalibration({k: AnchorCalibration(b, 0.08, 0.05) for k, b in enumerate(BIAS_M)})


def heard(calibration, tag_m, count=3000, seed=1, noise_m=0.05, late_m=0.0):
    """Mean position over the second half; anchors are off as ``KNOWN`` says, anchor 2 by ``late_m`` more at the end."""
    rng = np.random.default_rng(seed)
    tracking = DifferenceTracking(DIFFERENCES, dict(PLACES), calibration=calibration)
    places = []
    for k in range(count):
        a, b = rng.choice(8, 2, replace=False).tolist()
        clean = PairTdoa(0.005 * k, a, b, dist(tag_m, PLACES[b]) - dist(tag_m, PLACES[a]))
        off_m = KNOWN.constant_m(clean) + 0.08 * log(dist(tag_m, PLACES[b]) / dist(tag_m, PLACES[a]))
        off_m += rng.normal(0.0, noise_m)
        off_m += late_m * ((b == 2) - (a == 2)) * (k > count // 2)
        if tracking.update((PairTdoa(clean.time_s, a, b, clean.tdoa_m + off_m),)) and k > count // 2:
            places.append(tracking.position_m)
    return np.array(places), tracking


@pytest.mark.parametrize("tag_m", [(1.0, 2.0, 1.2), (4.5, 6.0, 0.8)])
def test_a_calibration_takes_constants_and_slope_off(tag_m):
    raw, _ = heard(None, tag_m)
    calibrated, tracking = heard(KNOWN, tag_m)
    assert np.linalg.norm(raw.mean(axis=0) - tag_m) > 0.15
    assert np.linalg.norm(calibrated.mean(axis=0) - tag_m) < 0.05
    assert tracking.counters["restart"] == 0


def test_anchors_that_are_not_in_it_are_taken_as_they_are():
    nothing, _ = heard(DifferenceCalibration({}), (1.0, 2.0, 1.2), count=600)
    raw, _ = heard(None, (1.0, 2.0, 1.2), count=600)
    assert np.array_equal(nothing, raw)


def test_a_blocked_anchor_harms_less_where_the_others_are_known():
    """0.8 m late: more than a calibrated anchor can be."""
    tag_m = (2.0, 3.0, 1.2)
    errors = [np.linalg.norm(heard(known, tag_m, late_m=0.8)[0][-500:].mean(axis=0) - tag_m) for known in (None, KNOWN)]
    assert errors[0] > 0.15
    assert errors[1] < 0.05


def test_a_wrong_calibration_ends_in_worse_fixes_and_not_in_none():
    wrong = DifferenceCalibration({k: AnchorCalibration(-one.bias_m, 0.0, 0.01) for k, one in KNOWN.anchors.items()})
    places, _ = heard(wrong, (2.0, 3.0, 1.2), count=2000)
    assert len(places) > 300
