"""Random numbers that are functions of keys: no state, so no order of drawing, and the same on any number of workers.

A number's key is the seed, a purpose, and up to three whole numbers (a node, another node, a frame or a knot). Each is
mixed in by a round of SplitMix64, a bijection of 64 bits. In plain Python NumPy warns of the overflow that it needs.
"""

import math
from typing import Final

import numpy as np

from skyless.site.kernels import kernel

START, CRYSTAL, TX_NOISE, RX_NOISE, CHANCE, LOSS, _, SURVEY, RANGE_CONSTANT, RANGE_CHANGING = range(1, 11)
"""Purposes."""

TAG_NODES: Final = 1 << 32
"""Tags are keyed by this and their number, anchors by their identifier."""

_STEP: Final = np.uint64(0x9E3779B97F4A7C15)
_FIRST: Final = np.uint64(0xBF58476D1CE4E5B9)
_SECOND: Final = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


@kernel
def mixed(key: np.uint64, value: int) -> np.uint64:
    """A key (64 bits) that depends on all bits of another and of a whole number, which may be negative."""
    x = (key ^ np.uint64(np.int64(value))) + _STEP
    x = (x ^ (x >> _S30)) * _FIRST
    x = (x ^ (x >> _S27)) * _SECOND
    return x ^ (x >> _S31)


@kernel
def purpose_key(seed: int, purpose: int) -> np.uint64:
    """Key of all numbers for one purpose."""
    return mixed(mixed(_STEP, seed), purpose)


@kernel
def key_of(base: np.uint64, one: int, other: int, number: int) -> np.uint64:
    """Key of one number: a purpose's key and three whole numbers."""
    return mixed(mixed(mixed(base, one), other), number)


@kernel
def uniform(key: np.uint64) -> float:
    """Uniform number in (0, 1) of a key, a multiple of 2⁻⁵³ and half of that."""
    return (np.float64(key >> _S11) + 0.5) * 2.0**-53


@kernel
def normal_pair(key: np.uint64) -> tuple[float, float]:
    """Two independent standard normals of a key (Box and Muller)."""
    length = math.sqrt(-2.0 * math.log(uniform(key)))
    turn = 2.0 * math.pi * uniform(mixed(key, 1))
    return length * math.cos(turn), length * math.sin(turn)


@kernel
def normal(key: np.uint64) -> float:
    """A standard normal of a key: the first of its pair."""
    return math.sqrt(-2.0 * math.log(uniform(key))) * math.cos(2.0 * math.pi * uniform(mixed(key, 1)))
