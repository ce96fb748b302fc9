"""The installer's sheet: for each floor a page with a plan of the anchors and a table for mounting and measuring."""

import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Final, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.image import imsave
from msgspec import Struct

from skyless.core.errors import ConfigurationError
from skyless.core.site import AnchorSite, Site
from skyless.site.planning.links import floor_of
from skyless.site.planning.picture import draw_image, draw_outline_and_walls
from skyless.site.report import BLUE, INK, MUTED, ORANGE, report_style

_A4_IN: Final = (8.27, 11.69)
_ROWS_BELOW_PLAN: Final = 26
_ROWS_OF_PAGE: Final = 60
_DPI: Final = 110.0
_COLUMNS: Final = {
    "anchor": 0.1, "x / m": 0.13, "y / m": 0.13, "height / m": 0.13, "cable / m": 0.2, "done": 0.08, "measured": 0.23,
}  # fmt: skip
"""Titles and widths of the table's columns. The installer fills in the last two."""

Point = tuple[float, float, float]


class Mount(Struct, frozen=True):
    """A row of the table."""

    anchor: AnchorSite
    cable_m: tuple[float, float] | None
    """Length of the anchor's cable, straight and along the axes, without detours."""


def mounts(site: Site, cables_from: Point | None = None) -> tuple[Mount, ...]:
    """Rows of all placed anchors, by floor and identifier."""
    ordered = sorted(site.anchors, key=lambda one: (one.floor, one.id))
    return tuple(Mount(one, None if cables_from is None else _cable_m(one, cables_from)) for one in ordered)


def _cable_m(anchor: AnchorSite, start: Point) -> tuple[float, float]:
    steps_m = [abs(to - of) for to, of in zip((anchor.x_m, anchor.y_m, anchor.z_m), start, strict=True)]
    return math.hypot(*steps_m), sum(steps_m)


def sheet(
    site: Site, file: Path | None, kind: Literal["pdf", "png"], date: str, cables_from: Point | None = None
) -> bytes:
    """The sheet as a file: one or more A4 pages per floor; in a PNG one below the other.

    ``file``: the site's file, to which the floor plan's image is relative; without it the image is left out.

    Raises ConfigurationError: no anchor has a position, or the anchors outline no floor.
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
    lines = [f"{date}  {len(rows)} anchors. x, y and height are of the antenna, in metres."]
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
    if file is not None:
        draw_image(plan, site, file)
    draw_outline_and_walls(plan, site, floor_of(site, file or Path("the site"), None, None))
    middle_x, middle_y = sum(plan.get_xlim()) / 2.0, sum(plan.get_ylim()) / 2.0
    for row in rows:
        x, y = row.anchor.x_m, row.anchor.y_m
        plan.plot(x, y, "^", color=BLUE, markeredgecolor=INK, markersize=8, zorder=6, clip_on=False)
        inwards = (math.copysign(9.0, middle_x - x), math.copysign(9.0, middle_y - y))
        plan.annotate(str(row.anchor.id), (x, y), inwards, textcoords="offset points", fontsize=8.0, zorder=7,
                      ha="center", va="center")  # fmt: skip
    if cables_from is not None:
        plan.plot(*cables_from[:2], "s", color=ORANGE, markeredgecolor=INK, markersize=8, zorder=6, label="cables from")
        plan.legend(loc="upper right")
    plan.set(aspect="equal", xlabel="x in m", ylabel="y in m")


def _fill(axes: Axes, rows: list[Mount]) -> None:
    axes.set_axis_off()
    cells = []
    for row in rows:
        at = row.anchor
        cable = "–" if row.cable_m is None else "{:.1f} / {:.1f}".format(*row.cable_m)
        cells.append([str(at.id), f"{at.x_m:.3f}", f"{at.y_m:.3f}", f"{at.z_m:.3f}", cable, "☐", ""])
    titles, widths = list(_COLUMNS), list(_COLUMNS.values())
    table = axes.table(cells, colLabels=titles, colWidths=widths, loc="upper center", cellLoc="center")
    table.auto_set_font_size(value=False)
    table.set_fontsize(7.0)
    box_in = axes.get_position().height * _A4_IN[1]
    for cell in table.get_celld().values():
        cell.set(height=min(0.16 / box_in, 1.0 / (len(rows) + 1)), linewidth=0.4, edgecolor=MUTED)
