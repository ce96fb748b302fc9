"""Gauss–Newton steps, damped after Levenberg and Marquardt where they fail, to a minimum of TDoAs' residuals."""

from typing import Final

from skyless.core.native.arithmetic import sqrt
from skyless.core.native.records import Reals
from skyless.core.native.small_matrices import factorise, solve
from skyless.core.tag.problem import PLANE, LocateProblem

CONVERGED, UNDETERMINED, DIVERGED, EXHAUSTED = range(4)
"""How the iteration ended: in a minimum, where the unknowns are not determined, on its way to infinity, or not at all
after ``MAX_ITERATIONS``."""
MAX_ITERATIONS: Final = 200
# The iteration ends with a step below this part of the anchors' extent (1 nm in 10 m).
STEP_TOLERANCE: Final = 1e-10
# It also ends where a step promises to lower the cost by less than this part: steps of 10⁻⁷ sigma.
GAIN_TOLERANCE: Final = 1e-13
FAR_EXTENTS: Final = 1e4  # nobody locates a tag at ten thousand times the anchors' extent
FIRST_DAMPING: Final = 1e-2
MIN_DAMPING: Final = 1e-4  # smaller damping is none
NEAREST_M2: Final = 1e-18
"""A smaller square of a distance counts as this."""


def descend(p: LocateProblem) -> int:
    """Move the state to the minimum of its surroundings; returns how it ended."""
    gradient = p.dims * (p.dims + 1) // 2
    cost = assemble(p, p.state, p.normal)
    damping, growth = 0.0, 2.0
    for j in range(3):
        p.trial[j] = p.state[j]
    for iteration in range(1, MAX_ITERATIONS + 1):
        p.iterations = iteration
        if not _find_damped_step(p, damping):
            if damping > 1.0:
                return UNDETERMINED
            damping = max(10.0 * damping, FIRST_DAMPING)
            continue
        predicted, longest = 0.0, 0.0
        for j in range(p.dims):
            p.trial[j] = p.state[j] + p.step[j]
            predicted += p.step[j] * (p.normal[gradient + j] + damping * p.normal[j * (j + 3) // 2] * p.step[j])
            longest = max(longest, abs(p.step[j]) / p.scale[j])
        is_small = longest <= STEP_TOLERANCE or predicted <= GAIN_TOLERANCE * cost
        next_cost = assemble(p, p.trial, p.next_normal)
        if next_cost < cost:
            damping, growth = _eased(damping, (cost - next_cost) / predicted if predicted > 0.0 else 1.0), 2.0
            cost = next_cost
            for j in range(p.dims):
                p.state[j] = p.trial[j]
            for k in range(gradient + p.dims):
                p.normal[k] = p.next_normal[k]
        else:
            damping, growth = max(growth * damping, FIRST_DAMPING), 2.0 * growth
        if is_small:
            return CONVERGED
        if _is_far(p):
            return DIVERGED
    return EXHAUSTED


def assemble(p: LocateProblem, state: Reals, normal: Reals) -> float:
    """Linearise, whiten where it is weighted, and write systemᵀ·system into ``normal``; returns the cost."""
    linearise(p, state)
    if p.is_weighted:
        whiten_system(p)
    element = 0
    for j in range(p.dims + 1):
        for k in range(j + 1):
            total = 0.0
            for i in range(p.anchors - 1):
                total += p.system[i][j] * p.system[i][k]
            normal[element] = total
            element += 1
    return normal[element - 1]


def linearise(p: LocateProblem, state: Reals) -> None:
    """Write ``system``; an anchor at the very position has no direction and counts with zeros."""
    reference_m, reference_x, reference_y, reference_z = 0.0, 0.0, 0.0, 0.0
    for i in range(p.anchors):
        anchor = p.anchors_m[i]
        x, y, z = state[0] - anchor[0], state[1] - anchor[1], state[2] - anchor[2]
        across = state[2] if p.kind == PLANE else z * z
        distance_m = sqrt(max(x * x + y * y + across, NEAREST_M2))
        x /= distance_m
        y /= distance_m
        z = (0.5 if p.kind == PLANE else z) / distance_m
        if i == 0:
            reference_m, reference_x, reference_y, reference_z = distance_m, x, y, z
        else:
            row = p.system[i - 1]
            row[2] = z - reference_z  # and then the residual, where the height is given
            row[0] = x - reference_x
            row[1] = y - reference_y
            row[p.dims] = p.tdoa_m[i - 1] - (distance_m - reference_m)


def whiten_system(p: LocateProblem) -> None:
    """Replace ``system`` by L⁻¹·system."""
    for i in range(p.anchors - 1):
        first = i * (i + 1) // 2
        row = p.system[i]
        for j in range(p.dims + 1):
            total = row[j]
            for k in range(i):
                total -= p.covariance[first + k] * p.system[k][j]
            row[j] = total / p.covariance[first + i]


def _find_damped_step(p: LocateProblem, damping: float) -> bool:
    """Solve (N + damping·diag N)·step = gradient; False where the matrix is singular."""
    gradient = p.dims * (p.dims + 1) // 2
    for k in range(gradient):
        p.factor[k] = p.normal[k]
    for j in range(p.dims):
        p.factor[j * (j + 3) // 2] *= 1.0 + damping
        p.step[j] = p.normal[gradient + j]
    if not factorise(p.factor, p.dims):
        return False
    solve(p.factor, p.dims, p.step)
    return True


def _is_far(p: LocateProblem) -> bool:
    """Whether the state has left for infinity, or is no number."""
    for j in range(p.dims):
        reach = abs(p.state[j]) / p.scale[j]
        if not (sqrt(reach) if p.kind == PLANE and j == 2 else reach) < FAR_EXTENTS:
            return True
    return False


def _eased(damping: float, ratio: float) -> float:
    """Next damping after a success, by the ratio of what it gained to what was predicted (H. B. Nielsen 1999)."""
    if ratio < 0.5:
        damping = max(damping, FIRST_DAMPING)
    excess = 2.0 * ratio - 1.0
    eased = damping * max(1.0 / 3.0, 1.0 - excess * excess * excess)
    return eased if eased > MIN_DAMPING else 0.0
