"""A shape's frame: named anchors, known points, the sketch, or by default the first and the farthest anchor.

Ranges leave a shape free to turn, to shift and to be mirrored.
"""

from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array, Integers, Mask
from skyless.site.survey._build import Measured, as_array, levels
from skyless.site.survey.facts import Gauge, Point
from skyless.site.survey.fit.problem import distances_m
from skyless.site.survey.result import anchors_named, joined

# Alignments, and frames through anchors


_DECIDED: Final = 16.0
"""Difference of the costs of an alignment and its mirror image from which on the better one is right."""

_OFF_AXIS: Final = 0.1  # distance from the x axis, as a part of its length, from which on an anchor's side is clear
_MAX_SIGMA: Final = 3.0


class Motion(Struct, frozen=True, eq=False):
    """A rotation, perhaps with a reflection, and then a shift."""

    rotation: Array
    """Shape (3, 3)."""
    shift_m: Array
    """Shape (3,)."""

    def moved(self, position_m: Array) -> Array:
        """Positions of shape (..., 3)."""
        return np.asarray(position_m @ self.rotation.T + self.shift_m)


class Alignment(Struct, frozen=True, eq=False):
    """The motion that fits one set of positions to another best."""

    motion: Motion
    mirror_decided: bool
    """Whether the mirror image fits worse."""


def align(position_m: Array, other_m: Array, std_m: float, axes: int) -> Alignment:
    """Least squares without scale, positions of shape (k, 3); ``axes`` 2: about the vertical, z stays as it is.

    ``std_m``: of both sets' difference per axis, shape (k,) or one for all; decides about mirror images only.
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
    return Alignment(best[2], decided)


def fitting_points(position_m: Array, covariance_m2: Array, point_m: Array, point_std_m: float) -> Mask:
    """Which points agree about the distances between them, shape (k,); ``covariance_m2`` of shape (3 k, 3 k).

    The point that contradicts most others leaves, until none does. Two points alone that contradict each other stay.
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
    side_decided: bool
    """Whether an anchor stands clearly on the left."""


