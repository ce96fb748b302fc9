"""The shape of a site: the fit of all anchors that have enough ranges, held by known points, and its covariance."""

import math
from typing import Final

import numpy as np
from msgspec import Struct, structs
from scipy.special import chdtri

from skyless.core.arrays import Array, Integers, Mask
from skyless.site.survey._build import Measured, as_array, build_problem, levels, own_variance_m2, with_free_delays
from skyless.site.survey._frame import Motion, align, fitting_points
from skyless.site.survey.facts import PairRange
from skyless.site.survey.fit import determined as determination
from skyless.site.survey.fit.problem import MoreRows, Problem, Solution, jacobian, solve_least_squares
from skyless.site.survey.fit.robust import OtherFit, RobustFit, fit_robustly
from skyless.site.survey.fit.start import start_positions
from skyless.site.survey.result import joined
from skyless.site.survey.walk import TagEpochs, fit_with_tag

_MIN_REDUNDANCY: Final = 4  # ranges more than unknowns from which on residuals show how good the ranges are
_FALSE_ALARM: Final = 0.01
"""Share of sites with ranges as good as stated whose residuals nevertheless seem to contradict that."""

_MAX_ROUNDS: Final = 4

_BENDS_M: Final = 0.03
_BENT_SIGMAS: Final = (-1.0, -0.5, 0.5, 1.0)
"""A shape with at least this standard deviation is also examined when bent by these multiples of it."""


class Fitted(Struct, frozen=True, eq=False):
    """The fit of the ``k`` anchors that have enough ranges, and its covariance."""

    measured: Measured
    kept: Integers
    """Shape (k,): indices of the fitted anchors."""
    robust: RobustFit
    problem: Problem
    pairs: tuple[PairRange, ...]
    solution: Solution
    used: Mask
    """Shape (m,): ranges in use."""
    range_std_m: float
    core: Mask
    """Shape (k,): anchors that are determined."""
    covariance_m2: Array
    """Shape (4 k, 4 k), coordinates and delays, aligned over the core, or over all if no anchor is determined."""
    points_used: tuple[int, ...]
    """Identifiers of the known points that hold the shape."""
    notes: tuple[str, ...]

    @property
    def anchors(self) -> tuple[int, ...]:
        """Identifiers of the fitted anchors."""
        return tuple(self.measured.anchors[index] for index in self.kept)


def fit_shape(measured: Measured, kept: Integers) -> Fitted:
    """The shape, without and then with known points, with the error of ranges that its residuals show."""
    facts = measured.facts
    anchors = tuple(measured.anchors[index] for index in kept)
    sketch = as_array(facts.sketch_m, anchors) if facts.sketch_m else None
    point = as_array(facts.points, anchors)
    range_std_m = facts.pair_std_m
    notes: list[str] = []
    extra: list[Array] = []
    is_held = np.zeros(len(kept), bool)
    if np.isfinite(point[:, :2]).all(axis=1).any():
        free = _round(measured, kept, range_std_m, None, sketch, [])
        is_held, moved, sketch, notes = _held_by_points(free, point, sketch)
        extra = [] if moved is None else [moved]
    held = np.where(is_held[:, None], point, np.nan)
    for _ in range(_MAX_ROUNDS):
        fitted = _round(measured, kept, range_std_m, held if is_held.any() else None, sketch, extra)
        shown = _shown_std_m(fitted)
        if shown <= fitted.range_std_m:
            break
        range_std_m = shown
    used = tuple(anchor for anchor, chosen in zip(anchors, is_held, strict=True) if chosen)
    return structs.replace(fitted, points_used=used, notes=tuple(notes))


def _round(
    measured: Measured,
    kept: Integers,
    range_std_m: float,
    point: Array | None,
    sketch: Array | None,
    extra: list[Array],
) -> Fitted:
    problem, pairs = build_problem(measured, kept, range_std_m, point, sketch)
    # a known point decides more than a sketch; a start needs no more than the latter.
    robust = fit_robustly(problem, [*start_positions(problem, sketch), *extra], range_std_m)
    problem, solution, used = robust.problem, robust.solution, robust.used
    if sketch is not None:
        solution = _in_sketch_frame(problem, solution, robust.weight, sketch)
        robust = structs.replace(robust, solution=solution)
    core, covariance = _determined(measured, kept, problem, solution, used, point)
    return Fitted(
        measured, kept, robust, problem, tuple(pairs), solution, used, robust.range_std_m, core, covariance, (), ()
    )


