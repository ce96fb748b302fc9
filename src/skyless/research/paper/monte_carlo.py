"""Monte Carlo of the paper's chain: means, variances and covariances of any number of draws, in constant memory.

One draw is one synchronisation of n anchors and one DTDoA of each, with noise on every stamp. The chain's functions
are the program's own, of ``core/protocol1/snapshots.py``. Errors are taken against the same chain without noise. Ideal
readings are float ticks; a hundred-thousandth of a tick is lost where clocks stand a second from their origins.

The noise of a chunk of draws comes from NumPy's Philox generator, whose key is the seed and the chunk's number. So the
draws depend on the seed alone, and sums have the same bits for any number of threads.
"""

import math
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from enum import IntEnum
from functools import reduce
from typing import Any, Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array
from skyless.core.processors import cores
from skyless.core.protocol1.snapshots import (
    averaged_offset,
    protocol_interval,
    relative_offset,
    relative_rate,
    tag_rate,
    to_master,
)
from skyless.core.ticks import TICK_M, TICK_S
from skyless.research.uncertainty import Chain, Reference

CHUNK_DRAWS: Final = 1 << 14
"""Draws with one key, which one thread sums up at a time."""
_BATCH_DRAWS: Final = 1 << 10
"""Draws that are computed at a time: they stay in the processor's cache."""

_SHARED_NOISES: Final = 4
"""Noises of a draw: the master's two synchronisation messages, its reference message, the tag's reception of it."""
_ANCHOR_NOISES: Final = 6
"""Noises of each anchor in a draw: its two receptions, its two transmissions, the tag's receptions of these."""


class Quantity(IntEnum):
    """What each draw gives for each anchor; the rows of ``errors``."""

    BETA = 0
    GAMMA_FIRST = 1
    GAMMA_DELAYED = 2
    GAMMA_AVERAGED = 3
    EPSILON_FIRST = 4
    EPSILON_DELAYED = 5
    XI = 6
    PHI = 7
    LAMBDA = 8


_UNITS: Final = np.array([1.0, *[TICK_S] * 5, 1.0, TICK_S, TICK_M])[:, None]
"""From ticks to what ``ChainMoments`` gives, by ``Quantity``."""


def run_chain(chain: Chain, reference: Reference, noise: Array) -> Array:
    """Every quantity of the chain in ticks, shape (quantities, draws, n), for stamps with ``noise`` of unit variance.

    ``noise``: shape (draws, numbers of a draw).
    """
    c, n = chain, len(chain.anchor_rate)
    shared, own = noise[:, :_SHARED_NOISES, None], noise[:, _SHARED_NOISES:].reshape(-1, n, _ANCHOR_NOISES)
    of_reference = {Reference.FIRST_SYNC: 0, Reference.SECOND_SYNC: 1, Reference.APART: 2}[reference]

    def master(true_s: float, noise: Array) -> Any:  # noqa: ANN401 - arrays, for functions of numbers
        return (c.master_offset_s + c.master_rate * true_s + c.sigma_master_s * noise) / TICK_S

    def anchor(true_s: Array, noise: Array) -> Any:  # noqa: ANN401
        return (c.anchor_offset_s + c.anchor_rate * true_s + c.sigma_anchor_s * noise) / TICK_S

    def tag(true_s: float | Array, noise: Array) -> Any:  # noqa: ANN401
        return (c.tag_offset_s + c.tag_rate * true_s + c.sigma_tag_s * noise) / TICK_S

    second_s, sent_s = c.sync_s + c.sync_spacing_s, c.reference_s + c.delay_s
    m1, m2 = master(c.sync_s, shared[:, 0]), master(second_s, shared[:, 1])
    tm = master(c.reference_s, shared[:, of_reference])
    rm = tag(c.reference_s + c.tag_master_tof_s, shared[:, 3])
    s1, s2 = anchor(c.sync_s + c.anchor_tof_s, own[..., 0]), anchor(second_s + c.anchor_tof_s, own[..., 1])
    a1, a2 = anchor(sent_s, own[..., 2]), anchor(sent_s + c.spacing_s, own[..., 3])
    r1, r2 = tag(sent_s + c.tag_tof_s, own[..., 4]), tag(sent_s + c.spacing_s + c.tag_tof_s, own[..., 5])
    tof: Any = c.anchor_tof_s / TICK_S
    rate = relative_rate(s2 - s1, m2 - m1)
    first, delayed = relative_offset(s1, m1, rate, tof), relative_offset(s2, m2, rate, tof)
    offset = averaged_offset(first, delayed)
    sent1, sent2 = to_master(a1, rate, offset), to_master(a2, rate, offset)
    tags_rate = tag_rate(r2 - r1, sent2 - sent1)
    interval = protocol_interval(tags_rate, sent1, tm)
    return np.array([rate, first, delayed, offset, sent1, sent2, tags_rate, interval, (r1 - rm) - interval])


