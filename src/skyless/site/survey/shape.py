"""The shape of a site: the problem of its ranges and facts, starts, the fit, and the frame to which it is moved.

Ranges determine a shape only up to rotation, shift and reflection. The frame is that of named anchors, known points, a
sketch or a default.
"""

import math
import zlib
from typing import Final

import numpy as np
from msgspec import Struct, structs
from scipy.sparse.csgraph import connected_components

from skyless.core.arrays import Array, Integers, Mask
from skyless.core.errors import SkylessError
from skyless.site.survey.facts import Facts, Gauge, PairRange, PairRanges, Point, Tape, anchors_named, joined
from skyless.site.survey.fit import (
    OtherFit,
    RobustFit,
    aligned_covariance,
    determined_core,
    fit_robustly,
    folds,
    may_be_flat,
    position_stds_m,
    rank,
    weak_directions,
)
from skyless.site.survey.problem import (
    Problem,
    Solution,
    delay_weights,
    distance_derivatives,
    distances_m,
    incidence,
    jacobian,
    solve_least_squares,
    superimposed,
)
from skyless.site.survey.walk import TagEpochs, fit_with_tag

# From ranges and facts to a ``Problem`` of some of the site's anchors.

_MIN_RANGE_STD_M: Final = 1e-5
_UNKNOWN_DELAY_STD_M: Final = 1e3  # standard deviation of a delay about which nothing is known
_LARGEST_M: Final = 1e5
"""Limit of ranges, distances and standard deviations; with far larger ones the fit would not converge."""

_STDS: Final = (
    "height_std_m", "point_std_m", "sketch_std_m", "delay_std_m", "common_delay_std_m", "pair_std_m",
)  # fmt: skip
"""Names of the standard deviations in ``Facts``."""

_OFTEN_LATE_STD_M: Final = 0.15
"""Extra standard deviation of a pair's range per share of late ranges, as an object near the path may also have delayed
the earliest ones."""


class Measured(Struct, frozen=True, eq=False):
    """The usable ranges and facts, with sentences about the others."""

    anchors: tuple[int, ...]
    pairs: tuple[PairRange, ...]
    tapes: tuple[Tape, ...]
    tx_std_m: dict[int, float]
    facts: Facts
    notes: tuple[str, ...]


