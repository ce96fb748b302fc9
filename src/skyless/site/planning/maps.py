"""Maps: predictions over a grid of the floor, one slice per height, and their export as tables.

The filter's predictions are slow. On large grids they are computed on a coarser grid, and their ratio to the PDOP
weighted by shares of frames, which is smooth, is interpolated; that PDOP is computed at every point, so that edges
behind walls stay sharp.
"""

import math
from collections.abc import Callable, Iterator
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array, Integers, Mask, Matrix, Vector
from skyless.core.earth import geodetic
from skyless.core.geometry import inside
from skyless.core.site import GeoreferenceSite
from skyless.site.planning.links import (
    ANCHORS_IN_VIEW,
    BIAS,
    CLAIMED,
    FIX_SHARE,
    PLAN_COLUMNS,
    RMSE,
    SIGMA,
    SIGMA_X,
    SIGMA_Y,
    SIGMA_Z,
    Floor,
)
from skyless.site.planning.predict import Predictor

_MAX_POINTS: Final = 5_000_000
_NICE_POINTS: Final = 12_000
MIN_BIAS_M: Final = 1e-4
"""Smaller mean errors of positions are ignored."""

_STEPS_M: Final = (0.05, 0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
_JOINT_BUDGET: Final = 2.5e5
"""Points of the joint filter times the cost of one: the square of the anchors in view plus a constant."""

_SAMPLE_POINTS: Final = 500  # points to estimate the mean number of anchors in view

_TABLE_ROWS: Final = 20_000  # rows of a table that are written at once


class Grid(Struct, frozen=True):
    """Cell centres over the region's box; those outside the outline do not count."""

    x_m: Vector
    y_m: Vector
    heights_m: Vector
    step_m: float
    within: Mask
    """Shape (ny, nx)."""

    @property
    def points(self) -> int:
        """Number of points inside the outline, at all heights."""
        return int(self.within.sum()) * len(self.heights_m)


class PlanMap(Struct, frozen=True):
    """Predictions over a grid."""

    grid: Grid
    table: Array
    """Shape (heights, ny, nx, columns); NaN outside the outline."""
    computed_every_m: float
    """Spacing of the fully computed points; wider than the grid's if the rest is interpolated."""

    def column(self, index: int) -> Array:
        """One column, shape (heights, ny, nx)."""
        return self.table[..., index]

    @property
    def has_bias(self) -> bool:
        """Whether positions somewhere have a mean error, as walls delay frames."""
        bias = self.column(BIAS)
        return bool((bias[np.isfinite(bias)] > MIN_BIAS_M).any())


class MapSummary(Struct, frozen=True):
    """Statistics of a map, metres; None if no point has a fix."""

    points: int
    covered_share: float
    """Share of the points with a fix in at least half of the messages."""
    mean_sigma_m: float | None
    """Over the covered points."""
    median_sigma_m: float | None
    p95_sigma_m: float | None
    worst_sigma_m: float | None
    worst_at_m: tuple[float, float, float] | None
    mean_rmse_m: float | None
    worst_rmse_m: float | None
    fewest_anchors: int
    target_share: float | None
    """Share of all points that meet the target; None without one."""


def grid_of(floor: Floor, heights_m: tuple[float, ...], step_m: float | None) -> Grid:
    """Grid over the floor's region; by default with some ten thousand points.

    Raises:
        ValueError: the region has no area or no point inside the outline, or there would be too many points.
    """
    x1, y1, x2, y2 = floor.region_m
    if not (x2 > x1 and y2 > y1):
        raise ValueError("the region has no area")
    step = step_m or next(
        (s for s in _STEPS_M if (x2 - x1) * (y2 - y1) / s**2 * len(heights_m) <= _NICE_POINTS), _STEPS_M[-1]
    )
    nx, ny = max(round((x2 - x1) / step), 1), max(round((y2 - y1) / step), 1)
    if nx * ny * len(heights_m) > _MAX_POINTS:
        raise ValueError(f"a step of {step:g} m makes {nx * ny * len(heights_m)} points; {_MAX_POINTS} are the most")
    xs = x1 + (np.arange(nx) + 0.5) * (x2 - x1) / nx
    ys = y1 + (np.arange(ny) + 0.5) * (y2 - y1) / ny
    flat = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    within = inside(flat, floor.outline_m).reshape(ny, nx)
    if not within.any():
        raise ValueError("no point of the region lies inside the outline")
    return Grid(xs, ys, np.array(heights_m, dtype=np.float64), step, within)


def plan_map(predictor: Predictor, grid: Grid, progress: Callable[[float], None] | None = None) -> PlanMap:
    """Predict over a grid; ``progress`` is called with the share done."""
    slices = [
        _slice(predictor, grid, height, _slice_progress(progress, k, grid)) for k, height in enumerate(grid.heights_m)
    ]
    return PlanMap(grid, np.stack([table for table, _ in slices]), slices[0][1])


def summary_of(plan: PlanMap, target_m: float | None = None) -> MapSummary:
    """Summarise a map."""
    table = plan.table[:, plan.grid.within].reshape(-1, len(PLAN_COLUMNS))
    covered = table[:, FIX_SHARE] >= 0.5
    sigma, rmse = table[covered, SIGMA], table[covered, RMSE]
    some = len(sigma) > 0
    worst_at = None
    if some:
        k, y, x = (indices[0] for indices in np.nonzero(plan.column(SIGMA) == sigma.max()))
        worst_at = (float(plan.grid.x_m[x]), float(plan.grid.y_m[y]), float(plan.grid.heights_m[k]))
    return MapSummary(
        points=len(table),
        covered_share=float(covered.mean()),
        mean_sigma_m=float(sigma.mean()) if some else None,
        median_sigma_m=float(np.median(sigma)) if some else None,
        p95_sigma_m=float(np.percentile(sigma, 95)) if some else None,
        worst_sigma_m=float(sigma.max()) if some else None,
        worst_at_m=worst_at,
        mean_rmse_m=float(rmse.mean()) if some else None,
        worst_rmse_m=float(rmse.max()) if some else None,
        fewest_anchors=int(table[:, ANCHORS_IN_VIEW].min()),
        target_share=None if target_m is None else float((covered & (table[:, SIGMA] <= target_m)).mean()),
    )


def _slice_progress(progress: Callable[[float], None] | None, k: int, grid: Grid) -> Callable[[float], None] | None:
    if progress is None:
        return None
    per_slice = grid.points / len(grid.heights_m)
    return lambda done: progress((k + min(done / per_slice, 1.0)) / len(grid.heights_m))


def _slice(
    predictor: Predictor, grid: Grid, height_m: float, progress: Callable[[float], None] | None
) -> tuple[Array, float]:
    points = points_of(grid, height_m)
    table = np.full((*grid.within.shape, len(PLAN_COLUMNS)), np.nan)
    stride = _stride(predictor, grid, points[grid.within])
    if stride == 1:
        table[grid.within] = predictor.at(points[grid.within], progress)
        return table, grid.step_m
    rows, columns = _every(stride, len(grid.y_m)), _every(stride, len(grid.x_m))
    nodes = points[np.ix_(rows, columns)].reshape(-1, 3)
    coarse = predictor.at(nodes, progress).reshape(len(rows), len(columns), -1)
    carrier = predictor.geometry_at(nodes)[:, SIGMA].reshape(len(rows), len(columns))
    fine = predictor.geometry_at(points[grid.within])
    _interpolate(coarse, carrier, rows, columns, grid.within, fine)
    table[grid.within] = fine
    return table, stride * grid.step_m


def points_of(grid: Grid, height_m: float) -> Array:
    """Points of one slice, shape (ny, nx, 3)."""
    x, y = np.meshgrid(grid.x_m, grid.y_m)
    return np.stack([x, y, np.full_like(x, height_m)], axis=-1)


def _stride(predictor: Predictor, grid: Grid, points: Matrix) -> int:
    """Stride of the rows and columns to compute in full; ``points``: a slice's points inside the outline, (n, 3)."""
    some = points[:: math.ceil(len(points) / _SAMPLE_POINTS)]
    most = _JOINT_BUDGET / float(((predictor.geometry_at(some)[:, ANCHORS_IN_VIEW] + 8.0) ** 2).mean())
    return max(1, math.ceil(math.sqrt(grid.points / most)))


def _every(stride: int, count: int) -> Integers:
    """Every ``stride``-th index, and the last one."""
    return np.unique(np.append(np.arange(0, count, stride), count - 1))


def _interpolate(
    coarse: Array,
    carrier: Matrix,
    rows: Integers,
    columns: Integers,
    within: Mask,
    fine: Matrix,
) -> None:
    """Fill the filter's columns of ``fine`` from a coarse table of these rows and columns of the grid.

    ``carrier``: weighted PDOP at the coarse points; at the fine points it is in the column ``sigma_m``.
    """
    from scipy.ndimage import distance_transform_edt, map_coordinates  # noqa: PLC0415 (SciPy is loaded late)

    ys, xs = np.nonzero(within)
    at = np.array([np.interp(ys, rows, np.arange(len(rows))), np.interp(xs, columns, np.arange(len(columns)))])
    known = np.isfinite(coarse[..., SIGMA])
    if not known.any():
        fine[:, SIGMA:] = math.inf
        fine[:, FIX_SHARE] = 0.0
        return
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    steady = known & np.isfinite(carrier)
    fine_carrier = fine[:, SIGMA].copy()
    near_steady = distance_transform_edt(~steady, return_distances=False, return_indices=True)

    def bilinear(values: Array) -> Vector:
        interpolated: Vector = map_coordinates(values, at, order=1, mode="nearest")
        return interpolated

    by_geometry = np.isfinite(fine_carrier) & bool(steady.any())
    for column in (SIGMA, SIGMA_X, SIGMA_Y, SIGMA_Z, CLAIMED):
        plain = bilinear(coarse[..., column][tuple(nearest)])
        with np.errstate(invalid="ignore"):
            ratio = bilinear((coarse[..., column] / carrier)[tuple(near_steady)])
        fine[:, column] = np.where(by_geometry, ratio * np.where(by_geometry, fine_carrier, 1.0), plain)
    fine[:, BIAS] = bilinear(coarse[..., BIAS][tuple(nearest)])
    fine[:, RMSE] = np.hypot(fine[:, SIGMA], fine[:, BIAS])
    fine[:, FIX_SHARE] = bilinear(coarse[..., FIX_SHARE])
    without = ~(map_coordinates(known.astype(np.float64), at, order=0, mode="nearest") > 0.5)
    fine[without, SIGMA:] = math.inf
    fine[without, FIX_SHARE] = 0.0


# Tables


def rows_of(plan: PlanMap) -> Matrix:
    """x, y, z and the columns of every point inside the outline, shape (points, 3 + columns)."""
    x, y = np.meshgrid(plan.grid.x_m, plan.grid.y_m)
    within = plan.grid.within
    slices = [
        np.column_stack([x[within], y[within], np.full(int(within.sum()), height), table[within]])
        for height, table in zip(plan.grid.heights_m, plan.table, strict=True)
    ]
    return np.concatenate(slices)


def csv_lines(plan: PlanMap) -> Iterator[str]:
    """The map as CSV, in pieces; fields are empty where there is no fix."""
    yield ",".join(("x_m", "y_m", "z_m", *PLAN_COLUMNS)) + "\n"
    pattern = (
        ",".join(["%.3f"] * 3 + ["%d" if k == ANCHORS_IN_VIEW else "%.4g" for k in range(len(PLAN_COLUMNS))]) + "\n"
    )
    for rows in _pieces(plan):
        text = "".join([pattern % row for row in map(tuple, rows.tolist())])
        yield text.replace("inf", "").replace("nan", "")


def geojson_lines(plan: PlanMap, georeference: GeoreferenceSite | None) -> Iterator[str]:
    """The map as a GeoJSON FeatureCollection, in pieces; values are null where there is no fix.

    With a georeference the coordinates are longitude and latitude as RFC 7946 requires, otherwise the site's metres;
    the member ``skyless:frame`` names the frame.
    """
    frame = "WGS 84" if georeference else "site, metres"
    yield f'{{"type":"FeatureCollection","skyless:frame":"{frame}","features":[\n'
    keys = ",".join(f'"{name}":' + ("%d" if k == ANCHORS_IN_VIEW else "%.4g") for k, name in enumerate(PLAN_COLUMNS))
    coordinates = "[%.8f,%.8f,%.3f]" if georeference else "[%.3f,%.3f,%.3f]"
    geometry = f'"geometry":{{"type":"Point","coordinates":{coordinates}}}'
    pattern = f'{{"type":"Feature",{geometry},"properties":{{{keys}}}}}'
    first = True
    for rows in _pieces(plan):
        if georeference:
            rows[:, :3] = to_wgs84(rows[:, :3], georeference)
        text = ",\n".join([pattern % row for row in map(tuple, rows.tolist())])
        yield ("" if first else ",\n") + text.replace(":inf", ":null").replace(":nan", ":null")
        first = False
    yield "\n]}\n"


def to_wgs84(points_m: Matrix, origin: GeoreferenceSite) -> Matrix:
    """Convert points of a site to longitude, latitude (degrees) and height (m), shape (m, 3)."""
    found = np.array([geodetic((x, y, z), origin) for x, y, z in points_m.tolist()]).reshape(-1, 3)
    return found[:, [1, 0, 2]]


def _pieces(plan: PlanMap) -> Iterator[Matrix]:
    rows = rows_of(plan)
    for start in range(0, len(rows), _TABLE_ROWS):
        yield rows[start : start + _TABLE_ROWS]