def axes_through(
    position_m: Array, usable: Mask, axes: int, origin: int, x_axis: int | None = None, left: int | None = None
) -> Axes:
    """The frame with ``origin`` at 0, ``x_axis`` on +x and ``left`` at y > 0; at least two anchors are usable.

    By default the farthest anchor names the x axis, and the first one that is clearly off it the left. ``axes`` 2: z
    stays as it is; 3: the three anchors lie at z = 0, and the first one that is clearly off their plane above it.
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
    return Axes(Motion(rotation, shift), origin, x_axis, chosen if decided else None, decided)


def _first(chosen: Mask) -> int | None:
    found = np.flatnonzero(chosen)
    return int(found[0]) if found.size else None


def _perpendicular(along: Array, axes: int) -> Array:
    if axes == 2:
        return np.array([-along[1], along[0], 0.0])
    other = np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
    return np.asarray(other / np.linalg.norm(other))


# The frame that the facts name


_NEAR: Final = 0.5
"""Distance of the x axis's anchor from the origin, as a part of the farthest one's, below which advice is due."""


class Framed(Struct, frozen=True, eq=False):
    """A shape in its frame. ``k`` anchors."""

    motion: Motion
    position_m: Array
    """Shape (k, 3)."""
    covariance_m2: Array
    """Shape (k, 3, 3)."""
    sentence: str
    gauge: Gauge | None
    notes: tuple[str, ...]


def in_frame(
    measured: Measured,
    kept: Integers,
    position_m: Array,
    covariance_m2: Array,
    core: Mask,
    points_used: tuple[int, ...],
) -> Framed:
    """Move positions, shape (k, 3), and their covariance, shape (4 k, 4 k), to the frame that the facts name."""
    anchors = np.array([measured.anchors[index] for index in kept])
    motion, sentence, gauge, notes = _motion(measured, anchors, position_m, core, points_used)
    k = len(kept)
    blocks = covariance_m2[: 3 * k, : 3 * k].reshape(k, 3, k, 3)[np.arange(k), :, np.arange(k)]
    rotated = motion.rotation @ blocks @ motion.rotation.T
    return Framed(motion, motion.moved(position_m), rotated, sentence, gauge, tuple(notes))


def _motion(
    measured: Measured, anchors: Integers, position_m: Array, core: Mask, points_used: tuple[int, ...]
) -> tuple[Motion, str, Gauge | None, list[str]]:
    axes = 2 if levels(measured) else 3
    still = Motion(np.eye(3), np.zeros(3))
    facts = measured.facts
    by_points, points_decide = _best(facts.points, max(facts.point_std_m, 0.03), anchors, position_m, core, axes)
    by_sketch, sketch_decides = _best(facts.sketch_m, facts.sketch_std_m, anchors, position_m, core, axes)
    decided = points_decide or sketch_decides
    gauge, notes = facts.gauge, _level_notes(measured)
    if gauge is not None:
        index = {int(anchor): number for number, anchor in enumerate(anchors) if core[number]}
        named = [gauge.origin, gauge.x_axis, *([] if gauge.left is None else [gauge.left])]
        missing = [anchor for anchor in dict.fromkeys(named) if anchor not in index]
        if not missing and len(set(named)) == len(named):
            chosen = [index[anchor] for anchor in named]
            return _by_gauge(anchors, position_m, core, axes, chosen, by_points or by_sketch, decided, notes)
        has = "has" if len(missing) == 1 else "have"
        why = f"{anchors_named(missing)} {has} no position" if missing else "one anchor is named twice"
        notes.append(f"the frame cannot be defined by anchors {joined(named)}: {why}")
    mirror = "" if decided else "; the ranges do not show whether this is a mirror image: name an anchor on the left"
    if by_points is not None:
        motion = still if points_used else by_points
        if not decided and axes == 2:
            motion = _left_of_points(measured, anchors, motion, position_m, core)
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
    anchors: Integers,
    position_m: Array,
    core: Mask,
    axes: int,
    chosen: list[int],
    known: Motion | None,
    decided: bool,
    notes: list[str],
) -> tuple[Motion, str, Gauge | None, list[str]]:
    """Axes through named anchors; if none is named for the left, points or the sketch choose the mirror image."""
    origin, x_axis = chosen[:2]
    if known is not None:
        position_m = known.moved(position_m)
    length = np.linalg.norm((position_m - position_m[origin])[:, :axes], axis=1)
    far = int(np.argmax(np.where(core, length, 0.0)))
    if length[x_axis] < _NEAR * length[far]:
        notes.append(
            f"anchor {anchors[x_axis]} defines the x axis from only {length[x_axis]:.1f} m away; "
            f"choose anchor {anchors[far]}, {length[far]:.1f} m away"
        )
    found = axes_through(position_m, core, axes, origin, x_axis, chosen[2] if len(chosen) > 2 else None)
    mirror = ""
    if len(chosen) > 2 and not found.side_decided:
        notes.append(f"anchor {anchors[chosen[2]]} stands on the x axis, so it cannot show which side is left")
    if len(chosen) < 3 and known is not None and decided and axes == 2:
        motion = found.motion
        if np.linalg.det(motion.rotation) < 0.0:
            motion = Motion(motion.rotation * [[1.0], [-1.0], [1.0]], motion.shift_m * [1.0, -1.0, 1.0])
        found = Axes(motion, found.origin, found.x_axis, None, True)
    elif len(chosen) < 3 or not found.side_decided:
        mirror = "; no anchor on the left is named, so the result may be a mirror image"
    sentence = _sentence(anchors, found, axes) + mirror
    if known is not None:
        whole = Motion(found.motion.rotation @ known.rotation, found.motion.moved(known.shift_m))
        return whole, sentence, _gauge_of(found, anchors), notes
    return found.motion, sentence, _gauge_of(found, anchors), notes


def _left_of_points(measured: Measured, anchors: Integers, motion: Motion, position_m: Array, core: Mask) -> Motion:
    """The mirror image that has the first anchor clearly off the points' line on its left."""
    given = [number for number, anchor in enumerate(anchors) if int(anchor) in measured.facts.points and core[number]]
    moved = motion.moved(position_m)
    found = axes_through(moved, core, 2, given[0], given[1])
    if np.linalg.det(found.motion.rotation) > 0.0:
        return motion
    along = found.motion.rotation[0]
    mirror = 2.0 * np.outer(along, along) - np.eye(3)
    mirror[2, 2] = 1.0
    origin = moved[given[0]]
    whole = Motion(mirror, origin - mirror @ origin)
    return Motion(mirror @ motion.rotation, whole.moved(motion.shift_m))


def _best(
    points: dict[int, Point], std_m: float, anchors: Integers, position_m: Array, core: Mask, axes: int
) -> tuple[Motion | None, bool]:
    """The motion to these points, and whether they exclude the mirror image."""
    there_m = as_array(points, tuple(anchors.tolist()))
    known = core & np.isfinite(there_m[:, :axes]).all(axis=1)
    if known.sum() < axes:
        return None, False
    there_m = np.where(np.isfinite(there_m), there_m, position_m)
    alignment = align(position_m[known], there_m[known], std_m, axes)
    return alignment.motion, alignment.mirror_decided


def _sentence(anchors: Integers, found: Axes, axes: int) -> str:
    left = f", anchor {anchors[found.left]} on the left (y > 0)" if found.left is not None else ""
    level = "" if axes == 2 else "; these three lie at z = 0, as fewer than three heights are given"
    return f"anchor {anchors[found.origin]} is the origin, anchor {anchors[found.x_axis]} on the x axis{left}{level}"


def _level_notes(measured: Measured) -> list[str]:
    if levels(measured):
        return []
    return ["the site may be tilted: give the heights of three anchors that are not on one line"]


def _gauge_of(axes: Axes, anchors: Integers) -> Gauge:
    left = None if axes.left is None else int(anchors[axes.left])
    return Gauge(int(anchors[axes.origin]), int(anchors[axes.x_axis]), left)
