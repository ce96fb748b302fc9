"""Pictures of a plan: the predicted error over the floor, and what makes it."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from msgspec import Struct

from skyless.kernels.arrays import Array
from skyless.planning.columns import ANCHORS_IN_VIEW, BIAS, FIX_SHARE, HDOP, PDOP, RMSE, SIGMA, VDOP
from skyless.planning.floor import Box, Floor, floor_plan_box
from skyless.planning.maps import Grid, PlanMap
from skyless.site.model import Site

_NO_FIX: Final = "#d9d9d9"
_EDGE: Final = "black"


class Layer(Struct, frozen=True):
    """One kind of map."""

    column: int
    title: str
    unit: str
    scale: float = 1.0


SIGMA_LAYER: Final = Layer(SIGMA, "predicted standard deviation", "cm", 100.0)
RMSE_LAYER: Final = Layer(RMSE, "predicted RMSE, walls' delays included", "cm", 100.0)
_LAYERS: Final = (
    SIGMA_LAYER,
    Layer(ANCHORS_IN_VIEW, "anchors in view", "anchors"),
    Layer(HDOP, "horizontal dilution of precision (HDOP)", ""),
    Layer(FIX_SHARE, "fixes of those possible", "%", 100.0),
)


class Background(Struct, frozen=True):
    """What is drawn besides the map."""

    site: Site
    floor: Floor
    file: Path
    """The site's file, next to which the image of the floor lies."""
    described: str
    """Method, noise and schedule, in words."""


def layers_for(plan: PlanMap) -> tuple[Layer, ...]:
    """The layers worth showing: RMSE only where walls bias positions, VDOP and PDOP only in 3-D."""
    bias = plan.column(BIAS)
    layers = list(_LAYERS)
    if np.nanmax(np.where(np.isfinite(bias), bias, 0.0)) > 1e-4:
        layers.insert(1, RMSE_LAYER)
    if np.nanmax(plan.column(VDOP)) > 0.0:
        layers.insert(-1, Layer(VDOP, "vertical dilution of precision (VDOP)", ""))
        layers.insert(-1, Layer(PDOP, "dilution of precision of the position (PDOP)", ""))
    return tuple(layers)


def draw_layer(plan: PlanMap, layer: Layer, background: Background) -> Figure:
    """One layer, a slice for each height, next to each other."""
    grid = plan.grid
    heights = grid.heights_m
    x1, y1 = background.floor.outline_m.min(axis=0)
    x2, y2 = background.floor.outline_m.max(axis=0)
    width = 5.2 if len(heights) > 1 else 8.0
    height_in = float(np.clip(width * (y2 - y1) / (x2 - x1), 2.5, 1.4 * width)) + 1.5
    figure = Figure(figsize=(width * len(heights) + 1.2, height_in), layout="constrained")
    figure.suptitle(f"{background.site.name}: {layer.title}\n{background.described}", fontsize=11)
    axes = np.atleast_1d(figure.subplots(1, len(heights), sharey=True))
    values = plan.column(layer.column) * layer.scale
    norm, ticks = _norm(values, layer)
    for k, height in enumerate(heights):
        mesh = _slice(axes[k], plan, values[k], norm, layer, background)
        axes[k].set(xlabel="x in m", aspect="equal", title=f"tag at a height of {height:g} m")
    axes[0].set_ylabel("y in m")
    bar = figure.colorbar(mesh, ax=list(axes), label=f"{layer.title} in {layer.unit}" if layer.unit else layer.title)
    if ticks is not None:
        bar.set_ticks(ticks.tolist(), labels=[f"{tick:.3g}" for tick in ticks])
        bar.ax.minorticks_off()
    return figure


def _norm(values: Array, layer: Layer) -> tuple[LogNorm | BoundaryNorm | None, Array | None]:
    """Colours: whole numbers for anchors, per cent from 0 to 100, else logarithmic between percentiles."""
    known = values[np.isfinite(values)]
    if layer.column == ANCHORS_IN_VIEW:
        most = int(known.max(initial=1))
        every = max(1, (most + 1) // 12)
        bounds = np.arange(-0.5, most + every, every)
        return BoundaryNorm(bounds.tolist(), 256), bounds[:-1] + 0.5
    if layer.column == FIX_SHARE or len(known) == 0:
        return None, None
    low = max(float(np.percentile(known, 1)), 1e-6)
    high = max(float(np.percentile(known, 98)), 1.3 * low)
    return LogNorm(low, high), _round_numbers(low, high)


def _round_numbers(low: float, high: float) -> Array:
    """About six round numbers between two."""
    if high / low > 8.0:
        decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
        ticks = np.sort(np.concatenate([decades, 2 * decades, 5 * decades]))
    else:
        rough = (high - low) / 6.0
        decade = 10.0 ** np.floor(np.log10(rough))
        step = float(min((m * decade for m in (1, 2, 2.5, 5, 10)), key=lambda s: abs(s - rough)))
        ticks = np.arange(np.ceil(low / step), high / step) * step
    inside: Array = ticks[(ticks >= low) & (ticks <= high)]
    return inside


def _slice(
    axes: Axes, plan: PlanMap, values: Array, norm: LogNorm | BoundaryNorm | None, layer: Layer, background: Background
) -> AxesImage:
    grid = plan.grid
    draw_image(axes, background.site, background.file)
    shown = np.where(grid.within, values, np.nan)
    extent = cells_box(grid)
    without_fix = grid.within & ~np.isfinite(values)
    opacity = 0.75 if background.site.floor_plan else 1.0
    axes.imshow(
        np.where(without_fix, 1.0, np.nan), extent=extent, origin="lower", cmap="Greys", vmin=0.0, vmax=5.0,
        interpolation="nearest", zorder=1,
    )  # fmt: skip
    most = 100.0 if norm is None else None
    mesh = axes.imshow(
        np.where(np.isfinite(shown), shown, np.nan), extent=extent, origin="lower", cmap="cividis", norm=norm,
        interpolation="nearest", alpha=opacity, zorder=2, vmin=None if most is None else 0.0, vmax=most,
    )  # fmt: skip
    if isinstance(norm, LogNorm) and np.isfinite(shown).sum() > 3 and min(shown.shape) > 1:
        _contours(axes, plan, shown, norm, layer)
    _site_plan(axes, background)
    if without_fix.any():
        axes.plot([], [], "s", color=_NO_FIX, label="no fix")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=4, fontsize=8, frameon=False)
    return mesh


