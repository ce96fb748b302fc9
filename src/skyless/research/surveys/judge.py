"""A survey against the truth: errors after the best rigid alignment, its bound, and what a tag makes of it."""

import math
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.arrays import Array
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M
from skyless.research.surveys.air import DrawnErrors, free_axes
from skyless.research.surveys.layouts import SLOT_S, SurveyLayout
from skyless.site.survey.facts import Facts, PairRanges, Survey
from skyless.site.survey.fit.determined import aligned_covariance
from skyless.site.survey.fit.problem import Problem, jacobian, superimposed

_GRID: Final = np.linspace(0.15, 0.85, 5)
"""Positions of tags, as shares of the site's length and width."""


class Outcome(Struct, frozen=True):
    """One survey, judged. Lengths are rms over anchors, after the best rigid alignment."""

    variant: str
    bound_m: float
    """Cramér–Rao bound of the anchors' distance error."""
    is_determined: bool
    """All anchors; the figures below are None otherwise."""
    is_open: bool
    """Whether it says that something is not determined, even if only delays against positions."""
    is_flagged: bool
    """Whether it says that it is ambiguous, that nothing checks it, or that an anchor is not determined."""
    hand_tag_m: float
    """Error of a tag's position, rms, by positions measured by hand and no knowledge of delays."""
    error_m: float | None = None
    said_m: float | None = None
    nees: float | None = None
    delay_m: float | None = None
    """Error of delays less their mean."""
    tag_m: float | None = None
    """Error of a tag's position, rms, by the survey."""
    late: int = 0
    found: int = 0
    """Late pairs that were left out."""
    direct: int = 0
    excluded_wrongly: int = 0


def survey_bound_m(
    layout: SurveyLayout, ranges: PairRanges, facts: Facts, drawn: DrawnErrors, seconds: float, noise_ps: float
) -> float:
    """Bound of the anchors' distance error, rms, of the pairs in the air, had it been known which are late."""
    n = len(layout.position_m)
    if facts.keep_positions:
        return facts.sketch_std_m * math.sqrt(layout.dimensions)
    superframes = seconds / (n * SLOT_S)
    stamp_m2 = (noise_ps * 1e-12 * SPEED_OF_LIGHT_MPS) ** 2 + TICK_M**2 / 12.0
    index = {anchor: number for number, anchor in enumerate(layout.anchors)}
    direct = [pair for pair in ranges.pairs if (pair.a, pair.b) not in drawn.late]
    first, second = (np.array([index[getattr(pair, end)] for pair in direct]) for end in "ab")
    tape_first, tape_second = (np.array([index[getattr(tape, end)] for tape in facts.tapes], int) for end in "ab")
    problem = Problem(
        is_free=np.tile(free_axes(layout) > 0.0, (n, 1)),
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
        tape_variance_m2=np.array([tape.std_m**2 for tape in facts.tapes]),
    )
    covariance = aligned_covariance(
        problem, jacobian(problem, layout.position_m), layout.position_m, np.ones(n, dtype=bool)
    )
    return math.sqrt(float(np.trace(covariance[: 3 * n, : 3 * n])) / n)


def judged(layout: SurveyLayout, survey: Survey, drawn: DrawnErrors, outcome: Outcome) -> Outcome:
    """The outcome with what came of the survey."""
    is_determined = all(one.determined for one in survey.anchors) and len(survey.anchors) == len(layout.anchors)
    flagged = bool(survey.ambiguities) or survey.unchecked is not None or not is_determined
    excluded = {(pair.a, pair.b) for pair in survey.pairs if pair.excluded}
    used = {(pair.a, pair.b) for pair in survey.pairs}
    outcome = replace(
        outcome,
        is_determined=is_determined,
        is_open=bool(survey.not_determined),
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
        tag_m=tag_error_m(layout, aligned(found_m, layout.position_m, k), delay_m, drawn.delay_m),
    )


def aligned(true_m: Array, found_m: Array, axes: int) -> Array:
    """True positions, shape (n, 3), turned, mirrored and shifted to fit the found ones best; in 2-D on the floor."""
    moved = true_m.copy()
    moved[:, :axes] = superimposed(true_m[:, :axes], found_m[:, :axes], np.ones(len(true_m)))
    return moved


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