def usable(ranges: PairRanges, facts: Facts) -> Measured:
    """Leave out, with a sentence about each, ranges and facts that are not finite or name anchors without ranges.

    Raises SkylessError: a standard deviation of the facts is negative, not finite or too large.
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
    for kind, given, finite in (
        ("point", set(facts.points), set(points)),
        ("height", set(facts.heights_m), set(heights_m)),
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
    """Heights of all anchors in two dimensions, shape (n,): as given, else the median of the given ones, else 0."""
    given_m = _given_heights_m(measured.facts)
    common_m = _common_height_m(given_m)
    return np.array([given_m.get(anchor, common_m) for anchor in measured.anchors])


def assumed_heights(measured: Measured) -> str | None:
    """A sentence about the anchors whose heights ``fixed_heights_m`` assumes; None if there are none."""
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
    """Points of these anchors as an array of shape (n, 3), NaN where a coordinate is not given."""
    nothing = (math.nan, math.nan, math.nan)
    rows = [points.get(anchor, nothing) for anchor in anchors]
    return np.array([[math.nan if value is None else value for value in row] for row in rows]).reshape(-1, 3)


def build_problem(
    measured: Measured, kept: Integers, point_m: Array | None = None, sketch_m: Array | None = None
) -> tuple[Problem, tuple[PairRange, ...]]:
    """Build the problem of the kept anchors (indices). Returns it with the pairs of its ranges, in order.

    ``point_m``, ``sketch_m``: known and rough coordinates of the kept anchors, shape (k, 3), NaN where there are none.
    """
    facts, index = measured.facts, {measured.anchors[at]: number for number, at in enumerate(kept)}
    n = len(kept)
    pairs = tuple(pair for pair in measured.pairs if pair.a in index and pair.b in index)
    tapes = [tape for tape in measured.tapes if tape.a in index and tape.b in index]
    is_free = np.ones((n, 3), bool)
    coordinate = np.zeros((n, 3))
    variance = np.full((n, 3), np.inf)
    height_m = np.full((n, 3), np.nan)
    if levels(measured):
        height_m[:, 2] = [facts.heights_m.get(anchor, math.nan) for anchor in index]
    stds_m = (facts.sketch_std_m, facts.height_std_m, facts.point_std_m)
    for known_m, std_m in zip((sketch_m, height_m, point_m), stds_m, strict=True):
        if known_m is not None:
            given = np.isfinite(known_m)
            coordinate[given], variance[given] = known_m[given], std_m**2
    if facts.dimensions == 2:
        is_free[:, 2] = False
        coordinate[:, 2], variance[:, 2] = fixed_heights_m(measured)[kept], np.inf
    stamp_variance = np.array([measured.tx_std_m.get(anchor, 0.0) ** 2 for anchor in index]).reshape(n)
    problem = Problem(
        is_free=is_free,
        first=np.array([index[pair.a] for pair in pairs], np.int64),
        second=np.array([index[pair.b] for pair in pairs], np.int64),
        range_m=np.array([pair.range_m for pair in pairs], np.float64),
        variance_m2=np.array([_own_variance_m2(pair) + facts.pair_std_m**2 for pair in pairs], np.float64),
        delay_variance_m2=facts.delay_std_m**2 + stamp_variance,
        common_delay_m=facts.common_delay_std_m if facts.delay_std_m > 0.0 else 0.0,
        coordinate_m=coordinate,
        coordinate_variance_m2=variance,
        tape_first=np.array([index[tape.a] for tape in tapes], np.int64),
        tape_second=np.array([index[tape.b] for tape in tapes], np.int64),
        tape_m=np.array([tape.distance_m for tape in tapes], np.float64),
        tape_variance_m2=np.array([tape.std_m**2 for tape in tapes], np.float64),
    )
    return problem, pairs


def _own_variance_m2(pair: PairRange) -> float:
    """Variance of a range without the constant error of a pair."""
    return pair.std_m**2 + (_OFTEN_LATE_STD_M * pair.late_share) ** 2 + _MIN_RANGE_STD_M**2


def with_free_delays(problem: Problem) -> tuple[Problem, Mask]:
    """The problem without delay priors that are coarser than a range, to see what the measurements alone determine.

    Also returns which delays have no prior then, shape (n,).
    """
    typical = float(np.median(problem.variance_m2)) if len(problem.variance_m2) else 0.0
    is_open = problem.delay_variance_m2 > typical
    is_common_open = problem.common_delay_m**2 > typical
    free = structs.replace(
        problem,
        delay_variance_m2=np.where(is_open, np.inf, problem.delay_variance_m2),
        common_delay_m=_UNKNOWN_DELAY_STD_M if is_common_open else problem.common_delay_m,
    )
    return free, np.asarray(is_open | is_common_open)


def own_delays(
    measured: Measured, anchors: tuple[int, ...], problem: Problem, delay_m: Array, covariance_m2: Array
) -> tuple[Array, Array]:
    """Delays without the shared error of an anchor's TX stamps, and their standard deviations, shape (k,) each.

    ``delay_m``, ``covariance_m2``: delay and stamp error together, as fitted; the priors tell how to divide them.
    """
    shared = np.array([measured.tx_std_m.get(anchor, 0.0) ** 2 for anchor in anchors])
    common_m2 = problem.common_delay_m**2
    own = np.diag(np.maximum(problem.delay_variance_m2 - shared, 0.0)) + common_m2
    whole = np.diag(np.maximum(problem.delay_variance_m2, 1e-10)) + common_m2
    part = own @ np.linalg.inv(whole)
    variance = np.diag(part @ covariance_m2 @ part.T + own - part @ own)
    return np.asarray(part @ delay_m), np.asarray(np.sqrt(np.maximum(variance, 0.0)))


# Alignments, and frames through anchors


_DECIDED: Final = 16.0
"""Least difference between the costs of an alignment and its mirror image that decides for the better one."""

_OFF_AXIS: Final = 0.1  # least distance from the x axis, as a share of its length, that makes an anchor's side clear
_MAX_SIGMA: Final = 3.0


class Motion(Struct, frozen=True, eq=False):
    """A rotation, possibly with a reflection, followed by a shift."""

    rotation: Array
    """Shape (3, 3)."""
    shift_m: Array
    """Shape (3,)."""

    def moved(self, position_m: Array) -> Array:
        """Apply the motion to positions of shape (..., 3)."""
        return np.asarray(position_m @ self.rotation.T + self.shift_m)


def align(position_m: Array, other_m: Array, std_m: float, axes: int) -> tuple[Motion, bool]:
    """Least squares alignment without scale, of positions of shape (k, 3); whether its mirror image is clearly worse.

    ``axes`` 2: rotate about the vertical and keep z. ``std_m``: standard deviation of the sets' difference per axis,
    used only to decide about mirror images.
    """
    own, other = position_m[:, :axes], other_m[:, :axes]
    centre, goal = own.mean(axis=0), other.mean(axis=0)
    left, _, right = np.linalg.svd((own - centre).T @ (other - goal))
    found = []
    for sign in (1.0, -1.0):
        flip = np.ones(axes)
        flip[-1] = sign
        turn = (left * flip) @ right
        residual = (own - centre) @ turn + goal - other
        rotation = np.eye(3)
        rotation[:axes, :axes] = turn.T
        shift = np.zeros(3)
        shift[:axes] = goal - turn.T @ centre
        cost = float(np.sum(residual**2)) / max(std_m, 1e-9) ** 2
        found.append((cost, float(np.linalg.det(turn)), Motion(rotation, shift)))
    plain = next(item for item in found if item[1] > 0.0)
    mirrored = next(item for item in found if item[1] < 0.0)
    decided = abs(plain[0] - mirrored[0]) > _DECIDED
    best = mirrored if decided and mirrored[0] < plain[0] else plain
    return best[2], decided


def fitting_points(position_m: Array, covariance_m2: Array, point_m: Array, point_std_m: float) -> Mask:
    """Mask of the points whose mutual distances agree with the positions, shape (k,).

    The point that contradicts most others is removed until none does, but the last two stay. ``covariance_m2``: shape
    (3 k, 3 k).
    """
    k = len(position_m)
    apart = position_m[:, None] - position_m[None]
    unit = apart / np.maximum(distances_m(position_m), 1e-9)[:, :, None]
    blocks = covariance_m2.reshape(k, 3, k, 3).transpose(0, 2, 1, 3)
    own = blocks[np.arange(k), np.arange(k)]
    spread = own[:, None] + own[None] - blocks - blocks.transpose(1, 0, 2, 3)
    variance = np.einsum("ija,ijab,ijb->ij", unit, spread, unit) + 2.0 * point_std_m**2
    sigma = np.abs(distances_m(position_m) - distances_m(point_m)) / np.sqrt(variance)
    np.fill_diagonal(sigma, 0.0)
    fits = np.ones(k, bool)
    while True:
        against = np.where(np.outer(fits, fits), sigma, 0.0)
        wrong = against > _MAX_SIGMA
        if not wrong.any() or fits.sum() <= 2:
            return fits
        order = np.lexsort((against.sum(axis=1), wrong.sum(axis=1)))
        fits[order[-1]] = False


class Axes(Struct, frozen=True, eq=False):
    """A frame through anchors, by indices."""

    motion: Motion
    origin: int
    x_axis: int
    left: int | None
    """None if no anchor is clearly on the left."""


def axes_through(
    position_m: Array, usable: Mask, axes: int, origin: int, x_axis: int | None = None, left: int | None = None
) -> Axes:
    """The frame with anchor ``origin`` at 0, ``x_axis`` on +x and ``left`` at y > 0; needs two usable anchors.

    By default the farthest anchor defines the x axis, and the first one clearly off it the left. ``axes`` 2: z is kept;
    3: the three anchors are at z = 0, and the first anchor clearly off their plane is above it.
    """
    arm = position_m - position_m[origin]
    if axes == 2:
        arm = arm * [1.0, 1.0, 0.0]
    length = np.where(usable, np.linalg.norm(arm, axis=1), -1.0)
    if x_axis is None:
        x_axis = int(np.argmax(length))
    along = arm[x_axis] / max(float(length[x_axis]), 1e-9)
    off = arm - np.outer(arm @ along, along)
    distance = np.linalg.norm(off, axis=1)
    clear = _first(usable & (distance > _OFF_AXIS * length[x_axis]))
    chosen = clear if left is None else left
    decided = chosen is not None and bool(distance[chosen] > _OFF_AXIS * _OFF_AXIS * length[x_axis])
    across = off[chosen] / distance[chosen] if chosen is not None and decided else _perpendicular(along, axes)
    up = np.array([0.0, 0.0, 1.0])
    if axes == 3:
        up = np.cross(along, across)
        height = arm @ up
        above = _first(usable & (np.abs(height) > _OFF_AXIS * length[x_axis]))
        up = up if above is None or height[above] > 0.0 else -up
    rotation = np.stack([along, across, up])
    shift = -rotation @ position_m[origin]
    if axes == 2:
        shift[2] = 0.0
    return Axes(Motion(rotation, shift), origin, x_axis, chosen if decided else None)


def _first(chosen: Mask) -> int | None:
    found = np.flatnonzero(chosen)
    return int(found[0]) if found.size else None


def _perpendicular(along: Array, axes: int) -> Array:
    if axes == 2:
        return np.array([-along[1], along[0], 0.0])
    other = np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
    return np.asarray(other / np.linalg.norm(other))


# The frame that the facts define


_NEAR: Final = 0.5
"""Advise another anchor if the x axis's is nearer to the origin than this share of the farthest one's distance."""


class Framed(Struct, frozen=True, eq=False):
    """A shape of ``k`` anchors in its frame."""

    motion: Motion
    position_m: Array
    """Shape (k, 3)."""
    covariance_m2: Array
    """Shape (k, 3, 3)."""
    sentence: str
    gauge: Gauge | None
    notes: tuple[str, ...]


def in_frame(fitted: "Fitted") -> Framed:
    """Move positions and their covariance to the frame that the facts define."""
    motion, sentence, gauge, notes = _motion(fitted)
    k = len(fitted.kept)
    blocks = fitted.covariance_m2[: 3 * k, : 3 * k].reshape(k, 3, k, 3)[np.arange(k), :, np.arange(k)]
    rotated = motion.rotation @ blocks @ motion.rotation.T
    return Framed(motion, motion.moved(fitted.solution.position_m), rotated, sentence, gauge, tuple(notes))


def _motion(fitted: "Fitted") -> tuple[Motion, str, Gauge | None, list[str]]:
    measured, position_m, core = fitted.measured, fitted.solution.position_m, fitted.core
    anchors, axes = np.array(fitted.anchors), 2 if levels(measured) else 3
    still = Motion(np.eye(3), np.zeros(3))
    facts = measured.facts
    if facts.keep_positions:
        return still, "positions are the given ones, which stay", None, []
    by_points, points_decide = _best(fitted, facts.points, max(facts.point_std_m, 0.03), axes)
    by_sketch, sketch_decides = _best(fitted, facts.sketch_m, facts.sketch_std_m, axes)
    decided = points_decide or sketch_decides
    notes: list[str] = []
    if axes == 3:
        notes.append("the site may be tilted: give the heights of three anchors that are not on one line")
    gauge = facts.gauge
    if gauge is not None:
        index = {int(anchor): number for number, anchor in enumerate(anchors) if core[number]}
        named = [gauge.origin, gauge.x_axis, *([] if gauge.left is None else [gauge.left])]
        missing = [anchor for anchor in dict.fromkeys(named) if anchor not in index]
        if not missing and len(set(named)) == len(named):
            chosen = [index[anchor] for anchor in named]
            return _by_gauge(fitted, axes, chosen, by_points or by_sketch, decided, notes)
        has = "has" if len(missing) == 1 else "have"
        why = f"{anchors_named(missing)} {has} no position" if missing else "one anchor is named twice"
        notes.append(f"the frame cannot be defined by anchors {joined(named)}: {why}")
    mirror = "" if decided else "; the ranges do not show whether this is a mirror image: name an anchor on the left"
    if by_points is not None:
        motion = still if fitted.points_used else by_points
        if not decided and axes == 2:
            motion = _left_of_points(fitted, motion)
        return motion, f"axes follow the known points{mirror}", None, notes
    if by_sketch is not None:
        return by_sketch, f"axes fit the sketch best{mirror}", None, notes
    lowest = int(np.flatnonzero(core)[0])
    if core.sum() < 2:
        return Motion(np.eye(3), -position_m[lowest] * ([1, 1, 0] if axes == 2 else [1, 1, 1])), "", None, notes
    found = axes_through(position_m, core, axes, lowest)
    return found.motion, f"{_sentence(anchors, found, axes)}; {_MIRROR}", _gauge_of(found, anchors), notes


_MIRROR = "no anchors are named for the origin and the axes, and the result may be a mirror image"


def _by_gauge(
    fitted: "Fitted", axes: int, chosen: list[int], known: Motion | None, decided: bool, notes: list[str]
) -> tuple[Motion, str, Gauge | None, list[str]]:
    """Frame through named anchors; if none is named for the left, points or the sketch decide the mirror image."""
    anchors, core, (origin, x_axis) = np.array(fitted.anchors), fitted.core, chosen[:2]
    position_m = fitted.solution.position_m if known is None else known.moved(fitted.solution.position_m)
    length = np.linalg.norm((position_m - position_m[origin])[:, :axes], axis=1)
    far = int(np.argmax(np.where(core, length, 0.0)))
    if length[x_axis] < _NEAR * length[far]:
        notes.append(
            f"anchor {anchors[x_axis]} defines the x axis from only {length[x_axis]:.1f} m away; "
            f"choose anchor {anchors[far]}, {length[far]:.1f} m away"
        )
    found = axes_through(position_m, core, axes, origin, x_axis, chosen[2] if len(chosen) > 2 else None)
    mirror = ""
    if len(chosen) > 2 and found.left is None:
        notes.append(f"anchor {anchors[chosen[2]]} stands on the x axis, so it cannot show which side is left")
    if len(chosen) < 3 and known is not None and decided and axes == 2:
        motion = found.motion
        if np.linalg.det(motion.rotation) < 0.0:
            motion = Motion(motion.rotation * [[1.0], [-1.0], [1.0]], motion.shift_m * [1.0, -1.0, 1.0])
        found = structs.replace(found, motion=motion, left=None)
    elif len(chosen) < 3 or found.left is None:
        mirror = "; no anchor on the left is named, so the result may be a mirror image"
    sentence = _sentence(anchors, found, axes) + mirror
    if known is not None:
        whole = Motion(found.motion.rotation @ known.rotation, found.motion.moved(known.shift_m))
        return whole, sentence, _gauge_of(found, anchors), notes
    return found.motion, sentence, _gauge_of(found, anchors), notes


def _left_of_points(fitted: "Fitted", motion: Motion) -> Motion:
    """The motion, mirrored if need be so that the first anchor clearly off the points' line is on its left."""
    points, core = fitted.measured.facts.points, fitted.core
    given = [number for number, anchor in enumerate(fitted.anchors) if anchor in points and core[number]]
    moved = motion.moved(fitted.solution.position_m)
    found = axes_through(moved, core, 2, given[0], given[1])
    if np.linalg.det(found.motion.rotation) > 0.0:
        return motion
    along = found.motion.rotation[0]
    mirror = 2.0 * np.outer(along, along) - np.eye(3)
    mirror[2, 2] = 1.0
    origin = moved[given[0]]
    whole = Motion(mirror, origin - mirror @ origin)
    return Motion(mirror @ motion.rotation, whole.moved(motion.shift_m))


