"""The shape of a site, from a fit of all anchors with enough ranges, and sentences on what remains undetermined."""

import math
import re
from collections.abc import Iterable
from typing import Final

import numpy as np
from msgspec import Struct, structs
from scipy.special import chdtri

from skyless.core.arrays import Array, Integers, Mask
from skyless.site.survey import determined as determination
from skyless.site.survey.determined import Links, TapeChoice, best_tapes, mending_tapes
from skyless.site.survey.facts import (
    MIN_CHECKS,
    Facts,
    PairRange,
    SurveyedAnchor,
    TapeAdvice,
    anchors_named,
    are,
    distances_named,
    joined,
)
from skyless.site.survey.frame import (
    Framed,
    Measured,
    Motion,
    align,
    as_array,
    build_problem,
    fitting_points,
    levels,
    own_variance_m2,
    with_free_delays,
)
from skyless.site.survey.problem import (
    MoreRows,
    Problem,
    Solution,
    delay_weights,
    jacobian,
    solve_least_squares,
    start_positions,
)
from skyless.site.survey.robust import OtherFit, RobustFit, fit_robustly
from skyless.site.survey.walk import TagEpochs, fit_with_tag

_MIN_REDUNDANCY: Final = 4  # spare ranges needed to judge the ranges by their residuals
_FALSE_ALARM: Final = 0.01
"""Share of sites whose ranges are as good as stated but whose residuals seem to contradict that."""

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
    """Shape (k,): determined anchors."""
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
    """Fit the shape, first without and then with known points, with the range error that the residuals show."""
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
    # Starts only need the sketch; known points take part in the fit.
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
    """Mask of the determined anchors, and the covariance aligned over them."""
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
    """The largest covariance, aligned over the core, of shapes within 1 σ along the least certain direction.

    Errors bend a shape that is held only by expected delays, and a bent shape seems to be held by its ranges.
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
    """The shape with a tag's rows, for a solution that includes them."""
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
    """Mask of the points that agree with the shape, shape and sketch moved to them, and sentences on the others."""
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
    """Constant error of a pair from the residuals, if they contradict the assumed one; otherwise 0."""
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
    """Measurements in use less the unknowns that they determine; delays known as well as a range are no unknowns."""
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
    """The shape with all tags that fit it, and the other results that the tags do not rule out.

    Its notes say what was used.
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


# Sentences: what a survey does not determine, why, and which distances to measure.

_FLAT: Final = 0.3  # a site is flat if its smallest extent is a smaller share of its largest one
_ONE_AXIS: Final = 0.7
"""Positions change along one direction if at least this share of their squared changes is along it."""

_NOTABLE_BEND_M: Final = 0.01
_BENT_SIGMA: Final = 3.0
"""A shape with at least this standard deviation is also examined when bent, by up to this multiple of it."""

_AXIS_PART: Final = 0.9  # a direction is along an axis if the squared cosine between both is larger
_UNLIKELY_SIGMAS: Final = 3.0


def unlikely_delays(anchors: Iterable[SurveyedAnchor], facts: Facts) -> tuple[str, ...]:
    """Sentences about unexpectedly large delays, a sign of an anchor's wrong height, tape or point."""
    expected_m = math.hypot(facts.delay_std_m, facts.common_delay_std_m if facts.delay_std_m > 0.0 else 0.0)
    return tuple(
        f"the delay of anchor {one.id} is off by {100.0 * one.delay_m:.0f} cm, where ±{100.0 * expected_m:.0f} cm is "
        "expected: is its height, its position or a distance mistyped?"
        for one in anchors
        if one.delay_m is not None and expected_m > 0.0 and abs(one.delay_m) > _UNLIKELY_SIGMAS * expected_m
    )


def anchor_reasons(measured: Measured, links: Links, fitted: Fitted | None) -> dict[int, str]:
    """Why each anchor, by identifier, is not determined."""
    names = measured.anchors
    inside = set() if fitted is None else set(fitted.kept.tolist())
    reasons = {}
    for index, anchor in enumerate(names):
        others = [names[other] for other in np.flatnonzero(links.adjacent[index])]
        group = next((group for group in links.groups if index in group), ())
        if index in inside:
            continue
        if group and len(links.groups) > 1:
            rest = [names[other] for other in range(len(names)) if other not in group]
            own = anchors_named([names[other] for other in group])
            reasons[anchor] = f"the group of {own} has too few ranges to {anchors_named(rest)}"
        elif not others:
            reasons[anchor] = "no range to any other anchor"
        elif len(others) < links.needed[index]:
            reasons[anchor] = f"only {_links_named(others)}; it needs {links.needed[index]}"
        else:
            reasons[anchor] = _LEADS_NOWHERE
    if fitted is not None:
        reasons.update(_loose(fitted))
    return reasons


_LEADS_NOWHERE: Final = "its ranges lead to anchors that are not determined themselves"


def _links_named(others: list[int]) -> str:
    return f"one range, to {others[0]}" if len(others) == 1 else f"{len(others)} ranges, to {joined(others)}"


