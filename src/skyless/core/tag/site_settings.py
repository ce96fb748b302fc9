"""What the estimator assumes at a site, from its pages of noise and accuracy."""

from typing import Final

from skyless.core.air.little_endian import two_bytes, unsigned
from skyless.core.air.page_check import STD_STEPS_PER_M, STEPS_PER_M, STEPS_PER_S
from skyless.core.constants import SPEED_OF_LIGHT_MPS, TICK_S
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.native.arithmetic import square
from skyless.core.native.records import Bytes

DROP_S: Final = 2.0
"""An anchor that is silent for longer, or for four superframes, leaves the estimator."""

# Relays of packets that are older than both are not used.
RELAY_AGE_S: Final = 1.0
RELAY_SUPERFRAMES: Final = 2.5

_LIGHT_2: Final = SPEED_OF_LIGHT_MPS**2
_ROUNDING_S2: Final = TICK_S**2 / 12.0
"""Variance of rounding to whole ticks."""


def read_accuracy(e: EstimatorSettings, noise: Bytes, accuracy: Bytes) -> None:
    """Fill in what the pages say."""
    fill_noise(e, _float_at(noise, 1), _float_at(noise, 5), _float_at(noise, 9), _float_at(noise, 13))
    e.survey_std_m = two_bytes(accuracy, 1) / STD_STEPS_PER_M
    e.range_std_m = two_bytes(accuracy, 3) / STD_STEPS_PER_M
    e.slope_std_m = two_bytes(accuracy, 5) / STD_STEPS_PER_M
    e.place_std_m = two_bytes(accuracy, 7) / STD_STEPS_PER_M
    e.place_distance_m = two_bytes(accuracy, 9) / STEPS_PER_M
    e.place_time_s = two_bytes(accuracy, 11) / STEPS_PER_S


def fill_noise(
    e: EstimatorSettings, tx_stamp_s: float, rx_stamp_s: float, white_fm: float, random_walk_fm: float
) -> None:
    """Fill in the variances of stamps and oscillators of this noise (``NoisePage``)."""
    e.tx_variance_m2 = _LIGHT_2 * square(tx_stamp_s)
    e.rx_variance_m2 = _LIGHT_2 * (square(rx_stamp_s) + _ROUNDING_S2)
    e.white, e.walk = _LIGHT_2 * square(white_fm), _LIGHT_2 * square(random_walk_fm)


def fill_ages(e: EstimatorSettings, superframe_s: float, drop_s: float) -> None:
    """Fill in after which times packets and anchors count no more; anchors after ``drop_s`` at least."""
    e.drop_s = max(drop_s, 4.0 * superframe_s)
    e.relay_age_s = max(RELAY_AGE_S, RELAY_SUPERFRAMES * superframe_s)


def _float_at(data: Bytes, at: int) -> float:
    """The number in four bytes, which is 0 or, in IEEE 754, a positive one below 1; pages have been checked."""
    bits = unsigned(data, at, 4)
    halvings, value = 150 - (bits >> 23), float(bits & 0x7FFFFF | 0x800000)
    if bits < 0x800000 or bits >= 0x80000000:
        halvings, value = 149, float(bits & 0x7FFFFF)
    for _ in range(halvings):
        value *= 0.5
    return value
