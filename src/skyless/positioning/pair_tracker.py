"""The tracker for systems that give time differences of pairs of anchors instead of stamps on one master's scale.

Position and velocity are its state; the tag's clock has dropped out with the difference. The steps are those of
``tracker`` (``kalman``), the measurement is d = |p - b| - |p - a|.
"""

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.compiled import borrowing_kernel
from skyless.positioning.kalman import horizontal_variance, innovation_variance, predict_motion, range_and_direction
from skyless.positioning.tracker import AGILITY, LOST_SHARE, REJECTED_SHARE, gated_correct

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

SETTING_QA, SETTING_VARIANCE, SETTING_GATE, SETTING_HEIGHT = range(4)


class PairSettings(Struct, frozen=True):
    """What the filter of pair differences assumes."""

    qa: float = 1.0
    """Spectral density of the acceleration, m²/s³ per axis."""
    tdoa_std_m: float = 0.22
    """Of one time difference, in metres."""
    gate: float = 2.5
    """Innovations beyond so many standard deviations are not used."""
    height_m: float | None = None
    """Height of the tag where it is given; None to estimate it."""

    @property
    def dim(self) -> int:
        """Dimensions of the position that are estimated."""
        return 3 if self.height_m is None else 2

    def array(self) -> Vector:
        """The settings as the kernels take them."""
        height_m = 0.0 if self.height_m is None else self.height_m
        return np.array([self.qa, self.tdoa_std_m**2, self.gate, height_m])


@borrowing_kernel
def pair_update(
    x: Vector,
    P: Matrix,
    whole: NDArray[np.int64],
    statistics: Vector,
    settings: Vector,
    h: Vector,
    ph: Vector,
    a_m: Vector,
    b_m: Vector,
    dt_s: float,
    tdoa_m: float,
) -> bool:
    """Advance by ``dt_s`` and take one difference; False if it lies beyond the gate."""
    n = x.shape[0]
    dim = n // 2
    predict_motion(x, P, dim, dt_s, settings[SETTING_QA] * statistics[AGILITY])
    for place in range(n):
        h[place] = 0.0
    range_b = range_and_direction(x, dim, settings[SETTING_HEIGHT], b_m, h, 1.0)
    range_a = range_and_direction(x, dim, settings[SETTING_HEIGHT], a_m, h, -1.0)
    innovation = tdoa_m - (range_b - range_a)
    spread = innovation_variance(P, h, ph, settings[SETTING_VARIANCE])
    return gated_correct(x, P, whole, statistics, ph, innovation, spread, settings[SETTING_GATE])


@borrowing_kernel
def track_pairs(
    x: Vector,
    P: Matrix,
    whole: NDArray[np.int64],
    statistics: Vector,
    settings: Vector,
    h: Vector,
    ph: Vector,
    a_m: Matrix,
    b_m: Matrix,
    dt_s: Vector,
    tdoa_m: Vector,
    states: Matrix,
) -> int:
    """Take many differences in one loop; row k of ``states`` is x after difference k. Returns the accepted."""
    accepted = 0
    for k in range(tdoa_m.shape[0]):
        accepted += pair_update(x, P, whole, statistics, settings, h, ph, a_m[k], b_m[k], dt_s[k], tdoa_m[k])
        for place in range(x.shape[0]):
            states[k, place] = x[place]
    return accepted


class PairTracker:
    """State of one tag's filter of pair differences."""

    def __init__(self, settings: PairSettings) -> None:
        self.dim = settings.dim
        n = 2 * self.dim
        self.settings = settings.array()
        self.x = np.zeros(n)
        self.P = np.zeros((n, n))
        self.whole = np.zeros(5, dtype=np.int64)
        self.statistics = np.ones(4)
        self.h = np.zeros(n)
        self.ph = np.zeros(n)

    def start(self, position_m: Vector, covariance_m2: Matrix, speed_variance: float) -> None:
        """Begin at a solved position: shapes (dim,) and (dim, dim)."""
        dim = self.dim
        self.x[:dim] = position_m
        self.x[dim:] = 0.0
        self.P[:] = 0.0
        self.P[:dim, :dim] = covariance_m2
        self.P[range(dim, 2 * dim), range(dim, 2 * dim)] = speed_variance
        self.whole[:] = 0
        self.statistics[:] = (1.0, self.settings[SETTING_VARIANCE], 0.0, 1.0)

    @property
    def lost(self) -> bool:
        """Whether so many differences do not fit that the state must be wrong."""
        return bool(self.statistics[REJECTED_SHARE] > LOST_SHARE)

    @property
    def rejected_share(self) -> float:
        """Part of the last differences, about fifty, that lay beyond the gate."""
        return float(self.statistics[REJECTED_SHARE])

    def set_gate(self, gate: float) -> None:
        """Use another gate from now on, in standard deviations."""
        self.settings[SETTING_GATE] = gate

    def horizontal_variance_m2(self, ahead_s: float) -> float:
        """Sum of the variances of x and y so much later, if nothing is heard until then."""
        return horizontal_variance(self.P, self.dim, ahead_s, self.settings[SETTING_QA] * self.statistics[AGILITY])

    def hear(self, a_m: Vector, b_m: Vector, dt_s: float, tdoa_m: float) -> bool:
        """Take one difference, ``dt_s`` after the last one (``pair_update``)."""
        return pair_update(
            self.x, self.P, self.whole, self.statistics, self.settings, self.h, self.ph, a_m, b_m, dt_s, tdoa_m
        )
