"""The report of a plan: all results and warnings as one tree of plain values."""

from collections.abc import Iterator
from typing import Any, Final

import msgspec
import numpy as np
from msgspec import Struct

from skyless.core.any_anchor import superframe_s
from skyless.core.arrays import Array, Mask
from skyless.core.fix import NoFixReason
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.native.records import MAX_ANCHORS
from skyless.core.protocol1.snapshots import literal_covariance
from skyless.core.tag.position import NoSolution, locate
from skyless.site.file.advice import warnings_of
from skyless.site.planning.links import BIAS, FIX_SHARE, IN_VIEW, SIGMA, Floor, Mounts, range_of, sample_points
from skyless.site.planning.maps import MapSummary, PlanMap, Predictor
from skyless.site.planning.optimise import Optimised, Scored, one_more
from skyless.site.planning.superframe import master_warnings, stamp_variances


class PointCheck(Struct, frozen=True):
    """Prediction and simulation at one point, metres; None where either has no fix."""

    position_m: tuple[float, float, float]
    predicted_sigma_m: float | None
    simulated_sigma_m: float | None
    ratio: float | None
    """Simulated over predicted standard deviation; ratio of RMSE if survey and ranges have errors."""
    ratio_error: float | None
    """Standard error of the ratio, from the scatter of the batches."""
    predicted_rmse_m: float | None
    simulated_rmse_m: float | None
    predicted_claim_m: float | None
    predicted_fix_share: float
    simulated_fix_share: float
    """Share of the messages after the warm-up of the anchors that a tag there uses."""
    fixes: int


class Verification(Struct, frozen=True):
    """All checked points, and statistics of the ratios."""

    seed: int
    simulated_s: float
    points: tuple[PointCheck, ...]
    mean_ratio: float | None
    smallest_ratio: float | None
    largest_ratio: float | None
    mean_ratio_error: float | None


class AfterMetre(Struct, frozen=True):
    """Standard deviation that ``joint`` claims after a tag has walked a metre; ``stamps_``: without carrier phases."""

    walks: int
    """Number of walks with fixes, from places all over the floor, along x and along y."""
    median_sigma_m: float
    worst_sigma_m: float
    stamps_median_sigma_m: float
    stamps_worst_sigma_m: float


def plan_report(
    predictor: Predictor,
    floor: Floor,
    mounts: Mounts,
    mapped: PlanMap,
    summary: MapSummary,
    optimised: Optimised | None,
    checked: Verification | None,
) -> dict[str, Any]:
    """The whole report, SI units."""
    site, channel = predictor.site, predictor.channel
    heights = tuple(mapped.grid.heights_m.tolist())
    more = one_more(site, channel, floor, mounts, heights) if len(site.anchors) < 200 else None
    return {
        "site": site.name,
        "method": DEFAULT_METHOD,
        "tx_stamp_ps": site.noise.tx_stamp_ps,
        "rx_stamp_ps": site.noise.rx_stamp_ps,
        "range_m": range_of(channel),
        "superframe_s": superframe_s(site),
        "master": site.master if site.schedule.needs_master else None,
        "dimensions": 3 if site.tags.height_m is None else 2,
        "heights_m": heights,
        "region_m": floor.region_m,
        "outline_m": floor.outline_m,
        "step_m": mapped.grid.step_m,
        "computed_every_m": mapped.computed_every_m,
        **msgspec.to_builtins(summary),
        "walls_bias": mapped.has_bias,
        "anchors": [
            {
                "id": anchor.id,
                "x_m": anchor.x_m,
                "y_m": anchor.y_m,
                "z_m": anchor.z_m,
                "hears_master": None if predictor.master is None else float(predictor.hears_master[row]),
                "sends": bool(predictor.superframe.sent[row]),
            }
            for row, anchor in enumerate(site.anchors)
        ],
        "warnings": plan_warnings(predictor, floor, mapped),
        "after_metre": _after_metre(predictor, floor, heights),
        "one_more": more,
        "optimised": None if optimised is None else _optimised(optimised),
        "verification": checked,
    }


_WALKED_PLACES: Final = 6


def _after_metre(predictor: Predictor, floor: Floor, heights_m: tuple[float, ...]) -> AfterMetre | None:
    """Benefit of carrier phases to walking tags; None if the site has none."""
    if predictor.site.schedule.carrier_phase is not True:
        return None
    points, _ = sample_points(floor, heights_m, _WALKED_PLACES)
    with_phases, stamps = (predictor.walked_sigma(points, has_phases=has_phases) for has_phases in (True, False))
    with_phases, stamps = with_phases[stamps < predictor.farthest_m], stamps[stamps < predictor.farthest_m]
    if len(stamps) == 0:
        return None
    figures = (float(figure(sigma_m)) for sigma_m in (with_phases, stamps) for figure in (np.median, np.max))
    return AfterMetre(len(stamps), *figures)


def _optimised(found: Optimised) -> dict[str, Any]:
    return {
        "best": _scored(found.best),
        "even": _scored(found.even),
        "mean_ratio": found.best.mean_sigma_m / found.even.mean_sigma_m,
        "worst_ratio": found.best.worst_sigma_m / found.even.worst_sigma_m,
        "target_met": found.target_met,
        "evaluations": found.evaluations,
        "finished": found.finished,
    }


