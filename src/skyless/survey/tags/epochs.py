"""Time differences of a tag, averaged over epochs of half a second, and its ranges in each epoch up to one constant."""

from array import array
from collections.abc import Mapping
from typing import Final

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from skyless.kernels.arrays import Array, Integers, Vector
from skyless.survey.tags.received import TagReceived

EPOCH_S: Final = 0.5
"""Reflections change while a tag is carried for half a second: the errors of two epochs count as independent."""

WALK_OFFSET_STD_M: Final = 0.07
"""Constant by which a tag's ranges to an anchor differ from what the anchors' own ranges say of its delay: stamps of
strong signals are early (APS011), and signals are stronger or weaker between anchors than at a tag."""

_MOST_SAMPLES: Final = 2_000_000
"""Twenty minutes of a site with 12 anchors; what comes later is not used."""

_LONE_STD_M: Final = 0.07
"""Of a single difference, for its weight against the velocity's prior."""

_FLOOR_COUNT: Final = 20
"""With more samples of a pair in one epoch the errors that they share exceed their noise: the weight grows no more."""

_SPEED_STD_MPS: Final = 1.5
_REJECT: Final = 4.0
_HUBER_M: Final = 0.1
_ROUNDS: Final = 4


class TagEpochs(TagReceived, frozen=True, eq=False):
    """Differences of one tag, ``r`` means over an epoch and a pair of anchors, in ``k`` epochs; ``n`` anchors.

    A difference is the range to ``second`` less that to ``first``, both with their delays h. If it is ``relayed``, the
    range of the pair, as the anchors measure it, is in it as well: ``second`` has received ``first`` and sent its own
    stamp of it. That range is to be taken off with all its errors, for they are the same.
    """

    anchors: tuple[int, ...]
    """In ascending order."""
    t_s: Vector
    """Shape (k,): the middle of each epoch."""
    epoch: Integers
    first: Integers
    second: Integers
    """Shape (r,): indices."""
    difference_m: Vector
    since_s: Vector
    """Shape (r,): mean time of a difference's samples since the middle of its epoch."""
    count: Integers
    """Shape (r,): samples in the mean."""
    relayed: bool
    known_m: Array
    """Shape (k, 3): the tag's coordinates where they are known, NaN elsewhere."""
    known_std_m: tuple[float, float, float] = (0.01, 0.01, 0.01)
    offset_std_m: float = WALK_OFFSET_STD_M
    """Of each anchor's own constant at the tag, besides its delay."""
    name: str = "the walk"
    """For sentences."""


class EpochCollector:
    """Gathers a tag's differences as they come."""

    def __init__(self, *, relayed: bool) -> None:
        self._relayed = relayed
        self._times, self._values = array("d"), array("d")
        self._firsts, self._seconds = array("q"), array("q")

    def add(self, t_s: float, first: int, second: int, difference_m: float) -> None:
        """Add the range to ``second`` less that to ``first`` at a time."""
        if len(self._times) < _MOST_SAMPLES:
            self._times.append(t_s)
            self._firsts.append(first)
            self._seconds.append(second)
            self._values.append(difference_m)

    def epochs(self) -> TagEpochs:
        """All that was gathered; samples that are far from the median of their pair and epoch are left out."""
        t_s, value_m = np.array(self._times), np.array(self._values)
        ids = np.array([self._firsts, self._seconds], dtype=np.int64).reshape(2, -1)
        anchors = np.unique(ids)
        first, second = np.searchsorted(anchors, ids)
        number = np.floor((t_s - t_s.min(initial=np.inf)) / EPOCH_S).astype(np.int64) if len(t_s) else ids[0]
        numbers, epoch = np.unique(number, return_inverse=True)
        middle_s = t_s.min(initial=np.inf) + (numbers + 0.5) * EPOCH_S if len(t_s) else t_s
        n = max(len(anchors), 1)
        group, group_of = np.unique((epoch * n + first) * n + second, return_inverse=True)
        median = _group_medians(group_of, value_m, len(group))
        away = np.abs(value_m - median[group_of])
        scale = np.maximum(1.4826 * _group_medians(group_of, away, len(group)), 0.02)
        kept = away <= _REJECT * scale[group_of]
        group_of, value_m, since_s = group_of[kept], value_m[kept], (t_s - middle_s[epoch])[kept]
        count = np.bincount(group_of, minlength=len(group))
        sums = (np.bincount(group_of, one, len(group)) for one in (value_m, since_s))
        mean_m, mean_s = (total / np.maximum(count, 1) for total in sums)
        return TagEpochs(
            tuple(anchors.tolist()),
            middle_s,
            group // (n * n),
            group // n % n,
            group % n,
            mean_m,
            mean_s,
            count,
            self._relayed,
            np.full((len(middle_s), 3), np.nan),
        )


