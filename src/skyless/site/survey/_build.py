"""From ranges and facts to a ``Problem`` of some of the site's anchors."""

import math
from typing import Final

import numpy as np
from msgspec import Struct, structs

from skyless.core.arrays import Array, Integers, Mask
from skyless.core.errors import SkylessError
from skyless.site.survey.facts import Facts, PairRange, PairRanges, Point, Tape
from skyless.site.survey.fit.problem import Problem
from skyless.site.survey.result import anchors_named

MIN_RANGE_STD_M: Final = 1e-5
_UNKNOWN_DELAY_STD_M: Final = 1e3  # standard deviation of a delay about which nothing is known
_LARGEST_M: Final = 1e5
"""No range, distance or standard deviation of a site is larger; with far larger ones the fit would not end."""

_STDS: Final = (
    "height_std_m", "point_std_m", "sketch_std_m", "delay_std_m", "common_delay_std_m", "pair_std_m",
)  # fmt: skip
"""Standard deviations among the facts."""

_OFTEN_LATE_STD_M: Final = 0.15
"""Further standard deviation of a pair's range, times the share of its ranges that came late: an object near the path
may have delayed the earliest ones, too."""


class Measured(Struct, frozen=True, eq=False):
    """Ranges and facts that can be used, with sentences about those that cannot."""

    anchors: tuple[int, ...]
    pairs: tuple[PairRange, ...]
    tapes: tuple[Tape, ...]
    tx_std_m: dict[int, float]
    facts: Facts
    notes: tuple[str, ...]


def usable(ranges: PairRanges, facts: Facts) -> Measured:
    """Leave out ranges and facts that are not finite, or that name anchors without ranges, with a sentence about each.

    Raises:
        SkylessError: a standard deviation of the facts is not finite, or is negative.
    """
    for name in _STDS:
        if not _is_std(getattr(facts, name)):
            raise SkylessError(f"{name} is {getattr(facts, name)}; it should be a standard deviation in metres")
    notes = []
    anchors = tuple(dict.fromkeys(ranges.anchors))
    known = set(anchors)
    best: dict[tuple[int, int], PairRange] = {}
    for pair in ranges.pairs:
        ends = (min(pair.a, pair.b), max(pair.a, pair.b))
        if not (abs(pair.range_m) < _LARGEST_M and _is_std(pair.std_m) and 0.0 <= pair.late_share <= 1.0):
            notes.append(f"the range of anchors {ends[0]} and {ends[1]} is not a possible figure: not used")
        elif pair.a == pair.b or not known.issuperset(ends) or ends in best:
            notes.append(
                f"the range of anchors {pair.a} and {pair.b} is not of a pair of this site, or is there twice: not used"
            )
        else:
            best[ends] = structs.replace(pair, a=ends[0], b=ends[1])
    tapes = []
    for tape in facts.tapes:
        is_possible = 0.0 < tape.distance_m < _LARGEST_M and _is_std(tape.std_m)
        if is_possible and tape.a != tape.b and {tape.a, tape.b} <= known:
            tapes.append(tape)
        else:
            why = "fits no pair of this site" if is_possible else "is not a possible figure"
            notes.append(f"the measured distance of anchors {tape.a} and {tape.b} {why}: not used")
    points = _finite(facts.points)
    heights_m = {anchor: z for anchor, z in facts.heights_m.items() if math.isfinite(z)}
    delays = [item for item in facts.delays if abs(item.delay_m) < _LARGEST_M and _is_std(item.std_m)]
    for kind, given, finite in (
        ("point", set(facts.points), set(points)),
        ("height", set(facts.heights_m), set(heights_m)),
        ("delay", {item.anchor for item in facts.delays}, {item.anchor for item in delays}),
    ):
        notes += [
            f"a {kind} is given for anchor {anchor}, which has no ranges: not used" for anchor in sorted(given - known)
        ]
        notes += [
            f"the {kind} of anchor {anchor} is not a possible figure: not used"
            for anchor in sorted(given & known - finite)
        ]
    kept = structs.replace(
        facts,
        points={anchor: point for anchor, point in points.items() if anchor in known},
        heights_m={anchor: z for anchor, z in heights_m.items() if anchor in known},
        sketch_m=_finite({anchor: point for anchor, point in facts.sketch_m.items() if anchor in known}),
        delays=tuple(item for item in delays if item.anchor in known),
    )
    tx_std_m = {anchor: std for anchor, std in ranges.tx_std_m.items() if _is_std(std)}
    return Measured(anchors, tuple(best.values()), tuple(tapes), tx_std_m, kept, tuple(notes))


