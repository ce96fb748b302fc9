"""``skyless.plan``: what a site will give before anything is mounted, and where its anchors should hang."""

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from skyless.api.floor_result import FloorResult
from skyless.api.inputs import AnySite, Progress, silent, site_of
from skyless.api.result import cm, data_frame
from skyless.api.slot_plan import SlotPlanResult, plan_slots
from skyless.arguments import (
    check_choice,
    check_number,
    check_point,
    check_whole,
    named_as_arguments,
    process_noise,
    sequence,
    wrong,
)
from skyless.errors import SkylessError
from skyless.evaluation.scenarios import NOISIEST_PS
from skyless.kernels.arrays import Array, Matrix
from skyless.method_names import DEFAULT_METHOD, METHODS
from skyless.planning.columns import ANCHORS_IN_VIEW, PLAN_COLUMNS, RMSE, SIGMA
from skyless.planning.floor import (
    check_anchor_count,
    fewest_anchors,
    floor_of,
    mounts_of,
    usual_tag_heights,
)
from skyless.planning.links import with_range
from skyless.planning.maps import PlanMap, grid_of, plan_map, rows_of, summary_of
from skyless.planning.optimise import Optimised, Search
from skyless.planning.predict import PlanSettings, Predictor
from skyless.planning.report import described, plan_report
from skyless.planning.verify import Verification, random_points, verify
from skyless.simulation.channel import ChannelModel
from skyless.site.model import Site
from skyless.site.outline import Box

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

_ARGUMENTS = {"range": "range_m", "step": "step_m", "outline": "outline_m"}


class PlanResult(FloorResult[PlanMap], frozen=True, eq=False):
    """Predicted errors over the floor of a site with one master; ``map.table`` has all columns."""

    @property
    def sigma_m(self) -> Array:
        """Shape (heights, ny, nx): predicted standard deviation; infinite without a fix, NaN outside the outline."""
        return self.map.column(SIGMA)

    @property
    def rmse_m(self) -> Array:
        """Shape (heights, ny, nx): the same with the delays of walls."""
        return self.map.column(RMSE)

    @property
    def anchors_in_view(self) -> Array:
        """Shape (heights, ny, nx): number of anchors."""
        return self.map.column(ANCHORS_IN_VIEW)

    def column(self, name: str) -> Array:
        """Shape (heights, ny, nx): one of ``skyless.planning.columns.PLAN_COLUMNS``. Raises SkylessError."""
        check_choice("name", name, PLAN_COLUMNS)
        return self.map.column(PLAN_COLUMNS.index(name))

    def to_dataframe(self) -> "DataFrame":
        """One row a point inside the outline: ``x_m``, ``y_m``, ``z_m`` and all of ``PLAN_COLUMNS``.

        Raises:
            SkylessError: pandas is not installed.
        """
        rows = rows_of(self.map)
        columns = {name: rows[:, number] for number, name in enumerate(("x_m", "y_m", "z_m", *PLAN_COLUMNS))}
        columns["anchors"] = columns["anchors"].astype(np.int64)
        return data_frame(columns)

    def plot(self, column: str | None = None) -> "Figure":
        """The map of a column, by default of the predicted error, a slice for each height.

        ``column``: ``sigma_m``, ``rmse_m``, ``anchors``, ``hdop``, ``vdop``, ``pdop`` or ``fix_share``, where it is
        worth drawing.

        Raises:
            SkylessError: there is no map of that.
        """
        # Matplotlib is loaded where it draws.
        from skyless.planning.picture import Background, draw_layer, layers_for, main_layer  # noqa: PLC0415

        layers = {PLAN_COLUMNS[layer.column]: layer for layer in layers_for(self.map)}
        if column is not None:
            check_choice("column", column, tuple(layers))
        layer = main_layer(self.map) if column is None else layers[column]
        return draw_layer(self.map, layer, Background(self.site, self.floor, self.file, described(self.summary)))

    def _title(self) -> str:
        return f"plan of {self.site.name}, {described(self.summary)}"

    def _facts(self) -> Iterator[tuple[str, str]]:
        found = self.summary
        yield "anchors", f"{len(found['anchors'])}, master {found['master']}"
        yield "points", f"{found['points']}, {found['step_m']:g} m apart"
        yield "covered", f"{found['covered_share']:.1%} of the region"
        yield "fewest anchors in view", f"{found['fewest_anchors']}"
        dimensions = f"{found['dimensions']}-D"
        yield f"mean σ {dimensions}", cm(found["mean_sigma_m"])
        yield f"95 % σ {dimensions}", cm(found["p95_sigma_m"])
        yield f"worst σ {dimensions}", cm(found["worst_sigma_m"])
        if found["walls_bias"]:
            yield "mean RMSE with the walls' delays", cm(found["mean_rmse_m"])
        if found["target_share"] is not None:
            yield "target met", f"in {found['target_share']:.1%} of the region"
        if found["verification"] is not None and found["verification"].mean_ratio is not None:
            yield "simulated over predicted", f"{found['verification'].mean_ratio:.3f}"
        for warning in found["warnings"]:
            yield "warning", warning


