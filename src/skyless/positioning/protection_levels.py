"""Protection levels from what ``protection_updates`` follows: ``joint``'s kernels (``docs/maths.md`` section 8)."""

from typing import Final

import numpy as np

from skyless.compiled import borrowing_kernel
from skyless.constants import TICK_S
from skyless.positioning.joint_state import (
    BASE,
    DIM,
    EPOCH,
    EVIDENCE,
    EXCLUDED,
    IN_ROW,
    PACKETS,
    REJECTIONS,
    RELAYS_IN_ROW,
    RELAYS_REFUSED,
    RELAYS_TAKEN,
    SLOTS,
    JointArrays,
    Matrix,
    Vector,
    values,
)
from skyless.positioning.protection_updates import LONG
from skyless.positioning.tracker import CHI2, RESTLESS_CHI2

SETTLED: Final = 0.5
"""Share of the long memory that must be filled: until then faults that led to the start may still be at work."""

REJECTED_OFTEN: Final = 1.5
"""Two packets of an anchor beyond the gate lately: with noise alone once in 10⁶ times."""

RELAYS_OFF: Final = 4
"""So many receptions among anchors in a row beyond the gate are due to the clock of one of them, ..."""

REFUSED_SHARE: Final = 0.25
FEW: Final = 4.0
"""... and this share of all, and more than so many, to clocks that are not what the filter says."""

HORIZONTAL_K, VERTICAL_K, FAULT_T = range(3)
"""Places in the array of limits."""

LIMITS: Final = 3

HPL, VPL, STATE, WORST_T, WORST_SLOT = range(5)
"""Places among the levels."""

LEVELS: Final = 5

LEAST_INFORMATION: Final = 1e-12
"""Of a fault's size, 1/m²: with less nothing is known of it, ..."""

NEGLIGIBLE: Final = 1e-6
"""... which harms where more than this part of it is in the position. What an anchor did that has been out for half a
minute is neither; after a few more the sums would be too small for floating point."""

REJECTED_ONCE: Final = 0.3
SUSPICIOUS: Final = 0.6
"""Where a packet of an anchor was rejected lately, the threshold for its fault is lower by this factor."""

DOUBTFUL: Final = 0.45
GROWING: Final = 1.5
"""A fault beyond this share of the threshold may be growing faster than its estimate: it counts so many times."""

OUT_IN_ROW: Final = 3
"""An anchor is out while the monitor leaves it out, or its packets are rejected one after the other, ..."""

MOST_BOUNDED: Final = 2.0
"""... and one whose fault is still in the fix is covered by the levels while none is rejected, up to this times the
threshold."""

NOTHING, LEFT_OUT, BOUNDED, DETECTED, UNAVAILABLE = range(5)
"""States: no fault; one whose anchor is out; one in the fix, which the levels cover, or do not; too early to say."""


@borrowing_kernel
def protect(s: JointArrays, covariance: Matrix, limits: Vector, levels: Vector) -> None:
    """Fill in ``levels`` for the newest message; ``covariance`` is that of ``joint_motion``."""
    dim, half = int(s.settings[DIM]), values(s)
    tau_s = (s.counts[EPOCH] - s.counts[BASE]) * TICK_S
    chi2 = s.statistics[CHI2]
    scale = chi2 * chi2 if chi2 > RESTLESS_CHI2 else 1.0
    xx, xy, yy = scale * covariance[0, 0], scale * covariance[0, 1], scale * covariance[1, 1]
    zz = scale * covariance[2, 2] if dim == 3 else 0.0
    hpl = limits[HORIZONTAL_K] * np.sqrt(_major(xx, xy, yy))
    vpl = limits[VERTICAL_K] * np.sqrt(zz)
    V, worst_t, worst_slot = s.sensitivities, 0.0, -1
    for slot in range(s.counts[SLOTS]):
        vx = V[0, slot] + tau_s * V[half, slot]
        vy = V[1, slot] + tau_s * V[half + 1, slot]
        vz = V[2, slot] + tau_s * V[half + 2, slot] if dim == 3 else 0.0
        across = np.sqrt(vx * vx + vy * vy)
        for memory in range(0, 2 * EVIDENCE, EVIDENCE):
            information = s.evidence[memory + 1, slot]
            if information > LEAST_INFORMATION:
                fault_m = abs(s.evidence[memory, slot]) / information
                variance = scale * s.evidence[memory + 2, slot] / (information * information)
                t = fault_m / np.sqrt(variance)
                if t > worst_t and not s.slots[slot, EXCLUDED]:
                    worst_t, worst_slot = t, slot
                if t > DOUBTFUL * limits[FAULT_T]:
                    fault_m *= GROWING
                major = _major(xx + vx * vx * variance, xy + vx * vy * variance, yy + vy * vy * variance)
                hpl = max(hpl, across * fault_m + limits[HORIZONTAL_K] * np.sqrt(major))
                vpl = max(vpl, abs(vz) * fault_m + limits[VERTICAL_K] * np.sqrt(zz + vz * vz * variance))
            elif across > NEGLIGIBLE or abs(vz) > NEGLIGIBLE:
                hpl, vpl = np.inf, np.inf
    levels[STATE] = _state(s, worst_t, worst_slot, limits[FAULT_T], hpl)
    levels[HPL], levels[VPL], levels[WORST_T], levels[WORST_SLOT] = hpl, vpl, worst_t, worst_slot


