"""``skyless.plan``: predict a site's errors before anything is mounted, and optimise its anchors' positions."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar, cast

import numpy as np
from msgspec.structs import replace

from skyless.arguments import check_choice, check_whole, python_function
from skyless.cli.api.fixes import Result, data_frame
from skyless.cli.api.options import PlanOptions
from skyless.cli.common import cm
from skyless.core.arrays import Array, Vector
from skyless.core.errors import SkylessError
from skyless.core.site import Site
from skyless.research.verify import random_points, verify
from skyless.site.channel import ChannelModel
from skyless.site.file.advice import anchors_needed
from skyless.site.file.load import site_of
from skyless.site.planning.links import (
    ANCHORS_IN_VIEW,
    PLAN_COLUMNS,
    RMSE,
    SIGMA,
    Floor,
    check_anchor_count,
    floor_of,
    mounts_of,
    usual_tag_heights,
    with_range,
)
from skyless.site.planning.maps import (
    MAX_PREDICTED,
    PlanMap,
    Predictor,
    grid_of,
    plan_map,
    rows_of,
    summary_of,
)
from skyless.site.planning.optimise import OneMore, Optimised, Search
from skyless.site.planning.rates import RateMap, described_rates, rate_map, rate_report
from skyless.site.planning.report import Verification, described, plan_report

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from skyless.core.geometry import Box

FloorMap = TypeVar("FloorMap", PlanMap, RateMap)


class FloorResult(Result, Generic[FloorMap], frozen=True, eq=False):
    """A map over the floor of a site."""

    site: Site
    """The site as planned, with optimised anchors if requested."""
    file: Path
    floor: Floor
    """Outline and region."""
    map: FloorMap
    """The full table of values."""
    summary: dict[str, Any]
    """The object that ``skyless plan --json`` writes, in SI units, without the version."""

    @property
    def x_m(self) -> Vector:
        """Shape (nx,): centres of the map's cells."""
        return self.map.grid.x_m

    @property
    def y_m(self) -> Vector:
        """Shape (ny,)."""
        return self.map.grid.y_m

    @property
    def heights_m(self) -> Vector:
        """Shape (heights,): heights of the tags."""
        return self.map.grid.heights_m


class RatePlanResult(FloorResult[RateMap], frozen=True, eq=False):
    """Plan of a site without a master: the beacons that reach tags over its floor."""

    @property
    def beacons_per_s(self) -> Array:
        """Shape (heights, ny, nx): beacons per second at one point of each cell; NaN outside the outline."""
        return self.map.beacons_per_s

    def to_dataframe(self) -> "DataFrame":
        """One row per cell and height: ``x_m``, ``y_m``, ``z_m``, ``beacons_per_s``.

        Raises:
            SkylessError: pandas is not installed.
        """
        z_m, y_m, x_m = np.meshgrid(self.heights_m, self.y_m, self.x_m, indexing="ij")
        within = np.isfinite(self.beacons_per_s)
        columns = {"x_m": x_m, "y_m": y_m, "z_m": z_m, "beacons_per_s": self.beacons_per_s}
        return data_frame({name: values[within] for name, values in columns.items()})

    def plot(self) -> "Figure":
        """Draw the beacons per second with the anchors."""
        from skyless.site.planning.picture import draw_rates

        return draw_rates(self.site, self.floor, self.map, self.file, described_rates(self.summary))

    def title(self) -> str:
        """Title of the plan."""
        return f"plan of {self.site.name}, {described_rates(self.summary)}"

    def facts(self) -> Iterator[tuple[str, str]]:
        """The main figures: name, and value with its unit."""
        found, summary = self.map.reception, self.summary
        yield "anchors", f"{len(self.site.all_anchors)}"
        yield "range in the open", f"{summary['range_m']:.0f} m (path loss exponent {summary['exponent']:g})"
        yield "each anchor sends", f"{summary['beacons_per_s_of_each_anchor']:.1f} beacons/s"
        yield "median beacons/s at a tag", f"{found.beacons_per_s.median:.0f}"
        yield "beacons/s at the worst 5 %", f"{found.beacons_per_s.worst_5_percent:.0f}"
        yield "anchors received at the worst 5 %", f"{found.anchors_received.worst_5_percent:.0f}"
        for warning in self.summary["warnings"]:
            yield "warning", warning


def _plan_rates(asked: PlanOptions, site: Site, file: Path) -> RatePlanResult:
    """Plan a site of protocol 2. Raises SkylessError."""
    started_s, exponent = time.perf_counter(), asked.exponent or 2.0
    heights_m, floor = _heights_m(asked, site), _floor(asked, site, file)
    channel = ChannelModel() if asked.range_m is None else with_range(ChannelModel(), asked.range_m, exponent)
    try:
        mapped = rate_map(site, floor, heights_m, asked.step_m, channel, exponent)
    except ValueError as error:
        raise SkylessError(f"no map: {error}") from None
    found = rate_report(site, floor, mapped, channel, exponent)
    found["wall_s"] = time.perf_counter() - started_s
    return RatePlanResult(site, file, floor, mapped, found)


