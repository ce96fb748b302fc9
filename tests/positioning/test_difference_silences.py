"""Differences of pairs that stay away for seconds while the tag moves on."""

import numpy as np

from skyless.core.air.masterless_packets import PairTdoa
from skyless.research.masterless.difference_tracking import DIFFERENCES, DifferenceTracking

ANCHORS_M = {n: (8.0 * (n & 1), 6.0 * (n >> 1 & 1), 0.3 + 2.4 * (n >> 2)) for n in range(8)}
STD_M = 0.1


def test_a_tag_that_moved_on_in_silence_is_found_again():
    """Round and round at 1 m/s, heard for 3 s and then not for 8 s; the noise is half of what the filter assumes."""
    generator = np.random.default_rng(4)
    tracking = DifferenceTracking(DIFFERENCES, ANCHORS_M)
    errors_m, sigmas_m = [], []
    for k in range(60_000):
        time_s = k / 400.0
        if time_s % 11.0 > 3.0:
            continue
        place = np.array([4.0 + 2.5 * np.cos(time_s / 2.5), 3.0 + 2.5 * np.sin(time_s / 2.5), 1.2])
        a, b = k % 8, (k + 1 + k // 8 % 7) % 8
        true_m = np.linalg.norm(place - ANCHORS_M[b]) - np.linalg.norm(place - ANCHORS_M[a])
        if tracking.update([PairTdoa(time_s, a, b, float(true_m + generator.normal(0.0, STD_M)))]):
            fix = tracking.fix()
            errors_m.append(float(np.linalg.norm(fix.position_m - place)))
            sigmas_m.append(fix.std_m)
    assert len(errors_m) > 0.9 * 60_000 * 3 / 11
    assert max(np.array(errors_m) / np.array(sigmas_m)) < 5.0
    assert max(errors_m) < 1.5
