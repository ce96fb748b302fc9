"""Whether the anchors tell the tag's height at all: those in one plane do not tell one side of it from the other."""

from typing import Final

import numpy as np

from skyless.compiled import kernel
from skyless.positioning.estimator.state import EstimatorState

PROBE_M: Final = 1.0
"""Places so far off the plane, or as far as the tag is, are to be told apart."""

TOLD_CHI2: Final = 25.0
"""Sum of the squared differences between their ranges, over the variances of range errors: by five sigma."""

LEAST_ANCHORS: Final = 3


def fit_plane(s: EstimatorState) -> None:
    """Find the plane of least squares through the anchors, where the height is estimated."""
    status, anchors_m = s.status[0], s.anchors["position_m"]
    status["plane_normal"] = 0.0
    if s.settings[0]["dim"] == 3 and len(anchors_m) >= LEAST_ANCHORS:
        status["plane_m"] = anchors_m.mean(axis=0)
        status["plane_normal"] = np.linalg.svd(anchors_m - status["plane_m"], full_matrices=False)[2][2]


@kernel
def is_height_open(s: EstimatorState) -> bool:
    """Whether the tag and its mirror image behind the anchors' plane explain the ranges alike.

    Range errors make up for what is left of the difference, and what all ranges have in common is the tag's clock.
    Not where the image lies where the tag cannot be.
    """
    x, status, settings = s.x, s.status[0], s.settings[0]
    normal, count = status["plane_normal"], len(s.anchors)
    if settings["dim"] == 2 or (normal[0] == 0.0 and normal[1] == 0.0 and normal[2] == 0.0):
        return False
    off_m = 0.0
    for axis in range(3):
        off_m += normal[axis] * (x[axis] - status["plane_m"][axis])
    image_z_m = x[2] - 2.0 * off_m * normal[2]
    is_image_possible = settings["lowest_m"] <= image_z_m <= settings["highest_m"]
    if not is_image_possible and off_m * off_m * normal[2] ** 2 > s.P[2, 2]:
        return False
    probe_m = max(abs(off_m), PROBE_M)
    total, square = 0.0, 0.0
    variance = settings["range_std_m"] ** 2 + settings["survey_std_m"] ** 2 + settings["rx_variance_m2"]
    for anchor in range(count):
        a = s.anchors[anchor]["position_m"]
        above, below = 0.0, 0.0
        for axis in range(3):
            foot_m = x[axis] - off_m * normal[axis] - a[axis]
            above += (foot_m + probe_m * normal[axis]) ** 2
            below += (foot_m - probe_m * normal[axis]) ** 2
        apart_m = np.sqrt(above) - np.sqrt(below)
        total += apart_m
        square += apart_m * apart_m
    return bool(square - total * total / count < TOLD_CHI2 * variance)
