"""Settings."""

from typing import Final

import numpy as np
from msgspec import Struct, structs

from skyless.core.constants import SPEED_OF_LIGHT_MPS
from skyless.core.integrity import RISK, limits_of
from skyless.core.kernels.arrays import Records


class Tuning(Struct, frozen=True):
    """Constants."""

    restart_m: float = 300.0
    restart_in_row: float = 3
    fading: float = 0.95
    recent_packets: float = 16.0
    creeping_s: float = 3.0
    opened_std_m: float = 1.0
    sure_chi2: float = 50.0
    rival_chi2: float = 20.0
    early_weight: float = 0.8
    jump_rise: float = 0.5
    first_change_scale: float = 25.0
    obstructed_std_m: float = 0.08
    obstructed_s: float = 5.0
    obstructed_walk: float = 0.004
    obstruction_memory_s: float = 10.0
    obstruction_return_m: float = 0.2
    stationary_noise_share: float = 2e-07
    probe_m: float = 1.0
    shift_part: float = 0.25
    sides_chi2: float = 25.0
    sensor_valid_s: float = 1.0
    uncovered_chi2: float = 240.0
    first_packets: float = 3
    max_level_std: float = 0.05
    contradicted_start_s: float = 5.0
    max_open_level_std: float = 0.02
    slope_from_m: float = 4.0
    held_step_m: float = 0.15
    held_std: float = 3.0
    held_max_m: float = 0.4
    clock_jump_relays: float = 4
    curvature_share: float = 0.01
    pair_relays: float = 12
    misplaced_pairs: float = 2
    misplaced_std_m: float = 0.3
    zero_variance_m2: float = 10000.0
    stationary_std_mps: float = 0.01
    forgetting: float = 0.02
    inconsistent_nis: float = 1.6
    suspect: float = 3.0
    in_row: float = 2
    in_row_where_late: float = 5
    late_often_share: float = 0.02
    together: float = 7.0
    agreement: float = 3.0
    jump_std_m: float = 0.2
    change_gain: float = 0.1
    change_growth: float = 1.2
    change_loss: float = 0.97
    max_change_scale: float = 250.0
    ended_std_m: float = 0.05
    ended: float = 2.0
    settled_change_scale: float = 2.0
    late_forgetting: float = 0.005
    late_probability_density: float = 0.05
    reception_huber: float = 1.5
    difference_huber: float = 1.0
    place_step_m: float = 0.1
    place_limit: float = 2.0
    place_limited_mean: float = 0.742
    place_samples: float = 100
    place_memory: float = 1000
    place_min_m2: float = 0.0012
    place_kept: float = 0.1
    max_change_std_m: float = 0.5
    moved: float = 1.0
    better_known: float = 0.8
    mean_gain: float = 0.05
    lag_forgetting: float = 0.01
    lag_limit: float = 2.6
    q_scale_gain: float = 1.05
    max_q_scale: float = 100.0
    scale_loss: float = 0.99
    common: float = 1.5
    mean_limit: float = 9.0
    walk_scale_gain: float = 1.2


TUNING: Final = Tuning()


MAX_CLOCK_RATE: Final = 50e-6  # two crystals of ±20 ppm, and margin
# Standard deviation of the constant error of the range between two anchors, without that of their survey.
PAIR_STD_M: Final = 0.02


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
    """Variances of one stamp each."""
    gate: float = 4.0
    """Innovations beyond this number of standard deviations are not used."""
    height_m: float | None = None
    """Height of the tag where it is given; None to estimate it."""
    height_std_m: float = 0.0
    """Standard deviation of the given height."""
    lowest_m: float = -np.inf
    highest_m: float = np.inf
    """Bounds of the tag's height."""
    drop_s: float = 2.0
    """Anchors that are silent for longer leave the state."""
    relay_age_s: float = 1.0
    """Older packets are not relayed, as sequence numbers come around."""
    survey_std_m: float = 0.02
    """Standard deviation of each coordinate of an anchor."""
    range_std_m: float = 0.03
    """Standard deviation of the constant error of a tag's ranges to one anchor."""
    pair_std_m: float = PAIR_STD_M
    """Standard deviation of the constant error of the range between two anchors.

    It is not used where survey and ranges are exact."""
    slope_std_m: float = 0.05
    """By how much ranges lengthen for each unit of clip((range − 4 m)/4 m, −1, 1)."""
    place_std_m: float = 0.005
    """Standard deviation of the part of a range's error that changes as the tag moves (the site file's name)."""
    place_distance_m: float = 1.0
    """Distance over which that part changes."""
    place_time_s: float = 100.0
    """Time over which that part changes while the tag is stationary."""
    change_memory_s: float = 0.0
    """Time within which the size of each anchor's changing part is estimated again; 0 where it is ``place_std_m``."""
    barometer_walk: float = 2.5e-4
    """Random walk of a barometer's zero, m²/s: 5 cm in ten seconds, as where doors and windows are opened."""
    least_change_std_m: float = 0.05
    """No changing part is estimated to be smaller."""
    earliest_m: float = -np.inf
    """No changing part is below this: obstacles only lengthen ranges."""
    difference_std_m: float = 0.12
    """Standard deviation of each ready-made time difference."""
    stationary_s: float = 0.0
    """A tag that has not shown any motion for this time counts as stationary; 0: never."""
    max_acceleration_mps2: float = 0.0
    """The tag's largest acceleration, as far as levels are to cover it beyond ``qa``."""
    max_walk_scale: float = 1e4
    """Largest factor on ``walk`` where innovations show that oscillators wander more."""
    integrity_risk: float = RISK
    alert_limit_m: float | None = None
    """Fixes with a higher horizontal protection level have an alert."""

    @property
    def dim(self) -> int:
        """Dimensions of the position that are estimated."""
        return 3 if self.height_m is None else 2

    def record(self) -> Records:
        """The settings for the kernels, shape (1,)."""
        record = np.zeros(1, SETTINGS_DTYPE)
        for name, value in structs.asdict(self).items():
            if name in _NAMES:
                record[name] = 0.0 if value is None else value
        for name, value in structs.asdict(TUNING).items():
            record[name] = value
        record["dim"] = self.dim
        record["clock_rate_variance"] = (MAX_CLOCK_RATE * SPEED_OF_LIGHT_MPS) ** 2
        record["horizontal_k"], record["vertical_k"] = limits_of(self.integrity_risk)[:2]
        return record


_NAMES: Final = tuple(
    name for name in EstimatorSettings.__struct_fields__ if name not in {"integrity_risk", "alert_limit_m"}
)

SETTINGS_DTYPE: Final = np.dtype(
    [
        ("dim", np.int64),
        *((name, np.float64) for name in (*_NAMES, *Tuning.__struct_fields__)),
        ("clock_rate_variance", np.float64),
        ("horizontal_k", np.float64),  # how many standard deviations the risk of levels allows
        ("vertical_k", np.float64),
    ],
    align=True,
)
"""``EstimatorSettings`` for the kernels."""
