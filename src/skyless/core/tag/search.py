"""Search for the positions that explain a set of TDoAs: starting points, descent, distinct minima."""

from typing import Annotated, Final

from skyless.core.native.arithmetic import (
    MAX_COLUMNS,
    Columns,
    factorise,
    least_squares,
    orthogonalise,
    solve,
    solve_lower,
    sqrt,
)
from skyless.core.native.records import MAX_ANCHORS, Array, Matrix, Reals, Record, record

# A set of TDoAs, in the axes in which the solution is simplest

TRIANGLE: Final = MAX_ANCHORS * (MAX_ANCHORS - 1) // 2
SMALL_TRIANGLE: Final = MAX_COLUMNS * (MAX_COLUMNS + 1) // 2
MAX_STARTS: Final = 9

FREE, HEIGHT, PLANE = range(3)
"""Kinds of problems. FREE: the state is (x, y, z). HEIGHT: it is (x, y), and its third element is the given height.
PLANE: all anchors have z = 0, and it is (x, y, s) with s = z², negative where noise makes it so."""

# Anchors are collinear if the width of their figure is below this fraction of its length.
COLLINEAR: Final = 1e-6
# Anchors are coplanar if they deviate from the plane by less than this fraction of the smallest TDoA sigma …
THIN_SIGMAS: Final = 0.1
FLAT: Final = 1e-9  # … or of their extent.


LARGEST: Final = 1e9
"""Limit in m or m². No site is larger, and nothing here overflows below it."""


@record
class Minimum(Record):
    """A local minimum of the cost, in the problem's axes."""

    iterations: int
    cost: float
    chi2: float
    """rᵀΣ⁻¹r, even if the cost is not weighted by Σ⁻¹."""
    state: Annotated[Reals, 3]
    covariance: Annotated[Reals, SMALL_TRIANGLE]
    """Lower triangle; zeros for a given height."""


@record
class LocateProblem(Record):
    """A set of TDoAs ``tdoa_m[i] = |p − anchors_m[i + 1]| − |p − anchors_m[0]|``, and the state of its solution."""

    anchors: int
    knows_height: bool
    is_weighted: bool
    has_bounds: bool
    """Whether the height is between ``low_m`` and ``high_m``."""
    height_m: float
    low_m: float
    high_m: float
    residual_tail: float
    """Residuals with a smaller tail probability are not noise."""
    anchors_m: Annotated[Matrix, MAX_ANCHORS, 3]
    """The reference first; ``choose_axes`` transforms them into its axes."""
    tdoa_m: Annotated[Reals, MAX_ANCHORS]
    covariance: Annotated[Reals, TRIANGLE]
    """Lower triangle of Σ, later of its factor L."""

    kind: int
    dims: int
    """Number of unknowns."""
    extent_m: float
    """Distance of the farthest anchor from the reference."""
    origin_m: Annotated[Reals, 3]
    axes: Annotated[Matrix, 3, 3]
    """In rows; a position is origin + axesᵀ·state."""
    scale: Annotated[Reals, 3]
    """Scale of each unknown: the extent, or its square for s."""

    start_count: int
    minimum_count: int
    starts: Annotated[Matrix, MAX_STARTS, 3]
    minima: Annotated[Array[Minimum], MAX_STARTS]
    """Ascending in cost."""

    iterations: int
    state: Annotated[Reals, 3]
    trial: Annotated[Reals, 3]
    step: Annotated[Reals, 3]
    system: Annotated[Matrix, MAX_ANCHORS, MAX_COLUMNS]
    """Rows [∂TDoA/∂state, measured − predicted]."""
    normal: Annotated[Reals, SMALL_TRIANGLE]
    """Lower triangle of systemᵀ·system."""
    next_normal: Annotated[Reals, SMALL_TRIANGLE]
    factor: Annotated[Reals, SMALL_TRIANGLE]


