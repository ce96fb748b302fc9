"""The study ``survey``: anchors that survey themselves through simulated air, against their bound.

Each run is one site in the air: real machines of anchors, whose receptions of one another become ranges and these a
survey. Delays, errors of pairs, late and missing pairs are drawn for each run and are in the air, not added afterwards.
Several surveys with other facts may use the air of one run.
"""

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_M
from skyless.evaluation.anchor_stamps import stamps_of
from skyless.kernels.arrays import Array
from skyless.simulation.channel import ChannelModel
from skyless.simulation.impairments import DelayError, PairError, lab_impairments
from skyless.site.model import EXACT, AnchorSite, ScheduleSite, Site
from skyless.studies.plan import Cell, Limit, Plan, Row, seed_of, with_limits
from skyless.studies.survey_layouts import SLOT_S, SurveyLayout, survey_layouts
from skyless.survey.facts import Facts, Point, Tape
from skyless.survey.fit.determined import aligned_covariance, jacobian
from skyless.survey.fit.problem import Problem
from skyless.survey.ranges import PairRanges
from skyless.survey.result import Survey
from skyless.survey.solve import run_survey

HAND_STD_M: Final = 0.02
"""Of positions measured by hand, per axis."""
TAPE_STD_M: Final = 0.005
NEAR_M: Final = 0.1
"""A result whose anchors are farther off (rms) is wrong."""
_WRONG_SIGMAS: Final = 4.0
"""It should say so, if it is also farther off than this many of its own standard deviations."""

_RUNS_IN_A_CELL: Final = 5
_LATE_M: Final = (0.2, 1.0)
_LATE_S: Final = 2.0
"""Length of runs with late pairs, whose errors do not average out."""
_SENSITIVITY_DBM: Final = -105.0
"""All anchors receive one another."""
_SKETCH_STD_M: Final = 0.3
_GRID: Final = np.linspace(0.15, 0.85, 5)
"""Positions of tags, as shares of the site's length and width."""


class Variant(Struct, frozen=True):
    """One survey of a run's air."""

    name: str
    delay_std_m: float
    """What the survey expects."""
    tapes: int = 0
    """Distances that the survey without them asked for."""
    keeps: bool = False
    """Positions by hand are kept."""
    sketched: bool = False


class Group(Struct, frozen=True):
    """One kind of air, and the surveys that use it."""

    name: str
    variants: tuple[Variant, ...]
    delay_std_m: float = 0.0
    """With which delays are drawn."""
    pair_std_m: float = 0.0
    late_share: float = 0.0
    missing_share: float = 0.0
    seconds: float | None = None


_KNOWN: Final = Variant("delays known", 0.0)
_EXACT: Final = (
    Group("exact", (_KNOWN,)),
    Group("1 s", (Variant("delays known, 1 s", 0.0),), seconds=1.0),
)
_DELAYS: Final = Group(
    "delays",
    (
        Variant("delays 15 cm", 0.15),
        Variant("delays 15 cm, a tape", 0.15, tapes=1),
        Variant("delays 15 cm, 3 tapes", 0.15, tapes=3),
        Variant("delays 15 cm, positions kept", 0.15, keeps=True),
    ),
    delay_std_m=0.15,
)
_PAIRS: Final = Group("pairs", (Variant("pairs 2 cm, delays 7 cm", 0.07),), delay_std_m=0.07, pair_std_m=0.02)
_CLEAN: Final = Group("clean", (Variant("pairs 3 cm", 0.0),), pair_std_m=0.03, seconds=_LATE_S)
_LATE: Final = Group("late", (Variant("10 % late", 0.0),), pair_std_m=0.03, late_share=0.1, seconds=_LATE_S)
_LATE_HALL: Final = Group(
    "late",
    (Variant("10 % late, 25 % missing, delays 7 cm", 0.07),),
    delay_std_m=0.07,
    pair_std_m=0.03,
    late_share=0.1,
    missing_share=0.25,
    seconds=_LATE_S,
)
_VERY_LATE: Final = Group("very late", (Variant("30 % late", 0.0),), pair_std_m=0.03, late_share=0.3, seconds=_LATE_S)
_VERY_LATE_HALL: Final = Group(
    "very late",
    (Variant("30 % late, 25 % missing", 0.0), Variant("30 % late, 25 % missing, sketch", 0.0, sketched=True)),
    pair_std_m=0.03,
    late_share=0.3,
    missing_share=0.25,
    seconds=_LATE_S,
)
_GROUPS: Final = {
    "lab": (*_EXACT, _DELAYS, _PAIRS, _CLEAN, _LATE, _VERY_LATE),
    "room": (*_EXACT, _DELAYS, _PAIRS, _CLEAN, _LATE),
    "hall": (*_EXACT, _DELAYS, _PAIRS, _CLEAN, _LATE_HALL, _VERY_LATE_HALL),
}


