"""The report of a plan: everything that it found as one tree of plain values, warnings included."""

import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, Literal

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.image import imsave
from msgspec import Struct

from skyless.core.any_receiver import superframe_s
from skyless.core.arrays import Array, Mask
from skyless.core.errors import ConfigurationError
from skyless.core.fix import NoFixReason
from skyless.core.method_names import FILTERS
from skyless.core.native.records import MAX_ANCHORS
from skyless.core.protocol1.snapshots import literal_covariance
from skyless.core.site import AnchorSite, Site
from skyless.core.tag.position import NoSolution, locate
from skyless.site.file.check import warnings_of
from skyless.site.planning.anchor_clocks import master_warnings, stamp_variances
from skyless.site.planning.links import (
    BIAS,
    FIX_SHARE,
    IN_VIEW,
    SIGMA,
    Floor,
    Mounts,
    floor_of,
    range_of,
    sample_points,
)
from skyless.site.planning.maps import MapSummary, PlanMap
from skyless.site.planning.optimise import Optimised, Scored, one_more
from skyless.site.planning.picture import draw_image, draw_outline_and_walls
from skyless.site.planning.predict import Predictor, delays
from skyless.site.report import BLUE, INK, MUTED, ORANGE, report_style


class PointCheck(Struct, frozen=True):
    """One point: prediction and simulation, metres; None where either has no fix."""

    position_m: tuple[float, float, float]
    predicted_sigma_m: float | None
    simulated_sigma_m: float | None
    ratio: float | None
    """Simulated over predicted standard deviation; over RMSE where survey and ranges have errors."""
    ratio_error: float | None
    """Standard error of the ratio, from the scatter of the batches."""
    predicted_rmse_m: float | None
    simulated_rmse_m: float | None
    predicted_claim_m: float | None
    predicted_fix_share: float
    simulated_fix_share: float
    """Share of the rounds (snapshots) or messages (filters) after the warm-up."""
    fixes: int


class Verification(Struct, frozen=True):
    """All points, and how far the ratios lie from one."""

    method: str
    seed: int
    simulated_s: float
    points: tuple[PointCheck, ...]
    mean_ratio: float | None
    smallest_ratio: float | None
    largest_ratio: float | None
    mean_ratio_error: float | None


class AfterMetre(Struct, frozen=True):
    """What ``joint`` claims after a tag has walked a metre, metres; *stamps* without phases of the carrier."""

    walks: int
    """From places all over the floor, along x and along y; those that have fixes."""
    median_sigma_m: float
    worst_sigma_m: float
    stamps_median_sigma_m: float
    stamps_worst_sigma_m: float


def plan_report(
    predictor: Predictor,
    floor: Floor,
    mounts: Mounts,
    mapped: PlanMap,
    summary: MapSummary,
    optimised: Optimised | None,
    checked: Verification | None,
) -> dict[str, Any]:
    """The whole report, SI units."""
    site, settings = predictor.site, predictor.settings
    heights = tuple(mapped.grid.heights_m.tolist())
    more = one_more(site, settings, floor, mounts, heights) if len(site.anchors) < 200 else None
    return {
        "site": site.name,
        "method": settings.method,
        "tx_stamp_ps": site.noise.tx_stamp_ps,
        "rx_stamp_ps": site.noise.rx_stamp_ps,
        "qa": settings.qa,
        "range_m": range_of(settings.channel),
        "superframe_s": superframe_s(site),
        "master": site.master if site.schedule.needs_master else None,
        "dimensions": 3 if site.tags.height_m is None else 2,
        "heights_m": heights,
        "region_m": floor.region_m,
        "outline_m": floor.outline_m,
        "step_m": mapped.grid.step_m,
        "computed_every_m": mapped.computed_every_m,
        **msgspec.to_builtins(summary),
        "walls_bias": mapped.has_bias,
        "anchors": [
            {
                "id": anchor.id,
                "x_m": anchor.x_m,
                "y_m": anchor.y_m,
                "z_m": anchor.z_m,
                "hears_master": None if predictor.master is None else float(predictor.links.share[row]),
                "sends": bool(predictor.clocks.sends[row]),
            }
            for row, anchor in enumerate(site.anchors)
        ],
        "warnings": plan_warnings(predictor, floor, mapped),
        "after_metre": _after_metre(predictor, floor, heights),
        "one_more": more,
        "optimised": None if optimised is None else _optimised(optimised),
        "verification": checked,
    }


_WALKED_PLACES: Final = 6