def _best(fitted: "Fitted", points: dict[int, Point], std_m: float, axes: int) -> tuple[Motion | None, bool]:
    """The best motion to these points, None if they are too few, and whether they exclude the mirror image."""
    there_m, position_m = as_array(points, fitted.anchors), fitted.solution.position_m
    known = fitted.core & np.isfinite(there_m[:, :axes]).all(axis=1)
    if known.sum() < axes:
        return None, False
    there_m = np.where(np.isfinite(there_m), there_m, position_m)
    return align(position_m[known], there_m[known], std_m, axes)


def _sentence(anchors: Integers, found: Axes, axes: int) -> str:
    left = f", anchor {anchors[found.left]} on the left (y > 0)" if found.left is not None else ""
    level = "" if axes == 2 else "; these three lie at z = 0, as fewer than three heights are given"
    return f"anchor {anchors[found.origin]} is the origin, anchor {anchors[found.x_axis]} on the x axis{left}{level}"


def _gauge_of(axes: Axes, anchors: Integers) -> Gauge:
    left = None if axes.left is None else int(anchors[axes.left])
    return Gauge(int(anchors[axes.origin]), int(anchors[axes.x_axis]), left)


# Starts of a fit: the layout of ranges completed by shortest paths, the sketch, and perturbed layouts.
#
# Late ranges and paths around corners are too long, never too short, and so are completed distances. The starts differ
# enough that one of them unfolds. The random seed is derived from the data, so that equal data give equal starts.