def choose_axes(p: LocateProblem) -> bool:
    """Transform the anchors into axes with the reference at the origin, and choose the kind of problem.

    Without a given height, the axes are the principal axes of the anchors' figure, the longest first.
    Returns False if the anchors are collinear.
    """
    m = Columns()
    m.rows = p.anchors
    m.columns = 3
    for k in range(3):
        p.origin_m[k] = p.anchors_m[0][k]
    for i in range(p.anchors):
        for k in range(3):
            p.anchors_m[i][k] -= p.origin_m[k]
            m.A[i][k] = 0.0 if p.knows_height and k == 2 else p.anchors_m[i][k]
    orthogonalise(m)
    square, square_width, thickness_m = 0.0, 0.0, 0.0
    for i in range(p.anchors):
        row = m.A[i]
        square_across = row[1] * row[1] + row[2] * row[2]
        square = max(square, row[0] * row[0] + square_across)
        square_width = max(square_width, square_across)
        thickness_m = max(thickness_m, abs(row[2]))
    if not square_width > COLLINEAR * COLLINEAR * square:
        return False
    p.extent_m = sqrt(square)
    is_flat = thickness_m <= max(FLAT * p.extent_m, THIN_SIGMAS * _least_sigma_m(p))
    p.kind = HEIGHT if p.knows_height else PLANE if is_flat else FREE
    p.dims = 2 if p.kind == HEIGHT else 3
    for j in range(3):
        p.scale[j] = p.extent_m * p.extent_m if p.kind == PLANE and j == 2 else p.extent_m
        for k in range(3):
            p.axes[j][k] = m.V[k][j] if p.kind != HEIGHT else 1.0 if j == k else 0.0
    if p.kind != HEIGHT:
        for i in range(p.anchors):
            for k in range(3):
                p.anchors_m[i][k] = 0.0 if p.kind == PLANE and k == 2 else m.A[i][k]
    return True


def sigma_m(p: LocateProblem, index: int) -> float:
    """Standard deviation of a TDoA, from the factor of Σ."""
    row = index * (index + 1) // 2
    total = 0.0
    for k in range(index + 1):
        total += p.covariance[row + k] * p.covariance[row + k]
    return sqrt(total)


def _least_sigma_m(p: LocateProblem) -> float:
    least_m = sigma_m(p, 0)
    for i in range(1, p.anchors - 1):
        least_m = min(least_m, sigma_m(p, i))
    return least_m


# Gauss–Newton steps, with Levenberg–Marquardt damping where they fail, to a minimum of the residuals

CONVERGED, UNDETERMINED, DIVERGED, EXHAUSTED = range(4)
"""How the iteration ended: in a minimum, with undetermined unknowns, on its way to infinity, or not within
``MAX_ITERATIONS``."""
MAX_ITERATIONS: Final = 200
# The iteration ends with a step below this fraction of the anchors' extent (1 nm in 10 m) …
STEP_TOLERANCE: Final = 1e-10
# … or with a step that promises to lower the cost by less than this fraction: 10⁻⁷ sigma.
GAIN_TOLERANCE: Final = 1e-13
FAR_EXTENTS: Final = 1e4  # in anchors' extents; farther away is a divergence
FIRST_DAMPING: Final = 1e-2
MIN_DAMPING: Final = 1e-4  # anything smaller is set to 0
NEAREST_M2: Final = 1e-18
"""Lower limit of a squared distance."""


def descend(p: LocateProblem) -> int:
    """Move the state to the nearest minimum. Returns how the iteration ended."""
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
    """Linearise, whiten if weighted, and write systemᵀ·system into ``normal``. Returns the cost."""
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
    """Write ``system``. An anchor at the state itself has no direction; its derivatives are zero."""
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
            row[2] = z - reference_z  # overwritten by the residual below if the height is given
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
    """Solve (N + damping·diag N)·step = gradient. Returns False if the matrix is singular."""
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
    """Whether the state has diverged or is NaN."""
    for j in range(p.dims):
        reach = abs(p.state[j]) / p.scale[j]
        if not (sqrt(reach) if p.kind == PLANE and j == 2 else reach) < FAR_EXTENTS:
            return True
    return False


def _eased(damping: float, ratio: float) -> float:
    """Next damping after a success, from the ratio of the actual to the predicted gain (H. B. Nielsen 1999)."""
    if ratio < 0.5:
        damping = max(damping, FIRST_DAMPING)
    excess = 2.0 * ratio - 1.0
    eased = damping * max(1.0 / 3.0, 1.0 - excess * excess * excess)
    return eased if eased > MIN_DAMPING else 0.0