def plan(
    site: AnySite,
    *,
    method: str = DEFAULT_METHOD,
    noise_ps: float | None = None,
    qa: float | None = None,
    dynamics: str | None = None,
    range_m: float | None = None,
    step_m: float | None = None,
    tag_heights_m: Sequence[float] | None = None,
    region_m: Sequence[float] | None = None,
    outline_m: Sequence[Sequence[float]] | None = None,
    target_m: float | None = None,
    optimise: int | None = None,
    anchor_heights_m: Sequence[float] | None = None,
    mounts_m: Sequence[Sequence[float]] | None = None,
    search_s: float = 60.0,
    verify_points: int | None = None,
    verify_rounds: int = 3000,
    seed: int = 1,
    exponent: float | None = None,
    progress: Progress | None = None,
) -> PlanResult | SlotPlanResult:
    """Predict the errors that tags at rest will have at a site, as ``skyless plan`` does.

    With ``optimise`` the anchors are placed from the start, and the plan is of that site. At a site in mode slots or
    free the plan is of the slots that anchors share, and of the beacons that reach tags: a ``SlotPlanResult``; of the
    arguments below it takes ``range_m``, ``step_m``, ``tag_heights_m``, ``region_m``, ``outline_m``, ``exponent``.

    Args:
        site: A site, or the path of its file.
        method: One of ``skyless.METHODS``.
        noise_ps: Noise of every TX and RX stamp; by default the site's own figures.
        qa: Process noise that ``joint`` assumes, spectral density of the acceleration in m²/s³; 0.3 by default.
        dynamics: How tags move: ``walk`` (as people), ``robot`` or ``drone``, which sets the process noise instead.
        range_m: How far a frame carries in the open: half arrive there; by default what the link budget gives.
        step_m: Spacing of the map's points; by default some ten thousand points.
        tag_heights_m: Heights of the tags, for sites that estimate the height (3-D); by default three.
        region_m: Region of interest, x1, y1, x2, y2; by default the whole floor.
        outline_m: Corners of the floor, shape (k, 2); by default the site's outline, the floor plan, or the
            box of the anchors.
        target_m: Standard deviation to be met.
        optimise: Replace the anchors by this many, placed on the walls where they serve best.
        anchor_heights_m: Heights at which anchors may hang; by default the lowest and highest of the site's.
        mounts_m: Walls on which they may hang, shape (k, 4), x1, y1, x2, y2 each; by default the outline.
        search_s: Time after which the search for positions ends in any case.
        verify_points: Let tags rest at this many random points in the simulated world, and compare.
        verify_rounds: Superframes that the comparison lasts.
        seed: Same seed, same random points and search.
        exponent: Modes slots and free: exponent of the path loss; 2 by default (free space).
        progress: Called now and then with the share done of the step at work: search, map, comparison.

    Raises:
        SkylessError: one line that names the argument, its value and what it should be.
    """
    started_s = time.perf_counter()
    report_progress = progress or silent
    known, file = site_of(site, slots_given=False)
    check_number("range_m", range_m, above=0.0)
    check_number("step_m", step_m, above=0.0)
    heights_m = _tag_heights(tag_heights_m, known)
    outline, region = _outline(outline_m), _region(region_m)
    if not known.schedule.needs_master:
        of_masters = {
            "method": method, "noise_ps": noise_ps, "qa": qa, "dynamics": dynamics, "target_m": target_m,
            "optimise": optimise,
            "anchor_heights_m": anchor_heights_m, "mounts_m": mounts_m, "search_s": search_s,
            "verify_points": verify_points, "verify_rounds": verify_rounds, "seed": seed,
        }  # fmt: skip
        _refuse(of_masters, f"in mode {known.schedule.mode}: errors are predicted for sites with one master only")
        check_number("exponent", exponent, least=1.5, most=6.0)
        with named_as_arguments(_ARGUMENTS):
            slot_plan = plan_slots(known, file, outline, region, heights_m, step_m, range_m, exponent or 2.0)
        report_progress(1.0)
        return slot_plan
    _refuse({"exponent": exponent}, "in mode master, whose anchors share no slots")
    check_choice("method", method, METHODS)
    check_number("noise_ps", noise_ps, above=0.0, most=NOISIEST_PS)
    check_number("qa", qa, above=0.0)
    check_number("target_m", target_m, above=0.0)
    check_number("search_s", search_s, above=0.0)
    check_whole("optimise", optimise, least=fewest_anchors(known), most=60)
    check_whole("verify_points", verify_points, least=1, most=200)
    check_whole("verify_rounds", verify_rounds, least=100)
    check_whole("seed", seed, least=0)
    walls_m, levels_m = _mounts(mounts_m), _heights("anchor_heights_m", anchor_heights_m)
    with named_as_arguments(_ARGUMENTS):
        channel = ChannelModel() if range_m is None else with_range(ChannelModel(), range_m)
        settings = PlanSettings(method, noise_ps, process_noise(qa, dynamics) or 0.3, channel)
        if optimise is None:
            check_anchor_count(known, file)
        floor = floor_of(known, file, outline, region)
        mounts = mounts_of(known, floor, walls_m, levels_m)
        optimised: Optimised | None = None
        if optimise is not None:
            search = Search(known, settings, floor, mounts, heights_m, optimise, seed, search_s)
            optimised = search.run(target_m, report_progress)
            known = optimised.best.site
        predictor = Predictor(known, settings)
        try:
            grid = grid_of(floor, heights_m, step_m)
        except ValueError as error:
            raise SkylessError(f"no map: {error}") from None
        mapped = plan_map(predictor, grid, report_progress)
        checked: Verification | None = None
        if verify_points is not None:
            points_m = random_points(mapped, verify_points, seed)
            checked = verify(predictor, points_m, verify_rounds, seed, report_progress)
        report_progress(1.0)
        found = plan_report(predictor, floor, mounts, mapped, summary_of(mapped, target_m), optimised, checked)
    return PlanResult(predictor.site, file, floor, mapped, {**found, "wall_s": time.perf_counter() - started_s})


