"""Random numbers for many nodes: every node draws from its own stream.

A node's stream depends only on the seed and the node's own key, so that another tag or anchor does not change what
others draw.
"""

from math import erfc, sqrt
from typing import Annotated, Final

import numpy as np

from skyless.core.native.records import Array, Reals, Record, record
from skyless.core.native.views import view

BLOCK: Final = 1024
"""Normals drawn ahead for each node."""

MAX_DRAWS: Final = 16
"""Most numbers that one step of a node may draw; a smaller rest of a block is discarded."""

ANCHOR_KEY: Final = 0
TAG_KEY: Final = 1


def stream(seed: int, kind: int, number: int, purpose: int = 0) -> np.random.Generator:
    """The random generator of one node (or of one purpose of it), independent of all other keys."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(kind, number, purpose))))


@record
class Noise(Record):
    """Standard normals of a node, drawn ahead."""

    used: int
    normals: Annotated[Reals, BLOCK]


class Streams:
    """The noise of every node."""

    def __init__(self, generators: list[np.random.Generator]) -> None:
        self._generators = generators
        self.noise: Array[Noise] = (Noise * len(generators))()
        self._used, self._normals = view(self.noise)["used"], view(self.noise)["normals"]
        for node in range(len(generators)):
            self._refill(node)

    def refill(self, most_used: int = BLOCK) -> None:
        """Refill nearly used-up blocks; ``most_used``: numbers that some node has used."""
        if most_used > BLOCK - MAX_DRAWS:
            for node in np.flatnonzero(self._used > BLOCK - MAX_DRAWS):
                self._refill(int(node))

    def _refill(self, node: int) -> None:
        self._generators[node].standard_normal(out=self._normals[node])
        self._used[node] = 0


def draw_normal(n: Noise) -> float:
    """Next standard normal of a node."""
    value = n.normals[n.used]
    n.used += 1
    return value


def draw_uniform(n: Noise) -> float:
    """Next uniform number of a node in (0, 1): a normal mapped by its distribution function."""
    return 0.5 * erfc(-draw_normal(n) / sqrt(2.0))
