"""Predicted errors of ``tracker`` for a tag at rest: two covariances side by side, message by message.

P is the filter's own, with the motion that it allows for; it gives the gains. Σ is that of the true error under those
gains: no motion, the crystals as they are, and the anchors' clock errors as long as they last (``anchor_clocks``),
through the covariance X of the tag's error with theirs. Both are run through superframes until they are periodic.
Where walls delay messages so that the innovations look restless, the filter's agility grows; it is searched for.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyless.compiled import kernel, threaded_kernel
from skyless.planning.anchor_clocks import AnchorClocks
from skyless.planning.columns import (
    BIAS,
    CLAIMED,
    FIX_SHARE,
    RMSE,
    SIGMA,
    SIGMA_X,
    SIGMA_Z,
)
from skyless.planning.geometry import Scene, fill_dops, observe
from skyless.planning.tracker_steps import (
    Work,
    advance,
    anchors_hear,
    assumed_correct,
    choose_active,
    innovation,
    new_work,
    true_correct,
)
from skyless.positioning.tracker import FORGETTING, MAX_AGILITY, RESTLESS_CHI2

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

SETTLED: Final = 2e-4
"""Relative change of the traces over a superframe below which the errors count as periodic."""

SETTLED_IN_A_ROW: Final = 12
"""For so many superframes: one alone may be the turning point of an overshoot."""

LONGEST_S: Final = 4.0
"""Filter time after which they count so in any case."""

LEAST_S: Final = 0.5
"""Filter time after which a position that is worse than the site is large has no hope left."""

RESTLESS_SIGMAS: Final = 1.31
"""The agility stands where its running mean is restless log(1/AGILITY_LOSS)/log(AGILITY_GAIN/AGILITY_LOSS) = 9.5 % of
the time, the normal distribution's tail beyond so many standard deviations."""

RARELY: Final = 0.1
"""An anchor of whose frames fewer arrive does not help a tag to start."""


@kernel
def _superframe(
    work: Work,
    dim: int,
    share: Vector,
    sight: Matrix,
    clocks: AnchorClocks,
    sync_delay: Vector,
    master: int,
    settings: Vector,
    count: int,
    qa: float,
    sums: Vector,
    row: Vector,
) -> None:
    """Run one superframe; leave sums over its messages in ``row`` and ``sums`` (updates, chi2, its variance, rest)."""
    P, S, shift = work.P, work.S, work.shift
    stamps, tx_var = settings[2] + settings[3], settings[2]
    row[SIGMA_X : SIGMA_Z + 1] = 0.0
    row[CLAIMED], row[BIAS], sums[:3] = 0.0, 0.0, 0.0
    for k in range(len(clocks.sender)):
        i = clocks.sender[k]
        part = share[i]
        sums[3] += clocks.gap_s[k]
        if part == 0.0 and i != master:
            continue
        advance(work, dim, count, sums[3], qa, settings)
        sums[3] = 0.0
        work.K[:] = 0.0
        if part > 0.0:
            delay_m = sight[i, 3] + sync_delay[i]
            spread, off = innovation(work, dim, sight[i], stamps + clocks.variance_m2[k], delay_m)
            passed, first, second, fourth, _ = true_correct(
                work, part, stamps, work.place[i], count, clocks.with_others[k], off, spread
            )
            part *= passed
            assumed_correct(work, part, share[i] * first * math.sqrt(spread))
            sums[0] += part
            sums[1] += share[i] * second
            sums[2] += share[i] * (fourth - second * second / max(passed, 1e-9))
        if i == master:
            anchors_hear(work, share[i], count, clocks.share, clocks.gain, tx_var)
        for a in range(dim):
            row[SIGMA_X + a] += part * S[a, a]
            row[CLAIMED] += part * P[a, a]
            row[BIAS] += part * shift[a] * shift[a]


