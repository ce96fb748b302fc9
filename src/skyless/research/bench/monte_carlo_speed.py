"""How fast ``research/paper/monte_carlo.py`` is, compared with a plain loop over its draws."""

import time
from collections.abc import Callable
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array
from skyless.core.processors import cores
from skyless.core.ticks import TICK_S
from skyless.research.paper.monte_carlo import draw_moments, ideal_values, noise_size, run_chain
from skyless.research.uncertainty.chain import Chain, Reference

_ROUNDS: Final = 3
"""Measurements of each in turn; the best counts, as other work on the machine only slows down."""


class MonteCarloSpeed(Struct, frozen=True):
    """Draws per second of the whole chain and its sums; ``ratio`` is batches over the loop, both on one core."""

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


def draw_loop(chain: Chain, draws: int) -> Array:
    """Variances of all quantities, shape (quantities, n), by a loop over draws, as anyone would write it first."""
    generator, ideal = np.random.default_rng(1), ideal_values(chain, Reference.APART)
    squares = np.zeros_like(ideal)
    for _ in range(draws):
        noise = generator.standard_normal((1, noise_size(chain)))
        squares += (run_chain(chain, Reference.APART, noise)[:, 0] - ideal) ** 2
    return squares / draws


def measure(draws: int, anchors: int = 10) -> MonteCarloSpeed:
    """Measure both; the NumPy loop makes a hundredth of ``draws``."""
    chain = bench_chain(anchors)
    loops, ones, boths = [], [], []
    for _ in range(_ROUNDS):
        loops.append(_rate(max(draws // 100, 100), lambda n: draw_loop(chain, n)))
        ones.append(_rate(draws, lambda n: draw_moments(chain, 1, n, threads=1)))
        boths.append(_rate(draws, lambda n: draw_moments(chain, 1, n)))
    loop, one = max(loops), max(ones)
    return MonteCarloSpeed(anchors, loop, one, max(boths), cores(), one / loop)


def _rate(draws: int, run: Callable[[int], object]) -> float:
    """Draws per second."""
    started_s = time.perf_counter()
    run(draws)
    return draws / (time.perf_counter() - started_s)
