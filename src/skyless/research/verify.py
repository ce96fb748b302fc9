"""Predictions against the simulated world: tags at rest at given points, each one's errors next to its prediction.

Where the site's survey and ranges have errors, there are many worlds, each with its own errors, and what is compared is
the RMSE over all of them.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from msgspec.structs import replace

from skyless.core.any_anchor import superframe_s as period_s
from skyless.core.arrays import Matrix
from skyless.sim.evaluation.fleet import Fleet, FleetSettings
from skyless.sim.evaluation.scenarios import Request, impairments_of, stated_room
from skyless.sim.trajectory import Static
from skyless.site.planning.links import CLAIMED, FIX_SHARE, RMSE, SIGMA
from skyless.site.planning.maps import PlanMap, Predictor
from skyless.site.planning.report import PointCheck, Verification

_WARM_UP_S: Final = 3.0
_BATCH_ROUNDS: Final = 60
"""Superframes that make a batch: longer than the filters remember, so that batches are independent."""

_WORLDS: Final = 20  # each with its own errors of survey and ranges


class _Batches:
    """Sums of one tag's errors, batch by batch."""

    def __init__(self) -> None:
        self._sums: dict[int, Matrix] = {}

    def add(self, batch: int, error_m: Matrix) -> None:
        sums = self._sums.setdefault(batch, np.zeros(5))
        sums[0] += 1.0
        sums[1:4] += error_m
        sums[4] += error_m @ error_m

    @property
    def fixes(self) -> int:
        return int(sum(sums[0] for sums in self._sums.values()))

    def statistics(self, *, about_mean: bool) -> tuple[float, float, float]:
        """Standard deviation, root mean square, and the relative standard error of either."""
        rows = np.array(list(self._sums.values()))
        total = rows.sum(axis=0)
        mean = total[1:4] / total[0]
        variance, mean_square = total[4] / total[0] - mean @ mean, total[4] / total[0]
        excess = rows[:, 4] - rows[:, 0] * mean_square
        if about_mean:
            excess += 2.0 * (rows[:, 0] * (mean @ mean) - rows[:, 1:4] @ mean)
        count, judged = len(rows), variance if about_mean else mean_square
        error = np.sqrt((excess @ excess) * count / max(count - 1, 1)) / (total[0] * judged)
        return float(np.sqrt(variance)), float(np.sqrt(mean_square)), float(error / 2.0)


def random_points(plan: PlanMap, count: int, seed: int) -> Matrix:
    """Points evenly random over a map's region and between its heights, shape (count, 3)."""
    grid, random = plan.grid, np.random.default_rng(seed)
    half = 0.5 * grid.step_m
    y, x = np.nonzero(grid.within)
    chosen = random.integers(len(x), size=count)
    flat = np.column_stack([grid.x_m[x[chosen]], grid.y_m[y[chosen]]]) + random.uniform(-half, half, (count, 2))
    levels = random.uniform(grid.heights_m.min(), grid.heights_m.max(), count)
    points: Matrix = np.column_stack([flat, levels])
    return points


def verify(
    predictor: Predictor, points_m: Matrix, rounds: int, seed: int, progress: Callable[[float], None] | None = None
) -> Verification:
    """Let a tag rest at each point, shape (m, 3), for ``rounds`` superframes, and compare."""
    site = predictor.site
    superframe_s = period_s(site)
    worlds = 1 if site.accuracy.is_exact else _WORLDS
    rounds = max(rounds // worlds, 1)
    still = [Static(*point) for point in points_m.tolist()]
    warm_up_s = max(_WARM_UP_S, 60.0 * superframe_s)
    batches = [_Batches() for _ in still]
    end_s = warm_up_s + rounds * superframe_s
    for world in range(worlds):
        slope_m = site.accuracy.slope_std_m * (-1.0) ** world  # one for all ranges: with both signs in turn
        room = None if worlds == 1 else stated_room(site, slope_m=slope_m, at_rest=True)
        request = Request(site=site, seed=seed + world, room=room)
        impairments = replace(impairments_of(request, site), channel=predictor.channel)
        fleet = Fleet(site, still, impairments, request.seed, FleetSettings(warmup_s=warm_up_s))
        now_s = 0.0
        while now_s < end_s:
            now_s = min(now_s + 0.25, end_s)
            for judged in fleet.run(now_s):
                if judged.time_s >= warm_up_s:
                    batch = int(judged.time_s / (_BATCH_ROUNDS * superframe_s)) if worlds == 1 else world
                    batches[judged.tag].add(batch, judged.error_m)
            if progress is not None:
                progress((world + now_s / end_s) / worlds)
    possible = (worlds * rounds * predictor.messages_at(points_m)).tolist()
    checks = [
        _check(point, row, batch, most, has_range_errors=worlds > 1)
        for point, row, batch, most in zip(points_m, predictor.at(points_m), batches, possible, strict=True)
    ]
    return _summary(seed, worlds * end_s, checks)


def _check(point: Matrix, row: Matrix, batch: _Batches, possible: int, *, has_range_errors: bool) -> PointCheck:
    predicted = bool(np.isfinite(row[SIGMA]))
    std_m = rmse_m = ratio = ratio_error = None
    if batch.fixes > 1:
        std_m, rmse_m, error = batch.statistics(about_mean=not has_range_errors)
        if predicted:
            ratio = rmse_m / float(row[RMSE]) if has_range_errors else std_m / float(row[SIGMA])
            ratio_error = error * ratio
    x, y, z = point.tolist()
    return PointCheck(
        position_m=(x, y, z),
        predicted_sigma_m=float(row[SIGMA]) if predicted else None,
        simulated_sigma_m=std_m,
        ratio=ratio,
        ratio_error=ratio_error,
        predicted_rmse_m=float(row[RMSE]) if predicted else None,
        simulated_rmse_m=rmse_m,
        predicted_claim_m=float(row[CLAIMED]) if predicted else None,
        predicted_fix_share=float(row[FIX_SHARE]),
        simulated_fix_share=batch.fixes / max(possible, 1),
        fixes=batch.fixes,
    )


def _summary(seed: int, simulated_s: float, checks: list[PointCheck]) -> Verification:
    ratios = [check.ratio for check in checks if check.ratio is not None]
    errors = [check.ratio_error for check in checks if check.ratio_error is not None]
    return Verification(
        seed=seed,
        simulated_s=simulated_s,
        points=tuple(checks),
        mean_ratio=float(np.mean(ratios)) if ratios else None,
        smallest_ratio=min(ratios, default=None),
        largest_ratio=max(ratios, default=None),
        mean_ratio_error=float(np.mean(errors)) if errors else None,
    )
