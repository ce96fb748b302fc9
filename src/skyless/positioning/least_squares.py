"""The position that fits TDoAs best: Gauss–Newton steps, damped after Levenberg and Marquardt where they fail."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyless.compiled import kernel, part
from skyless.positioning.closed_form import HEIGHT, PLANE
from skyless.uncertainty.cholesky import factorise, invert, solve, whiten

CONVERGED: Final = 0
SINGULAR: Final = 1
"""The unknowns are not determined where the iteration ended."""
FAR: Final = 2
"""The iteration left for infinity."""
EXHAUSTED: Final = 3
"""No end after MOST_ITERATIONS."""

MOST_ITERATIONS: Final = 200
STEP_TOLERANCE: Final = 1e-10
"""The iteration ends with a step below this part of the anchors' extent (1 nm in 10 m)."""
GAIN_TOLERANCE: Final = 1e-13
"""It also ends where a step promises to lower the cost by less than this part: steps of 10⁻⁷ sigma."""
FAR_EXTENTS: Final = 1e4
"""Nobody locates a tag at ten thousand times the anchors' extent."""
FIRST_DAMPING: Final = 1e-2
LEAST_DAMPING: Final = 1e-4
"""Smaller damping is none."""


@kernel
def linearise(
    anchors: NDArray[np.float64],
    tdoa: NDArray[np.float64],
    state: NDArray[np.float64],
    kind: int,
    system: NDArray[np.float64],
) -> None:
    """Write rows [∂TDoA/∂state, measured − predicted] into ``system``, shape (n, 4).

    The kinds of problem are those of ``closed_form``; where the height is given, the residuals stand in column
    2, else in column 3. An anchor at the very position has no direction and counts with zeros.
    """
    last = 2 if kind == HEIGHT else 3
    floor = 1e-18
    reference = 0.0
    reference_x = 0.0
    reference_y = 0.0
    reference_z = 0.0
    for i in range(len(anchors)):
        x = state[0] - anchors[i, 0]
        y = state[1] - anchors[i, 1]
        z = state[2] - anchors[i, 2]
        across = state[2] if kind == PLANE else z * z
        distance = math.sqrt(max(x * x + y * y + across, floor))
        x, y = x / distance, y / distance
        z = 0.5 / distance if kind == PLANE else z / distance
        if i == 0:
            reference, reference_x, reference_y, reference_z = distance, x, y, z
            continue
        row = system[i - 1]
        row[2] = z - reference_z
        row[0] = x - reference_x
        row[1] = y - reference_y
        row[last] = tdoa[i - 1] - (distance - reference)


@kernel
def square(system: NDArray[np.float64], columns: int, normal: NDArray[np.float64]) -> float:
    """Write the lower triangle of systemᵀ·system into ``normal``; returns its last element, the sum of squares."""
    for j in range(columns):
        for k in range(j + 1):
            total = 0.0
            for i in range(len(system)):
                total += system[i, j] * system[i, k]
            normal[j, k] = total
    return float(normal[columns - 1, columns - 1])


@kernel
def assemble(
    anchors: NDArray[np.float64],
    tdoa: NDArray[np.float64],
    state: NDArray[np.float64],
    kind: int,
    weighted: bool,
    factor: NDArray[np.float64],
    system: NDArray[np.float64],
    normal: NDArray[np.float64],
) -> float:
    """Linearise, whiten if ``weighted``, and form the normal equations; returns the cost."""
    columns = 3 if kind == HEIGHT else 4
    linearise(anchors, tdoa, state, kind, system)
    if weighted:
        whiten(factor, len(system), system, columns)
    return square(system, columns, normal)


@kernel
def damped_step(
    normal: NDArray[np.float64], dims: int, damping: float, work: NDArray[np.float64], step: NDArray[np.float64]
) -> bool:
    """Solve (N + damping·diag N)·step = gradient; False where the matrix is singular."""
    for j in range(dims):
        step[j] = normal[dims, j]
        for k in range(j + 1):
            work[j, k] = normal[j, k]
        work[j, j] *= 1.0 + damping
    if not factorise(work, dims):
        return False
    solve(work, dims, step)
    return True


@part
def _eased(damping: float, ratio: float) -> float:
    """Next damping after a success, by the ratio of what it gained to what was promised (H. B. Nielsen 1999)."""
    if ratio < 0.5:
        damping = max(damping, FIRST_DAMPING)
    eased = damping * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)
    return eased if eased > LEAST_DAMPING else 0.0