# Starting points: closed-form solutions of the TDoAs, without an initial guess
#
# With the reference anchor at the origin, x the tag, ρ = |x| its distance from there, and the measured d_i = |x −
# a_i| − ρ, squaring ρ + d_i = |x − a_i| leaves equations that are linear in x and ρ:
#
#     a_iᵀx + d_i·ρ = (|a_i|² − d_i²)/2
#
# *Spherical intersection* solves them for x as a function of ρ, and |x|² = ρ² is then a quadratic with two roots;
# *spherical interpolation* takes ρ as one more unknown (H. C. Schau and A. Z. Robinson 1987; J. O. Smith and
# J. S. Abel 1987). Anchors in one plane determine nothing of the coordinate w across it except w² = ρ² − x² − y².
# The equations are not weighted.


@record
class Equations(Record):
    """The linear equations of a closed-form start."""

    left: Columns
    right: Annotated[Reals, MAX_ANCHORS]
    """Right-hand side: (|a_i|² − d_i²)/2, less the contribution of a given height."""
    u: Annotated[Reals, MAX_COLUMNS]
    v: Annotated[Reals, MAX_COLUMNS]


def add_algebraic_starts(p: LocateProblem) -> None:
    """Add the closed-form solutions as starting points."""
    coordinates = 3 if p.kind == FREE else 2
    if p.kind != PLANE:
        _add_intersections(p, coordinates)
    if p.anchors - 1 > coordinates:
        _add_interpolation(p, coordinates)
    if p.kind == FREE:
        _add_interpolation(p, 2)


def _add_intersections(p: LocateProblem, coordinates: int) -> None:
    """Add the points x = u − v·ρ for each non-negative root ρ of |x|² = ρ².

    If noise leaves no real root, the parabola's vertex is used. The roots are computed without cancellation.
    """
    e = Equations()
    _fill(p, e, coordinates, False)
    if not (least_squares(e.left, e.right, e.u) and least_squares(e.left, p.tdoa_m, e.v)):
        return
    height_m = _given_height_m(p)
    a, half_b, c = -1.0, 0.0, height_m * height_m
    for k in range(coordinates):
        a += e.v[k] * e.v[k]
        half_b -= e.u[k] * e.v[k]
        c += e.u[k] * e.u[k]
    discriminant = half_b * half_b - a * c
    if discriminant < 0.0:
        _add_at_distance(p, e, -half_b / a)
    else:
        root = sqrt(discriminant)
        larger = -half_b - root if half_b >= 0.0 else root - half_b
        if a != 0.0:
            _add_at_distance(p, e, larger / a)
        if larger != 0.0:
            _add_at_distance(p, e, c / larger)


def _add_at_distance(p: LocateProblem, e: Equations, distance_m: float) -> None:
    if distance_m >= 0.0:
        x, y = e.u[0] - e.v[0] * distance_m, e.u[1] - e.v[1] * distance_m
        _add(p, x, y, _given_height_m(p) if p.kind == HEIGHT else e.u[2] - e.v[2] * distance_m)


def _add_interpolation(p: LocateProblem, coordinates: int) -> None:
    """Add the solution for these coordinates and ρ; with two of three coordinates, both points at the distance ρ."""
    e = Equations()
    _fill(p, e, coordinates, True)
    if not least_squares(e.left, e.right, e.u):
        return
    x, y = e.u[0], e.u[1]
    square_across = e.u[2] * e.u[2] - x * x - y * y
    if p.kind == HEIGHT:
        _add(p, x, y, _given_height_m(p))
    elif p.kind == PLANE:
        _add(p, x, y, square_across)
    elif coordinates == 3:
        _add(p, x, y, e.u[2])
    else:
        across_m = sqrt(max(square_across, 0.0))
        _add(p, x, y, across_m)
        _add(p, x, y, -across_m)


def _fill(p: LocateProblem, e: Equations, coordinates: int, has_distance: bool) -> None:
    """Write the equations for these coordinates and, if ``has_distance``, for ρ."""
    m = e.left
    m.rows = p.anchors - 1
    m.columns = coordinates + (1 if has_distance else 0)
    for i in range(m.rows):
        anchor = p.anchors_m[i + 1]
        square = anchor[0] * anchor[0] + anchor[1] * anchor[1] + anchor[2] * anchor[2]
        e.right[i] = 0.5 * (square - p.tdoa_m[i] * p.tdoa_m[i]) - anchor[2] * _given_height_m(p)
        m.A[i][coordinates] = p.tdoa_m[i]
        for k in range(coordinates):
            m.A[i][k] = anchor[k]
    orthogonalise(m)