_PERTURBED: Final = 6
_KEPT_SHARE: Final = 0.75  # ranges kept in a perturbed start; paths replace the others
_MOVED_SHARE: Final = 0.1  # standard deviation of a perturbed start's positions, as a share of the site's size


def start_positions(problem: Problem, sketch_m: Array | None = None) -> list[Array]:
    """Starting positions for a fit, each of shape (n, 3).

    ``sketch_m``: rough positions, shape (n, 3), NaN where there is none. Starts are aligned with the sketch and known
    coordinates. Coordinates that are not estimated are those of ``coordinate_m``.
    """
    axes = np.flatnonzero(problem.is_free.any(axis=0))
    distance_m = _known_distances(problem, axes)
    known_m = np.where(np.isfinite(problem.coordinate_variance_m2), problem.coordinate_m, np.nan)
    if sketch_m is not None:
        known_m = np.where(np.isnan(known_m), sketch_m, known_m)
    rng = np.random.default_rng(zlib.crc32(problem.range_m.tobytes()))
    laid_out = [_layout(_completed(distance_m), len(axes))]
    for _ in range(_PERTURBED):
        kept = np.triu(rng.random(distance_m.shape) < _KEPT_SHARE, 1)
        fewer_m = np.where(kept | kept.T, distance_m, np.inf)
        parts, _ = connected_components(np.isfinite(fewer_m), directed=False)
        position_m = _layout(_completed(fewer_m if parts == 1 else distance_m), len(axes))
        moved_m = _MOVED_SHARE * max(float(position_m.std()), 0.1)
        laid_out.append(position_m + rng.normal(0.0, moved_m, position_m.shape))
    starts = []
    if sketch_m is not None:
        nearby_m = _moved_to(laid_out[0], known_m, axes)
        starts.append(np.where(np.isnan(sketch_m), nearby_m, sketch_m))
    starts += [_moved_to(position_m, known_m, axes) for position_m in laid_out]
    fixed_m = np.where(np.isfinite(problem.coordinate_m), problem.coordinate_m, 0.0)
    return [np.where(problem.is_free, position_m, fixed_m) for position_m in starts]


