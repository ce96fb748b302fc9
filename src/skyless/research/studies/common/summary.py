"""From the worlds of a case to a row: standard errors from the scatter between worlds, intervals of rare shares."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from scipy.stats import chi2
from scipy.stats import t as student

from skyless.core.arrays import Array
from skyless.research.studies.common.plan import Cell, Limit, Plan, Row
from skyless.research.studies.common.worlds import Run, RunResult, run_world
from skyless.research.uncertainty.bounds import Biases

_MESSAGE_S: Final = 40e-6
"""About what a tag takes for a message, and an anchor with all that is simulated around it."""

RAW_METHODS: Final = ("joint",)
"""Methods that use what anchors hear of each other."""


_ALPHA: Final = 0.01
CLUSTER_FIXES: Final = 25.0
"""Fixes that may be misleading together, as neighbours share their errors, even if no such cluster was observed."""


class Case(Struct, frozen=True):
    """Worlds that differ by chance alone."""

    name: str
    series: str
    x: float | None
    runs: tuple[Run, ...]
    of: str | None = None
    """Case over whose RMSE this one's is the ratio, in worlds of the same seeds; it may have more of them."""
    limit: float | None = None
    limits: tuple[Limit, ...] = ()
    """On other figures than the ratio."""
    biases: Biases | None = None
    """What the worlds' ranges and anchors are off by, for the Cramér–Rao bound over which the ratio is then; None for
    cases without a bound."""


class WorldRow(Row, frozen=True, kw_only=True):
    """Results of simulated worlds."""

    outside: float | None = None
    """Share of fixes that lie outside of their own 99.9 % ellipse; 0.001 for true ones with Gaussian errors."""
    of: str | None = None
    """The case over whose RMSE ``ratio`` is."""
    cpu_us_per_message: float | None = None
    cpu_ms_per_tag_s: float | None = None
    """Time of one core for each second of a tag."""


def world_cells(cases: Sequence[Case]) -> list[Cell]:
    """One cell for each world."""
    return [Cell(case.name, partial(run_world, run), _weight_s(run)) for case in cases for run in case.runs]


def _weight_s(run: Run) -> float:
    frames = run.until_s / run.site.schedule.slot_s
    return frames * _MESSAGE_S * (len(run.trajectories) + len(run.site.anchors))


def world_rows(study: str, plan: Plan, cases: Sequence[Case], results: Sequence[RunResult]) -> list[WorldRow]:
    """A row for each case; the results stand in the order of ``world_cells``."""
    worlds = {case.name: own for case, own in zip(cases, by_case(cases, results), strict=True)}
    return [
        case_row(study, plan, case, worlds[case.name], worlds[case.of][: len(case.runs)] if case.of else None)
        for case in cases
    ]


def by_case(cases: Sequence[Case], results: Sequence[Any]) -> list[list[Any]]:
    """The results of each case's worlds, of those in the order of ``world_cells``."""
    rest = iter(results)
    return [[next(rest) for _ in case.runs] for case in cases]


def case_row(
    study: str, plan: Plan, case: Case, worlds: list[RunResult], reference: list[RunResult] | None
) -> WorldRow:
    """The row of a case's worlds; ``reference``: those of the case over whose RMSE its ratio is."""
    cpu_s = sum(world.cpu_s for world in worlds)
    fixes = sum(world.fixes for world in worlds)
    row = WorldRow(
        study=study,
        method=plan.method,
        case=case.name,
        series=case.series,
        x=case.x,
        mesh=True if plan.method in RAW_METHODS else None,
        noise_ps=plan.noise_ps,
        runs=len(worlds),
        fixes=fixes,
        rmse_m=None,
        available=fixes / max(sum(world.superframes for world in worlds), 1),
        of=case.of,
        limit=case.limit,
        passed=None if case.limit is None else False,
        cpu_us_per_message=1e6 * cpu_s / max(sum(world.messages for world in worlds), 1),
        cpu_ms_per_tag_s=1e3 * cpu_s / max(sum(world.tag_s for world in worlds), 1e-9),
    )
    if fixes == 0:
        return row
    row = _with_errors(row, worlds)
    return row if reference is None else _with_ratio(row, worlds, reference)


