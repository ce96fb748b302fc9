"""From repeated ranges of pairs to one range of each: the mean of the earliest cluster.

A signal can come late and not early, so where a pair's ranges fall into clusters the earliest is the direct way, if it
holds enough of them.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np

from skyless.kernels.arrays import Array
from skyless.survey.ranges import PairRange, PairRanges
from skyless.survey.stamps.clusters import LEAST_CLUSTER_SHARE, earliest_cluster

_ENOUGH: Final = 5
"""Ranges of a pair from which it has clusters; of fewer the median is used."""
_LEAST_COUNT: Final = 3
"""Ranges in a cluster, and of a pair whose scatter is looked at."""
_SIGMAS_OF_MAD: Final = 1.4826
_MEDIAN_OVER_MEAN: Final = 1.25
"""Standard deviation of a median over that of the mean."""
_LEAST_NOISE_M: Final = 1e-3
_UNKNOWN_NOISE_M: Final = 0.05
"""Of one range where no pair was measured more than once."""


def mean_ranges(ranges_m: Mapping[tuple[int, int], Sequence[float]], anchors: Iterable[int] = ()) -> PairRanges:
    """One range of each pair, by pair ``(a, b)`` with a < b; ``anchors``: further ones, without a range.

    Ranges that are not finite are left out, and so are pairs without any other.
    """
    finite_m = {pair: [value for value in values if math.isfinite(value)] for pair, values in ranges_m.items()}
    noise_m = _noise(finite_m)
    pairs = tuple(_mean(a, b, np.sort(values), noise_m) for (a, b), values in sorted(finite_m.items()) if values)
    everybody = {anchor for pair in ranges_m for anchor in pair} | set(anchors)
    return PairRanges(pairs, tuple(sorted(everybody)))


def _noise(ranges_m: Mapping[tuple[int, int], Sequence[float]]) -> float:
    """Noise of one range that all pairs share: root mean square of theirs, without the quarter with the most."""
    own, weight = [], []
    for values in ranges_m.values():
        if len(values) >= _LEAST_COUNT:
            own.append(_robust_std(np.asarray(values)) ** 2)
            weight.append(len(values) - 1)
    if not own:
        return _UNKNOWN_NOISE_M
    quiet = np.argsort(own)[: math.ceil(0.75 * len(own))]
    return max(math.sqrt(float(np.average(np.array(own)[quiet], weights=np.array(weight)[quiet]))), _LEAST_NOISE_M)


def _robust_std(values: Array) -> float:
    """Robust standard deviation; of few values corrected for their number."""
    deviation = float(np.median(np.abs(values - np.median(values))))
    return _SIGMAS_OF_MAD * deviation * math.sqrt(len(values) / (len(values) - 1.0))


def _mean(a: int, b: int, values_m: Array, noise_m: float) -> PairRange:
    """Of one pair; values in ascending order."""
    count = len(values_m)
    if count < _ENOUGH:
        std_m = noise_m * (_MEDIAN_OVER_MEAN if count > 2 else 1.0) / math.sqrt(count)
        return PairRange(a, b, float(np.median(values_m)), std_m, count)
    total = max(float(count), _LEAST_COUNT / LEAST_CLUSTER_SHARE)
    cluster = values_m[earliest_cluster(values_m, np.ones(count), noise_m, total)]
    std_m = max(float(np.std(cluster, ddof=1)) if len(cluster) > 1 else 0.0, noise_m) / math.sqrt(len(cluster))
    late_share = float(np.mean(values_m > cluster.max()))
    return PairRange(a, b, float(cluster.mean()), std_m, len(cluster), late_share)