def _scored(scored: Scored) -> dict[str, Any]:
    return {
        "mean_sigma_m": scored.mean_sigma_m,
        "worst_sigma_m": scored.worst_sigma_m,
        "covered_share": scored.covered_share,
        "master": scored.site.master if scored.site.schedule.needs_master else None,
        "anchors": [(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in scored.site.anchors],
    }


def described(result: dict[str, Any]) -> str:
    """Assumptions of a plan in one line."""
    tx_ps, rx_ps = result["tx_stamp_ps"], result["rx_stamp_ps"]
    noise = f"{tx_ps:g} ps" if tx_ps == rx_ps else f"{tx_ps:g} ps (TX) and {rx_ps:g} ps (RX)"
    return (
        f"predicted for {result['method']} with stamps of {noise}, "
        f"{'periods' if result['master'] is None else 'superframes'} of {1e3 * result['superframe_s']:.1f} ms, "
        "tags at rest"
    )


_WEAK_RATIO: Final = 2.0  # a position is weak if its error exceeds this multiple of the median
_MIRROR_POINTS: Final = 150


def plan_warnings(predictor: Predictor, floor: Floor, plan: PlanMap) -> list[str]:
    """Warnings of anything that may cost accuracy or the fix, from the site and its map."""
    return [
        *warnings_of(predictor.site),
        *master_warnings(predictor.site, predictor.channel),
        *_mirrors(predictor, floor, plan),
        *_holes(plan),
        *_weak(plan),
        *_walls(plan),
    ]


def _mirrors(predictor: Predictor, floor: Floor, plan: PlanMap) -> Iterator[str]:
    """Warn of positions with a mirror image that fits as well, according to the solver with exact TDoAs."""
    points, _ = sample_points(floor, tuple(plan.grid.heights_m.tolist()), _MIRROR_POINTS)
    tx_var, rx_var = stamp_variances(predictor.site)
    height = predictor.site.tags.height_m
    share, _ = predictor.scene.heard_at(points)
    ambiguous = [
        point
        for point, seen in zip(points, share >= IN_VIEW, strict=True)
        if _has_mirror(predictor.anchors_m[seen], point, height, tx_var, rx_var)
    ]
    if ambiguous:
        x, y, z = ambiguous[len(ambiguous) // 2]
        yield (
            f"{len(ambiguous) / len(points):.0%} of the region has a mirror image that explains the measurements as "
            f"well, for one around ({x:.1f}, {y:.1f}, {z:.1f}): vary the anchors' heights, or set tags.height_m if it "
            "is known"
        )


def _has_mirror(anchors: Array, point: Array, height_m: float | None, tx_var: float, rx_var: float) -> bool:
    """Whether the anchors in view, shape (n, 3), or the nearest of many, leave two possible positions."""
    anchors = anchors[np.sort(np.argsort(np.linalg.norm(anchors - point, axis=1))[:MAX_ANCHORS])]
    if len(anchors) < (4 if height_m is None else 3):
        return False
    ranges = np.linalg.norm(anchors - point, axis=1)
    covariance = literal_covariance(np.full(len(anchors) - 1, 0.5), tx_var, rx_var)
    solution = locate(anchors, ranges[1:] - ranges[0], covariance, height_m=height_m)
    return isinstance(solution, NoSolution) and solution.reason is NoFixReason.MIRROR


def _holes(plan: PlanMap) -> Iterator[str]:
    missing = np.where(plan.grid.within, plan.column(FIX_SHARE), np.nan) < 0.5
    if missing.any():
        part, (x, y, z) = missing.sum() / plan.grid.points, _central(plan, missing)
        yield f"{part:.1%} of the region has no fix most of the time, as around ({x:.1f}, {y:.1f}, {z:.1f})"


def _weak(plan: PlanMap) -> Iterator[str]:
    sigma = np.where(plan.column(FIX_SHARE) >= 0.5, plan.column(SIGMA), np.nan)
    if not np.isfinite(sigma).any():
        return
    median, worst = float(np.nanmedian(sigma)), float(np.nanmax(sigma))
    if worst >= _WEAK_RATIO * median:
        part = float(np.nansum(sigma > _WEAK_RATIO * median)) / plan.grid.points
        x, y, z = _central(plan, sigma == worst)
        yield (
            f"weak corner at ({x:.1f}, {y:.1f}, {z:.1f}): {100 * worst:.1f} cm, {worst / median:.1f} times the median; "
            f"{part:.1%} of the region is worse than {_WEAK_RATIO:g} times the median"
        )


def _walls(plan: PlanMap) -> Iterator[str]:
    bias, sigma = plan.column(BIAS), plan.column(SIGMA)
    known = np.isfinite(bias) & np.isfinite(sigma)
    worse = known & (bias > sigma)
    if worse.any():
        # The prediction does not include joint's fault monitors (docs/planning.md).
        yield (
            f"walls' delays shift positions by more than their standard deviation in {worse.sum() / known.sum():.0%} "
            f"of the region, by {100 * float(bias[known].max()):.0f} cm at most; joint may take delays for faults of "
            "anchors there, and err more than predicted"
        )


def _central(plan: PlanMap, where: Mask) -> tuple[float, float, float]:
    k, y, x = np.nonzero(where)
    points = np.column_stack([plan.grid.x_m[x], plan.grid.y_m[y], plan.grid.heights_m[k]])
    nearest = points[np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1))]
    return float(nearest[0]), float(nearest[1]), float(nearest[2])
