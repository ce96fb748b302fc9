"""Inner steps of the filters: a constant-velocity state with an optional clock, and the scalar update.

A state vector is ``[position (dim), velocity (dim), clock offset, clock rate]``; without a clock the last two are
absent. All arrays belong to the caller and nothing is allocated.
"""

import numpy as np
from numpy.typing import NDArray

from skyless.compiled import borrowing_kernel

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@borrowing_kernel
def predict_motion(x: Vector, P: Matrix, dim: int, dt_s: float, qa: float) -> None:
    """Advance position and velocity; ``qa`` is the acceleration's spectral density in m²/s³ per axis."""
    for axis in range(dim):
        _shear(x, P, axis, dim + axis, dt_s)
        _add_noise(P, axis, dim + axis, dt_s, 0.0, qa)


@borrowing_kernel
def horizontal_variance(P: Matrix, dim: int, dt_s: float, qa: float) -> float:
    """Sum of the variances of x and y that ``predict_motion`` would give, m²."""
    total = 2.0 * qa * dt_s * dt_s * dt_s / 3.0
    for axis in range(2):
        total += P[axis, axis] + dt_s * (2.0 * P[axis, dim + axis] + dt_s * P[dim + axis, dim + axis])
    return float(total)


@borrowing_kernel
def predict_clock(x: Vector, P: Matrix, offset: int, dt_s: float, white: float, walk: float) -> None:
    """Advance the clock whose offset (m) and rate (m/s) stand at ``offset`` and ``offset + 1``."""
    _shear(x, P, offset, offset + 1, dt_s)
    _add_noise(P, offset, offset + 1, dt_s, white, walk)


@borrowing_kernel
def _shear(x: Vector, P: Matrix, i: int, j: int, dt_s: float) -> None:
    """x_i += dt·x_j, and P accordingly, as F·P·Fᵀ."""
    x[i] += dt_s * x[j]
    n = x.shape[0]
    for column in range(n):
        P[i, column] += dt_s * P[j, column]
    for row in range(n):
        P[row, i] += dt_s * P[row, j]


@borrowing_kernel
def _add_noise(P: Matrix, i: int, j: int, dt_s: float, white: float, walk: float) -> None:
    half = walk * dt_s * dt_s / 2.0
    P[i, i] += white * dt_s + walk * dt_s * dt_s * dt_s / 3.0
    P[i, j] += half
    P[j, i] += half
    P[j, j] += walk * dt_s


@borrowing_kernel
def innovation_variance(P: Matrix, h: Vector, ph: Vector, variance: float) -> float:
    """Fill ``ph`` with P·h and return hᵀ·P·h + variance."""
    n = h.shape[0]
    total = variance
    for row in range(n):
        value = 0.0
        for column in range(n):
            value += P[row, column] * h[column]
        ph[row] = value
        total += h[row] * value
    return total


@borrowing_kernel
def correct(x: Vector, P: Matrix, ph: Vector, innovation: float, spread: float) -> None:
    """Scalar Kalman update with gain ph / spread; the covariance stays exactly symmetric."""
    n = x.shape[0]
    for row in range(n):
        gain = ph[row] / spread
        x[row] += gain * innovation
        for column in range(row, n):
            P[row, column] -= gain * ph[column]
            P[column, row] = P[row, column]


@borrowing_kernel
def range_and_direction(x: Vector, dim: int, height_m: float, anchor_m: Vector, h: Vector, sign: float) -> float:
    """Range from the state's position to an anchor; adds ``sign`` times its gradient to ``h``.

    With ``dim`` 2 the tag moves at ``height_m``; with 3 the height is a state.
    """
    dx = x[0] - anchor_m[0]
    dy = x[1] - anchor_m[1]
    dz = (x[2] if dim == 3 else height_m) - anchor_m[2]
    range_m = np.sqrt(dx * dx + dy * dy + dz * dz)
    scale = sign / max(range_m, 1e-6)
    h[0] += scale * dx
    h[1] += scale * dy
    if dim == 3:
        h[2] += scale * dz
    return float(range_m)
