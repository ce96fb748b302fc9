"""The study ``large``: a site of a thousand anchors.

The anchors are a tape (``sim/tape``); each tag gets the beacons that it receives, and nothing else.
"""

import math
from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import chain
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.arrays import Array
from skyless.core.fix import Fix
from skyless.core.site import EXACT, AccuracySite, Site
from skyless.core.tag.joint import Estimation
from skyless.core.tag.receiver import Receiver
from skyless.research.studies.picture import jackknife, with_errors
from skyless.research.studies.room import biases_of
from skyless.research.studies.runner import Cell, Limit, Plan, Row, seed_of, with_limits
from skyless.research.studies.worlds import bounds_m2
from skyless.sim.evaluation.scenarios import ROOM_QA_M2PS3, Room
from skyless.sim.impairments import Impairments, RangeErrorModel
from skyless.sim.tape import Heard, Tape
from skyless.sim.trajectory import Roaming, Trajectory, Waypoints
from skyless.site.channel import ChannelModel
from skyless.site.file.template import grid_site

_SIDE: Final = 32
"""Anchors along each side of the square: 1,024 in all."""

_HEIGHT_M: Final = 4.0
_TAG_HEIGHT_M: Final = 1.0
_WALK_MPS: Final = 1.4
_EDGE_M: Final = 40.0
"""Tags stay this far inside of the outermost anchors."""

_LEG_M: Final = (40.0, 100.0)
"""From point to point; tags that drive go farther."""

_POINTS: Final = 40
"""Points of a path, after which a tag comes back to the first."""

_CORNER_S: Final = 2.0
_SETTLED_S: Final = 2.0
"""After a tag's first fix, from when on it is judged."""

_SPAN_S: Final = 1.0
_ROAM_STD_M: Final = 6.0
"""Standard deviation per axis of the positions of tags that move as the bound assumes."""

_BOUND_S: Final = 12.0
_ROOM: Final = Room()

_TAG_COST_S: Final = 0.07
"""About what a second of a tag takes."""

_PATH_KEY: Final = 41


class LargeCase(Struct, frozen=True):
    """One kind of site and of tags."""

    name: str
    series: str
    spacing_m: float = 15.0
    in_room: bool = False
    bounded: bool = False
    """Whether tags move as the bound assumes, and it is computed."""
    speed_mps: float = _WALK_MPS
    loss: float = 0.0
    dead_share: float = 0.0
    seconds: float | None = None
    """None: as of the plan."""
    starts: bool = False
    """Whether only cold starts are judged."""
    limits: tuple[Limit, ...] = ()

    @property
    def tags(self) -> int:
        """Tags in a cell."""
        return 12 if self.starts else 1


def cases(plan: Plan) -> list[LargeCase]:
    """Sites and tags; limits stand where the issue of protocol 2 has figures."""
    errors = (Limit("rmse_m", most=0.027), Limit("nees", 0.6, 1.2), Limit("restarts", most=0.0))
    walk = (*errors, Limit("beacons_per_s", least=140.0), Limit("gap_s", most=0.15))
    roaming = 60.0 if plan.quick else 1100.0
    start = (Limit("first_fix_s", most=0.3),)
    return [
        LargeCase("random instants", "walking", limits=walk),
        LargeCase("7 m apart", "walking", spacing_m=7.0),
        LargeCase("5 m/s through the whole site", "walking", speed_mps=5.0, seconds=roaming, limits=errors),
        LargeCase("30 % lost", "walking", loss=0.3, limits=(Limit("restarts", most=0.0),)),
        LargeCase("20 % of the anchors dead", "walking", dead_share=0.2, limits=(Limit("restarts", most=0.0),)),
        LargeCase("exact ranges, bounded", "bounds", bounded=True),
        LargeCase("room", "bounds", in_room=True, bounded=True, limits=(Limit("ratio", most=1.2),)),
        LargeCase("cold starts", "cold starts", starts=True, limits=start),
        LargeCase("cold starts, room", "cold starts", in_room=True, starts=True, limits=start),
        LargeCase(
            "cold starts, 7 m apart", "cold starts", spacing_m=7.0, starts=True,
            limits=(Limit("first_fix_s", most=0.5),),
        ),
    ]  # fmt: skip


class LargeRow(Row, frozen=True, kw_only=True):
    """Results of the tags of a case."""

    beacons_per_s: float | None = None
    """That a tag receives."""
    first_fix_s: float
    """From a tag's first beacon to its first fix, which 95 % of the tags do not exceed."""
    gap_s: float | None = None
    """Longest time between two fixes."""
    joins: int | None = None
    """How often an anchor joined those in use."""
    restarts: int | None = None
    """How often a tag had to begin again."""


class LargeResult(Struct, frozen=True):
    """What they did; sums over fixes."""

    fixes: int
    squared_m2: float
    nees: float
    variance_m2: float
    errors_m: Array
    bound_m2: float
    """Sum of the bound's variances at the same fixes; 0 where there is none."""
    beacons: int
    tag_s: float
    gap_s: float
    first_fix_s: tuple[float, ...]
    """From each tag's first beacon to its first fix; infinite where there was none."""
    joins: int
    restarts: int


