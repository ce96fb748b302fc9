"""States from which the iterations start: from TDoAs in closed form, without a guess.

With the reference anchor at the origin, x the tag, ρ = |x| its distance from there, and the measured
d_i = |x − a_i| − ρ, squaring ρ + d_i = |x − a_i| leaves equations that are linear in x and ρ:

    a_iᵀx + d_i·ρ = (|a_i|² − d_i²)/2

*Spherical intersection* solves them for x as a function of ρ, and |x|² = ρ² is then a quadratic with two roots;
*spherical interpolation* takes ρ as one more unknown (H. C. Schau and A. Z. Robinson 1987; J. O. Smith and
J. S. Abel 1987). Anchors in one plane determine nothing of the coordinate w across it except w² = ρ² − x² − y².
The equations are not weighted.
"""

from typing import Annotated

from skyless.core.native.arithmetic import sqrt
from skyless.core.native.records import Reals, Record, record
from skyless.core.native.sizes import MAX_ANCHORS
from skyless.core.native.small_matrices import MAX_COLUMNS, Columns, least_squares, orthogonalise
from skyless.core.tag.problem import FREE, HEIGHT, PLANE, LocateProblem


@record
class Equations(Record):
    """Linear equations of a start."""

    left: Columns
    right: Annotated[Reals, MAX_ANCHORS]
    """What is known: (|a_i|² − d_i²)/2, less what a given height contributes."""
    u: Annotated[Reals, MAX_COLUMNS]
    v: Annotated[Reals, MAX_COLUMNS]


def add_algebraic_starts(p: LocateProblem) -> None:
    """Add what the closed forms find."""
    coordinates = 3 if p.kind == FREE else 2
    if p.kind != PLANE:
        _add_intersections(p, coordinates)
    if p.anchors - 1 > coordinates:
        _add_interpolation(p, coordinates)
    if p.kind == FREE:
        _add_interpolation(p, 2)


def _add_intersections(p: LocateProblem, coordinates: int) -> None:
    """Add the points x = u − v·ρ for each non-negative root ρ of |x|² = ρ².

    Where noise leaves no real root, the vertex of the parabola is used. The roots' form does not cancel.
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
    """Add the solution of the equations for these coordinates and ρ; with two of three, both that have this ρ."""
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
    """Write the equations for these coordinates and, if it has it, for ρ."""
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
    """The given height above the reference anchor; 0 where none is given."""
    return p.height_m - p.origin_m[2] if p.kind == HEIGHT else 0.0


def add_central_starts(p: LocateProblem) -> None:
    """Add the anchors' centroid; where the height is unknown, half their extent off their plane."""
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
    """Add the state's mirror image behind the anchors' line or plane of least squares; a given height stays."""
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
