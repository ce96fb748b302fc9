"""Random numbers for many nodes: every node draws from its own stream.

A node's stream depends only on the seed and the node's own key, so that another tag or anchor does not change what
others draw.
"""

import math
from typing import Final

import numpy as np

from skyless.core.arrays import Array, Integers
from skyless.site.kernels import part

BLOCK: Final = 1024
"""Normals drawn ahead for each node."""

MAX_DRAWS: Final = 16
"""Most numbers that one step of a node may draw; a smaller rest of a block is discarded."""

ANCHOR_KEY: Final = 0
TAG_KEY: Final = 1


def stream(seed: int, kind: int, number: int, purpose: int = 0) -> np.random.Generator:
    """The random generator of one node (or of one purpose of it), independent of all other keys."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(kind, number, purpose))))


class Streams:
    """Standard normals of every node, shape (nodes, BLOCK), with a cursor each that the kernels move."""

    def __init__(self, generators: list[np.random.Generator]) -> None:
        self._generators = generators
        self.normals: Array = np.empty((len(generators), BLOCK))
        self.cursors: Integers = np.zeros(len(generators), dtype=np.int64)
        for node in range(len(generators)):
            self._refill(node)

    def refill(self, highest_cursor: int) -> None:
        """Refill nearly used-up blocks; ``highest_cursor`` is that after the last step."""
        if highest_cursor > BLOCK - MAX_DRAWS:
            for node in np.flatnonzero(self.cursors > BLOCK - MAX_DRAWS):
                self._refill(int(node))

    def _refill(self, node: int) -> None:
        self._generators[node].standard_normal(out=self.normals[node])
        self.cursors[node] = 0


@part
def draw_normal(normals: Array, cursors: Integers, node: int) -> float:
    """Next standard normal of the node."""
    value: float = normals[node, cursors[node]]
    cursors[node] += 1
    return value


@part
def draw_uniform(normals: Array, cursors: Integers, node: int) -> float:
    """Next uniform number of the node in (0, 1): a normal mapped by its distribution function."""
    return 0.5 * math.erfc(-draw_normal(normals, cursors, node) / math.sqrt(2.0))
