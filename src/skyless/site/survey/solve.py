"""Survey: positions and delays of all anchors from the ranges of their pairs and the user's facts.

Counting comes first: only anchors with enough ranges are fitted. The fit finds a shape, which is moved to its frame
(``shape.py``); sentences say what is not determined, and why.

If positions are given and kept, only delays are estimated, and the positions' errors count as errors of the ranges.
Delays then compensate for a part of the positions' errors: they are farther from the truth than those of a joint fit,
but a tag that uses both is closer to it (``docs/maths.md`` section 9).
"""

import math
import re
from collections.abc import Iterable
from typing import Final

import numpy as np
from msgspec import structs

from skyless.core.arrays import Array, Integers, Mask
from skyless.site.survey.facts import (
    MIN_CHECKS,
    Ambiguity,
    Facts,
    PairRanges,
    Survey,
    SurveyedAnchor,
    SurveyedPair,
    anchors_named,
    are,
    distances_named,
    joined,
)
from skyless.site.survey.fit import (
    TOUCHED,
    Direction,
    Links,
    OtherFit,
    aligned_covariance,
    best_tapes,
    count_links,
    find_ambiguities,
    max_std_m,
    position_stds_m,
    weak_directions,
)
from skyless.site.survey.problem import Problem, adjacency, delay_weights
from skyless.site.survey.shape import (
    Fitted,
    Framed,
    Measured,
    as_array,
    assumed_heights,
    fit_delays,
    fit_shape,
    in_frame,
    levels,
    own_delays,
    redundancy,
    surveyed_problem,
    usable,
    with_free_delays,
    with_tags,
)

_MOVED_M: Final = 0.1  # an anchor that differs less between two results is at the same position
_ELSEWHERE: Final = 0.3
"""An anchor is elsewhere in another result if it moves by more than this share of the largest motion; with less it only
follows the others."""

_SAME_M: Final = 0.5  # two alternative results are the same if their moved anchors are this near to each other
_MAX_NAMED: Final = 3  # anchors whose places are named
_DECIDES: Final = 0.7
"""The shortest of the distances whose difference is at least this share of the largest is the one to measure."""


def run_survey(ranges: PairRanges, facts: Facts) -> Survey:
    """Estimate positions and delays, or say why they are not determined.

    Anchors that are not determined have no figures. Insufficient or contradictory ranges and facts raise no error:
    ``not_determined`` and ``notes`` name them.
    """
    measured = usable(ranges, facts)
    survey = _survey(measured)
    return structs.replace(
        survey,
        notes=(*survey.notes, *_unlikely_delays(survey.anchors, facts)),
        assumed_heights=assumed_heights(measured),
    )


def _survey(measured: Measured) -> Survey:
    links, keeps = _links(measured), measured.facts.keep_positions
    is_placed = [anchor in measured.facts.sketch_m for anchor in measured.anchors]
    kept = np.flatnonzero(is_placed if keeps else links.has_enough)
    fitted_ids = {measured.anchors[index] for index in kept}
    if not len(kept) or not (keeps or any({pair.a, pair.b} <= fitted_ids for pair in measured.pairs)):
        return _nothing(measured, links, None)
    fitted = fit_delays(measured, kept) if keeps else fit_shape(measured, kept)
    fitted, others = with_tags(fitted, () if keeps else find_ambiguities(fitted))
    if not fitted.core.any():
        return _nothing(measured, links, fitted)
    framed, at_m, covariance_m2 = in_frame(fitted), fitted.solution.position_m, fitted.covariance_m2
    return Survey(
        anchors=_anchors(measured, links, fitted, framed),
        pairs=_pairs(measured, fitted),
        range_std_m=fitted.range_std_m,
        redundancy=redundancy(fitted),
        unchecked=_unchecked(fitted),
        not_determined=(
            *_missing_sentences(measured, links, fitted),
            *_silent_sentence(fitted),
            *_held_by_expected_delays(fitted, framed),
        ),
        ambiguities=_ambiguities(fitted, framed, others),
        tapes=() if keeps else tuple(best_tapes(fitted.problem, fitted.anchors, at_m, covariance_m2, fitted.core)[0]),
        frame=framed.sentence,
        gauge=framed.gauge,
        notes=(*measured.notes, *fitted.notes, *framed.notes),
    )


