"""The picture of a study: a line of panels for each series, curves over numbers and bars for named cases."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import groupby
from typing import Any, Final, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from msgspec import Struct
from msgspec.structs import replace
from scipy.stats import chi2
from scipy.stats import t as student

from skyless.core.arrays import Array
from skyless.research.studies.runner import AnyRow, Cell, Limit, Plan, Row, Study, with_limits
from skyless.research.studies.worlds import Run, RunResult, bound_m2, run_world
from skyless.research.uncertainty import Biases
from skyless.site.report import BLUE, GREEN, GRID, INK, MUTED, ORANGE, RED, report_style

_WIDTH_IN: Final = 4.7
_BAR_IN: Final = 0.24
_CURVE_IN: Final = 2.6
_WIDE_RATIO: Final = 15.0
"""Values that lie farther apart are drawn on a logarithmic axis."""
_WIDE_X_RATIO: Final = 10.0
"""The same for the numbers of a series."""


# Which side of a limit is the safe one

_ROOM: Final = 1.25
"""Both sides of the limit are in view: the axis reaches to at least this multiple of it, and to a part of it."""


class Sides(Struct, frozen=True):
    """What it means to be below and above a limit."""

    below: str
    above: str
    safe: Literal["below", "above", "neither"] = "below"
    """``neither``: far from the limit is bad on both sides."""

    def colour(self, side: str) -> str:
        """Green for the safe side."""
        return INK if self.safe == "neither" else GREEN if side == self.safe else RED


CONFIDENCE: Final = Sides("errors smaller than reported: safe side", "errors larger than reported: too confident")
"""Sides of the ratio of squared errors to reported variances, whose limit is 1."""

STATED_RISK: Final = Sides("rarer than stated: safe side", "more often than stated: too confident")
"""Sides of the share of errors beyond a protection level, whose limit is the stated probability."""

BOUND: Final = Sides("below the bound: by chance alone", "above the bound: information not used", "neither")
"""Sides of the ratio of errors to the smallest possible ones, whose limit is 1."""


def shade_sides(axes: Axes, sides: Sides, limit: float | None, *, along: Literal["x", "y"]) -> None:
    """Shade and name both sides of a limit on the axis ``along``; call it after everything else is drawn.

    Without a limit both directions are named.
    """
    for side, words in (("below", sides.below), ("above", sides.above)):
        _name(axes, words, sides.colour(side), side, along)
    if limit is None:
        return
    low, high = sorted(axes.get_xlim() if along == "x" else axes.get_ylim())
    logarithmic = (axes.get_xscale() if along == "x" else axes.get_yscale()) == "log"
    high = max(high, limit * (_ROOM**3 if logarithmic else _ROOM))
    low = min(low, limit / (_ROOM**3 if logarithmic else _ROOM))
    span, set_limits = (axes.axvspan, axes.set_xlim) if along == "x" else (axes.axhspan, axes.set_ylim)
    for start, end, side in ((low, limit, "below"), (limit, high, "above")):
        if sides.safe != "neither":
            span(start, end, color=sides.colour(side), alpha=0.07, linewidth=0.0, zorder=0.5)
    set_limits(low, high)


def _name(axes: Axes, words: str, colour: str, side: str, along: Literal["x", "y"]) -> None:
    """Words for a side: below the label of the axis x, at the upper or lower edge of the panel for y."""
    if along == "x":
        axes.set_xlabel(f"{axes.get_xlabel()}\n" + (f"◂ {words}" if side == "below" else f"{words} ▸"))
    else:
        y = 0.015 if side == "below" else 0.985
        axes.text(
            0.985, y, words, transform=axes.transAxes, ha="right", va="bottom" if side == "below" else "top",
            fontsize=7.0, color=colour, zorder=5,
        )  # fmt: skip


# Panels


class _Panel(Struct, frozen=True):
    label: str
    figure: str
    """Field of a row that is drawn, ``scale`` times as large, with its own limits."""
    scale: float = 1.0
    error: str = ""
    """Field with its standard error."""
    target: float | None = None
    """The ideal value; values are then drawn as points instead of bars."""
    floor: float | None = None
    """Smaller values are drawn here, as a logarithmic axis has no 0."""
    sides: Sides | None = None
    """Meaning of the two sides of the target or of the stated risk."""
    log: bool | None = None
    """Whether the axis of bars is logarithmic; None for where values lie far apart."""

    def values(self, rows: Sequence[Row], figure: str) -> Array:
        """One field of all rows, scaled; NaN where a row does not have it."""
        values = np.array([getattr(row, figure, None) for row in rows], np.float64)
        return self.scale * (values if self.floor is None else np.maximum(values, self.floor))


_RARE: Final = 1e-6
"""Smallest share of exceeded levels that is drawn."""

PANELS: Final = {
    "rmse": _Panel("RMSE in cm", "rmse_m", 100.0, error="rmse_error_m"),
    "ratio": _Panel("RMSE over bound", "ratio", error="ratio_error", target=1.0, sides=BOUND),
    "nees": _Panel("NEES per dimension", "nees", target=1.0, sides=CONFIDENCE),
    "level": _Panel(
        "fixes with a level in %",
        "level",
        100.0,
        sides=Sides("fewer fixes with a level", "more: better, if they hold", "above"),
        log=False,
    ),
    "exceeded": _Panel("levels exceeded in 10⁻⁴", "exceeded", 1e4, floor=_RARE, sides=STATED_RISK, log=True),
    "hpl": _Panel("median HPL in cm", "hpl_m", 100.0),
    "available": _Panel("fixes with a level in %", "available", 100.0, log=False),
    "misleading": _Panel("misleading fixes in 10⁻⁴", "hmi", 1e4, floor=_RARE, sides=STATED_RISK, log=True),
    "found": _Panel(
        "events found in %",
        "found",
        100.0,
        sides=Sides("events missed: unsafe", "events found: safe side", "above"),
        log=False,
    ),
    "found_s": _Panel("seconds to the finding, 99 %", "found_s", log=True),
}


def draw(study: Study, rows: Sequence[Row]) -> Figure:
    """Draw the rows of a study; error bars are standard errors."""
    with report_style():
        series = [(name, list(group)) for name, group in groupby(rows, key=lambda row: row.series)]
        series = [(name, group) for name, group in series if _has_values(group, study.panels)] or series
        heights = [_CURVE_IN if _is_curve(group) else 0.8 + _BAR_IN * len(group) for _, group in series]
        figure = Figure(figsize=(_WIDTH_IN * len(study.panels), sum(heights) + 0.5), layout="constrained")
        methods = ", ".join(dict.fromkeys(row.method for row in rows))
        note = "; grey: where 99 % of consistent ones lie" if "nees" in study.panels else ""
        figure.suptitle(
            f"{study.title[0].upper()}{study.title[1:]}: {methods}, simulated{note}", x=0.01, ha="left", fontsize=11.0
        )
        grid = figure.subplots(len(series), len(study.panels), squeeze=False, height_ratios=heights)
        for line, (name, group) in zip(grid, series, strict=True):
            for axes, panel in zip(line, study.panels, strict=True):
                _fill(axes, PANELS[panel], group, study.x)
            for axes in line[1:]:
                if not _is_curve(group):
                    axes.set_yticklabels([])
            line[0].set_title(name, loc="left")
    return figure


def _has_values(rows: Sequence[Row], panels: Sequence[str]) -> bool:
    """Whether any panel shows something of these rows; cold starts, for one, have no errors."""
    return any(getattr(row, PANELS[panel].figure, None) is not None for panel in panels for row in rows)


def _is_curve(rows: Sequence[Row]) -> bool:
    return all(row.x is not None for row in rows)


def _fill(axes: Axes, panel: _Panel, rows: list[Row], x: str) -> None:
    values, errors = panel.values(rows, panel.figure), np.nan_to_num(panel.values(rows, panel.error))
    curve = _is_curve(rows)
    if curve:
        _curve(axes, np.array([row.x for row in rows], dtype=np.float64), values, errors, x or rows[0].series)
        if panel.target is not None:
            axes.set_ylim(top=max(axes.get_ylim()[1], 1.3 * panel.target))
        axes.set(ylabel=panel.label)
    else:
        _named(axes, panel, rows, values, errors)
        axes.set(xlabel=panel.label)
    if panel.target is not None:
        (axes.axhline if curve else axes.axvline)(panel.target, color=MUTED, linewidth=1.0, linestyle="--", zorder=1.5)
    if panel is PANELS["nees"]:
        _intervals(axes, rows, curve=curve)
    _limits(axes, panel, rows, curve=curve)
    if panel.sides is not None:
        shade_sides(axes, panel.sides, panel.target, along="y" if curve else "x")


def _curve(axes: Axes, x: Array, values: Array, errors: Array, label: str) -> None:
    positive = x > 0.0  # a logarithmic axis has no 0
    logarithmic = bool(positive.any()) and x.max() > _WIDE_X_RATIO * x[positive].min()
    if logarithmic:
        x, values, errors = x[positive], values[positive], errors[positive]
    axes.errorbar(x, values, errors, fmt="o-", color=BLUE, markersize=4, capsize=2, zorder=3)
    axes.set(xlabel=label)
    if logarithmic:
        axes.set_xscale("log")
        axes.set_xticks(x, [f"{value:g}" for value in x])
        axes.set_xticks([], minor=True)
    highest = float(np.nanmax(values + errors, initial=0.0))
    if highest > _WIDE_RATIO * float(np.nanmin(values, initial=np.inf)):
        axes.set_yscale("log")
        _plain_numbers(axes.yaxis)
    else:
        axes.set_ylim(0.0, 1.15 * max(highest, 1e-9))


def _plain_numbers(axis: Axis, *, between: bool = True) -> None:
    """Numbers at the powers of ten, and ``between`` them."""
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("{x:g}" if between else NullFormatter())
    axis.set_tick_params(which="minor", labelsize=6.0)


def _named(axes: Axes, panel: _Panel, rows: list[Row], values: Array, errors: Array) -> None:
    rows_y = np.arange(len(rows))
    colours = [ORANGE if row.passed is False else BLUE for row in rows]
    for row_y, value, error, colour in zip(rows_y, values, errors, colours, strict=True):
        if panel.target is not None:
            axes.errorbar(value, row_y, xerr=error, fmt="o", color=colour, markersize=5, capsize=2, zorder=3)
        else:
            axes.barh(row_y, value, xerr=error, color=colour, height=0.7, error_kw={"ecolor": INK, "elinewidth": 1.0})
    wide = np.nanmax(values, initial=0.0) > _WIDE_RATIO * np.nanmin(values, initial=np.inf)
    positive = values[values > 0.0]  # a logarithmic axis has no 0
    if (wide if panel.log is None else panel.log) and len(positive):
        axes.set_xscale("log")
        axes.set_xlim(left=0.6 * float(positive.min()))
        _plain_numbers(axes.xaxis, between=panel.log is None)
    axes.set_yticks(rows_y, [row.case for row in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")


def _intervals(axes: Axes, rows: list[Row], *, curve: bool) -> None:
    for row_y, row in enumerate(rows):
        if row.nees_interval is None:
            continue
        at = (row.x or 0.0) if curve else row_y
        low, high = row.nees_interval
        ends = ([at, at], [low, high]) if curve else ([low, high], [at, at])
        axes.plot(*ends, color=GRID, linewidth=7.0, solid_capstyle="butt", zorder=1.2, scalex=False, scaley=False)


def _limits(axes: Axes, panel: _Panel, rows: list[Row], *, curve: bool) -> None:
    """Mark what a figure should be at least or at most; on the RMSE also the limit on its ratio."""
    for row_y, row in enumerate(rows):
        factors = {panel.figure: panel.scale}
        if panel.figure == "rmse_m" and row.rmse_m is not None and row.ratio:
            factors["ratio"] = panel.scale * row.rmse_m / row.ratio
        limits = [one for one in row.limits if one.figure in factors]
        values = [factors[one.figure] * end for one in limits for end in (one.least, one.most) if end is not None]
        if values:
            along, mark = [row.x if curve and row.x is not None else row_y] * len(values), "_" if curve else "|"
            ends = (along, values) if curve else (values, along)
            (line,) = axes.plot(*ends, mark, color=RED, markersize=14, markeredgewidth=1.6, label="limit")
            axes.legend(handles=[line])


# From the worlds of a case to a row: standard errors from the scatter between worlds, intervals of rare shares.

_MESSAGE_S: Final = 40e-6
"""Approximate CPU time for a message, of a tag or of a simulated anchor."""
_BOUND_TAG_S: Final = 0.03
"""Approximate CPU time of simulation and bound for a second of a tag."""

RAW_METHODS: Final = ("joint",)
"""Methods that use anchors' receptions of each other."""

