"""Which side of a limit is the safe one, shaded and named in the pictures of studies."""

from typing import Final, Literal

from matplotlib.axes import Axes
from msgspec import Struct

from skyless.evaluation.figures import GREEN, INK, RED

_ALPHA: Final = 0.07
_ROOM: Final = 1.25
"""Both sides of the limit are in view: the axis reaches to at least this multiple of it, and to a part of it."""


class Sides(Struct, frozen=True):
    """What it means to be below and above a limit."""

    below: str
    above: str
    safe: Literal["below", "above", "neither"] = "below"
    """``neither``: far from the limit is bad on both sides."""


CONFIDENCE: Final = Sides("errors smaller than reported: safe side", "errors larger than reported: too confident")
"""Of squared errors over reported variances, whose limit is 1."""

STATED_RISK: Final = Sides("rarer than stated: safe side", "more often than stated: too confident")
"""Of the share of errors beyond a protection level, whose limit is the stated probability."""

BOUND: Final = Sides("below the bound: by chance alone", "above the bound: information not used", "neither")
"""Of errors over the smallest possible ones, whose limit is 1."""


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
            span(start, end, color=colour, alpha=_ALPHA, linewidth=0.0, zorder=0.5)
        _name(axes, words, colour, side, along)
    set_limits(low, high)


def name_sides(axes: Axes, sides: Sides, *, along: Literal["x", "y"]) -> None:
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