def _loose(fitted: Fitted) -> dict[int, str]:
    anchors = [anchor for anchor, fixed in zip(fitted.anchors, fitted.core, strict=True) if not fixed]
    if not anchors:
        return {}
    position = fitted.solution.position_m - fitted.solution.position_m.mean(axis=0)
    axes = 2 if levels(fitted.measured) else 3
    extent = np.linalg.svd(position[:, :axes], compute_uv=False)
    vague = f"its ranges give a standard deviation above {determination.max_std_m(fitted.problem):.2f} m"
    if (not fitted.core.any() and len(extent) and extent[-1] < _FLAT * extent[0]) or len(extent) < axes:
        shape = "on one line" if axes == 2 or extent[1] < _FLAT * extent[0] else "nearly in one plane"
        why = f"all anchors are {shape}, and no measurement determines their positions across it"
    elif levels(fitted.measured) and fitted.measured.facts.dimensions == 2:
        why = vague
    else:
        why = f"{vague}; give heights of anchors, if they are known"
    return dict.fromkeys(anchors, why)


def missing_sentences(measured: Measured, links: Links, fitted: Fitted | None) -> tuple[str, ...]:
    """One sentence per reason: which anchors are not determined, why, and which distances to measure."""
    if not measured.anchors:
        return ("no anchor is determined: there are no anchors",)
    reasons = anchor_reasons(measured, links, fitted)
    by_reason: dict[str, list[int]] = {}
    for anchor, reason in reasons.items():
        # Anchors with equally few ranges share a sentence, which then does not say to whom the ranges are.
        by_reason.setdefault(re.sub(r", to .*;", ";", reason), []).append(anchor)
    by_reason = {reasons[anchors[0]] if len(anchors) == 1 else reason: anchors for reason, anchors in by_reason.items()}
    sentences = []
    for reason, anchors in by_reason.items():
        named = f"{anchors_named(anchors)} {are(anchors)} not determined: {_plural(reason, anchors)}"
        sentences.append(named + _distances_to_measure(measured, links, fitted, anchors))
    return tuple(sentences)


def _plural(reason: str, anchors: list[int]) -> str:
    return (
        reason if len(anchors) == 1 else reason.replace("it needs", "each needs").replace("its ranges", "their ranges")
    )


def _distances_to_measure(measured: Measured, links: Links, fitted: Fitted | None, anchors: list[int]) -> str:
    """Which measured distances would determine these anchors."""
    if fitted is None or len(fitted.anchors) < 3:
        return ""
    placed = [index for index, fixed in zip(fitted.kept.tolist(), fitted.core, strict=True) if fixed]
    if not placed:
        chosen = mending_tapes(surveyed_problem(fitted), fitted.solution.position_m, fitted.covariance_m2, ~fitted.core)
        pairs = [(fitted.anchors[item.first], fitted.anchors[item.second]) for item in chosen]
        return f"; {_advised(pairs)}" if pairs else ""
    pairs = []
    for anchor in anchors:
        index = measured.anchors.index(anchor)
        near = [other for other in placed if not links.adjacent[index, other]]
        lacking = int(links.needed[index]) - sum(bool(links.adjacent[index, other]) for other in placed)
        if index in fitted.kept or lacking > len(near):
            return ""
        pairs += [(anchor, measured.anchors[other]) for other in _far_apart(near, placed, fitted, lacking)]
    return f"; {_advised(pairs)}" if pairs else ""


def _far_apart(near: list[int], placed: list[int], fitted: Fitted, count: int) -> list[int]:
    """Choose ``count`` anchors of ``near`` that are far from one another."""
    number = {index: k for k, index in enumerate(fitted.kept.tolist())}
    position = fitted.solution.position_m
    chosen: list[int] = []
    centre = position[[number[index] for index in placed]].mean(axis=0)
    while len(chosen) < count:
        anchors_m = position[[number[index] for index in chosen]] if chosen else centre[None]
        left = [index for index in near if index not in chosen]
        chosen.append(
            max(left, key=lambda index: float(np.linalg.norm(position[number[index]] - anchors_m, axis=1).min()))
        )
    return sorted(chosen)


def _advised(pairs: list[tuple[int, int]]) -> str:
    return f"measure {distances_named(pairs)}"


def held_by_expected_delays(fitted: Fitted, framed: Framed) -> tuple[str, ...]:
    """A sentence if only the expected delays separate delays from positions."""
    surveyed, unknown = with_free_delays(surveyed_problem(fitted))
    if not unknown.any():
        return ()
    position, covariance = _least_held(fitted, surveyed)
    stds = determination.position_stds_m(surveyed, covariance)
    least_m = determination.max_std_m(surveyed)
    if not np.any(fitted.core & (stds > least_m)):
        return ()
    most = 3 * len(position)
    directions = determination.weak_directions(surveyed, covariance, fitted.core, least_m, most)
    if not directions:
        return ()
    delays = np.sqrt(sum((direction.delay_m * direction.std_m) ** 2 for direction in directions))
    chosen = _touched(np.asarray(delays), unknown & fitted.core)
    anchors = [anchor for anchor, is_one in zip(fitted.anchors, chosen, strict=True) if is_one]
    against = _axis(fitted, framed, directions)
    expected = max(_expected_m(fitted.problem, direction.delay_m) for direction in directions)
    mending = mending_tapes(surveyed, position, covariance, fitted.core)
    pairs = [(fitted.anchors[item.first], fitted.anchors[item.second]) for item in mending]
    return (
        f"ranges alone do not separate the antenna delays of {anchors_named(anchors)} from {against}: longer delays "
        f"look like anchors farther apart, and only the usual size of delays (±{expected:.2f} m) limits the error"
        + (f"; {_advised(pairs)}" if pairs else ""),
    )