@borrowing_kernel
def _major(xx: float, xy: float, yy: float) -> float:
    """Largest eigenvalue of a covariance."""
    half = 0.5 * (xx - yy)
    return float(0.5 * (xx + yy) + np.sqrt(half * half + xy * xy))


@borrowing_kernel
def _state(s: JointArrays, worst_t: float, worst_slot: int, most_t: float, hpl: float) -> int:
    """Whether a fault shows, in the innovations or in what was rejected, and whether it is one that can be left out."""
    if s.recent[PACKETS] < SETTLED * LONG * s.counts[SLOTS] or not np.isfinite(hpl):
        return UNAVAILABLE
    if not _is_determined(s):
        return UNAVAILABLE
    refused = s.recent[RELAYS_REFUSED]
    suspect, suspects = -1, 0
    for slot in range(s.counts[SLOTS]):
        if _is_out(s, slot) or s.evidence[REJECTIONS, slot] > REJECTED_OFTEN:
            suspect = slot
            suspects += 1
    if suspects == 1:
        return _state_with_suspect(s, suspect, worst_t, worst_slot, most_t)
    clocks_wrong = refused > FEW and refused > REFUSED_SHARE * (refused + s.recent[RELAYS_TAKEN])
    if suspects > 1 or clocks_wrong:
        return DETECTED
    return _state_without_rejections(s, worst_t, worst_slot, most_t)


@borrowing_kernel
def _is_determined(s: JointArrays) -> bool:
    """Whether there are anchors enough for a position: what is not seen moves as it likes, unlike what P assumes."""
    used = 0
    for slot in range(s.counts[SLOTS]):
        used += 0 if s.slots[slot, EXCLUDED] or s.slots[slot, IN_ROW] >= OUT_IN_ROW else 1
    return bool(used > int(s.settings[DIM]))


@borrowing_kernel
def _is_out(s: JointArrays, slot: int) -> bool:
    """Whether the monitor leaves an anchor out, or its clock is what its own packets say as relays no longer fit."""
    return bool(s.slots[slot, EXCLUDED] or s.slots[slot, RELAYS_IN_ROW] >= RELAYS_OFF)


@borrowing_kernel
def _state_with_suspect(s: JointArrays, suspect: int, worst_t: float, worst_slot: int, most_t: float) -> int:
    """While one anchor is out, what shows at the others is what it has done to the state before, or its echo."""
    if _is_out(s, suspect):
        return LEFT_OUT if _is_bounded(s, worst_t, worst_slot, most_t) else DETECTED
    out = s.slots[suspect, IN_ROW] >= OUT_IN_ROW
    return LEFT_OUT if out and (worst_t <= most_t or worst_slot == suspect) else DETECTED


@borrowing_kernel
def _state_without_rejections(s: JointArrays, worst_t: float, worst_slot: int, most_t: float) -> int:
    touched = worst_slot >= 0 and s.evidence[REJECTIONS, worst_slot] > REJECTED_ONCE
    if worst_t <= (SUSPICIOUS * most_t if touched else most_t):
        return NOTHING
    return BOUNDED if _is_bounded(s, worst_t, worst_slot, most_t) else DETECTED


@borrowing_kernel
def _is_bounded(s: JointArrays, worst_t: float, worst_slot: int, most_t: float) -> bool:
    """Whether the levels cover what shows: up to a size, of anchors of which nothing was rejected."""
    if worst_t <= most_t:
        return True
    return bool(s.evidence[REJECTIONS, worst_slot] <= REJECTED_ONCE and worst_t <= MOST_BOUNDED * most_t)
