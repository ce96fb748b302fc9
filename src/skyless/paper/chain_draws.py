"""Draws of the paper's chain as it is: the program's own kernels on noisy stamps, summed up as they come.

One draw is one synchronisation of n anchors and one DTDoA of each, with a noise number for every stamp. Ideal
readings are float ticks; a hundred-thousandth of a tick is lost where clocks stand a second from their origins. Errors
are taken against the same chain without noise. The scalar functions are those of
``positioning/methods/snapshots.py``, on the processor and on a GPU alike.
"""

from enum import IntEnum
from typing import Final

import numpy as np

from skyless.constants import TICK_S
from skyless.kernels.arrays import Array
from skyless.kernels.compiled import kernel, threaded_kernel
from skyless.paper.counter_random import NUMBERS_PER_BLOCK, fill_noise
from skyless.positioning.methods.snapshots import (
    averaged_offset,
    protocol_interval,
    relative_offset,
    relative_rate,
    tag_rate,
    to_master,
)
from skyless.uncertainty.chain import Chain, Reference


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


QUANTITIES: Final = len(Quantity)

_M1, _M2, _TM, _RM = range(4)
"""Columns of the shared readings and places of their noise: the master's stamps, the tag's of the reference packet."""
_S1, _S2, _A1, _A2, _R1, _R2, _TOF = range(7)
"""Columns of an anchor's readings: its receptions, its transmissions, the tag's receptions; then the flight time."""
_SHARED: Final = 4
_OWN: Final = 6
_SIGMA_MASTER, _SIGMA_ANCHOR, _SIGMA_TAG, _REFERENCE = range(4)
_POWERS: Final = 3
"""Sums of the first, second and fourth power are kept of every quantity."""


class Readings:
    """A chain as the kernels take it: what every clock would read, in ticks, and the noise."""

    def __init__(self, chain: Chain, reference: Reference, *, uniform: bool) -> None:
        t_m, t_i = chain.reference_s, chain.reference_s + chain.delay_s
        sync = np.array([chain.sync_s, chain.sync_s + chain.sync_spacing_s])

        def master(true_s: Array) -> Array:
            return (chain.master_offset_s + chain.master_rate * true_s) / TICK_S

        def anchor(true_s: Array) -> Array:
            return (chain.anchor_offset_s + chain.anchor_rate * true_s) / TICK_S

        def tag(true_s: Array) -> Array:
            return (chain.tag_offset_s + chain.tag_rate * true_s) / TICK_S

        heard_s = t_i + chain.tag_tof_s
        received = (sync[0] + chain.anchor_tof_s, sync[1] + chain.anchor_tof_s)
        columns = [anchor(t) for t in (*received, t_i, t_i + chain.spacing_s)]
        columns += [tag(heard_s), tag(heard_s + chain.spacing_s), chain.anchor_tof_s / TICK_S]
        self.anchors = np.ascontiguousarray(np.column_stack(np.broadcast_arrays(*columns)))
        at_reference = tag(np.array(t_m + chain.tag_master_tof_s))
        self.shared = np.array([*master(sync), master(np.array(t_m)), at_reference])
        which = {Reference.APART: _TM, Reference.FIRST_SYNC: _M1, Reference.SECOND_SYNC: _M2}[reference]
        sigmas = [chain.sigma_master_s, chain.sigma_anchor_s, chain.sigma_tag_s]
        self.settings = np.array([*(sigma / TICK_S for sigma in sigmas), which])
        self.uniform = uniform
        self.ideal = np.empty((QUANTITIES, len(self.anchors)))
        run_chain(self.shared, self.anchors, self.settings, np.zeros(noise_size(len(self.anchors))), self.ideal)


