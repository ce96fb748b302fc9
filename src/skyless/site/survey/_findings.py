"""Sentences: what a survey does not determine, why, and which distances to measure."""

import math
import re
from collections.abc import Iterable
from typing import Final

import numpy as np

from skyless.core.arrays import Array, Mask
from skyless.site.survey._build import Measured, levels, with_free_delays
from skyless.site.survey._frame import Framed
from skyless.site.survey._shape import Fitted, redundancy, surveyed_problem
from skyless.site.survey.facts import MIN_CHECKS, Facts
from skyless.site.survey.fit import determined as determination
from skyless.site.survey.fit.determined import Links, TapeChoice, best_tapes, mending_tapes
from skyless.site.survey.fit.problem import Problem, delay_weights, jacobian
from skyless.site.survey.result import SurveyedAnchor, TapeAdvice, anchors_named, are, distances_named, joined

_FLAT: Final = 0.3  # a site is flat if its smallest extent is a smaller part of its largest one
_ONE_AXIS: Final = 0.7
"""Positions change along one direction if at least this part of their squared changes is along it."""

_BENDS_M: Final = 0.01
_BENT_SIGMA: Final = 3.0
"""A shape with at least this standard deviation is also examined when bent, by up to this multiple of it."""

_AXIS_PART: Final = 0.9  # a direction is that of an axis if the square of the cosine between both is larger
_UNLIKELY_SIGMAS: Final = 3.0


def unlikely_delays(anchors: Iterable[SurveyedAnchor], facts: Facts) -> tuple[str, ...]:
    """Sentences about delays far beyond what is expected: a wrong height, tape or point of an anchor looks so."""
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
    """One for each reason: which anchors, why, and which distances to measure."""
    if not measured.anchors:
        return ("no anchor is determined: there are no anchors",)
    reasons = anchor_reasons(measured, links, fitted)
    by_reason: dict[str, list[int]] = {}
    for anchor, reason in reasons.items():
        # Anchors with equally few ranges share a sentence, which then does not name to whom they are.
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
    """Anchors of ``near`` that are far from one another."""
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
    """A sentence where only the expected delays separate delays from positions."""
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
    """How much one delay is expected to be off in such a change of delays."""
    along = float(np.sum((delay_weights(problem) @ delay_m) ** 2))
    common = 0.0 if problem.common_delay_m is None else float(np.median(problem.common_delay_m))
    one = math.sqrt(float(np.median(problem.delay_variance_m2)) + common**2)
    return min(one, math.sqrt(float(np.sum(delay_m**2)) / max(along, 1e-12)))


def _least_held(fitted: Fitted, surveyed: Problem) -> tuple[Array, Array]:
    """Positions that the fit does not exclude and that ranges alone hold least, with their covariance.

    Where only expected delays hold a shape, they are off, and bend it: a bent shape seems to be held by its ranges,
    although the true one is not. So the shapes along the least certain direction are looked at, up to 3 σ.
    """
    weight = fitted.used.astype(np.float64)
    start = fitted.solution.position_m

    def covariance_at(position_m: Array) -> tuple[float, Array]:
        rows = jacobian(surveyed, position_m, weight)
        covariance = determination.aligned_covariance(surveyed, rows, position_m, fitted.core)
        return float(determination.position_stds_m(surveyed, covariance)[fitted.core].max()), covariance

    worst, covariance = covariance_at(start)
    least_held = start
    for direction in determination.weak_directions(surveyed, fitted.covariance_m2, fitted.core, _BENDS_M, 1):
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
    """Along what the positions change: an axis, or the pair of anchors that is the most parallel."""
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
    """A sentence where too few ranges check the result."""
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
    """The three distances that would help most, one after another."""
    problem = fitted.problem
    chosen = best_tapes(problem, fitted.solution.position_m, fitted.covariance_m2, fitted.core)
    return tuple(_advice(fitted, item) for item in chosen)


def _advice(fitted: Fitted, choice: TapeChoice) -> TapeAdvice:
    a, b = sorted((fitted.anchors[choice.first], fitted.anchors[choice.second]))
    return TapeAdvice(a, b, choice.std_before_m, choice.std_after_m)