_WALKING: Final = (
    "become more accurate in seconds to minutes: while a tag moves, joint tells errors of survey and ranges from its "
    "position, and at rest it cannot; skyless simulate shows it"
)


class PlanResult(FloorResult[PlanMap], frozen=True, eq=False):
    """Predicted errors over the floor of a site; ``map.table`` has all columns."""

    @property
    def sigma_m(self) -> Array:
        """Shape (heights, ny, nx): predicted standard deviation; infinite without a fix, NaN outside the outline."""
        return self.map.column(SIGMA)

    @property
    def rmse_m(self) -> Array:
        """Shape (heights, ny, nx): predicted RMSE, including the walls' delays."""
        return self.map.column(RMSE)

    @property
    def anchors_in_view(self) -> Array:
        """Shape (heights, ny, nx): number of anchors in view."""
        return self.map.column(ANCHORS_IN_VIEW)

    def column(self, name: str) -> Array:
        """Shape (heights, ny, nx): one of ``skyless.site.planning.links.PLAN_COLUMNS``. Raises SkylessError."""
        check_choice("name", name, PLAN_COLUMNS)
        return self.map.column(PLAN_COLUMNS.index(name))

    def to_dataframe(self) -> "DataFrame":
        """One row per point inside the outline: ``x_m``, ``y_m``, ``z_m`` and all of ``PLAN_COLUMNS``.

        Raises:
            SkylessError: pandas is not installed.
        """
        rows = rows_of(self.map)
        columns = {name: rows[:, number] for number, name in enumerate(("x_m", "y_m", "z_m", *PLAN_COLUMNS))}
        columns["anchors"] = columns["anchors"].astype(np.int64)
        return data_frame(columns)

    def plot(self, column: str | None = None) -> "Figure":
        """Draw the map of a column, by default of the predicted error, with a panel for each height.

        ``column``: ``sigma_m``, ``rmse_m``, ``anchors``, ``hdop``, ``vdop``, ``pdop`` or ``fix_share``, if it is worth
        drawing.

        Raises:
            SkylessError: there is no map of this column.
        """
        from skyless.site.planning.picture import Background, draw_layer, layers_for, main_layer

        layers = {PLAN_COLUMNS[layer.column]: layer for layer in layers_for(self.map)}
        if column is not None:
            check_choice("column", column, tuple(layers))
        layer = main_layer(self.map) if column is None else layers[column]
        return draw_layer(self.map, layer, Background(self.site, self.floor, self.file, described(self.summary)))

    def title(self) -> str:
        """Title of the plan."""
        return f"plan of {self.site.name}, {described(self.summary)}"

    def facts(self) -> Iterator[tuple[str, str]]:
        """The main figures: name, and value with its unit."""
        found = self.summary
        worst_at, dimensions = found["worst_at_m"], f"{found['dimensions']}-D"
        where = "" if worst_at is None else " at ({:.2f}, {:.2f}, {:.2f}) m".format(*worst_at)
        master = "no master" if found["master"] is None else f"master {found['master']}"
        yield "anchors", f"{len(found['anchors'])}, {master}, range {found['range_m']:.0f} m in the open"
        line = f"{found['points']} points, {found['step_m']:g} m apart"
        if found["computed_every_m"] > found["step_m"]:
            line += f"; {found['method']} computed every {found['computed_every_m']:g} m and interpolated by the PDOP"
        yield "map", line
        yield (
            "covered",
            f"{found['covered_share']:.1%} of the region; fewest anchors in view: {found['fewest_anchors']}",
        )
        yield (
            f"standard deviation {dimensions}",
            f"mean {cm(found['mean_sigma_m'])}, median {cm(found['median_sigma_m'])}, "
            f"95 % {cm(found['p95_sigma_m'])}, worst {cm(found['worst_sigma_m'])}{where}",
        )
        if not self.site.accuracy.is_exact:
            yield "tags that walk", _WALKING
        if found["walls_bias"]:
            rmse = f"RMSE mean {cm(found['mean_rmse_m'])}, worst {cm(found['worst_rmse_m'])}"
            yield "with the walls' delays", rmse
        if (after := found["after_metre"]) is not None:
            yield (
                "after 1 m of walking",
                f"median {cm(after.median_sigma_m)}, worst {cm(after.worst_sigma_m)} with phases of the carrier; by "
                f"stamps alone {cm(after.stamps_median_sigma_m)} and {cm(after.stamps_worst_sigma_m)} "
                f"({after.walks} walks)",
            )
        if found["target_share"] is not None:
            yield "target met", f"in {found['target_share']:.1%} of the region"
        if found["one_more"] is not None:
            yield "one more anchor", _one_more(found["one_more"])
        if found["optimised"] is not None:
            yield "optimised", _against_even(found["optimised"])
        if found["verification"] is not None:
            yield "simulated", _verified(found["verification"])


def _one_more(more: OneMore) -> str:
    x, y, z = more.position_m
    mean = _change(more.mean_before_m, more.mean_after_m)
    worst = _change(more.worst_before_m, more.worst_after_m)
    if not more.helps:
        return f"none helps noticeably; with the best one mean {mean}, worst {worst}"
    return f"helps most at ({x:.2f}, {y:.2f}, {z:.2f}) m: mean {mean}, worst {worst}"


