"""Warnings of a plan: links, geometry, mirrors, weak corners and holes, each in a sentence."""

from typing import Final

import numpy as np

from skyless.kernels.arrays import Array, Mask
from skyless.method_names import FILTERS
from skyless.planning.anchor_clocks import stamp_variances
from skyless.planning.columns import BIAS, FIX_SHARE, SIGMA
from skyless.planning.floor import Floor, sample_points
from skyless.planning.links import IN_VIEW
from skyless.planning.maps import PlanMap
from skyless.planning.predict import Predictor
from skyless.planning.reception import master_warnings
from skyless.planning.snapshot_sigma import delays
from skyless.positioning.fix import NoFixReason
from skyless.positioning.methods.locate import NoSolution, locate
from skyless.positioning.methods.snapshots import literal_covariance
from skyless.site.advice import warnings_of

_WEAK_RATIO: Final = 2.0
"""A position is weak where the error exceeds this multiple of the median."""

_MIRROR_POINTS: Final = 150


def plan_warnings(predictor: Predictor, floor: Floor, plan: PlanMap) -> list[str]:
    """All that may cost accuracy or the fix, from the site alone and from its map."""
    return [
        *warnings_of(predictor.site),
        *master_warnings(predictor.site, predictor.settings.channel),
        *_order(predictor),
        *_mirrors(predictor, floor, plan),
        *_holes(plan),
        *_weak(plan),
        *_walls(predictor, plan),
    ]


def _order(predictor: Predictor) -> list[str]:
    if predictor.settings.method in FILTERS:
        return []
    kappa, _ = delays(predictor.site)
    early = [anchor.id for anchor, delay in zip(predictor.site.anchors, kappa, strict=True) if delay < 0.0]
    if not early:
        return []
    numbers = ", ".join(map(str, early))
    return [f"anchor {numbers}: sends before the master in a round, and {predictor.settings.method} cannot use it"]


def _mirrors(predictor: Predictor, floor: Floor, plan: PlanMap) -> list[str]:
    """Ask the solver itself, with TDoAs that are exact, whether a position has a mirror image that fits as well."""
    points, _ = sample_points(floor, tuple(plan.grid.heights_m.tolist()), _MIRROR_POINTS)
    tx_var, rx_var = stamp_variances(predictor.site)
    height = predictor.site.tags.height_m
    share, _ = predictor.scene.heard_at(points)
    ambiguous = [
        point
        for point, seen in zip(points, share >= IN_VIEW, strict=True)
        if _has_mirror(predictor.anchors_m[seen], point, height, tx_var, rx_var)
    ]
    if not ambiguous:
        return []
    x, y, z = ambiguous[len(ambiguous) // 2]
    return [
        f"{len(ambiguous) / len(points):.0%} of the region has a mirror image that explains the measurements as well, "
        f"for one around ({x:.1f}, {y:.1f}, {z:.1f}): vary the anchors' heights, or set tags.height_m if it is known"
    ]


def _has_mirror(anchors: Array, point: Array, height_m: float | None, tx_var: float, rx_var: float) -> bool:
    """Whether the anchors in view, shape (n, 3), leave two positions."""
    if len(anchors) < (4 if height_m is None else 3):
        return False
    ranges = np.linalg.norm(anchors - point, axis=1)
    covariance = literal_covariance(np.full(len(anchors) - 1, 0.5), tx_var, rx_var)
    solution = locate(anchors, ranges[1:] - ranges[0], covariance, height_m=height_m)
    return isinstance(solution, NoSolution) and solution.reason is NoFixReason.MIRROR


def _holes(plan: PlanMap) -> list[str]:
    share = np.where(plan.grid.within, plan.column(FIX_SHARE), np.nan)
    missing = share < 0.5
    if not missing.any():
        return []
    part = missing.sum() / (plan.grid.points)
    x, y, z = _central(plan, missing)
    return [f"{part:.1%} of the region has no fix most of the time, as around ({x:.1f}, {y:.1f}, {z:.1f})"]


def _weak(plan: PlanMap) -> list[str]:
    """The worst position of those whose error is a multiple of the median."""
    sigma = np.where(plan.column(FIX_SHARE) >= 0.5, plan.column(SIGMA), np.nan)
    if not np.isfinite(sigma).any():
        return []
    median, worst = float(np.nanmedian(sigma)), float(np.nanmax(sigma))
    if worst < _WEAK_RATIO * median:
        return []
    part = float(np.nansum(sigma > _WEAK_RATIO * median)) / plan.grid.points
    x, y, z = _central(plan, sigma == worst)
    return [
        f"weak corner at ({x:.1f}, {y:.1f}, {z:.1f}): {100 * worst:.1f} cm, {worst / median:.1f} times the median; "
        f"{part:.1%} of the region is worse than {_WEAK_RATIO:g} times the median"
    ]


def _walls(predictor: Predictor, plan: PlanMap) -> list[str]:
    bias, sigma = plan.column(BIAS), plan.column(SIGMA)
    known = np.isfinite(bias) & np.isfinite(sigma)
    worse = known & (bias > sigma)
    if not worse.any():
        return []
    largest = float(bias[known].max())
    # its monitors are not in the prediction (docs/planning.md)
    monitors = "; joint may take delays for faults of anchors there, and err more than predicted"
    return [
        f"walls' delays shift positions by more than their standard deviation in {worse.sum() / known.sum():.0%} of "
        f"the region, by {100 * largest:.0f} cm at most{monitors if predictor.settings.method == 'joint' else ''}"
    ]


def _central(plan: PlanMap, where: Mask) -> tuple[float, float, float]:
    """The marked point that is nearest to the middle of all marked ones."""
    k, y, x = np.nonzero(where)
    points = np.column_stack([plan.grid.x_m[x], plan.grid.y_m[y], plan.grid.heights_m[k]])
    nearest = points[np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1))]
    return float(nearest[0]), float(nearest[1]), float(nearest[2])
