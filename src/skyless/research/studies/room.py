"""The study ``room``: a method judged where the errors of real rooms are, and where one thing more is wrong.

The room is the lab with anchors, ranges and motions as in ``sim/evaluation/scenarios.py``. Each other case changes one
thing in it. The worlds do not depend on the method. ``CONDITIONS`` has further cases, most of them in the paper's lab.

Cases whose errors of survey and ranges are all that is wrong, and whose tags accelerate at random, have a Cramér–Rao
bound: that of all receptions that a tag's beacons state, counted as known when they happened, for errors with the
variances with which the worlds draw them, whatever a site file states. That tags are also held in the room by a spring
and damping is left out, as no receiver knows it.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np
from msgspec.structs import replace

from skyless.core.site import AnchorSite, Site, TagsSite, WallSite
from skyless.research.studies import lab
from skyless.research.studies.picture import Case, world_cells, world_rows
from skyless.research.studies.runner import Cell, Limit, Plan, Row, seed_of
from skyless.research.studies.worlds import Run, anchor_of, box, walking, worlds
from skyless.research.uncertainty import Biases
from skyless.sim.evaluation.scenarios import Room, wanderer, wanderers
from skyless.sim.impairments import AnchorBias, Body, CarrierModel, RangeErrorModel, WarmUp
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.sim.motion_sensor import MotionErrors
from skyless.sim.trajectory import Static, Trajectory, Waypoints

BASE: Final = "the room"
AIR: Final = "unbiased air"
_WARMUP_S: Final = 1.5

_BOUND_RATIO: Final = 1.15
"""Largest ratio of the RMSE to the Cramér–Rao bound in the room itself."""

_LATER_RATIO: Final = 1.2
"""Largest ratio of the RMSE of tags after a long rest to their RMSE at first."""

_SHARE: Final = 0.25
"""Worlds of each other case, as a share of those of the room."""

_CHANGING_M: Final = 0.029
"""The standard deviation of constants that are uniform within 5 cm."""

_HALL_M: Final = (12.0, 16.0)
_ROOM_3D_M: Final = (8.0, 6.0)
_HEIGHTS_M: Final = (0.2, 3.0)
"""Heights of neighbouring anchors in the 3-D room."""
_STAIRWELL_M: Final = (4.0, 6.0)
_STAIRWELL_HEIGHTS_M: Final = (0.2, 3.8, 1.4, 5.0, 0.8, 4.4, 2.0, 5.2)
"""Heights of its anchors, in their order around the walls."""
_LINE_M: Final = (10.0, 0.1)
"""Length of the row of anchors along a wall, and by how much every second one stands off it."""
_BESIDE_M: Final = (np.array((0.5, 1.0, 0.0)), np.array((9.5, 5.0, 0.0)))
"""Corners of the box in which tags wander beside that row."""

WALL: Final = WallSite(4.0, 3.0, 4.0, 5.0, delay_m=0.25)
"""Between the tags that walk past and three of the anchors, low enough for these to hear the others over it."""
_PAST_WALL_X_M: Final = (3.4, 3.7)
_PAST_WALL_Y_M: Final = (0.3, 7.7)

_SMALL_M: Final = (0.1, 0.4)
_LARGE_M: Final = (0.5, 2.0)
"""Ranges from which each late anchor's delay is drawn."""
_LATE_S: Final = (_WARMUP_S + 3.0, _WARMUP_S + 9.0)

_CRYSTALS: Final = ((1.0, 20.0), (-1.0, 20.0), (2.0, 20.0), (-2.0, 20.0), (5.0, 60.0))
"""Final change of the tags' crystals in ppm, and its time constant in s."""

_POWER_CUT_PPM: Final = (0.5, 3.0)
_POWER_CUT_TAU_S: Final = 60.0
"""Change of each anchor's crystal from cold: its magnitude is drawn from this range, its sign is random."""
_DRAUGHTS_PPMPS: Final = ((0.01, 0.03), (0.03, 0.1))
"""Ranges of the change of each anchor's frequency in a second."""
_DRAUGHT_TAU_S: Final = 1e4
"""Long enough for a warm-up to be a straight line in a study."""