def cells_box(grid: Grid) -> Box:
    """Return the outer edges of a grid's cells as an image's extent: left, right, bottom, top, metres."""
    return (*_extent(grid.x_m), *_extent(grid.y_m))


def _extent(centres: Array) -> tuple[float, float]:
    half = (centres[1] - centres[0]) / 2.0 if len(centres) > 1 else 0.5
    return float(centres[0] - half), float(centres[-1] + half)


def _contours(axes: Axes, plan: PlanMap, shown: Array, norm: LogNorm, layer: Layer) -> None:
    levels = _round_numbers(float(norm.vmin or 0.1), float(norm.vmax or 1.0))
    clipped = np.where(np.isfinite(shown), np.minimum(shown, 2.0 * float(norm.vmax or 1.0)), np.nan)
    if len(levels) == 0 or not (np.nanmin(clipped) < levels[-1] and np.nanmax(clipped) > levels[0]):
        return
    lines = axes.contour(plan.grid.x_m, plan.grid.y_m, clipped, levels, colors="white", linewidths=0.9, zorder=3)
    unit = f" {layer.unit}" if layer.unit else ""
    texts = axes.clabel(lines, fmt=lambda level: f"{level:.3g}{unit}", fontsize=8)
    for text in texts:
        text.set_bbox({"facecolor": "black", "alpha": 0.55, "pad": 0.8, "edgecolor": "none"})


def draw_image(axes: Axes, site: Site, file: Path) -> None:
    """Draw the image of the floor, below everything else; the path of it is relative to the site's file."""
    plan = site.floor_plan
    box = floor_plan_box(site, file)
    if plan is None or box is None:
        return
    from matplotlib.image import imread  # noqa: PLC0415 (only with a floor plan)

    image = imread(file.parent / plan.image)
    axes.imshow(image, extent=(box[0], box[2], box[1], box[3]), zorder=0, cmap="gray")


def draw_outline_and_walls(axes: Axes, site: Site, floor: Floor) -> None:
    """Draw the floor's outline and the walls; the first wall has a label, and the axes end just outside."""
    closed = np.vstack([floor.outline_m, floor.outline_m[:1]])
    axes.plot(closed[:, 0], closed[:, 1], color=_EDGE, linewidth=1.2, zorder=4)
    for index, wall in enumerate(site.walls):
        label = "wall" if index == 0 else None
        ends = ([wall.x1_m, wall.x2_m], [wall.y1_m, wall.y2_m])
        axes.plot(*ends, color="white", linewidth=5.0, zorder=4, solid_capstyle="butt")
        axes.plot(*ends, color="#b2182b", linewidth=3.0, zorder=5, solid_capstyle="butt", label=label)
    margin = 0.05 * float(np.ptp(closed, axis=0).max())
    low, high = closed.min(axis=0) - margin, closed.max(axis=0) + margin
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


def _site_plan(axes: Axes, background: Background) -> None:
    """Outline, walls, and anchors with their identifiers; the master is a star."""
    site = background.site
    draw_outline_and_walls(axes, site, background.floor)
    for anchor in site.anchors:
        master = anchor.id == site.master
        axes.plot(
            anchor.x_m, anchor.y_m, "*" if master else "^", markersize=15 if master else 9, color="white",
            markeredgecolor=_EDGE, zorder=6, clip_on=False,
        )  # fmt: skip
        label = f"{anchor.id}" if site.tags.height_m is not None else f"{anchor.id}\n{anchor.z_m:g} m"
        axes.annotate(
            label, (anchor.x_m, anchor.y_m), xytext=(7, 5), textcoords="offset points", fontsize=8, zorder=7,
            bbox={"facecolor": "white", "alpha": 0.8, "pad": 1.0, "edgecolor": "none"},
        )  # fmt: skip
    for marker, name in (("*", "master"), ("^", "anchor")):
        axes.plot([], [], marker, color="white", markeredgecolor=_EDGE, label=name)