def _is_std(value_m: float) -> bool:
    return 0.0 <= value_m < _LARGEST_M


def _finite(points: dict[int, Point]) -> dict[int, Point]:
    return {
        anchor: (x, y, z if z is not None and math.isfinite(z) else None)
        for anchor, (x, y, z) in points.items()
        if math.isfinite(x) and math.isfinite(y)
    }


def fixed_heights_m(measured: Measured) -> Array:
    """Z of all anchors in two dimensions, shape (n,): given ones, else the median of these, else 0."""
    given_m = _given_heights_m(measured.facts)
    common_m = _common_height_m(given_m)
    return np.array([given_m.get(anchor, common_m) for anchor in measured.anchors])


def assumed_heights(measured: Measured) -> str | None:
    """A sentence about anchors whose heights ``fixed_heights_m`` assumes; None where it assumes none."""
    if measured.facts.dimensions == 3 and not measured.facts.keep_positions:
        return None
    given_m = _given_heights_m(measured.facts)
    missing = [anchor for anchor in measured.anchors if anchor not in given_m]
    if not missing:
        return None
    if not given_m:
        return "no heights are given: all anchors are taken to be on the floor, at z = 0 m"
    common = f"{_common_height_m(given_m):g} m is assumed, the median of the others"
    return f"no height is given for {anchors_named(missing)}: {common}"


def _given_heights_m(facts: Facts) -> dict[int, float]:
    given = {anchor: point[2] for source in (facts.sketch_m, facts.points) for anchor, point in source.items()}
    given.update(facts.heights_m)
    return {anchor: z for anchor, z in given.items() if z is not None}


def _common_height_m(given_m: dict[int, float]) -> float:
    return float(np.median(list(given_m.values()))) if given_m else 0.0


def levels(measured: Measured) -> bool:
    """Whether the vertical is known: in two dimensions, or by heights of three anchors or more."""
    return measured.facts.dimensions == 2 or len(measured.facts.heights_m) >= 3


def as_array(points: dict[int, Point], anchors: tuple[int, ...]) -> Array:
    """Shape (n, 3), NaN where a coordinate is not given."""
    nothing = (math.nan, math.nan, math.nan)
    rows = [points.get(anchor, nothing) for anchor in anchors]
    return np.array([[math.nan if value is None else value for value in row] for row in rows]).reshape(-1, 3)


def indices_of(measured: Measured, kept: Integers) -> dict[int, int]:
    """Index of each kept anchor, by identifier."""
    return {measured.anchors[index]: number for number, index in enumerate(kept)}


