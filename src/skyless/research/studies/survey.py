"""The study ``survey``: anchors that survey themselves through simulated air, against their bound.

Each run is one site in the air: real machines of anchors, whose receptions of one another become ranges and these a
survey. Delays, errors of pairs, late and missing pairs are drawn for each run and are in the air, not added afterwards.
Several surveys with other facts may use the air of one run.
"""

import math
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import chain
from typing import Any, Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.research.studies.runner import Cell, Limit, Plan, Row, seed_of, with_limits
from skyless.research.studies.surveyed_rooms import (
    HAND_STD_M,
    DrawnRoom,
    Outcome,
    RoomErrors,
    drawn_errors,
    facts_of,
    judged,
    ranges_in_air,
    survey_bound_m,
    survey_layouts,
    tag_error_m,
    taped,
)
from skyless.site.survey.facts import Facts, TapeAdvice
from skyless.site.survey.solve import run_survey

NEAR_M: Final = 0.1
"""Results whose anchors are farther off than this (rms) may be wrong."""
_WRONG_SIGMAS: Final = 4.0
"""They are wrong if they are also farther off than this many of their own standard deviations."""

_RUNS_IN_A_CELL: Final = 5
_LATE_S: Final = 2.0
"""Length of runs with late pairs, whose errors do not average out."""


class Variant(Struct, frozen=True):
    """One survey of a run's air."""

    name: str
    delay_std_m: float
    """Standard deviation of delays that the survey assumes."""
    tapes: int = 0
    """Distances that the survey without them asked for."""
    keeps: bool = False
    """Positions by hand are kept."""
    sketched: bool = False


class Group(Struct, frozen=True):
    """One kind of air, and the surveys that use it."""

    name: str
    variants: tuple[Variant, ...]
    errors: RoomErrors = RoomErrors()
    seconds: float | None = None


_KNOWN: Final = Variant("delays known", 0.0)
_EXACT: Final = (Group("exact", (_KNOWN,)), Group("1 s", (Variant("delays known, 1 s", 0.0),), seconds=1.0))
_DELAYS: Final = Group(
    "delays",
    (
        Variant("delays 15 cm", 0.15),
        Variant("delays 15 cm, a tape", 0.15, tapes=1),
        Variant("delays 15 cm, 3 tapes", 0.15, tapes=3),
        Variant("delays 15 cm, positions kept", 0.15, keeps=True),
    ),
    errors=RoomErrors(delay_std_m=0.15),
)
_PAIRS: Final = Group(
    "pairs", (Variant("pairs 2 cm, delays 7 cm", 0.07),), RoomErrors(delay_std_m=0.07, pair_std_m=0.02)
)
_CLEAN: Final = Group("clean", (Variant("pairs 3 cm", 0.0),), RoomErrors(pair_std_m=0.03), _LATE_S)
_LATE: Final = Group("late", (Variant("10 % late", 0.0),), RoomErrors(pair_std_m=0.03, late_share=0.1), _LATE_S)
_LATE_HALL: Final = Group(
    "late",
    (Variant("10 % late, 25 % missing, delays 7 cm", 0.07),),
    RoomErrors(delay_std_m=0.07, pair_std_m=0.03, late_share=0.1, missing_share=0.25),
    _LATE_S,
)
_VERY_LATE: Final = Group(
    "very late", (Variant("30 % late", 0.0),), RoomErrors(pair_std_m=0.03, late_share=0.3), _LATE_S
)
_VERY_LATE_HALL: Final = Group(
    "very late",
    (Variant("30 % late, 25 % missing", 0.0), Variant("30 % late, 25 % missing, sketch", 0.0, sketched=True)),
    RoomErrors(pair_std_m=0.03, late_share=0.3, missing_share=0.25),
    _LATE_S,
)
GROUPS: Final = {
    "lab": (*_EXACT, _DELAYS, _PAIRS, _CLEAN, _LATE, _VERY_LATE),
    "room": (*_EXACT, _DELAYS, _PAIRS, _CLEAN, _LATE),
    "hall": (*_EXACT, _DELAYS, _PAIRS, _CLEAN, _LATE_HALL, _VERY_LATE_HALL),
}