_ALPHA: Final = 0.01
CLUSTER_FIXES: Final = 25.0
"""Assumed size of a cluster of misleading fixes where none larger is observed: neighbours share their errors."""


class Case(Struct, frozen=True):
    """Worlds that differ by chance alone."""

    name: str
    series: str
    x: float | None
    runs: tuple[Run, ...]
    of: str | None = None
    """The reference case of the ratio of RMSEs, in worlds of the same seeds; it may have more worlds."""
    limits: tuple[Limit, ...] = ()
    biases: Biases | None = None
    """What the worlds' ranges and anchors are off by, for the Cramér–Rao bound over which the ratio is then; None for
    cases without a bound."""


class WorldRow(Row, frozen=True, kw_only=True):
    """Results of simulated worlds."""

    outside: float | None = None
    """Share of fixes that lie outside of their own 99.9 % ellipse; 0.001 for true ones with Gaussian errors."""
    of: str | None = None
    """The reference case of ``ratio``."""
    cpu_us_per_message: float | None = None
    cpu_ms_per_tag_s: float | None = None
    """CPU time for each second of a tag."""
    level: float | None = None
    """Share of the judged fixes that give a horizontal protection level; None for methods without levels."""
    exceeded: float | None = None
    """Share of those whose horizontal error is larger than it."""
    exceeded_interval: tuple[float, float] | None = None
    """99 % confidence interval of that share, with tags as independent units."""
    exceeded_unwarned: float | None = None
    """Share of the fixes with a level whose error is larger, and which carry no alert."""
    hpl_m: float | None = None
    """Median horizontal level of the fixes that give one."""