def _change(before_m: float, after_m: float) -> str:
    """A relative change; absolute values would differ from the facts' mean and worst, which are of other points."""
    return f"{after_m / before_m - 1.0:+.0%}"


def _against_even(found: dict[str, Any]) -> str:
    best, even = found["best"], found["even"]
    mean, worst = (_change(even[name], best[name]) for name in ("mean_sigma_m", "worst_sigma_m"))
    text = f"mean {mean}, worst {worst} against as many anchors evenly along the walls"
    if found["target_met"] is not None:
        text += "; the target is met everywhere" if found["target_met"] else "; the target is not met everywhere"
    return text if found["finished"] else text + "; the search was ended before it was complete"


def _verified(checked: Verification) -> str:
    if checked.mean_ratio is None or checked.smallest_ratio is None or checked.largest_ratio is None:
        return "no point with a fix in both"
    return (
        f"simulated over predicted at {len(checked.points)} points: mean {checked.mean_ratio:.3f}, from "
        f"{checked.smallest_ratio:.3f} to {checked.largest_ratio:.3f}; each ± {checked.mean_ratio_error:.3f}"
    )


def run_plan(asked: PlanOptions) -> PlanResult | RatePlanResult:
    """Predict the errors that tags at rest will have at a site, as ``skyless plan`` does.

    With ``optimise`` the anchors are placed from the start, and the plan is of that site. For a site of more than 60
    anchors without a master the plan is of the beacons that reach tags (``RatePlanResult``). It then uses only
    ``range_m``, ``step_m``, ``tag_heights_m``, ``region_m``, ``outline_m`` and ``exponent`` of the arguments below.
    """
    started_s = time.perf_counter()
    site, file = site_of(asked.site)
    if not site.schedule.needs_master and len(site.anchors) > MAX_PREDICTED:
        asked.leave_out(
            *("noise_ps", "target_m", "optimise", "anchor_heights_m", "mounts_m"),
            *("search_s", "verify_points", "verify_rounds", "seed"),
            why=f"errors are predicted for sites of at most {MAX_PREDICTED} anchors; this one has {len(site.anchors)}",
        )
        rates = _plan_rates(asked, site, file)
        asked.progress(1.0)
        return rates
    asked.leave_out("exponent", why=f"it is for sites of more than {MAX_PREDICTED} anchors")
    channel = ChannelModel() if asked.range_m is None else with_range(ChannelModel(), asked.range_m)
    if asked.noise_ps is not None:
        site = replace(site, noise=replace(site.noise, tx_stamp_ps=asked.noise_ps, rx_stamp_ps=asked.noise_ps))
    if asked.optimise is None:
        check_anchor_count(site, file)
    else:
        check_whole("--optimise", asked.optimise, least=anchors_needed(site)[0], most=60)
    floor, heights_m = _floor(asked, site, file), _heights_m(asked, site)
    walls_m = None if asked.mounts_m is None else np.array(asked.mounts_m)
    mounts = mounts_of(site, floor, walls_m, None if asked.anchor_heights_m is None else tuple(asked.anchor_heights_m))
    optimised: Optimised | None = None
    if asked.optimise is not None:
        search = Search(site, channel, floor, mounts, heights_m, asked.optimise, asked.seed, asked.search_s)
        optimised = search.run(asked.target_m, asked.progress)
        site = optimised.best.site
    predictor = Predictor(site, channel)
    try:
        grid = grid_of(floor, heights_m, asked.step_m)
    except ValueError as error:
        raise SkylessError(f"no map: {error}") from None
    mapped = plan_map(predictor, grid, asked.progress)
    checked: Verification | None = None
    if asked.verify_points is not None:
        points_m = random_points(mapped, asked.verify_points, asked.seed)
        checked = verify(predictor, points_m, asked.verify_rounds, asked.seed, asked.progress)
    asked.progress(1.0)
    found = plan_report(predictor, floor, mounts, mapped, summary_of(mapped, asked.target_m), optimised, checked)
    return PlanResult(predictor.site, file, floor, mapped, {**found, "wall_s": time.perf_counter() - started_s})


def _heights_m(asked: PlanOptions, site: Site) -> tuple[float, ...]:
    """Heights of the tags. Raises SkylessError if they are given although the site states its tags' height."""
    if asked.tag_heights_m is None:
        return usual_tag_heights(site) if site.anchors else (0.0,)
    if site.tags.height_m is not None:
        asked.leave_out("tag_heights_m", why=f"this site's tags are all at {site.tags.height_m:g} m")
    return tuple(asked.tag_heights_m)


def _floor(asked: PlanOptions, site: Site, file: Path) -> Floor:
    """The floor from the given outline and region of interest. Raises ConfigurationError."""
    outline_m = None if asked.outline_m is None else np.array(asked.outline_m)
    return floor_of(site, file, outline_m, cast("Box | None", asked.region_m))


plan = python_function(PlanOptions, run_plan)
