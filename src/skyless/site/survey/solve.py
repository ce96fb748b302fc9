"""Survey: positions and delays of all anchors from the ranges of their pairs and the user's facts.

Counting comes first: only anchors with enough ranges are fitted. The fit finds a shape (``shape.py``), which is moved
to its frame (``frame.py``); then ``shape.py`` tells what is not determined.

If positions are given and kept, only delays are estimated, and the positions' errors count as errors of the ranges.
Delays then compensate for a part of the positions' errors: they are farther from the truth than those of a joint fit,
but a tag that uses both is closer to it (``docs/maths.md`` section 9).
"""

import math
from typing import Final

import numpy as np
from msgspec import structs

from skyless.core.arrays import Array, Integers, Mask
from skyless.site.survey.determined import Links, count_links, position_stds_m
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
    joined,
)
from skyless.site.survey.frame import (
    Framed,
    Measured,
    as_array,
    assumed_heights,
    build_problem,
    fixed_heights_m,
    in_frame,
    levels,
    own_delays,
    usable,
)
from skyless.site.survey.problem import Problem, adjacency, delay_weights, unit_vectors
from skyless.site.survey.robust import OtherFit, RobustFit, find_ambiguities, fit_robustly
from skyless.site.survey.shape import (
    Fitted,
    advised_tapes,
    anchor_reasons,
    fit_shape,
    held_by_expected_delays,
    missing_sentences,
    redundancy,
    unchecked,
    unlikely_delays,
    with_tags,
)
from skyless.site.survey.walk import TagEpochs, fit_with_tag

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
        notes=(*survey.notes, *unlikely_delays(survey.anchors, facts)),
        assumed_heights=assumed_heights(measured),
    )