def limits_of(layout: str, case: str) -> tuple[Limit, ...]:
    """Limits of issue 13 (``docs/survey.md``, "Figures")."""
    of = {"lab": 0, "room": 1, "hall": 2}[layout]
    honest = Limit("nees", 0.9, 1.1)
    found: dict[str, tuple[Limit, ...]] = {
        "delays known": (Limit("ratio", most=1.07), honest),
        "delays known, 1 s": (Limit("ratio", most=1.07), honest),
        "delays 15 cm": (
            (Limit("undetermined", 1.0),) if layout == "lab" else (Limit("rmse_m", most=(0.0, 0.006, 0.0022)[of]),)
        ),
        "delays 15 cm, a tape": (Limit("rmse_m", most=0.0045),) if layout == "lab" else (),
        "delays 15 cm, positions kept": (
            Limit("delay_m", most=(0.016, 0.016, 0.014)[of]),
            Limit("tag_m", most=(0.016, 0.024, 0.013)[of]),
        ),
        "pairs 2 cm, delays 7 cm": (Limit("ratio", most=1.05), honest, Limit("tag_m", most=(0.020, 0.026, 0.012)[of])),
        "pairs 3 cm": (Limit("flagged", most=0.01),),
        "10 % late": (*((Limit("near", 0.8),) if layout == "lab" else ()), Limit("wrong_flagged", 0.9)),
        "30 % late": (Limit("wrong_flagged", 0.9),),
        "10 % late, 25 % missing, delays 7 cm": (
            Limit("near", 0.95),
            Limit("excluded_wrongly", most=0.02),
            Limit("wrong_flagged", 0.9),
        ),
        "30 % late, 25 % missing": (Limit("wrong_flagged", 0.9),),
        "30 % late, 25 % missing, sketch": (Limit("near", 0.8), Limit("wrong_flagged", 0.9)),
    }
    return found.get(case, ())


class SurveyRow(Row, frozen=True, kw_only=True):
    """Results of the surveys of a variant."""

    near: float
    """Share of surveys whose anchors are less than 10 cm off, rms."""
    undetermined: float
    """Share of surveys that say something is not determined: an anchor, or delays against positions."""
    flagged: float
    """Share of surveys that say they are ambiguous or not checked, or leave an anchor without a position."""
    wrong_runs: int
    """Surveys of all anchors that are 10 cm and four of their own standard deviations off."""
    wrong_flagged: float | None
    """Share of these that say they are ambiguous or not checked."""
    found_late: float | None
    """Share of the late pairs that were left out."""
    excluded_wrongly: float | None
    """Share of the other pairs that were left out."""
    delay_m: float | None
    """Error of delays less their mean, rms."""
    tag_m: float | None
    """Systematic error of tags' positions, rms, by the survey."""
    hand_tag_m: float | None
    """The same by positions measured by hand to 2 cm per axis, with delays unknown."""


def cells(plan: Plan) -> list[Cell]:
    """Some runs of one group on one layout each."""
    found = []
    for number, (layout, groups) in enumerate(GROUPS.items()):
        for kind, group in enumerate(groups):
            seconds = plan.seconds if group.seconds is None else min(group.seconds, plan.seconds)
            for first in range(0, plan.worlds, _RUNS_IN_A_CELL):
                worlds = range(first, min(first + _RUNS_IN_A_CELL, plan.worlds))
                seeds = [seed_of(plan.seed, number, kind, world) for world in worlds]
                run = partial(survey_runs, layout, group, seeds, seconds, plan.noise_ps)
                found.append(
                    Cell(f"{layout}, {group.name}", run, len(seeds) * (0.06 * seconds + 0.3 * len(group.variants)))
                )
    return found


def survey_runs(
    layout: str, group: Group, seeds: Sequence[int], seconds: float, noise_ps: float
) -> tuple[Outcome, ...]:
    """Outcomes of each run, one for each variant of the group."""
    rooms = (drawn_errors(survey_layouts()[layout], group.errors, noise_ps, seed) for seed in seeds)
    return tuple(outcome for room in rooms for outcome in _run(room, group, seconds))


def _run(room: DrawnRoom, group: Group, seconds: float) -> Iterator[Outcome]:
    layout, ranges = room.layout, ranges_in_air(room, seconds)
    hand_tag_m = tag_error_m(layout, layout.position_m + room.hand_m, np.zeros(len(layout.anchors)), room.tx_delay_m)
    asked_for = tuple[TapeAdvice, ...]()
    for variant in group.variants:
        facts = _facts(room, group, variant, asked_for[: variant.tapes])
        survey = run_survey(ranges, facts)
        if not variant.tapes and not variant.keeps:
            asked_for = survey.tapes
        bound_m = survey_bound_m(room, ranges, facts, seconds)
        yield judged(room, survey, variant.name, bound_m, hand_tag_m)


