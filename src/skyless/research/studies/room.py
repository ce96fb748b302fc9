"""The study ``room``: a method judged where the errors of real rooms are, and where one thing more is wrong.

The room is the lab with anchors, ranges and motions as in ``sim/evaluation/scenarios.py``. Each other case changes one
thing in it. The worlds do not depend on the method.

Cases whose errors of survey and ranges are all that is wrong, and whose tags accelerate at random, have a Cramér–Rao
bound: that of all receptions that a tag's beacons state, counted as known when they happened, for errors with the
variances with which the worlds draw them, whatever a site file states. That tags are also held in the room by a spring
and damping is left out, as no receiver knows it.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from msgspec.structs import asdict, replace

from skyless.core.air.beacon import Beacon, decode_cached
from skyless.core.arrays import Array, Integers, Mask
from skyless.core.integrity import IntegrityRequirement
from skyless.core.site import AnchorSite, Site, TagsSite, WallSite
from skyless.research.studies.lab import laps
from skyless.research.studies.picture import (
    Case,
    WorldRow,
    by_case,
    clustered_interval,
    jackknife,
    world_cells,
    world_rows,
)
from skyless.research.studies.runner import Cell, Limit, Plan, Row, seed_of, with_limits
from skyless.research.studies.worlds import Run, RunResult, anchor_of, box, worlds
from skyless.research.uncertainty import Biases, BoundSettings, Sendings, received_bound, relayed_receptions
from skyless.sim.evaluation.figures import LevelCounts
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.evaluation.scenarios import ROOM_QA_M2PS3, Room, wanderer, wanderers
from skyless.sim.impairments import AnchorBias, Body, RangeErrorModel, WarmUp
from skyless.sim.lab import lab_site
from skyless.sim.trajectory import Static, Trajectory, Waypoints
from skyless.sim.world import Broadcast

BASE: Final = "the room"
AIR: Final = "unbiased air"
_WARMUP_S: Final = 1.5

_BOUND_RATIO: Final = 1.15
"""Over the Cramér–Rao bound, at most, in the room itself."""

_LATER_RATIO: Final = 1.2
"""Largest ratio of the RMSE of tags after a long rest to their RMSE at first."""

_SHARE: Final = 0.25
"""Worlds of each case but the room itself, of those that the room has."""

_CHANGING_M: Final = 0.029
"""As large as constants that are uniform within 5 cm."""

_HALL_M: Final = (12.0, 16.0)
_ROOM_3D_M: Final = (8.0, 6.0)
_HEIGHTS_M: Final = (0.2, 3.0)
"""Heights of neighbouring anchors in the 3-D room."""
_STAIRWELL_M: Final = (4.0, 6.0)
_STAIRWELL_HEIGHTS_M: Final = (0.2, 3.8, 1.4, 5.0, 0.8, 4.4, 2.0, 5.2)
"""Heights of its anchors, in their order around the walls."""
_LINE_M: Final = (10.0, 0.1)
"""Length of the row of anchors along a wall, and by how much every second one stands off it."""
_BESIDE_M: Final = ((0.5, 1.0), (9.5, 5.0))
"""Corners of the box in which tags wander beside that row."""

WALL: Final = WallSite(4.0, 3.0, 4.0, 5.0, delay_m=0.25)
"""Between the tags that walk past and three of the anchors, low enough for these to hear the others over it."""
_PAST_WALL_X_M: Final = (3.4, 3.7)
_PAST_WALL_Y_M: Final = (0.3, 7.7)

_SMALL_M: Final = (0.1, 0.4)
_LARGE_M: Final = (0.5, 2.0)
"""By how much anchors are late, each by its own draw."""
_LATE_S: Final = (_WARMUP_S + 3.0, _WARMUP_S + 9.0)

_CRYSTALS: Final = ((1.0, 20.0), (-1.0, 20.0), (2.0, 20.0), (-2.0, 20.0), (5.0, 60.0))
"""What tags' crystals gain in the end in ppm, and the time constant in s."""

