"""Picture of a plan of protocol 2: anchors in the colours of their slots, and the beacons that reach tags."""

import colorsys
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from skyless.kernels.arrays import Array
from skyless.planning.floor import Floor
from skyless.planning.picture import cells_box, draw_image, draw_outline_and_walls, value_colours
from skyless.planning.slot_plan import RateMap
from skyless.site.model import Site
from skyless.site.near import anchor_positions

MOST_LABELS: Final = 300
"""With more anchors the picture has no numbers in them."""

_GOLDEN: Final = 0.618034
_NO_SLOT: Final = (0.8, 0.84, 0.9)
_PANEL_IN: Final = 7.0
_POINTS_PER_IN: Final = 72.0


def draw_slots(site: Site, floor: Floor, mapped: RateMap, file: Path, described: str) -> Figure:
    """Two panels: the anchors by slot, and beacons per second at a tag; ``file`` is the site's."""
    x1, y1 = floor.outline_m.min(axis=0)
    x2, y2 = floor.outline_m.max(axis=0)
    ratio = float((y2 - y1) / (x2 - x1))
    wide = ratio < 0.7
    panel_in = _PANEL_IN * 1.5 if wide else _PANEL_IN
    height_in = float(np.clip(panel_in * ratio, 1.5, 1.3 * panel_in)) + 0.9
    size = (panel_in + 1.2, 2 * height_in + 0.6) if wide else (2 * panel_in + 1.2, height_in + 0.6)
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(f"{site.name}: {described}", fontsize=11)
    anchors, rates = figure.subplots(2, 1) if wide else figure.subplots(1, 2)
    _draw_anchors(anchors, site, panel_in)
    image = _draw_rates(rates, mapped)
    for axes in (anchors, rates):
        draw_image(axes, site, file)
        draw_outline_and_walls(axes, site, floor)
        axes.set(xlabel="x in m", ylabel="y in m", aspect="equal")
    if site.walls:
        anchors.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), fontsize=8, frameon=False)
    figure.colorbar(image, ax=rates, label="beacons per second at a tag", shrink=0.8)
    return figure


def _draw_anchors(axes: Axes, site: Site, panel_in: float) -> None:
    """One dot for each anchor; its slot, in mode free its identifier, in it where there is space."""
    points = anchor_positions(site)
    labelled = len(points) <= MOST_LABELS
    longest_m = max(float(np.ptp(points[:, :2], axis=0).max()), 1.0)
    apart_points = panel_in * _POINTS_PER_IN / max(longest_m / _spacing_m(points), 1.0)
    diameter = float(np.clip(0.75 * apart_points, 2.0, 17.0))
    colours = [_NO_SLOT if anchor.slot is None else slot_colour(anchor.slot) for anchor in site.anchors]
    axes.scatter(points[:, 0], points[:, 1], s=diameter**2, c=colours, linewidths=0, zorder=6, clip_on=False)
    for anchor, colour in zip(site.anchors, colours, strict=True) if labelled else ():
        axes.annotate(
            f"{anchor.id if anchor.slot is None else anchor.slot}", (anchor.x_m, anchor.y_m), ha="center",
            va="center_baseline", zorder=7, fontsize=max(0.5 * diameter, 4.0),
            color="white" if _is_dark(colour) else "black",
        )  # fmt: skip
    if site.schedule.mode == "free":
        axes.set_title(f"anchors{' and their identifiers' if labelled else ''}")
    else:
        axes.set_title(f"anchors; one colour is one slot{', with its number' if labelled else ''}")


def _spacing_m(points: Array) -> float:
    """Distance of neighbours if the anchors stood on a grid over their box."""
    extent = np.ptp(points[:, :2], axis=0)
    return max(float(np.sqrt(extent[0] * extent[1] / max(len(points), 1))), float(extent.max() / len(points)), 0.1)


def slot_colour(slot: int) -> tuple[float, float, float]:
    """Red, green and blue of a slot, 0 to 1; slots with near numbers look different."""
    lightness = (0.42, 0.62, 0.78)[slot % 3]
    return colorsys.hls_to_rgb(slot * _GOLDEN % 1.0, lightness, 0.75)


def _is_dark(colour: tuple[float, float, float]) -> bool:
    red, green, blue = colour
    return 0.3 * red + 0.59 * green + 0.11 * blue < 0.5


def _draw_rates(axes: Axes, mapped: RateMap) -> AxesImage:
    """The lowest of the heights' rates at every point."""
    lowest = mapped.beacons_per_s.min(axis=0)
    heights = ", ".join(f"{height:g}" for height in mapped.grid.heights_m)
    several = "the least at heights of" if len(mapped.grid.heights_m) > 1 else "at a height of"
    axes.set_title(f"beacons per second at a tag, {several} {heights} m")
    return axes.imshow(
        lowest, extent=cells_box(mapped.grid), origin="lower", cmap=value_colours(reversed_=True), vmin=0.0,
        interpolation="nearest", zorder=1, alpha=0.85,
    )  # fmt: skip
