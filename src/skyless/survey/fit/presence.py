"""Which pairs have a range says where anchors are: where only near ones do, an anchor is far from those without.

On a sparse site this is what contradicts a mirror image that lies amid anchors with which it has no range.
"""

from typing import Final

import numpy as np

from skyless.kernels.arrays import Array
from skyless.survey.fit.links import adjacency
from skyless.survey.fit.problem import Problem

_STEPS: Final = 12
_LEAST_EVIDENCE: Final = 30.0
"""Twice the logarithm of likelihoods by which distance must explain which pairs have a range, else it says nothing."""

_WEIGHT: Final = 0.5
"""Of this evidence: pairs behind one wall are missing together."""

_SURE: Final = 1e-3
"""Probability that a pair at any distance has, or lacks, a range for another reason."""


class Presence:
    """A logistic curve of the share of pairs with a range over distance, fitted to one result of a problem."""

    def __init__(self, problem: Problem, position_m: Array) -> None:
        """``position_m``: shape (n, 3)."""
        n = len(position_m)
        self._first, self._second = np.triu_indices(n, 1)
        self._is_present = adjacency(n, problem.first, problem.second)[self._first, self._second]
        share = float(np.mean(self._is_present)) if self._is_present.size else 1.0
        self._curve: Array | None = None
        if not 0.0 < share < 1.0:
            return
        distance = self._distances(position_m[None])[0]
        rows = np.stack([np.ones_like(distance), distance], axis=1)
        curve = np.array([np.log(share / (1.0 - share)), 0.0])
        for _ in range(_STEPS):
            expected = 1.0 / (1.0 + np.exp(-np.clip(rows @ curve, -30.0, 30.0)))
            information = (rows * (expected * (1.0 - expected))[:, None]).T @ rows + 1e-3 * np.eye(2)
            curve = curve + np.linalg.solve(information, rows.T @ (self._is_present - expected) - 1e-3 * curve)
        level = -2.0 * np.sum(np.where(self._is_present, np.log(share), np.log1p(-share)))
        if curve[1] < 0.0 and level - self._surprise(distance, curve) > _LEAST_EVIDENCE:
            self._curve = curve

    def cost(self, position_m: Array) -> Array:
        """Of results, shape (b, n, 3): to be added to their weighted squares; shape (b,)."""
        if self._curve is None:
            return np.zeros(len(position_m))
        return np.asarray(_WEIGHT * self._surprise(self._distances(position_m), self._curve))

    def _distances(self, position_m: Array) -> Array:
        return np.asarray(np.linalg.norm(position_m[:, self._first] - position_m[:, self._second], axis=2))

    def _surprise(self, distance_m: Array, curve: Array) -> Array:
        """Twice the negative logarithm of the likelihood of the pairs that have a range, over the last axis."""
        share = 1.0 / (1.0 + np.exp(-np.clip(curve[0] + curve[1] * distance_m, -30.0, 30.0)))
        share = _SURE + (1.0 - 2.0 * _SURE) * share
        return np.asarray(-2.0 * np.sum(np.log(np.where(self._is_present, share, 1.0 - share)), axis=-1))
