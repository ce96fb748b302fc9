"""Which blocks of a pair agree: the earliest cluster, as what is in the way makes a signal late, never early."""

from typing import Final

import numpy as np

from skyless.kernels.arrays import Array, Mask

_LEAST_SHARE: Final = 0.1
"""Of all exchanges: an earlier cluster with fewer is an error."""

_SIGMAS: Final = 4.0
_DENSE_SHARE: Final = 0.3
_DENSE_WIDTH: Final = 0.771
"""Width of that middle part of a normal distribution, in standard deviations."""


def earliest_cluster(value: Array, weight: Array, std: float, total: float | None = None) -> Mask:
    """The members of the earliest cluster that holds a tenth of the weight, shape (n,); the heaviest if none does.

    ``value``, ``weight``: shape (n,), n > 0; ``std``: the least standard deviation within a cluster; ``total``: of the
    weights, where it is more than their sum.
    """
    order = np.argsort(value, kind="stable")
    ordered, until = value[order], np.cumsum(weight[order])
    width = 2.0 * _SIGMAS * max(std, _densest(ordered, until) / _DENSE_WIDTH)
    ends = np.searchsorted(ordered, ordered + width, side="right") - 1
    held = until[ends] - until + weight[order]
    enough = np.flatnonzero(held >= _LEAST_SHARE * max(until[-1], total or 0.0))
    begin = int(enough[0]) if len(enough) else int(np.argmax(held))
    centre = half_sample_mode(ordered[begin : ends[begin] + 1])
    for _ in range(2):
        inside = np.abs(value - centre) <= 0.5 * width + 1e-9
        centre = float(np.average(value[inside], weights=weight[inside]))
    return np.asarray(inside)


def half_sample_mode(ordered: Array) -> float:
    """The mode of ascending values: the densest half, of that the densest half, and so on."""
    while len(ordered) > 3:
        half = (len(ordered) + 1) // 2
        begin = int(np.argmin(ordered[half - 1 :] - ordered[: len(ordered) - half + 1]))
        ordered = ordered[begin : begin + half]
    if len(ordered) == 3:
        ordered = ordered[:2] if ordered[1] - ordered[0] <= ordered[2] - ordered[1] else ordered[1:]
    return float(np.mean(ordered))


def _densest(ordered: Array, until: Array) -> float:
    """Length of the shortest interval that holds ``_DENSE_SHARE`` of the weight."""
    before = np.concatenate([[0.0], until[:-1]])
    ends = np.searchsorted(until, before + _DENSE_SHARE * until[-1] * (1.0 - 1e-9))
    whole = ends < len(ordered)
    return float(np.min(ordered[ends[whole]] - ordered[whole]))
