"""Delays of anchors whose positions are given and stay: the simplest survey.

Positions are held in the fit, and their errors count as errors of the ranges. Delays then make up for a part of the
positions' errors: they are farther from the truth than those of a joint fit, and a tag that uses both is closer to it
(``docs/maths.md`` section 9).
"""

import math

import numpy as np
from msgspec import structs

from skyless.kernels.arrays import Array
from skyless.survey.build import Measured, as_array, build_problem, fixed_heights_m, own_delays
from skyless.survey.count import LEAST_CHECKS
from skyless.survey.fit.problem import Problem, delay_weights, unit_vectors
from skyless.survey.fit.robust import RobustFit, fit_robustly
from skyless.survey.ranges import PairRange
from skyless.survey.result import Survey, SurveyedAnchor, SurveyedPair
from skyless.survey.sentences import anchors_named, are
from skyless.survey.tags.epochs import TagEpochs
from skyless.survey.tags.joint import fit_with_tag

_NO_POSITION = "no position is given for it"


def survey_of_kept_positions(measured: Measured) -> Survey:
    """Delays with their standard deviations; positions are those of the sketch. Anchors without one have no figures."""
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
    residuals: dict[tuple[int, int], tuple[float, bool]] = {}
    redundancy, range_std_m = 0, facts.pair_std_m
    notes: tuple[str, ...] = ()
    if pairs:
        fit = fit_robustly(problem, [position], math.hypot(facts.pair_std_m, math.sqrt(2.0) * facts.sketch_std_m))
        fit, tag_information, notes = _with_tags(fit, measured, ids, position)
        covariance = _delay_covariance(fit, position, facts.sketch_std_m, facts.dimensions, tag_information)
        own, std = own_delays(measured, ids, fit.problem, fit.solution.delay_m, covariance)
        delays = {anchor: (float(own[k]), float(std[k])) for k, anchor in enumerate(ids) if anchor in linked}
        for index, pair in enumerate(pairs):
            residuals[pair.a, pair.b] = float(fit.solution.residual_m[index]), not fit.used[index]
        incidence = _incidence(fit.problem)[fit.used]
        redundancy = int(fit.used.sum()) - int(np.linalg.matrix_rank(incidence))
        range_std_m = math.sqrt(max(fit.range_std_m**2 - 2.0 * facts.sketch_std_m**2, facts.pair_std_m**2))
    missing = [anchor for anchor in measured.anchors if anchor not in ids]
    silent = [anchor for anchor in ids if anchor not in linked]
    sentences = [f"{anchors_named(missing)} {are(missing)} not determined: {_NO_POSITION}"] if missing else []
    if silent:
        sentences.append(f"delays of {anchors_named(silent)} are not determined: no range to an anchor with a position")
    return Survey(
        anchors=tuple(_anchor(measured, anchor, sketch[k], delays) for k, anchor in enumerate(measured.anchors)),
        pairs=tuple(_pair(measured, pair, residuals.get((pair.a, pair.b))) for pair in measured.pairs),
        range_std_m=range_std_m,
        redundancy=redundancy,
        unchecked=None if redundancy >= LEAST_CHECKS else "too few ranges check these delays",
        not_determined=tuple(sentences),
        ambiguities=(),
        tapes=(),
        frame="positions are the given ones, which stay",
        gauge=None,
        notes=(*measured.notes, *notes),
    )


def _with_tags(
    fit: RobustFit, measured: Measured, ids: tuple[int, ...], position_m: Array
) -> tuple[RobustFit, Array, tuple[str, ...]]:
    """The fit with what tags received, their information on coordinates and delays, (4 k, 4 k), and sentences."""
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
    """Of the estimated delays, shape (k, k); errors of positions are shared by all ranges of an anchor."""
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
    """Shape (m, k): 1 where a range has the delay of an anchor."""
    rows = np.zeros((len(problem.first), len(problem.delay_m)))
    number = np.arange(len(rows))
    rows[number, problem.first] = 1.0
    rows[number, problem.second] = 1.0
    return rows


def _anchor(
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


def _pair(measured: Measured, pair: PairRange, found: tuple[float, bool] | None) -> SurveyedPair:
    residual, excluded = (None, False) if found is None else found
    std = math.sqrt(pair.std_m**2 + measured.facts.pair_std_m**2 + 2.0 * measured.facts.sketch_std_m**2)
    return SurveyedPair(pair.a, pair.b, pair.range_m, residual, std, excluded=excluded)
