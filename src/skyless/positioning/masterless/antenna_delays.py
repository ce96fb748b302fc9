"""Antenna delays of anchors that range each other, from how much longer their flights seem than their distances.

The flight of anchors i and j as they range it is their distance + a_i + a_j, a being half of what TX and RX of a node
are late together. A listener sees j as d + 2·a_i between i's reception of j and its own clock, so that without the a
its time differences are off by a_j − a_i. Positions, too, are off by centimetres, and signals are stamped by their
strength (Decawave APS011), so a pair's excess says no more than that of a node that nobody has measured.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from skyless.kernels.arrays import Array

EXCESS_STD_M: Final = 0.1
"""What is in the excess of a pair beside the delays of its nodes: places that are off, strong and weak signals."""

DELAY_STD_M: Final = 0.07
"""How much the delays of nodes of one kind scatter: two of them as much as all else."""

BLOCKED_M: Final = 0.5
"""A pair whose excess is farther from all others' is blocked or reflected."""

Pair = tuple[int, int]


def antenna_delays_m(excess_m: Mapping[Pair, float]) -> dict[int, float]:
    """Best linear estimate of each anchor's delay a, less the mean of all; ``excess_m``: flights less distances."""
    if not excess_m:
        return {}
    middle = float(np.median(list(excess_m.values())))
    kept = {pair: excess - middle for pair, excess in excess_m.items() if abs(excess - middle) <= BLOCKED_M}
    anchors = sorted({anchor for pair in kept for anchor in pair})
    H, excess = _design(kept, anchors), np.array(list(kept.values()))
    information = H.T @ H / EXCESS_STD_M**2
    information[range(len(anchors)), range(len(anchors))] += 1.0 / DELAY_STD_M**2
    delays = np.linalg.solve(information, H.T @ excess / EXCESS_STD_M**2)
    return dict(zip(anchors, delays[:-1].tolist(), strict=True))


def contradictions_m(excess_m: Mapping[Pair, float], delays_m: Mapping[int, float]) -> dict[Pair, float]:
    """Pairs whose flights cannot be had by their positions, by how much they are too long; empty where all can.

    Obstacles make flights longer, and only that; where one is too short, positions are wrong.
    """
    if not excess_m:
        return {}
    middle = float(np.median(list(excess_m.values())))
    off_m = {
        (a, b): excess - middle - delays_m.get(a, 0.0) - delays_m.get(b, 0.0) for (a, b), excess in excess_m.items()
    }
    wrong = {pair: round(off, 3) for pair, off in off_m.items() if abs(off) > BLOCKED_M}
    return wrong if min(wrong.values(), default=0.0) < 0.0 else {}


def _design(pairs: Mapping[Pair, float], anchors: list[int]) -> Array:
    """A row for each pair: its two anchors, and what all have in common in the last column."""
    place = {anchor: k for k, anchor in enumerate(anchors)}
    H = np.zeros((len(pairs), len(anchors) + 1))
    H[:, -1] = 1.0
    for row, (a, b) in enumerate(pairs):
        H[row, place[a]] = H[row, place[b]] = 1.0
    return H