_POWER_CUT_PPM: Final = (0.5, 3.0)
_POWER_CUT_TAU_S: Final = 60.0
"""By how much the crystals of anchors that were all cold warm up, each by its own draw and with its own sign."""
_DRAUGHTS_PPMPS: Final = ((0.01, 0.03), (0.03, 0.1))
"""By how much the frequencies of all anchors change in a second."""
_DRAUGHT_TAU_S: Final = 1e4
"""Long enough for a warm-up to be a straight line in a study."""

_FIELDS_M: Final = ((0.05, 0.075), (0.10, 0.12))
"""Standard deviations of multipath, and the largest RMSE with each."""
_FIELD_LENGTH_M: Final = 0.1
"""Way in which the correlation of multipath falls to 1/e."""

_CREEP_MPS: Final = 0.05
_CREEPS_S: Final = (5.0, 20.0, 60.0)

_LONG_WORLDS: Final = 2
"""Number of worlds in cases whose worlds last for minutes."""
_REST_SPANS: Final = 8
_WALK_SPANS: Final = 4
"""Tags at rest: spans of rest, of which the last is judged, and of walking before. A span is what other cases judge."""

TURNS_MPS2: Final = (3.0, 6.0, 10.0, 30.0)
_TURNING_MPS: Final = 3.0
_STATED_MPS2: Final = 10.0
"""Turns that are also driven with the tag's largest acceleration stated."""

_LATE_KEY: Final = 23
_PATH_KEY: Final = 29
_CRYSTAL_KEY: Final = 31
"""Keys of streams of random numbers, next to the worlds' own."""

_BOUND_SPEED_STD_MPS: Final = 1.0
"""Before the first frame; after the second and a half for which nothing is judged nothing of it is left."""

_BOUND_TAG_S: Final = 0.03
"""About what simulation and bound take for a second of a tag."""

Paths = Callable[[int], Sequence[Trajectory]]


def cases(plan: Plan) -> list[Case]:
    """The room, and what differs from it in one thing; of a quick study the first case of each series."""
    changes = (*_crystals(plan), *_power_cuts(plan), *_turns(plan))
    each = [*_rooms(plan), *_rests(plan), *_errors(plan), *_fields(plan), *_obstacles(plan), *_late(plan), *changes]
    return list({case.series: case for case in reversed(each)}.values())[::-1] if plan.quick else each


def _case(
    plan: Plan,
    name: str,
    series: str,
    *limits: Limit,
    site: Site | None = None,
    paths: Paths | None = None,
    bounded: bool = False,
    long: bool = False,
    **faults: Any,  # noqa: ANN401 - of ``worlds``
) -> Case:
    """``bounded``: nothing is wrong but what the room's errors of survey and ranges are, so that there is a bound."""
    in_site = site or lab_site(plan.noise_ps)
    count = plan.worlds if name == BASE else max(2, _LONG_WORLDS if long else round(_SHARE * plan.worlds))
    trajectories = paths or partial(wanderers, in_site, plan.tags)
    faults = {"room": Room(), "warmup_s": _WARMUP_S, **faults}
    runs = worlds(plan, in_site, trajectories, count=count, **faults)
    return Case(name, series, None, runs, limits=limits, biases=biases_of(faults["room"]) if bounded else None)


def _exceeded(most: float) -> Limit:
    return Limit("exceeded", most=most)


def _rooms(plan: Plan) -> list[Case]:
    hall = (Limit("level", 0.97), Limit("nees", 0.5, 1.5))
    usual = (
        Limit("rmse_m", most=0.030),
        Limit("nees", 0.7, 1.3),
        Limit("level", 0.99),
        _exceeded(1e-4),
        Limit("hpl_m", most=0.30),
    )
    return [
        replace(_case(plan, BASE, "rooms", *usual, bounded=True), limit=_BOUND_RATIO),
        _case(plan, AIR, "rooms", Limit("rmse_m", most=0.019), room=None, bounded=True),
        _case(plan, "hall, 8 anchors", "rooms", *hall, site=hall_site(plan.noise_ps), bounded=True),
        *(
            _case(plan, name, "rooms", Limit("rmse_m", most=most_m), site=site, bounded=True)
            for name, most_m, site in (
                ("3-D room, 8 anchors", 0.050, room_3d_site(plan.noise_ps)),
                ("stairwell in 3-D, 8 anchors", 0.038, stairwell_site(plan.noise_ps)),
            )
        ),
        _case(
            plan,
            "anchors in a line",
            "rooms",
            *(Limit("level", most=0.0), _exceeded(0.0)),
            site=line_site(plan.noise_ps),
            paths=partial(_beside_the_line, plan.tags),
        ),
    ]


