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
from skyless.site.planning.floor import Floor, floor_of, sides
from skyless.site.planning.picture import draw_image, draw_outline_and_walls
from skyless.site.report.figures import BLUE, INK, MUTED, ORANGE, report_style

_A4_IN: Final = (8.27, 11.69)
_ROWS_BELOW_PLAN: Final = 26
_ROWS_OF_PAGE: Final = 60
_MAX_DIMENSIONED: Final = 12
"""With more anchors on a page the distances stand in the table only."""
_NOT_PARALLEL: Final = 0.5  # sine of the least angle between two walls that fix a position
_DPI: Final = 110.0

Point = tuple[float, float, float]


class WallDistance(Struct, frozen=True):
    """How far an anchor is from a side of the room."""

    side: str
    """A for the side from the first corner of the outline to the second, B for the next, and so on."""
    distance_m: float


class Cable(Struct, frozen=True):
    """Length of the cable to an anchor, without what is needed to go round things and at its ends."""

    straight_m: float
    along_m: float
    """Along x, then y, then up: as in ducts."""


class Mount(Struct, frozen=True):
    """A row of the table."""

    anchor: AnchorSite
    walls: tuple[WallDistance, ...]
    """Two that are not parallel, the nearest first; none where the site has no outline."""
    cable: Cable | None


def mounts(site: Site, cables_from: Point | None = None) -> tuple[Mount, ...]:
    """The rows of all placed anchors, by floor and identifier."""
    outline_m = outline_of(site)
    ordered = sorted(site.anchors, key=lambda one: (one.floor, one.id))
    return tuple(
        Mount(
            anchor,
            () if outline_m is None else wall_distances(np.array([anchor.x_m, anchor.y_m]), outline_m),
            None if cables_from is None else _cable(anchor, cables_from),
        )
        for anchor in ordered
    )


def wall_distances(point_m: Vector, outline_m: Matrix) -> tuple[WallDistance, ...]:
    """Distances of a point, shape (2,), from the nearest side and from the nearest that is not parallel to it.

    Sides that a tape can be laid square to from the point come before others.
    """
    found = []
    for index, (x1, y1, x2, y2) in enumerate(sides(outline_m).tolist()):
        start, along = np.array([x1, y1]), np.array([x2 - x1, y2 - y1])
        length_m = float(np.linalg.norm(along))
        if length_m == 0.0:
            continue
        direction, to = along / length_m, point_m - start
        beside = not -0.01 <= float(to @ direction) <= length_m + 0.01
        found.append((beside, abs(float(direction[0] * to[1] - direction[1] * to[0])), index, direction))
    found.sort(key=lambda one: one[:3])
    _, first_m, first, towards = found[0]
    for _, distance_m, index, direction in found[1:]:
        if abs(float(towards[0] * direction[1] - towards[1] * direction[0])) > _NOT_PARALLEL:
            return WallDistance(_letter(first), first_m), WallDistance(_letter(index), distance_m)
    return (WallDistance(_letter(first), first_m),)


