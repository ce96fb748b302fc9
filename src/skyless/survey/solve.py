"""A survey: positions and delays of all anchors from the ranges of their pairs and what the user knows.

Counting comes first (``fit/links.py``): only anchors with enough ranges are fitted. The fit finds a shape
(``shape.py``), which is moved to its frame (``frame.py``); then follows what is not determined (``findings.py``).
"""

import math
from typing import Final

import numpy as np
from msgspec import structs

from skyless.kernels.arrays import Array, Mask
from skyless.survey.build import Measured, as_array, assumed_heights, levels, own_delays, usable
from skyless.survey.facts import Facts
from skyless.survey.findings import (
    advised_tapes,
    anchor_reasons,
    held_by_expected_delays,
    missing_sentences,
    unchecked,
    unlikely_delays,
)
from skyless.survey.fit.ambiguity import OtherFit, find_ambiguities
from skyless.survey.fit.determined import position_stds_m
from skyless.survey.fit.links import Links, adjacency, count_links
from skyless.survey.frame import Framed, in_frame
from skyless.survey.kept import survey_of_kept_positions
from skyless.survey.ranges import PairRange, PairRanges
from skyless.survey.result import Ambiguity, Survey, SurveyedAnchor, SurveyedPair
from skyless.survey.sentences import anchors_named, joined
from skyless.survey.shape import Fitted, fit_shape, redundancy
from skyless.survey.tagged import with_tags

_MOVED_M: Final = 0.1
"""An anchor whose position differs less in another result is at the same position."""


def run_survey(ranges: PairRanges, facts: Facts) -> Survey:
    """Positions and delays, or, where there are none, why.

    What is not determined has no figures. Ranges and facts that do not suffice or do not fit raise nothing:
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
    return tuple(_pair(measured, fitted, pair, number.get((pair.a, pair.b))) for pair in measured.pairs)


def _pair(measured: Measured, fitted: Fitted | None, pair: PairRange, index: int | None) -> SurveyedPair:
    if fitted is None or index is None:
        std = math.hypot(pair.std_m, measured.facts.pair_std_m)
        return SurveyedPair(pair.a, pair.b, pair.range_m, None, std, excluded=False)
    problem = fitted.problem
    both = fitted.core[problem.first[index]] and fitted.core[problem.second[index]]
    residual = float(fitted.solution.residual_m[index]) if both else None
    std = math.sqrt(problem.variance_m2[index])
    return SurveyedPair(pair.a, pair.b, pair.range_m, residual, std, excluded=not fitted.used[index])


def _ambiguities(fitted: Fitted, framed: Framed, others: tuple[OtherFit, ...]) -> tuple[Ambiguity, ...]:
    found = []
    for other in others:
        position = framed.motion.moved(other.position_m)
        distance = np.linalg.norm(position - framed.position_m, axis=1)
        moved: Mask = (distance > _MOVED_M) & fitted.core
        if not moved.any():
            continue
        anchors = tuple(anchor for anchor, is_one in zip(fitted.anchors, moved, strict=True) if is_one)
        positions = {anchor: _xyz(position[fitted.anchors.index(anchor)]) for anchor in anchors}
        size = f"by up to {distance[moved].max():.2f} m"
        sentence = f"{anchors_named(anchors)} may be elsewhere, {size}, {_reason(fitted, other.used)}"
        found.append(Ambiguity(sentence, anchors, positions))
    return tuple(found)


def _reason(fitted: Fitted, used: Mask) -> str:
    late = [f"{fitted.pairs[index].a}–{fitted.pairs[index].b}" for index in np.flatnonzero(fitted.used & ~used)]
    return f"if {joined(late)} came late" if late else "the ranges fit there as well, as in a mirror"


def _xyz(position_m: Array) -> tuple[float, float, float]:
    x, y, z = position_m.tolist()
    return x, y, z


def _nothing(measured: Measured, links: Links, fitted: Fitted | None) -> Survey:
    """No anchor is determined."""
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
