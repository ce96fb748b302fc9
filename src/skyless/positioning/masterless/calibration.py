"""What a calibration knows of the anchors of a system without a master, and how it is taken off a time difference.

A listener sees anchor i at

    range + bias_i + slope_i·ln(range / 1 m)

The constant comes from wrong antenna delays (half of what TX and RX together are off, where anchors range each other),
the slope from the receiver: a DW1000 stamps strong signals early (Decawave APS011), by some 9 mm/dB between 3 and
10 m, and a signal loses 8.7 dB when the range grows by the factor e. Only differences of constants can be seen, so
their zero is arbitrary.
"""

from math import log
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.air.masterless_packets import PairTdoa

LEAST_NOISE_M: Final = 0.05
"""A quieter calibration is not believed further: places it has not seen are somewhat different."""

NEAREST_M: Final = 0.5
"""Below this range the slope is not followed any more."""

SHARED: Final = 1.5
"""Differences that follow each other share receptions and reflections, which the filter counts as new in each."""

TYPICAL_SLOPE_M: Final = 0.05
"""Of a DW1000 that nobody has calibrated: APS011 says 0.03 to 0.10 m, flights that told it 0.03 to 0.08 m."""

KNOWN_STD_M: Final = 0.02
"""Of a constant that was calibrated, without the error of the survey: with it, constants of the same anchors differ by
3 cm between recordings."""


class AnchorCalibration(Struct, frozen=True):
    """What is known of one anchor, metres."""

    bias_m: float
    slope_m: float = 0.0
    """Growth of the bias while the range grows by the factor e."""
    noise_m: float | None = None
    """Standard deviation of the differences that the anchor takes part in, outliers apart."""


NOTHING: Final = AnchorCalibration(0.0)
UNKNOWN: Final = AnchorCalibration(0.0, TYPICAL_SLOPE_M)


class DifferenceCalibration(Struct, frozen=True):
    """What is known of the anchors; those that are not in it are taken as they are."""

    anchors: dict[int, AnchorCalibration]

    def of(self, anchor: int) -> AnchorCalibration:
        """What is known of an anchor, or of any."""
        return self.anchors.get(anchor, UNKNOWN)

    def error_m(self, anchor: int, range_m: float) -> float:
        """By how much an anchor seems too far away."""
        known = self.of(anchor)
        return known.bias_m + known.slope_m * log(max(range_m, NEAREST_M))

    def constant_m(self, pair: PairTdoa) -> float:
        """By how much a difference is too large for its anchors' constants."""
        return self.of(pair.anchor_b).bias_m - self.of(pair.anchor_a).bias_m

    def difference_std_m(self, otherwise_m: float) -> float:
        """Of a difference, by the median of what was measured at the anchors, where that is less than otherwise."""
        known = [anchor.noise_m for anchor in self.anchors.values() if anchor.noise_m is not None]
        return min(SHARED * max(float(np.median(known)), LEAST_NOISE_M), otherwise_m) if known else otherwise_m