def _links(measured: Measured) -> Links:
    facts, index = measured.facts, {anchor: number for number, anchor in enumerate(measured.anchors)}
    ends = [(index[pair.a], index[pair.b]) for pair in measured.pairs]
    ends += [(index[tape.a], index[tape.b]) for tape in measured.tapes]
    both = np.array(ends, np.int64).reshape(-1, 2)
    unknown = np.full(len(index), facts.dimensions)
    if facts.dimensions == 3 and levels(measured):
        unknown[[index[anchor] for anchor in facts.heights_m]] -= 1
    # A sketch shows which of two positions is the right one.
    unknown[[index[anchor] for anchor in facts.sketch_m]] -= 1
    is_known: Mask = np.asarray(
        np.isfinite(as_array(facts.points, measured.anchors)[:, : facts.dimensions]).all(axis=1)
    )
    least = 3 if levels(measured) else 4
    return count_links(adjacency(len(index), both[:, 0], both[:, 1]), unknown, is_known, least)


def _anchors(measured: Measured, links: Links, fitted: Fitted, framed: Framed) -> tuple[SurveyedAnchor, ...]:
    reasons = _anchor_reasons(measured, links, fitted)
    number = {anchor: k for k, anchor in enumerate(fitted.anchors)}
    stds, silent = position_stds_m(fitted.problem, fitted.covariance_m2), fitted.silent
    if measured.facts.keep_positions:
        stds = np.full(len(number), measured.facts.sketch_std_m)
    covariance_of_delays = fitted.covariance_m2[3 * len(number) :, 3 * len(number) :]
    delays, delay_stds = own_delays(
        measured, fitted.anchors, fitted.problem, fitted.solution.delay_m, covariance_of_delays
    )
    found = []
    for anchor in measured.anchors:
        k = number.get(anchor)
        if k is None or not fitted.core[k]:
            found.append(SurveyedAnchor(anchor, determined=False, reason=reasons[anchor]))
            continue
        x, y, z = framed.position_m[k].tolist()
        found.append(
            SurveyedAnchor(
                anchor,
                determined=True,
                x_m=x,
                y_m=y,
                z_m=z,
                std_m=float(stds[k]),
                covariance_m2=tuple(tuple(row) for row in framed.covariance_m2[k].tolist()),
                delay_m=None if anchor in silent else float(delays[k]),
                delay_std_m=None if anchor in silent else float(delay_stds[k]),
            )
        )
    return tuple(found)


def _pairs(measured: Measured, fitted: Fitted | None) -> tuple[SurveyedPair, ...]:
    number = {} if fitted is None else {(pair.a, pair.b): index for index, pair in enumerate(fitted.pairs)}
    found = []
    for pair in measured.pairs:
        std_m, residual_m, excluded = math.hypot(pair.std_m, measured.facts.pair_std_m), None, False
        if fitted is not None and (index := number.get((pair.a, pair.b))) is not None:
            std_m, excluded = math.sqrt(fitted.problem.variance_m2[index]), not fitted.used[index]
            if fitted.core[fitted.problem.first[index]] and fitted.core[fitted.problem.second[index]]:
                residual_m = float(fitted.solution.residual_m[index])
        found.append(SurveyedPair(pair.a, pair.b, pair.range_m, residual_m, std_m, excluded))
    return tuple(found)


def _ambiguities(fitted: Fitted, framed: Framed, others: tuple[OtherFit, ...]) -> tuple[Ambiguity, ...]:
    """The alternative results, without those that differ only in which ranges came late."""
    found: list[Ambiguity] = []
    for other in others:
        position_m = framed.motion.moved(other.position_m)
        distance_m = np.where(fitted.core, np.linalg.norm(position_m - framed.position_m, axis=1), 0.0)
        if distance_m.max() <= _MOVED_M:
            continue
        elsewhere = np.flatnonzero(distance_m > max(_MOVED_M, _ELSEWHERE * distance_m.max()))
        positions = {fitted.anchors[index]: tuple(position_m[index].tolist()) for index in elsewhere.tolist()}
        same = [one.positions_m for one in found if one.positions_m.keys() == positions.keys()]
        if any(all(math.dist(one[anchor], at_m) < _SAME_M for anchor, at_m in positions.items()) for one in same):
            continue
        sentence = _sentence(fitted, framed, other, position_m, distance_m, elsewhere)
        found.append(Ambiguity(sentence, tuple(positions), positions))
    return tuple(found)