def _after_metre(predictor: Predictor, floor: Floor, heights_m: tuple[float, ...]) -> AfterMetre | None:
    """What phases of the carrier give tags that walk; None where the site has none or nothing is estimated."""
    if predictor.site.schedule.carrier_phase is not True or predictor.settings.method not in FILTERS:
        return None
    points, _ = sample_points(floor, heights_m, _WALKED_PLACES)
    with_phases, stamps = (predictor.walked_sigma(points, has_phases=has_phases) for has_phases in (True, False))
    with_phases, stamps = with_phases[stamps < predictor.farthest_m], stamps[stamps < predictor.farthest_m]
    if len(stamps) == 0:
        return None
    figures = (float(figure(sigma_m)) for sigma_m in (with_phases, stamps) for figure in (np.median, np.max))
    return AfterMetre(len(stamps), *figures)


def _optimised(found: Optimised) -> dict[str, Any]:
    return {
        "best": _scored(found.best),
        "even": _scored(found.even),
        "mean_ratio": found.best.mean_sigma_m / found.even.mean_sigma_m,
        "worst_ratio": found.best.worst_sigma_m / found.even.worst_sigma_m,
        "target_met": found.target_met,
        "evaluations": found.evaluations,
        "finished": found.finished,
    }


def _scored(scored: Scored) -> dict[str, Any]:
    return {
        "mean_sigma_m": scored.mean_sigma_m,
        "worst_sigma_m": scored.worst_sigma_m,
        "covered_share": scored.covered_share,
        "master": scored.site.master if scored.site.schedule.needs_master else None,
        "anchors": [(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in scored.site.anchors],
    }


def described(result: dict[str, Any]) -> str:
    """Method, noise and schedule in one line."""
    tx_ps, rx_ps = result["tx_stamp_ps"], result["rx_stamp_ps"]
    noise = f"{tx_ps:g} ps" if tx_ps == rx_ps else f"{tx_ps:g} ps (TX) and {rx_ps:g} ps (RX)"
    process_noise = f" with qa {result['qa']:g} m²/s³" if result["method"] == "joint" else ""
    return (
        f"predicted for {result['method']}{process_noise}, stamps of {noise}, "
        f"{'periods' if result['master'] is None else 'superframes'} of {1e3 * result['superframe_s']:.1f} ms, "
        "tags at rest"
    )


_WEAK_RATIO: Final = 2.0  # a position is weak where the error exceeds this multiple of the median
_MIRROR_POINTS: Final = 150


def plan_warnings(predictor: Predictor, floor: Floor, plan: PlanMap) -> list[str]:
    """All that may cost accuracy or the fix, from the site alone and from its map."""
    return [
        *warnings_of(predictor.site),
        *master_warnings(predictor.site, predictor.settings.channel),
        *_order(predictor),
        *_mirrors(predictor, floor, plan),
        *_holes(plan),
        *_weak(plan),
        *_walls(predictor, plan),
    ]


def _order(predictor: Predictor) -> list[str]:
    if predictor.settings.method in FILTERS:
        return []
    kappa, _ = delays(predictor.site)
    early = [anchor.id for anchor, delay in zip(predictor.site.anchors, kappa, strict=True) if delay < 0.0]
    if not early:
        return []
    numbers = ", ".join(map(str, early))
    return [f"anchor {numbers}: sends before the master in a round, and {predictor.settings.method} cannot use it"]


def _mirrors(predictor: Predictor, floor: Floor, plan: PlanMap) -> list[str]:
    """Ask the solver itself, with TDoAs that are exact, whether a position has a mirror image that fits as well."""
    points, _ = sample_points(floor, tuple(plan.grid.heights_m.tolist()), _MIRROR_POINTS)
    tx_var, rx_var = stamp_variances(predictor.site)
    height = predictor.site.tags.height_m
    share, _ = predictor.scene.heard_at(points)
    ambiguous = [
        point
        for point, seen in zip(points, share >= IN_VIEW, strict=True)
        if _has_mirror(predictor.anchors_m[seen], point, height, tx_var, rx_var)
    ]
    if not ambiguous:
        return []
    x, y, z = ambiguous[len(ambiguous) // 2]
    return [
        f"{len(ambiguous) / len(points):.0%} of the region has a mirror image that explains the measurements as well, "
        f"for one around ({x:.1f}, {y:.1f}, {z:.1f}): vary the anchors' heights, or set tags.height_m if it is known"
    ]


def _has_mirror(anchors: Array, point: Array, height_m: float | None, tx_var: float, rx_var: float) -> bool:
    """Whether the anchors in view, shape (n, 3), or the nearest of many, leave two positions."""
    nearest = np.argsort(np.linalg.norm(anchors - point, axis=1))[:MAX_ANCHORS]
    anchors = anchors[np.sort(nearest)]
    if len(anchors) < (4 if height_m is None else 3):
        return False
    ranges = np.linalg.norm(anchors - point, axis=1)
    covariance = literal_covariance(np.full(len(anchors) - 1, 0.5), tx_var, rx_var)
    solution = locate(anchors, ranges[1:] - ranges[0], covariance, height_m=height_m)
    return isinstance(solution, NoSolution) and solution.reason is NoFixReason.MIRROR


def _holes(plan: PlanMap) -> list[str]:
    share = np.where(plan.grid.within, plan.column(FIX_SHARE), np.nan)
    missing = share < 0.5
    if not missing.any():
        return []
    part = missing.sum() / (plan.grid.points)
    x, y, z = _central(plan, missing)
    return [f"{part:.1%} of the region has no fix most of the time, as around ({x:.1f}, {y:.1f}, {z:.1f})"]


def _weak(plan: PlanMap) -> list[str]:
    sigma = np.where(plan.column(FIX_SHARE) >= 0.5, plan.column(SIGMA), np.nan)
    if not np.isfinite(sigma).any():
        return []
    median, worst = float(np.nanmedian(sigma)), float(np.nanmax(sigma))
    if worst < _WEAK_RATIO * median:
        return []
    part = float(np.nansum(sigma > _WEAK_RATIO * median)) / plan.grid.points
    x, y, z = _central(plan, sigma == worst)
    return [
        f"weak corner at ({x:.1f}, {y:.1f}, {z:.1f}): {100 * worst:.1f} cm, {worst / median:.1f} times the median; "
        f"{part:.1%} of the region is worse than {_WEAK_RATIO:g} times the median"
    ]


def _walls(predictor: Predictor, plan: PlanMap) -> list[str]:
    bias, sigma = plan.column(BIAS), plan.column(SIGMA)
    known = np.isfinite(bias) & np.isfinite(sigma)
    worse = known & (bias > sigma)
    if not worse.any():
        return []
    largest = float(bias[known].max())
    # its monitors are not in the prediction (docs/planning.md)
    monitors = "; joint may take delays for faults of anchors there, and err more than predicted"
    return [
        f"walls' delays shift positions by more than their standard deviation in {worse.sum() / known.sum():.0%} of "
        f"the region, by {100 * largest:.0f} cm at most{monitors if predictor.settings.method == 'joint' else ''}"
    ]


def _central(plan: PlanMap, where: Mask) -> tuple[float, float, float]:
    k, y, x = np.nonzero(where)
    points = np.column_stack([plan.grid.x_m[x], plan.grid.y_m[y], plan.grid.heights_m[k]])
    nearest = points[np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1))]
    return float(nearest[0]), float(nearest[1]), float(nearest[2])


