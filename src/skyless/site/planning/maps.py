"""Predicted errors of a site, in compiled code on all cores, at points and on maps: grids of the floor at each height.

The filter's predictions are slow. On large grids they are computed on a coarser grid, and their ratio to the PDOP
weighted by shares of frames, which is smooth, is interpolated; that PDOP is computed at every point, so that edges
behind walls stay sharp.
"""

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from typing import Any, Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.core.air.site_pages import encode_page
from skyless.core.any_anchor import superframe_s
from skyless.core.arrays import Array, Integers, Mask, Matrix, Vector
from skyless.core.earth import geodetic
from skyless.core.estimator import steady_state
from skyless.core.estimator.compiled import add_anchor
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import State, at, new_state
from skyless.core.estimator.steady_state import PlannedMessage, PlannedRelay, SteadyState
from skyless.core.geometry import anchor_positions, inside
from skyless.core.native.library import compiled
from skyless.core.native.records import MAX_ANCHORS_IN_USE
from skyless.core.native.views import records, view
from skyless.core.pages import filter_pages_of
from skyless.core.site import GeoreferenceSite, Site
from skyless.core.tag.joint import fill_ages, read_accuracy
from skyless.core.ticks import TICK_S
from skyless.site.channel import ChannelModel, barriers_of
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
    Scene,
    fill_dops,
    link_budget,
    master_links,
    weighted_pdop,
)
from skyless.site.planning.superframe import relays_of, row_of_master, superframe_of

# Predicted errors of ``joint``, from the estimator's covariance at points of a site: at rest, and after a walk.

_RARELY: Final = 0.1  # an anchor does not help a tag that receives a smaller share of its frames

# The state counts as steady when it equals that of _COMPLETE_OVER_S, or one superframe if longer, before; at the latest
# after _MAX_S and _MAX_SUPERFRAMES.
_COMPLETE_OVER_S: Final = 0.1
_MAX_S: Final = 4.0
_MAX_SUPERFRAMES: Final = 20

_RESTED_S: Final = 3.0  # before a walk; phases count from two seconds after the start

_START_VARIANCE: Final = 1.0  # of position and velocity, m² and m²/s²; the steady state does not depend on it

_find_steady_state = compiled(steady_state.find_steady_state)
_find_walked = compiled(steady_state.find_walked)


def anchors_in_use(scene: Scene, point: Vector, share: Vector) -> Integers:
    """Rows of the anchors that a tag at a point uses, where these shares of their frames arrive."""
    return scene.strongest(point, np.flatnonzero(share >= _RARELY), MAX_ANCHORS_IN_USE)


MAX_PREDICTED: Final = 60
"""Larger sites of protocol 2 are planned by the beacons that reach tags (``rates``)."""

# Points that a thread computes at a time: fewer for the filter, which is slower.
_GEOMETRY_CHUNK: Final = 2000
_FILTER_CHUNK: Final = 100

_QA_M2PS3: Final = 0.3  # what a receiver assumes of a tag at rest