def _limits(layout: str, case: str) -> tuple[Limit, ...]:
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
        "pairs 2 cm, delays 7 cm": (
            Limit("ratio", most=1.05),
            honest,
            Limit("tag_m", most=(0.020, 0.026, 0.012)[of]),
        ),
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


class SurveyRuns(Struct, frozen=True):
    """Runs of one group on one layout."""

    layout: str
    group: Group
    seeds: tuple[int, ...]
    seconds: float
    noise_ps: float


class Outcome(Struct, frozen=True):
    """One survey, judged. Lengths are rms over anchors, after the best rigid alignment."""

    variant: str
    bound_m: float
    """Cramér–Rao bound of the anchors' distance error."""
    is_determined: bool
    """All anchors; the figures below are None otherwise."""
    is_flagged: bool
    """Whether it says that it is ambiguous, that nothing checks it, or that an anchor is not determined."""
    hand_tag_m: float
    """Error of a tag's position, rms, by positions measured by hand and no knowledge of delays."""
    error_m: float | None = None
    said_m: float | None = None
    nees: float | None = None
    delay_m: float | None = None
    """Of delays less their mean."""
    tag_m: float | None = None
    """As ``hand_tag_m``, by the survey."""
    late: int = 0
    found: int = 0
    """Late pairs that were left out."""
    direct: int = 0
    excluded_wrongly: int = 0


def cells(plan: Plan) -> list[Cell]:
    """Some runs of one group on one layout each."""
    return [Cell(f"{runs.layout}, {runs.group.name}", survey_runs, runs, _weight_s(runs)) for runs in _all_runs(plan)]


def _all_runs(plan: Plan) -> list[SurveyRuns]:
    found = []
    for number, (layout, groups) in enumerate(_GROUPS.items()):
        for kind, group in enumerate(groups):
            seeds = [seed_of(plan.seed, number, kind, world) for world in range(plan.worlds)]
            seconds = plan.seconds if group.seconds is None else min(group.seconds, plan.seconds)
            found += [
                SurveyRuns(layout, group, tuple(seeds[first : first + _RUNS_IN_A_CELL]), seconds, plan.noise_ps)
                for first in range(0, plan.worlds, _RUNS_IN_A_CELL)
            ]
    return found


def _weight_s(runs: SurveyRuns) -> float:
    return len(runs.seeds) * (0.06 * runs.seconds + 0.3 * len(runs.group.variants))


def survey_runs(runs: SurveyRuns) -> tuple[tuple[Outcome, ...], ...]:
    """Outcomes of each run, one for each variant."""
    return tuple(_run(runs, survey_layouts()[runs.layout], seed) for seed in runs.seeds)


class _Drawn(Struct, frozen=True, eq=False):
    """What is wrong with the air of one run."""

    delay_m: Array
    """Shape (n,)."""
    late: frozenset[tuple[int, int]]
    missing: frozenset[tuple[int, int]]
    errors: tuple[PairError, ...]


def _run(runs: SurveyRuns, layout: SurveyLayout, seed: int) -> tuple[Outcome, ...]:
    draw = np.random.default_rng(seed)
    drawn = _drawn(runs.group, layout, draw)
    ranges = _ranges(runs, layout, drawn, int(draw.integers(1 << 60)))
    hand_m = draw.normal(0.0, HAND_STD_M, layout.position_m.shape) * _free(layout)
    sketch_m = draw.normal(0.0, _SKETCH_STD_M, layout.position_m.shape) * _free(layout)
    tape_m = draw.normal(0.0, TAPE_STD_M, 3)
    hand_tag_m = tag_error_m(layout, layout.position_m + hand_m, np.zeros(len(hand_m)), drawn.delay_m)
    outcomes, asked_for = [], tuple[tuple[int, int], ...]()
    for variant in runs.group.variants:
        facts = _facts(layout, runs.group, variant, asked_for[: variant.tapes], tape_m, (hand_m, sketch_m))
        survey = run_survey(ranges, facts)
        if not variant.tapes and not variant.keeps:
            asked_for = tuple((tape.a, tape.b) for tape in survey.tapes)
        bound_m = _bound_m(layout, ranges, facts, runs)
        outcomes.append(_judged(layout, survey, drawn, Outcome(variant.name, bound_m, False, False, hand_tag_m)))
    return tuple(outcomes)


