"""What plain loops under Numba take: the floor beside which ``skyless bench`` sets the kernels' own speed.

Nothing but the arithmetic: no gate, no running means, no epochs in integers, nobody who joins or leaves.
"""

import numpy as np

from skyless.kernels.arrays import Integers, Matrix, Vector
from skyless.kernels.compiled import threaded_kernel


@threaded_kernel
def joint_filter(
    x: Vector,
    P: Matrix,
    anchors_m: Matrix,
    senders: Integers,
    dt_s: Vector,
    pseudoranges_m: Vector,
    sync_m: Vector,
    variance: float,
    noise: Vector,
) -> float:
    """Four states of motion and an offset and a rate of seven anchors: own reception, and what was heard of anchor 0.

    ``pseudoranges_m`` are those of the tag, ``sync_m`` the sender's clock less anchor 0's as the sender measured it.
    ``x`` is [x, y, vx, vy, (offset, rate) of each], shape (18,), ``P`` (18, 18).
    """
    n = 18
    h, ph = np.zeros(n), np.zeros(n)
    for k in range(len(dt_s)):
        _elapse(x, P, 2, 7, dt_s[k], noise)
        sender = senders[k]
        dx, dy = x[0] - anchors_m[sender, 0], x[1] - anchors_m[sender, 1]
        dz = anchors_m[sender, 2]
        range_m = np.sqrt(dx * dx + dy * dy + dz * dz)
        for place in range(n):
            h[place] = 0.0
        h[0], h[1] = dx / range_m, dy / range_m
        h[4 + 2 * sender] = 1.0
        _update(x, P, h, ph, pseudoranges_m[k] - range_m - x[4 + 2 * sender], variance)
        if sender != 0:
            h[0] = h[1] = 0.0
            h[4] = -1.0
            _update(x, P, h, ph, sync_m[k] - (x[4 + 2 * sender] - x[4]), variance)
    return float(x[0])


@threaded_kernel
def _elapse(x: Vector, P: Matrix, dim: int, clocks: int, dt: float, noise: Vector) -> None:
    """F·P·Fᵀ + Q, pair by pair of a value and its rate."""
    n = len(x)
    for pair in range(dim + clocks):
        value = pair if pair < dim else 2 * dim + 2 * (pair - dim)
        rate = dim + pair if pair < dim else value + 1
        x[value] += dt * x[rate]
        for column in range(n):
            P[value, column] += dt * P[rate, column]
        for row in range(n):
            P[row, value] += dt * P[row, rate]
        white = 0.0 if pair < dim else noise[1]
        walk = noise[0] if pair < dim else noise[2]
        P[value, value] += white * dt + walk * dt * dt * dt / 3.0
        P[value, rate] += walk * dt * dt / 2.0
        P[rate, value] += walk * dt * dt / 2.0
        P[rate, rate] += walk * dt


@threaded_kernel
def _update(x: Vector, P: Matrix, h: Vector, ph: Vector, innovation: float, variance: float) -> None:
    n = len(x)
    ph[:] = 0.0
    for row in range(n):
        if h[row] != 0.0:  # of P, symmetric, the few rows that count
            for column in range(n):
                ph[column] += h[row] * P[row, column]
    spread = variance
    for row in range(n):
        spread += h[row] * ph[row]
    for row in range(n):
        gain = ph[row] / spread
        x[row] += gain * innovation
        for column in range(n):
            P[row, column] -= gain * ph[column]