# The installer's sheet: for each floor a page with a plan of the anchors and a table of what to measure and mount.

_A4_IN: Final = (8.27, 11.69)
_ROWS_BELOW_PLAN: Final = 26
_ROWS_OF_PAGE: Final = 60
_DPI: Final = 110.0
_COLUMNS: Final = {
    "anchor": 0.1, "x / m": 0.13, "y / m": 0.13, "height / m": 0.13, "cable / m": 0.2, "done": 0.08, "measured": 0.23,
}  # fmt: skip
"""Titles of the table and the columns' widths. The last two are for the person who mounts."""

Point = tuple[float, float, float]


class Mount(Struct, frozen=True):
    """A row of the table."""

    anchor: AnchorSite
    cable_m: tuple[float, float] | None
    """Length of its cable, straight and along x, then y, then up, without what is needed to go round things."""


def mounts(site: Site, cables_from: Point | None = None) -> tuple[Mount, ...]:
    """The rows of all placed anchors, by floor and identifier."""
    ordered = sorted(site.anchors, key=lambda one: (one.floor, one.id))
    return tuple(Mount(one, None if cables_from is None else _cable_m(one, cables_from)) for one in ordered)


def _cable_m(anchor: AnchorSite, start: Point) -> tuple[float, float]:
    steps_m = [abs(to - of) for to, of in zip((anchor.x_m, anchor.y_m, anchor.z_m), start, strict=True)]
    return math.hypot(*steps_m), sum(steps_m)


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
