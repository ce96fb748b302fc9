"""How fast ``research/paper/monte_carlo.py`` is, compared with a plain NumPy loop over draws of the same chain."""

import time
from collections.abc import Callable
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.random import Generator

from skyless.core.arrays import Array
from skyless.core.constants import TICK_S
from skyless.core.processors import cores
from skyless.research.paper.monte_carlo import Quantity, draw_moments
from skyless.research.uncertainty.chain import Chain

_ROUNDS: Final = 3
"""Measurements of each in turn; the best counts, as other work on the machine only slows down."""


class MonteCarloSpeed(Struct, frozen=True):
    """Draws per second of the whole chain and its sums; ``ratio`` is compiled over NumPy loop, both on one core."""

    anchors: int
    numpy_loop_draws_per_s: float
    one_core_draws_per_s: float
    all_cores_draws_per_s: float
    cores: int
    ratio: float


def bench_chain(anchors: int = 10, seed: int = 1) -> Chain:
    """A chain of ``anchors`` random anchors that share one synchronisation."""
    draw = np.random.default_rng(seed)
    sigma_s = TICK_S / 3.0
    return Chain(
        master_offset_s=0.01,
        master_rate=1.0 + 5e-6,
        tag_offset_s=0.3,
        tag_rate=1.0 - 8e-6,
        anchor_offset_s=draw.uniform(0.0, 1.0, anchors),
        anchor_rate=1.0 + draw.uniform(-20e-6, 20e-6, anchors),
        anchor_tof_s=draw.uniform(3e-9, 40e-9, anchors),
        tag_tof_s=draw.uniform(3e-9, 40e-9, anchors),
        tag_master_tof_s=20e-9,
        sync_s=0.0,
        sync_spacing_s=0.015,
        reference_s=0.02,
        delay_s=draw.uniform(1e-3, 12e-3, anchors),
        spacing_s=draw.uniform(10e-3, 20e-3, anchors),
        sigma_master_s=sigma_s,
        sigma_anchor_s=sigma_s,
        sigma_tag_s=sigma_s,
    )


def numpy_loop(chain: Chain, draws: int, generator: Generator) -> tuple[Array, Array]:
    """Means and variances of all quantities, shape (quantities, n), by a loop over draws with NumPy over anchors.

    In seconds, and λ in seconds of the tag. What anyone would write first, without its own kernels.
    """
    n = len(chain.anchor_rate)
    ideal = numpy_draw(chain, np.zeros((4 + 6 * n,)))
    total, squares = np.zeros((len(Quantity), n)), np.zeros((len(Quantity), n))
    for _ in range(draws):
        error = numpy_draw(chain, generator.standard_normal(4 + 6 * n)) - ideal
        total += error
        squares += error**2
    mean = total / draws
    return mean, squares / draws - mean**2


def numpy_draw(chain: Chain, noise: Array) -> Array:
    """All quantities of one draw, shape (quantities, n), for noise of unit variance, four shared and six per anchor."""
    c = chain
    shared, own = noise[:4], noise[4 : 4 + 6 * len(c.anchor_rate)].reshape(-1, 6)
    s1_noise, s2_noise, a1_noise, a2_noise = (c.sigma_anchor_s * own[:, k] for k in range(4))
    t2, t_i = c.sync_s + c.sync_spacing_s, c.reference_s + c.delay_s
    m1 = c.master_offset_s + c.master_rate * c.sync_s + c.sigma_master_s * shared[0]
    m2 = c.master_offset_s + c.master_rate * t2 + c.sigma_master_s * shared[1]
    tm = c.master_offset_s + c.master_rate * c.reference_s + c.sigma_master_s * shared[2]
    rm = c.tag_offset_s + c.tag_rate * (c.reference_s + c.tag_master_tof_s) + c.sigma_tag_s * shared[3]
    s1 = c.anchor_offset_s + c.anchor_rate * (c.sync_s + c.anchor_tof_s) + s1_noise
    s2 = c.anchor_offset_s + c.anchor_rate * (t2 + c.anchor_tof_s) + s2_noise
    a1 = c.anchor_offset_s + c.anchor_rate * t_i + a1_noise
    a2 = c.anchor_offset_s + c.anchor_rate * (t_i + c.spacing_s) + a2_noise
    r1 = c.tag_offset_s + c.tag_rate * (t_i + c.tag_tof_s) + c.sigma_tag_s * own[:, 4]
    r2 = c.tag_offset_s + c.tag_rate * (t_i + c.spacing_s + c.tag_tof_s) + c.sigma_tag_s * own[:, 5]
    rate = (s2 - s1) / (m2 - m1)
    first = s1 - rate * m1 - c.anchor_tof_s
    delayed = s2 - rate * m2 - c.anchor_tof_s
    offset = (first + delayed) / 2
    sent1, sent2 = (a1 - offset) / rate, (a2 - offset) / rate
    tags_rate = (r2 - r1) / (sent2 - sent1)
    interval = tags_rate * (sent1 - tm)
    return np.array([rate, first, delayed, offset, sent1, sent2, tags_rate, interval, (r1 - rm) - interval])


def measure(draws: int, anchors: int = 10) -> MonteCarloSpeed:
    """Measure both; the NumPy loop makes a hundredth of ``draws``, and all is compiled before."""
    chain = bench_chain(anchors)
    draw_moments(chain, 1, 2)
    loops, ones, boths = [], [], []
    for _ in range(_ROUNDS):
        loops.append(_rate(max(draws // 100, 100), lambda n: numpy_loop(chain, n, np.random.default_rng(1))))
        ones.append(_rate(draws, lambda n: draw_moments(chain, 1, n, threads=1)))
        boths.append(_rate(draws, lambda n: draw_moments(chain, 1, n)))
    loop, one = max(loops), max(ones)
    return MonteCarloSpeed(anchors, loop, one, max(boths), cores(), one / loop)


def _rate(draws: int, run: Callable[[int], object]) -> float:
    """Draws per second."""
    started_s = time.perf_counter()
    run(draws)
    return draws / (time.perf_counter() - started_s)
