"""What a cause does to the ranges of all pairs, and how much evidence there is for it.

A cause is an anchor's displacement (its ranges change by the projection on their directions), an anchor's delay (they
all change by as much), or one late link. Its evidence is by how much chi-squared falls when it is allowed for. Causes
are numbered: displacements of the ``n`` anchors, their delays, then the ``m`` links.
"""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from msgspec import Struct
from scipy.special import chdtri

from skyless.kernels.arrays import Array, Integers, Mask

_LEAST_INFORMATION_PER_M2: Final = 4.0
"""A displacement in a direction in which its standard deviation exceeds half a metre is not seen."""

_SHARED: Final = 0.25
"""Correlation of two pairs that share an anchor, as TX noise makes up half of a range's variance."""

_STEPS: Final = 8
_SMALLEST_STEP_M: Final = 1e-4


class Pairs(Struct, frozen=True, eq=False):
    """What is compared in a window: ``m`` pairs of ``n`` anchors."""

    position_m: Array
    """Shape (n, 3), where the anchors should be."""
    first: Integers
    second: Integers
    """Shape (m,): indices of each pair's anchors."""
    dimensions: int
    weight: Array
    """Shape (m, m): inverse covariance of the pairs' changes."""

    @property
    def anchors(self) -> int:
        """Number of anchors."""
        return len(self.position_m)

    @property
    def causes(self) -> int:
        """Number of causes."""
        return 2 * len(self.position_m) + len(self.first)


class Fit(Struct, frozen=True, eq=False):
    """Changes explained by a set of causes."""

    chi2: float
    """That is left."""
    residual_m: Array
    """Shape (m,)."""
    parameter_m: tuple[Array, ...]
    """Of each cause: its displacement, or its delay or lateness alone."""
    covariance_m2: tuple[Array, ...]
    columns: Array
    """Shape (m, k): derivatives of the changes with respect to all parameters, at the solution."""


def weight_of(first: Integers, second: Integers, anchors: int, white_m: Array, drift_m: Array) -> Array:
    """Inverse covariance, shape (m, m), of changes with white noise of stamps and drift, each shape (m,)."""
    rows = np.arange(len(first))
    shared = np.zeros((len(first), anchors))  # what an anchor's TX noise does to its pairs
    shared[rows, first] = shared[rows, second] = math.sqrt(_SHARED) * white_m
    own = 1.0 / ((1.0 - 2.0 * _SHARED) * white_m**2 + drift_m**2)
    weighted = own[:, None] * shared
    inner = np.linalg.inv(np.eye(anchors) + shared.T @ weighted)  # of anchors, not of pairs: the matrix inversion lemma
    weight: Array = -(weighted @ inner) @ weighted.T
    weight[rows, rows] += own
    return weight


def evidence(pairs: Pairs, weight: Array, weighted_m: Array) -> tuple[Array, Integers]:
    """Of each cause alone: the fall of chi-squared, shape (..., causes), and its degrees of freedom, shape (causes,).

    ``weight``: shape (m, m), with what other causes explain already taken out. ``weighted_m``: ``weight`` times the
    changes, shape (..., m).
    """
    n, dim, m = pairs.anchors, pairs.dimensions, len(pairs.first)
    moved = _moved_columns(pairs, pairs.position_m).reshape(m, n * dim)
    delayed = _delay_columns(pairs)
    products = (weight @ moved).reshape(m, n, dim)
    information, directions = np.linalg.eigh(np.einsum("pid,pie->ide", moved.reshape(m, n, dim), products))
    is_seen = information > _LEAST_INFORMATION_PER_M2
    along = np.einsum("ide,...id->...ie", directions, (weighted_m @ moved).reshape(*weighted_m.shape[:-1], n, dim))
    of_moved = np.where(is_seen, along**2 / np.where(is_seen, information, 1.0), 0.0).sum(axis=-1)
    of_delay, delay_seen = _scalar(weighted_m @ delayed, np.einsum("pi,pi->i", delayed, weight @ delayed))
    of_link, link_seen = _scalar(weighted_m, np.diagonal(weight))
    return (
        np.concatenate([of_moved, of_delay, of_link], axis=-1),
        np.concatenate([is_seen.sum(axis=-1), delay_seen, link_seen]).astype(np.int64),
    )


def _scalar(along: Array, information: Array) -> tuple[Array, Mask]:
    is_seen = information > _LEAST_INFORMATION_PER_M2
    return np.asarray(np.where(is_seen, along**2 / np.where(is_seen, information, 1.0), 0.0)), is_seen