@kernel
def noise_size(anchors: int) -> int:
    """Numbers of one draw, rounded up to whole blocks of the generator."""
    return -(-(_SHARED + _OWN * anchors) // NUMBERS_PER_BLOCK) * NUMBERS_PER_BLOCK


def sums_size(anchors: int) -> int:
    """Length of the sums: powers of all quantities, ε(t_i)·ε(t_i + Δ_i), and λ·λᵀ (its lower triangle)."""
    return _POWERS * QUANTITIES * anchors + anchors + anchors * anchors


@kernel
def run_chain(shared: Array, anchors: Array, settings: Array, noise: Array, values: Array) -> None:
    """Write every quantity of the chain, shape (quantities, n), for stamps with ``noise`` (of unit variance)."""
    sigma_master, sigma_anchor, sigma_tag = settings[_SIGMA_MASTER], settings[_SIGMA_ANCHOR], settings[_SIGMA_TAG]
    m1 = shared[_M1] + sigma_master * noise[_M1]
    m2 = shared[_M2] + sigma_master * noise[_M2]
    tm = shared[_TM] + sigma_master * noise[int(settings[_REFERENCE])]
    rm = shared[_RM] + sigma_tag * noise[_RM]
    for i in range(len(anchors)):
        at = _SHARED + _OWN * i
        s1 = anchors[i, _S1] + sigma_anchor * noise[at + _S1]
        s2 = anchors[i, _S2] + sigma_anchor * noise[at + _S2]
        a1 = anchors[i, _A1] + sigma_anchor * noise[at + _A1]
        a2 = anchors[i, _A2] + sigma_anchor * noise[at + _A2]
        r1 = anchors[i, _R1] + sigma_tag * noise[at + _R1]
        r2 = anchors[i, _R2] + sigma_tag * noise[at + _R2]
        tof = anchors[i, _TOF]
        rate = relative_rate(s2 - s1, m2 - m1)
        first = relative_offset(s1, m1, rate, tof)
        delayed = relative_offset(s2, m2, rate, tof)
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


@kernel
def add_draw(
    seed: int,
    draw: int,
    uniform: bool,
    shared: Array,
    anchors: Array,
    settings: Array,
    ideal: Array,
    noise: Array,
    errors: Array,
    sums: Array,
) -> None:
    """Make one draw and add its errors to ``sums``; ``noise`` and ``errors`` are scratch."""
    n = len(anchors)
    fill_noise(seed, draw, uniform, noise)
    run_chain(shared, anchors, settings, noise, errors)
    at = 0
    for quantity in range(QUANTITIES):
        for i in range(n):
            error = errors[quantity, i] - ideal[quantity, i]
            errors[quantity, i] = error
            square = error * error
            sums[at] += error
            sums[at + 1] += square
            sums[at + 2] += square * square
            at += _POWERS
    for i in range(n):
        sums[at] += errors[4, i] * errors[5, i]
        at += 1
    for i in range(n):
        for j in range(i + 1):
            sums[at + j] += errors[8, i] * errors[8, j]
        at += n


@threaded_kernel
def add_draws(
    seed: int,
    first: int,
    count: int,
    uniform: bool,
    shared: Array,
    anchors: Array,
    settings: Array,
    ideal: Array,
    sums: Array,
) -> None:
    """Add the draws from number ``first`` on to ``sums``."""
    noise = np.empty(noise_size(len(anchors)))
    errors = np.empty((QUANTITIES, len(anchors)))
    for draw in range(first, first + count):
        add_draw(seed, draw, uniform, shared, anchors, settings, ideal, noise, errors, sums)


@threaded_kernel
def list_lambdas(
    seed: int,
    first: int,
    uniform: bool,
    shared: Array,
    anchors: Array,
    settings: Array,
    ideal: Array,
    lambdas: Array,
) -> None:
    """Write the errors of the DTDoAs of the draws from number ``first`` on, in ticks, shape (draws, n)."""
    noise = np.empty(noise_size(len(anchors)))
    errors = np.empty((QUANTITIES, len(anchors)))
    for k in range(len(lambdas)):
        fill_noise(seed, first + k, uniform, noise)
        run_chain(shared, anchors, settings, noise, errors)
        for i in range(len(anchors)):
            lambdas[k, i] = errors[8, i] - ideal[8, i]