def _determined(
    measured: Measured, kept: Integers, problem: Problem, solution: Solution, used: Mask, point: Array | None
) -> tuple[Mask, Array]:
    """Which anchors are determined, and the covariance aligned over them."""
    weight = used.astype(np.float64)
    surveyed = structs.replace(problem, coordinate_variance_m2=_without_sketch(measured, kept, point))
    rows = jacobian(surveyed, solution.position_m, weight)
    least = 1 if point is not None else 3 if levels(measured) else 4
    core = determination.determined_core(surveyed, rows, solution.position_m, least)
    aligned_over = core if core.any() else np.ones(len(kept), bool)
    covariance = determination.aligned_covariance(surveyed, rows, solution.position_m, aligned_over)
    for direction in determination.weak_directions(surveyed, covariance, core, 0.02, 4):
        if determination.folds(surveyed, solution.position_m, solution.delay_m, weight, direction):
            core = core & ~direction.anchors
    flat = determination.may_be_flat(
        surveyed, solution.position_m, solution.delay_m, weight, 2 if levels(measured) else 3
    )
    if core.sum() < least or flat:
        core = np.zeros(len(kept), bool)
    if core.any():
        covariance = _largest_nearby(problem, solution.position_m, weight, core)
    return core, covariance


def _largest_nearby(problem: Problem, position_m: Array, weight: Array, core: Mask) -> Array:
    """The covariance, aligned over the core, of the shape or of one within 1 σ along its least certain direction.

    Errors bend a shape that only expected delays hold, and a bent one seems to be held by its ranges.
    """

    def covariance_at(at_m: Array) -> Array:
        rows = jacobian(problem, at_m, weight)
        return determination.aligned_covariance(problem, rows, at_m, core)

    covariance = covariance_at(position_m)
    found = [covariance]
    for direction in determination.weak_directions(problem, covariance, core, _BENDS_M, 1):
        steps = (sigma * direction.std_m * direction.shift_m for sigma in _BENT_SIGMAS)
        found += [covariance_at(position_m + step) for step in steps]
    return max(found, key=lambda one: float(np.trace(one[: 3 * len(core), : 3 * len(core)])))


def with_tag(fitted: Fitted, rows: MoreRows, solution: Solution, used: Mask) -> Fitted:
    """The shape with what a tag received, where that is in the solution."""
    problem = structs.replace(fitted.problem, more=(*fitted.problem.more, rows))
    core, covariance = _determined(fitted.measured, fitted.kept, problem, solution, used, _points(fitted))
    return structs.replace(fitted, problem=problem, solution=solution, used=used, core=core, covariance_m2=covariance)


def _in_sketch_frame(problem: Problem, solution: Solution, weight: Array, sketch: Array) -> Solution:
    known = np.isfinite(sketch[:, :2]).all(axis=1)
    if known.sum() < 2:
        return solution
    axes = 3 if problem.is_free[:, 2].all() and np.isfinite(sketch[known]).all() and known.sum() > 2 else 2
    there = np.where(np.isfinite(sketch), sketch, solution.position_m)
    alignment = align(solution.position_m[known], there[known], 0.3, axes)
    moved = alignment.motion.moved(solution.position_m)
    moved = np.where(problem.is_free, moved, solution.position_m)
    return solve_least_squares(problem, moved, weight)


def _without_sketch(measured: Measured, kept: Integers, point: Array | None) -> Array:
    """Variances of known coordinates, shape (k, 3), infinite for those of the sketch."""
    return build_problem(measured, kept, 0.0, point, None)[0].coordinate_variance_m2


def _held_by_points(
    free: Fitted, point: Array, sketch: Array | None
) -> tuple[Mask, Array | None, Array | None, list[str]]:
    """Points that agree with the shape, the shape and the sketch moved to them, and sentences about the others."""
    facts, anchors, position = free.measured.facts, free.anchors, free.solution.position_m
    is_given: Mask = np.asarray(np.isfinite(point[:, :2]).all(axis=1))
    axes = 2 if levels(free.measured) else 3
    whole = is_given & np.isfinite(point[:, :axes]).all(axis=1)
    tested = np.flatnonzero(whole & free.core)
    if len(tested) < axes:
        return is_given, None, sketch, []
    there = np.where(np.isfinite(point), point, position)[tested]
    columns = (3 * tested[:, None] + np.arange(3)).ravel()
    covariance = free.covariance_m2[np.ix_(columns, columns)]
    fits = fitting_points(position[tested], covariance, there, facts.point_std_m)
    good = tested[fits]
    stds = determination.position_stds_m(free.problem, free.covariance_m2)
    std = math.hypot(facts.point_std_m, float(np.median(stds[tested])))
    motion = align(position[good], there[fits], std, axes).motion
    moved = np.where(free.problem.is_free, motion.moved(position), position)
    notes = []
    error = np.linalg.norm((moved[tested] - there)[:, :axes], axis=1)
    if len(good) == axes == 2 and not np.all(error[fits] <= 3.0 * std * math.sqrt(2.0)):
        by_points, by_ranges = (float(np.linalg.norm(np.diff(item[:2], axis=0))) for item in (there, moved[tested]))
        names = joined(anchors[index] for index in good)
        notes.append(
            f"the points of anchors {names} are {by_points:.2f} m apart, but {by_ranges:.2f} m by the ranges: "
            "has one of them moved, or is one mistyped?"
        )
        return np.zeros(len(point), bool), moved, _moved_sketch(sketch, motion), notes
    for index, chosen, distance in zip(tested, fits, error, strict=True):
        if not chosen:
            notes.append(
                f"the point of anchor {anchors[index]} does not fit the ranges by {distance:.2f} m: "
                "has the anchor moved, or is the point mistyped?"
            )
    held = is_given.copy()
    held[tested[~fits]] = False
    return held, moved, _moved_sketch(sketch, motion), notes


