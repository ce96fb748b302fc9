"""Means, variances and covariances of the paper's chain from any number of draws, in memory that does not grow.

The draws depend on the seed alone, whatever takes them: threads of the processor (the sums then have the same bits for
any number of threads) or a GPU (the same but for the order of summation).
"""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.constants import TICK_M, TICK_S
from skyless.errors import SkylessError
from skyless.kernels.arrays import Array
from skyless.kernels.compiled import cores
from skyless.paper.chain_draws import QUANTITIES, Quantity, Readings, add_draws, list_lambdas, sums_size
from skyless.uncertainty.chain import Chain, Reference

Progress = Callable[[int], None]

CHUNK: Final = 1 << 14
"""Draws that one thread sums up at a time."""
GPU_CHUNK: Final = 1 << 25

_UNITS: Final = np.array([1.0, *[TICK_S] * 5, 1.0, TICK_S, TICK_M])[:, None]
"""From ticks to what ``ChainMoments`` gives, by ``Quantity``."""


class ChainMoments(Struct, frozen=True):
    """What draws of a chain came to; rows in the order of ``Quantity``, one column for each anchor.

    Rates are pure numbers, λ is in metres, all else in seconds.
    """

    draws: int
    mean: Array
    """Shape (quantities, n); zero to first order."""
    variance: Array
    """Shape (quantities, n), about the mean."""
    fourth: Array
    """Mean fourth power, shape (quantities, n); about zero, from which the mean differs by very little."""
    epsilon_covariance_s2: Array
    """E[ε(t_i)·ε(t_i + Δ_i)], shape (n,)."""
    lambda_covariance_m2: Array
    """Of the TDoAs of all anchors, shape (n, n)."""

    @property
    def std(self) -> Array:
        """Standard deviations, shape (quantities, n)."""
        return np.sqrt(self.variance)

    @property
    def mean_error(self) -> Array:
        """Standard error of the means."""
        return np.sqrt(self.variance / self.draws)

    @property
    def std_relative_error(self) -> Array:
        """Standard error of the standard deviations over themselves: 1/√(2·draws) for Gaussian errors."""
        excess: Array = np.maximum(self.fourth / self.variance**2 - 1.0, 0.0)
        error: Array = np.sqrt(excess / self.draws) / 2.0
        return error

    @property
    def epsilon_covariance_error_s2(self) -> Array:
        """Standard error of ``epsilon_covariance_s2``, for jointly Gaussian errors."""
        both = self.variance[Quantity.EPSILON_FIRST] * self.variance[Quantity.EPSILON_DELAYED]
        error: Array = np.sqrt((both + self.epsilon_covariance_s2**2) / self.draws)
        return error

    @property
    def lambda_covariance_error_m2(self) -> Array:
        """Standard error of ``lambda_covariance_m2``, for jointly Gaussian errors."""
        own = np.diag(self.lambda_covariance_m2)
        return np.sqrt((np.outer(own, own) + self.lambda_covariance_m2**2) / self.draws)


class _Merge:
    """Mean, squares about the mean and products of all chunks so far (T. Chan, G. Golub, R. LeVeque 1979)."""

    def __init__(self, anchors: int) -> None:
        self._n = anchors
        self._count = 0
        self._mean = np.zeros((QUANTITIES, anchors))
        self._squares = np.zeros((QUANTITIES, anchors))
        self._fourth = np.zeros((QUANTITIES, anchors))
        self._epsilon = np.zeros(anchors)
        self._lambda = np.zeros((anchors, anchors))

    def add(self, sums: Array, count: int) -> None:
        """Take the sums of ``count`` draws."""
        n = self._n
        powers = sums[: 3 * QUANTITIES * n].reshape(QUANTITIES, n, 3)
        epsilon, products = sums[-n * n - n : -n * n], sums[-n * n :].reshape(n, n)
        mean = powers[:, :, 0] / count
        self._merge_squares(mean, powers[:, :, 1] - count * mean**2, count)
        self._fourth += powers[:, :, 2]
        self._epsilon += epsilon
        self._lambda += products

    def _merge_squares(self, mean: Array, squares: Array, count: int) -> None:
        total = self._count + count
        apart = mean - self._mean
        self._squares += squares + apart**2 * (self._count * count / total)
        self._mean += apart * (count / total)
        self._count = total

    def moments(self) -> ChainMoments:
        """What all draws came to."""
        draws, mean = self._count, self._mean
        epsilon = self._epsilon / draws - mean[Quantity.EPSILON_FIRST] * mean[Quantity.EPSILON_DELAYED]
        lower = self._lambda / draws
        products = lower + np.tril(lower, -1).T - np.outer(mean[Quantity.LAMBDA], mean[Quantity.LAMBDA])
        return ChainMoments(
            draws=draws,
            mean=mean * _UNITS,
            variance=self._squares / (draws - 1) * _UNITS**2,
            fourth=self._fourth / draws * _UNITS**4,
            epsilon_covariance_s2=epsilon * TICK_S**2,
            lambda_covariance_m2=products * TICK_M**2,
        )