def _refuse(given: Mapping[str, object], mode: str) -> None:
    """See that arguments which mean nothing here are not given. Raises SkylessError."""
    usual = plan.__kwdefaults__ or {}
    for name, value in given.items():
        if value is not None and not (usual[name] is not None and value == usual[name]):
            raise SkylessError(f"{name} is not for this site, which is {mode}; leave it out")


def _tag_heights(values_m: Sequence[float] | None, site: Site) -> tuple[float, ...]:
    heights_m = _heights("tag_heights_m", values_m)
    if heights_m is not None and site.tags.height_m is not None:
        raise wrong("tag_heights_m", values_m, f"left out: this site's tags are all at {site.tags.height_m:g} m")
    return heights_m or (usual_tag_heights(site) if site.anchors else (0.0,))


def _heights(name: str, values_m: Sequence[float] | None) -> tuple[float, ...] | None:
    if values_m is None:
        return None
    heights_m = sequence(name, values_m, "heights in metres")
    check_point(name, heights_m, (max(len(heights_m), 1),))
    return tuple(map(float, heights_m))


def _outline(corners_m: Sequence[Sequence[float]] | None) -> Matrix | None:
    if corners_m is None:
        return None
    corners = sequence("outline_m", corners_m, "three or more corners, (x, y) each")
    for number, corner_m in enumerate(corners):
        check_point(f"outline_m[{number}]", corner_m, (2,))
    if len(corners) < 3:
        raise wrong("outline_m", corners_m, "three or more corners, (x, y) each")
    return np.array(corners, dtype=np.float64)


def _region(box_m: Sequence[float] | None) -> Box | None:
    if box_m is None:
        return None
    check_point("region_m", box_m, (4,))
    x1, y1, x2, y2 = map(float, box_m)
    if not (x2 > x1 and y2 > y1):
        raise wrong("region_m", box_m, "x1, y1, x2, y2 with x1 < x2 and y1 < y2")
    return x1, y1, x2, y2


def _mounts(walls_m: Sequence[Sequence[float]] | None) -> Matrix | None:
    if walls_m is None:
        return None
    walls = sequence("mounts_m", walls_m, "walls, x1, y1, x2, y2 each")
    for number, wall_m in enumerate(walls):
        check_point(f"mounts_m[{number}]", wall_m, (4,))
    segments_m = np.array(walls, dtype=np.float64).reshape(-1, 4)
    if not np.hypot(*(segments_m[:, 2:] - segments_m[:, :2]).T).sum() > 0.0:
        raise wrong("mounts_m", walls_m, "walls, x1, y1, x2, y2 each, with two different ends")
    return segments_m
