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

from skyless.kernels.arrays import Vector
from skyless.kernels.compiled import step
from skyless.positioning.estimator.faults import whiten
from skyless.positioning.estimator.monitor import covariance_scale
from skyless.positioning.estimator.state import EstimatorState

RECENT_STD_M: Final = 0.08
"""Of a fault that has begun lately without a jump that shows."""

HPL, VPL, LASTING_CHI2, RECENT_CHI2 = range(4)
"""What ``protect`` writes."""

LEVELS: Final = 4


@step
def protect(s: EstimatorState, levels: Vector) -> None:
    """Write the levels in metres and the tests of faults."""
    settings = s.settings[0]
    dim, count = settings["dim"], len(s.anchors)
    scale = covariance_scale(s)
    levels[HPL] = levels[VPL] = 0.0
    for bank in range(2):
        std_m = s.status[0]["fault_std_m"] if bank == 0 else RECENT_STD_M
        begin = bank * count
        for one in range(count):
            for other in range(count):
                s.work[one, other] = s.information[bank, one, other]
            s.work[one, one] += 1.0 / (std_m * std_m)
            s.work[count, one] = s.evidence[bank, one]
            for axis in range(dim):
                s.work[count + 1 + axis, one] = s.V[begin + one, axis]
        whiten(s.work, count, 1 + dim)
        chi2, shift_x, shift_y, shift_z = 0.0, 0.0, 0.0, 0.0
        xx, xy, yy, zz = scale * s.P[0, 0], scale * s.P[0, 1], scale * s.P[1, 1], 0.0
        for one in range(count):
            fault, vx, vy = s.work[count, one], s.work[count + 1, one], s.work[count + 2, one]
            chi2 += fault * fault
            shift_x += vx * fault
            shift_y += vy * fault
            xx += vx * vx
            xy += vx * vy
            yy += vy * vy
            if dim == 3:
                vz = s.work[count + 3, one]
                shift_z += vz * fault
                zz += vz * vz
        largest = 0.5 * (xx + yy) + np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        levels[HPL] = max(levels[HPL], np.hypot(shift_x, shift_y) + settings["horizontal_k"] * np.sqrt(largest))
        if dim == 3:
            levels[VPL] = max(levels[VPL], abs(shift_z) + settings["vertical_k"] * np.sqrt(scale * s.P[2, 2] + zz))
        levels[LASTING_CHI2 + bank] = chi2
    squared, up = 0.0, 0.0
    for column in range(2 * count, 2 * count + dim):
        squared += s.V[column, 0] ** 2 + s.V[column, 1] ** 2
        if dim == 3:
            up += s.V[column, 2] ** 2
    levels[HPL] += s.settings[0]["max_acceleration_mps2"] * np.sqrt(squared)
    levels[VPL] += s.settings[0]["max_acceleration_mps2"] * np.sqrt(up)