def _expected_m(problem: Problem, delay_m: Array) -> float:
    """Expected error of one delay in a joint change of delays."""
    along = float(np.sum((delay_weights(problem) @ delay_m) ** 2))
    common = 0.0 if problem.common_delay_m is None else float(np.median(problem.common_delay_m))
    one = math.sqrt(float(np.median(problem.delay_variance_m2)) + common**2)
    return min(one, math.sqrt(float(np.sum(delay_m**2)) / max(along, 1e-12)))


def _least_held(fitted: Fitted, surveyed: Problem) -> tuple[Array, Array]:
    """Possible positions that ranges alone hold least, with their covariance.

    If a shape is held only by expected delays, their errors bend it, and a bent shape seems to be held by its ranges
    although the true one is not. So shapes along the least certain direction are examined, up to 3 σ.
    """
    weight = fitted.used.astype(np.float64)
    start = fitted.solution.position_m

    def covariance_at(position_m: Array) -> tuple[float, Array]:
        rows = jacobian(surveyed, position_m, weight)
        covariance = determination.aligned_covariance(surveyed, rows, position_m, fitted.core)
        return float(determination.position_stds_m(surveyed, covariance)[fitted.core].max()), covariance

    worst, covariance = covariance_at(start)
    least_held = start
    for direction in determination.weak_directions(surveyed, fitted.covariance_m2, fitted.core, _NOTABLE_BEND_M, 1):
        middle = 0.0
        for half, step in ((_BENT_SIGMA, 0.5), (0.5, 0.1)):
            for sigma in np.arange(middle - half, middle + half + 0.01, step).tolist():
                position = start + sigma * direction.std_m * direction.shift_m
                std, found = covariance_at(position)
                if std > worst:
                    worst, covariance, least_held, middle = std, found, position, sigma
    return least_held, covariance


def _touched(size: Array, allowed: Mask) -> Mask:
    limit = determination.TOUCHED * float(size[allowed].max()) if allowed.any() else 0.0
    return np.asarray(allowed & (size > limit))


def _axis(fitted: Fitted, framed: Framed, directions: list[determination.Direction]) -> str:
    """Direction in which the positions change, in words: an axis, or the most parallel pair of anchors."""
    shift = np.concatenate([direction.shift_m @ framed.motion.rotation.T for direction in directions])
    values, vectors = np.linalg.eigh(shift.T @ shift)
    if values[-1] < _ONE_AXIS * values.sum():
        return "the anchors' positions"
    along = vectors[:, -1]
    axis = int(np.argmax(np.abs(along)))
    if along[axis] ** 2 > _AXIS_PART:
        return f"positions along {'xyz'[axis]}"
    first, second = np.triu_indices(int(fitted.core.sum()), 1)
    core = np.flatnonzero(fitted.core)
    apart = framed.position_m[core[first]] - framed.position_m[core[second]]
    best = int(np.argmax(np.abs(apart @ along) / np.maximum(np.linalg.norm(apart, axis=1), 1e-9)))
    return f"positions along the line from {fitted.anchors[core[first[best]]]} to {fitted.anchors[core[second[best]]]}"


def unchecked(fitted: Fitted) -> str | None:
    """A sentence if too few ranges check the result."""
    checks, excluded = redundancy(fitted), int((~fitted.used).sum())
    if checks <= 0:
        return "nothing checks this survey: there are as many unknowns as ranges"
    if checks < MIN_CHECKS:
        return f"too little checks this survey: only {checks} range{'s' if checks > 1 else ''} more than unknowns"
    if excluded > checks:
        return (
            f"{excluded} ranges were left out as late, more than half of the {checks + excluded} that could check "
            "this survey"
        )
    return None


def advised_tapes(fitted: Fitted) -> tuple[TapeAdvice, ...]:
    """The three distances that would help most, each given those before it."""
    problem = fitted.problem
    chosen = best_tapes(problem, fitted.solution.position_m, fitted.covariance_m2, fitted.core)
    return tuple(_advice(fitted, item) for item in chosen)


def _advice(fitted: Fitted, choice: TapeChoice) -> TapeAdvice:
    a, b = sorted((fitted.anchors[choice.first], fitted.anchors[choice.second]))
    return TapeAdvice(a, b, choice.std_before_m, choice.std_after_m)