def _known_distances(problem: Problem, axes: Integers) -> Array:
    """Distances along the estimated axes, shape (n, n); infinite where there is no range."""
    n = len(problem.is_free)
    first = np.concatenate([problem.first, problem.tape_first])
    second = np.concatenate([problem.second, problem.tape_second])
    length_m = np.maximum(np.concatenate([problem.range_m, problem.tape_m]), 0.0)
    others = np.setdiff1d(np.arange(3), axes)
    apart = np.nan_to_num(problem.coordinate_m[:, others])
    across = np.sum((apart[first] - apart[second]) ** 2, axis=1)
    along_m = np.sqrt(np.maximum(length_m**2 - across, 1e-4 * length_m**2))
    distance_m = np.full((n, n), np.inf)
    np.minimum.at(distance_m, (first, second), along_m)
    distance_m = np.minimum(distance_m, distance_m.T)
    np.fill_diagonal(distance_m, 0.0)
    return np.asarray(distance_m)


def _completed(distance_m: Array) -> Array:
    """Lengths of the shortest paths; unconnected parts of the site are as far apart as the longest path."""
    path_m = distance_m.copy()
    for middle in range(len(path_m)):
        np.minimum(path_m, path_m[:, middle, None] + path_m[middle], out=path_m)
    finite = np.isfinite(path_m)
    return np.asarray(np.where(finite, path_m, path_m[finite].max(initial=1.0)))


