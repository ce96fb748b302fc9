"""Clocks as functions of true time: counters at knots, straight lines in between.

The knots' noise is the two-state model of ``sim/oscillator.py``, sampled exactly from knot to knot by keyed
normals. All counters are summed up in one pass over all nodes, a few nanoseconds a knot and node; sums at checkpoints
are kept, so that a time far back costs no more than one stretch. Straight lines leave out the white frequency noise
within a knot's interval: 2 ps in its middle for a white FM of 2e-11.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from skyless.core.arrays import Array, Integers
from skyless.core.ticks import TICK_RATE_HZ, WRAP_TICKS
from skyless.sim.cells._keyed import CRYSTAL, START, key_of, mixed, normal_pair, purpose_key, uniform
from skyless.sim.oscillator import OscillatorModel
from skyless.site.kernels import kernel

KNOT_BITS: Final = 31
KNOT_TICKS: Final = 1 << KNOT_BITS
"""True time between knots, 33.6 ms."""
_MASK: Final = KNOT_TICKS - 1
_KNOT_S: Final = KNOT_TICKS / TICK_RATE_HZ

CHECKPOINT_KNOTS: Final = 256
"""Between two sums that are kept, 8.6 s: 28 kB for each second of 10,000 nodes."""

_AHEAD_KNOTS: Final = 8
"""Summed up beyond the demand, so that small steps of it seldom cost one."""


class Knots(NamedTuple):
    """Counters of all nodes at knots of true time."""

    first: int
    """Number of the first knot; knot k is ``k · KNOT_TICKS`` after the start."""
    ticks: Integers
    """Own unwrapped counters, whole, shape (nodes, knots)."""
    fraction: Array
    """Their fractions, in [0, 1)."""


@kernel
def own_time(knots: Knots, node: int, true_ticks: int, true_fraction: float) -> tuple[int, float]:
    """A node's unwrapped counter at a true time, whole and fraction, both times within the knots."""
    k = (true_ticks >> KNOT_BITS) - knots.first
    within = true_ticks & _MASK
    ticks, fraction = knots.ticks[node, k], knots.fraction[node, k]
    gain = (knots.ticks[node, k + 1] - ticks - KNOT_TICKS) + (knots.fraction[node, k + 1] - fraction)
    total = fraction + true_fraction + gain * ((within + true_fraction) / KNOT_TICKS)
    carry = math.floor(total)
    return ticks + within + int(carry), total - carry


@kernel
def true_time(knots: Knots, node: int, own_ticks: int) -> tuple[int, float]:
    """True time, whole and fraction, at which a node's unwrapped counter shows a whole value."""
    last = knots.ticks.shape[1] - 2
    k = min(max((own_ticks - knots.ticks[node, 0]) >> KNOT_BITS, 0), last)
    while k > 0 and knots.ticks[node, k] > own_ticks:
        k -= 1
    while k < last and knots.ticks[node, k + 1] <= own_ticks:
        k += 1
    ticks, fraction = knots.ticks[node, k], knots.fraction[node, k]
    gain = (knots.ticks[node, k + 1] - ticks - KNOT_TICKS) + (knots.fraction[node, k + 1] - fraction)
    since = (own_ticks - ticks) - fraction
    rest = -fraction - gain * (since / (KNOT_TICKS + gain))
    carry = math.floor(rest)
    return ((knots.first + k) << KNOT_BITS) + (own_ticks - ticks) + int(carry), rest - carry


@kernel
def start_clocks(seed: int, nodes: Integers, offset_ppm: float, ticks: Integers, fraction: Array, rate: Array) -> None:
    """Random counters and rates at knot 0 of the nodes with those keys, shape (n,) each."""
    base = purpose_key(seed, START)
    for node in range(nodes.shape[0]):
        key = mixed(base, nodes[node])
        ticks[node] = int(uniform(mixed(key, 0)) * WRAP_TICKS)
        fraction[node] = uniform(mixed(key, 1))
        rate[node] = offset_ppm * 1e-6 * (2.0 * uniform(mixed(key, 2)) - 1.0)