def _rests(plan: Plan) -> list[Case]:
    """Tags that lie still from the start on: judged at first, and a second time when they have lain for long."""
    later_s = _WARMUP_S + (_REST_SPANS - 1) * plan.seconds
    limits = (Limit("nees", most=2.0), _exceeded(0.0))
    found = []
    for name, site, room in (
        ("at rest, unbiased air", lab_site(plan.noise_ps), None),
        ("at rest", lab_site(plan.noise_ps), Room()),
        ("at rest, 3-D room", room_3d_site(plan.noise_ps), Room()),
    ):
        resting = partial(still, site, plan.tags)
        first = _case(plan, name, "rest", *limits, site=site, paths=resting, room=room, long=True)
        later = _case(
            plan, f"{name}, later", "rest", *limits, site=site, paths=resting, room=room, long=True, warmup_s=later_s
        )
        found += [first, replace(later, of=name, limit=_LATER_RATIO)]
    return found


def still(site: Site, tags: int, seed: int) -> Sequence[Trajectory]:
    """Tags that stay where those that wander begin."""
    return [Static(*path.position(0.0).tolist()) for path in wanderers(site, tags, seed)]


def _beside_the_line(tags: int, seed: int) -> Sequence[Trajectory]:
    low_m, high_m = (np.array((*corner_m, 0.0)) for corner_m in _BESIDE_M)
    return [wanderer(low_m, high_m, seed, tag) for tag in range(tags)]


def _errors(plan: Plan) -> list[Case]:
    """Constants of the ranges, then anchors that stand elsewhere than their room's survey accounts for."""
    ranges = {
        "constants change in 10 s": {"constant_m": 0.0, "changing_m": _CHANGING_M, "correlation_s": 10.0},
        "constants change within 1 m": {"constant_m": 0.0, "changing_m": _CHANGING_M, "correlation_m": 1.0},
        "constants within 10 cm": {"constant_m": 0.10},
    }
    off = [(1, 0.10), (1, 0.15), (1, 0.20), (1, 0.30), (2, 0.20)]
    return [
        *(
            _case(plan, name, "ranges", room=Room(ranges=RangeErrorModel(slope_m=0.05, **changes)), bounded=True)
            for name, changes in ranges.items()
        ),
        *(
            _case(
                plan,
                f"{'one anchor' if count == 1 else 'two anchors'} {100 * off_m:.0f} cm off",
                "positions of anchors",
                _exceeded(3e-4),
                room=Room(off_anchors=count, off_m=off_m),
            )
            for count, off_m in off
        ),
        _case(plan, "each axis N(5 cm)", "positions of anchors", room=Room(axis_std_m=0.05), bounded=True),
    ]


def _fields(plan: Plan) -> list[Case]:
    """Multipath over centimetres, with the room's own errors, at tags that have walked through it for a while."""
    return [
        _case(
            plan,
            f"multipath of {100 * std_m:.0f} cm over {100 * _FIELD_LENGTH_M:.0f} cm",
            "ranges",
            *(Limit("rmse_m", most=most_m), Limit("nees", most=2.0), _exceeded(1e-3)),
            room=Room(ranges=replace(Room().ranges, changing_m=std_m, correlation_m=_FIELD_LENGTH_M)),
            long=True,
            warmup_s=_WALK_SPANS * plan.seconds,
        )
        for std_m, most_m in _FIELDS_M
    ]