def _layout(distance_m: Array, dimensions: int) -> Array:
    """Classical multidimensional scaling, shape (n, dimensions)."""
    squared = distance_m**2
    centred = squared - squared.mean(axis=0) - squared.mean(axis=1)[:, None] + squared.mean()
    value, vector = np.linalg.eigh(-0.5 * centred)
    largest = np.argsort(value)[::-1][:dimensions]
    position_m = np.zeros((len(distance_m), dimensions))
    position_m[:, : len(largest)] = vector[:, largest] * np.sqrt(np.maximum(value[largest], 0.0))
    return position_m


def _moved_to(layout_m: Array, known_m: Array, axes: Integers) -> Array:
    """The layout, shape (n, dimensions), rotated, reflected and shifted to known coordinates; shape (n, 3)."""
    position_m = np.zeros((len(layout_m), 3))
    position_m[:, axes] = layout_m
    if 2 in axes and np.count_nonzero(np.isfinite(known_m[:, 2])) > 3:
        position_m = _levelled(position_m, known_m[:, 2])
    whole = np.isfinite(known_m[:, axes]).all(axis=1)
    flat = axes if np.count_nonzero(whole) > len(axes) else axes[axes < 2]
    known: Mask = np.asarray(np.isfinite(known_m[:, flat]).all(axis=1))
    if not flat.size or not known.any():
        return position_m
    return superimposed(position_m, np.nan_to_num(known_m), known.astype(np.float64), flat)


def _levelled(position_m: Array, height_m: Array) -> Array:
    """Positions rotated so that z best fits the known heights."""
    known = np.isfinite(height_m)
    centre = position_m[known].mean(axis=0)
    upwards = np.linalg.lstsq(position_m[known] - centre, height_m[known] - height_m[known].mean(), rcond=None)[0]
    if np.linalg.norm(upwards) < 1e-6:
        return position_m
    axes = np.linalg.qr(np.column_stack([upwards, np.eye(3)]))[0]
    axes = axes * np.sign(axes[:, 0] @ upwards)
    return np.asarray((position_m - centre) @ axes[:, [1, 2, 0]] + [0.0, 0.0, height_m[known].mean()])


# The shape: a fit of all anchors with enough ranges


_BENDS_M: Final = 0.03
_BENT_SIGMAS: Final = (-1.0, -0.5, 0.5, 1.0)
"""A shape with at least this standard deviation is also examined when bent by these multiples of it."""


class Fitted(RobustFit, frozen=True, eq=False):
    """The fit of the ``k`` anchors that have enough ranges, and its covariance."""

    measured: Measured
    kept: Integers
    """Shape (k,): indices of the fitted anchors."""
    pairs: tuple[PairRange, ...]
    core: Mask
    """Shape (k,): determined anchors."""
    covariance_m2: Array
    """Shape (4 k, 4 k), coordinates and delays, aligned over the core, or over all if no anchor is determined."""
    points_used: tuple[int, ...] = ()
    """Identifiers of the known points that hold the shape."""
    notes: tuple[str, ...] = ()

    @property
    def anchors(self) -> tuple[int, ...]:
        """Identifiers of the fitted anchors."""
        return tuple(self.measured.anchors[index] for index in self.kept)

    @property
    def silent(self) -> tuple[int, ...]:
        """Kept anchors without a range, whose delays nothing shows."""
        if not self.measured.facts.keep_positions:
            return ()
        ranged = {anchor for pair in self.pairs for anchor in (pair.a, pair.b)}
        return tuple(anchor for anchor in self.anchors if anchor not in ranged)