def thresholds(dof: Integers, probability: float) -> Array:
    """What chi-squared exceeds by chance with that probability, in any of the causes; infinite without a freedom."""
    found = np.full(len(dof), np.inf)
    seen = dof > 0
    found[seen] = chdtri(dof[seen], probability / max(int(seen.sum()), 1))
    return found


def fit(pairs: Pairs, change_m: Array, causes: Sequence[int], scratch: Fit | None = None) -> Fit:
    """Least squares of these causes together; displacements may be as large as they like.

    ``change_m``: shape (m,). ``scratch``: the fit of all but the last cause, where to begin.
    """
    sizes = [pairs.dimensions if cause < pairs.anchors else 1 for cause in causes]
    ends = np.cumsum(sizes, dtype=np.int64)
    parameter = np.zeros(int(ends[-1]) if sizes else 0)
    if scratch is not None and scratch.parameter_m:
        start = np.concatenate(scratch.parameter_m)
        parameter[: len(start)] = start
    columns, predicted = _model(pairs, causes, ends, parameter)
    moves = any(cause < pairs.anchors for cause in causes)
    for _ in range(_STEPS if moves else 1):
        residual = change_m - predicted
        step = _inverse(columns.T @ pairs.weight @ columns) @ (columns.T @ (pairs.weight @ residual))
        parameter = parameter + step
        columns, predicted = _model(pairs, causes, ends, parameter)
        if not len(step) or np.abs(step).max() < _SMALLEST_STEP_M:
            break
    residual = change_m - predicted
    covariance = _inverse(columns.T @ pairs.weight @ columns)
    spans = [slice(end - size, end) for size, end in zip(sizes, ends.tolist(), strict=True)]
    return Fit(
        float(residual @ pairs.weight @ residual),
        residual,
        tuple(parameter[span] for span in spans),
        tuple(covariance[span, span] for span in spans),
        columns,
    )


def weight_without(pairs: Pairs, found: Fit) -> Array:
    """The weight of what the causes of a fit leave unexplained."""
    if not found.columns.shape[1]:
        return pairs.weight
    weighted = pairs.weight @ found.columns
    return np.asarray(pairs.weight - weighted @ _inverse(found.columns.T @ weighted) @ weighted.T)


def _inverse(information: Array) -> Array:
    """Without the directions that are not seen."""
    values, vectors = np.linalg.eigh(information)
    is_seen = values > _LEAST_INFORMATION_PER_M2
    return np.asarray((vectors * np.where(is_seen, 1.0 / np.where(is_seen, values, 1.0), 0.0)) @ vectors.T)


def _moved_columns(pairs: Pairs, position_m: Array) -> Array:
    """Shape (m, n, dim): by how much each pair's distance grows when an anchor moves."""
    apart = (position_m[pairs.first] - position_m[pairs.second])[:, : pairs.dimensions]
    distance = np.linalg.norm(position_m[pairs.first] - position_m[pairs.second], axis=1)
    unit = apart / np.maximum(distance, 1e-6)[:, None]
    columns = np.zeros((len(pairs.first), pairs.anchors, pairs.dimensions))
    rows = np.arange(len(pairs.first))
    columns[rows, pairs.first] = unit
    columns[rows, pairs.second] = -unit
    return columns


def _delay_columns(pairs: Pairs) -> Array:
    """Shape (m, n)."""
    columns = np.zeros((len(pairs.first), pairs.anchors))
    rows = np.arange(len(pairs.first))
    columns[rows, pairs.first] = columns[rows, pairs.second] = 1.0
    return columns


def _model(pairs: Pairs, causes: Sequence[int], ends: Integers, parameter: Array) -> tuple[Array, Array]:
    """Derivatives, shape (m, k), and the changes that these parameters make, shape (m,)."""
    n, m, dim = pairs.anchors, len(pairs.first), pairs.dimensions
    position_m = pairs.position_m.copy()
    for cause, end in zip(causes, ends.tolist(), strict=True):
        if cause < n:
            position_m[cause, :dim] += parameter[end - dim : end]
    apart_m = np.linalg.norm(position_m[pairs.first] - position_m[pairs.second], axis=1)
    before_m = np.linalg.norm(pairs.position_m[pairs.first] - pairs.position_m[pairs.second], axis=1)
    predicted = apart_m - before_m
    columns = np.zeros((m, len(parameter)))
    moved, delayed = _moved_columns(pairs, position_m), _delay_columns(pairs)
    for cause, end in zip(causes, ends.tolist(), strict=True):
        if cause < n:
            columns[:, end - dim : end] = moved[:, cause]
            continue
        if cause < 2 * n:
            columns[:, end - 1] = delayed[:, cause - n]
        else:
            columns[cause - 2 * n, end - 1] = 1.0
        predicted = predicted + columns[:, end - 1] * parameter[end - 1]
    return columns, predicted