def world_cells(cases: Sequence[Case]) -> list[Cell]:
    """One cell for each world of all cases, then one for the bound of each world that has one."""
    worlds = [
        Cell(
            case.name,
            partial(run_world, run),
            run.until_s / run.site.schedule.slot_s * _MESSAGE_S * (len(run.trajectories) + len(run.site.anchors)),
        )
        for case in cases
        for run in case.runs
    ]
    bounds = [
        Cell(case.name, partial(bound_m2, run, case.biases), _BOUND_TAG_S * len(run.trajectories) * run.until_s)
        for case in cases
        if case.biases is not None
        for run in case.runs
    ]
    return [*worlds, *bounds]


def world_rows(study: str, plan: Plan, cases: Sequence[Case], results: Sequence[Any]) -> list[WorldRow]:
    """A row for each case, with its limits; the results stand in the order of ``world_cells``."""
    rest, found = iter(results), []
    worlds = {case.name: [next(rest) for _ in case.runs] for case in cases}
    for case in cases:
        own = worlds[case.name]
        row = case_row(study, plan, case, own, worlds[case.of][: len(own)] if case.of else None)
        if case.biases is not None:
            row = _with_bound(row, own, [next(rest) for _ in own])
        found.append(with_limits(row, case.limits))
    return found


def case_row(
    study: str, plan: Plan, case: Case, worlds: Sequence[RunResult], reference: Sequence[RunResult] | None
) -> WorldRow:
    """The row of a case's worlds; ``reference``: worlds of the reference case."""
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
        available=fixes / max(sum(world.superframes for world in worlds), 1),
        of=case.of,
        cpu_us_per_message=1e6 * cpu_s / max(sum(world.messages for world in worlds), 1),
        cpu_ms_per_tag_s=1e3 * cpu_s / max(sum(world.tag_s for world in worlds), 1e-9),
    )
    if fixes == 0:
        return row
    sums = np.array([(world.fixes, world.squared_m2, world.nees) for world in worlds])
    row = replace(
        with_errors(row, sums, np.concatenate([world.sample_m for world in worlds])),
        max_m=max(world.max_m for world in worlds),
        said_m=(sum(world.variance_m2 for world in worlds) / fixes) ** 0.5,
        outside=sum(world.outside for world in worlds) / fixes,
    )
    row = _with_levels(row, worlds)
    return row if reference is None else _with_ratio(row, worlds, reference)