def build_problem(
    measured: Measured, kept: Integers, pair_std_m: float, point_m: Array | None, sketch_m: Array | None
) -> tuple[Problem, list[PairRange]]:
    """The problem of the kept anchors (indices), and the pairs of its ranges in their order.

    ``point_m``, ``sketch_m``: known and rough coordinates of the kept anchors, shape (k, 3), NaN where there are none.
    """
    facts, index = measured.facts, indices_of(measured, kept)
    n = len(kept)
    pairs = [pair for pair in measured.pairs if pair.a in index and pair.b in index]
    tapes = [tape for tape in measured.tapes if tape.a in index and tape.b in index]
    is_free = np.ones((n, 3), bool)
    coordinate = np.zeros((n, 3))
    variance = np.full((n, 3), np.inf)
    for source, std in ((sketch_m, facts.sketch_std_m), (_heights(measured, kept), facts.height_std_m)):
        _add(coordinate, variance, source, std)
    _add(coordinate, variance, point_m, facts.point_std_m)
    if facts.dimensions == 2:
        is_free[:, 2] = False
        coordinate[:, 2], variance[:, 2] = fixed_heights_m(measured)[kept], np.inf
    delay = np.zeros(n)
    delay_variance = np.full(n, facts.delay_std_m**2, np.float64)
    common = np.full(n, facts.common_delay_std_m if facts.delay_std_m > 0.0 else 0.0, np.float64)
    for item in facts.delays:
        if item.anchor in index:
            delay[index[item.anchor]], delay_variance[index[item.anchor]] = item.delay_m, item.std_m**2
            common[index[item.anchor]] = 0.0
    delay_variance += np.array([measured.tx_std_m.get(anchor, 0.0) ** 2 for anchor in index]).reshape(n)
    problem = Problem(
        is_free=is_free,
        first=np.array([index[pair.a] for pair in pairs], np.int64),
        second=np.array([index[pair.b] for pair in pairs], np.int64),
        range_m=np.array([pair.range_m for pair in pairs], np.float64),
        variance_m2=np.array([own_variance_m2(pair) + pair_std_m**2 for pair in pairs], np.float64),
        delay_m=delay,
        delay_variance_m2=delay_variance,
        common_delay_m=common if common.any() else None,
        coordinate_m=coordinate,
        coordinate_variance_m2=variance,
        tape_first=np.array([index[tape.a] for tape in tapes], np.int64),
        tape_second=np.array([index[tape.b] for tape in tapes], np.int64),
        tape_m=np.array([tape.distance_m for tape in tapes], np.float64),
        tape_variance_m2=np.array([tape.std_m**2 for tape in tapes], np.float64),
    )
    return problem, pairs


def own_variance_m2(pair: PairRange) -> float:
    """Variance of a range without the constant error that any pair has."""
    return pair.std_m**2 + (_OFTEN_LATE_STD_M * pair.late_share) ** 2 + MIN_RANGE_STD_M**2


def with_free_delays(problem: Problem) -> tuple[Problem, Mask]:
    """Without the expected delays that are coarser than a range: what the measurements alone determine.

    Also which delays, shape (n,), are unknown in this sense.
    """
    typical = float(np.median(problem.variance_m2)) if len(problem.variance_m2) else 0.0
    own, common = problem.delay_variance_m2, problem.common_delay_m
    free = structs.replace(problem, delay_variance_m2=np.where(own > typical, np.inf, own))
    if common is None:
        return free, np.asarray(own > typical)
    shared = common**2 > typical
    free = structs.replace(free, common_delay_m=np.where(shared, _UNKNOWN_DELAY_STD_M, common))
    return free, np.asarray((own > typical) | shared)


def own_delays(
    measured: Measured, anchors: tuple[int, ...], problem: Problem, delay_m: Array, covariance_m2: Array
) -> tuple[Array, Array]:
    """Delays less the error of TX stamps that all ranges of an anchor share, and standard deviations, shape (k,).

    ``delay_m``, ``covariance_m2``: of both together, as fitted. What is known of their shares is in the expected
    delays.
    """
    shared = np.array([measured.tx_std_m.get(anchor, 0.0) ** 2 for anchor in anchors])
    common = np.zeros(len(anchors)) if problem.common_delay_m is None else problem.common_delay_m
    own = np.diag(np.maximum(problem.delay_variance_m2 - shared, 0.0)) + np.outer(common, common)
    whole = np.diag(np.maximum(problem.delay_variance_m2, 1e-10)) + np.outer(common, common)
    part = own @ np.linalg.inv(whole)
    own_m = problem.delay_m + part @ (delay_m - problem.delay_m)
    variance = np.diag(part @ covariance_m2 @ part.T + own - part @ own)
    return np.asarray(own_m), np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _heights(measured: Measured, kept: Integers) -> Array:
    """Known heights as points, shape (k, 3); none where fewer than three level the site."""
    known = np.full((len(kept), 3), np.nan)
    if levels(measured):
        known[:, 2] = [measured.facts.heights_m.get(measured.anchors[index], math.nan) for index in kept]
    return known


def _add(coordinate: Array, variance: Array, known_m: Array | None, std_m: float) -> None:
    if known_m is not None:
        given = np.isfinite(known_m)
        coordinate[given], variance[given] = known_m[given], std_m**2
