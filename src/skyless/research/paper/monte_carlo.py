"""Monte Carlo of the paper's chain: means, variances and covariances of any number of draws, in constant memory.

One draw is one synchronisation of n anchors and one DTDoA of each, with noise on every stamp. The scalar functions are
the program's own, of ``positioning/methods/snapshots.py``. Errors are taken against the same chain
without noise. Ideal readings are float ticks; a hundred-thousandth of a tick is lost where clocks stand a second from
their origins.

The noise of a chunk of draws comes from NumPy's Philox generator, whose key is the seed and the chunk's number. So the
draws depend on the seed alone, and sums have the same bits for any number of threads.
"""

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array
from skyless.core.constants import TICK_M, TICK_S
from skyless.core.processors import cores
from skyless.core.protocol1.snapshots import (
    averaged_offset,
    protocol_interval,
    relative_offset,
    relative_rate,
    tag_rate,
    to_master,
)
from skyless.research.uncertainty.chain import Chain, Reference
from skyless.site.kernels.compiled import jitted, kernel, threaded_kernel

for _function in (averaged_offset, protocol_interval, relative_offset, relative_rate, tag_rate, to_master):
    jitted(_function)

CHUNK_DRAWS: Final = 1 << 14
"""Draws with one key, which one thread sums up at a time."""
_BATCH_DRAWS: Final = 256
"""Draws whose noise is made at a time: it stays in the processor's cache."""

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


_EPSILON_FIRST: Final = int(Quantity.EPSILON_FIRST)
_EPSILON_DELAYED: Final = int(Quantity.EPSILON_DELAYED)
_LAMBDA: Final = int(Quantity.LAMBDA)

_UNITS: Final = np.array([1.0, *[TICK_S] * 5, 1.0, TICK_S, TICK_M])[:, None]
"""From ticks to what ``ChainMoments`` gives, by ``Quantity``."""


class Readings(NamedTuple):
    """What every clock of a chain would read without noise, and the noise, all in ticks; arrays have shape (n,)."""

    sync_first: float
    """The master's clock at its synchronisation messages."""
    sync_second: float
    reference: float
    """The master's clock when the reference message leaves, and the tag's when it arrives."""
    reference_at_tag: float
    received_first: Array
    """An anchor's clock at its receptions of the synchronisation messages, and at its own two messages."""
    received_second: Array
    sent_first: Array
    sent_second: Array
    heard_first: Array
    """The tag's clock at its receptions of these."""
    heard_second: Array
    tof: Array
    sigma_master: float
    sigma_anchor: float
    sigma_tag: float
    reference_noise: int
    """Which of the shared noises is that of the reference message: its own, or that of a synchronisation message."""


def readings_of(chain: Chain, reference: Reference) -> Readings:
    """The readings of a chain whose reference message is one of its own or a synchronisation message."""

    def master(true_s: float) -> float:
        return (chain.master_offset_s + chain.master_rate * true_s) / TICK_S

    def anchor(true_s: Array) -> Array:
        return (chain.anchor_offset_s + chain.anchor_rate * true_s) / TICK_S

    def tag(true_s: Array) -> Array:
        return (chain.tag_offset_s + chain.tag_rate * true_s) / TICK_S

    second_s = chain.sync_s + chain.sync_spacing_s
    sent_s = chain.reference_s + chain.delay_s
    heard_s = sent_s + chain.tag_tof_s
    at_tag = tag(np.array(chain.reference_s + chain.tag_master_tof_s))
    return Readings(
        sync_first=master(chain.sync_s),
        sync_second=master(second_s),
        reference=master(chain.reference_s),
        reference_at_tag=float(at_tag),
        received_first=anchor(chain.sync_s + chain.anchor_tof_s),
        received_second=anchor(second_s + chain.anchor_tof_s),
        sent_first=anchor(sent_s),
        sent_second=anchor(sent_s + chain.spacing_s),
        heard_first=tag(heard_s),
        heard_second=tag(heard_s + chain.spacing_s),
        tof=chain.anchor_tof_s / TICK_S,
        sigma_master=chain.sigma_master_s / TICK_S,
        sigma_anchor=chain.sigma_anchor_s / TICK_S,
        sigma_tag=chain.sigma_tag_s / TICK_S,
        reference_noise={Reference.FIRST_SYNC: 0, Reference.SECOND_SYNC: 1, Reference.APART: 2}[reference],
    )


def noise_size(anchors: int) -> int:
    """Numbers of one draw."""
    return _SHARED_NOISES + _ANCHOR_NOISES * anchors


def ideal_values(readings: Readings) -> Array:
    """Every quantity of the chain without noise, shape (quantities, n)."""
    n = len(readings.tof)
    values = np.empty((len(Quantity), n))
    run_chain(readings, np.zeros(noise_size(n)), values)
    return values


