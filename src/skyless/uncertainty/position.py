"""From the noise of TDoAs to that of the position, at one place or at very many.

To first order the covariance of the estimate of ``positioning/least_squares.py``: weighted (HᵀΣ⁻¹H)⁻¹, not weighted
G·Σ·Gᵀ with G = (HᵀH)⁻¹Hᵀ, H the gradient of the TDoAs. Because Σ is a diagonal and a number common to all, the weighted
case is that of pseudoranges whose clock is unknown, so that ``dop`` and this share their geometry and both cost a few
operations per anchor.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyless.compiled import kernel, threaded_kernel
from skyless.uncertainty.cholesky import factorise, invert
from skyless.uncertainty.dop import add_anchor, direction
from skyless.uncertainty.tdoa import own_and_common

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_COMMON = 1e-12
"""A reference without noise counts with this part of the others' variance, which keeps its weight finite."""


def position_covariance(
    anchors_m: ArrayLike,
    positions_m: ArrayLike,
    tdoa_covariance_m2: ArrayLike,
    *,
    height_known: bool,
    weighted: bool,
    in_view: Mask | None = None,
) -> Array:
    """Covariance of positions located by TDoAs, shape (m, 3, 3), in m².

    ``anchors_m``: shape (n + 1, 3), the reference first. ``positions_m``: shape (m, 3). ``tdoa_covariance_m2``: Σ,
    shape (n, n), of the form that ``uncertainty/tdoa.py`` gives. A known height has zeros. ``in_view``: shape
    (m, n + 1), which anchors each place hears; without the reference there are no TDoAs. All elements are infinite
    where the position is not determined or has no direction to some anchor. Threads may share the places between them.

    Raises:
        ValueError: Σ has another form, or the shapes do not fit each other.
    """
    anchors = np.ascontiguousarray(anchors_m, np.float64)
    positions = np.ascontiguousarray(positions_m, np.float64).reshape(-1, 3)
    own, common = own_and_common(np.asarray(tdoa_covariance_m2, np.float64))
    if anchors.shape != (len(own) + 1, 3):
        raise ValueError(f"anchors {anchors.shape} and {len(own)} TDoAs: expected ({len(own) + 1}, 3)")
    variances = np.concatenate([[max(common, _LEAST_COMMON * float(own.max(initial=0.0)))], own])
    seen = np.ones((1, len(anchors)), np.bool_) if in_view is None else np.ascontiguousarray(in_view, np.bool_)
    if seen.shape not in {(1, len(anchors)), (len(positions), len(anchors))}:
        raise ValueError(f"in_view {seen.shape}: expected ({len(positions)}, {len(anchors)})")
    covariance = np.full((len(positions), 3, 3), math.inf)
    fill = _fill_weighted if weighted else _fill_unweighted
    fill(anchors, positions, variances, seen, 2 if height_known else 3, np.empty((3, 4, 4)), covariance)
    return covariance


def pseudorange_covariance(
    anchors_m: ArrayLike,
    positions_m: ArrayLike,
    variances_m2: ArrayLike,
    *,
    height_known: bool,
    in_view: Mask | None = None,
) -> Array:
    """Covariance of positions located by pseudoranges of independent noise, shape (m, 3, 3), in m².

    ``anchors_m``: shape (n, 3), ``variances_m2``: shape (n,); any of the anchors may be out of view.
    """
    anchors = np.ascontiguousarray(anchors_m, np.float64)
    positions = np.ascontiguousarray(positions_m, np.float64).reshape(-1, 3)
    variances = np.ascontiguousarray(variances_m2, np.float64)
    seen = np.ones((1, len(anchors)), np.bool_) if in_view is None else np.ascontiguousarray(in_view, np.bool_)
    covariance = np.full((len(positions), 3, 3), math.inf)
    dims = 2 if height_known else 3
    _fill_pseudoranges(anchors, positions, variances, seen, dims, np.empty((3, 4, 4)), covariance)
    return covariance


@threaded_kernel
def _fill_weighted(
    anchors: Array, positions: Array, variances: Array, seen: Mask, dims: int, work: Array, covariance: Array
) -> None:
    for k in range(len(positions)):
        view = seen[k if len(seen) > 1 else 0]
        if view[0]:
            _pseudoranges_at(anchors, positions[k], variances, view, dims, work, covariance[k])


@threaded_kernel
def _fill_pseudoranges(
    anchors: Array, positions: Array, variances: Array, seen: Mask, dims: int, work: Array, covariance: Array
) -> None:
    for k in range(len(positions)):
        view = seen[k if len(seen) > 1 else 0]
        _pseudoranges_at(anchors, positions[k], variances, view, dims, work, covariance[k])


@kernel
def _pseudoranges_at(
    anchors: Array, position: Array, variances: Array, view: Mask, dims: int, work: Array, covariance: Array
) -> None:
    """Covariance at one place; the clock, which comes first in the normal matrix, is left out of it."""
    normal, inverse = work[0], work[1]
    normal[:] = 0.0
    for i in range(len(anchors)):
        if view[i] and not add_anchor(anchors, i, position, 1.0 / variances[i], normal):
            return
    if not factorise(normal, dims + 1):
        return
    invert(normal, dims + 1, inverse)
    covariance[:] = 0.0
    for p in range(dims):
        for q in range(dims):
            covariance[p, q] = inverse[1 + p, 1 + q]


@threaded_kernel
def _fill_unweighted(
    anchors: Array, positions: Array, variances: Array, seen: Mask, dims: int, work: Array, covariance: Array
) -> None:
    normal, spread, inverse = work[0], work[1], work[2]
    for k in range(len(positions)):
        view = seen[k if len(seen) > 1 else 0]
        determined = view[0] and _differences(anchors, positions[k], variances, view, normal, spread)
        if not (determined and factorise(normal, dims)):
            continue
        invert(normal, dims, inverse)
        covariance[k] = 0.0
        for p in range(dims):
            for q in range(dims):
                total = 0.0
                for r in range(dims):
                    for s in range(dims):
                        total += inverse[p, r] * spread[r, s] * inverse[s, q]
                covariance[k, p, q] = total


@kernel
def _differences(anchors: Array, position: Array, variances: Array, view: Mask, normal: Array, spread: Array) -> bool:
    """Write HᵀH into ``normal`` and HᵀΣH into ``spread``, rows of H being differences of directions."""
    normal[:] = 0.0
    spread[:] = 0.0
    reference = direction(anchors, 0, position)
    total = spread[3]
    for i in range(1, len(anchors)):
        if not view[i]:
            continue
        towards = direction(anchors, i, position)
        for p in range(3):
            row_p = towards[p] - reference[p]
            if math.isnan(row_p):
                return False
            total[p] += row_p
            for q in range(3):
                product = row_p * (towards[q] - reference[q])
                normal[p, q] += product
                spread[p, q] += variances[i] * product
    for p in range(3):
        for q in range(3):
            spread[p, q] += variances[0] * total[p] * total[q]
    return True
