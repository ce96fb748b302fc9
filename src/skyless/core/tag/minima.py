"""The minima of a set of TDoAs, and which of them are distinct."""

from typing import Final

from skyless.core.native.records import Reals
from skyless.core.native.small_matrices import factorise, solve, solve_lower
from skyless.core.tag.descent import CONVERGED, assemble, descend, whiten_system
from skyless.core.tag.problem import MAX_STARTS, PLANE, LocateProblem, Minimum
from skyless.core.tag.starts import add_algebraic_starts, add_central_starts, add_image

# Two iterations ended in one point if that is within this part of the extent, which is far above their tolerance.
SAME_POINT: Final = 1e-6
# A second minimum is a rival while its chi2 is less than this above the best one (a likelihood ratio of 90).
RIVAL_MINIMUM_CHI2: Final = 9.0
# Two minima are distinct where one lies outside the 3-sigma ellipsoid of the other.
DISTINCT_MINIMA_CHI2: Final = 9.0


def find_minima(p: LocateProblem) -> int:
    """Fill ``minima`` with all that are found, the best first; returns how the last iteration that failed ended.

    The closed form's starts depend on the reference and miss about one rival in a hundred; the anchors' centroid
    finds most of these, and the mirror image of what is found the rest where anchors are nearly in one line or plane.
    """
    add_algebraic_starts(p)
    add_central_starts(p)
    status, start = CONVERGED, 0
    while start < p.start_count:
        for k in range(3):
            p.state[k] = p.starts[start][k]
        start += 1
        end = descend(p)
        if end != CONVERGED:
            status = end
        elif not _is_found(p):
            if p.kind != PLANE and p.minimum_count == 0 and p.start_count < MAX_STARTS:
                add_image(p)
            _assess(p)
    return status


def _is_found(p: LocateProblem) -> bool:
    """Whether the state is at a minimum that has been found before."""
    for index in range(p.minimum_count):
        apart = 0.0
        for j in range(p.dims):
            apart += abs(p.minima[index].state[j] - p.state[j]) / p.scale[j]
        if apart < SAME_POINT:
            return True
    return False


def _assess(p: LocateProblem) -> None:
    """Insert the minimum at the state, unless it is singular there.

    Its covariance is G·Σ·Gᵀ with the G of the estimate, (HᵀΣ⁻¹H)⁻¹HᵀΣ⁻¹ or, not weighted, (HᵀH)⁻¹Hᵀ.
    """
    found = Minimum()
    found.iterations = p.iterations
    found.cost = assemble(p, p.state, p.normal)
    for k in range(p.dims * (p.dims + 1) // 2):
        p.factor[k] = p.normal[k]
    if not factorise(p.factor, p.dims):
        return
    for j in range(3):
        found.state[j] = p.state[j]
    for i in range(p.anchors - 1):
        _find_gain(p, i)
        element = 0
        for j in range(p.dims):
            for k in range(j + 1):
                found.covariance[element] += p.step[j] * p.step[k]
                element += 1
    if not found.covariance[p.dims * (p.dims + 1) // 2 - 1] > 0.0:  # too small for a number
        return
    if not p.is_weighted:
        whiten_system(p)
    for i in range(p.anchors - 1):
        found.chi2 += p.system[i][p.dims] * p.system[i][p.dims]
    index = p.minimum_count
    while index > 0 and p.minima[index - 1].cost > found.cost:
        p.minima[index] = p.minima[index - 1]
        index -= 1
    p.minima[index] = found
    p.minimum_count += 1


def _find_gain(p: LocateProblem, index: int) -> None:
    """Write a column of G·L into ``step``; where it is weighted, ``system`` holds L⁻¹·H."""
    for j in range(p.dims):
        if p.is_weighted:
            p.step[j] = p.system[index][j]
        else:
            p.step[j] = 0.0
            for i in range(index, p.anchors - 1):
                p.step[j] += p.system[i][j] * p.covariance[i * (i + 1) // 2 + index]
    solve(p.factor, p.dims, p.step)


def keep_rivals(p: LocateProblem) -> None:
    """Keep the best minimum and those that explain the TDoAs about as well from somewhere else."""
    kept, best = 1, p.minima[0]
    for index in range(1, p.minimum_count):
        other = p.minima[index]
        if other.chi2 <= best.chi2 + RIVAL_MINIMUM_CHI2 and (
            _is_outside(p, best, other.state) or _is_outside(p, other, best.state)
        ):
            p.minima[kept] = p.minima[index]
            kept += 1
    p.minimum_count = kept


def _is_outside(p: LocateProblem, minimum: Minimum, state: Reals) -> bool:
    """Whether a state lies outside a minimum's error ellipsoid."""
    for k in range(p.dims * (p.dims + 1) // 2):
        p.factor[k] = minimum.covariance[k]
    for j in range(p.dims):
        p.step[j] = state[j] - minimum.state[j]
    if not factorise(p.factor, p.dims):
        return True
    solve_lower(p.factor, p.dims, p.step)
    chi2 = 0.0
    for j in range(p.dims):
        chi2 += p.step[j] * p.step[j]
    return not chi2 <= DISTINCT_MINIMA_CHI2