def _sentence(
    fitted: Fitted, framed: Framed, other: OtherFit, position_m: Array, distance_m: Array, elsewhere: Integers
) -> str:
    """Say which anchors are elsewhere, where, by how much the others differ, and which distance decides."""
    here_m, unused = framed.position_m, np.flatnonzero(fitted.used & ~other.used)
    late = [f"{fitted.pairs[index].a}–{fitted.pairs[index].b}" for index in unused]
    case = f"if {joined(late)} came late" if late else "in a mirror image that fits as well"
    if len(elsewhere) > _MAX_NAMED:
        anchors = anchors_named([fitted.anchors[index] for index in elsewhere])
        sentence = f"{case}, {anchors} are elsewhere, by up to {distance_m.max():.2f} m"
    else:
        axes = fitted.measured.facts.dimensions
        places = [
            f"anchor {fitted.anchors[index]} is not at {_place(here_m[index, :axes])} but {distance_m[index]:.2f} m "
            f"away at {_place(position_m[index, :axes])}"
            for index in elsewhere.tolist()
        ]
        rest_m = float(np.delete(distance_m, elsewhere).max(initial=0.0))
        stays = f"by {100.0 * rest_m:.0f} cm at most" if rest_m >= 0.005 else "not at all"
        sentence = f"{case}, {joined(places)}; the other anchors differ {stays}"
    one = int(np.argmax(distance_m))
    rest = np.setdiff1d(np.flatnonzero(fitted.core), elsewhere)
    if not rest.size:
        return sentence
    first_m, second_m = (np.linalg.norm(at_m[rest] - at_m[one], axis=1) for at_m in (here_m, position_m))
    apart_m = np.abs(first_m - second_m)
    longest_m = np.where(apart_m >= _DECIDES * apart_m.max(), np.maximum(first_m, second_m), np.inf)
    best = int(np.argmin(longest_m))
    a, b = sorted((fitted.anchors[one], fitted.anchors[int(rest[best])]))
    return f"{sentence}; the distance {a}–{b} decides: {first_m[best]:.2f} m, or {second_m[best]:.2f} m there"


def _place(position_m: Array) -> str:
    return f"({', '.join(f'{round(value, 2) + 0.0:.2f}' for value in position_m.tolist())})"


def _nothing(measured: Measured, links: Links, fitted: Fitted | None) -> Survey:
    reasons = _anchor_reasons(measured, links, fitted)
    return Survey(
        anchors=tuple(
            SurveyedAnchor(anchor, determined=False, reason=reasons.get(anchor)) for anchor in measured.anchors
        ),
        pairs=_pairs(measured, fitted),
        range_std_m=measured.facts.pair_std_m if fitted is None else fitted.range_std_m,
        unchecked="nothing checks this survey: no anchor is determined",
        not_determined=_missing_sentences(measured, links, fitted),
        frame="no anchor is determined, so there is no frame",
        notes=measured.notes if fitted is None else (*measured.notes, *fitted.notes),
    )


# Sentences: what a survey does not determine, why, and which distances to measure.

_FLAT: Final = 0.3  # a site is flat if its smallest extent is a smaller share of its largest one
_ONE_AXIS: Final = 0.7
"""Positions change along one direction if at least this share of their squared changes is along it."""

_NOTABLE_BEND_M: Final = 0.01
_BENT_SIGMA: Final = 3.0
"""A shape with at least this standard deviation is also examined when bent, by up to this multiple of it."""

_AXIS_PART: Final = 0.9  # a direction is along an axis if the squared cosine between both is larger
_UNLIKELY_SIGMAS: Final = 3.0


