"""Gauss–Newton steps, damped after Levenberg and Marquardt where they fail, to a minimum of TDoAs' residuals."""

from typing import Annotated, Final

from skyless.core.native.arithmetic import sqrt
from skyless.core.native.records import Matrix, Reals, Record, record

MAX_ANCHORS: Final = 64
"""Most anchors of one set of TDoAs."""

FREE, HEIGHT, PLANE = range(3)
"""Kinds of problems: the state is (x, y, z); or (x, y), and its third element is the given height; or all anchors have
z = 0, and it is (x, y, s) with s = z², negative where noise makes it so."""

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
SINGULAR_PIVOT: Final = 1e-12
"""A pivot below this part of its diagonal element is rounding noise: the matrix is singular."""


@record
class Descent(Record):
    """A set of TDoAs, the reference first, and where the iteration is."""

    kind: int
    anchors: int
    dims: int
    """Number of unknowns."""
    iterations: int
    positions_m: Annotated[Matrix, MAX_ANCHORS, 3]
    tdoa_m: Annotated[Reals, MAX_ANCHORS]
    whitener: Annotated[Matrix, MAX_ANCHORS, MAX_ANCHORS]
    """A lower triangle; the unit matrix where the sum of squares is not weighted."""
    scale: Annotated[Reals, 3]
    """What the anchors' extent is for each unknown."""
    state: Annotated[Reals, 3]
    trial: Annotated[Reals, 3]
    step: Annotated[Reals, 3]
    system: Annotated[Matrix, MAX_ANCHORS, 4]
    """Rows [∂TDoA/∂state, measured − predicted]."""
    normal: Annotated[Matrix, 4, 4]
    """The lower triangle of systemᵀ·system."""
    next_normal: Annotated[Matrix, 4, 4]
    damped: Annotated[Matrix, 4, 4]


def linearise(d: Descent, state: Reals) -> None:
    """Write ``system``; an anchor at the very position has no direction and counts with zeros."""
    reference_m, reference_x, reference_y, reference_z = 0.0, 0.0, 0.0, 0.0
    for i in range(d.anchors):
        anchor = d.positions_m[i]
        x, y, z = state[0] - anchor[0], state[1] - anchor[1], state[2] - anchor[2]
        across = state[2] if d.kind == PLANE else z * z
        distance_m = sqrt(max(x * x + y * y + across, 1e-18))
        x /= distance_m
        y /= distance_m
        z = (0.5 if d.kind == PLANE else z) / distance_m
        if i == 0:
            reference_m, reference_x, reference_y, reference_z = distance_m, x, y, z
        else:
            row = d.system[i - 1]
            row[2] = z - reference_z  # and then the residual, where the height is given
            row[0] = x - reference_x
            row[1] = y - reference_y
            row[d.dims] = d.tdoa_m[i - 1] - (distance_m - reference_m)


def _assemble(d: Descent, state: Reals, normal: Annotated[Matrix, 4, 4]) -> float:
    """Linearise, whiten, and write the lower triangle of systemᵀ·system into ``normal``; returns the cost."""
    linearise(d, state)
    rows = d.anchors - 1
    for i in range(rows - 1, -1, -1):  # W is a lower triangle: rows above are still to come
        for j in range(d.dims + 1):
            total = 0.0
            for k in range(i + 1):
                total += d.whitener[i][k] * d.system[k][j]
            d.system[i][j] = total
    for j in range(d.dims + 1):
        for k in range(j + 1):
            total = 0.0
            for i in range(rows):
                total += d.system[i][j] * d.system[i][k]
            normal[j][k] = total
    return normal[d.dims][d.dims]


def _find_damped_step(d: Descent, damping: float) -> bool:
    """Solve (N + damping·diag N)·step = gradient by Cholesky's method; False where the matrix is singular."""
    L, step = d.damped, d.step
    for j in range(d.dims):
        step[j] = d.normal[d.dims][j]
        for k in range(j + 1):
            L[j][k] = d.normal[j][k]
        L[j][j] *= 1.0 + damping
    for j in range(d.dims):
        pivot = L[j][j]
        for k in range(j):
            pivot -= L[j][k] * L[j][k]
        if not (pivot > SINGULAR_PIVOT * L[j][j] and L[j][j] > 0.0):
            return False
        L[j][j] = sqrt(pivot)
        for i in range(j + 1, d.dims):
            total = L[i][j]
            for k in range(j):
                total -= L[i][k] * L[j][k]
            L[i][j] = total / L[j][j]
    for i in range(d.dims):
        total = step[i]
        for k in range(i):
            total -= L[i][k] * step[k]
        step[i] = total / L[i][i]
    for i in range(d.dims - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, d.dims):
            total -= L[k][i] * step[k]
        step[i] = total / L[i][i]
    return True


def descend(d: Descent) -> int:
    """Move the state to the minimum of its surroundings; returns how it ended."""
    cost = _assemble(d, d.state, d.normal)
    damping, growth = 0.0, 2.0
    for j in range(3):
        d.trial[j] = d.state[j]
    for iteration in range(1, MAX_ITERATIONS + 1):
        d.iterations = iteration
        if not _find_damped_step(d, damping):
            if damping > 1.0:
                return UNDETERMINED
            damping = max(10.0 * damping, FIRST_DAMPING)
            continue
        predicted, longest = 0.0, 0.0
        for j in range(d.dims):
            d.trial[j] = d.state[j] + d.step[j]
            predicted += d.step[j] * (d.normal[d.dims][j] + damping * d.normal[j][j] * d.step[j])
            longest = max(longest, abs(d.step[j]) / d.scale[j])
        is_small = longest <= STEP_TOLERANCE or predicted <= GAIN_TOLERANCE * cost
        next_cost = _assemble(d, d.trial, d.next_normal)
        if next_cost < cost:
            damping, growth = _eased(damping, (cost - next_cost) / max(predicted, 1e-300)), 2.0
            cost = next_cost
            for j in range(d.dims):
                d.state[j] = d.trial[j]
            for j in range(d.dims + 1):
                for k in range(j + 1):
                    d.normal[j][k] = d.next_normal[j][k]
        else:
            damping, growth = max(growth * damping, FIRST_DAMPING), 2.0 * growth
        if is_small:
            return CONVERGED
        if _is_far(d):
            return DIVERGED
    return EXHAUSTED


def _is_far(d: Descent) -> bool:
    """Whether the state has left for infinity, or is no number."""
    for j in range(d.dims):
        reach = abs(d.state[j]) / d.scale[j]
        if not (sqrt(reach) if d.kind == PLANE and j == 2 else reach) < FAR_EXTENTS:
            return True
    return False


def _eased(damping: float, ratio: float) -> float:
    """Next damping after a success, by the ratio of what it gained to what was predicted (H. B. Nielsen 1999)."""
    if ratio < 0.5:
        damping = max(damping, FIRST_DAMPING)
    excess = 2.0 * ratio - 1.0
    eased = damping * max(1.0 / 3.0, 1.0 - excess * excess * excess)
    return eased if eased > MIN_DAMPING else 0.0