def _letter(index: int) -> str:
    return chr(ord("A") + index % 26) + (str(index // 26) if index >= 26 else "")


def _cable(anchor: AnchorSite, start_m: Point) -> Cable:
    steps_m = [abs(a - b) for a, b in zip((anchor.x_m, anchor.y_m, anchor.z_m), start_m, strict=True)]
    return Cable(math.hypot(*steps_m), sum(steps_m))


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
    name = file or Path("the site")
    if not site.anchors:
        raise ConfigurationError(name, "anchors", "a list without positions", "placed: skyless survey finds positions")
    floor = floor_of(site, name, None, None)
    out = io.BytesIO()
    with report_style():
        pages = list(_pages(site, file, floor, mounts(site, cables_from), cables_from, date))
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
    site: Site, file: Path | None, floor: Floor, rows: tuple[Mount, ...], cables_from: Point | None, date: str
) -> Iterator[Figure]:
    storeys = sorted({row.anchor.floor for row in rows})
    for storey in storeys:
        own = [row for row in rows if row.anchor.floor == storey]
        title = f"{site.name} (site {site.id})" + (f", floor {storey}" if len(storeys) > 1 else "")
        page, plan, table = _page(f"{title}: anchors to mount", _notes(site, rows, cables_from, date), has_plan=True)
        if file is not None:
            draw_image(plan, site, file)
        draw_outline_and_walls(plan, site, floor)
        _draw_plan(plan, site, own, cables_from)
        _fill(table, own[:_ROWS_BELOW_PLAN])
        yield page
        for first in range(_ROWS_BELOW_PLAN, len(own), _ROWS_OF_PAGE):
            page, _, table = _page(f"{title}: anchors, continued", date, has_plan=False)
            _fill(table, own[first : first + _ROWS_OF_PAGE])
            yield page


def _notes(site: Site, rows: tuple[Mount, ...], cables_from: Point | None, date: str) -> str:
    lines = [f"{date}  {len(rows)} anchors. x, y and height are of the antenna, in metres."]
    if outline_of(site) is None:
        lines.append("The site file has no outline_m: distances from walls are not given.")
    else:
        lines.append("Walls: distance square to the side of that letter.")
    cables = [row.cable for row in rows if row.cable is not None]
    if cables_from is not None:
        straight_m, along_m = sum(one.straight_m for one in cables), sum(one.along_m for one in cables)
        start = ", ".join(f"{value:g}" for value in cables_from)
        lines.append(
            f"Cables from ({start}): {straight_m:.1f} m straight, {along_m:.1f} m along the axes in all, "
            "without reserve and detours."
        )
    if site.unplaced:
        lines.append(f"Without a position yet: anchors {', '.join(str(one.id) for one in site.unplaced)}.")
    return "\n".join(lines)


def _page(title: str, notes: str, *, has_plan: bool) -> tuple[Figure, Axes, Axes]:
    page = Figure(figsize=_A4_IN, dpi=_DPI)
    page.text(0.07, 0.965, title, fontsize=13, fontweight="bold", va="top", color=INK)
    page.text(0.07, 0.94, notes, fontsize=8, va="top", color=INK, linespacing=1.4)
    plan = page.add_axes((0.1, 0.47, 0.83, 0.39)) if has_plan else page.add_axes((0.0, 0.0, 0.0, 0.0))
    table = page.add_axes((0.07, 0.03, 0.86, 0.39 if has_plan else 0.87))
    table.set_axis_off()
    return page, plan, table


def _draw_plan(plan: Axes, site: Site, rows: list[Mount], cables_from: Point | None) -> None:
    """Anchors with identifiers, the room's sides with letters and lengths, and few anchors' distances from walls."""
    plan.grid(visible=False)
    outline_m = outline_of(site)
    box_m = np.array([plan.get_xlim(), plan.get_ylim()])
    middle_x, middle_y = box_m.mean(axis=1).tolist()
    for index, (x1, y1, x2, y2) in enumerate([] if outline_m is None else sides(outline_m).tolist()):
        x, y, steep = (x1 + x2) / 2.0, (y1 + y2) / 2.0, abs(y2 - y1) > abs(x2 - x1)
        away = (math.copysign(8.0, x - middle_x), 0.0) if steep else (0.0, math.copysign(8.0, y - middle_y))
        label = f"{_letter(index)} {math.hypot(x2 - x1, y2 - y1):.2f} m"
        style: dict[str, Any] = {"ha": "center", "va": "center", "rotation": 90.0 if steep else 0.0}
        plan.annotate(label, (x, y), away, textcoords="offset points", fontsize=7.5, color=MUTED, **style)
    for row in rows:
        x, y = row.anchor.x_m, row.anchor.y_m
        plan.plot(x, y, "^", color=BLUE, markeredgecolor=INK, markersize=8, zorder=6, clip_on=False)
        walls = row.walls if len(rows) <= _MAX_DIMENSIONED else ()
        label = "\n".join([str(row.anchor.id), *(f"{one.side} {one.distance_m:.2f}" for one in walls)])
        inwards = (7.0 if x < middle_x else -7.0, 7.0 if y < middle_y else -7.0)
        style = {"ha": "left" if x < middle_x else "right", "va": "bottom" if y < middle_y else "top"}
        box = {"facecolor": "white", "alpha": 0.8, "pad": 0.8, "edgecolor": "none"}
        plan.annotate(label, (x, y), inwards, textcoords="offset points", fontsize=7.0, zorder=7, bbox=box, **style)
    if cables_from is not None:
        plan.plot(*cables_from[:2], "s", color=ORANGE, markeredgecolor=INK, markersize=8, zorder=6, label="cables from")
        plan.legend(loc="upper right")
    plan.set(aspect="equal", xlabel="x in m", ylabel="y in m")


def _fill(axes: Axes, rows: list[Mount]) -> None:
    """The table; its last two columns are for the person who mounts."""
    titles = [
        "anchor",
        "x / m",
        "y / m",
        "height / m",
        "floor",
        "walls / m",
        "delays tx, rx",
        "cable / m",
        "done",
        "measured",
    ]
    cells = []
    for row in rows:
        anchor, cable = row.anchor, row.cable
        cells.append([
            str(anchor.id), f"{anchor.x_m:.3f}", f"{anchor.y_m:.3f}", f"{anchor.z_m:.3f}", str(anchor.floor),
            ", ".join(f"{one.side} {one.distance_m:.2f}" for one in row.walls) or "–",
            f"{anchor.tx_antenna_delay_ticks}, {anchor.rx_antenna_delay_ticks}",
            "–" if cable is None else f"{cable.straight_m:.1f} / {cable.along_m:.1f}",
            "☐", "",
        ])  # fmt: skip
    widths = [0.07, 0.08, 0.08, 0.1, 0.06, 0.16, 0.13, 0.12, 0.06, 0.14]
    table = axes.table(cells, colLabels=titles, colWidths=widths, loc="upper center", cellLoc="center")
    table.auto_set_font_size(value=False)
    table.set_fontsize(7.0)
    box_in = axes.get_position().height * _A4_IN[1]
    for (row_number, _), cell in table.get_celld().items():
        cell.set_height(min(0.16 / box_in, 1.0 / (len(rows) + 1)))
        cell.set(linewidth=0.4, edgecolor=MUTED)
        if row_number == 0:
            cell.set_text_props(fontweight="bold")
