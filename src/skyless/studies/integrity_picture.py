"""The picture of the study ``integrity``: level and error, availability and misleading fixes over the fault's size."""

from collections.abc import Callable, Iterable, Sequence
from itertools import groupby
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from skyless.evaluation.plot_style import BLUE, GREEN, INK, MUTED, ORANGE, PURPLE, RED, house_style
from skyless.studies.plan import Row

WIDTH_IN: Final = 4.4
HEIGHT_IN: Final = 3.0
LEAST: Final = 1e-6
"""Smaller shares of misleading fixes are drawn here, none as well."""

_COLOURS: Final = (BLUE, ORANGE, GREEN, PURPLE, RED, INK)

_Values = Callable[[Row], float | None]


def draw(rows: Sequence[Row]) -> Figure:
    """A line of panels for each place, a curve for each kind of fault; clean data at the left end."""
    single = [row for row in rows if row.x is not None]
    places = {place: list(group) for place, group in groupby(single, key=_place)}
    with house_style():
        figure = Figure(figsize=(3.0 * WIDTH_IN, HEIGHT_IN * len(places) + 0.5), layout="constrained")
        figure.suptitle("One faulty anchor: joint, simulated", x=0.01, ha="left", fontsize=11.0)
        grid = figure.subplots(len(places), 3, squeeze=False)
        for line, (place, group) in zip(grid, places.items(), strict=True):
            _fill(line, group)
            line[0].set_title(place, loc="left")
        grid[0, 1].legend(loc="lower right")
    return figure


def _place(row: Row) -> str:
    return row.case.partition(",")[0]


def _fill(line: Sequence[Axes], rows: list[Row]) -> None:
    levels, available, misleading = line
    faulty = [row for row in rows if row.x]
    for colour, (series, group) in zip(_COLOURS, groupby(faulty, key=lambda row: row.series), strict=False):
        of_kind = list(group)
        name = series.partition(", ")[2]
        _curve(levels, of_kind, lambda row: _cm(row.hpl_m), colour, "-", name)
        _curve(levels, of_kind, lambda row: _cm(row.rmse_m), colour, ":", None)
        _curve(available, of_kind, lambda row: 100.0 * (row.available or 0.0), colour, "-", name)
        _shares(misleading, of_kind, colour)
    for row in rows:
        if not row.x and row.hpl_m is not None:
            levels.axhline(100.0 * row.hpl_m, color=MUTED, linewidth=1.0, linestyle="--", zorder=1.5)
    levels.set(ylabel="median HPL (—), RMSE (···) in cm; clean: - -", yscale="log")
    levels.yaxis.set_major_formatter("{x:g}")
    levels.yaxis.set_minor_formatter("{x:g}")
    levels.tick_params(axis="y", which="minor", labelsize=6.0)
    available.set(ylabel="fixes with a level, %", ylim=(0.0, 103.0))
    misleading.axhline(rows[0].risk or 0.0, color=MUTED, linewidth=1.0, linestyle="--", zorder=1.5)
    misleading.set(ylabel="misleading, with 99 % interval; stated risk: - -", yscale="log", ylim=(0.7 * LEAST, None))
    for axes in line:
        axes.set(xlabel="size of the fault in m", xscale="log")
        axes.xaxis.set_major_formatter("{x:g}")


def _cm(value_m: float | None) -> float | None:
    return None if value_m is None else 100.0 * value_m


def _numbers(values: Iterable[float | None]) -> list[float]:
    return [np.nan if value is None else value for value in values]


def _curve(axes: Axes, rows: list[Row], value: _Values, colour: str, line: str, name: str | None) -> None:
    axes.plot(
        _numbers(row.x for row in rows),
        _numbers(map(value, rows)),
        line,
        marker="o",
        markersize=3.5,
        color=colour,
        label=name,
    )


def _shares(axes: Axes, rows: list[Row], colour: str) -> None:
    for row in rows:
        share, (low, high) = max(row.hmi or 0.0, LEAST), row.hmi_interval or (0.0, 0.0)
        size_m = row.x or 0.0
        axes.plot([size_m, size_m], [max(low, LEAST), max(high, LEAST)], color=colour, linewidth=1.0, alpha=0.6)
        axes.plot(size_m, share, "o", color=colour, markersize=3.5)