def _obstacles(plan: Plan) -> list[Case]:
    lab = lab_site(plan.noise_ps)
    wall = (Limit("rmse_m", most=0.08), Limit("nees", most=3.0), _exceeded(1e-3))
    body = (Limit("rmse_m", most=0.12), Limit("nees", most=4.0), _exceeded(1e-3))
    past = partial(past_wall, plan.tags)
    walled = replace(lab, walls=(WALL,))
    return [
        _case(plan, "past a wall", "obstacles", *wall, site=walled, paths=past, walls_between_anchors=False),
        _case(plan, "a body", "obstacles", *body, body=Body()),
    ]


def _late(plan: Plan) -> list[Case]:
    found = []
    for span_m in (_SMALL_M, _LARGE_M):
        for count in (1, 2, 3):
            for when, (from_s, to_s) in {"": (0.0, np.inf), ", 6 s": _LATE_S}.items():
                name = f"{count} of 6 late, {span_m[0]:g}–{span_m[1]:g} m{when}"
                limits = () if count == 1 else (_exceeded(1e-3),)
                late = partial(late_anchors, plan, count, span_m, from_s, to_s)
                found.append(_case(plan, name, "late anchors", *limits, biases=late))
    for creep_s in _CREEPS_S:
        name, long = f"1 of 6 creeps 5 cm/s for {creep_s:.0f} s", creep_s > plan.seconds
        late = partial(creeping_anchor, plan, creep_s)
        seconds = max(plan.seconds, creep_s)
        found.append(_case(plan, name, "late anchors", _exceeded(1e-3), biases=late, seconds=seconds, long=long))
    return found


def creeping_anchor(plan: Plan, creep_s: float, number: int) -> tuple[AnchorBias, ...]:
    """Another anchor in each world, whose range creeps from the start of the judging on and is then right again."""
    anchor = anchor_of(lab_site(plan.noise_ps), number).id
    return (AnchorBias(anchor, 0.0, from_s=_WARMUP_S, to_s=_WARMUP_S + creep_s, creep_mps=_CREEP_MPS),)


def late_anchors(
    plan: Plan, count: int, span_m: tuple[float, float], from_s: float, to_s: float, number: int
) -> tuple[AnchorBias, ...]:
    """Other anchors in each world; those that are late in twos are among those in threes, by the same amounts."""
    draw = np.random.default_rng(seed_of(plan.seed, number, _LATE_KEY))
    anchors = lab_site(plan.noise_ps).anchors
    chosen, amounts_m = draw.permutation(len(anchors))[:count], draw.uniform(*span_m, len(anchors))
    return tuple(AnchorBias(anchors[one].id, float(amounts_m[one]), from_s=from_s, to_s=to_s) for one in chosen)


def _crystals(plan: Plan) -> list[Case]:
    lab = lab_site(plan.noise_ps)

    def of_an_anchor(number: int) -> tuple[WarmUp, ...]:
        return (WarmUp(1.0, 20.0, _WARMUP_S, anchor_of(lab, number).id),)

    tags = [
        _case(plan, f"tags' crystals {ppm:+g} ppm", "crystals", warm_ups=(WarmUp(ppm, tau_s, _WARMUP_S),))
        for ppm, tau_s in _CRYSTALS
    ]
    return [
        replace(case, of=BASE, limit=1.3)
        for case in (*tags, _case(plan, "an anchor's crystal +1 ppm", "crystals", warm_ups=of_an_anchor))
    ]


def _power_cuts(plan: Plan) -> list[Case]:
    """All anchors' crystals change at once from the start on: cold ones warm up, or draughts cool and warm them."""
    low, high = _POWER_CUT_PPM
    cases = [(f"all anchors' crystals ±{low:g}–{high:g} ppm", low, high, _POWER_CUT_TAU_S, 0.04)]
    for (low, high), most_m in zip(_DRAUGHTS_PPMPS, (0.04, 0.08), strict=True):
        name = f"all anchors' crystals ±{low:g}–{high:g} ppm/s"
        cases.append((name, low * _DRAUGHT_TAU_S, high * _DRAUGHT_TAU_S, _DRAUGHT_TAU_S, most_m))
    return [
        _case(
            plan,
            name,
            "crystals",
            *(Limit("rmse_m", most=most_m), Limit("level", 0.95), _exceeded(1e-3)),
            warm_ups=partial(warming_anchors, plan, low, high, tau_s),
        )
        for name, low, high, tau_s, most_m in cases
    ]


