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
from skyless.research.studies.runner import Cell, Limit, Plan, Row
from skyless.research.studies.worlds import Run, RunResult, run_world
from skyless.research.uncertainty import Biases
from skyless.site.report import BLUE, GREEN, GRID, INK, MUTED, ORANGE, RED, report_style

_WIDTH_IN: Final = 4.7
_BAR_IN: Final = 0.24
_CURVE_IN: Final = 2.6
_WIDE_RATIO: Final = 15.0
"""Values that lie farther apart are drawn on a logarithmic axis."""


# Which side of a limit is the safe one

_FAINT: Final = 0.07
_ROOM: Final = 1.25
"""Both sides of the limit are in view: the axis reaches to at least this multiple of it, and to a part of it."""


class Sides(Struct, frozen=True):
    """What it means to be below and above a limit."""

    below: str
    above: str
    safe: Literal["below", "above", "neither"] = "below"
    """``neither``: far from the limit is bad on both sides."""


CONFIDENCE: Final = Sides("errors smaller than reported: safe side", "errors larger than reported: too confident")
"""Sides of the ratio of squared errors to reported variances, whose limit is 1."""

STATED_RISK: Final = Sides("rarer than stated: safe side", "more often than stated: too confident")
"""Sides of the share of errors beyond a protection level, whose limit is the stated probability."""

BOUND: Final = Sides("below the bound: by chance alone", "above the bound: information not used", "neither")
"""Sides of the ratio of errors to the smallest possible ones, whose limit is 1."""


def shade_sides(axes: Axes, sides: Sides, limit: float, *, along: Literal["x", "y"]) -> None:
    """Shade and name both sides of a limit on the axis ``along``; call it after everything else is drawn."""
    low, high = sorted(axes.get_xlim() if along == "x" else axes.get_ylim())
    logarithmic = (axes.get_xscale() if along == "x" else axes.get_yscale()) == "log"
    high = max(high, limit * (_ROOM**3 if logarithmic else _ROOM))
    low = min(low, limit / (_ROOM**3 if logarithmic else _ROOM))
    span, set_limits = (axes.axvspan, axes.set_xlim) if along == "x" else (axes.axhspan, axes.set_ylim)
    for start, end, side, words in ((low, limit, "below", sides.below), (limit, high, "above", sides.above)):
        colour = INK if sides.safe == "neither" else GREEN if side == sides.safe else RED
        if sides.safe != "neither":
            span(start, end, color=colour, alpha=_FAINT, linewidth=0.0, zorder=0.5)
        _name(axes, words, colour, side, along)
    set_limits(low, high)


def _name_sides(axes: Axes, sides: Sides, *, along: Literal["x", "y"]) -> None:
    """Name both directions of an axis without a common limit."""
    for side, words in (("below", sides.below), ("above", sides.above)):
        _name(axes, words, GREEN if side == sides.safe else RED, side, along)


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


class Look(Struct, frozen=True):
    """How a study is drawn."""

    title: str
    panels: tuple[str, ...]
    """Names of ``_PANELS``, side by side."""
    x: str = ""
    """What the numbers of a series mean; by default the series says it."""
    log: bool = False


class _Panel(Struct, frozen=True):
    label: str
    value: Callable[[Any], float | None]
    """A figure of a study's row."""
    error: Callable[[Row], float | None] = lambda _: None
    target: float | None = None
    """What a good receiver has; the values are then points about it, not lengths."""
    limits: bool = False
    """Whether limits on the ratio are drawn as limits on the RMSE."""
    figure: str = ""
    """Field of a row whose own limits are drawn, ``scale`` times as large."""
    scale: float = 1.0
    sides: Sides | None = None
    """What the two sides of the target mean, or of the stated risk."""
    log: bool | None = None
    """Whether the axis of bars is logarithmic; None for where values lie far apart."""


def _times(factor: float, value: float | None) -> float | None:
    return None if value is None else factor * value


_MIN_DRAWN_SHARE: Final = 1e-6
"""Smaller shares of exceeded levels, and none, are drawn here."""


def _parts(share: float | None) -> float | None:
    return None if share is None else 1e4 * max(share, _MIN_DRAWN_SHARE)


_PANELS: Final = {
    "rmse": _Panel(
        "RMSE in cm",
        lambda row: _times(100.0, row.rmse_m),
        lambda row: _times(100.0, row.rmse_error_m),
        limits=True,
        figure="rmse_m",
        scale=100.0,
    ),
    "ratio": _Panel("RMSE over bound", lambda row: row.ratio, lambda row: row.ratio_error, 1.0, sides=BOUND),
    "nees": _Panel("NEES per dimension", lambda row: row.nees, target=1.0, figure="nees", sides=CONFIDENCE),
    "level": _Panel(
        "fixes with a level in %",
        lambda row: _times(100.0, row.level),
        figure="level",
        scale=100.0,
        sides=Sides("fewer fixes with a level", "more: better, if they hold", "above"),
        log=False,
    ),
    "exceeded": _Panel(
        "levels exceeded in 10⁻⁴",
        lambda row: _parts(row.exceeded),
        figure="exceeded",
        scale=1e4,
        sides=STATED_RISK,
        log=True,
    ),
    "hpl": _Panel("median HPL in cm", lambda row: _times(100.0, row.hpl_m)),
    "available": _Panel("fixes with a level in %", lambda row: _times(100.0, row.available), log=False),
    "misleading": _Panel("misleading fixes in 10⁻⁴", lambda row: _parts(row.hmi), sides=STATED_RISK, log=True),
    "found": _Panel(
        "events found in %",
        lambda row: _times(100.0, row.found),
        figure="found",
        scale=100.0,
        sides=Sides("events missed: unsafe", "events found: safe side", "above"),
        log=False,
    ),
    "found_s": _Panel("seconds to the finding, 99 %", lambda row: row.found_s, log=True),
    "cpu": _Panel("CPU in µs a message", lambda row: row.cpu_us_per_message),
}