@lru_cache(maxsize=4)
def site_of(case: LargeCase) -> Site:
    """A square of anchors under one ceiling, as its planner makes it."""
    side_m = _SIDE * case.spacing_m
    site = grid_site(side_m, side_m, case.spacing_m, _HEIGHT_M, _TAG_HEIGHT_M)
    return replace(site, accuracy=AccuracySite() if case.in_room else EXACT)


def _paths(case: LargeCase, plan: Plan, number: int) -> list[Trajectory]:
    """Where the tags of a cell go."""
    draw = np.random.default_rng(seed_of(plan.seed, _PATH_KEY, number))
    side_m = _SIDE * case.spacing_m
    low_m, high_m = min(_EDGE_M, side_m / 4.0), side_m - min(_EDGE_M, side_m / 4.0)
    return [_path(case, draw, low_m, high_m) for _ in range(case.tags)]


def _path(case: LargeCase, draw: np.random.Generator, low_m: float, high_m: float) -> Trajectory:
    if case.bounded or case.starts:
        middle_m = [*draw.uniform(low_m, high_m, 2), _TAG_HEIGHT_M]
        std_m = (_ROAM_STD_M, _ROAM_STD_M, 0.0)
        return Roaming(middle_m, std_m, qa_m2ps3=ROOM_QA_M2PS3, seed=int(draw.integers(2**62)))
    points, longest_m = [draw.uniform(low_m, high_m, 2)], _LEG_M[1] if case.speed_mps <= _WALK_MPS else math.inf
    while len(points) < _POINTS or np.linalg.norm(points[0] - points[-1]) < _LEG_M[0]:
        point = draw.uniform(low_m, high_m, 2)
        if _LEG_M[0] <= np.linalg.norm(point - points[-1]) <= longest_m:
            points.append(point)
    return Waypoints([(x_m, y_m, _TAG_HEIGHT_M) for x_m, y_m in points], case.speed_mps, loop=True, corner_s=_CORNER_S)


def _tape_of(case: LargeCase, plan: Plan, number: int) -> Tape:
    """The site on the air, and the tags of a cell in it."""
    site, draw = site_of(case), np.random.default_rng(seed_of(plan.seed, _PATH_KEY, number, 1))
    impairments = Impairments(
        tx_stamp_ps=plan.noise_ps,
        rx_stamp_ps=plan.noise_ps,
        channel=ChannelModel(loss_probability=case.loss),
        range_errors=_ROOM.ranges if case.in_room else RangeErrorModel(),
    )
    return Tape(
        site,
        _paths(case, plan, number),
        impairments,
        seed_of(plan.seed, _PATH_KEY, number, 2) >> 1,
        dead=draw.random(len(site.anchors)) < case.dead_share,
        survey_std_m=_ROOM.axis_std_m if case.in_room else 0.0,
    )


def run_large(case: LargeCase, plan: Plan, number: int) -> LargeResult:
    """Simulate the tags of a cell, and judge their fixes."""
    tape = _tape_of(case, plan, number)
    draws = [np.random.default_rng(seed_of(plan.seed, number, tag)) for tag in range(case.tags)]
    return _sum([_judge_tag(case, plan, tape, tag, float(one.uniform(1.0, 20.0))) for tag, one in enumerate(draws)])


def _judge_tag(case: LargeCase, plan: Plan, tape: Tape, tag: int, begin_s: float) -> LargeResult:
    receiver = Receiver()
    seconds = 1.0 if case.starts else _BOUND_S if case.bounded else case.seconds or plan.seconds
    beacons: list[Heard] = []
    first_s, last_s, gap_s, at_s = math.inf, math.inf, 0.0, begin_s
    joins = restarts = 0
    judged: list[tuple[float, ...]] = []
    while at_s < begin_s + seconds and not (case.starts and first_s < math.inf):
        for heard in tape.hear(tag, at_s, min(at_s + _SPAN_S, begin_s + seconds)):
            fix, joined, restarted = _process(receiver, heard)
            joins, restarts = joins + joined, restarts + restarted
            if fix is not None:
                now_s = heard.reception.host_s or 0.0
                first_s = min(first_s, now_s)
                gap_s, last_s = max(gap_s, now_s - last_s), now_s
                if now_s - first_s >= _SETTLED_S:
                    judged.append((len(beacons), *_judge(fix, heard.truth_m)))
            beacons.append(heard)
        at_s += _SPAN_S
    rows = np.array(judged).reshape(-1, 4)
    bounds_m2 = _bound_m2(tape, beacons, case, plan)[rows[:, 0].astype(int)] if case.bounded else np.zeros(0)
    return LargeResult(
        fixes=len(rows),
        squared_m2=float(rows[:, 1].sum()),
        nees=float(rows[:, 2].sum()),
        variance_m2=float(rows[:, 3].sum()),
        errors_m=np.sqrt(rows[:, 1]),
        bound_m2=float(bounds_m2.sum()),
        beacons=len(beacons),
        tag_s=seconds,
        gap_s=gap_s,
        first_fix_s=(first_s - (beacons[0].reception.host_s or 0.0) if beacons else math.inf,),
        joins=joins,
        restarts=restarts,
    )