def _given_height_m(p: LocateProblem) -> float:
    """The given height relative to the reference anchor; 0 if none is given."""
    return p.height_m - p.origin_m[2] if p.kind == HEIGHT else 0.0


def add_central_starts(p: LocateProblem) -> None:
    """Add the anchors' centroid; if the height is unknown, shifted off their plane by half their extent."""
    x, y, z, off_m = 0.0, 0.0, 0.0, 0.5 * p.extent_m
    for i in range(p.anchors):
        x += p.anchors_m[i][0] / p.anchors
        y += p.anchors_m[i][1] / p.anchors
        z += p.anchors_m[i][2] / p.anchors
    if p.kind == FREE:
        _add(p, x, y, z + off_m)
        _add(p, x, y, z - off_m)
    else:
        _add(p, x, y, _given_height_m(p) if p.kind == HEIGHT else off_m * off_m)


def add_image(p: LocateProblem) -> None:
    """Add the mirror image of the state in the anchors' least-squares line or plane; a given height stays."""
    m = Columns()
    m.rows = p.anchors
    m.columns = p.dims
    off_m = 0.0
    for k in range(p.dims):
        mean = 0.0
        for i in range(p.anchors):
            mean += p.anchors_m[i][k] / p.anchors
        for i in range(p.anchors):
            m.A[i][k] = p.anchors_m[i][k] - mean
        p.trial[k] = p.state[k] - mean
    orthogonalise(m)
    across = p.dims - 1
    for k in range(p.dims):
        off_m += m.V[k][across] * p.trial[k]
    for k in range(p.dims):
        p.trial[k] = p.state[k] - 2.0 * off_m * m.V[k][across]
    _add(p, p.trial[0], p.trial[1], p.state[2] if p.kind == HEIGHT else p.trial[2])


def _add(p: LocateProblem, x: float, y: float, z: float) -> None:
    start = p.starts[p.start_count]
    start[0] = x
    start[1] = y
    start[2] = z
    p.start_count += 1


# Two iterations ended in the same point if they are closer than this fraction of the extent, far above tolerance.
SAME_POINT: Final = 1e-6
# A second minimum is a rival if its chi2 exceeds the best one's by less than this (a likelihood ratio of 90).
RIVAL_MINIMUM_CHI2: Final = 9.0
# Two minima are distinct if one lies outside the 3-sigma ellipsoid of the other.
DISTINCT_MINIMA_CHI2: Final = 9.0


def find_minima(p: LocateProblem) -> int:
    """Fill ``minima``, the best first. Returns how the last failed iteration ended, ``CONVERGED`` if none failed.

    The closed-form starts depend on the reference and miss about one rival in a hundred. The anchors' centroid finds
    most of these, and the mirror image of a minimum the rest, where anchors are nearly collinear or coplanar.
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
    """Whether the state is at a minimum that was found before."""
    for index in range(p.minimum_count):
        apart = 0.0
        for j in range(p.dims):
            apart += abs(p.minima[index].state[j] - p.state[j]) / p.scale[j]
        if apart < SAME_POINT:
            return True
    return False


def _assess(p: LocateProblem) -> None:
    """Insert the minimum at the state, unless it is singular.

    Its covariance is G·Σ·Gᵀ with the estimator's G: (HᵀΣ⁻¹H)⁻¹HᵀΣ⁻¹ or, unweighted, (HᵀH)⁻¹Hᵀ.
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
    if not found.covariance[p.dims * (p.dims + 1) // 2 - 1] > 0.0:  # underflow
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
    """Write a column of G·L into ``step``; if weighted, ``system`` is L⁻¹·H."""
    for j in range(p.dims):
        if p.is_weighted:
            p.step[j] = p.system[index][j]
        else:
            p.step[j] = 0.0
            for i in range(index, p.anchors - 1):
                p.step[j] += p.system[i][j] * p.covariance[i * (i + 1) // 2 + index]
    solve(p.factor, p.dims, p.step)


def keep_rivals(p: LocateProblem) -> None:
    """Keep the best minimum and the distinct ones that explain the TDoAs about as well."""
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
