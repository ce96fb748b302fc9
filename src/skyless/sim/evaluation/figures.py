"""Citable figures: errors of fixes against the truth, and whether the fixes' own claims hold.

``docs/recordings.md`` defines each. Replays, benchmarks and the Python interface all take them from here.
"""

import math
from array import array
from bisect import bisect_right
from collections import Counter
from struct import Struct as Format
from typing import Any, Final

import numpy as np
from msgspec import Struct

from skyless.core.alert import Alert
from skyless.core.any_anchor import superframe_s
from skyless.core.arrays import Array, Mask, Matrix, Vector
from skyless.core.fix import Fix
from skyless.core.site import Site
from skyless.site.tables import Truth

# Which fixes are judged, and tallies of errors and protection levels, in bounded memory.
#
# Sums are exact; percentiles, medians and plots come from an even sample of the run.

_SAMPLE_ROWS: Final = 1 << 17
"""Most rows kept; with fewer, percentiles are exact."""


class FirstFixes:
    """Picks the first fix of each tag and superframe, so that all methods are judged at the same times."""

    def __init__(self, site: Site, tags: int) -> None:
        self.superframe_s = superframe_s(site)
        self._last = [-1] * tags

    def is_first(self, tag: int, time_s: float) -> bool:
        """Whether a fix at that true time is the tag's first one in its superframe."""
        superframe = int(time_s / self.superframe_s)
        if superframe == self._last[tag]:
            return False
        self._last[tag] = superframe
        return True


class EvenSample:
    """Every k-th row of a stream, with k doubling whenever the store is full: even and reproducible."""

    def __init__(self, columns: int, rows: int = _SAMPLE_ROWS) -> None:
        self._columns = columns
        self._most = rows * columns
        self._store = array("d")
        self._stride = 1
        self.seen = 0
        """Rows offered so far."""

    def add(self, row: tuple[float, ...]) -> None:
        """Offer one row."""
        seen = self.seen
        self.seen = seen + 1
        if seen % self._stride:
            return
        if len(self._store) >= self._most:
            self._store = array("d", self.rows[::2].tobytes())
            self._stride *= 2
            if seen % self._stride:
                return
        self._store.extend(row)

    @property
    def rows(self) -> Array:
        """The rows kept, shape (kept, columns), in order; a copy."""
        return np.array(self._store).reshape(-1, self._columns)


class ErrorSummary(Struct, frozen=True):
    """Errors of a run in metres; None if there were none to judge."""

    count: int
    rmse_2d_m: float | None
    rmse_3d_m: float | None
    p95_m: float | None
    max_m: float | None
    bias_m: tuple[float, float, float] | None


class ErrorStatistics:
    """Accumulates position errors."""

    def __init__(self, *, planar: bool) -> None:
        """``planar``: percentiles and maximum refer to the horizontal error, as the height was given."""
        self._planar = planar
        self.count = 0
        """Number of errors."""
        self._origin = (0.0, 0.0, 0.0)
        """The first vector: sums are relative to it, so that no digits are lost far from the site's origin."""
        self._sum = [0.0, 0.0, 0.0]
        self._squares = [0.0, 0.0, 0.0]
        self._max = 0.0
        self._sample = EvenSample(1)

    def add(self, x_m: float, y_m: float, z_m: float) -> None:
        """Add one error vector."""
        if self.count == 0:
            self._origin = (x_m, y_m, z_m)
        self.count += 1
        for axis, value in enumerate((x_m, y_m, z_m)):
            offset = value - self._origin[axis]
            self._sum[axis] += offset
            self._squares[axis] += offset * offset
        error_m = (x_m * x_m + y_m * y_m + (0.0 if self._planar else z_m * z_m)) ** 0.5
        self._max = max(self._max, error_m)
        self._sample.add((error_m,))

    def summary(self) -> ErrorSummary:
        """Figures of all errors."""
        count = self.count
        if count == 0:
            return ErrorSummary(0, None, None, None, None, None)
        x_m, y_m, z_m = (start + total / count for start, total in zip(self._origin, self._sum, strict=True))
        means_m = (x_m, y_m, z_m)
        mean_squares = [
            mean**2 + max(square / count - (total / count) ** 2, 0.0)
            for mean, square, total in zip(means_m, self._squares, self._sum, strict=True)
        ]
        return ErrorSummary(
            count=count,
            rmse_2d_m=(mean_squares[0] + mean_squares[1]) ** 0.5,
            rmse_3d_m=None if self._planar else sum(mean_squares) ** 0.5,
            p95_m=float(np.percentile(self._sample.rows, 95)),
            max_m=self._max,
            bias_m=means_m,
        )