@kernel
def minimise(
    anchors: NDArray[np.float64],
    tdoa: NDArray[np.float64],
    kind: int,
    weighted: bool,
    factor: NDArray[np.float64],
    extent: float,
    state: NDArray[np.float64],
    system: NDArray[np.float64],
    work: NDArray[np.float64],
) -> tuple[int, int]:
    """Move ``state`` to the minimum of its surroundings; returns how it ended and after how many steps.

    ``factor``: Cholesky factor of the TDoAs' covariance, shape (n, n), used if ``weighted``. ``extent``: size of
    the anchors' figure. Scratch: ``system`` (n, 4), ``work`` (4, 4, 4).
    """
    dims = 2 if kind == HEIGHT else 3
    normal, next_normal, damped = work[0], work[1], work[2]
    step, trial = work[3, 0], work[3, 1]
    trial[2] = state[2]
    tolerance = STEP_TOLERANCE * extent
    cost = assemble(anchors, tdoa, state, kind, weighted, factor, system, normal)
    damping, growth = 0.0, 2.0
    for iteration in range(1, MOST_ITERATIONS + 1):
        if not damped_step(normal, dims, damping, damped, step):
            if damping > 1.0:
                return SINGULAR, iteration
            damping = max(10.0 * damping, FIRST_DAMPING)
            continue
        last = abs(step[2]) <= (tolerance * extent if kind == PLANE else tolerance) or dims == 2
        small = abs(step[0]) <= tolerance and abs(step[1]) <= tolerance and last
        promised = 0.0
        for j in range(dims):
            trial[j] = state[j] + step[j]
            promised += step[j] * (normal[dims, j] + damping * normal[j, j] * step[j])
        small = small or promised <= GAIN_TOLERANCE * cost
        next_cost = assemble(anchors, tdoa, trial, kind, weighted, factor, system, next_normal)
        if next_cost < cost:
            damping, growth = _eased(damping, (cost - next_cost) / max(promised, 1e-300)), 2.0
            cost = next_cost
            for row in range(4):
                for column in range(4):
                    normal[row, column] = next_normal[row, column]
            for axis in range(3):
                state[axis] = trial[axis]
        else:
            damping, growth = max(growth * damping, FIRST_DAMPING), 2.0 * growth
        if small:
            return CONVERGED, iteration
        reach = math.sqrt(abs(state[2])) if kind == PLANE else abs(state[2])
        if not max(abs(state[0]), abs(state[1]), reach if dims == 3 else 0.0) < FAR_EXTENTS * extent:
            return FAR, iteration
    return EXHAUSTED, MOST_ITERATIONS


@kernel
def assess(
    anchors: NDArray[np.float64],
    tdoa: NDArray[np.float64],
    kind: int,
    weighted: bool,
    factor: NDArray[np.float64],
    covariance: NDArray[np.float64],
    state: NDArray[np.float64],
    system: NDArray[np.float64],
    work: NDArray[np.float64],
    residuals: NDArray[np.float64],
    state_covariance: NDArray[np.float64],
) -> float:
    """Write residuals (n,) and covariance (3, 3) of a minimum; returns chi2, or −1 where it is singular.

    Weighted: (HᵀΣ⁻¹H)⁻¹. Not weighted: G·Σ·Gᵀ with G = (HᵀH)⁻¹Hᵀ. chi2 is rᵀΣ⁻¹r in both cases.
    """
    dims = 2 if kind == HEIGHT else 3
    normal, spread_normal, inverse = work[0], work[1], work[2]
    linearise(anchors, tdoa, state, kind, system)
    for i in range(len(system)):
        residuals[i] = system[i, dims]
    if not weighted:
        square(system, dims, normal)
        sandwich(system, dims, covariance, spread_normal)
    whiten(factor, len(system), system, dims + 1)
    if weighted:
        square(system, dims, normal)
    if not factorise(normal, dims):
        return -1.0
    invert(normal, dims, inverse)
    state_covariance[:] = 0.0
    for j in range(dims):
        for k in range(dims):
            if weighted:
                state_covariance[j, k] = inverse[j, k]
                continue
            for p in range(dims):
                for q in range(dims):
                    state_covariance[j, k] += inverse[j, p] * spread_normal[p, q] * inverse[q, k]
    chi2 = 0.0
    for i in range(len(system)):
        chi2 += system[i, dims] * system[i, dims]
    return chi2


@kernel
def sandwich(
    system: NDArray[np.float64], dims: int, covariance: NDArray[np.float64], product: NDArray[np.float64]
) -> None:
    """Write HᵀΣH into ``product``."""
    for p in range(dims):
        for q in range(dims):
            total = 0.0
            for i in range(len(system)):
                for k in range(len(system)):
                    total += system[i, p] * covariance[i, k] * system[k, q]
            product[p, q] = total
