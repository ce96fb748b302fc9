"""What ``joint`` is compared with: extended Kalman filters of position and velocity, with two rules of gating.

Both get time differences, start at the truth where it is known, know no faults and never start again.

- *Gate*: a difference is used if its innovation is within three standard deviations of what the filter expects.
- *Bitcraze*: the rule of its firmware since 2023, as described in "New Loco TDoA outlier filter"
  (https://www.bitcraze.io/2023/03/new-loco-tdoa-outlier-filter/): a difference that exceeds the distance of its anchors
  is refused; an error up to two standard deviations of a measurement adds the time since the one before to a sum of at
  most 0.3 s, a larger one subtracts it. The filter closes when the sum is nearly full, and then refuses errors of more
  than two and a half standard deviations; it opens again when the sum is nearly empty.
"""

from typing import Final

import numpy as np

from skyless.core.arrays import Array, Matrix, Vector
from skyless.site.kernels import kernel

GATE, BITCRAZE = range(2)
TDOA_STD_M: Final = {GATE: 0.22, BITCRAZE: 0.15}
"""Noise of a difference: without tuning, and the default of Bitcraze's firmware."""

QA_M2PS3: Final = 2.0
"""Density of the acceleration. From 1 to 9 errors of most flights change by less than a tenth; from 4 on some noisy
logs diverge."""

GATE_STD: Final = 3.0
START_STD_M: Final = 0.1
START_STD_MPS: Final = 0.1
SUM_S: Final = 0.3
LONGEST_ADDED_S: Final = 0.03
CLOSES, OPENS = 0.9, 0.1
TRUSTED_STD, ACCEPTED_STD = 2.0, 2.5


def plain_track(
    rule: int, time_s: Vector, tdoa_m: Vector, a_m: Matrix, b_m: Matrix, start: Vector, is_planar: bool
) -> tuple[Matrix, Array]:
    """Positions after each of n differences, shape (n, 3), and their covariances, shape (n, 3, 3).

    ``a_m`` and ``b_m``: the anchors' positions, shape (n, 3); a difference is the range to b less that to a. ``start``:
    position and velocity, shape (6,); the height stays as it is where ``is_planar``.
    """
    axes = np.array([1.0, 1.0, 0.0 if is_planar else 1.0])
    P = np.diag(np.concatenate([axes * START_STD_M**2, axes * START_STD_MPS**2]))
    positions_m, covariances_m2 = np.empty((len(time_s), 3)), np.empty((len(time_s), 3, 3))
    a_m, b_m, qa = np.ascontiguousarray(a_m), np.ascontiguousarray(b_m), QA_M2PS3 * axes
    time_s, tdoa_m = np.ascontiguousarray(time_s), np.ascontiguousarray(tdoa_m)
    _run(time_s, tdoa_m, a_m, b_m, rule, TDOA_STD_M[rule], qa, start.copy(), P, positions_m, covariances_m2)
    return positions_m, covariances_m2


@kernel
def _run(
    time_s: Vector,
    tdoa_m: Vector,
    a_m: Matrix,
    b_m: Matrix,
    rule: int,
    std_m: float,
    qa: Vector,
    x: Vector,
    P: Matrix,
    positions_m: Matrix,
    covariances_m2: Array,
) -> None:
    F, Q, H = np.eye(6), np.zeros((6, 6)), np.zeros(6)
    last_s, good_s, is_open = time_s[0], 0.0, True
    for n in range(len(time_s)):
        dt_s = time_s[n] - last_s
        last_s = time_s[n]
        for i in range(3):
            F[i, i + 3] = dt_s
            Q[i, i] = qa[i] * dt_s**3 / 3
            Q[i, i + 3] = Q[i + 3, i] = qa[i] * dt_s**2 / 2
            Q[i + 3, i + 3] = qa[i] * dt_s
        x[:] = F @ x
        P[:] = F @ P @ F.T + Q
        to_a, to_b = x[:3] - a_m[n], x[:3] - b_m[n]
        range_a, range_b = np.linalg.norm(to_a), np.linalg.norm(to_b)
        H[:3] = to_b / range_b - to_a / range_a
        PH = P @ H
        S = H @ PH + std_m * std_m
        innovation = tdoa_m[n] - (range_b - range_a)
        if rule == GATE:
            used = innovation * innovation <= GATE_STD * GATE_STD * S
        elif abs(tdoa_m[n]) >= np.linalg.norm(a_m[n] - b_m[n]):
            used = False
        else:
            added_s = min(dt_s, LONGEST_ADDED_S)
            if abs(innovation) < TRUSTED_STD * std_m:
                good_s = min(good_s + added_s, SUM_S)
            else:
                good_s = max(good_s - added_s, 0.0)
            used = is_open or abs(innovation) < ACCEPTED_STD * std_m
            is_open = good_s <= CLOSES * SUM_S if is_open else good_s < OPENS * SUM_S
        if used:
            x += PH * (innovation / S)
            P -= np.outer(PH, PH) / S
            P[:] = (P + P.T) / 2
        positions_m[n] = x[:3]
        covariances_m2[n] = P[:3, :3]
