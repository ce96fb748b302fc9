"""Protection levels: how wrong a position may be, whatever is late (``docs/maths.md`` section 8).

Hypothesis: the tag's receptions of every anchor are late (or early) by a constant of its own, all at once. With the
faults b̂ and their sensitivities V (``faults``) the estimate under the hypothesis and its covariance are

    x + V·b̂        P + V·(M + I/σ_f²)⁻¹·Vᵀ

so the error exceeds |V·b̂| + k·σ with the stated risk only, whichever anchors are at fault. Two kinds are looked at:
constants since an anchor joined, and what has begun lately. What is larger than σ_f shows, as a jump or in
yᵀ·(M + I/σ_f²)⁻¹·y, which is χ² without faults; then there is no number.
"""

from typing import Final

import numpy as np

from skyless.compiled import kernel
from skyless.positioning.estimator.faults import solve
from skyless.positioning.estimator.monitor import covariance_scale
from skyless.positioning.estimator.state import EstimatorState, Matrix, Vector

RECENT_STD_M: Final = 0.08
"""Of a fault that has begun lately without a jump that shows."""

HPL, VPL, LASTING_CHI2, RECENT_CHI2 = range(4)
"""What ``protect`` writes."""

LEVELS: Final = 4


@kernel
def protect(s: EstimatorState, horizontal_k: float, vertical_k: float, work: Matrix, levels: Vector) -> None:
    """Write the levels in metres and the tests of faults; ``work`` has shape (2·anchors + 8, anchors).

    ``horizontal_k`` and ``vertical_k`` are how many standard deviations the risk allows.
    """
    dim, count, P, V = s.settings[0]["dim"], len(s.anchors), s.P, s.V
    scale = covariance_scale(s)
    levels[HPL] = levels[VPL] = 0.0
    for bank in range(2):
        std_m = s.status[0]["fault_std_m"] if bank == 0 else RECENT_STD_M
        begin = bank * count
        for one in range(count):
            for other in range(count):
                work[one, other] = s.information[bank, one, other]
            work[one, one] += 1.0 / (std_m * std_m)
            work[count, one] = s.evidence[bank, one]
            for axis in range(dim):
                work[count + 1 + axis, one] = V[begin + one, axis]
        solve(work, count, 1 + dim)
        chi2, shift_x, shift_y, shift_z = 0.0, 0.0, 0.0, 0.0
        xx, xy, yy, zz = scale * P[0, 0], scale * P[0, 1], scale * P[1, 1], 0.0
        for one in range(count):
            fault_m = work[count, one]
            chi2 += s.evidence[bank, one] * fault_m
            vx, vy = V[begin + one, 0], V[begin + one, 1]
            shift_x += vx * fault_m
            shift_y += vy * fault_m
            xx += vx * work[count + 1, one]
            xy += vx * work[count + 2, one]
            yy += vy * work[count + 2, one]
            if dim == 3:
                shift_z += V[begin + one, 2] * fault_m
                zz += V[begin + one, 2] * work[count + 3, one]
        largest = 0.5 * (xx + yy) + np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        levels[HPL] = max(levels[HPL], np.hypot(shift_x, shift_y) + horizontal_k * np.sqrt(largest))
        if dim == 3:
            levels[VPL] = max(levels[VPL], abs(shift_z) + vertical_k * np.sqrt(scale * P[2, 2] + zz))
        levels[LASTING_CHI2 + bank] = chi2
    acceleration = s.settings[0]["max_acceleration_mps2"]
    if acceleration > 0.0:
        squared, up = 0.0, 0.0
        for column in range(2 * count, 2 * count + dim):
            squared += V[column, 0] ** 2 + V[column, 1] ** 2
            if dim == 3:
                up += V[column, 2] ** 2
        levels[HPL] += acceleration * np.sqrt(squared)
        levels[VPL] += acceleration * np.sqrt(up)
