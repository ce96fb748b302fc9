"""The installer's sheet: for each floor a page with a plan of the anchors and a table of what to measure and mount."""

import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.image import imsave
from msgspec import Struct

from skyless.core.arrays import Matrix, Vector
from skyless.core.errors import ConfigurationError
from skyless.core.geometry import outline_of
from skyless.core.site import AnchorSite, Site
from skyless.site.planning.floor import floor_of, sides
from skyless.site.planning.picture import draw_image, draw_outline_and_walls
from skyless.site.report.figures import BLUE, INK, MUTED, ORANGE, report_style

_A4_IN: Final = (8.27, 11.69)
_ROWS_BELOW_PLAN: Final = 26
_ROWS_OF_PAGE: Final = 60
_NOT_PARALLEL: Final = 0.5  # sine of the least angle between two walls that fix a position
_DPI: Final = 110.0
_COLUMNS: Final = {
    "anchor": 0.09, "x / m": 0.1, "y / m": 0.1, "height / m": 0.11, "walls / m": 0.2, "cable / m": 0.16, "done": 0.07,
    "measured": 0.17,
}  # fmt: skip
"""Titles of the table and the columns' widths. The last two are for the person who mounts."""

Point = tuple[float, float, float]


class Mount(Struct, frozen=True):
    """A row of the table."""

    anchor: AnchorSite
    walls_m: dict[str, float]
    """Distances from two sides of the room that are not parallel, the nearest first. A is the side from the first
    corner of the outline to the second, B the next, and so on. Empty where the site has no outline."""
    cable_m: tuple[float, float] | None
    """Length of its cable, straight and along x, then y, then up, without what is needed to go round things."""


def mounts(site: Site, cables_from: Point | None = None) -> tuple[Mount, ...]:
    """The rows of all placed anchors, by floor and identifier."""
    outline_m = outline_of(site)
    rows = []
    for anchor in sorted(site.anchors, key=lambda one: (one.floor, one.id)):
        point_m = (anchor.x_m, anchor.y_m, anchor.z_m)
        walls_m = {} if outline_m is None else wall_distances(np.array(point_m[:2]), outline_m)
        cable_m = None
        if cables_from is not None:
            steps_m = [abs(a - b) for a, b in zip(point_m, cables_from, strict=True)]
            cable_m = math.hypot(*steps_m), sum(steps_m)
        rows.append(Mount(anchor, walls_m, cable_m))
    return tuple(rows)


def wall_distances(point_m: Vector, outline_m: Matrix) -> dict[str, float]:
    """Distances of a point, shape (2,), from the nearest side and from the nearest that is not parallel to it.

    Sides that a tape can be laid square to from the point come before others.
    """
    along = np.roll(outline_m, -1, axis=0) - outline_m
    lengths_m = np.linalg.norm(along, axis=1)
    x, y = (along / lengths_m[:, None]).T
    to_x, to_y = (point_m - outline_m).T
    beside = np.abs(to_x * x + to_y * y - lengths_m / 2.0) > lengths_m / 2.0 + 0.01
    distances_m = np.abs(x * to_y - y * to_x)
    first, *others = np.lexsort((distances_m, beside)).tolist()
    second = [side for side in others if abs(x[first] * y[side] - y[first] * x[side]) > _NOT_PARALLEL][:1]
    return {_letter(side): float(distances_m[side]) for side in (first, *second)}