def with_errors(row: AnyRow, sums: Array, errors_m: Array) -> AnyRow:
    """Add RMSE, NEES and percentile; ``sums``: of each independent run fixes, squared errors and their NEES."""
    rmse_m, rmse_error_m = jackknife(sums, _rmse)
    nees, nees_error = jackknife(sums, lambda rows: _per_fix(rows, 2))
    return replace(
        row,
        rmse_m=rmse_m,
        rmse_error_m=rmse_error_m,
        p95_m=float(np.percentile(errors_m, 95)),
        nees=nees,
        nees_interval=interval(nees_error, len(sums)),
    )


def _with_levels(row: WorldRow, worlds: Sequence[RunResult]) -> WorldRow:
    """Add protection levels, with tags as units, where the method gives some."""
    tallies = [world.levels for world in worlds if world.levels is not None]
    if not tallies:
        return row
    levels, exceeded, unwarned = np.concatenate([(one.levels, one.exceeded, one.unwarned) for one in tallies], axis=1)
    count = levels.sum()
    row = replace(row, level=count / row.fixes)
    if not count:
        return row
    low, high = clustered_interval(exceeded, count)
    return replace(
        row,
        exceeded=exceeded.sum() / count,
        exceeded_interval=(min(low, 1.0), min(high, 1.0)),
        exceeded_unwarned=unwarned.sum() / count,
        hpl_m=float(np.median(np.concatenate([one.hpl_m for one in tallies]))),
    )


