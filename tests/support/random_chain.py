"""A chain of the paper with random anchors, and its variances by a plain loop."""

import numpy as np

from skyless.core.ticks import TICK_S
from skyless.research.paper.plan import ideal_values, noise_size, run_chain
from skyless.research.uncertainty import Chain


def random_chain(anchors=10, seed=1):
    """A chain of random anchors that share one synchronisation."""
    draw = np.random.default_rng(seed)
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
        sigma_master_s=TICK_S / 3.0,
        sigma_anchor_s=TICK_S / 3.0,
        sigma_tag_s=TICK_S / 3.0,
    )


def draw_loop(chain, draws):
    """Variances of all quantities, shape (quantities, n), by a loop over draws, as anyone would write it first."""
    generator, ideal = np.random.default_rng(1), ideal_values(chain)
    squares = np.zeros_like(ideal)
    for _ in range(draws):
        noise = generator.standard_normal((1, noise_size(chain)))
        squares += (run_chain(chain, noise)[:, 0] - ideal) ** 2
    return squares / draws
