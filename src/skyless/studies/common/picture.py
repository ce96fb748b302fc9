"""The picture of a study: a line of panels for each series, curves over numbers and bars for named cases."""

from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from msgspec import Struct

from skyless.evaluation.figures import BLUE, GRID, INK, MUTED, ORANGE, RED, report_style
from skyless.kernels.arrays import Array
from skyless.studies.common.plan import Row
from skyless.studies.common.sides import BOUND, CONFIDENCE, STATED_RISK, Sides, name_sides, shade_sides

_WIDTH_IN: Final = 4.7
_BAR_IN: Final = 0.24
_CURVE_IN: Final = 2.6
_WIDE_RATIO: Final = 15.0
"""Values that lie farther apart are drawn on a logarithmic axis."""


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
    value: Callable[[Row], float | None]
    error: Callable[[Row], float | None]
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


def centimetres(value_m: float | None) -> float | None:
    """A length in centimetres."""
    return None if value_m is None else 100.0 * value_m


LEAST_DRAWN_SHARE: Final = 1e-6
"""Smaller shares of exceeded levels, and none, are drawn here."""


def _exceeded(row: Row) -> float | None:
    return None if row.exceeded is None else 1e4 * max(row.exceeded, LEAST_DRAWN_SHARE)


_PANELS: Final = {
    "rmse": _Panel(
        "RMSE in cm",
        lambda row: centimetres(row.rmse_m),
        lambda row: centimetres(row.rmse_error_m),
        limits=True,
        figure="rmse_m",
        scale=100.0,
    ),
    "ratio": _Panel("RMSE over bound", lambda row: row.ratio, lambda row: row.ratio_error, 1.0, sides=BOUND),
    "nees": _Panel("NEES per dimension", lambda row: row.nees, lambda _: None, 1.0, figure="nees", sides=CONFIDENCE),
    "level": _Panel(
        "fixes with a level in %",
        lambda row: None if row.level is None else 100.0 * row.level,
        lambda _: None,
        figure="level",
        scale=100.0,
        sides=Sides("fewer fixes with a level", "more: better, if they hold", "above"),
        log=False,
    ),
    "exceeded": _Panel(
        "levels exceeded in 10⁻⁴",
        _exceeded,
        lambda _: None,
        figure="exceeded",
        scale=1e4,
        sides=STATED_RISK,
        log=True,
    ),
    "superframes": _Panel(
        "superframes, the slowest run",
        lambda row: row.superframes_most,
        lambda _: None,
        figure="superframes_most",
        log=True,
    ),
    "found": _Panel(
        "events found in %",
        lambda row: None if row.found is None else 100.0 * row.found,
        lambda _: None,
        figure="found",
        scale=100.0,
        sides=Sides("events missed: unsafe", "events found: safe side", "above"),
        log=False,
    ),
    "found_s": _Panel("seconds to the finding, 99 %", lambda row: row.found_s, lambda _: None, log=True),
    "cpu": _Panel("CPU in µs a message", lambda row: row.cpu_us_per_message, lambda _: None),
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
        limit = panel.target or _stated_risk(rows, panel)
        if limit is None:
            name_sides(axes, panel.sides, along="y" if curve else "x")
        else:
            shade_sides(axes, panel.sides, limit, along="y" if curve else "x")


def _stated_risk(rows: list[Row], panel: _Panel) -> float | None:
    """The probability that all rows state for what the panel shows, on its axis; None where they state none."""
    risks = {row.risk for row in rows}
    (risk,) = risks if len(risks) == 1 else (None,)
    return panel.scale * risk if panel.sides is STATED_RISK and risk else None


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def _curve(axes: Axes, x: Array, values: Array, errors: Array, look: Look, series: str) -> None:
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
