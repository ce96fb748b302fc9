"""Starts of a fit: ranges completed by shortest paths and laid out, the sketch, and perturbed ones.

Ranges that come late and paths around corners are too long, never too short: so are the distances that are filled in.
Several starts differ enough that one of them unfolds. What is random is drawn from the data: equal data, equal starts.
"""

import zlib
from typing import Final

import numpy as np
from scipy.sparse.csgraph import connected_components

from skyless.core.arrays import Array, Integers, Mask
from skyless.site.survey.fit.problem import Problem, superimposed

_PERTURBED: Final = 6
_KEPT_SHARE: Final = 0.75  # ranges kept in a perturbed start; the others are filled in by paths
_MOVED_SHARE: Final = 0.1  # standard deviation of a perturbed start's positions, of the site's size


def start_positions(problem: Problem, sketch_m: Array | None = None) -> list[Array]:
    """Positions, each of shape (n, 3), from which a fit should be tried.

    ``sketch_m``: rough positions, shape (n, 3), NaN where there is none. Starts are moved to fit it and known
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
    """Distances along the axes that are estimated, shape (n, n); infinite where there is no range."""
    n = len(problem.delay_m)
    first = np.concatenate([problem.first, problem.tape_first])
    second = np.concatenate([problem.second, problem.tape_second])
    delays = problem.delay_m[problem.first] + problem.delay_m[problem.second]
    length_m = np.maximum(np.concatenate([problem.range_m - delays, problem.tape_m]), 0.0)
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
    """Lengths of the shortest paths; parts of the site that nothing connects stand as far apart as the longest path."""
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
    return _aligned(position_m, known_m, flat) if flat.size else position_m


def _levelled(position_m: Array, height_m: Array) -> Array:
    """Rotated so that z fits the known heights best."""
    known = np.isfinite(height_m)
    centre = position_m[known].mean(axis=0)
    upwards = np.linalg.lstsq(position_m[known] - centre, height_m[known] - height_m[known].mean(), rcond=None)[0]
    if np.linalg.norm(upwards) < 1e-6:
        return position_m
    axes = np.linalg.qr(np.column_stack([upwards, np.eye(3)]))[0]
    axes = axes * np.sign(axes[:, 0] @ upwards)
    return np.asarray((position_m - centre) @ axes[:, [1, 2, 0]] + [0.0, 0.0, height_m[known].mean()])


def _aligned(position_m: Array, known_m: Array, axes: Integers) -> Array:
    """Moved rigidly, or reflected, along some axes to anchors known in all of these."""
    known: Mask = np.asarray(np.isfinite(known_m[:, axes]).all(axis=1))
    if not known.any():
        return position_m
    moved_m = position_m.copy()
    moved_m[:, axes] = superimposed(position_m[:, axes], np.nan_to_num(known_m[:, axes]), known.astype(np.float64))
    return moved_m