def _free(layout: SurveyLayout) -> Array:
    """Coordinates that are estimated: 1, the others 0."""
    return np.array([1.0, 1.0, 1.0 if layout.dimensions == 3 else 0.0])


def _drawn(group: Group, layout: SurveyLayout, draw: np.random.Generator) -> _Drawn:
    anchors = layout.anchors
    delay_m = draw.normal(0.0, group.delay_std_m, len(anchors)) if group.delay_std_m else np.zeros(len(anchors))
    late, missing, errors = [], [], []
    for index, a in enumerate(anchors):
        for b in anchors[index + 1 :]:
            error_m = draw.normal(0.0, group.pair_std_m) if group.pair_std_m else 0.0
            is_late, is_missing, late_m = draw.random() < group.late_share, draw.random(), draw.uniform(*_LATE_M)
            if is_missing < group.missing_share:
                missing.append((a, b))
                errors.append(PairError(a, b, blocked=True))
                continue
            if is_late:
                late.append((a, b))
            if is_late or error_m:
                errors.append(PairError(a, b, late_m=error_m + (late_m if is_late else 0.0)))
    return _Drawn(delay_m, frozenset(late), frozenset(missing), tuple(errors))


def _ranges(runs: SurveyRuns, layout: SurveyLayout, drawn: _Drawn, seed: int) -> PairRanges:
    """What the anchors of a site in such air receive of one another."""
    anchors = tuple(
        AnchorSite(anchor, x_m, y_m, z_m)
        for anchor, (x_m, y_m, z_m) in zip(layout.anchors, layout.position_m.tolist(), strict=True)
    )
    site = Site(layout.name, 1, 1, anchors, ScheduleSite(slot_s=SLOT_S), accuracy=EXACT)
    delays = tuple(
        DelayError(anchor, float(delay_m / TICK_M), float(delay_m / TICK_M))
        for anchor, delay_m in zip(layout.anchors, drawn.delay_m, strict=True)
    )
    air = replace(
        lab_impairments(runs.noise_ps),
        delay_errors=delays,
        anchor_pair_errors=drawn.errors,
        channel=ChannelModel(sensitivity_dbm=_SENSITIVITY_DBM),
    )
    return stamps_of(site, air, runs.seconds, seed).ranges()


def _facts(
    layout: SurveyLayout,
    group: Group,
    variant: Variant,
    tapes: Sequence[tuple[int, int]],
    tape_m: Array,
    off_m: tuple[Array, Array],
) -> Facts:
    """What a survey is given; ``off_m``: errors of positions by hand and of a sketch."""
    at_m = dict(zip(layout.anchors, layout.position_m, strict=True))
    sketch: dict[int, Point] = {}
    if variant.keeps or variant.sketched:
        rough_m = layout.position_m + (off_m[0] if variant.keeps else off_m[1])
        sketch = {anchor: (x, y, z) for anchor, (x, y, z) in zip(layout.anchors, rough_m.tolist(), strict=True)}
    return Facts(
        dimensions=layout.dimensions,
        heights_m=layout.heights_m,
        tapes=tuple(
            Tape(a, b, float(np.linalg.norm(at_m[a] - at_m[b])) + float(error_m), TAPE_STD_M)
            for (a, b), error_m in zip(tapes, tape_m, strict=False)
        ),
        sketch_m=sketch,
        sketch_std_m=HAND_STD_M if variant.keeps else _SKETCH_STD_M,
        keep_positions=variant.keeps,
        delay_std_m=variant.delay_std_m,
        pair_std_m=group.pair_std_m,
    )