def ideal_values(chain: Chain, reference: Reference) -> Array:
    """Every quantity of the chain without noise, shape (quantities, n)."""
    return run_chain(chain, reference, np.zeros((1, noise_size(chain))))[:, 0]


def noise_size(chain: Chain) -> int:
    """Numbers of one draw."""
    return _SHARED_NOISES + _ANCHOR_NOISES * len(chain.anchor_rate)


def noise_batches(seed: int, chunk: int, draws: int, size: int, *, uniform: bool) -> Iterator[Array]:
    """Noise of the first draws of a chunk, of mean 0 and variance 1, shape (up to ``_BATCH_DRAWS``, ``size``) each."""
    generator = np.random.Generator(np.random.Philox(key=np.array([seed, chunk], np.uint64)))
    bound = math.sqrt(3.0)
    for first in range(0, draws, _BATCH_DRAWS):
        shape = min(_BATCH_DRAWS, draws - first), size
        yield generator.uniform(-bound, bound, shape) if uniform else generator.standard_normal(shape)


class ChainMoments(Struct, frozen=True):
    """Results of the draws of a chain; rows in the order of ``Quantity``, one column for each anchor.

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
    """Covariance of the TDoAs of all anchors, shape (n, n)."""

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


def draw_moments(
    chain: Chain,
    seed: int,
    draws: int,
    *,
    reference: Reference = Reference.APART,
    uniform: bool = False,
    threads: int | None = None,
) -> ChainMoments:
    """Moments of every quantity of the chain over ``draws`` (at least 2) draws.

    ``uniform``: noise uniform within ±√3·σ instead of Gaussian. ``threads``: as many as the machine has unless given.
    """

    def sums_of(chunk: tuple[int, int]) -> tuple[Array, ...]:
        return _total(_sums(errors) for errors in _errors(chain, seed, chunk, reference, uniform=uniform))

    with ThreadPoolExecutor(threads or cores()) as pool:
        sums = _total(pool.map(sums_of, _chunks(draws)))
    first, second, fourth, epsilon, lambdas = (one / draws for one in sums)
    return ChainMoments(
        draws=draws,
        mean=first * _UNITS,
        variance=(second - first**2) * (draws / (draws - 1)) * _UNITS**2,
        fourth=fourth * _UNITS**4,
        epsilon_covariance_s2=(epsilon - first[Quantity.EPSILON_FIRST] * first[Quantity.EPSILON_DELAYED]) * TICK_S**2,
        lambda_covariance_m2=(lambdas - np.outer(first[Quantity.LAMBDA], first[Quantity.LAMBDA])) * TICK_M**2,
    )


def draw_lambdas(
    chain: Chain, seed: int, draws: int, *, reference: Reference = Reference.APART, uniform: bool = False
) -> Iterator[Array]:
    """Errors of the DTDoAs of the draws that ``draw_moments`` makes, in metres, shape (up to a batch, n) each."""
    for chunk in _chunks(draws):
        for errors in _errors(chain, seed, chunk, reference, uniform=uniform):
            yield errors[Quantity.LAMBDA] * TICK_M


def _chunks(draws: int) -> Iterator[tuple[int, int]]:
    """Number and draws of every chunk."""
    for chunk in range(-(-draws // CHUNK_DRAWS)):
        yield chunk, min(CHUNK_DRAWS, draws - chunk * CHUNK_DRAWS)


def _errors(chain: Chain, seed: int, chunk: tuple[int, int], reference: Reference, *, uniform: bool) -> Iterator[Array]:
    """Errors of every quantity of a chunk's draws, shape (quantities, up to a batch, n) each."""
    ideal = ideal_values(chain, reference)[:, None]
    for noise in noise_batches(seed, *chunk, noise_size(chain), uniform=uniform):
        yield run_chain(chain, reference, noise) - ideal


def _sums(errors: Array) -> tuple[Array, ...]:
    """First, second and fourth powers, products of both ε, and products of all λ, over the draws."""
    squares, of_lambda = errors**2, errors[Quantity.LAMBDA]
    products = errors[Quantity.EPSILON_FIRST] * errors[Quantity.EPSILON_DELAYED]
    powers = (errors.sum(axis=1), squares.sum(axis=1), (squares**2).sum(axis=1))
    return *powers, products.sum(axis=0), of_lambda.T @ of_lambda


def _total(parts: Iterable[tuple[Array, ...]]) -> tuple[Array, ...]:
    """Sums added up one after the other."""
    return reduce(lambda whole, part: tuple(map(np.add, whole, part)), parts)