def _process(receiver: Receiver, heard: Heard) -> tuple[Fix | None, bool, bool]:
    """A beacon's fix, if it gives one, and whether its anchor joined those in use, and whether the tag began again."""
    anchor, method = heard.beacon.anchor, receiver.method
    was_running = isinstance(method, Estimation) and not method.is_starting
    was_in = isinstance(method, Estimation) and was_running and method.estimator.has_anchor(anchor)
    fix = receiver.hear_beacon(heard.beacon, heard.reception)
    method = receiver.method
    if not isinstance(method, Estimation) or not was_running:
        return fix, False, False
    return fix, not method.is_starting and not was_in and method.estimator.has_anchor(anchor), method.is_starting


def _judge(fix: Fix, truth_m: Array) -> tuple[float, float, float]:
    """Squared error of a fix, its normalised square per dimension, and the variance, all horizontal."""
    error, covariance = (fix.position_m - truth_m)[:2], fix.covariance_m2[:2, :2]
    nees = float(error @ np.linalg.solve(covariance, error)) / 2.0
    return float(error @ error), nees, float(np.trace(covariance))


def _sum(tags: Sequence[LargeResult]) -> LargeResult:
    own = {name: [getattr(one, name) for one in tags] for name in LargeResult.__struct_fields__}
    others = {
        "errors_m": np.concatenate(own.pop("errors_m")),
        "gap_s": max(own.pop("gap_s")),
        "first_fix_s": tuple(chain.from_iterable(own.pop("first_fix_s"))),
    }
    return LargeResult(**{name: sum(values) for name, values in own.items()}, **others)


# The bound


def _bound_m2(tape: Tape, heard: Sequence[Heard], case: LargeCase, plan: Plan) -> Array:
    """Trace of the Cramér–Rao bound after each beacon of a tag, shape (beacons,)."""
    site = site_of(case)
    row_of, beacons = {one.id: row for row, one in enumerate(site.anchors)}, [one.beacon for one in heard]
    ids = sorted({beacon.anchor for beacon in beacons})
    anchors_m = {identifier: tape.true_positions_m[row_of[identifier]] for identifier in ids}
    times_s, path_m = np.array([one.reception.host_s for one in heard]), np.array([one.truth_m for one in heard])
    biases = biases_of(_ROOM if case.in_room else None)
    return bounds_m2(anchors_m, beacons, times_s, path_m, plan.noise_ps * 1e-12, site.noise, biases)


# Cells and rows


def _worlds(plan: Plan, case: LargeCase) -> range:
    """Numbers of the cells of a case."""
    return range((8 if plan.quick else 16) if case.starts else min(plan.worlds, 2) if case.seconds else plan.worlds)


def cells(plan: Plan) -> list[Cell]:
    """One cell for each tag, or for some cold starts."""
    return [
        Cell(
            case.name,
            partial(run_large, case, plan, number),
            _TAG_COST_S * case.tags * (case.seconds or plan.seconds) + 1.0,
        )
        for case in cases(plan)
        for number in _worlds(plan, case)
    ]


def rows(plan: Plan, results: Sequence[LargeResult]) -> list[Row]:
    """A row for each case; the results stand in the order of ``cells``."""
    rest = iter(results)
    return [
        with_limits(row_of(plan, case, [next(rest) for _ in _worlds(plan, case)]), case.limits) for case in cases(plan)
    ]


def row_of(plan: Plan, case: LargeCase, each: list[LargeResult]) -> Row:
    """The results of a case, without its limits."""
    whole = _sum(each)
    row = LargeRow(
        study="large",
        method="joint",
        case=case.name,
        series=case.series,
        mesh=True,
        noise_ps=plan.noise_ps,
        runs=len(each),
        fixes=len(whole.first_fix_s) if case.starts else whole.fixes,
        first_fix_s=float(np.percentile(whole.first_fix_s, 95, method="higher")),
    )
    if case.starts or whole.fixes == 0:
        return row
    sums = np.array([(one.fixes, one.squared_m2, one.nees, one.bound_m2) for one in each])
    row = replace(
        with_errors(row, sums, whole.errors_m),
        max_m=float(whole.errors_m.max()),
        said_m=math.sqrt(whole.variance_m2 / whole.fixes),
        beacons_per_s=whole.beacons / whole.tag_s,
        gap_s=whole.gap_s,
        joins=whole.joins,
        restarts=whole.restarts,
    )
    if not case.bounded:
        return row
    ratio, ratio_error = jackknife(sums, lambda part: math.sqrt(part[:, 1].sum() / part[:, 3].sum()))
    return replace(row, bound_m=math.sqrt(whole.bound_m2 / whole.fixes), ratio=ratio, ratio_error=ratio_error)