def _bound_m(layout: SurveyLayout, ranges: PairRanges, facts: Facts, runs: SurveyRuns) -> float:
    """Bound of the anchors' distance error, rms, of the pairs in the air, had it been known which are late."""
    n = len(layout.position_m)
    if facts.keep_positions:
        return HAND_STD_M * math.sqrt(layout.dimensions)
    superframes = runs.seconds / (n * SLOT_S)
    stamp_m2 = (runs.noise_ps * 1e-12 * SPEED_OF_LIGHT_MPS) ** 2 + TICK_M**2 / 12.0
    index = {anchor: number for number, anchor in enumerate(layout.anchors)}
    first, second = (np.array([index[getattr(pair, end)] for pair in ranges.pairs]) for end in "ab")
    tape_first, tape_second = (np.array([index[getattr(tape, end)] for tape in facts.tapes], int) for end in "ab")
    problem = Problem(
        is_free=np.tile(_free(layout) > 0.0, (n, 1)),
        first=first,
        second=second,
        range_m=np.zeros(len(first)),
        variance_m2=np.full(len(first), stamp_m2 / (2.0 * superframes) + facts.pair_std_m**2),
        delay_m=np.zeros(n),
        delay_variance_m2=np.full(n, facts.delay_std_m**2 + stamp_m2 / (4.0 * superframes)),
        coordinate_m=layout.position_m,
        coordinate_variance_m2=np.full((n, 3), facts.sketch_std_m**2 if facts.sketch_m else np.inf),
        tape_first=tape_first,
        tape_second=tape_second,
        tape_m=np.zeros(len(tape_first)),
        tape_variance_m2=np.full(len(tape_first), TAPE_STD_M**2),
    )
    covariance = aligned_covariance(
        problem, jacobian(problem, layout.position_m), layout.position_m, np.ones(n, dtype=bool)
    )
    return math.sqrt(float(np.trace(covariance[: 3 * n, : 3 * n])) / n)


def _judged(layout: SurveyLayout, survey: Survey, drawn: _Drawn, outcome: Outcome) -> Outcome:
    """The outcome with what came of the survey."""
    is_determined = all(one.determined for one in survey.anchors) and len(survey.anchors) == len(layout.anchors)
    flagged = bool(survey.ambiguities) or survey.unchecked is not None or not is_determined
    excluded = {(pair.a, pair.b) for pair in survey.pairs if pair.excluded}
    used = {(pair.a, pair.b) for pair in survey.pairs}
    outcome = replace(
        outcome,
        is_determined=is_determined,
        is_flagged=flagged,
        late=len(drawn.late),
        found=len(drawn.late & excluded),
        direct=len(used - drawn.late),
        excluded_wrongly=len(excluded - drawn.late),
    )
    if not is_determined:
        return outcome
    found_m = np.array([(one.x_m, one.y_m, one.z_m) for one in survey.anchors], float)
    delay_m = np.array([one.delay_m or 0.0 for one in survey.anchors])
    true_m = aligned(layout.position_m, found_m, layout.dimensions)
    error_m = found_m - true_m
    k = layout.dimensions
    squares = [
        float(error @ np.linalg.pinv(np.array(one.covariance_m2)[:k, :k], rcond=1e-9, hermitian=True) @ error)
        for one, error in zip(survey.anchors, error_m[:, :k], strict=True)
        if one.covariance_m2 is not None
    ]
    off_m = delay_m - drawn.delay_m
    said_m2 = [k * (one.std_m or 0.0) ** 2 for one in survey.anchors]
    return replace(
        outcome,
        error_m=math.sqrt(float(np.mean(np.sum(error_m**2, axis=1)))),
        said_m=math.sqrt(float(np.mean(said_m2))),
        nees=float(np.mean(squares)) / k if squares else None,
        delay_m=float(np.std(off_m)),
        tag_m=tag_error_m(layout, layout.position_m + _turned_back(error_m, true_m, layout), delay_m, drawn.delay_m),
    )


def aligned(true_m: Array, found_m: Array, axes: int) -> Array:
    """True positions, shape (n, 3), turned, mirrored and shifted to fit the found ones best; in 2-D on the floor."""
    moved = true_m.copy()
    own, other = true_m[:, :axes], found_m[:, :axes]
    u, _, vt = np.linalg.svd((own - own.mean(axis=0)).T @ (other - other.mean(axis=0)))
    moved[:, :axes] = (own - own.mean(axis=0)) @ (u @ vt) + other.mean(axis=0)
    return moved


def _turned_back(error_m: Array, true_m: Array, layout: SurveyLayout) -> Array:
    """Errors in the frame of the layout."""
    k = layout.dimensions
    own, other = true_m[:, :k], layout.position_m[:, :k]
    u, _, vt = np.linalg.svd((own - own.mean(axis=0)).T @ (other - other.mean(axis=0)))
    back = np.zeros_like(error_m)
    back[:, :k] = error_m[:, :k] @ (u @ vt)
    return back


