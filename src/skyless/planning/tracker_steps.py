"""Steps of the tracker's two covariances (``tracker_sigma``): time that passes, and a message that is heard.

P is the filter's own covariance, S that of the true error, X that of the true error with the anchors' clock errors.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyless.compiled import borrowing_kernel, kernel
from skyless.positioning.kalman import innovation_variance, predict_clock, predict_motion
from skyless.positioning.tracker import TrackerSettings

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Integers = NDArray[np.int64]

GATE: Final = TrackerSettings().gate
"""Innovations beyond so many standard deviations are not used."""


class Work(NamedTuple):
    """The covariances of a point, and what its updates need."""

    P: Matrix
    S: Matrix
    """Shapes (states, states)."""
    X: Matrix
    """Shape (states, 2·anchors)."""
    h: Vector
    ph: Vector
    K: Vector
    """Of the message at hand: its gradient, P·h and the gain; shapes (states,)."""
    g: Vector
    """Its true covariance with the state."""
    shift: Vector
    """Mean error, shape (states,)."""
    active: Integers
    """Anchors in view, the master apart: as many as ``choose_active`` says, ..."""
    place: Integers
    """... and where each stands among them, or −1; shapes (anchors,)."""


@kernel
def new_work(anchors: int, states: int) -> Work:
    """Room for a point, and for one after the other."""
    P, S, X = np.zeros((states, states)), np.zeros((states, states)), np.zeros((states, 2 * anchors))
    h, ph, K, g, shift = np.zeros(states), np.zeros(states), np.zeros(states), np.zeros(states), np.zeros(states)
    return Work(P, S, X, h, ph, K, g, shift, np.zeros(anchors, np.int64), np.zeros(anchors, np.int64))


@borrowing_kernel
def _with_anchors_predict(X: Matrix, dim: int, count: int, dt_s: float, white: float, walk: float) -> None:
    """Advance the covariance of the tag's error with the anchors'; the master's noise is common to its clocks."""
    clock = 2 * dim
    q00, q01, q11 = dt_s * (white + walk * dt_s * dt_s / 3.0), walk * dt_s * dt_s / 2.0, walk * dt_s
    for column in range(2 * count):
        for axis in range(dim):
            X[axis, column] += dt_s * X[dim + axis, column]
        X[clock, column] += dt_s * X[clock + 1, column]
    for c in range(count):
        for row in range(X.shape[0]):
            X[row, 2 * c] += dt_s * X[row, 2 * c + 1]
        X[clock, 2 * c] += q00
        X[clock, 2 * c + 1] += q01
        X[clock + 1, 2 * c] += q01
        X[clock + 1, 2 * c + 1] += q11


@kernel
def gated(mean: float, variance: float) -> tuple[float, float, float, float, float]:
    """What the gate leaves of a normal innovation in units of the assumed spread: share, E[f], E[f²], E[f⁴], E[f'].

    f(z) is z within the gate and 0 beyond; E[f'] is the slope of E[f] in the mean.
    """
    if abs(mean) < 0.5 and variance < 1.3:
        square = mean * mean
        fourth = 3.0 * variance * variance + 6.0 * variance * square + square * square
        return 1.0, mean, variance + square, fourth, 1.0
    deviation = math.sqrt(variance)
    high, low = (GATE - mean) / deviation, (-GATE - mean) / deviation
    share = 0.5 * (math.erf(high / math.sqrt(2.0)) - math.erf(low / math.sqrt(2.0)))
    scale = 1.0 / (deviation * math.sqrt(2.0 * math.pi))
    top, bottom = scale * math.exp(-0.5 * high * high), scale * math.exp(-0.5 * low * low)
    first = mean * share - variance * (top - bottom)
    second = variance * share + mean * first - variance * GATE * (top + bottom)
    third = 2.0 * variance * first + mean * second - variance * GATE**2 * (top - bottom)
    fourth = 3.0 * variance * second + mean * third - variance * GATE**3 * (top + bottom)
    return share, first, second, fourth, share - GATE * (top + bottom)