class LevelReport(Struct, frozen=True):
    """Protection levels of all judged fixes of a method that has them."""

    integrity_risk: float
    available: float
    """Share of fixes with a level."""
    misleading: int
    """Fixes whose horizontal or vertical error exceeds their level."""
    hpl_m: float | None
    """Median of the horizontal levels, None if there are none."""
    alerts: dict[str, int]
    """Fixes by alert."""


class LevelTally:
    """Counts fixes by their protection levels and whether these held."""

    def __init__(self, tags: int, sample_rows: int) -> None:
        self.risk: float | None = None
        """As the fixes state it; None if none was judged or the method has no levels."""
        self.fixes, self.levels, self.exceeded, self.unwarned = np.zeros((4, tags))
        """Of each tag: judged fixes, of these with a horizontal level, of these beyond it, of these without alert."""
        self._misleading = 0
        self._alerts: Counter[str] = Counter()
        self._sample = EvenSample(1, sample_rows)

    def add(self, tag: int, fix: Fix, error_m: Array) -> None:
        """Add a fix and its error, shape (3,)."""
        integrity = fix.integrity
        if integrity is None:
            return
        self.risk = fix.integrity_risk
        self._alerts[integrity.alert.value] += 1
        self.fixes[tag] += 1
        hpl_m, vpl_m = integrity.hpl_m, integrity.vpl_m
        if hpl_m is None:
            return
        self._sample.add((hpl_m,))
        self.levels[tag] += 1
        exceeded = math.hypot(error_m[0], error_m[1]) > hpl_m
        self._misleading += exceeded or (vpl_m is not None and bool(abs(error_m[2]) > vpl_m))
        if exceeded:
            self.exceeded[tag] += 1
            self.unwarned[tag] += integrity.alert is Alert.NONE

    @property
    def hpl_m(self) -> Array:
        """An even sample of the horizontal levels."""
        return self._sample.rows[:, 0]

    def report(self) -> LevelReport | None:
        """Report of all tags together; None if no fix was judged or the method has no levels."""
        if self.risk is None:
            return None
        levels = float(self.levels.sum())
        median_m = float(np.median(self.hpl_m)) if levels else None
        available = levels / float(self.fixes.sum())
        return LevelReport(self.risk, available, self._misleading, median_m, dict(sorted(self._alerts.items())))


# The truth of a recording: carried to the antenna, interpolated, and shifted in time.

Triple = tuple[float, float, float]

FLIGHT_M: Final = 0.3
"""A drone above this height is flying."""

MAX_GAP_S: Final = 1.0
"""Longer gaps in the table have no truth."""

_WIDEST_OFFSET_S: Final = 5.0
_OFFSET_ROWS: Final = 5_000
"""Fixes used to estimate an offset, an even sample."""


def flies(truth: Truth) -> bool:
    """Whether the tag starts on the floor and then spends most of its time well above it."""
    heights = truth.position_m[:, 2]
    return bool(heights[0] < FLIGHT_M and np.median(heights) > 2.0 * FLIGHT_M)


def antenna_truth(truth: Truth, lever_arm_m: Triple) -> Truth:
    """The truth moved from the body to the antenna; without an attitude the body is assumed level.

    ``lever_arm_m`` is the antenna in the body's frame.
    """
    arm = np.array(lever_arm_m)
    if truth.quaternion is None:
        return Truth(truth.t_s, truth.position_m + arm, None)
    vector, scalar = truth.quaternion[:, :3], truth.quaternion[:, 3:]
    turned = arm + 2.0 * np.cross(vector, np.cross(vector, arm) + scalar * arm)
    return Truth(truth.t_s, truth.position_m + turned, truth.quaternion)