def tag_error_m(layout: SurveyLayout, found_m: Array, delay_m: Array, true_delay_m: Array) -> float:
    """What tags' positions are off without noise, rms over a grid, by positions (n, 3) and delays (n,) of anchors.

    The tag's clock is free; its height is estimated in 3-D.
    """
    low_m, high_m = layout.position_m.min(axis=0), layout.position_m.max(axis=0)
    k, squares = layout.dimensions, []
    for x in _GRID:
        for y in _GRID:
            at_m = low_m + (high_m - low_m) * np.array([x, y, 0.0])
            at_m[2] = layout.tag_height_m
            apart = at_m - layout.position_m
            unit = apart / np.linalg.norm(apart, axis=1)[:, None]
            late_m = np.sum(unit * (found_m - layout.position_m), axis=1) + true_delay_m - delay_m
            design = np.column_stack([unit[:, :k], np.ones(len(unit))])
            squares.append(float(np.sum(np.linalg.lstsq(design, late_m, rcond=None)[0][:k] ** 2)))
    return math.sqrt(float(np.mean(squares)))


def rows(plan: Plan, results: Sequence[Any]) -> list[Row]:
    """A row for each layout and variant."""
    found: dict[tuple[str, str], list[Outcome]] = {}
    for runs, outcomes in zip(_all_runs(plan), results, strict=True):
        for of_run in outcomes:
            for outcome in of_run:
                found.setdefault((runs.layout, outcome.variant), []).append(outcome)
    return [_row(plan, layout, variant, outcomes) for (layout, variant), outcomes in found.items()]


def _row(plan: Plan, layout: str, variant: str, outcomes: Sequence[Outcome]) -> Row:
    whole = [one for one in outcomes if one.is_determined]
    errors_m = np.array([one.error_m for one in whole], float)
    bounds_m2 = np.array([one.bound_m**2 for one in whole])
    wrong = [one for one in whole if _is_wrong(one)]
    squares_m2 = errors_m**2
    rmse_m = _root_mean(errors_m.tolist())
    ratio = error = None
    if rmse_m is not None and bounds_m2.sum() > 0.0:
        ratio = math.sqrt(float(squares_m2.sum() / bounds_m2.sum()))
        spread = float(np.std(squares_m2)) / math.sqrt(len(squares_m2))
        error = spread / (2.0 * rmse_m)
    late, direct = sum(one.late for one in outcomes), sum(one.direct for one in outcomes)
    row = Row(
        study="survey",
        method=plan.method,
        case=f"{layout}, {variant}",
        series=layout,
        x=None,
        mesh=None,
        noise_ps=plan.noise_ps,
        runs=len(outcomes),
        fixes=len(outcomes),
        rmse_m=rmse_m,
        rmse_error_m=error,
        p95_m=float(np.quantile(errors_m, 0.95)) if whole else None,
        max_m=float(errors_m.max()) if whole else None,
        said_m=_root_mean([one.said_m for one in whole]),
        nees=_mean([one.nees for one in whole]),
        bound_m=_root_mean([one.bound_m for one in outcomes]),
        ratio=ratio,
        ratio_error=None if ratio is None or error is None or not rmse_m else ratio * error / rmse_m,
        near=float(np.mean([one.error_m is not None and one.error_m < NEAR_M for one in outcomes])),
        undetermined=1.0 - len(whole) / len(outcomes),
        flagged=float(np.mean([one.is_flagged for one in outcomes])),
        wrong=len(wrong),
        wrong_flagged=float(np.mean([one.is_flagged for one in wrong])) if wrong else None,
        found_late=sum(one.found for one in outcomes) / late if late else None,
        excluded_wrongly=sum(one.excluded_wrongly for one in outcomes) / direct if direct else None,
        delay_m=_root_mean([one.delay_m for one in whole]),
        tag_m=_root_mean([one.tag_m for one in whole]),
        hand_tag_m=_root_mean([one.hand_tag_m for one in outcomes]),
    )
    limits = [] if plan.quick else [one for one in _limits(layout, variant) if one.figure != "wrong_flagged" or wrong]
    return with_limits(row, limits)


def _is_wrong(one: Outcome) -> bool:
    """Whether a result is far off, and farther than it says."""
    return one.error_m is not None and one.error_m > max(NEAR_M, _WRONG_SIGMAS * (one.said_m or 0.0))


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _root_mean(values: Sequence[float | None]) -> float | None:
    known = [value**2 for value in values if value is not None]
    return math.sqrt(float(np.mean(known))) if known else None
