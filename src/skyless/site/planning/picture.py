"""Pictures of a plan: the predicted error over the floor and its causes, or the beacons that reach tags."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import BoundaryNorm, Colormap, LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.text import Annotation, Text
from matplotlib.transforms import Bbox
from msgspec import Struct

from skyless.core.arrays import Array
from skyless.core.geometry import Box, anchor_positions
from skyless.core.site import Site
from skyless.site.planning.colours import COLOUR_STOPS, round_values, scale_of
from skyless.site.planning.links import ANCHORS_IN_VIEW, FIX_SHARE, HDOP, PDOP, RMSE, SIGMA, VDOP, Floor, floor_plan_box
from skyless.site.planning.maps import Grid, PlanMap
from skyless.site.planning.rates import RateMap

_EDGE: Final = "black"
_FLAT: Final = 0.45  # floors with a smaller aspect ratio have the colour bar below them
_PANEL_IN: Final = 8.0
_SMALL_PANEL_IN: Final = 5.2
_TALLEST: Final = 1.2  # largest ratio of a floor's height to its width in the picture
_MARGIN: Final = 0.07  # margin for names of anchors, as a share of the floor's longer side
_NAME_OFFSETS: Final = (
    *((7, 6), (-7, 6), (7, -6), (-7, -6), (0, 9), (0, -9), (10, 0), (-10, 0)),
    *((14, 12), (-14, 12), (14, -12), (-14, -12), (0, 18), (0, -18)),
)
"""Candidate offsets of a name from its anchor, in points; the first free one is used."""

_HALF_MARK: Final = 5.0  # half the size of an anchor's mark, in points


class Layer(Struct, frozen=True):
    """One kind of map."""

    column: int
    title: str
    unit: str
    scale: float = 1.0
    more_is_better: bool = False
    """Whether to reverse the colours, which run from the best value to the worst."""

    @property
    def label(self) -> str:
        """Label of the colour bar."""
        return f"{self.title} in {self.unit}" if self.unit else self.title


SIGMA_LAYER: Final = Layer(SIGMA, "predicted standard deviation", "cm", 100.0)
RMSE_LAYER: Final = Layer(RMSE, "predicted RMSE, walls' delays included", "cm", 100.0)
_LAYERS: Final = (
    SIGMA_LAYER,
    Layer(ANCHORS_IN_VIEW, "anchors in view", "", more_is_better=True),
    Layer(HDOP, "horizontal dilution of precision (HDOP)", ""),
    Layer(FIX_SHARE, "fixes of those possible", "%", 100.0, more_is_better=True),
)


class Background(Struct, frozen=True):
    """Content drawn in addition to the map."""

    site: Site
    floor: Floor
    file: Path
    """The site's file; the floor plan's image is relative to it."""
    described: str
    """Method, noise and schedule, in words."""


def main_layer(plan: PlanMap) -> Layer:
    """The layer of the predicted error, including the walls' delays if there are any."""
    return RMSE_LAYER if plan.has_bias else SIGMA_LAYER


def layers_for(plan: PlanMap) -> tuple[Layer, ...]:
    """The layers to show: RMSE only if walls bias positions, VDOP and PDOP only in 3-D."""
    layers = list(_LAYERS)
    if plan.has_bias:
        layers.insert(1, RMSE_LAYER)
    if np.nanmax(plan.column(VDOP)) > 0.0:
        layers.insert(-1, Layer(VDOP, "vertical dilution of precision (VDOP)", ""))
        layers.insert(-1, Layer(PDOP, "dilution of precision of the position (PDOP)", ""))
    return tuple(layers)


def value_colours(*, reversed_: bool = False) -> Colormap:
    """Colour map of predicted values, from the best to the worst; reversed if more is better."""
    stops = COLOUR_STOPS[::-1] if reversed_ else COLOUR_STOPS
    return LinearSegmentedColormap.from_list("predicted", list(stops))


