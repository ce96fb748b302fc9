"""From repeated ranges of pairs to one range of each: the mean of the earliest cluster.

A signal can come late and not early, so where a pair's ranges fall into clusters the earliest is the direct way, if it
holds enough of them.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from skyless.core.arrays import Array, Mask
from skyless.site.survey.facts import PairRange, PairRanges

STD_OVER_MAD: Final = 1.4826
"""Standard deviation of normally distributed values over the median of their distances from their median."""

MIN_CLUSTER_SHARE: Final = 0.1
"""An earlier cluster with a smaller share of all exchanges is an error."""

_SIGMAS: Final = 4.0
_DENSE_SHARE: Final = 0.3
_DENSE_WIDTH: Final = 0.771  # standard deviations that hold this share of a normal distribution


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
    enough = np.flatnonzero(held >= MIN_CLUSTER_SHARE * max(until[-1], total or 0.0))
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


_ENOUGH: Final = 5  # ranges of a pair from which it has clusters; of fewer the median is used
_MIN_COUNT: Final = 3  # ranges in a cluster, and of a pair whose scatter is looked at
_MEDIAN_OVER_MEAN: Final = 1.25  # standard deviation of a median over that of the mean
_MIN_NOISE_M: Final = 1e-3
_UNKNOWN_NOISE_M: Final = 0.05  # of a range where no pair was measured more than once


def mean_ranges(ranges_m: Mapping[tuple[int, int], Sequence[float]]) -> PairRanges:
    """One range of each pair, by pair ``(a, b)`` with a < b.

    Ranges that are not finite are left out, and so are pairs without any other.
    """
    finite_m = {pair: [value for value in values if math.isfinite(value)] for pair, values in ranges_m.items()}
    noise_m = _noise(finite_m)
    pairs = tuple(_mean(a, b, np.sort(values), noise_m) for (a, b), values in sorted(finite_m.items()) if values)
    return PairRanges(pairs, tuple(sorted({anchor for pair in ranges_m for anchor in pair})))


def _noise(ranges_m: Mapping[tuple[int, int], Sequence[float]]) -> float:
    """Noise of one range that all pairs share: root mean square of theirs, without the quarter with the most."""
    own, weight = [], []
    for values in ranges_m.values():
        if len(values) >= _MIN_COUNT:
            own.append(_robust_std(np.asarray(values)) ** 2)
            weight.append(len(values) - 1)
    if not own:
        return _UNKNOWN_NOISE_M
    quiet = np.argsort(own)[: math.ceil(0.75 * len(own))]
    return max(math.sqrt(float(np.average(np.array(own)[quiet], weights=np.array(weight)[quiet]))), _MIN_NOISE_M)


def _robust_std(values: Array) -> float:
    """Robust standard deviation; of few values corrected for their number."""
    deviation = float(np.median(np.abs(values - np.median(values))))
    return STD_OVER_MAD * deviation * math.sqrt(len(values) / (len(values) - 1.0))


def _mean(a: int, b: int, values_m: Array, noise_m: float) -> PairRange:
    count = len(values_m)
    if count < _ENOUGH:
        std_m = noise_m * (_MEDIAN_OVER_MEAN if count > 2 else 1.0) / math.sqrt(count)
        return PairRange(a, b, float(np.median(values_m)), std_m, count)
    total = max(float(count), _MIN_COUNT / MIN_CLUSTER_SHARE)
    cluster = values_m[earliest_cluster(values_m, np.ones(count), noise_m, total)]
    std_m = max(float(np.std(cluster, ddof=1)) if len(cluster) > 1 else 0.0, noise_m) / math.sqrt(len(cluster))
    late_share = float(np.mean(values_m > cluster.max()))
    return PairRange(a, b, float(cluster.mean()), std_m, len(cluster), late_share)