def _group_medians(group_of: Integers, values: Vector, groups: int) -> Vector:
    """Lower median of each group, shape (groups,); every group has a value."""
    order = np.lexsort((values, group_of))
    size = np.bincount(group_of, minlength=groups)
    begin = np.cumsum(size) - size
    return np.asarray(values[order][begin + (size - 1) // 2] if groups else values)


def tag_ranges(epochs: TagEpochs, pair_ranges_m: Mapping[tuple[int, int], float]) -> Array:
    """Ranges to all anchors in each epoch up to one constant, shape (k, n); NaN where there are none.

    ``pair_ranges_m``: of the anchors, by identifiers in ascending order. A relayed difference whose pair is missing
    there is not used. Anchors that an epoch's differences do not tie to most others are NaN.
    """
    k, n = len(epochs.t_s), len(epochs.anchors)
    epoch, first, second, value_m = epochs.epoch, epochs.first, epochs.second, epochs.difference_m
    since_s, count = epochs.since_s, epochs.count
    if epochs.relayed:
        of_pair = np.full((n, n), np.nan)
        for i, a in enumerate(epochs.anchors):
            for j, b in enumerate(epochs.anchors):
                of_pair[i, j] = pair_ranges_m.get((min(a, b), max(a, b)), np.nan)
        value_m = value_m - of_pair[first, second]
        known = np.isfinite(value_m)
        epoch, first, second, value_m = epoch[known], first[known], second[known], value_m[known]
        since_s, count = since_s[known], count[known]
    joined = _largest_part(epoch * n + first, epoch * n + second, k, n)
    strength = np.minimum(count, _FLOOR_COUNT) / _LONE_STD_M**2
    columns = np.stack([first, second, n + first, n + second], axis=1)
    factors = np.stack([-np.ones(len(first)), np.ones(len(first)), -since_s, since_s], axis=1)
    solution: Array = np.zeros((k, 2 * n))
    weight = strength
    for _ in range(_ROUNDS):
        normal = np.zeros((k, 2 * n, 2 * n))
        diagonal = np.arange(2 * n)
        normal[:, diagonal[:n], diagonal[:n]] = 1e-4
        normal[:, diagonal[n:], diagonal[n:]] = 1.0 / _SPEED_STD_MPS**2
        right = np.zeros((k, 2 * n))
        for i in range(4):
            np.add.at(right, (epoch, columns[:, i]), weight * factors[:, i] * value_m)
            for j in range(4):
                np.add.at(normal, (epoch, columns[:, i], columns[:, j]), weight * factors[:, i] * factors[:, j])
        solution = np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0])
        model_m = (factors * np.take_along_axis(solution[epoch], columns, axis=1)).sum(axis=1)
        away = np.abs(value_m - model_m)
        weight = strength * np.minimum(1.0, _HUBER_M / np.maximum(away, _HUBER_M))
    return np.where(joined, solution[:, :n], np.nan)


def _largest_part(first: Integers, second: Integers, k: int, n: int) -> Array:
    """Whether each anchor is in its epoch's largest part that differences tie together, shape (k, n), truth values."""
    edges = coo_array((np.ones(len(first)), (first, second)), shape=(k * n, k * n))
    label = connected_components(edges, directed=False)[1]
    size = np.bincount(label, minlength=k * n)
    of_node = size[label].reshape(k, n)
    most = of_node.max(axis=1, initial=0, keepdims=True)
    chosen = np.where(of_node == most, label.reshape(k, n), k * n).min(axis=1, initial=k * n, keepdims=True)
    return np.asarray((label.reshape(k, n) == chosen) & (most > 1))