def draw_layer(plan: PlanMap, layer: Layer, background: Background) -> Figure:
    """Draw one layer, with a panel for each height."""
    heights = plan.grid.heights_m
    x1, y1 = background.floor.outline_m.min(axis=0)
    x2, y2 = background.floor.outline_m.max(axis=0)
    margin = 2.0 * _MARGIN * max(x2 - x1, y2 - y1)
    ratio = float((y2 - y1 + margin) / (x2 - x1 + margin))
    flat = ratio < _FLAT
    width = _SMALL_PANEL_IN if len(heights) > 1 else _PANEL_IN
    width *= min(1.0, _TALLEST / ratio)
    rows, columns = (len(heights), 1) if flat else (1, len(heights))
    size = (max(width * columns + (0.4 if flat else 1.6), 6.0), (width * ratio + 0.6) * rows + (1.9 if flat else 1.2))
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{background.site.name}: {layer.title}\n{background.described}", fontsize=11, wrap=True)
    panels = figure.subplots(rows, columns, sharex=flat, sharey=not flat, squeeze=False).ravel()
    values = plan.column(layer.column) * layer.scale
    norm, ticks = _norm(values, layer)
    labels: list[tuple[Axes, list[Annotation], list[Text]]] = []
    for axes, height, shown in zip(panels, heights, values, strict=True):
        mesh, contours = _slice(axes, plan, shown, norm, layer, background)
        axes.set(aspect="equal", title=f"tag at a height of {height:g} m")
        labels.append((axes, _site_plan(axes, background), contours))
    for axes in panels[-1:] if flat else panels:
        axes.set_xlabel("x in m")
    for axes in panels if flat else panels[:1]:
        axes.set_ylabel("y in m")
    bar = figure.colorbar(
        mesh, ax=list(panels), label=layer.label, location="bottom" if flat else "right", aspect=50.0 if flat else 25.0
    )
    if ticks is not None:
        bar.set_ticks(list(ticks), labels=[f"{tick:.3g}" for tick in ticks])
        bar.ax.minorticks_off()
    handles = {handle.get_label(): handle for axes in panels for handle in axes.get_legend_handles_labels()[0]}
    figure.legend(handles=list(handles.values()), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    figure.draw_without_rendering()  # computes the layout, which shows what overlaps
    for axes, names, contours in labels:
        _separate(axes, names, contours)
    return figure


def _separate(axes: Axes, names: list[Annotation], contours: list[Text]) -> None:
    """Move anchor names to free positions, and remove contour labels that cover something.

    A name without a free position is removed, as it would cover another one.
    """
    figure = axes.figure
    points = figure.dpi / 72.0
    frame = axes.get_window_extent()
    marks = []
    for name in names:
        x, y = axes.transData.transform(name.xy)
        half = _HALF_MARK * points
        marks.append(Bbox.from_extents(x - half, y - half, x + half, y + half))
    taken = list(marks)
    for name in names:
        for dx, dy in _NAME_OFFSETS:
            name.set_position((dx, dy))
            name.set(ha="left" if dx > 0 else "right" if dx < 0 else "center")
            name.set(va="bottom" if dy > 0 else "top" if dy < 0 else "center")
            box = name.get_window_extent().padded(points)
            if _contains(frame, box) and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
        else:
            name.remove()
    for label in contours:
        box = label.get_window_extent().padded(2.0 * points)
        if _contains(frame, box) and not any(box.overlaps(other) for other in taken):
            taken.append(box)
        else:
            label.remove()


def _contains(outer: Bbox, inner: Bbox) -> bool:
    return bool(inner.x0 >= outer.x0 and inner.y0 >= outer.y0 and inner.x1 <= outer.x1 and inner.y1 <= outer.y1)


def _norm(values: Array, layer: Layer) -> tuple[LogNorm | BoundaryNorm | None, tuple[float, ...] | None]:
    """Colour norm and ticks: whole numbers for anchors, default for per cent, else the scale of the page's map."""
    known = np.sort(values[np.isfinite(values)])
    if layer.column == ANCHORS_IN_VIEW:
        most = int(known.max(initial=1))
        every = max(1, (most + 1) // 12)
        bounds = np.arange(-0.5, most + every, every)
        return BoundaryNorm(bounds.tolist(), 256), tuple((bounds[:-1] + 0.5).tolist())
    if layer.column == FIX_SHARE:
        return None, None
    scale = scale_of(known.tolist())
    return (None, None) if scale is None else (LogNorm(scale.low, scale.high), scale.ticks)


def _slice(
    axes: Axes, plan: PlanMap, values: Array, norm: LogNorm | BoundaryNorm | None, layer: Layer, background: Background
) -> tuple[AxesImage, list[Text]]:
    """Draw colours and contours of one height. Returns the image and the contour labels."""
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
        np.where(np.isfinite(shown), shown, np.nan), extent=extent, origin="lower",
        cmap=value_colours(reversed_=layer.more_is_better), norm=norm, interpolation="nearest", alpha=opacity,
        zorder=2, vmin=None if most is None else 0.0, vmax=most,
    )  # fmt: skip
    if isinstance(norm, LogNorm) and np.isfinite(shown).sum() > 3 and min(shown.shape) > 1:
        contours = _contours(axes, plan, shown, norm, layer)
    else:
        contours = []
    if without_fix.any():
        axes.plot([], [], "s", color="#d9d9d9", label="no fix")
    return mesh, contours


def cells_box(grid: Grid) -> Box:
    """Outer edges of a grid's cells as an image extent: left, right, bottom, top, metres."""
    return (*_extent(grid.x_m), *_extent(grid.y_m))


def _extent(centres: Array) -> tuple[float, float]:
    half = (centres[1] - centres[0]) / 2.0 if len(centres) > 1 else 0.5
    return float(centres[0] - half), float(centres[-1] + half)


def _contours(axes: Axes, plan: PlanMap, shown: Array, norm: LogNorm, layer: Layer) -> list[Text]:
    low, high = float(norm.vmin or 0.1), float(norm.vmax or 1.0)
    levels = round_values(low, high)
    clipped = np.where(np.isfinite(shown), np.minimum(shown, 2.0 * high), np.nan)
    if len(levels) == 0 or not (np.nanmin(clipped) < levels[-1] and np.nanmax(clipped) > levels[0]):
        return []
    lines = axes.contour(plan.grid.x_m, plan.grid.y_m, clipped, levels, colors="white", linewidths=0.9, zorder=3)
    unit = f" {layer.unit}" if layer.unit else ""
    texts = axes.clabel(lines, fmt=lambda level: f"{level:.3g}{unit}", fontsize=8, inline=False, colors="white")
    for text in texts:
        text.set_bbox({"facecolor": "black", "alpha": 0.55, "pad": 0.8, "edgecolor": "none"})
    return list(texts)


def draw_image(axes: Axes, site: Site, file: Path) -> None:
    """Draw the floor plan's image, if any, below everything else; its path is relative to the site's file."""
    plan = site.floor_plan
    box = floor_plan_box(site, file)
    if plan is None or box is None:
        return
    from matplotlib.image import imread  # noqa: PLC0415 (only with a floor plan)

    axes.imshow(imread(file.parent / plan.image), extent=(box[0], box[2], box[1], box[3]), zorder=0, cmap="gray")


def draw_outline_and_walls(axes: Axes, site: Site, floor: Floor) -> None:
    """Draw the floor's outline and the walls, the first with a label, and set the axes' limits just outside."""
    closed = np.vstack([floor.outline_m, floor.outline_m[:1]])
    axes.plot(closed[:, 0], closed[:, 1], color=_EDGE, linewidth=1.2, zorder=4)
    for index, wall in enumerate(site.walls):
        label = "wall" if index == 0 else None
        ends = ([wall.x1_m, wall.x2_m], [wall.y1_m, wall.y2_m])
        axes.plot(*ends, color="white", linewidth=5.0, zorder=4, solid_capstyle="butt")
        axes.plot(*ends, color="#b2182b", linewidth=3.0, zorder=5, solid_capstyle="butt", label=label)
    margin = _MARGIN * float(np.ptp(closed, axis=0).max())
    low, high = closed.min(axis=0) - margin, closed.max(axis=0) + margin
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


def _site_plan(axes: Axes, background: Background) -> list[Annotation]:
    """Draw outline, walls and anchors, with a star for the master. Returns the anchors' names."""
    site = background.site
    draw_outline_and_walls(axes, site, background.floor)
    names = []
    for anchor in site.anchors:
        master = site.schedule.needs_master and anchor.id == site.master
        axes.plot(
            anchor.x_m, anchor.y_m, "*" if master else "^", markersize=15 if master else 9, color="white",
            markeredgecolor=_EDGE, zorder=6, clip_on=False,
        )  # fmt: skip
        label = f"{anchor.id}" if site.tags.height_m is not None else f"{anchor.id}: {anchor.z_m:g} m"
        names.append(
            axes.annotate(
                label, (anchor.x_m, anchor.y_m), xytext=_NAME_OFFSETS[0], textcoords="offset points", fontsize=8,
                zorder=7, bbox={"facecolor": "white", "alpha": 0.8, "pad": 1.0, "edgecolor": "none"},
            )
        )  # fmt: skip
    for marker, name in (("*", "master"), ("^", "anchor")):
        axes.plot([], [], marker, color="white", markeredgecolor=_EDGE, linestyle="none", label=name)
    return names


# Beacons per second, at a site without a master


_MAX_LABELS: Final = 300  # identifiers are left out with more anchors
_RATES_PANEL_IN: Final = 9.0
_POINTS_PER_IN: Final = 72.0


def draw_rates(site: Site, floor: Floor, mapped: RateMap, file: Path, described: str) -> Figure:
    """Draw the beacons per second at a tag, the minimum over the heights at every point; ``file``: the site's."""
    x1, y1 = floor.outline_m.min(axis=0)
    x2, y2 = floor.outline_m.max(axis=0)
    height_in = float(np.clip(_RATES_PANEL_IN * (y2 - y1) / (x2 - x1), 2.0, 1.3 * _RATES_PANEL_IN))
    figure = Figure(figsize=(_RATES_PANEL_IN + 1.2, height_in + 1.5), layout="constrained")
    heights = ", ".join(f"{height:g}" for height in mapped.grid.heights_m)
    several = "the least at heights of" if len(mapped.grid.heights_m) > 1 else "at a height of"
    figure.suptitle(f"{site.name}: beacons per second at a tag, {several} {heights} m\n{described}", fontsize=11)
    axes = figure.subplots()
    image = axes.imshow(
        mapped.beacons_per_s.min(axis=0), extent=cells_box(mapped.grid), origin="lower",
        cmap=value_colours(reversed_=True), vmin=0.0, interpolation="nearest", zorder=1, alpha=0.85,
    )  # fmt: skip
    draw_image(axes, site, file)
    draw_outline_and_walls(axes, site, floor)
    _draw_anchors(axes, site)
    axes.set(xlabel="x in m", ylabel="y in m", aspect="equal")
    if site.walls:
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), fontsize=8, frameon=False)
    figure.colorbar(image, ax=axes, label="beacons per second at a tag", shrink=0.8)
    return figure


def _draw_anchors(axes: Axes, site: Site) -> None:
    """Draw a dot for each anchor, sized by spacing, with its identifier unless there are too many."""
    points = anchor_positions(site)
    extent = np.ptp(points[:, :2], axis=0)
    spacing_m = max(float(np.sqrt(extent[0] * extent[1] / len(points))), float(extent.max() / len(points)), 0.1)
    apart_points = _RATES_PANEL_IN * _POINTS_PER_IN / max(float(extent.max()) / spacing_m, 1.0)
    diameter = float(np.clip(0.5 * apart_points, 2.0, 17.0))
    axes.scatter(
        points[:, 0], points[:, 1], s=diameter**2, c="white", edgecolors="black", linewidths=0.5, zorder=6,
        clip_on=False,
    )  # fmt: skip
    for anchor in site.anchors if len(points) <= _MAX_LABELS else ():
        axes.annotate(
            f"{anchor.id}", (anchor.x_m, anchor.y_m), ha="center", va="center_baseline", zorder=7,
            fontsize=max(0.5 * diameter, 4.0),
        )  # fmt: skip