@kernel
def run_chain(readings: Readings, noise: Array, values: Array) -> None:
    """Write every quantity of the chain, shape (quantities, n), for stamps with ``noise`` (of unit variance)."""
    sigma_master, sigma_anchor, sigma_tag = readings.sigma_master, readings.sigma_anchor, readings.sigma_tag
    m1 = readings.sync_first + sigma_master * noise[0]
    m2 = readings.sync_second + sigma_master * noise[1]
    tm = readings.reference + sigma_master * noise[readings.reference_noise]
    rm = readings.reference_at_tag + sigma_tag * noise[3]
    for i in range(len(readings.tof)):
        own = noise[_SHARED_NOISES + _ANCHOR_NOISES * i : _SHARED_NOISES + _ANCHOR_NOISES * (i + 1)]
        s1 = readings.received_first[i] + sigma_anchor * own[0]
        s2 = readings.received_second[i] + sigma_anchor * own[1]
        a1 = readings.sent_first[i] + sigma_anchor * own[2]
        a2 = readings.sent_second[i] + sigma_anchor * own[3]
        r1 = readings.heard_first[i] + sigma_tag * own[4]
        r2 = readings.heard_second[i] + sigma_tag * own[5]
        rate = relative_rate(s2 - s1, m2 - m1)
        first = relative_offset(s1, m1, rate, readings.tof[i])
        delayed = relative_offset(s2, m2, rate, readings.tof[i])
        offset = averaged_offset(first, delayed)
        sent1 = to_master(a1, rate, offset)
        sent2 = to_master(a2, rate, offset)
        tags_rate = tag_rate(r2 - r1, sent2 - sent1)
        interval = protocol_interval(tags_rate, sent1, tm)
        values[0, i] = rate
        values[1, i] = first
        values[2, i] = delayed
        values[3, i] = offset
        values[4, i] = sent1
        values[5, i] = sent2
        values[6, i] = tags_rate
        values[7, i] = interval
        values[8, i] = (r1 - rm) - interval


@threaded_kernel
def add_draws(
    readings: Readings, ideal: Array, noise: Array, powers: Array, epsilon_products: Array, lambda_products: Array
) -> None:
    """Add one draw for each row of ``noise`` to the sums.

    ``powers`` (quantities, n, 3): first, second and fourth power of every error; ``epsilon_products`` (n,):
    ε(t_i)·ε(t_i + Δ_i); ``lambda_products`` (n, n): λ·λᵀ, its lower triangle.
    """
    quantities, n = ideal.shape
    errors = np.empty((quantities, n))
    for k in range(len(noise)):
        run_chain(readings, noise[k], errors)
        for quantity in range(quantities):
            for i in range(n):
                error = errors[quantity, i] - ideal[quantity, i]
                errors[quantity, i] = error
                square = error * error
                powers[quantity, i, 0] += error
                powers[quantity, i, 1] += square
                powers[quantity, i, 2] += square * square
        for i in range(n):
            epsilon_products[i] += errors[_EPSILON_FIRST, i] * errors[_EPSILON_DELAYED, i]
            for j in range(i + 1):
                lambda_products[i, j] += errors[_LAMBDA, i] * errors[_LAMBDA, j]


@threaded_kernel
def list_lambdas(readings: Readings, ideal: Array, noise: Array, lambdas: Array) -> None:
    """Write the errors of the DTDoAs, in ticks, shape (draws, n): one draw for each row of ``noise``."""
    n = lambdas.shape[1]
    errors = np.empty((len(ideal), n))
    for k in range(len(noise)):
        run_chain(readings, noise[k], errors)
        for i in range(n):
            lambdas[k, i] = errors[_LAMBDA, i] - ideal[_LAMBDA, i]


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
    readings = readings_of(chain, reference)
    ideal, n = ideal_values(readings), len(readings.tof)

    def zeros() -> tuple[Array, Array, Array]:
        return np.zeros((len(Quantity), n, 3)), np.zeros(n), np.zeros((n, n))

    def sums_of(chunk: tuple[int, int]) -> tuple[Array, Array, Array]:
        sums = zeros()
        for noise in noise_batches(seed, *chunk, noise_size(n), uniform=uniform):
            add_draws(readings, ideal, noise, *sums)
        return sums

    powers, epsilons, lambdas = zeros()
    with ThreadPoolExecutor(threads or cores()) as pool:
        for of_chunk in pool.map(sums_of, _chunks(draws)):
            for whole, part in zip((powers, epsilons, lambdas), of_chunk, strict=True):
                np.add(whole, part, out=whole)
    first, second, fourth = np.moveaxis(powers, 2, 0) / draws
    lower = lambdas / draws
    products = lower + np.tril(lower, -1).T - np.outer(first[Quantity.LAMBDA], first[Quantity.LAMBDA])
    epsilon = epsilons / draws - first[Quantity.EPSILON_FIRST] * first[Quantity.EPSILON_DELAYED]
    return ChainMoments(
        draws=draws,
        mean=first * _UNITS,
        variance=(second - first**2) * (draws / (draws - 1)) * _UNITS**2,
        fourth=fourth * _UNITS**4,
        epsilon_covariance_s2=epsilon * TICK_S**2,
        lambda_covariance_m2=products * TICK_M**2,
    )


def draw_lambdas(
    chain: Chain, seed: int, draws: int, *, reference: Reference = Reference.APART, uniform: bool = False
) -> Iterator[Array]:
    """Errors of the DTDoAs of the draws that ``draw_moments`` makes, in metres, shape (up to a batch, n) each."""
    readings = readings_of(chain, reference)
    ideal, n = ideal_values(readings), len(readings.tof)
    for chunk, count in _chunks(draws):
        for noise in noise_batches(seed, chunk, count, noise_size(n), uniform=uniform):
            lambdas = np.empty((len(noise), n))
            list_lambdas(readings, ideal, noise, lambdas)
            yield lambdas * TICK_M


def _chunks(draws: int) -> Iterator[tuple[int, int]]:
    """Number and draws of every chunk."""
    for chunk in range(-(-draws // CHUNK_DRAWS)):
        yield chunk, min(CHUNK_DRAWS, draws - chunk * CHUNK_DRAWS)