def fit_shape(measured: Measured, kept: Integers) -> Fitted:
    """Fit the shape, first without and then with known points, with the range error that the residuals show."""
    anchors = tuple(measured.anchors[index] for index in kept)
    sketch = as_array(measured.facts.sketch_m, anchors) if measured.facts.sketch_m else None
    point = as_array(measured.facts.points, anchors)
    if not np.isfinite(point[:, :2]).all(axis=1).any():
        return _round(measured, kept, sketch)
    is_held, moved, sketch, notes = _held_by_points(_round(measured, kept, sketch), point, sketch)
    used = tuple(anchor for anchor, chosen in zip(anchors, is_held, strict=True) if chosen)
    fitted = _round(measured, kept, sketch, used, () if moved is None else (moved,))
    return structs.replace(fitted, notes=tuple(notes))


def _round(
    measured: Measured,
    kept: Integers,
    sketch: Array | None,
    points_used: tuple[int, ...] = (),
    extra: tuple[Array, ...] = (),
) -> Fitted:
    """Fit the shape with these points; ``extra``: further starts."""
    problem, pairs = build_problem(measured, kept, _points(measured, kept, points_used), sketch)
    # Starts only need the sketch; known points take part in the fit.
    robust = fit_robustly(problem, [*start_positions(problem, sketch), *extra], measured.facts.pair_std_m)
    if sketch is not None:
        robust = structs.replace(robust, solution=_in_sketch_frame(robust, sketch))
    return _determined(_fitted(measured, kept, robust, pairs, points_used))


def _fitted(
    measured: Measured,
    kept: Integers,
    robust: RobustFit,
    pairs: tuple[PairRange, ...],
    points_used: tuple[int, ...] = (),
) -> Fitted:
    """The fit with all anchors in the core, before its covariance is known."""
    everyone, unknown = np.ones(len(kept), bool), np.zeros((0, 0))
    return Fitted(
        **structs.asdict(robust),
        measured=measured,
        kept=kept,
        pairs=pairs,
        core=everyone,
        covariance_m2=unknown,
        points_used=points_used,
    )


def _determined(fitted: Fitted) -> Fitted:
    """The fit with its determined anchors, and the covariance aligned over them; kept positions stay determined."""
    measured, problem, solution = fitted.measured, fitted.problem, fitted.solution
    if measured.facts.keep_positions:
        return structs.replace(fitted, covariance_m2=_covariance_of_kept(fitted))
    weight, surveyed, everyone = (
        fitted.used.astype(np.float64),
        surveyed_problem(fitted),
        np.ones(len(fitted.kept), bool),
    )
    least = 1 if fitted.points_used else 3 if levels(measured) else 4
    core = determined_core(surveyed, solution.position_m, least, weight)
    aligned_over = core if core.any() else everyone
    covariance = aligned_covariance(surveyed, solution.position_m, aligned_over, weight)
    for direction in weak_directions(surveyed, covariance, core, 0.02, 4):
        if folds(surveyed, solution.position_m, solution.delay_m, weight, direction):
            core = core & ~direction.anchors
    flat = may_be_flat(surveyed, solution.position_m, solution.delay_m, weight, 2 if levels(measured) else 3)
    if core.sum() < least or flat:
        core = ~everyone
    if core.any():
        covariance = _largest_nearby(problem, solution.position_m, weight, core)
    return structs.replace(fitted, core=core, covariance_m2=covariance)


def _largest_nearby(problem: Problem, position_m: Array, weight: Array, core: Mask) -> Array:
    """The largest covariance, aligned over the core, of shapes within 1 σ along the least certain direction.

    Errors bend a shape that is held only by expected delays, and a bent shape seems to be held by its ranges.
    """
    found = [aligned_covariance(problem, position_m, core, weight)]
    for direction in weak_directions(problem, found[0], core, _BENDS_M, 1):
        steps = (sigma * direction.std_m * direction.shift_m for sigma in _BENT_SIGMAS)
        found += [aligned_covariance(problem, position_m + step, core, weight) for step in steps]
    return max(found, key=lambda one: float(np.trace(one[: 3 * len(core), : 3 * len(core)])))


def _in_sketch_frame(robust: RobustFit, sketch: Array) -> Solution:
    known, problem, position_m = np.isfinite(sketch[:, :2]).all(axis=1), robust.problem, robust.solution.position_m
    if known.sum() < 2:
        return robust.solution
    axes = 3 if problem.is_free[:, 2].all() and np.isfinite(sketch[known]).all() and known.sum() > 2 else 2
    there = np.where(np.isfinite(sketch), sketch, position_m)
    moved = align(position_m[known], there[known], 0.3, axes)[0].moved(position_m)
    return solve_least_squares(problem, np.where(problem.is_free, moved, position_m), robust.weight)


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
    stds = position_stds_m(free.problem, free.covariance_m2)
    std = math.hypot(facts.point_std_m, float(np.median(stds[tested])))
    motion, _ = align(position[good], there[fits], std, axes)
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


