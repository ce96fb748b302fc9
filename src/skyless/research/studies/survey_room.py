"""The study ``survey-room``: tags in a room, with site files from a survey, by hand and from the truth.

A world is one room: its anchors survey themselves through its air, and the same tags then walk there with each file.
The files differ in nothing else: seeds, ways and errors of ranges are the same. Two more cases have no errors but noise
and a tag at rest in the middle of the lab.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, Final

from msgspec import Struct

from skyless.core.site import Site
from skyless.research.studies.picture import Case, case_row
from skyless.research.studies.runner import Cell, Limit, Plan, Row, seed_of, with_limits
from skyless.research.studies.surveyed_rooms import (
    ROOM_RANGES,
    DrawnRoom,
    RoomErrors,
    air_of,
    drawn_room,
    exact_site,
    hand_site,
    kept_site,
    ranges_of,
    site_at,
    survey_layouts,
    surveyed_room,
    true_site,
)
from skyless.research.studies.worlds import Run, RunResult, run_world
from skyless.sim.evaluation.scenarios import wanderers
from skyless.sim.trajectory import Static, Trajectory

TRUTH: Final = "truth"
SURVEYED: Final = "surveyed"
TAPED: Final = "surveyed, a tape"
KEPT: Final = "positions kept"
HAND: Final = "by hand"

_WARMUP_S: Final = 1.5
_SURVEY_S: Final = 20.0
_AT_REST_M: Final = (3.0, 4.0, 0.0)
_DELAY_STD_M: Final = 0.07
_PAIR_STDS_M: Final = (0.0, 0.02, 0.05)
_RUN_S: Final = 0.018
"""Approximate CPU time of a tag for a second of a world."""


class Group(Struct, frozen=True):
    """Rooms of one kind."""

    name: str
    layout: str
    errors: RoomErrors = RoomErrors()
    files: tuple[str, ...] = (TRUTH, SURVEYED)
    """The first one is the reference for the others."""
    at_rest: bool = False
    """Tags at rest, delays known and no errors but noise; the survey knows that."""


class RoomRun(Struct, frozen=True):
    """One world of a group."""

    group: Group
    plan: Plan
    world: int

    @property
    def survey_s(self) -> float:
        """How long its anchors survey themselves."""
        return min(_SURVEY_S, 2.0 * self.plan.seconds)


def groups() -> tuple[Group, ...]:
    """The lab and the room in 3-D, with errors of pairs from none on; then tags at rest in the lab."""
    of_layout = {"lab": (TRUTH, SURVEYED, TAPED, KEPT, HAND), "room": (TRUTH, SURVEYED, KEPT, HAND)}
    walking = [
        Group(f"{layout}, pairs {100.0 * pair_std_m:g} cm", layout, _errors(pair_std_m), files)
        for layout, files in of_layout.items()
        for pair_std_m in _PAIR_STDS_M
    ]
    return (*walking, Group("lab, at rest", "lab", at_rest=True))


def _errors(pair_std_m: float) -> RoomErrors:
    return RoomErrors(_DELAY_STD_M, pair_std_m, ROOM_RANGES)


def limits_of(group: Group, file: str) -> tuple[Limit, ...]:
    """Limits: within 1.2 times what surveyed truth gives in the room, 5 % at rest; honest fixes and levels."""
    if file in {TRUTH, HAND}:
        return ()
    if group.at_rest:
        return (Limit("ratio", most=1.05),)
    honest = (Limit("nees", most=1.3), Limit("level", 0.99), Limit("exceeded", most=1e-4))
    is_room = group.errors.pair_std_m == 0.0  # of the scenario room
    return (Limit("ratio", most=1.2), *honest) if is_room else honest


def cells(plan: Plan) -> list[Cell]:
    """One cell for each world."""
    runs = [RoomRun(group, plan, world) for group in groups() for world in range(plan.worlds)]
    return [Cell(run.group.name, partial(room_results, run), _weight_s(run)) for run in runs]


def _weight_s(run: RoomRun) -> float:
    return run.survey_s * 0.06 + len(run.group.files) * run.plan.tags * (run.plan.seconds + _WARMUP_S) * _RUN_S


def room_results(run: RoomRun) -> tuple[RunResult, ...]:
    """Results of the tags with each file of a room."""
    plan, seed = run.plan, seed_of(run.plan.seed, run.world)
    room = drawn_room(survey_layouts()[run.group.layout], run.group.errors, plan.noise_ps, seed)
    paths = _paths(run, room)
    return tuple(
        run_world(
            Run(
                site=site,
                trajectories=paths,
                impairments=air_of(room, site),
                seed=room.seed,
                method=plan.method,
                warmup_s=_WARMUP_S,
                until_s=_WARMUP_S + plan.seconds,
            )
        )
        for site in _files(run, room)
    )


def _paths(run: RoomRun, room: DrawnRoom) -> tuple[Trajectory, ...]:
    if run.group.at_rest:
        return (Static(*_AT_REST_M),) * run.plan.tags
    return tuple(wanderers(site_at(room.layout, room.layout.position_m, run.plan.noise_ps), run.plan.tags, room.seed))


def _files(run: RoomRun, room: DrawnRoom) -> list[Site]:
    ranges = ranges_of(room, run.survey_s)
    if run.group.at_rest:
        return [exact_site(room), surveyed_room(room, ranges, is_exact=True)]
    made = {
        TRUTH: lambda: true_site(room),
        SURVEYED: lambda: surveyed_room(room, ranges),
        TAPED: lambda: surveyed_room(room, ranges, with_tape=True),
        KEPT: lambda: kept_site(room, ranges),
        HAND: lambda: hand_site(room),
    }
    return [made[file]() for file in run.group.files]


def rows(plan: Plan, results: Sequence[Any]) -> Sequence[Row]:
    """A row for each group and file; the ratio is that to the truth's RMSE in the same worlds."""
    found = []
    for number, group in enumerate(groups()):
        worlds: Sequence[tuple[RunResult, ...]] = results[number * plan.worlds : (number + 1) * plan.worlds]
        truth = [world[0] for world in worlds]
        for column, file in enumerate(group.files):
            own = [world[column] for world in worlds]
            limits = () if plan.quick else limits_of(group, file)
            case = Case(f"{group.name}, {file}", group.name, None, (), of=None if file == TRUTH else TRUTH)
            row = case_row("survey-room", plan, case, own, None if file == TRUTH else truth)
            found.append(with_limits(row, limits))
    return found