def _unlikely_delays(anchors: Iterable[SurveyedAnchor], facts: Facts) -> tuple[str, ...]:
    """Sentences about unexpectedly large delays, a sign of an anchor's wrong height, tape or point."""
    expected_m = math.hypot(facts.delay_std_m, facts.common_delay_std_m if facts.delay_std_m > 0.0 else 0.0)
    return tuple(
        f"the delay of anchor {one.id} is off by {100.0 * one.delay_m:.0f} cm, where ±{100.0 * expected_m:.0f} cm is "
        "expected: is its height, its position or a distance mistyped?"
        for one in anchors
        if one.delay_m is not None and expected_m > 0.0 and abs(one.delay_m) > _UNLIKELY_SIGMAS * expected_m
    )


def _anchor_reasons(measured: Measured, links: Links, fitted: Fitted | None) -> dict[int, str]:
    """Why each anchor, by identifier, is not determined."""
    names = measured.anchors
    inside = set() if fitted is None else set(fitted.kept.tolist())
    if measured.facts.keep_positions:
        return {anchor: "no position is given for it" for index, anchor in enumerate(names) if index not in inside}
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
            few = "one range" if len(others) == 1 else f"{len(others)} ranges"
            reasons[anchor] = f"only {few}, to {joined(others)}; it needs {links.needed[index]}"
        else:
            reasons[anchor] = "its ranges lead to anchors that are not determined themselves"
    if fitted is not None:
        reasons.update(_loose(fitted))
    return reasons


def _loose(fitted: Fitted) -> dict[int, str]:
    anchors = [anchor for anchor, fixed in zip(fitted.anchors, fitted.core, strict=True) if not fixed]
    if not anchors:
        return {}
    position = fitted.solution.position_m - fitted.solution.position_m.mean(axis=0)
    axes = 2 if levels(fitted.measured) else 3
    extent = np.linalg.svd(position[:, :axes], compute_uv=False)
    vague = f"its ranges give a standard deviation above {max_std_m(fitted.problem):.2f} m"
    if (not fitted.core.any() and len(extent) and extent[-1] < _FLAT * extent[0]) or len(extent) < axes:
        shape = "on one line" if axes == 2 or extent[1] < _FLAT * extent[0] else "nearly in one plane"
        why = f"all anchors are {shape}, and no measurement determines their positions across it"
    elif levels(fitted.measured) and fitted.measured.facts.dimensions == 2:
        why = vague
    else:
        why = f"{vague}; give heights of anchors, if they are known"
    return dict.fromkeys(anchors, why)


def _missing_sentences(measured: Measured, links: Links, fitted: Fitted | None) -> tuple[str, ...]:
    """One sentence per reason: which anchors are not determined, why, and which distances to measure."""
    if not measured.anchors:
        return ("no anchor is determined: there are no anchors",)
    reasons = _anchor_reasons(measured, links, fitted)
    by_reason: dict[str, list[int]] = {}
    for anchor, reason in reasons.items():
        # Anchors with equally few ranges share a sentence, which then does not say to whom the ranges are.
        by_reason.setdefault(re.sub(r", to .*;", ";", reason), []).append(anchor)
    by_reason = {reasons[anchors[0]] if len(anchors) == 1 else reason: anchors for reason, anchors in by_reason.items()}
    sentences = []
    for reason, anchors in by_reason.items():
        named = f"{anchors_named(anchors)} {are(anchors)} not determined: {reason}"
        if len(anchors) > 1:
            named = named.replace("it needs", "each needs").replace("its ranges", "their ranges")
        sentences.append(named + _distances_to_measure(measured, links, fitted, anchors))
    return tuple(sentences)


def _silent_sentence(fitted: Fitted) -> tuple[str, ...]:
    if not fitted.silent:
        return ()
    return (f"delays of {anchors_named(fitted.silent)} are not determined: no range to an anchor with a position",)


def _distances_to_measure(measured: Measured, links: Links, fitted: Fitted | None, anchors: list[int]) -> str:
    """Which measured distances would determine these anchors."""
    if fitted is None or len(fitted.anchors) < 3 or measured.facts.keep_positions:
        return ""
    placed = [index for index, fixed in zip(fitted.kept.tolist(), fitted.core, strict=True) if fixed]
    if not placed:
        problem, position_m = surveyed_problem(fitted), fitted.solution.position_m
        return _mending(fitted, problem, position_m, fitted.covariance_m2, ~fitted.core)
    pairs = []
    for anchor in anchors:
        index = measured.anchors.index(anchor)
        near = [other for other in placed if not links.adjacent[index, other]]
        lacking = int(links.needed[index]) - sum(bool(links.adjacent[index, other]) for other in placed)
        if index in fitted.kept or lacking > len(near):
            return ""
        pairs += [(anchor, measured.anchors[other]) for other in _far_apart(near, placed, fitted, lacking)]
    return _advised(pairs)