def _with_errors(row: WorldRow, worlds: list[RunResult]) -> WorldRow:
    sums = np.array([(world.fixes, world.squared_m2, world.nees) for world in worlds])
    rmse_m, rmse_error_m = jackknife(sums, _rmse)
    nees, nees_error = jackknife(sums, _nees)
    return replace(
        row,
        rmse_m=rmse_m,
        rmse_error_m=rmse_error_m,
        p95_m=float(np.percentile(np.concatenate([world.sample_m for world in worlds]), 95)),
        max_m=max(world.max_m for world in worlds),
        said_m=(sum(world.variance_m2 for world in worlds) / row.fixes) ** 0.5,
        nees=nees,
        nees_interval=interval(nees_error, len(worlds)),
        outside=sum(world.outside for world in worlds) / row.fixes,
    )


def _with_ratio(row: WorldRow, worlds: list[RunResult], reference: list[RunResult]) -> WorldRow:
    """Worlds and reference worlds of the same number share their seed, so they are left out together."""
    pairs = zip(worlds, reference, strict=True)
    sums = np.array([(a.fixes, a.squared_m2, b.fixes, b.squared_m2) for a, b in pairs])
    if sums[:, 2].sum() == 0:
        return row
    ratio, ratio_error = jackknife(sums, lambda rows: _rmse(rows) / _rmse(rows[:, 2:]))
    passed = None if row.limit is None else ratio <= row.limit
    return replace(row, ratio=ratio, ratio_error=ratio_error, passed=passed)


def _rmse(sums: Array) -> float:
    """From columns of counts and sums of squares."""
    fixes, squared = sums[:, 0].sum(), sums[:, 1].sum()
    return float(np.sqrt(squared / fixes)) if fixes else np.nan


def _nees(sums: Array) -> float:
    fixes = sums[:, 0].sum()
    return float(sums[:, 2].sum() / fixes) if fixes else np.nan


def jackknife(rows: Array, figure: Callable[[Array], float]) -> tuple[float, float | None]:
    """A figure of independent rows and its standard error, None where it cannot be estimated (Quenouille, Tukey).

    ``rows`` has shape (n, columns); the figure is a smooth function of their sums.
    """
    whole, n = figure(rows), len(rows)
    if n < 2:
        return whole, None
    without = np.array([figure(np.delete(rows, one, axis=0)) for one in range(n)])
    error = float(np.sqrt((n - 1) / n * np.square(without - without.mean()).sum()))
    return whole, error if np.isfinite(error) else None


def interval(standard_error: float | None, runs: int) -> tuple[float, float] | None:
    """Where a mean of 1 would be measured with a probability of 99 %, by Student's distribution."""
    if standard_error is None:
        return None
    reach = float(student.ppf(0.995, runs - 1)) * standard_error
    return max(1.0 - reach, 0.0), 1.0 + reach


def clustered_interval(events: Array, count: float) -> tuple[float, float]:
    """Where the true share of rare events lies, with 99 %, for ``count`` cases with ``events`` in each independent run.

    Runs with events are taken as a Poisson process of clusters: Fay and Feuer (Statistics in Medicine 16, 1997,
    791-801), whose interval ends where Garwood's exact one does, below, if all clusters have one event.
    """
    y, v = float(events.sum()), float(np.square(events).sum())
    w = max(float(events.max(initial=0.0)), CLUSTER_FIXES)
    low = v / (2.0 * y) * float(chi2.ppf(_ALPHA / 2.0, 2.0 * y * y / v)) if y > 0.0 else 0.0
    high = (v + w * w) / (2.0 * (y + w)) * float(chi2.ppf(1.0 - _ALPHA / 2.0, 2.0 * (y + w) ** 2 / (v + w * w)))
    return low / count, high / count