@kernel
def settle_tracker(
    work: Work,
    dim: int,
    share: Vector,
    sight: Matrix,
    clocks: AnchorClocks,
    sync_delay: Vector,
    master: int,
    settings: Vector,
    qa: float,
    farthest: float,
    row: Vector,
) -> float:
    """Run a point's filter until it is periodic and fill the columns from the mean over its last superframe.

    ``settings``: white and walk (m²/s, m²/s³) of one clock, tx and rx variance in m². Returns how high the running mean
    of the normalised squared innovations reaches, ``RESTLESS_SIGMAS`` above its mean.
    """
    count = choose_active(work, share, clocks.share)
    superframe_s, passed_s, before_p, before_s, settled = clocks.gap_s.sum(), 0.0, 0.0, 0.0, 0
    sums = np.zeros(4)
    while passed_s < LONGEST_S + 20.0 * superframe_s:
        _superframe(work, dim, share, sight, clocks, sync_delay, master, settings, count, qa, sums, row)
        passed_s += superframe_s
        told_p, true_s = row[CLAIMED], row[SIGMA_X] + row[SIGMA_X + 1] + row[SIGMA_Z]
        is_settled = abs(told_p - before_p) <= SETTLED * told_p and abs(true_s - before_s) <= SETTLED * true_s
        settled = settled + 1 if is_settled else 0
        if settled >= SETTLED_IN_A_ROW:
            break
        if passed_s > LEAST_S and true_s > farthest * farthest * sums[0]:
            break
        before_p, before_s = told_p, true_s
    _finish(row, dim, sums[0])
    row[FIX_SHARE] = sums[0] / len(clocks.sender)
    scatter = math.sqrt(sums[2] / sums[0] * FORGETTING / (2.0 - FORGETTING))
    return float(sums[1] / sums[0] + RESTLESS_SIGMAS * scatter)


@kernel
def _finish(row: Vector, dim: int, updates: float) -> None:
    """Turn sums of squares over a superframe into the columns."""
    squares = 0.0
    for a in range(dim):
        squares += row[SIGMA_X + a] / updates
        row[SIGMA_X + a] = math.sqrt(row[SIGMA_X + a] / updates)
    row[SIGMA] = math.sqrt(squares)
    row[RMSE] = math.sqrt(squares + row[BIAS] / updates)
    row[BIAS] = math.sqrt(row[BIAS] / updates)
    row[CLAIMED] = math.sqrt(row[CLAIMED] / updates)


@kernel
def begin(work: Work, dim: int) -> None:
    """Start both covariances somewhere sensible; the steady state does not depend on it."""
    P, S = work.P, work.S
    clock = 2 * dim
    P[:], S[:], work.X[:], work.shift[:] = 0.0, 0.0, 0.0, 0.0
    for axis in range(dim):
        P[axis, axis] = S[axis, axis] = 0.01
        P[dim + axis, dim + axis] = S[dim + axis, dim + axis] = 0.05
    P[clock, clock] = S[clock, clock] = 0.01
    P[clock + 1, clock + 1] = S[clock + 1, clock + 1] = 0.5


@threaded_kernel
def fill_tracker_sigma(
    points: Matrix,
    dim: int,
    scene: Scene,
    master: int,
    sync_delay: Vector,
    clocks: AnchorClocks,
    qa: float,
    settings: Vector,
    farthest: float,
    table: Matrix,
) -> None:
    """Fill ``table`` (points, columns) for the points, shape (m, 3)."""
    n, states = len(scene.anchors), 2 * dim + 2
    share, sight = np.zeros(n), np.zeros((n, 4))
    seen, normal, inverse = np.zeros((n, 3)), np.zeros((4, 4)), np.zeros((4, 4))
    work = new_work(n, states)
    for m in range(len(points)):
        row = table[m]
        observe(scene, points[m], share, sight)
        fill_dops(scene.anchors, share, points[m], dim, seen, normal, inverse, row)
        heard = 0
        for i in range(n):
            heard += share[i] >= RARELY
        row[SIGMA:] = math.inf
        row[FIX_SHARE] = 0.0
        if heard > dim:
            begin(work, dim)
            low, high, factor = 0.0, math.log(MAX_AGILITY), 0.0
            for trial in range(8):
                agile = qa * math.exp(factor)
                restless = settle_tracker(
                    work, dim, share, sight, clocks, sync_delay, master, settings, agile, farthest, row
                )
                if trial == 0 and restless <= RESTLESS_CHI2:
                    break
                low, high = (factor, high) if restless > RESTLESS_CHI2 else (low, factor)
                factor = 0.5 * (low + high)
            if not row[SIGMA] < farthest:
                row[SIGMA:] = math.inf
                row[FIX_SHARE] = 0.0
