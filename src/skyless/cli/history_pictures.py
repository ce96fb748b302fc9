"""Pictures of the history's answers."""

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from skyless.site.report import BLUE, MAP, MUTED, panel, report_style

_BARS: Final = 30

_Zones = Mapping[str, tuple[str, tuple[tuple[float, float], ...]]]

_Answer = Mapping[str, Any]
"""The fields of an answer (``run/history/answers.py``), with names beside identifiers."""


def track_figure(track: _Answer, zones: _Zones, title: str) -> Figure:
    """Draw the track over the zones, interrupted at gaps."""
    with report_style():
        figure, axes = panel(f"{track['tag_name']}, {title}", 4.2)
        rows = np.array([(point.unix_s, point.x_m, point.y_m) for point in track["points"]]).reshape(-1, 3)
        usual_s = np.median(np.diff(rows[:, 0])) if len(rows) > 1 else 0.0
        gaps = np.flatnonzero(np.diff(rows[:, 0]) > max(track["gap_s"], 3.0 * usual_s)) + 1
        for part in np.split(rows, gaps):
            axes.plot(part[:, 1], part[:, 2], ".-", color=BLUE, markersize=1.5, linewidth=0.7)
        _plan(axes, zones)
        return figure


def heatmap_figure(heatmap: _Answer, zones: _Zones, title: str) -> Figure:
    """Draw the time in each cell over the zones, in logarithmic colours."""
    with report_style():
        figure, axes = panel(title, 4.2)
        seconds = np.array(heatmap["seconds"]).reshape(heatmap["rows"], heatmap["columns"])
        if (seconds > 0.0).any():
            x0_m, y0_m, cell_m = (heatmap[name] for name in ("x0_m", "y0_m", "cell_m"))
            extent = (x0_m, x0_m + cell_m * seconds.shape[1], y0_m, y0_m + cell_m * seconds.shape[0])
            shown = np.ma.masked_equal(seconds, 0.0)
            drawn = axes.imshow(shown, extent=extent, origin="lower", cmap=MAP, norm=LogNorm())
            figure.colorbar(drawn, ax=axes, label="time in s")
        _plan(axes, zones)
        return figure


def dwell_figure(dwell: Sequence[_Answer], _zones: _Zones, title: str) -> Figure:
    """Draw the longest times as bars."""
    longest = sorted(dwell, key=lambda one: -one["seconds"])[:_BARS][::-1]
    with report_style():
        figure, axes = panel(title, 1.2 + 0.2 * max(len(longest), 3))
        names = [f"{one['tag_name']}, {one['zone_name']}" for one in longest]
        axes.barh(names, [one["seconds"] / 60.0 for one in longest], color=BLUE)
        axes.set_xlabel("time in min")
        return figure


def contacts_figure(contacts: Sequence[_Answer], _zones: _Zones, title: str) -> Figure:
    """Draw when each other tag was near."""
    times = [(one["other_name"], one["begin_unix_s"], one["end_unix_s"]) for one in contacts]
    names = list(dict.fromkeys(name for name, _, _ in times))[:_BARS][::-1]
    with report_style():
        figure, axes = panel(title, 1.2 + 0.2 * max(len(names), 3))
        for name, begin_s, end_s in times:
            if name in names:
                begin, end = datetime.fromtimestamp(begin_s), datetime.fromtimestamp(end_s)
                axes.barh(name, end - begin, left=begin, color=BLUE)  # type: ignore[arg-type]
        figure.autofmt_xdate()
        return figure


def _plan(axes: Axes, zones: _Zones) -> None:
    for name, corners in zones.values():
        if corners:
            x_m, y_m = zip(*corners, corners[0], strict=True)
            axes.plot(x_m, y_m, color=MUTED, linewidth=0.8)
            axes.annotate(name, (sum(x_m[1:]) / len(corners), sum(y_m[1:]) / len(corners)), fontsize=7.0, ha="center")
    axes.set(xlabel="x in m", ylabel="y in m", aspect="equal")


FIGURES: Final[Mapping[str, Callable[[Any, _Zones, str], Figure]]] = {
    "track": track_figure,
    "heatmap": heatmap_figure,
    "dwell": dwell_figure,
    "contacts": contacts_figure,
}
"""Functions that draw the answer to a question, by the question's name."""