def truth_at(truth: Truth | None, times_s: Vector) -> Matrix:
    """True positions by linear interpolation, shape (n, 3): NaN outside the table and in its gaps."""
    times_s = np.asarray(times_s, dtype=np.float64)
    if truth is None or len(truth.t_s) == 0:
        return np.full((len(times_s), 3), np.nan)
    known_s = truth.t_s
    places_m = np.column_stack([np.interp(times_s, known_s, axis, np.nan, np.nan) for axis in truth.position_m.T])
    after = np.searchsorted(known_s, times_s).clip(1, max(len(known_s) - 1, 1))
    if len(known_s) > 1:
        before_s, after_s = known_s[after - 1], known_s[after]
        places_m[(after_s - before_s > MAX_GAP_S) & (times_s != before_s) & (times_s != after_s)] = np.nan
    return places_m


class TruthTrack:
    """``truth_at`` for single times, ten times as fast as with arrays of one."""

    def __init__(self, truth: Truth | None) -> None:
        self._times: list[float] = [] if truth is None else truth.t_s.tolist()
        self._places: Array = np.empty((0, 3)) if truth is None else truth.position_m

    def at(self, time_s: float) -> Triple | None:
        """True position, None outside the table and in its gaps."""
        times = self._times
        if not times or not times[0] <= time_s <= times[-1]:
            return None
        after = min(bisect_right(times, time_s), len(times) - 1)
        before_s, span_s = times[after - 1], times[after] - times[after - 1]
        if span_s > MAX_GAP_S and time_s not in (before_s, times[after]):
            return None
        part = (time_s - before_s) / span_s if span_s > 0.0 else 0.0
        x, y, z = (self._places[after - 1] + part * (self._places[after] - self._places[after - 1])).tolist()
        return x, y, z


def shifted(truth: Truth, offset_s: float) -> Truth:
    """The truth with ``offset_s`` added to its times."""
    return Truth(truth.t_s + offset_s, truth.position_m, truth.quaternion)


