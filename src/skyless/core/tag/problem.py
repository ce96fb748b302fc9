"""A set of TDoAs, in the axes in which their solution is simplest."""

from typing import Annotated, Final

from skyless.core.native.arithmetic import sqrt
from skyless.core.native.records import Array, Matrix, Reals, Record, record
from skyless.core.native.sizes import MAX_ANCHORS
from skyless.core.native.small_matrices import MAX_COLUMNS, Columns, orthogonalise

TRIANGLE: Final = MAX_ANCHORS * (MAX_ANCHORS - 1) // 2
SMALL_TRIANGLE: Final = MAX_COLUMNS * (MAX_COLUMNS + 1) // 2
MAX_STARTS: Final = 9

FREE, HEIGHT, PLANE = range(3)
"""Kinds of problems: the state is (x, y, z); or (x, y), and its third element is the given height; or all anchors have
z = 0, and it is (x, y, s) with s = z², negative where noise makes it so."""

# Anchors are in one line, or one point, if their figure's width is below this part of its length.
COLLINEAR: Final = 1e-6
# Anchors are in one plane if they leave it by less than this part of the smallest TDoA sigma.
THIN_SIGMAS: Final = 0.1
FLAT: Final = 1e-9  # or if they leave it by less than this part of their extent


LARGEST: Final = 1e9
"""Metres, or m²: anything beyond is no site, and no number here overflows before it."""


@record
class Minimum(Record):
    """A minimum of the cost, in the problem's axes."""

    iterations: int
    cost: float
    chi2: float
    """rᵀΣ⁻¹r, also where the cost is not weighted by Σ⁻¹."""
    state: Annotated[Reals, 3]
    covariance: Annotated[Reals, SMALL_TRIANGLE]
    """A lower triangle; zeros for a given height."""


@record
class LocateProblem(Record):
    """A set of TDoAs ``tdoa_m[i] = |p − anchors_m[i + 1]| − |p − anchors_m[0]|``, and how far its solution is."""

    anchors: int
    knows_height: bool
    is_weighted: bool
    has_bounds: bool
    """Whether the height is between ``low_m`` and ``high_m``."""
    height_m: float
    low_m: float
    high_m: float
    residual_tail: float
    """Residuals that noise exceeds more rarely are not noise."""
    anchors_m: Annotated[Matrix, MAX_ANCHORS, 3]
    """The reference first; ``choose_axes`` moves them into its axes."""
    tdoa_m: Annotated[Reals, MAX_ANCHORS]
    covariance: Annotated[Reals, TRIANGLE]
    """The lower triangle of Σ, and then of its factor L."""

    kind: int
    dims: int
    """Number of unknowns."""
    extent_m: float
    """Size of the anchors' figure."""
    origin_m: Annotated[Reals, 3]
    axes: Annotated[Matrix, 3, 3]
    """Its rows; a position is origin + axesᵀ·state."""
    scale: Annotated[Reals, 3]
    """What the extent is for each unknown."""

    start_count: int
    minimum_count: int
    starts: Annotated[Matrix, MAX_STARTS, 3]
    minima: Annotated[Array[Minimum], MAX_STARTS]
    """The best first."""

    iterations: int
    state: Annotated[Reals, 3]
    trial: Annotated[Reals, 3]
    step: Annotated[Reals, 3]
    system: Annotated[Matrix, MAX_ANCHORS, MAX_COLUMNS]
    """Rows [∂TDoA/∂state, measured − predicted]."""
    normal: Annotated[Reals, SMALL_TRIANGLE]
    """The lower triangle of systemᵀ·system."""
    next_normal: Annotated[Reals, SMALL_TRIANGLE]
    factor: Annotated[Reals, SMALL_TRIANGLE]


def choose_axes(p: LocateProblem) -> bool:
    """Move the anchors into axes with the reference at the origin, and choose the kind of problem.

    Without a given height, the axes are those of the anchors' figure, the longest first. False where the anchors are
    in one line or in one point.
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
