"""Whether the anchors determine the tag's height: anchors in one plane give both sides of it the same ranges."""

from typing import Final

import numpy as np

from skyless.constants import TICK_S
from skyless.kernels.compiled import step
from skyless.positioning.estimator.state import EstimatorState

PROBE_M: Final = 1.0
"""Least distance from the plane at which the two sides are compared; for a tag that is farther off it is its own."""

DISTINCT_CHI2: Final = 25.0
"""The sides differ where their ranges' squared differences, over the variance of range errors, sum to more."""

LEAST_ANCHORS: Final = 3

SENSOR_VALID_S: Final = 1.0
"""Time for which a sensor's height resolves which side it is."""


def fit_plane(s: EstimatorState) -> None:
    """Find the plane of least squares through the anchors, where the height is estimated."""
    status, anchors_m = s.status[0], s.anchors["position_m"]
    status["plane_normal"] = 0.0
    if s.settings[0]["dim"] == 3 and len(anchors_m) >= LEAST_ANCHORS:
        status["plane_m"] = anchors_m.mean(axis=0)
        status["plane_normal"] = np.linalg.svd(anchors_m - status["plane_m"], full_matrices=False)[2][2]


@step
def _apart_m(s: EstimatorState, anchor: int, off_m: float, probe_m: float) -> float:
    """By how much an anchor is farther from a place above the tag's foot in the plane than from one below."""
    normal, a_m = s.status[0]["plane_normal"], s.anchors[anchor]["position_m"]
    above, below = 0.0, 0.0
    for axis in range(3):
        foot_m = s.x[axis] - off_m * normal[axis] - a_m[axis]
        above += (foot_m + probe_m * normal[axis]) ** 2
        below += (foot_m - probe_m * normal[axis]) ** 2
    return float(np.sqrt(above) - np.sqrt(below))


@step
def is_height_open(s: EstimatorState) -> bool:
    """Whether the tag and its mirror image behind the anchors' plane explain the ranges alike.

    Range errors make up for what is left of the difference, and what all ranges have in common is the tag's clock.
    Not where the image lies where the tag cannot be, nor while a sensor measures the height.
    """
    status, settings = s.status[0], s.settings[0]
    normal, count, off_m, square, total = status["plane_normal"], len(s.anchors), 0.0, 0.0, 0.0
    variance = settings["range_std_m"] ** 2 + settings["survey_std_m"] ** 2 + settings["rx_variance_m2"]
    if settings["dim"] == 3:
        for axis in range(3):
            off_m += normal[axis] * (s.x[axis] - status["plane_m"][axis])
        for anchor in range(count):
            apart_m = _apart_m(s, anchor, off_m, max(abs(off_m), PROBE_M))
            total += apart_m
            square += apart_m * apart_m
    is_flat = square - total * total / count < DISTINCT_CHI2 * variance
    image_z_m = s.x[2] - 2.0 * off_m * normal[2]
    is_image_possible = settings["lowest_m"] <= image_z_m <= settings["highest_m"]
    is_near = off_m * off_m * normal[2] ** 2 <= s.P[2, 2]
    has_sensor = (status["epoch_ticks"] - status["height_ticks"]) * TICK_S < SENSOR_VALID_S
    return bool(settings["dim"] == 3 and is_flat and not has_sensor and (is_image_possible or is_near))