def warming_anchors(plan: Plan, low_ppm: float, high_ppm: float, tau_s: float, number: int) -> tuple[WarmUp, ...]:
    """Each anchor's crystal by its own amount and sign, from before the tags are switched on."""
    anchors = lab_site(plan.noise_ps).anchors
    draw = np.random.default_rng(seed_of(plan.seed, number, _CRYSTAL_KEY))
    gains_ppm = draw.uniform(low_ppm, high_ppm, len(anchors)) * draw.choice((-1.0, 1.0), len(anchors))
    return tuple(WarmUp(ppm, tau_s, 0.0, one.id) for one, ppm in zip(anchors, gains_ppm.tolist(), strict=True))


def _turns(plan: Plan) -> list[Case]:
    """Cases of tags that turn, with and without a stated largest acceleration."""
    found = []
    for turn, stated in (*((turn, False) for turn in TURNS_MPS2), (_STATED_MPS2, True)):
        name = f"turns of {turn:g} m/s² at {_TURNING_MPS:g} m/s" + (", stated" if stated else "")
        limits = (_exceeded(1e-3),) if turn == _STATED_MPS2 else ()
        asked = IntegrityRequirement(max_acceleration_mps2=turn if stated else 0.0)
        found.append(_case(plan, name, "turns", *limits, paths=partial(turning, plan, turn), integrity=asked))
    return found


def turning(plan: Plan, acceleration_mps2: float, seed: int) -> Sequence[Trajectory]:
    """Tags that go round and round the lab; all accelerations have the same rounds."""
    draw, (low_m, high_m) = np.random.default_rng(seed_of(seed, _PATH_KEY)), box(lab_site(plan.noise_ps))
    return [laps(draw, low_m, high_m, _TURNING_MPS, acceleration_mps2) for _ in range(plan.tags)]


def past_wall(tags: int, seed: int) -> Sequence[Trajectory]:
    """Tags that walk to and fro along the wall at 1 m/s, from where it hides no anchor."""
    lines_m = np.random.default_rng(seed_of(seed, _PATH_KEY)).uniform(*_PAST_WALL_X_M, tags).tolist()
    return [Waypoints([(x_m, y_m) for y_m in _PAST_WALL_Y_M], 1.0, loop=True, corner_s=1.0) for x_m in lines_m]


def hall_site(noise_ps: float) -> Site:
    """Eight anchors on the walls of 12 m × 16 m: corners and middles, at the tags' height as in the lab."""
    anchors = tuple(AnchorSite(id=k, x_m=x, y_m=y) for k, (x, y) in enumerate(_around(*_HALL_M), start=1))
    return replace(lab_site(noise_ps), name="hall", anchors=anchors)


def room_3d_site(noise_ps: float) -> Site:
    """Eight anchors on the walls of 8 m × 6 m, high and low by turns; the height of tags is not given."""
    return _site_3d(noise_ps, "3-D room", _ROOM_3D_M, tuple(_HEIGHTS_M[k % 2] for k in range(1, 9)))


def stairwell_site(noise_ps: float) -> Site:
    """Eight anchors on the walls of 4 m × 6 m, over 5 m of height; the height of tags is not given."""
    return _site_3d(noise_ps, "stairwell", _STAIRWELL_M, _STAIRWELL_HEIGHTS_M)


