"""What a calibration knows of the anchors of a system without a master, and how it is taken off a time difference.

A listener sees anchor i at

    range + bias_i + slope_i·ln(range / 1 m)

The constant comes from wrong antenna delays (half of what TX and RX together are off, where anchors range each other),
the slope from the receiver: a DW1000 stamps strong signals early (Decawave APS011), by some 9 mm/dB between 3 and
10 m, and a signal loses 8.7 dB when the range grows by the factor e. Only differences of constants can be seen, so
their zero is arbitrary.
"""

from math import dist, log
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.air.packet import PairTdoa, Point
from skyless.positioning.pair_tracker import PairSettings

LEAST_NOISE_M: Final = 0.05
"""A quieter calibration does not narrow the gate further: places it has not seen are somewhat different."""

NEAREST_M: Final = 0.5
"""Below this range the slope is not followed any more."""


class AnchorCalibration(Struct, frozen=True):
    """What is known of one anchor, metres."""

    bias_m: float
    slope_m: float = 0.0
    """Growth of the bias while the range grows by the factor e."""
    noise_m: float | None = None
    """Standard deviation of the differences that the anchor takes part in, outliers apart."""


NOTHING: Final = AnchorCalibration(0.0)


class PairCalibration(Struct, frozen=True):
    """What is known of the anchors; those that are not in it are taken as they are."""

    anchors: dict[int, AnchorCalibration]

    def correction_m(self, pair: PairTdoa, a_m: Point, b_m: Point, position_m: Point | None) -> float:
        """What to add to a difference; without a position the constants only."""
        a, b = self.anchors.get(pair.anchor_a, NOTHING), self.anchors.get(pair.anchor_b, NOTHING)
        correction_m = a.bias_m - b.bias_m
        if position_m is not None and (a.slope_m or b.slope_m):
            correction_m += a.slope_m * _log_range(position_m, a_m) - b.slope_m * _log_range(position_m, b_m)
        return correction_m

    @property
    def noise_m(self) -> float | None:
        """Of a difference, median over the anchors; None where no anchor's is known."""
        known = [anchor.noise_m for anchor in self.anchors.values() if anchor.noise_m is not None]
        return float(np.median(known)) if known else None

    def gate(self, settings: PairSettings) -> float:
        """The settings' gate for the noise that was measured, in their own standard deviations.

        Those stay what they are in the filter: they stand for errors that last, which a constant does not take off.
        """
        if self.noise_m is None:
            return settings.gate
        return settings.gate * min(max(self.noise_m, LEAST_NOISE_M) / settings.tdoa_std_m, 1.0)


def _log_range(position_m: Point, anchor_m: Point) -> float:
    return log(max(dist(position_m, anchor_m), NEAREST_M))
