"""Frames: what names origin and axes of a shape that ranges leave free to turn, to shift and to be mirrored."""

from typing import Final

import numpy as np
from msgspec import Struct

from skyless.kernels.arrays import Array, Mask
from skyless.survey.fit.links import distances_m

_DECIDED: Final = 16.0
"""Difference of the costs of an alignment and its mirror image from which on the better one is right."""

_OFF_AXIS: Final = 0.1
"""Distance from the x axis, as a part of its length, from which on an anchor's side is clear."""

_MOST_SIGMA: Final = 3.0


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


def superimposed(position_m: Array, target_m: Array, weight: Array) -> Array:
    """Positions rotated, shifted and perhaps reflected to fit a target best (the weighted Procrustes problem).

    ``position_m``, ``target_m``: shape (n, d). ``weight``: of each anchor's squared distance, shape (n,), not all 0.
    """
    centre = np.average(position_m, axis=0, weights=weight)
    goal = np.average(target_m, axis=0, weights=weight)
    left, _, right = np.linalg.svd((weight[:, None] * (position_m - centre)).T @ (target_m - goal))
    return np.asarray((position_m - centre) @ (left @ right) + goal)


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
        wrong = against > _MOST_SIGMA
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
