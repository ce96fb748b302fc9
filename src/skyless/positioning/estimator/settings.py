"""What the estimator assumes of tag, clocks, stamps, survey and ranges."""

from typing import Final

import numpy as np
from msgspec import Struct, structs

from skyless.constants import SPEED_OF_LIGHT_MPS
from skyless.kernels.arrays import Records
from skyless.positioning.integrity import limits_of

MAX_CLOCK_RATE: Final = 50e-6
"""Two crystals of ±20 ppm, and margin."""

RISK: Final = 1e-4
"""Probability, for each fix, that an error exceeds its protection level."""


class EstimatorSettings(Struct, frozen=True):
    """What the filter assumes; standard deviations are one sigma."""

    qa: float = 0.5
    """Spectral density of the tag's acceleration, m²/s³ per axis."""
    white: float = 3.6e-5
    """White frequency noise of each oscillator, m²/s."""
    walk: float = 0.09
    """Random walk of each oscillator's rate, m²/s³."""
    tx_variance_m2: float = 9e-4
    rx_variance_m2: float = 9e-4
    """Of one stamp each."""
    gate: float = 4.0
    """Innovations beyond so many standard deviations are not used."""
    height_m: float | None = None
    """Height of the tag where it is given; None to estimate it."""
    height_std_m: float = 0.0
    """Of the given one."""
    lowest_m: float = -np.inf
    highest_m: float = np.inf
    """Between which the tag's height is known to be."""
    drop_s: float = 2.0
    """Anchors that are silent for longer leave the state."""
    relay_age_s: float = 1.0
    """Older packets are not relayed, as sequence numbers come around."""
    survey_std_m: float = 0.02
    """Of each coordinate of an anchor."""
    range_std_m: float = 0.03
    """Of the constant error of a tag's ranges to one anchor."""
    slope_std_m: float = 0.05
    """By how much ranges lengthen for each unit of clip((range − 4 m)/4 m, −1, 1)."""
    place_std_m: float = 0.005
    """Of the part of a range's error that changes along the way."""
    place_distance_m: float = 1.0
    """Distance over which that part changes, ..."""
    place_time_s: float = 100.0
    """... and time over which it changes at rest."""
    place_memory_s: float = 0.0
    """Time within which the size of each anchor's changing part is estimated again; 0 where it is ``place_std_m``."""
    least_place_std_m: float = 0.05
    """No changing part is estimated to be smaller."""
    difference_std_m: float = 0.12
    """Of what is new in each ready-made time difference."""
    rest_s: float = 0.0
    """A tag that has not shown any motion for so long is taken to stand still; 0: never."""
    max_acceleration_mps2: float = 0.0
    """The tag's largest acceleration, as far as levels are to cover it beyond ``qa``."""
    max_walk_scale: float = 1e4
    """Largest factor on ``walk`` where innovations show that oscillators wander more."""
    integrity_risk: float = RISK
    alert_limit_m: float | None = None
    """Fixes with a higher horizontal protection level say so."""

    @property
    def dim(self) -> int:
        """Dimensions of the position that are estimated."""
        return 3 if self.height_m is None else 2

    def record(self) -> Records:
        """The settings as the kernels take them, shape (1,)."""
        record = np.zeros(1, SETTINGS)
        for name, value in structs.asdict(self).items():
            if name in _NAMES:
                record[name] = 0.0 if value is None else value
        record["dim"] = self.dim
        record["clock_rate_variance"] = (MAX_CLOCK_RATE * SPEED_OF_LIGHT_MPS) ** 2
        record["horizontal_k"], record["vertical_k"] = limits_of(self.integrity_risk)[:2]
        return record


_NAMES: Final = (
    "qa",
    "white",
    "walk",
    "tx_variance_m2",
    "rx_variance_m2",
    "gate",
    "height_m",
    "height_std_m",
    "lowest_m",
    "highest_m",
    "drop_s",
    "relay_age_s",
    "survey_std_m",
    "range_std_m",
    "slope_std_m",
    "place_std_m",
    "place_distance_m",
    "place_time_s",
    "max_acceleration_mps2",
    "place_memory_s",
    "least_place_std_m",
    "difference_std_m",
    "rest_s",
    "max_walk_scale",
)

SETTINGS: Final = np.dtype(
    [
        ("dim", np.int64),
        *((name, np.float64) for name in _NAMES),
        ("clock_rate_variance", np.float64),
        ("horizontal_k", np.float64),  # how many standard deviations the risk of levels allows
        ("vertical_k", np.float64),
    ],
    align=True,
)
"""``EstimatorSettings`` for the kernels."""