class Predictor:
    """Predictions of ``joint`` for one site."""

    def __init__(self, site: Site, channel: ChannelModel) -> None:
        self.site, self.channel = site, channel
        self.dim = 3 if site.tags.height_m is None else 2
        self.anchors_m = anchor_positions(site)
        self.master = row_of_master(site) if site.schedule.needs_master else None
        """Row of the master; None where there is none."""
        self.budget, self.barriers = link_budget(channel), barriers_of(site.walls, site.storeys)
        self.hears_master: Vector = (
            np.ones(len(site.anchors))
            if self.master is None
            else master_links(self.anchors_m, self.master, self.budget, self.barriers)
        )
        """Share of the master's frames that each anchor receives; 1 where there is no master."""
        self.superframe = superframe_of(site, self.hears_master)
        self.relays = relays_of(self.anchors_m, self.master, self.superframe, self.budget, self.barriers)
        self.scene = Scene(self.anchors_m, self.superframe.sent, self.budget, self.barriers)
        self.farthest_m = float(np.linalg.norm(np.ptp(self.anchors_m, axis=0)))
        self.estimator = EstimatorSettings(qa=_QA_M2PS3, height_m=site.tags.height_m)
        read_accuracy(self.estimator, *map(encode_page, filter_pages_of(site)))
        fill_ages(self.estimator, superframe_s(site))

    def walked_sigma(self, points_m: Matrix, *, has_phases: bool) -> Vector:
        """Standard deviations that ``joint`` claims after walks of 1 m from points, along x and along y, shape (2·m,).

        Walks go towards the middle of the points, shape (m, 3), at 1 m/s. With ``has_phases`` the tag measures carrier
        phases, with the noise and wander that the filter starts with. Infinite where there is no fix.
        """
        sides = np.where(points_m > points_m.mean(axis=0), -1.0, 1.0)
        walks = ((point, side * axis) for point, side in zip(points_m, sides, strict=True) for axis in np.eye(3)[:2])
        return np.array([self._walked_sigma(point, way, has_phases) for point, way in walks])

    def _walked_sigma(self, point: Vector, velocity_mps: Vector, has_phases: bool) -> float:
        """Standard deviation after a rest at a point and a walk of a second."""
        (share,), _ = self.scene.heard_at(point[None])
        rows = anchors_in_use(self.scene, point, share)
        if len(rows) <= self.dim:
            return math.inf
        s = self._state_at(rows, point, has_phases=has_phases)
        s.tuning.slow_forgetting = 0.0  # nothing is learnt from innovations of zero
        columns, found = self._planned(share, np.zeros_like(share), rows), SteadyState()
        length_s = self.superframe.gap_s.sum()
        walked, at_rest = max(1, round(1.0 / length_s)), math.ceil(_RESTED_S / length_s)
        velocity = np.ascontiguousarray(velocity_mps / (walked * length_s))
        _find_walked(s, *columns, len(self.superframe.sender), at_rest, velocity, walked, found)
        return math.sqrt(sum(found.variance_m2) / found.fixes)

    def messages_at(self, points_m: Matrix) -> Integers:
        """Messages in a superframe of the anchors that a tag uses at points, shape (m, 3); shape (m,)."""
        shares, _ = self.scene.heard_at(points_m)
        rows = (anchors_in_use(self.scene, point, share) for point, share in zip(points_m, shares, strict=True))
        return np.array([np.isin(self.superframe.sender, one).sum() for one in rows])

    def at(self, points_m: Matrix, progress: Callable[[float], None] | None = None) -> Matrix:
        """Table of predictions (m, len(PLAN_COLUMNS)) at points, shape (m, 3); ``progress`` gets the points done."""
        return in_threads(self._errors, np.ascontiguousarray(points_m, np.float64), _FILTER_CHUNK, progress)

    def _errors(self, points: Matrix, table: Matrix) -> None:
        """Fill a table of predictions; there is no fix where the standard deviation would exceed ``farthest_m``."""
        shares, delays_m = self.scene.heard_at(points)
        fill_dops(self.scene, points, shares, self.dim, table)
        table[:, SIGMA:], table[:, FIX_SHARE] = math.inf, 0.0
        for row, point, share, delay_m in zip(table, points, shares, delays_m, strict=True):
            rows = anchors_in_use(self.scene, point, share)
            if len(rows) <= self.dim:
                continue
            found = self._steady_state(point, share, delay_m, rows)
            claimed_m2 = view(found.variance_m2) / found.fixes
            variance_m2 = np.maximum(claimed_m2 - view(found.motion_m2), 0.0)
            sigma_m = math.sqrt(variance_m2.sum())
            if not sigma_m < self.farthest_m:
                continue
            row[SIGMA], row[SIGMA_X : SIGMA_Z + 1] = sigma_m, np.sqrt(variance_m2)
            row[BIAS] = math.sqrt(found.square_bias_m2 / found.fixes)
            row[RMSE] = math.hypot(sigma_m, row[BIAS])
            row[FIX_SHARE] = found.fixes / np.isin(self.superframe.sender, rows).sum()
            row[CLAIMED] = math.sqrt(claimed_m2.sum())

    def _state_at(self, rows: Integers, point: Vector, *, has_phases: bool = False) -> State:
        """The estimator's state at a point, with the anchors in these rows."""
        s = new_state(self.estimator)
        s.status.walk_scale, s.status.has_phases, s.hypotheses.count = 1.0, has_phases, int(has_phases)
        for axis in range(2 * s.dim):
            s.P[at(axis, axis)] = _START_VARIANCE
        for row in rows.tolist():
            add_anchor(s, row, self.anchors_m[row], -1.0, False)
        view(s.x)[: s.dim] = point[: s.dim]
        if s.dim == 2:
            s.settings.height_m = point[2]
        return s

    def _steady_state(self, point: Vector, share: Vector, delay_m: Vector, rows: Integers) -> SteadyState:
        """The steady state of a tag that receives these shares of the anchors' messages, late by these delays."""
        superframe_s, found = float(self.superframe.gap_s.sum()), SteadyState()
        most = max(_MAX_SUPERFRAMES, math.ceil(_MAX_S / superframe_s))
        step = max(1, math.ceil(_COMPLETE_OVER_S / superframe_s))
        columns = self._planned(share, delay_m, rows)
        _find_steady_state(self._state_at(rows, point), *columns, len(self.superframe.sender), most, step, found)
        return found

    def _planned(self, share: Vector, delay_m: Vector, rows: Integers) -> tuple[Any, Any]:
        """The superframe's messages and their relays, as records."""
        sender, relays = self.superframe.sender, self.relays
        index_of = np.full(len(share), -1)
        index_of[rows] = np.arange(len(rows))
        messages: NDArray[Any] = np.zeros(len(sender), np.dtype(PlannedMessage))
        messages["anchor"], messages["gap_ticks"] = index_of[sender], np.rint(self.superframe.gap_s / TICK_S)
        messages["share"], messages["late_m"], messages["end"] = share[sender], delay_m[sender], relays.ends
        listeners = np.repeat(sender, np.diff(relays.ends, prepend=0))
        relayed: NDArray[Any] = np.zeros(len(relays.sender), np.dtype(PlannedRelay))
        relayed["sender"], relayed["age_s"], relayed["late_m"] = index_of[relays.sender], relays.age_s, relays.delay_m
        relayed["share"] = share[listeners] * share[relays.sender] * relays.share
        return records(PlannedMessage, messages), records(PlannedRelay, relayed)

    def geometry_at(self, points_m: Matrix) -> Matrix:
        """Table with only anchors in view and DOPs; its column ``sigma_m`` is the weighted PDOP."""
        return in_threads(self._geometry, np.ascontiguousarray(points_m, np.float64), _GEOMETRY_CHUNK)

    def _geometry(self, points: Matrix, table: Matrix) -> None:
        share, _ = self.scene.heard_at(points)
        fill_dops(self.scene, points, share, self.dim, table)
        table[:, SIGMA] = weighted_pdop(self.scene, points, share, self.dim)