def draw_moments(
    chain: Chain,
    seed: int,
    draws: int,
    *,
    reference: Reference = Reference.APART,
    uniform: bool = False,
    threads: int | None = None,
    gpu: bool = False,
    progress: Progress | None = None,
) -> ChainMoments:
    """Moments of every quantity of the chain over ``draws`` (at least 2) draws.

    ``uniform``: noise uniform within ±√3·σ instead of Gaussian. ``threads``: as many as the machine has unless given.
    ``progress`` is called with the draws done so far.

    Raises:
        SkylessError: a GPU was asked for and there is none.
    """
    readings = Readings(chain, reference, uniform=uniform)
    merge = _Merge(len(readings.anchors))
    done = 0
    parts = _on_gpu(readings, seed, draws) if gpu else _on_threads(readings, seed, draws, threads or cores())
    for sums, count in parts:
        merge.add(sums, count)
        done += count
        if progress is not None:
            progress(done)
    return merge.moments()


def draw_lambdas(
    chain: Chain,
    seed: int,
    first: int,
    draws: int,
    *,
    reference: Reference = Reference.APART,
    uniform: bool = False,
) -> Array:
    """Errors of the DTDoAs of the draws from number ``first`` on, in metres, shape (draws, n)."""
    readings = Readings(chain, reference, uniform=uniform)
    lambdas = np.empty((draws, len(readings.anchors)))
    inputs = (readings.shared, readings.anchors, readings.settings, readings.ideal)
    list_lambdas(seed, first, readings.uniform, *inputs, lambdas)
    return lambdas * TICK_M


def _chunks(draws: int, size: int) -> Iterator[tuple[int, int]]:
    for first in range(0, draws, size):
        yield first, min(size, draws - first)


def _on_threads(readings: Readings, seed: int, draws: int, threads: int) -> Iterator[tuple[Array, int]]:
    """Sums of every chunk, in the order of the chunks; twice as many under way as there are threads."""
    with ThreadPoolExecutor(threads) as pool:
        under_way: deque[tuple[Future[Array], int]] = deque()
        for first, count in _chunks(draws, CHUNK):
            under_way.append((pool.submit(sums_of, readings, seed, first, count), count))
            if len(under_way) >= 2 * threads:
                oldest, taken = under_way.popleft()
                yield oldest.result(), taken
        for future, count in under_way:
            yield future.result(), count


def sums_of(readings: Readings, seed: int, first: int, count: int) -> Array:
    """Sums of ``count`` draws from number ``first`` on, in one thread."""
    sums = np.zeros(sums_size(len(readings.anchors)))
    inputs = (readings.shared, readings.anchors, readings.settings, readings.ideal)
    add_draws(seed, first, count, readings.uniform, *inputs, sums)
    return sums


def gpu_available() -> bool:
    """Whether a CUDA device (or Numba's simulator of one) is there and can be used."""
    try:
        from numba import cuda  # noqa: PLC0415 (slow to import, and only where a device is asked for)
    except ImportError:
        return False
    return bool(cuda.is_available())  # type: ignore[no-untyped-call]


def _on_gpu(readings: Readings, seed: int, draws: int) -> Iterator[tuple[Array, int]]:
    if not gpu_available():
        raise SkylessError("no CUDA device can be used here: Numba finds no driver or no toolkit")
    from skyless.paper.gpu_draws import gpu_sums  # noqa: PLC0415

    for first, count in _chunks(draws, GPU_CHUNK):
        yield gpu_sums(readings, seed, first, count), count
