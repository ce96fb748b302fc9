"""The baseline of recorded flights: a gated constant-velocity extended Kalman filter of time differences, compiled.

It is ``PlainFilter`` over a whole recording at once. It starts at the truth, knows no faults and never starts again.
"""

import numpy as np
from numba import njit

TDOA_STD_M = 0.22
GATE = 3.0
QA = 2.0
"""Density of the acceleration, m²/s³. From 1 to 9 errors of most flights change by less than a tenth; from 4 on some
noisy logs diverge."""

START_STD_M = 0.1
START_STD_MPS = 0.1


def plain_positions(t_s, a_m, b_m, tdoa_m, start_m, start_mps, qa=QA):
    """Positions after each difference, shape (n, 3), and how many differences the gate let through.

    ``a_m`` and ``b_m`` are the anchors' places, shape (n, 3); a difference is the range to b less the range to a.
    """
    x = np.concatenate([start_m, start_mps])
    P = np.diag(np.repeat([START_STD_M**2, START_STD_MPS**2], 3))
    positions_m = np.empty((len(t_s), 3))
    used = _run(t_s, a_m, b_m, tdoa_m, x, P, qa, TDOA_STD_M**2, GATE**2, positions_m)
    return positions_m, used


@njit(cache=True)
def _run(t_s, a_m, b_m, tdoa_m, x, P, qa, variance_m2, gate_squared, positions_m):
    F, Q, H = np.eye(6), np.zeros((6, 6)), np.zeros(6)
    last_s, used = t_s[0], 0
    for k in range(len(t_s)):
        dt_s = t_s[k] - last_s
        last_s = t_s[k]
        for i in range(3):
            F[i, i + 3] = dt_s
            Q[i, i] = qa * dt_s**3 / 3
            Q[i, i + 3] = Q[i + 3, i] = qa * dt_s**2 / 2
            Q[i + 3, i + 3] = qa * dt_s
        x[:] = F @ x
        P[:] = F @ P @ F.T + Q
        to_a, to_b = x[:3] - a_m[k], x[:3] - b_m[k]
        range_a, range_b = np.linalg.norm(to_a), np.linalg.norm(to_b)
        H[:3] = to_b / range_b - to_a / range_a
        PH = P @ H
        spread = H @ PH + variance_m2
        innovation = tdoa_m[k] - (range_b - range_a)
        if innovation**2 <= gate_squared * spread:
            x += PH * (innovation / spread)
            P -= np.outer(PH, PH) / spread
            P[:] = (P + P.T) / 2
            used += 1
        positions_m[k] = x[:3]
    return used