_FIELDS_M: Final = ((0.05, 0.075), (0.10, 0.12))
"""Standard deviations of multipath, and the largest RMSE with each."""
_FIELD_LENGTH_M: Final = 0.1
"""Distance over which the correlation of multipath falls to 1/e."""

_CREEP_MPS: Final = 0.05
_CREEPS_S: Final = (5.0, 20.0, 60.0)

_LONG_WORLDS: Final = 2
"""Number of worlds in cases whose worlds last for minutes."""
_REST_SPANS: Final = 8
_WALK_SPANS: Final = 4
"""Tags at rest: spans of rest, of which the last is judged, and of walking before. A span is what other cases judge."""

TURNS_MPS2: Final = (3.0, 6.0, 10.0, 30.0)
_TURNING_MPS: Final = 3.0
_JUDGED_TURN_MPS2: Final = 10.0

_PHASE_WARMUP_S: Final = 2.5
_PHASE_RATIO: Final = 1.05
"""Largest ratio of the RMSE with phases to that by stamps alone."""
_LOCKS: Final = (*product(("walking", "hands"), (400.0, 100.0), (1e-9, 5e-9)), ("hands", 60.0, 5e-9))
"""Motion, beacons of all anchors a second, random-walk FM of the crystals in 1/√s; plain ones have 5·10⁻⁹."""

_LATE_KEY: Final = 23
_PATH_KEY: Final = 29
_CRYSTAL_KEY: Final = 31
"""Keys of streams of random numbers, beside those of the worlds."""

Paths = Callable[[int], Sequence[Trajectory]]


def cases(plan: Plan) -> list[Case]:
    """The cases of the plan's conditions."""
    return CONDITIONS[plan.conditions](plan)


def _usual(plan: Plan) -> list[Case]:
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
    """``bounded``: errors of survey and ranges are the only ones, so there is a bound."""
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
    stairwell = _site_3d(plan.noise_ps, "stairwell", _STAIRWELL_M, _STAIRWELL_HEIGHTS_M)
    usual = (
        Limit("rmse_m", most=0.030),
        Limit("nees", 0.7, 1.3),
        Limit("level", 0.99),
        _exceeded(1e-4),
        Limit("hpl_m", most=0.30),
    )
    return [
        _case(plan, BASE, "rooms", *usual, Limit("ratio", most=_BOUND_RATIO), bounded=True),
        _case(plan, AIR, "rooms", Limit("rmse_m", most=0.019), room=None, bounded=True),
        _case(plan, "hall, 8 anchors", "rooms", *hall, site=hall_site(plan.noise_ps), bounded=True),
        *(
            _case(plan, name, "rooms", Limit("rmse_m", most=most_m), site=site, bounded=True)
            for name, most_m, site in (
                ("3-D room, 8 anchors", 0.050, room_3d_site(plan.noise_ps)),
                ("stairwell in 3-D, 8 anchors", 0.038, stairwell),
            )
        ),
        _case(
            plan,
            "anchors in a line",
            "rooms",
            *(Limit("level", most=0.0), _exceeded(0.0)),
            site=line_site(plan.noise_ps),
            paths=lambda seed: [wanderer(*_BESIDE_M, seed, tag) for tag in range(plan.tags)],
        ),
    ]


def _rests(plan: Plan) -> list[Case]:
    """Tags at rest: judged at first, and again after a long rest."""
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
        found += [first, replace(later, of=name, limits=(*limits, Limit("ratio", most=_LATER_RATIO)))]
    return found


def still(site: Site, tags: int, seed: int) -> Sequence[Trajectory]:
    """Tags at rest where those that wander begin."""
    return [Static(*path.position(0.0).tolist()) for path in wanderers(site, tags, seed)]