def redundancy(fitted: Fitted) -> int:
    """Measurements in use less the unknowns that they determine; delays known as well as a range are no unknowns.

    If positions are kept, all delays count as unknown, as the errors of positions make every range a poor one.
    """
    if fitted.measured.facts.keep_positions:
        delays = incidence(len(fitted.kept), fitted.problem.first, fitted.problem.second)[fitted.used]
        return len(delays) - int(np.linalg.matrix_rank(delays)) if len(delays) else 0
    problem, _ = with_free_delays(surveyed_problem(fitted))
    rows = jacobian(problem, fitted.solution.position_m, fitted.used.astype(np.float64))
    return int(np.any(rows != 0.0, axis=1).sum()) - rank(rows)


def surveyed_problem(fitted: Fitted) -> Problem:
    """The problem without the sketch, which determines nothing."""
    points = _points(fitted.measured, fitted.kept, fitted.points_used)
    variance = build_problem(fitted.measured, fitted.kept, points)[0].coordinate_variance_m2
    return structs.replace(fitted.problem, coordinate_variance_m2=variance)


def _points(measured: Measured, kept: Integers, used: tuple[int, ...]) -> Array | None:
    """Coordinates of the points in use, shape (k, 3), NaN for other anchors; None without any."""
    points = {anchor: measured.facts.points[anchor] for anchor in used}
    return as_array(points, tuple(measured.anchors[index] for index in kept)) if points else None


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
            problem = structs.replace(fitted.problem, more=(*fitted.problem.more, joint.rows))
            fitted = structs.replace(fitted, problem=problem, solution=joint.solution, used=used[joint.chosen])
            fitted = _determined(fitted)
            others = tuple(others[number - 1] for number in joint.possible if number and number != joint.chosen)
        fitted = structs.replace(fitted, notes=notes)
    return fitted, others


# Only delays, of anchors whose positions are kept


def fit_delays(measured: Measured, kept: Integers) -> Fitted:
    """Fit the delays of anchors whose positions, those of the sketch, stay; their errors count as errors of ranges."""
    facts = measured.facts
    position_m = as_array(facts.sketch_m, tuple(measured.anchors[index] for index in kept))
    position_m[:, 2] = np.where(np.isnan(position_m[:, 2]), fixed_heights_m(measured)[kept], position_m[:, 2])
    problem, pairs = build_problem(measured, kept)
    problem = structs.replace(
        problem,
        is_free=np.zeros((len(kept), 3), bool),
        coordinate_m=position_m,
        variance_m2=problem.variance_m2 + 2.0 * facts.sketch_std_m**2,
    )
    fit = fit_robustly(problem, [position_m], math.hypot(facts.pair_std_m, math.sqrt(2.0) * facts.sketch_std_m))
    range_m2 = max(fit.range_std_m**2 - 2.0 * facts.sketch_std_m**2, facts.pair_std_m**2)
    robust = structs.replace(fit, range_std_m=math.sqrt(range_m2))
    return _determined(_fitted(measured, kept, robust, pairs))


def _covariance_of_kept(fitted: Fitted) -> Array:
    """Covariance of kept positions, and of delays with the positions' errors, which an anchor's ranges share."""
    problem, solution, facts = fitted.problem, fitted.solution, fitted.measured.facts
    k, m, dimensions = len(fitted.kept), len(problem.first), facts.dimensions
    of_tags = np.zeros((4 * k, 4 * k))
    for more in problem.more:
        rows, _ = more.rows(solution.position_m, solution.delay_m)
        of_tags += rows.T @ rows
    by_tags = of_tags[3 * k :, : 3 * k].reshape(k, k, 3)[:, :, :dimensions]
    of_tags = of_tags[3 * k :, 3 * k :]
    weight = fitted.used / problem.variance_m2
    delays = incidence(k, problem.first, problem.second)
    prior = delay_weights(problem).T @ delay_weights(problem)
    inverse = np.linalg.inv(delays.T @ (weight[:, None] * delays) + prior + of_tags)
    gain = inverse @ (delays.T * weight)
    shift = distance_derivatives(solution.position_m, problem.first, problem.second)[:, :, :dimensions]
    moved = gain @ shift.reshape(m, k * dimensions) + inverse @ by_tags.reshape(k, -1)
    noise = np.maximum(problem.variance_m2 - 2.0 * facts.sketch_std_m**2, 0.0)
    covariance = np.zeros((4 * k, 4 * k))
    covariance[: 3 * k, : 3 * k] = np.diag(np.tile(np.arange(3) < dimensions, k) * facts.sketch_std_m**2)
    covariance[3 * k :, 3 * k :] = (
        (gain * noise) @ gain.T + facts.sketch_std_m**2 * moved @ moved.T + inverse @ (prior + of_tags) @ inverse
    )
    return covariance