def _survey(measured: Measured) -> Survey:
    if measured.facts.keep_positions:
        return survey_of_kept_positions(measured)
    links = _links(measured)
    kept = np.flatnonzero(links.has_enough)
    fitted_ids = {measured.anchors[index] for index in kept}
    if not any(pair.a in fitted_ids and pair.b in fitted_ids for pair in measured.pairs):
        return _nothing(measured, links, None)
    fitted = fit_shape(measured, kept)
    fitted, others = with_tags(fitted, find_ambiguities(fitted.robust))
    if not fitted.core.any():
        return _nothing(measured, links, fitted)
    framed = in_frame(measured, kept, fitted.solution.position_m, fitted.covariance_m2, fitted.core, fitted.points_used)
    return Survey(
        anchors=_anchors(measured, links, fitted, framed),
        pairs=_pairs(measured, fitted),
        range_std_m=fitted.range_std_m,
        redundancy=redundancy(fitted),
        unchecked=unchecked(fitted),
        not_determined=(*missing_sentences(measured, links, fitted), *held_by_expected_delays(fitted, framed)),
        ambiguities=_ambiguities(fitted, framed, others),
        tapes=advised_tapes(fitted),
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
    reasons = anchor_reasons(measured, links, fitted)
    number = {anchor: k for k, anchor in enumerate(fitted.anchors)}
    stds = position_stds_m(fitted.problem, fitted.covariance_m2)
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
        covariance = tuple(tuple(row) for row in framed.covariance_m2[k].tolist())
        found.append(
            SurveyedAnchor(
                anchor,
                determined=True,
                x_m=x,
                y_m=y,
                z_m=z,
                std_m=float(stds[k]),
                covariance_m2=covariance,
                delay_m=float(delays[k]),
                delay_std_m=float(delay_stds[k]),
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
        positions = {fitted.anchors[index]: _xyz(position_m[index]) for index in elsewhere.tolist()}
        if any(_is_same(positions, known.positions_m) for known in found):
            continue
        sentence = _sentence(fitted, framed, other, position_m, distance_m, elsewhere)
        found.append(Ambiguity(sentence, tuple(positions), positions))
    return tuple(found)


def _is_same(one: dict[int, tuple[float, float, float]], other: dict[int, tuple[float, float, float]]) -> bool:
    return one.keys() == other.keys() and all(math.dist(one[anchor], other[anchor]) < _SAME_M for anchor in one)


def _sentence(
    fitted: Fitted, framed: Framed, other: OtherFit, position_m: Array, distance_m: Array, elsewhere: Integers
) -> str:
    """Say which anchors are elsewhere, where, by how much the others differ, and which distance decides."""
    case, here_m = _case(fitted, other.used), framed.position_m
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


def _case(fitted: Fitted, used: Mask) -> str:
    late = [f"{fitted.pairs[index].a}–{fitted.pairs[index].b}" for index in np.flatnonzero(fitted.used & ~used)]
    return f"if {joined(late)} came late" if late else "in a mirror image that fits as well"


def _xyz(position_m: Array) -> tuple[float, float, float]:
    x, y, z = position_m.tolist()
    return x, y, z


def _nothing(measured: Measured, links: Links, fitted: Fitted | None) -> Survey:
    reasons = anchor_reasons(measured, links, fitted)
    return Survey(
        anchors=tuple(
            SurveyedAnchor(anchor, determined=False, reason=reasons.get(anchor)) for anchor in measured.anchors
        ),
        pairs=_pairs(measured, fitted),
        range_std_m=measured.facts.pair_std_m if fitted is None else fitted.range_std_m,
        redundancy=0,
        unchecked="nothing checks this survey: no anchor is determined",
        not_determined=missing_sentences(measured, links, fitted),
        ambiguities=(),
        tapes=(),
        frame="no anchor is determined, so there is no frame",
        gauge=None,
        notes=measured.notes if fitted is None else (*measured.notes, *fitted.notes),
    )


# Only delays, of anchors whose positions are kept


_NO_POSITION = "no position is given for it"


def survey_of_kept_positions(measured: Measured) -> Survey:
    """Estimate only delays; positions are those of the sketch, and anchors without one have no figures."""
    facts = measured.facts
    sketch = as_array(facts.sketch_m, measured.anchors)
    sketch[:, 2] = np.where(np.isnan(sketch[:, 2]), fixed_heights_m(measured), sketch[:, 2])
    kept = np.flatnonzero(np.isfinite(sketch[:, :2]).all(axis=1))
    position = sketch[kept]
    problem, pairs = build_problem(measured, kept, facts.pair_std_m, None, None)
    problem = structs.replace(
        problem,
        is_free=np.zeros((len(kept), 3), bool),
        coordinate_m=position,
        variance_m2=problem.variance_m2 + 2.0 * facts.sketch_std_m**2,
    )
    ids = tuple(measured.anchors[index] for index in kept)
    linked = {anchor for pair in pairs for anchor in (pair.a, pair.b)}
    delays: dict[int, tuple[float, float]] = {}
    residuals: dict[tuple[int, int], tuple[float | None, bool]] = {}
    redundancy, range_std_m = 0, facts.pair_std_m
    notes: tuple[str, ...] = ()
    if pairs:
        fit = fit_robustly(problem, [position], math.hypot(facts.pair_std_m, math.sqrt(2.0) * facts.sketch_std_m))
        fit, tag_information, notes = _kept_with_tags(fit, measured, ids, position)
        covariance = _delay_covariance(fit, position, facts.sketch_std_m, facts.dimensions, tag_information)
        own, std = own_delays(measured, ids, fit.problem, fit.solution.delay_m, covariance)
        delays = {anchor: (float(own[k]), float(std[k])) for k, anchor in enumerate(ids) if anchor in linked}
        for index, pair in enumerate(pairs):
            residuals[pair.a, pair.b] = float(fit.solution.residual_m[index]), not fit.used[index]
        incidence = _incidence(fit.problem)[fit.used]
        redundancy = int(fit.used.sum()) - int(np.linalg.matrix_rank(incidence))
        range_std_m = math.sqrt(max(fit.range_std_m**2 - 2.0 * facts.sketch_std_m**2, facts.pair_std_m**2))
    kept_pairs = []
    for pair in measured.pairs:
        residual_m, excluded = residuals.get((pair.a, pair.b), (None, False))
        std_m = math.sqrt(pair.std_m**2 + facts.pair_std_m**2 + 2.0 * facts.sketch_std_m**2)
        kept_pairs.append(SurveyedPair(pair.a, pair.b, pair.range_m, residual_m, std_m, excluded))
    missing = [anchor for anchor in measured.anchors if anchor not in ids]
    silent = [anchor for anchor in ids if anchor not in linked]
    sentences = [f"{anchors_named(missing)} {are(missing)} not determined: {_NO_POSITION}"] if missing else []
    if silent:
        sentences.append(f"delays of {anchors_named(silent)} are not determined: no range to an anchor with a position")
    return Survey(
        anchors=tuple(_kept_anchor(measured, anchor, sketch[k], delays) for k, anchor in enumerate(measured.anchors)),
        pairs=tuple(kept_pairs),
        range_std_m=range_std_m,
        redundancy=redundancy,
        unchecked=None if redundancy >= MIN_CHECKS else "too few ranges check these delays",
        not_determined=tuple(sentences),
        ambiguities=(),
        tapes=(),
        frame="positions are the given ones, which stay",
        gauge=None,
        notes=(*measured.notes, *notes),
    )


def _kept_with_tags(
    fit: RobustFit, measured: Measured, ids: tuple[int, ...], position_m: Array
) -> tuple[RobustFit, Array, tuple[str, ...]]:
    """The fit with the tags' receptions, their information on coordinates and delays, (4 k, 4 k), and sentences."""
    ranges_m = {(pair.a, pair.b): pair.range_m for pair in measured.pairs}
    information = np.zeros((4 * len(ids), 4 * len(ids)))
    sentences: list[str] = []
    for epochs in measured.facts.tags:
        assert isinstance(epochs, TagEpochs)
        joint = fit_with_tag(fit.problem, ids, [fit.solution], epochs, ranges_m, [fit.used])
        sentences.append(joint.sentence)
        if joint.solution is not None and joint.rows is not None:
            problem = structs.replace(fit.problem, more=(*fit.problem.more, joint.rows))
            fit = structs.replace(fit, problem=problem, solution=joint.solution)
            jacobian, _ = joint.rows.rows(position_m, joint.solution.delay_m)
            information += jacobian.T @ jacobian
    return fit, information, tuple(sentences)


def _delay_covariance(
    fit: RobustFit, position_m: Array, position_std_m: float, dimensions: int, tag_information: Array
) -> Array:
    """Covariance of the delays, shape (k, k), with position errors, which all ranges of an anchor share."""
    problem, k = fit.problem, len(position_m)
    weight = fit.used / problem.variance_m2
    incidence = _incidence(problem)
    prior = delay_weights(problem).T @ delay_weights(problem)
    of_tags = tag_information[3 * k :, 3 * k :]
    inverse = np.linalg.inv(incidence.T @ (weight[:, None] * incidence) + prior + of_tags)
    gain = inverse @ (incidence.T * weight)
    unit = unit_vectors(position_m, problem.first, problem.second)
    shift = np.zeros((len(problem.first), k, dimensions))
    number = np.arange(len(problem.first))
    shift[number, problem.first] = unit[:, :dimensions]
    shift[number, problem.second] = -unit[:, :dimensions]
    by_tags = tag_information[3 * k :, : 3 * k].reshape(k, k, 3)[:, :, :dimensions]
    moved = gain @ shift.reshape(len(number), -1) + inverse @ by_tags.reshape(k, -1)
    noise = np.maximum(problem.variance_m2 - 2.0 * position_std_m**2, 0.0)
    return np.asarray(
        (gain * noise) @ gain.T + position_std_m**2 * moved @ moved.T + inverse @ (prior + of_tags) @ inverse
    )


def _incidence(problem: Problem) -> Array:
    """Incidence matrix of ranges and anchors, shape (m, k): 1 where a range contains an anchor's delay."""
    rows = np.zeros((len(problem.first), len(problem.delay_m)))
    number = np.arange(len(rows))
    rows[number, problem.first] = 1.0
    rows[number, problem.second] = 1.0
    return rows


def _kept_anchor(
    measured: Measured, anchor: int, position_m: Array, delays: dict[int, tuple[float, float]]
) -> SurveyedAnchor:
    if not np.isfinite(position_m).all():
        return SurveyedAnchor(anchor, determined=False, reason=_NO_POSITION)
    facts = measured.facts
    x, y, z = position_m.tolist()
    delay, std = delays.get(anchor, (None, None))
    variance = [facts.sketch_std_m**2 if axis < facts.dimensions else 0.0 for axis in range(3)]
    a, b, c = np.diag(variance).tolist()
    return SurveyedAnchor(
        anchor,
        determined=True,
        x_m=x,
        y_m=y,
        z_m=z,
        std_m=facts.sketch_std_m,
        covariance_m2=(tuple(a), tuple(b), tuple(c)),
        delay_m=delay,
        delay_std_m=std,
    )