@kernel
def extend_clocks(
    seed: int,
    nodes: Integers,
    white_fm: float,
    random_walk_fm: float,
    first: int,
    ticks: Integers,
    fraction: Array,
    rate: Array,
) -> None:
    """Sum up counters from knot to knot: column 0 is given, the others are filled in, ``rate`` is brought along.

    ``ticks`` and ``fraction`` have shape (nodes, knots), ``first`` is the number of column 0.
    """
    base = purpose_key(seed, CRYSTAL)
    walk = random_walk_fm * math.sqrt(_KNOT_S)
    own_std_s = math.sqrt(_KNOT_S * (white_fm * white_fm + random_walk_fm * random_walk_fm * _KNOT_S * _KNOT_S / 12.0))
    for node in range(nodes.shape[0]):
        for k in range(ticks.shape[1] - 1):
            one, other = normal_pair(key_of(base, nodes[node], first + k, 0))
            rate_gain = walk * one
            gain = rate[node] * KNOT_TICKS + (0.5 * rate_gain * _KNOT_S + own_std_s * other) * TICK_RATE_HZ
            total = fraction[node, k] + gain
            carry = math.floor(total)
            ticks[node, k + 1] = ticks[node, k] + KNOT_TICKS + int(carry)
            fraction[node, k + 1] = total - carry
            rate[node] += rate_gain


class CellClocks:
    """The counters of nodes over a window of true time that moves with the demand."""

    def __init__(self, model: OscillatorModel, nodes: Integers, seed: int) -> None:
        """``nodes`` are the nodes' keys, shape (n,).

        Raises ValueError for crystals that follow a temperature, which these clocks do not.
        """
        if model.temperature is not None:
            raise ValueError("oscillator.temperature should be None: the clocks of several cells follow none")
        self._model, self._nodes, self._seed = model, nodes, seed
        count = len(nodes)
        ticks, fraction, self._rate = np.zeros((count, 1), dtype=np.int64), np.zeros((count, 1)), np.zeros(count)
        start_clocks(seed, nodes, model.offset_ppm, ticks[:, 0], fraction[:, 0], self._rate)
        self._knots = Knots(0, ticks, fraction)
        self._checkpoints = [(ticks[:, 0].copy(), fraction[:, 0].copy(), self._rate.copy())]

    def cover(self, first_ticks: int, last_ticks: int) -> Knots:
        """Counters from one true time to another, at the least; before the start there are none."""
        first, last = max(first_ticks >> KNOT_BITS, 0), (last_ticks >> KNOT_BITS) + 1
        if first < self._knots.first or first > self._knots.first + self._knots.ticks.shape[1] + CHECKPOINT_KNOTS:
            self._go_back(min(first // CHECKPOINT_KNOTS, len(self._checkpoints) - 1))
        if last >= self._knots.first + self._knots.ticks.shape[1]:
            self._extend(first, last + _AHEAD_KNOTS)
        return self._knots

    def shift(self, node: int, ticks: int) -> None:
        """Add whole ticks to a node's counter, now and for ever (a restart)."""
        self._knots.ticks[node] += ticks
        for counters, _, _ in self._checkpoints:
            counters[node] += ticks

    def _go_back(self, checkpoint: int) -> None:
        ticks, fraction, rate = self._checkpoints[checkpoint]
        self._knots = Knots(checkpoint * CHECKPOINT_KNOTS, ticks[:, None].copy(), fraction[:, None].copy())
        self._rate = rate.copy()

    def _extend(self, first: int, last: int) -> None:
        """Sum up to knot ``last`` and forget those before ``first``; checkpoints on the way are kept."""
        while (end := self._knots.first + self._knots.ticks.shape[1] - 1) < last:
            until = min(last, (end // CHECKPOINT_KNOTS + 1) * CHECKPOINT_KNOTS)
            ticks = np.empty((len(self._nodes), until - end + 1), dtype=np.int64)
            fraction = np.empty(ticks.shape)
            ticks[:, 0], fraction[:, 0] = self._knots.ticks[:, -1], self._knots.fraction[:, -1]
            white_fm, random_walk_fm = self._model.white_fm, self._model.random_walk_fm
            extend_clocks(self._seed, self._nodes, white_fm, random_walk_fm, end, ticks, fraction, self._rate)
            if until == len(self._checkpoints) * CHECKPOINT_KNOTS:
                self._checkpoints.append((ticks[:, -1].copy(), fraction[:, -1].copy(), self._rate.copy()))
            kept = min(max(first - self._knots.first, 0), end - self._knots.first)
            self._knots = Knots(
                self._knots.first + kept,
                np.concatenate((self._knots.ticks[:, kept:-1], ticks), axis=1),
                np.concatenate((self._knots.fraction[:, kept:-1], fraction), axis=1),
            )
