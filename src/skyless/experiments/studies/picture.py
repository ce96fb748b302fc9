"""The picture of a study: a line of panels for each series, curves over numbers and bars beside names."""

from collections.abc import Callable, Sequence
from itertools import groupby
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from msgspec import Struct

from skyless.experiments.paper.style import BLUE, INK, MUTED, ORANGE, RED, house_style
from skyless.experiments.studies.plan import Row

WIDTH_IN: Final = 4.7
BAR_IN: Final = 0.26
CURVE_IN: Final = 2.6


class Look(Struct, frozen=True):
    """How a study is drawn."""

    title: str
    panels: tuple[str, ...]
    """Names of ``_PANELS``, side by side."""
    x: str = ""
    """What the numbers of a series mean."""
    log: bool = False


class _Panel(Struct, frozen=True):
    label: str
    value: Callable[[Row], float | None]
    error: Callable[[Row], float | None]
    target: float | None = None
    """Where a good value lies."""


def _nees_error(row: Row) -> float | None:
    return None if row.nees_interval is None else (row.nees_interval[1] - row.nees_interval[0]) / 2.0


_PANELS: Final = {
    "rmse": _Panel("RMSE in cm", lambda row: _cm(row.rmse_m), lambda row: _cm(row.rmse_error_m)),
    "ratio": _Panel("RMSE over bound", lambda row: row.ratio, lambda row: row.ratio_error, 1.0),
    "nees": _Panel("NEES per dimension", lambda row: row.nees, _nees_error, 1.0),
    "cpu": _Panel("CPU in µs a message", lambda row: row.cpu_us_per_message, lambda _: None),
}


def _cm(value_m: float | None) -> float | None:
    return None if value_m is None else 100.0 * value_m


def draw(look: Look, rows: Sequence[Row]) -> Figure:
    """Draw the rows of a study; error bars are standard errors, at the NEES half a 99 % interval."""
    with house_style():
        series = [(name, list(group)) for name, group in groupby(rows, key=lambda row: row.series)]
        heights = [CURVE_IN if _is_curve(group) else 0.8 + BAR_IN * len(group) for _, group in series]
        size = (WIDTH_IN * len(look.panels), sum(heights) + 0.5)
        figure = Figure(figsize=size, layout="constrained")
        methods = ", ".join(dict.fromkeys(row.method for row in rows))
        figure.suptitle(f"{look.title}: {methods}, simulated", x=0.01, ha="left", fontsize=11.0)
        grid = figure.subplots(len(series), len(look.panels), squeeze=False, height_ratios=heights)
        for line, (name, group) in zip(grid, series, strict=True):
            for axes, panel in zip(line, look.panels, strict=True):
                _fill(axes, _PANELS[panel], group, look)
            line[0].set_title(name, loc="left")
    return figure


def _is_curve(rows: Sequence[Row]) -> bool:
    return all(row.x is not None for row in rows)


def _fill(axes: Axes, panel: _Panel, rows: list[Row], look: Look) -> None:
    shown = [row for row in rows if panel.value(row) is not None]
    values = np.array([panel.value(row) for row in shown], dtype=np.float64)
    errors = np.array([panel.error(row) or 0.0 for row in shown])
    if _is_curve(rows):
        _curve(axes, shown, values, errors)
        axes.set(xlabel=look.x if look.x != "number of" else f"{look.x} {rows[0].series}", ylabel=panel.label)
        if look.log:
            axes.set_xscale("log")
        axes.set_ylim(0.0, max([1.15 * float((values + errors).max(initial=0.0)), 1.3 * (panel.target or 0.0), 1e-9]))
    else:
        _bars(axes, rows, dict(zip((row.case for row in shown), zip(values, errors, strict=True), strict=True)))
        axes.set(xlabel=panel.label)
    if panel.target is not None:
        (axes.axhline if _is_curve(rows) else axes.axvline)(panel.target, color=MUTED, linewidth=1.0, linestyle="--")
    if panel is _PANELS["rmse"]:
        _limits(axes, shown)


def _curve(axes: Axes, rows: list[Row], values: np.ndarray, errors: np.ndarray) -> None:
    axes.errorbar([row.x or 0.0 for row in rows], values, errors, fmt="o-", color=BLUE, markersize=4, capsize=2)


def _bars(axes: Axes, rows: list[Row], values: dict[str, tuple[float, float]]) -> None:
    names = [row.case for row in rows]
    for place, row in enumerate(rows):
        value, error = values.get(row.case, (0.0, 0.0))
        colour = ORANGE if row.passed is False else BLUE
        axes.barh(place, value, xerr=error, color=colour, height=0.7, error_kw={"ecolor": INK, "elinewidth": 1.0})
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")


def _limits(axes: Axes, rows: list[Row]) -> None:
    """Mark the largest RMSE that is accepted."""
    for place, row in enumerate(rows):
        if row.limit is None or row.ratio is None or row.rmse_m is None:
            continue
        limit_cm = 100.0 * row.rmse_m / row.ratio * row.limit
        across = (row.x, limit_cm) if row.x is not None else (limit_cm, place)
        axes.plot(*across, "_" if row.x is not None else "|", color=RED, markersize=14, markeredgewidth=1.6)