def _moved_sketch(sketch: Array | None, motion: Motion) -> Array | None:
    if sketch is None:
        return None
    flat = np.where(np.isnan(sketch[:, 2:]), 0.0, sketch[:, 2:])
    return np.where(np.isnan(sketch), np.nan, motion.moved(np.concatenate([sketch[:, :2], flat], axis=1)))


def _shown_std_m(fitted: Fitted) -> float:
    """Constant error of a pair that the residuals show, if they contradict the assumed one; 0 otherwise."""
    problem, used = fitted.problem, fitted.used
    full = jacobian(problem, fitted.solution.position_m, used.astype(np.float64))
    everyone = np.ones(len(fitted.kept), bool)
    covariance = determination.aligned_covariance(problem, full, fitted.solution.position_m, everyone)
    rows = full[: len(used)]
    freedom = float(used.sum()) - float(np.einsum("ij,jk,ik->", rows, covariance, rows, optimize=True))
    squares = fitted.solution.residual_m[used] ** 2
    noise = np.array([own_variance_m2(pair) for pair in fitted.pairs])[used]
    if redundancy(fitted) < _MIN_REDUNDANCY or freedom < 1.0:
        return 0.0
    if float(np.sum(squares / problem.variance_m2[used])) <= chdtri(freedom, _FALSE_ALARM):
        return 0.0
    low, high = 0.0, 10.0 * math.sqrt(float(squares.max()))
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.sum(squares / (noise + middle**2)) > freedom else (low, middle)
    return high


def redundancy(fitted: Fitted) -> int:
    """Measurements in use less unknowns that they determine; delays known to a range's error are no unknowns."""
    problem, _ = with_free_delays(surveyed_problem(fitted))
    rows = jacobian(problem, fitted.solution.position_m, fitted.used.astype(np.float64))
    return int(np.any(rows != 0.0, axis=1).sum()) - determination.rank(rows)


def surveyed_problem(fitted: Fitted) -> Problem:
    """The problem without the sketch, which determines nothing."""
    variance = _without_sketch(fitted.measured, fitted.kept, _points(fitted))
    return structs.replace(fitted.problem, coordinate_variance_m2=variance)


def _points(fitted: Fitted) -> Array | None:
    points = {anchor: fitted.measured.facts.points[anchor] for anchor in fitted.points_used}
    return as_array(points, fitted.anchors) if points else None


def with_tags(fitted: Fitted, others: tuple[OtherFit, ...]) -> tuple[Fitted, tuple[OtherFit, ...]]:
    """The shape with all tags that fit it, and those of the other results that they do not rule out.

    Sentences say what was used and what was not.
    """
    ranges_m = {(pair.a, pair.b): pair.range_m for pair in fitted.measured.pairs}
    for epochs in fitted.measured.facts.tags:
        assert isinstance(epochs, TagEpochs)
        used = [fitted.used, *(other.used for other in others)]
        elsewhere = [solve_least_squares(fitted.problem, one.position_m, one.used.astype(np.float64)) for one in others]
        alone = [fitted.solution, *elsewhere]
        joint = fit_with_tag(fitted.problem, fitted.anchors, alone, epochs, ranges_m, used)
        notes = (*fitted.notes, joint.sentence)
        if joint.solution is not None and joint.rows is not None:
            if joint.chosen:
                notes = (*notes, f"{epochs.name} contradicts the result that fits the ranges best: another was chosen")
            fitted = with_tag(fitted, joint.rows, joint.solution, used[joint.chosen])
            others = tuple(others[number - 1] for number in joint.possible if number and number != joint.chosen)
        fitted = structs.replace(fitted, notes=notes)
    return fitted, others