def _site_3d(noise_ps: float, name: str, floor_m: tuple[float, float], heights_m: Sequence[float]) -> Site:
    anchors = tuple(
        AnchorSite(id=k, x_m=x, y_m=y, z_m=z_m)
        for k, ((x, y), z_m) in enumerate(zip(_around(*floor_m), heights_m, strict=True), start=1)
    )
    return replace(lab_site(noise_ps), name=name, anchors=anchors, tags=TagsSite())


def line_site(noise_ps: float) -> Site:
    """Six anchors along one wall, every second one a little off it: all tags are on one side, which ranges hide."""
    (length_m, off_m), lab = _LINE_M, lab_site(noise_ps)
    places = enumerate(np.linspace(0.0, length_m, len(lab.anchors)).tolist())
    anchors = tuple(AnchorSite(id=k + 1, x_m=x_m, y_m=off_m * (k % 2)) for k, x_m in places)
    return replace(lab, name="line", anchors=anchors)


def _around(x_m: float, y_m: float) -> list[tuple[float, float]]:
    along_x, along_y = (0.0, 0.5, 1.0, 1.0, 1.0, 0.5, 0.0, 0.0), (0.0, 0.0, 0.0, 0.5, 1.0, 1.0, 1.0, 0.5)
    return [(x_m * a, y_m * b) for a, b in zip(along_x, along_y, strict=True)]


def cells(plan: Plan) -> list[Cell]:
    """The worlds of all cases, then their bounds where there are some."""
    each = cases(plan)
    return [*world_cells(each), *bound_cells(each)]


def rows(plan: Plan, results: Sequence[Any]) -> Sequence[Row]:
    """A row for each case; the results stand in the order of ``cells``."""
    each = cases(plan)
    count = sum(len(case.runs) for case in each)
    worlds, bounds = results[:count], iter(results[count:])
    found = []
    for case, row, own in zip(each, world_rows("room", plan, each, worlds), by_case(each, worlds), strict=True):
        bounded = row if case.biases is None else with_bound(row, own, [next(bounds) for _ in case.runs])
        found.append(with_limits(with_levels(bounded, own), case.limits))
    return found


class LevelRow(WorldRow, frozen=True, kw_only=True):
    """Results of worlds with the protection levels of their fixes."""

    level: float | None = None
    """Share of the judged fixes that give a horizontal protection level."""
    exceeded: float | None = None
    """Share of those whose horizontal error is larger than it."""
    exceeded_interval: tuple[float, float] | None = None
    """Where that share truly lies, with 99 %, with tags as independent units."""
    exceeded_unwarned: float | None = None
    """Share of the fixes with a level whose error is larger, and which carry no alert."""
    hpl_m: float | None = None
    """Median horizontal level of the fixes that give one."""


def with_levels(world_row: WorldRow, own: Sequence[RunResult]) -> LevelRow:
    """The row with its protection levels, tags as units; none of them where the method gives none."""
    row = LevelRow(**asdict(world_row))
    counts = [world.levels for world in own if world.levels is not None]
    if not counts:
        return row
    levels, exceeded = _total(counts, "levels"), _total(counts, "exceeded")
    row = replace(row, level=levels.sum() / row.fixes)
    if not levels.any():
        return row
    low, high = clustered_interval(exceeded, levels.sum())
    return replace(
        row,
        exceeded=exceeded.sum() / levels.sum(),
        exceeded_interval=(min(low, 1.0), min(high, 1.0)),
        exceeded_unwarned=_total(counts, "unwarned").sum() / levels.sum(),
        hpl_m=float(np.median(np.concatenate([one.hpl_m for one in counts]))),
    )