def in_threads(
    fill: Callable[[Matrix, Matrix], None],
    points_m: Matrix,
    chunk: int,
    progress: Callable[[float], None] | None = None,
) -> Matrix:
    """Fill a table of predictions for points, in chunks on all cores."""
    table: Matrix = np.zeros((len(points_m), len(PLAN_COLUMNS)))
    starts = range(0, len(points_m), chunk)
    if len(starts) == 1:
        fill(points_m, table)
        return table
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        tasks = [pool.submit(partial(fill, points_m[s : s + chunk], table[s : s + chunk])) for s in starts]
        for done, task in enumerate(as_completed(tasks), start=1):
            task.result()
            if progress is not None:
                progress(min(done * chunk, len(points_m)))
    return table


_MAX_POINTS: Final = 5_000_000
_NICE_POINTS: Final = 12_000
MIN_BIAS_M: Final = 1e-4
"""Smaller mean errors of positions are ignored."""

STEPS_M: Final = (0.05, 0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""Usual steps of grids."""
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

    Raises ValueError: the region has no area or no point inside the outline, or there would be too many points.
    """
    x1, y1, x2, y2 = floor.region_m
    if not (x2 > x1 and y2 > y1):
        raise ValueError("the region has no area")
    step = step_m or next(
        (s for s in STEPS_M if (x2 - x1) * (y2 - y1) / s**2 * len(heights_m) <= _NICE_POINTS), STEPS_M[-1]
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
    points = np.stack([*np.meshgrid(grid.x_m, grid.y_m), np.full(grid.within.shape, height_m)], axis=-1)
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


def _stride(predictor: Predictor, grid: Grid, points: Matrix) -> int:
    """Stride of the rows and columns to compute in full; ``points``: a slice's points inside the outline, (n, 3)."""
    some = points[:: math.ceil(len(points) / _SAMPLE_POINTS)]
    most = _JOINT_BUDGET / float(((predictor.geometry_at(some)[:, ANCHORS_IN_VIEW] + 8.0) ** 2).mean())
    return max(1, math.ceil(math.sqrt(grid.points / most)))


def _every(stride: int, count: int) -> Integers:
    """Every ``stride``-th index, and the last one."""
    return np.unique(np.append(np.arange(0, count, stride), count - 1))


def _interpolate(coarse: Array, carrier: Matrix, rows: Integers, columns: Integers, within: Mask, fine: Matrix) -> None:
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
    for number, rows in enumerate(_pieces(plan)):
        if georeference:
            rows[:, :3] = to_wgs84(rows[:, :3], georeference)
        text = ",\n".join([pattern % row for row in map(tuple, rows.tolist())])
        yield (",\n" if number else "") + text.replace(":inf", ":null").replace(":nan", ":null")
    yield "\n]}\n"


def to_wgs84(points_m: Matrix, origin: GeoreferenceSite) -> Matrix:
    """Convert points of a site to longitude, latitude (degrees) and height (m), shape (m, 3)."""
    found = np.array([geodetic((x, y, z), origin) for x, y, z in points_m.tolist()]).reshape(-1, 3)
    return found[:, [1, 0, 2]]


def _pieces(plan: PlanMap) -> Iterator[Matrix]:
    rows = rows_of(plan)
    for start in range(0, len(rows), _TABLE_ROWS):
        yield rows[start : start + _TABLE_ROWS]