def estimated_offset_s(truth: Truth, times_s: Vector, position_m: Matrix) -> float | None:
    """The offset of the truth's times at which it fits positions of shape (n, 3) best; None if none stands out.

    It minimises the median horizontal error within five seconds. A tag at rest has none.
    """
    kept = slice(None, None, max(len(times_s) // _OFFSET_ROWS, 1))
    times_s, position_m = times_s[kept], position_m[kept]

    def misfit_m(offset_s: float) -> float:
        error_m = np.linalg.norm((position_m - truth_at(truth, times_s - offset_s))[:, :2], axis=1)
        known = np.isfinite(error_m)
        return float(np.median(error_m[known])) if 2 * known.sum() > len(error_m) else np.inf

    best_s, around_s, misfits = 0.0, _WIDEST_OFFSET_S, [np.inf]
    for step_s in (0.1, 0.01, 0.001):
        offsets_s = best_s + np.arange(-around_s, around_s + step_s / 2.0, step_s)
        found = [misfit_m(offset_s) for offset_s in offsets_s]
        misfits = found if around_s == _WIDEST_OFFSET_S else misfits
        best_s, around_s = float(offsets_s[int(np.argmin(found))]), step_s
    known = np.array(misfits)[np.isfinite(misfits)]
    return best_s if len(known) and np.min(known) < 0.5 * np.median(known) else None


KEPT_FIXES: Final = 1 << 19
"""Of recordings with more fixes, every second, fourth, … one is judged."""

HOLD_S: Final = 1.0
"""A fix counts as current until the next one, but no longer than this."""

STEP_M: Final = 1.0
"""Length of the true path over which relative errors are taken."""

CHI2_95: Final = {2: 5.991464547107979, 3: 7.814727903251179}
"""95 % points of χ² with two and three degrees of freedom."""

_ALERTS: Final = tuple(Alert)
_NUMBER: Final = {alert: float(number) for number, alert in enumerate(_ALERTS)}
_NO_LEVELS: Final = (np.nan, np.nan, -1.0)
_PLACE: Final = Format("12d")
"""The position and covariance at the beginning of a fix's rows."""


class FixTable(Struct, frozen=True):
    """n fixes as arrays."""

    time_s: Vector
    """Shape (n,): in the recording's own time."""
    position_m: Matrix
    """Shape (n, 3)."""
    covariance_m2: Array
    """Shape (n, 3, 3); NaN if none is claimed."""
    levels_m: Matrix
    """Shape (n, 2): protection levels, horizontal and vertical; NaN if there is none."""
    alert: Vector
    """Shape (n,): number of the alert in ``Alert``; −1 without levels."""


def axes_std_m(covariance_m2: Array) -> Matrix:
    """Standard deviations of x, y and z from covariances of shape (n, 3, 3), shape (n, 3)."""
    std_m: Matrix = np.sqrt(np.diagonal(covariance_m2, axis1=1, axis2=2))
    return std_m


class FixSamples:
    """Collects fixes, 104 bytes each, in bounded memory."""

    def __init__(self) -> None:
        self._sample = EvenSample(13, KEPT_FIXES)

    def add(self, time_s: float, fix: Fix) -> None:
        """Add a fix; ``time_s`` is in the recording's own time."""
        integrity, levels = fix.integrity, _NO_LEVELS
        if integrity is not None:
            hpl_m, vpl_m = (np.nan if level_m is None else level_m for level_m in (integrity.hpl_m, integrity.vpl_m))
            levels = hpl_m, vpl_m, _NUMBER[integrity.alert]
        x, y, z, xx, xy, xz, _, yy, yz, _, _, zz = _PLACE.unpack_from(fix.rows)
        self._sample.add((time_s, x, y, z, xx, xy, xz, yy, yz, zz, *levels))

    @property
    def count(self) -> int:
        """Number of fixes added."""
        return self._sample.seen

    def table(self) -> FixTable:
        """All fixes, or an even sample."""
        rows = self._sample.rows
        covariance_m2 = rows[:, [4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(-1, 3, 3)
        return FixTable(rows[:, 0], rows[:, 1:4], covariance_m2, rows[:, 10:12], rows[:, 12])


class Judged(Struct, frozen=True):
    """Which fixes are judged: those after settling with a known and high enough true position."""

    truth: Truth | None
    begin_s: float | None
    """Time of the first record; None before it."""
    end_s: float
    planar: bool
    """Whether the height was given: then only the horizontal error is judged."""
    settle_s: float
    above_m: float | None = None
    """True height above which fixes are judged."""

    def of(self, times_s: Vector) -> tuple[Matrix, Mask]:
        """The truth at these times, shape (n, 3), and whether their fixes are judged, shape (n,)."""
        truth_m, masks = self.masks(times_s)
        return truth_m, masks["judged"]

    def masks(self, times_s: Vector) -> tuple[Matrix, dict[str, Mask]]:
        """The truth at these times, and masks of judged fixes and of each reason for leaving fixes out."""
        truth_m = truth_at(self.truth, times_s)
        settled = times_s - (self.begin_s or 0.0) >= self.settle_s
        known = np.isfinite(truth_m[:, 0])
        high = np.full(len(known), True) if self.above_m is None else ~(truth_m[:, 2] <= self.above_m)
        return truth_m, {
            "judged": settled & known & high,
            "settling": ~settled,
            "without-truth": settled & ~known,
            "below-height": settled & known & ~high,
        }


class Figures(Struct, frozen=True, kw_only=True):
    """Figures of a run; metres and seconds, None if unknown."""

    judged: int = 0
    """Judged fixes, ..."""
    judged_s: float = 0.0
    """... the time that they cover, ..."""
    left_out: dict[str, int] = {}
    """... and the number left out by reason: ``settling``, ``without-truth``, ``below-height``, ``thinned``."""
    median_m: Triple | None = None
    """Median position after the settling time."""
    std_m: Triple | None = None
    """Standard deviation of the position after the settling time, for tags at rest."""
    rmse_2d_m: float | None = None
    rmse_3d_m: float | None = None
    """Root mean square errors; all 3-D figures are None if the height was given."""
    rmse_axes_m: Triple | None = None
    p50_2d_m: float | None = None
    p75_2d_m: float | None = None
    p95_2d_m: float | None = None
    max_2d_m: float | None = None
    p50_3d_m: float | None = None
    p75_3d_m: float | None = None
    p95_3d_m: float | None = None
    max_3d_m: float | None = None
    bias_m: Triple | None = None
    """Mean error."""
    sigma_2d_m: float | None = None
    sigma_3d_m: float | None = None
    """Claimed: root of the mean trace of the covariances."""
    nees: float | None = None
    """Mean of the squared error over the claimed covariance, per degree of freedom: 1 if the claim is right."""
    beyond_95: float | None = None
    """Share of fixes outside the ellipse or ellipsoid that should contain 95 % of them."""
    ate_m: float | None = None
    """Absolute trajectory error: RMSE after the best rotation and translation."""
    rpe_m: float | None = None
    """Relative trajectory error: RMSE of the displacement over each ``STEP_M`` of the true path."""
    levels: int = 0
    """Fixes with a protection level and a known truth, from the first fix on, ..."""
    exceeded_horizontal: int = 0
    exceeded_vertical: int = 0
    """... those of them whose error exceeds it, ..."""
    exceeded_unalerted: int = 0
    """... and those of these without an alert."""
    hpl_m: float | None = None
    vpl_m: float | None = None
    """Medians of the levels."""
    alerts: dict[str, int] = {}
    """Fixes by alert, from the first fix on."""
    availability: float | None = None
    """Share of the recording's time in which the newest fix is at most ``HOLD_S`` old."""
    first_fix_s: float | None = None
    """From the first record on."""
    first_fix_error_m: float | None = None


def figures_of(table: FixTable, how: Judged, count: int | None = None) -> Figures:
    """Figures of fixes; ``count`` is the total number if the table is a sample."""
    if how.begin_s is None or len(table.time_s) == 0:
        return Figures()
    dim, time_s = 2 if how.planar else 3, table.time_s
    truth_m, masks = how.masks(time_s)
    here, all_errors_m = masks.pop("judged"), (table.position_m - truth_m)[:, :dim]
    left_out = {name: int(mask.sum()) for name, mask in masks.items() if mask.any()}
    if count is not None and count > len(time_s):
        left_out["thinned"] = count - len(time_s)
    lengths_m = np.sqrt((all_errors_m**2).sum(axis=1))
    hold_s = np.diff(time_s, append=max(how.end_s, time_s[-1])).clip(0.0, HOLD_S)
    span_s = how.end_s - how.begin_s
    settled_m = table.position_m[~masks["settling"]]
    return Figures(
        judged=int(here.sum()),
        judged_s=float(hold_s[here].sum()),
        left_out=left_out,
        median_m=_triple(np.median(settled_m, axis=0)) if len(settled_m) else None,
        std_m=_triple(settled_m.std(axis=0)) if len(settled_m) else None,
        **_errors((table.position_m - truth_m)[here], dim),
        **_claims(all_errors_m[here], table.covariance_m2[here, :dim, :dim]),
        **_trajectory(table.position_m[here], truth_m[here], dim),
        **_levels(table, all_errors_m),
        availability=float(min(hold_s.sum() / span_s, 1.0)) if span_s > 0.0 else None,
        first_fix_s=float(time_s[0] - how.begin_s),
        first_fix_error_m=float(lengths_m[0]) if np.isfinite(lengths_m[0]) else None,
    )


def _triple(values: Array) -> Triple:
    x, y, z = values.tolist()
    return x, y, z


def _errors(error_m: Matrix, dim: int) -> dict[str, Any]:
    if len(error_m) == 0:
        return {}
    found: dict[str, Any] = {
        "rmse_axes_m": _triple(np.sqrt((error_m**2).mean(axis=0))),
        "bias_m": _triple(error_m.mean(axis=0)),
    }
    for of in range(2, dim + 1):
        length_m = np.sqrt((error_m[:, :of] ** 2).sum(axis=1))
        found[f"rmse_{of}d_m"] = float(np.sqrt((length_m**2).mean()))
        for share in (50, 75, 95):
            found[f"p{share}_{of}d_m"] = float(np.percentile(length_m, share))
        found[f"max_{of}d_m"] = float(length_m.max())
    return found


def _claims(error_m: Matrix, covariance_m2: Array) -> dict[str, Any]:
    """Errors of shape (n, dim) against their covariances (n, dim, dim)."""
    dim = error_m.shape[1]
    claimed: Mask = np.asarray(np.isfinite(covariance_m2).all(axis=(1, 2)))
    claimed[claimed] = np.linalg.det(covariance_m2[claimed]) > 0.0
    error_m, covariance_m2 = error_m[claimed], covariance_m2[claimed]
    if len(error_m) == 0:
        return {}
    nees = (error_m * np.linalg.solve(covariance_m2, error_m[..., None])[..., 0]).sum(axis=1)
    variances_m2 = np.diagonal(covariance_m2, axis1=1, axis2=2).mean(axis=0)
    sigmas = {f"sigma_{of}d_m": float(np.sqrt(variances_m2[:of].sum())) for of in range(2, dim + 1)}
    return {"nees": float(nees.mean() / dim), "beyond_95": float((nees > CHI2_95[dim]).mean()), **sigmas}


def _trajectory(position_m: Matrix, truth_m: Matrix, dim: int) -> dict[str, Any]:
    """Trajectory errors as defined by common tools for comparing trajectories (Sturm et al. 2012)."""
    if len(position_m) < 3:
        return {}
    position_m, truth_m = position_m.copy(), truth_m.copy()
    position_m[:, dim:] = truth_m[:, dim:] = 0.0
    centred_m, true_m = position_m - position_m.mean(axis=0), truth_m - truth_m.mean(axis=0)
    U, _, Vt = np.linalg.svd(true_m.T @ centred_m)
    U[:, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    found = {"ate_m": float(np.sqrt(((true_m - centred_m @ (U @ Vt).T) ** 2).sum(axis=1).mean()))}
    way_m = np.concatenate([[0.0], np.cumsum(np.sqrt((np.diff(truth_m, axis=0) ** 2).sum(axis=1)))])
    ends, last_m = [0], 0.0
    while (end := int(np.searchsorted(way_m, last_m + STEP_M))) < len(way_m):
        ends.append(end)
        last_m = way_m[end]
    if len(ends) > 1:
        gone_m = np.diff(position_m[ends], axis=0) - np.diff(truth_m[ends], axis=0)
        found["rpe_m"] = float(np.sqrt((gone_m**2).sum(axis=1).mean()))
    return found


def _levels(table: FixTable, error_m: Matrix) -> dict[str, Any]:
    horizontal_m, vertical_m = table.levels_m.T
    has_level = np.isfinite(error_m[:, 0]) & np.isfinite(horizontal_m)
    over = has_level & (np.hypot(error_m[:, 0], error_m[:, 1]) > horizontal_m)
    above = has_level & (np.abs(error_m[:, -1]) > vertical_m) if error_m.shape[1] == 3 else np.zeros_like(over)
    numbers, counts = np.unique(table.alert[table.alert >= 0.0], return_counts=True)
    medians = (np.median(level[np.isfinite(level)]) if np.isfinite(level).any() else None for level in table.levels_m.T)
    hpl_m, vpl_m = (None if median is None else float(median) for median in medians)
    return {
        "levels": int(has_level.sum()),
        "exceeded_horizontal": int(over.sum()),
        "exceeded_vertical": int(above.sum()),
        "exceeded_unalerted": int(((over | above) & (table.alert == _NUMBER[Alert.NONE])).sum()),
        "hpl_m": hpl_m,
        "vpl_m": vpl_m,
        "alerts": {_ALERTS[int(number)].value: int(n) for number, n in zip(numbers, counts, strict=True)},
    }