def draw(look: Look, rows: Sequence[Row]) -> Figure:
    """Draw the rows of a study; error bars are standard errors."""
    with report_style():
        series = [(name, list(group)) for name, group in groupby(rows, key=lambda row: row.series)]
        series = [(name, group) for name, group in series if _has_values(group, look)] or series
        heights = [_CURVE_IN if _is_curve(group) else 0.8 + _BAR_IN * len(group) for _, group in series]
        figure = Figure(figsize=(_WIDTH_IN * len(look.panels), sum(heights) + 0.5), layout="constrained")
        methods = ", ".join(dict.fromkeys(row.method for row in rows))
        note = "; grey: where 99 % of consistent ones lie" if "nees" in look.panels else ""
        figure.suptitle(f"{look.title}: {methods}, simulated{note}", x=0.01, ha="left", fontsize=11.0)
        grid = figure.subplots(len(series), len(look.panels), squeeze=False, height_ratios=heights)
        for line, (name, group) in zip(grid, series, strict=True):
            for axes, panel in zip(line, look.panels, strict=True):
                _fill(axes, _PANELS[panel], group, look)
            for axes in line[1:]:
                if not _is_curve(group):
                    axes.set_yticklabels([])
            line[0].set_title(name, loc="left")
    return figure


def _has_values(rows: Sequence[Row], look: Look) -> bool:
    """Whether any panel shows something of these rows; cold starts, for one, have no errors."""
    return any(_PANELS[panel].value(row) is not None for panel in look.panels for row in rows)


def _is_curve(rows: Sequence[Row]) -> bool:
    return all(row.x is not None for row in rows)


def _fill(axes: Axes, panel: _Panel, rows: list[Row], look: Look) -> None:
    values = np.array([_or_nan(panel.value(row)) for row in rows])
    errors = np.nan_to_num(np.array([_or_nan(panel.error(row)) for row in rows]))
    curve = _is_curve(rows)
    if curve:
        _curve(axes, np.array([row.x for row in rows], dtype=np.float64), values, errors, look, rows[0].series)
        if panel.target is not None:
            axes.set_ylim(top=max(axes.get_ylim()[1], 1.3 * panel.target))
        axes.set(ylabel=panel.label)
    else:
        _named(axes, panel, rows, values, errors)
        axes.set(xlabel=panel.label)
    if panel.target is not None:
        (axes.axhline if curve else axes.axvline)(panel.target, color=MUTED, linewidth=1.0, linestyle="--", zorder=1.5)
    if panel is _PANELS["nees"]:
        _intervals(axes, rows, curve=curve)
    if panel.limits:
        _limits(axes, rows)
    if panel.figure and not curve:
        _own_limits(axes, panel, rows)
    if panel.sides is not None:
        limit = panel.target
        if limit is None:
            _name_sides(axes, panel.sides, along="y" if curve else "x")
        else:
            shade_sides(axes, panel.sides, limit, along="y" if curve else "x")


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def _curve(axes: Axes, x: Array, values: Array, errors: Array, look: Look, series: str) -> None:
    if look.log:  # a logarithmic axis has no 0
        x, values, errors = x[x > 0.0], values[x > 0.0], errors[x > 0.0]
    axes.errorbar(x, values, errors, fmt="o-", color=BLUE, markersize=4, capsize=2, zorder=3)
    axes.set(xlabel=look.x or series)
    if look.log:
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


def _limits(axes: Axes, rows: list[Row]) -> None:
    """Mark the largest RMSE that is accepted."""
    for row_y, row in enumerate(rows):
        if row.limit is None or row.ratio is None or row.rmse_m is None:
            continue
        limit_cm = 100.0 * row.rmse_m / row.ratio * row.limit
        x, y, mark = (limit_cm, row_y, "|") if row.x is None else (row.x, limit_cm, "_")
        (line,) = axes.plot(x, y, mark, color=RED, markersize=14, markeredgewidth=1.6, linestyle="none", label="limit")
        axes.legend(handles=[line])


def _own_limits(axes: Axes, panel: _Panel, rows: list[Row]) -> None:
    """Mark what a figure should be at least or at most."""
    for row_y, row in enumerate(rows):
        ends = [end for one in row.limits if one.figure == panel.figure for end in (one.least, one.most)]
        values = [panel.scale * end for end in ends if end is not None]
        if values:
            rows_y = [float(row_y)] * len(values)
            (line,) = axes.plot(values, rows_y, "|", color=RED, markersize=14, markeredgewidth=1.6, label="limit")
            axes.legend(handles=[line])


# From the worlds of a case to a row: standard errors from the scatter between worlds, intervals of rare shares.

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