def _errors(plan: Plan) -> list[Case]:
    """Constants of the ranges, then anchors farther off than the survey accounts for."""
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
    wall = (Limit("rmse_m", most=0.05), Limit("nees", most=3.0), _exceeded(1e-3))
    body = (Limit("rmse_m", most=0.09), Limit("nees", most=3.0), _exceeded(1e-3))
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
    """Another anchor in each world, whose range error grows from the start of the judging and then ends."""
    anchor = anchor_of(lab_site(plan.noise_ps), number).id
    return (AnchorBias(anchor, 0.0, from_s=_WARMUP_S, to_s=_WARMUP_S + creep_s, creep_mps=_CREEP_MPS),)


def late_anchors(
    plan: Plan, count: int, span_m: tuple[float, float], from_s: float, to_s: float, number: int
) -> tuple[AnchorBias, ...]:
    """Other anchors in each world; the pairs are among the triples, late by the same amounts."""
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
        replace(case, of=BASE, limits=(Limit("ratio", most=1.3),))
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
    """A drift of each anchor's crystal with its own amount and sign, from before the tags are switched on."""
    anchors = lab_site(plan.noise_ps).anchors
    draw = np.random.default_rng(seed_of(plan.seed, number, _CRYSTAL_KEY))
    gains_ppm = draw.uniform(low_ppm, high_ppm, len(anchors)) * draw.choice((-1.0, 1.0), len(anchors))
    return tuple(WarmUp(ppm, tau_s, 0.0, one.id) for one, ppm in zip(anchors, gains_ppm.tolist(), strict=True))


def _turns(plan: Plan) -> list[Case]:
    found = []
    for turn in TURNS_MPS2:
        name = f"turns of {turn:g} m/s² at {_TURNING_MPS:g} m/s"
        limits = (_exceeded(1e-3),) if turn == _JUDGED_TURN_MPS2 else ()
        found.append(_case(plan, name, "turns", *limits, paths=partial(turning, plan, turn)))
    return found


def turning(plan: Plan, acceleration_mps2: float, seed: int) -> Sequence[Trajectory]:
    """Tags that go round and round the lab; all accelerations have the same rounds."""
    draw, (low_m, high_m) = np.random.default_rng(seed_of(seed, _PATH_KEY)), box(lab_site(plan.noise_ps))
    return [lab.laps(draw, low_m, high_m, _TURNING_MPS, acceleration_mps2) for _ in range(plan.tags)]


def _losses(plan: Plan) -> list[Case]:
    """Losses in the paper's lab, and in unbiased air with a bound."""
    air = [
        _case(plan, f"{100 * share:.0f} % lost, {AIR}", "lost in unbiased air", room=None, loss=share, bounded=True)
        for share in lab.MAX_RATIOS
    ]
    return [*lab.loss_cases(plan), *air]


def _phases(plan: Plan) -> list[Case]:
    """Scenes without and with phases of the carrier: the same stamps, then the phases of the tag's own receptions."""
    exceeded = _exceeded(1e-3)
    honest = (Limit("nees", most=1.5), exceeded)
    in_site, usual, quiet = lab_site(plan.noise_ps), CarrierModel(), CarrierModel(reflections=RangeErrorModel())
    stronger = replace(usual, reflections=RangeErrorModel(changing_m=0.008, correlation_m=0.05))
    wander = partial(wanderers, in_site, plan.tags)
    in_room = partial(worlds, plan, in_site, wander, room=Room())
    in_lab = partial(walking, plan, paper_lab_site(plan.noise_ps))
    walled = replace(in_site, walls=(WALL,))
    past = partial(worlds, plan, walled, partial(past_wall, plan.tags), room=Room(), walls_between_anchors=False)
    sensed = partial(_locking, plan, "hands", 100.0, 5e-9, sensor=MotionErrors())
    scenes: list[tuple[str, CarrierModel, Callable[..., tuple[Run, ...]], tuple[Limit, ...]]] = [
        ("lab, no reflections", quiet, in_lab, (Limit("rmse_m", most=0.005), *honest)),
        (BASE, usual, in_room, (Limit("rmse_m", most=0.022), Limit("nees", 0.7, 1.3), exceeded)),
        ("at rest", usual, partial(worlds, plan, in_site, partial(still, in_site, plan.tags), room=Room()), honest),
        ("reflections of 8 mm", stronger, in_room, honest),
        ("1 % slips", replace(usual, slips=0.01), in_room, (Limit("nees", most=1.7), exceeded)),
        ("10 % wild", replace(usual, wild=0.1), in_room, honest),
        ("past a wall", usual, past, (exceeded,)),
        ("a body", usual, partial(in_room, body=Body()), (exceeded,)),
        *((f"{one[0]}, {one[1]:g}/s, {one[2]:g}", usual, partial(_locking, plan, *one), honest) for one in _LOCKS),
        ("hands, 100/s, 5e-09, motion sensor", usual, sensed, honest),
    ]
    found, never_worse = [], Limit("ratio", most=_PHASE_RATIO)
    for name, carrier, runs_of, limits in scenes:
        stamps, phases = (
            runs_of(warmup_s=_PHASE_WARMUP_S, change=partial(replace, carrier=one)) for one in (None, carrier)
        )
        alone = f"{name}, stamps alone"
        found += [Case(alone, name, None, stamps), Case(name, name, None, phases, alone, (*limits, never_worse))]
    return found


