"""What a recording can resolve: whether its anchors resolve the height, and whether the tag flies."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from skyless.air.masterless_packets import Point
from skyless.recordings.truth import Truth
from skyless.uncertainty.dop import dilution_of_precision

MAX_VDOP: Final = 4.0
"""With a larger vertical dilution in the middle of the anchors, the height is not worth estimating."""

FLIGHT_M: Final = 0.3
"""Above this height a drone flies."""


GUESSED_STD_M: Final = 0.5
"""Standard deviation of a tag's height from the anchors', where that is used instead."""


def plane_height_m(anchors_m: Mapping[int, Point]) -> float | None:
    """Mean height of anchors that lie too flat to resolve the height; None where they resolve it, or are too few."""
    positions_m = np.array(list(anchors_m.values()), dtype=np.float64).reshape(-1, 3)
    if len(positions_m) < 3:
        return None
    middle = positions_m.mean(axis=0)
    dops = dilution_of_precision(positions_m, middle, height_known=False)
    return float(middle[2]) if dops.vdop > MAX_VDOP else None


def flies(truth: Truth) -> bool:
    """Whether the tag begins on the floor and then spends most of its time well above it."""
    heights = truth.position_m[:, 2]
    return bool(heights[0] < FLIGHT_M and np.median(heights) > 2.0 * FLIGHT_M)
