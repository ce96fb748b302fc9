"""Which anchors' faults explain ``joint``'s innovations best (``docs/maths.md`` section 6).

Let y be what innovations say of each anchor's lateness, Σwsν, and M the information Σwss' in it, together
for all anchors. Faults of a set of anchors explain the innovations by yᵀM⁻¹y, rows and columns of that set: twice the
logarithm of the generalised likelihood ratio (Willsky and Jones 1976), here for one anchor and for two.
"""

from typing import Final

from skyless.compiled import borrowing_kernel
from skyless.positioning.joint_state import (
    DIM,
    EVIDENCE,
    EXCLUDED,
    EXCLUSIONS,
    IN_ROW,
    READMISSIONS,
    REFUSED,
    REJECTIONS,
    SLOTS,
    JointArrays,
)

SECOND: Final = 15.0
"""So much more, by twice the logarithm, two faults have to explain than one."""

EARLY: Final = 10.0
"""And an anchor that seems early, as obstacles make them late."""

FAULTY: Final = 15.0
"""So much one fault has to explain before an anchor is left out, ..."""

CHANGE: Final = 15.0
"""Of other anchors than those that are left out, unless innovations of one that is not are off."""

LEAST_INFORMATION: Final = 1e-9
APART: Final = 0.02
"""Two faults are told apart where they share less than all but this part of their information."""


@borrowing_kernel
def exclude_likeliest(s: JointArrays, margin: float) -> bool:
    """Leave out the one or two anchors whose faults explain most, and no others; whether that changes anything.

    Nothing changes if they explain less than ``margin`` more than those that are out now, or none can be spared.
    """
    spare, excluded = s.counts[SLOTS] - int(s.settings[DIM]) - 1, 0
    for slot in range(s.counts[SLOTS]):
        excluded += s.slots[slot, EXCLUDED]
    first, second, most, now = -1, -1, FAULTY, 0.0
    for one in range(s.counts[SLOTS]):
        for other in range(one + 1):
            faults = 1 if one == other else 2
            explained = _explained(s, one, other)
            if explained > most and 2 * faults <= spare + 1:
                first, second, most = one, other, explained
            if faults == excluded and s.slots[one, EXCLUDED] and s.slots[other, EXCLUDED]:
                now = explained
    return bool(first >= 0 and most >= now + margin and _leave_out(s, first, second))


@borrowing_kernel
def _explained(s: JointArrays, one: int, other: int) -> float:
    """Twice the logarithm of the likelihood ratio of faults of two anchors, or of one, less what speaks against it."""
    a, y = max(-s.shared[one, one], LEAST_INFORMATION), _innovations(s, one)
    if one == other:
        return float(y * y / a - (EARLY if y < 0.0 else 0.0))
    b, z = max(-s.shared[other, other], LEAST_INFORMATION), _innovations(s, other)
    both = -s.shared[one, other]
    determinant = a * b - both * both
    if determinant < APART * a * b:
        return 0.0
    one_m, other_m = (b * y - both * z) / determinant, (a * z - both * y) / determinant
    against = SECOND + (EARLY if one_m < 0.0 else 0.0) + (EARLY if other_m < 0.0 else 0.0)
    return float(one_m * y + other_m * z - against)


@borrowing_kernel
def _innovations(s: JointArrays, slot: int) -> float:
    return float(s.evidence[EVIDENCE, slot] + s.evidence[REFUSED, slot])


@borrowing_kernel
def _leave_out(s: JointArrays, one: int, other: int) -> bool:
    """Leave these out and no others; False if it is so already."""
    changed = False
    for slot in range(s.counts[SLOTS]):
        out = slot in (one, other)
        if out and not s.slots[slot, EXCLUDED]:
            s.slots[slot, EXCLUDED] = 1
            s.slots[slot, IN_ROW] = 0
            s.counts[EXCLUSIONS] += 1
            changed = True
        elif s.slots[slot, EXCLUDED] and not out:
            take_back(s, slot)
            changed = True
    return changed


@borrowing_kernel
def take_back(s: JointArrays, slot: int) -> None:
    """Use an anchor again that was left out."""
    s.slots[slot, EXCLUDED] = 0
    s.evidence[REJECTIONS, slot] = 0.0
    s.counts[READMISSIONS] += 1