def _mending(fitted: Fitted, problem: Problem, position_m: Array, covariance_m2: Array, core: Mask) -> str:
    """Advice to measure the distances that would determine all anchors of the core; none if six are not enough."""
    most_m = max_std_m(problem)
    tapes, worst_m = best_tapes(problem, fitted.anchors, position_m, covariance_m2, core, most=6, until_m=most_m)
    return _advised([(tape.a, tape.b) for tape in tapes] if worst_m <= most_m else [])


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
    return f"; measure {distances_named(pairs)}" if pairs else ""


def _held_by_expected_delays(fitted: Fitted, framed: Framed) -> tuple[str, ...]:
    """A sentence if only the expected delays separate delays from positions."""
    surveyed, unknown = with_free_delays(surveyed_problem(fitted))
    if not unknown.any():
        return ()
    position, covariance = _least_held(fitted, surveyed)
    stds = position_stds_m(surveyed, covariance)
    least_m = max_std_m(surveyed)
    if not np.any(fitted.core & (stds > least_m)):
        return ()
    most = 3 * len(position)
    directions = weak_directions(surveyed, covariance, fitted.core, least_m, most)
    if not directions:
        return ()
    delays = np.sqrt(sum((direction.delay_m * direction.std_m) ** 2 for direction in directions))
    allowed = unknown & fitted.core
    chosen = allowed & (delays > TOUCHED * float(np.max(delays, where=allowed, initial=0.0)))
    anchors = [anchor for anchor, is_one in zip(fitted.anchors, chosen, strict=True) if is_one]
    against = _axis(fitted, framed, directions)
    expected = max(_expected_m(fitted.problem, direction.delay_m) for direction in directions)
    return (
        f"ranges alone do not separate the antenna delays of {anchors_named(anchors)} from {against}: longer delays "
        f"look like anchors farther apart, and only the usual size of delays (±{expected:.2f} m) limits the error"
        + _mending(fitted, surveyed, position, covariance, fitted.core),
    )


def _expected_m(problem: Problem, delay_m: Array) -> float:
    """Expected error of one delay in a joint change of delays."""
    along = float(np.sum((delay_weights(problem) @ delay_m) ** 2))
    one = math.sqrt(float(np.median(problem.delay_variance_m2)) + problem.common_delay_m**2)
    return min(one, math.sqrt(float(np.sum(delay_m**2)) / max(along, 1e-12)))


def _least_held(fitted: Fitted, surveyed: Problem) -> tuple[Array, Array]:
    """Possible positions that ranges alone hold least, with their covariance.

    If a shape is held only by expected delays, their errors bend it, and a bent shape seems to be held by its ranges
    although the true one is not. So shapes along the least certain direction are examined, up to 3 σ.
    """
    weight = fitted.used.astype(np.float64)
    start = fitted.solution.position_m

    def covariance_at(position_m: Array) -> tuple[float, Array]:
        covariance = aligned_covariance(surveyed, position_m, fitted.core, weight)
        return float(position_stds_m(surveyed, covariance)[fitted.core].max()), covariance

    worst, covariance = covariance_at(start)
    least_held = start
    for direction in weak_directions(surveyed, fitted.covariance_m2, fitted.core, _NOTABLE_BEND_M, 1):
        middle = 0.0
        for half, step in ((_BENT_SIGMA, 0.5), (0.5, 0.1)):
            for sigma in np.arange(middle - half, middle + half + 0.01, step).tolist():
                position = start + sigma * direction.std_m * direction.shift_m
                std, found = covariance_at(position)
                if std > worst:
                    worst, covariance, least_held, middle = std, found, position, sigma
    return least_held, covariance


def _axis(fitted: Fitted, framed: Framed, directions: list[Direction]) -> str:
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


def _unchecked(fitted: Fitted) -> str | None:
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