def _with_ratio(row: WorldRow, worlds: Sequence[RunResult], reference: Sequence[RunResult]) -> WorldRow:
    """Add the ratio of RMSEs. Worlds of the same number share their seed, so the jackknife leaves them out together."""
    sums = np.array([(a.fixes, a.squared_m2, b.fixes, b.squared_m2) for a, b in zip(worlds, reference, strict=True)])
    if sums[:, 2].sum() == 0:
        return row
    ratio, ratio_error = jackknife(sums, lambda rows: _rmse(rows) / _rmse(rows[:, 2:]))
    return replace(row, ratio=ratio, ratio_error=ratio_error)


def _with_bound(row: WorldRow, worlds: Sequence[RunResult], variances_m2: Sequence[float]) -> WorldRow:
    """Add the bound of the worlds, and the RMSE over it."""
    row = replace(row, bound_m=float(np.sqrt(np.mean(variances_m2))))
    if row.fixes == 0:
        return row
    sums = np.array([(a.fixes, a.squared_m2, variance) for a, variance in zip(worlds, variances_m2, strict=True)])
    ratio, ratio_error = jackknife(sums, lambda rows: float(np.sqrt(_per_fix(rows, 1) / rows[:, 2].mean())))
    return replace(row, ratio=ratio, ratio_error=ratio_error)


def _rmse(sums: Array) -> float:
    """From columns of counts and sums of squares."""
    return float(np.sqrt(_per_fix(sums, 1)))


def _per_fix(sums: Array, column: int) -> float:
    fixes = sums[:, 0].sum()
    return float(sums[:, column].sum() / fixes) if fixes else np.nan


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
    """Interval in which a mean of 1 is measured with a probability of 99 % (Student's distribution)."""
    if standard_error is None:
        return None
    reach = float(student.ppf(0.995, runs - 1)) * standard_error
    return max(1.0 - reach, 0.0), 1.0 + reach


def clustered_interval(events: Array, count: float) -> tuple[float, float]:
    """99 % confidence interval of the share of rare events, for ``count`` cases; ``events``: of each independent run.

    Runs with events are taken as a Poisson process of clusters: Fay and Feuer (Statistics in Medicine 16, 1997,
    791-801), whose interval ends where Garwood's exact one does, below, if all clusters have one event.
    """
    y, v = float(events.sum()), float(np.square(events).sum())
    w = max(float(events.max(initial=0.0)), CLUSTER_FIXES)
    low = v / (2.0 * y) * float(chi2.ppf(_ALPHA / 2.0, 2.0 * y * y / v)) if y > 0.0 else 0.0
    high = (v + w * w) / (2.0 * (y + w)) * float(chi2.ppf(1.0 - _ALPHA / 2.0, 2.0 * (y + w) ** 2 / (v + w * w)))
    return low / count, high / count