def _letter(side: int) -> str:
    return chr(ord("A") + side % 26) + (str(side // 26) if side >= 26 else "")


def sheet(
    site: Site,
    file: Path | None,
    kind: Literal["pdf", "png"],
    date: str,
    cables_from: Point | None = None,
) -> bytes:
    """The sheet as a file: a page A4 for each floor, more where its anchors do not fit; in a PNG one below the other.

    ``file`` is the site's, next to which the image of the floor lies; without it the image is left out.

    Raises:
        ConfigurationError: no anchor has a position, or the anchors outline no floor.
    """
    if not site.anchors:
        right = "placed: skyless survey finds positions"
        raise ConfigurationError(file or Path("the site"), "anchors", "a list without positions", right)
    out = io.BytesIO()
    with report_style():
        pages = list(_pages(site, file, mounts(site, cables_from), cables_from, date))
        if kind == "pdf":
            with PdfPages(out, metadata={"CreationDate": None}) as pdf:
                for page in pages:
                    pdf.savefig(page)
        else:
            canvases = [FigureCanvasAgg(page) for page in pages]
            for canvas in canvases:
                canvas.draw()  # type: ignore[no-untyped-call]
            pixels = [np.asarray(canvas.buffer_rgba()) for canvas in canvases]  # type: ignore[no-untyped-call]
            imsave(out, np.vstack(pixels), format="png", dpi=_DPI)
    return out.getvalue()


def _pages(
    site: Site, file: Path | None, rows: tuple[Mount, ...], cables_from: Point | None, date: str
) -> Iterator[Figure]:
    storeys = sorted({row.anchor.floor for row in rows})
    for storey in storeys:
        own = [row for row in rows if row.anchor.floor == storey]
        title = f"{site.name} (site {site.id})" + (f", floor {storey}" if len(storeys) > 1 else "")
        page = _page(f"{title}: anchors to mount", _notes(site, rows, cables_from, date))
        _draw_plan(page.add_axes((0.1, 0.47, 0.83, 0.39)), site, file, own, cables_from)
        _fill(page.add_axes((0.07, 0.03, 0.86, 0.39)), own[:_ROWS_BELOW_PLAN])
        yield page
        for first in range(_ROWS_BELOW_PLAN, len(own), _ROWS_OF_PAGE):
            page = _page(f"{title}: anchors, continued", date)
            _fill(page.add_axes((0.07, 0.03, 0.86, 0.87)), own[first : first + _ROWS_OF_PAGE])
            yield page


def _page(title: str, notes: str) -> Figure:
    page = Figure(figsize=_A4_IN, dpi=_DPI)
    page.text(0.07, 0.965, title, fontsize=13, fontweight="bold", va="top", color=INK)
    page.text(0.07, 0.94, notes, fontsize=8, va="top", color=INK, linespacing=1.4)
    return page


def _notes(site: Site, rows: tuple[Mount, ...], cables_from: Point | None, date: str) -> str:
    walls = "distance square to the side of that letter" if outline_of(site) is not None else "no outline_m is given"
    lines = [f"{date}  {len(rows)} anchors. x, y and height are of the antenna, in metres. Walls: {walls}."]
    if cables_from is not None:
        straight_m, along_m = np.sum([row.cable_m or (0.0, 0.0) for row in rows], axis=0).tolist()
        start = ", ".join(f"{value:g}" for value in cables_from)
        lines.append(
            f"Cables from ({start}): {straight_m:.1f} m straight, {along_m:.1f} m along the axes in all, "
            "without reserve and detours."
        )
    if site.unplaced:
        lines.append(f"Without a position yet: anchors {', '.join(str(one.id) for one in site.unplaced)}.")
    return "\n".join(lines)


def _draw_plan(plan: Axes, site: Site, file: Path | None, rows: list[Mount], cables_from: Point | None) -> None:
    """Anchors with their identifiers, and the room's sides with letters and lengths."""
    if file is not None:
        draw_image(plan, site, file)
    draw_outline_and_walls(plan, site, floor_of(site, file or Path("the site"), None, None))
    plan.grid(visible=False)
    outline_m = outline_of(site)
    middle = np.array([plan.get_xlim(), plan.get_ylim()]).mean(axis=1).tolist()
    beside: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "center"}
    for side, (x1, y1, x2, y2) in enumerate([] if outline_m is None else sides(outline_m).tolist()):
        steep = abs(y2 - y1) > abs(x2 - x1)
        x, y = (x1 + x2) / 2.0, (y1 + y2) / 2.0
        away = (math.copysign(8.0, x - middle[0]), 0.0) if steep else (0.0, math.copysign(8.0, y - middle[1]))
        label = f"{_letter(side)} {math.hypot(x2 - x1, y2 - y1):.2f} m"
        plan.annotate(label, (x, y), away, fontsize=7.5, color=MUTED, rotation=90.0 if steep else 0.0, **beside)
    for row in rows:
        x, y = row.anchor.x_m, row.anchor.y_m
        plan.plot(x, y, "^", color=BLUE, markeredgecolor=INK, markersize=8, zorder=6, clip_on=False)
        inwards = (math.copysign(9.0, middle[0] - x), math.copysign(9.0, middle[1] - y))
        plan.annotate(str(row.anchor.id), (x, y), inwards, fontsize=7.0, zorder=7, **beside)
    if cables_from is not None:
        plan.plot(*cables_from[:2], "s", color=ORANGE, markeredgecolor=INK, markersize=8, zorder=6, label="cables from")
        plan.legend(loc="upper right")
    plan.set(aspect="equal", xlabel="x in m", ylabel="y in m")


def _fill(axes: Axes, rows: list[Mount]) -> None:
    axes.set_axis_off()
    cells = []
    for row in rows:
        at = row.anchor
        walls = ", ".join(f"{side} {distance_m:.2f}" for side, distance_m in row.walls_m.items()) or "–"
        cable = "–" if row.cable_m is None else "{:.1f} / {:.1f}".format(*row.cable_m)
        cells.append([str(at.id), f"{at.x_m:.3f}", f"{at.y_m:.3f}", f"{at.z_m:.3f}", walls, cable, "☐", ""])
    titles, widths = list(_COLUMNS), list(_COLUMNS.values())
    table = axes.table(cells, colLabels=titles, colWidths=widths, loc="upper center", cellLoc="center")
    table.auto_set_font_size(value=False)
    table.set_fontsize(7.0)
    box_in = axes.get_position().height * _A4_IN[1]
    for cell in table.get_celld().values():
        cell.set(height=min(0.16 / box_in, 1.0 / (len(rows) + 1)), linewidth=0.4, edgecolor=MUTED)
