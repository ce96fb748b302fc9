"""Figures: one style for all, with sizes for a phone's width and colours for a bright and a dark page; and their files.

Files are written whole or not at all, and without a screen.
"""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from cycler import cycler
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

INK: Final = "#1f2933"
MUTED: Final = "#5f6b7a"
GRID: Final = "#d9dee5"
PAPER: Final = "#ffffff"
"""These four turn on a dark page; the others can be seen on both."""

MAP_WHITE: Final = "#fdfdfd"
"""On maps, on either page."""

BLUE: Final = "#2f86d0"
ORANGE: Final = "#dd7a1f"
GREEN: Final = "#1f9d73"
PURPLE: Final = "#a56bc4"
RED: Final = "#d1495b"

METHOD_COLOURS: Final = {"literal": ORANGE, "weighted": PURPLE, "bracketed": GREEN, "joint": BLUE}
MAP: Final = "viridis"

_RC: Final[dict[Any, Any]] = {
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "text.color": INK,
    "axes.titlecolor": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.facecolor": PAPER,
    "figure.facecolor": PAPER,
    "legend.facecolor": PAPER,
    "legend.edgecolor": GRID,
    "legend.framealpha": 0.9,
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": cycler(color=[BLUE, ORANGE, GREEN, PURPLE, RED]),
    "axes.unicode_minus": True,
    "lines.linewidth": 1.4,
    "svg.fonttype": "none",
    "svg.hashsalt": "skyless",
}


@contextmanager
def report_style() -> Iterator[None]:
    """Everything drawn and saved in the block has the style of the reports."""
    with rc_context(_RC):
        yield


def panel(title: str, height_in: float = 3.5) -> tuple[Figure, Axes]:
    """An empty picture of the report's width with one pair of axes."""
    figure = Figure(figsize=(4.7, height_in), layout="constrained")
    axes = figure.subplots()
    axes.set_title(title, loc="left")
    return figure, axes


def draw_floor_plan(axes: Axes, anchors_m: list[tuple[float, float]], *, labels: bool = True) -> None:
    """Draw the lab's walls and anchors, the first one the master, in metres."""
    x, y = zip(*anchors_m, strict=True)
    left, right, low, high = min(x), max(x), min(y), max(y)
    axes.plot([left, right, right, left, left], [low, low, high, high, low], color=MUTED, linewidth=1.0, zorder=1)
    axes.plot(x[1:], y[1:], "s", color=INK, markersize=6, clip_on=False, zorder=5)
    axes.plot(x[:1], y[:1], "D", color=RED, markersize=7, clip_on=False, zorder=5)
    if labels:
        for number, (at_x, at_y) in enumerate(anchors_m, start=1):
            inwards = (9 if at_x < (left + right) / 2 else -9, 8 if at_y < high else -8)
            name = "1 (master)" if number == 1 else str(number)
            side = "left" if inwards[0] > 0 else "right"
            axes.annotate(
                name,
                (at_x, at_y),
                inwards,
                ha=side,
                va="center",
                textcoords="offset points",
                fontsize=8.0,
                color=INK,
                zorder=6,
            )
    axes.set(xlabel="x in m", ylabel="y in m", aspect="equal")
    axes.grid(visible=False)


def picture(figure: Figure, kind: str, dpi: float = 130.0) -> bytes:
    """A figure as the bytes of a file of that kind; the same figure gives the same bytes at any time.

    Raises:
        ValueError: there is no such kind.
    """
    FigureCanvasAgg(figure)
    file = io.BytesIO()
    undated = {"Date": None} if kind == "svg" else None
    figure.savefig(file, format=kind, dpi=dpi, metadata=undated)
    return file.getvalue()
