"""Predictions against the simulated world: tags at rest at given points, each one's errors beside its prediction."""

from collections.abc import Callable
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from skyless.air.schedule import schedule_of
from skyless.experiments.fleet import Fleet, FleetSettings
from skyless.experiments.scenarios import Request, impairments_of
from skyless.methods import FILTERS
from skyless.planning.columns import CLAIMED, FIX_SHARE, RMSE, SIGMA
from skyless.planning.maps import PlanMap
from skyless.planning.predict import Predictor
from skyless.simulation.trajectory import Static

Matrix = NDArray[np.float64]

WARM_UP_S: Final = 3.0
BATCH_ROUNDS: Final = 60
"""Superframes that make a batch: longer than the filters remember, so that batches are independent."""


class PointCheck(Struct, frozen=True):
    """One point: prediction and simulation, metres; None where either has no fix."""

    position_m: tuple[float, float, float]
    predicted_sigma_m: float | None
    simulated_sigma_m: float | None
    ratio: float | None
    """Simulated over predicted standard deviation."""
    ratio_error: float | None
    """Standard error of the ratio, from the scatter of the batches."""
    predicted_rmse_m: float | None
    simulated_rmse_m: float | None
    predicted_claim_m: float | None
    predicted_fix_share: float
    simulated_fix_share: float
    """Of the rounds (snapshots) or messages (filters) after the warm-up."""
    fixes: int


class Verification(Struct, frozen=True):
    """All points, and how far the ratios lie from one."""

    method: str
    seed: int
    simulated_s: float
    points: tuple[PointCheck, ...]
    mean_ratio: float | None
    smallest_ratio: float | None
    largest_ratio: float | None
    mean_ratio_error: float | None


class _Batches:
    """Sums of one tag's errors, batch by batch."""

    def __init__(self, batch_s: float) -> None:
        self._batch_s = batch_s
        self._sums: dict[int, Matrix] = {}

    def add(self, time_s: float, error_m: Matrix) -> None:
        sums = self._sums.setdefault(int(time_s / self._batch_s), np.zeros(5))
        sums[0] += 1.0
        sums[1:4] += error_m
        sums[4] += error_m @ error_m

    @property
    def fixes(self) -> int:
        return int(sum(sums[0] for sums in self._sums.values()))

    def statistics(self) -> tuple[float, float, float]:
        """Standard deviation about the mean, root mean square, and the relative standard error of the former."""
        rows = np.array(list(self._sums.values()))
        total = rows.sum(axis=0)
        mean = total[1:4] / total[0]
        variance = total[4] / total[0] - mean @ mean
        spread = rows[:, 4] - 2.0 * rows[:, 1:4] @ mean + rows[:, 0] * (mean @ mean) - rows[:, 0] * variance
        count = len(rows)
        error = np.sqrt((spread @ spread) * count / max(count - 1, 1)) / (total[0] * variance)
        return float(np.sqrt(variance)), float(np.sqrt(total[4] / total[0])), float(error / 2.0)


def random_points(plan: PlanMap, count: int, seed: int) -> Matrix:
    """So many points, evenly random over a map's region and between its heights, shape (count, 3)."""
    grid, random = plan.grid, np.random.default_rng(seed)
    half = 0.5 * grid.step_m
    y, x = np.nonzero(grid.within)
    chosen = random.integers(len(x), size=count)
    places = np.column_stack([grid.x_m[x[chosen]], grid.y_m[y[chosen]]]) + random.uniform(-half, half, (count, 2))
    levels = random.uniform(grid.heights_m.min(), grid.heights_m.max(), count)
    points: Matrix = np.column_stack([places, levels])
    return points


def verify(
    predictor: Predictor,
    points_m: Matrix,
    rounds: int,
    seed: int,
    progress: Callable[[float], None] | None = None,
) -> Verification:
    """Let a tag rest at each point, shape (m, 3), for so many superframes, and compare."""
    site, settings = predictor.site, predictor.settings
    superframe_s = 1.0 / schedule_of(site).superframe_rate_hz
    impairments = replace(impairments_of(Request(site=site), site), channel=settings.channel)
    still = [Static(*point) for point in points_m.tolist()]
    warm_up_s = max(WARM_UP_S, 60.0 * superframe_s)
    fleet = Fleet(site, still, impairments, seed, FleetSettings(settings.method, settings.qa, warm_up_s))
    batches = [_Batches(BATCH_ROUNDS * superframe_s) for _ in still]
    end_s, now_s = warm_up_s + rounds * superframe_s, 0.0
    while now_s < end_s:
        now_s = min(now_s + 0.25, end_s)
        for judged in fleet.run(now_s):
            if judged.time_s >= warm_up_s:
                batches[judged.tag].add(judged.time_s, judged.error_m)
        if progress is not None:
            progress(now_s / end_s)
    per_round = len(predictor.clocks.sender) if settings.method in FILTERS else 1
    rows = predictor.at(points_m)
    checks = [
        _check(point, row, batch, rounds * per_round * _frames(predictor))
        for point, row, batch in zip(points_m, rows, batches, strict=True)
    ]
    return _summary(settings.method, seed, end_s, checks)


def _frames(predictor: Predictor) -> int:
    """Snapshot methods give a fix in every round, of which a superframe has one for each frame of a node."""
    return 1 if predictor.settings.method in FILTERS else predictor.site.schedule.frames_per_node


def _check(point: Matrix, row: Matrix, batch: _Batches, possible: int) -> PointCheck:
    predicted = bool(np.isfinite(row[SIGMA]))
    std_m = rmse_m = error = None
    if batch.fixes > 1:
        std_m, rmse_m, error = batch.statistics()
    both = predicted and std_m is not None
    x, y, z = point.tolist()
    return PointCheck(
        position_m=(x, y, z),
        predicted_sigma_m=float(row[SIGMA]) if predicted else None,
        simulated_sigma_m=std_m,
        ratio=std_m / float(row[SIGMA]) if both and std_m is not None else None,
        ratio_error=error * (std_m or 0.0) / float(row[SIGMA]) if both and error is not None else None,
        predicted_rmse_m=float(row[RMSE]) if predicted else None,
        simulated_rmse_m=rmse_m,
        predicted_claim_m=float(row[CLAIMED]) if predicted else None,
        predicted_fix_share=float(row[FIX_SHARE]),
        simulated_fix_share=batch.fixes / possible,
        fixes=batch.fixes,
    )


def _summary(method: str, seed: int, simulated_s: float, checks: list[PointCheck]) -> Verification:
    ratios = [check.ratio for check in checks if check.ratio is not None]
    errors = [check.ratio_error for check in checks if check.ratio_error is not None]
    return Verification(
        method=method,
        seed=seed,
        simulated_s=simulated_s,
        points=tuple(checks),
        mean_ratio=float(np.mean(ratios)) if ratios else None,
        smallest_ratio=min(ratios, default=None),
        largest_ratio=max(ratios, default=None),
        mean_ratio_error=float(np.mean(errors)) if errors else None,
    )