def _facts(room: DrawnRoom, group: Group, variant: Variant, tapes: Sequence[TapeAdvice]) -> Facts:
    off_m = room.hand_m if variant.keeps else room.sketch_m if variant.sketched else None
    facts = facts_of(room, None if off_m is None else room.layout.position_m + off_m)
    return replace(
        facts,
        tapes=taped(room, tapes),
        sketch_std_m=HAND_STD_M if variant.keeps else facts.sketch_std_m,
        keep_positions=variant.keeps,
        delay_std_m=variant.delay_std_m,
        pair_std_m=group.errors.pair_std_m,
    )


def rows(plan: Plan, results: Sequence[Any]) -> list[Row]:
    """A row for each layout and variant."""
    found: dict[tuple[str, str], list[Outcome]] = {}
    for outcome in chain.from_iterable(results):
        found.setdefault((outcome.layout, outcome.variant), []).append(outcome)
    return [_row(plan, layout, variant, outcomes) for (layout, variant), outcomes in found.items()]


def _row(plan: Plan, layout: str, variant: str, outcomes: Sequence[Outcome]) -> Row:
    whole = [one for one in outcomes if one.is_determined]
    errors_m = np.array([one.error_m for one in whole], float)
    bounds_m2 = np.array([one.bound_m**2 for one in whole])
    said_m = np.array([one.said_m or 0.0 for one in whole])
    wrong = [whole[row] for row in np.flatnonzero(errors_m > np.maximum(NEAR_M, _WRONG_SIGMAS * said_m)).tolist()]
    squares_m2 = errors_m**2
    rmse_m = _root_mean(errors_m.tolist())
    ratio = error = None
    if rmse_m is not None and bounds_m2.sum() > 0.0:
        ratio = math.sqrt(float(squares_m2.sum() / bounds_m2.sum()))
        spread = float(np.std(squares_m2)) / math.sqrt(len(squares_m2))
        error = spread / (2.0 * rmse_m)
    late, direct = sum(one.late for one in outcomes), sum(one.direct for one in outcomes)
    row = SurveyRow(
        study="survey",
        method=plan.method,
        case=f"{layout}, {variant}",
        series=layout,
        noise_ps=plan.noise_ps,
        runs=len(outcomes),
        fixes=len(outcomes),
        rmse_m=rmse_m,
        rmse_error_m=error,
        p95_m=float(np.quantile(errors_m, 0.95)) if whole else None,
        max_m=float(errors_m.max()) if whole else None,
        said_m=_root_mean([one.said_m for one in whole]),
        nees=float(np.mean(known)) if (known := [one.nees for one in whole if one.nees is not None]) else None,
        bound_m=_root_mean([one.bound_m for one in outcomes]),
        ratio=ratio,
        ratio_error=None if ratio is None or error is None or not rmse_m else ratio * error / rmse_m,
        near=float(np.mean([one.error_m is not None and one.error_m < NEAR_M for one in outcomes])),
        undetermined=float(np.mean([one.is_open for one in outcomes])),
        flagged=float(np.mean([one.is_flagged for one in outcomes])),
        wrong_runs=len(wrong),
        wrong_flagged=float(np.mean([one.is_flagged for one in wrong])) if wrong else None,
        found_late=sum(one.found for one in outcomes) / late if late else None,
        excluded_wrongly=sum(one.excluded_wrongly for one in outcomes) / direct if direct else None,
        delay_m=_root_mean([one.delay_m for one in whole]),
        tag_m=_root_mean([one.tag_m for one in whole]),
        hand_tag_m=_root_mean([one.hand_tag_m for one in outcomes]),
    )
    limits = [] if plan.quick else [one for one in limits_of(layout, variant) if one.figure != "wrong_flagged" or wrong]
    return with_limits(row, limits)


def _root_mean(values: Sequence[float | None]) -> float | None:
    known = [value**2 for value in values if value is not None]
    return math.sqrt(float(np.mean(known))) if known else None
