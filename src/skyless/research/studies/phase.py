"""The study ``phase``: the same worlds with and without phases of the carrier.

Each scene is run twice, with the same stamps: by stamps alone, then with the phases of the tag's own receptions, whose
ratio is the RMSE over that by stamps.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.site import Site
from skyless.research.studies.picture import Case, by_case, world_rows
from skyless.research.studies.room import WALL, past_wall, still, with_levels
from skyless.research.studies.runner import Limit, Plan, Row, with_limits
from skyless.research.studies.worlds import box, walking, worlds
from skyless.sim.evaluation.scenarios import Room, wanderer, wanderers
from skyless.sim.impairments import Body, CarrierModel, Impairments, RangeErrorModel
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.sim.trajectory import Trajectory

_WARMUP_S: Final = 2.5
_STAMPS: Final = ", stamps alone"
_NEVER_WORSE: Final = 1.05
"""Largest ratio of the RMSE with phases to that by stamps alone."""

_HANDS_QA_M2PS3: Final = 3.0
_HANDS: Final = ((20.0, 5e-9), (10.0, 5e-9), (20.0, 1e-9))
"""Beacons of each anchor a second, and random-walk FM of the crystals, 1/√s; plain ones have 5·10⁻⁹."""


class _Scene(Struct, frozen=True):
    name: str
    carrier: CarrierModel
    runs: Callable[..., Any]
    """Worlds, by the function that changes their impairments."""
    limits: tuple[Limit, ...] = ()


def cases(plan: Plan) -> list[Case]:
    """Two cases of each scene."""
    found = []
    for scene in _scenes(plan):
        alone = Case(scene.name + _STAMPS, scene.name, None, scene.runs(change=partial(_with_carrier, None)))
        runs = scene.runs(change=partial(_with_carrier, scene.carrier))
        found += [alone, Case(scene.name, scene.name, None, runs, alone.name, _NEVER_WORSE, scene.limits)]
    return found


def rows(plan: Plan, results: Sequence[Any]) -> Sequence[Row]:
    """A row for each case with its levels."""
    each = cases(plan)
    table = zip(each, world_rows("phase", plan, each, results), by_case(each, results), strict=True)
    return [with_limits(with_levels(row, ran), case.limits) for case, row, ran in table]


def _scenes(plan: Plan) -> list[_Scene]:
    usual, exceeded = CarrierModel(), Limit("exceeded", most=1e-3)
    honest = (Limit("nees", most=1.5), exceeded)
    site = lab_site(plan.noise_ps)
    walled = replace(site, walls=(WALL,))
    relaying = replace(site, schedule=replace(site.schedule, carrier_phase=True))
    room = partial(_room, plan, site)
    stronger = replace(usual, reflections=RangeErrorModel(changing_m=0.008, correlation_m=0.05))
    quiet = replace(usual, reflections=RangeErrorModel())
    lab = partial(walking, plan, paper_lab_site(plan.noise_ps), warmup_s=_WARMUP_S)
    past = partial(past_wall, plan.tags)
    return [
        _Scene("lab, no reflections", quiet, lab, (Limit("rmse_m", most=0.005), *honest)),
        _Scene("the room", usual, room, (Limit("rmse_m", most=0.022), Limit("nees", 0.7, 1.3), exceeded)),
        _Scene("the room, phases relayed", usual, partial(_room, plan, relaying), honest),
        _Scene("at rest", usual, partial(room, paths=partial(still, site, plan.tags)), honest),
        _Scene("reflections of 8 mm", stronger, room, honest),
        _Scene("1 % slips", replace(usual, slips=0.01), room, (Limit("nees", most=1.7), exceeded)),
        _Scene("10 % wild", replace(usual, wild=0.1), room, honest),
        _Scene(
            "past a wall", usual, partial(_room, plan, walled, paths=past, walls_between_anchors=False), (exceeded,)
        ),
        _Scene("a body", usual, partial(room, body=Body()), (exceeded,)),
        *(
            _Scene(f"hands, {rate_hz:g}/s, {walk:g}", usual, partial(_hands, plan, rate_hz, walk), honest)
            for rate_hz, walk in _HANDS
        ),
    ]


def _with_carrier(carrier: CarrierModel | None, impairments: Impairments) -> Impairments:
    return replace(impairments, carrier=carrier)


def _room(plan: Plan, site: Site, **options: Any) -> Any:  # noqa: ANN401 - of ``worlds``
    paths = options.pop("paths", partial(wanderers, site, plan.tags))
    return worlds(plan, site, paths, warmup_s=_WARMUP_S, room=Room(), **options)


def _hands(plan: Plan, rate_hz: float, random_walk_fm: float, **options: Any) -> Any:  # noqa: ANN401 - of ``worlds``
    """Tags in hands, with filters that know how hands move, at this rate of beacons of each anchor."""
    site = lab_site(plan.noise_ps)
    site = replace(
        site,
        noise=replace(site.noise, random_walk_fm=random_walk_fm),
        schedule=replace(site.schedule, rate_hz=rate_hz),
    )
    paths = partial(_hand_paths, site, plan.tags)
    return _room(replace(plan, qa=_HANDS_QA_M2PS3), site, paths=paths, **options)


def _hand_paths(site: Site, tags: int, seed: int) -> list[Trajectory]:
    low_m, high_m = box(site)
    return [wanderer(low_m, high_m, seed, tag, _HANDS_QA_M2PS3) for tag in range(tags)]