def _locking(plan: Plan, motion: str, rate_hz: float, random_walk_fm: float, **options: Any) -> tuple[Run, ...]:  # noqa: ANN401
    """Tags that walk or are in hands, at this rate of beacons of all anchors, which relay phases."""
    site = lab_site(plan.noise_ps)
    schedule = replace(site.schedule, rate_hz=rate_hz / len(site.anchors), carrier_phase=True)
    site = replace(site, noise=replace(site.noise, random_walk_fm=random_walk_fm), schedule=schedule)

    def paths(seed: int) -> list[Trajectory]:
        if motion == "walking":
            return wanderers(site, plan.tags, seed)
        return [wanderer(*box(site), seed, tag, qa_m2ps3=3.0) for tag in range(plan.tags)]

    return worlds(plan, site, paths, room=Room(), **options)


CONDITIONS: Final[dict[str, Callable[[Plan], list[Case]]]] = {
    "usual": _usual,
    "loss": _losses,
    "nlos": lab.nlos_cases,
    "motion": lab.motion_cases,
    "sync": lab.sync_cases,
    "phase": _phases,
    "scale": lab.scale_cases,
}
"""The cases of the study by ``--conditions``."""


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


def _site_3d(noise_ps: float, name: str, floor_m: tuple[float, float], heights_m: Sequence[float]) -> Site:
    anchors = tuple(
        AnchorSite(id=k, x_m=x, y_m=y, z_m=z_m)
        for k, ((x, y), z_m) in enumerate(zip(_around(*floor_m), heights_m, strict=True), start=1)
    )
    return replace(lab_site(noise_ps), name=name, anchors=anchors, tags=TagsSite())


def line_site(noise_ps: float) -> Site:
    """Six anchors along one wall, every second one a little off it: ranges do not show on which side tags are."""
    (length_m, off_m), lab = _LINE_M, lab_site(noise_ps)
    places = enumerate(np.linspace(0.0, length_m, len(lab.anchors)).tolist())
    anchors = tuple(AnchorSite(id=k + 1, x_m=x_m, y_m=off_m * (k % 2)) for k, x_m in places)
    return replace(lab, name="line", anchors=anchors)


def _around(x_m: float, y_m: float) -> list[tuple[float, float]]:
    along_x, along_y = (0.0, 0.5, 1.0, 1.0, 1.0, 0.5, 0.0, 0.0), (0.0, 0.0, 0.0, 0.5, 1.0, 1.0, 1.0, 0.5)
    return [(x_m * a, y_m * b) for a, b in zip(along_x, along_y, strict=True)]


def cells(plan: Plan) -> list[Cell]:
    """The worlds of all cases, then their bounds where there are some."""
    return world_cells(cases(plan))


def rows(plan: Plan, results: Sequence[Any]) -> Sequence[Row]:
    """A row for each case; the results stand in the order of ``cells``."""
    return world_rows("room", plan, cases(plan), results)


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