def _total(counts: Sequence[LevelCounts], name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """A count of every tag of all worlds."""
    return np.concatenate([getattr(one, name) for one in counts])


def biases_of(room: Room | None) -> Biases:
    """Standard deviations of the errors of a room's survey and ranges; its slope is one such deviation."""
    if room is None:
        return Biases()
    ranges = room.ranges
    return Biases(
        survey_std_m=room.axis_std_m,
        constant_std_m=ranges.constant_m / math.sqrt(3.0),
        changing_std_m=ranges.changing_m,
        slope_std_m=ranges.slope_m,
        correlation_s=ranges.correlation_s or math.inf,
        correlation_m=ranges.correlation_m or math.inf,
    )


def bound_cells(cases: Sequence[Case]) -> list[Cell]:
    """One cell for each world of the cases that have a bound."""
    return [
        Cell(
            case.name,
            partial(bound_variance_m2, run, case.biases),
            _BOUND_TAG_S * len(run.trajectories) * run.until_s,
        )
        for case in cases
        if case.biases is not None
        for run in case.runs
    ]


def bound_variance_m2(run: Run, biases: Biases) -> float:
    """Trace of the bound, its mean over all tags of a world and the superframes in which fixes are judged."""
    site, noise = run.site, run.impairments
    off_m = {one.anchor: (one.x_m, one.y_m, one.z_m) for one in noise.anchor_displacements}
    anchors_m = np.array(
        [np.add((one.x_m, one.y_m, one.z_m), off_m.get(one.id, (0.0, 0.0, 0.0))) for one in site.anchors]
    )
    settings = BoundSettings(
        noise.rx_stamp_ps * 1e-12,
        white_fm=noise.oscillator.white_fm,
        random_walk_fm=noise.oscillator.random_walk_fm,
        qa=ROOM_QA_M2PS3,
        slot_s=1.0,  # of no use here: the frames state when they were sent
        speed_std_mps=_BOUND_SPEED_STD_MPS,
        mesh=True,
        height_known=site.tags.height_m is not None,
    )
    means = []
    for received in _received(run):
        times_s = np.array([broadcast.emission_s for broadcast, _ in received])
        path_m = np.array([position_m for _, position_m in received])
        known, senders = _known(site, [broadcast.frame for broadcast, _ in received])
        bound = received_bound(anchors_m, path_m, settings, known, Sendings(senders, times_s), biases)
        means.append(np.trace(bound, axis1=1, axis2=2)[times_s >= run.warmup_s].mean())
    return float(np.mean(means))


def _received(run: Run) -> list[list[tuple[Broadcast, Array]]]:
    """What each tag of a world received, and where it was then."""
    received: list[list[tuple[Broadcast, Array]]] = [[] for _ in run.trajectories]
    for broadcast in world_of(run.site, run.trajectories, run.impairments, run.seed).run(run.until_s):
        for tag, position_m in zip(broadcast.tags.tolist(), broadcast.positions_m, strict=True):
            received[tag].append((broadcast, position_m))
    return received


def _known(site: Site, frames: Sequence[bytes]) -> tuple[Mask, Integers]:
    """Which receptions the frames of a tag tell it of, as ``relayed_receptions``, and the frames' senders."""
    index_of = {one.id: row for row, one in enumerate(site.anchors)}
    beacons = [beacon for frame in frames if isinstance(beacon := decode_cached(frame), Beacon)]
    senders = np.array([index_of[one.anchor] for one in beacons])
    sequences = np.array([one.sequence for one in beacons])
    relays = [[(index_of[entry.anchor], entry.sequence) for entry in one.heard] for one in beacons]
    return relayed_receptions(senders, sequences, relays, len(index_of)), senders


def with_bound(row: WorldRow, worlds: Sequence[RunResult], variances_m2: Sequence[float]) -> WorldRow:
    """The row with the bound of its worlds, and the RMSE over it."""
    sums = np.array(
        [(a.fixes, a.squared_m2, variance) for a, variance in zip(worlds, variances_m2, strict=True)], np.float64
    )
    row = replace(row, bound_m=float(np.sqrt(np.mean(variances_m2))))
    if row.fixes == 0:
        return row
    ratio, ratio_error = jackknife(sums, _ratio)
    passed = None if row.limit is None else ratio <= row.limit
    return replace(row, ratio=ratio, ratio_error=ratio_error, passed=passed)


def _ratio(sums: Array) -> float:
    fixes = sums[:, 0].sum()
    return float(np.sqrt(sums[:, 1].sum() / fixes / sums[:, 2].mean())) if fixes else np.nan