@borrowing_kernel
def true_correct(
    work: Work, part: float, noise: float, own: int, count: int, with_others: Vector, off: float, assumed: float
) -> tuple[float, float, float, float, float]:
    """Σ and X after a message that arrives with probability ``part``: error x − K(hx − v), v with its clock error.

    ``own`` is the sender's place among the active anchors, −1 for the master; ``off`` the innovation's mean. What the
    gate does to it is taken in the mean (statistical linearisation). Returns the moments of ``gated``.
    """
    S, X, K, h, g, active = work.S, work.X, work.K, work.h, work.g, work.active
    n = S.shape[0]
    spread = noise
    for row in range(n):
        g[row] = 0.0
        for column in range(n):
            g[row] += S[row, column] * h[column]
        spread += h[row] * g[row]
    if own >= 0:
        spread += with_others[2 * active[own]]
        for row in range(n):
            g[row] -= X[row, 2 * own]
            spread -= 2.0 * h[row] * X[row, 2 * own]
    moments = gated(off / math.sqrt(assumed), spread / assumed)
    spread, slope = assumed * (moments[2] - moments[1] * moments[1]), moments[4]
    for row in range(n):
        for column in range(n):
            S[row, column] += part * (K[row] * K[column] * spread - slope * (K[row] * g[column] + g[row] * K[column]))
    for column in range(2 * count):
        seen = 0.0
        if own >= 0:
            seen = -with_others[2 * active[column // 2] + column % 2]
        for row in range(n):
            seen += h[row] * X[row, column]
        for row in range(n):
            X[row, column] -= part * slope * K[row] * seen
    return moments


@borrowing_kernel
def anchors_hear(work: Work, part: float, count: int, share: Vector, gain: Matrix, tx_var: float) -> None:
    """X after the master's message, which the anchors hear too, with the same emission noise."""
    X, K = work.X, work.K
    for c in range(count):
        i = work.active[c]
        for row in range(X.shape[0]):
            own = X[row, 2 * c] - part * K[row] * tx_var
            X[row, 2 * c] -= share[i] * gain[i, 0] * own
            X[row, 2 * c + 1] -= share[i] * gain[i, 1] * own


@borrowing_kernel
def choose_active(work: Work, share: Vector, anchor_share: Vector) -> int:
    """List the anchors, the master apart, that a point hears; how many they are."""
    active, place = work.active, work.place
    count = 0
    for i in range(len(share)):
        place[i] = -1
        if share[i] > 0.0 and anchor_share[i] > 0.0:
            active[count] = i
            place[i] = count
            count += 1
    return count


@borrowing_kernel
def advance(work: Work, dim: int, count: int, dt_s: float, qa: float, settings: Vector) -> None:
    """Let time pass: the filter allows for motion, the tag rests."""
    P, S, idle, shift = work.P, work.S, work.h, work.shift
    white, walk = settings[0], settings[1]
    predict_motion(idle, P, dim, dt_s, qa)
    predict_clock(idle, P, 2 * dim, dt_s, 2.0 * white, 2.0 * walk)
    predict_motion(shift, S, dim, dt_s, 0.0)
    predict_clock(shift, S, 2 * dim, dt_s, 2.0 * white, 2.0 * walk)
    _with_anchors_predict(work.X, dim, count, dt_s, white, walk)


@borrowing_kernel
def innovation(work: Work, dim: int, direction: Vector, noise: float, delay_m: float) -> tuple[float, float]:
    """Fill h, P·h and the gain for a message; the innovation's variance as assumed, and its true mean."""
    h, ph, K = work.h, work.ph, work.K
    h[:] = 0.0
    for a in range(dim):
        h[a] = direction[a]
    h[2 * dim] = 1.0
    spread, off = innovation_variance(work.P, h, ph, noise), delay_m
    for a in range(len(h)):
        K[a] = ph[a] / spread
        off -= h[a] * work.shift[a]
    return spread, off


@borrowing_kernel
def assumed_correct(work: Work, accepted: float, moved_m: float) -> None:
    """The filter's own P, and the mean error, after a message that is accepted with this probability."""
    P, K = work.P, work.K
    for a in range(len(K)):
        work.shift[a] += K[a] * moved_m
        for b in range(len(K)):
            P[a, b] -= accepted * K[a] * work.ph[b]
