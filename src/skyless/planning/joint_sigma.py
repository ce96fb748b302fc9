"""Predicted errors of ``joint`` for a tag at rest: the filter's covariance, less what it allows for motion.

P is the filter's own covariance, run through superframes until it is periodic. Its noises are as it assumes, so that
the true error has the same covariance but for the accelerations that it allows for and a tag at rest does not have.
What these add to P follows from the gains: what errors will do to the position is carried back through the superframes
before. The walls' delays are carried forward through the same gains.

Where only a share of an anchor's packets arrives, the stamps of all count for as much less: their variances are divided
by the share, and those of relayed receptions by the share of all three that they take.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyless.compiled import kernel, threaded_kernel
from skyless.planning.anchor_clocks import AnchorClocks
from skyless.planning.columns import BIAS, CLAIMED, FIX_SHARE, RMSE, SIGMA, SIGMA_X, SIGMA_Z
from skyless.planning.geometry import Scene, fill_dops, observe
from skyless.planning.joint_script import Script, new_script, write_script
from skyless.planning.joint_steps import (
    MOST_PLACES,
    RX_VAR,
    TX_VAR,
    Work,
    advance,
    back_in_time,
    back_through,
    by_anchor,
    by_tag,
    correct,
    new_packet,
    relay_variance,
    shift_by,
)
from skyless.planning.relays import Relays

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Integers = NDArray[np.int64]

SETTLED: Final = 1e-4
"""Relative change of the position's variance, or of a sum, over a superframe below which it counts as complete, ..."""

SETTLED_IN_A_ROW: Final = 4
"""... for so many superframes: one alone may be the turning point of an overshoot."""

LONGEST_S: Final = 4.0
"""Filter time after which it counts so in any case, and ..."""

LONGEST: Final = 20
"""... superframes."""

AS_LONG: Final = 4
"""Sums over the past go back at most so many times as far as the covariance took to settle."""

PHASES: Final = 4
"""Packets of a superframe at which the motion's part is computed."""


@kernel
def begin(P: Matrix, half: int, tx_var: float) -> None:
    """Start somewhere sensible; the steady state does not depend on it."""
    P[:] = 0.0
    for value in range(half):
        P[value, value] = 0.01
        P[half + value, half + value] = 0.05
    for noise in range(2 * half, len(P)):
        P[noise, noise] = tx_var


@kernel
def _superframe(work: Work, dim: int, script: Script, settings: Vector, qa: float, row: Vector) -> None:
    """Take the packets of one superframe; leaves every gain, and sums of the position's variances in ``row``."""
    P, gains, places, h, ph = work
    half, update, relay = dim + script.counts[0], 0, 0
    row[SIGMA_X : SIGMA_Z + 1], row[FIX_SHARE] = 0.0, 0.0
    for k in range(script.counts[1]):
        own, share = script.sender[k], script.share[k]
        advance(P, dim, half, script.since_s[k], qa, settings)
        new_packet(P, 2 * half + own, settings[TX_VAR] / share)
        count = by_tag(script.sight[own], dim, half, own, places, h)
        correct(P, places, h, count, settings[RX_VAR] / share, ph, gains[update])
        update += 1
        for r in range(relay, script.end[k]):
            count = by_anchor(dim, half, own, script.heard[r], script.age_s[r], places, h)
            variance = relay_variance(script.age_s[r], settings) / script.part[r]
            correct(P, places, h, count, variance, ph, gains[update])
            update += 1
        relay = script.end[k]
        for axis in range(dim):
            row[SIGMA_X + axis] += share * P[axis, axis]
        row[FIX_SHARE] += share


@kernel
def settle_joint(
    work: Work, dim: int, script: Script, settings: Vector, qa: float, superframe_s: float, row: Vector
) -> int:
    """Run superframes until they repeat; returns how many."""
    before, settled, count = 0.0, 0, 0
    while settled < SETTLED_IN_A_ROW and (count * superframe_s < LONGEST_S or count < LONGEST):
        _superframe(work, dim, script, settings, qa, row)
        now = row[SIGMA_X : SIGMA_X + dim].sum()
        settled = settled + 1 if abs(now - before) <= SETTLED * now else 0
        before = now
        count += 1
    return count


@kernel
def _by_motion(
    work: Work, adjoint: Matrix, phase: int, dim: int, script: Script, qa: float, most: int, caused: Vector
) -> None:
    """Fill ``caused`` with the variances, after packet ``phase``, that the filter's accelerations have."""
    half, packets, relays = dim + script.counts[0], script.counts[1], script.counts[2]
    _, gains, places, h, _ = work
    adjoint[:], caused[:], before = 0.0, 0.0, 0.0
    for axis in range(dim):
        adjoint[axis, axis] = 1.0
    for superframe in range(most):
        update = packets + relays
        for k in range(packets - 1, -1, -1):
            first = script.end[k - 1] if k > 0 else 0
            if superframe == 0 and k > phase:
                update -= script.end[k] - first + 1
                continue
            own = script.sender[k]
            for r in range(script.end[k] - 1, first - 1, -1):
                update -= 1
                count = by_anchor(dim, half, own, script.heard[r], script.age_s[r], places, h)
                back_through(adjoint, places, h, count, gains[update])
            update -= 1
            count = by_tag(script.sight[own], dim, half, own, places, h)
            back_through(adjoint, places, h, count, gains[update])
            adjoint[:, 2 * half + own] = 0.0
            back_in_time(adjoint, dim, half, script.since_s[k], qa, caused)
        now = caused.sum()
        if now - before <= SETTLED * now:
            break
        before = now


@kernel
def _by_walls(work: Work, dim: int, script: Script, most: int, row: Vector) -> None:
    """Carry the mean error that delays make through the superframes; leaves the sum of its squares in ``row``."""
    half, before = dim + script.counts[0], 0.0
    _, gains, places, h, shift = work
    shift[:] = 0.0
    for _ in range(most):
        update, relay = 0, 0
        row[BIAS] = 0.0
        for k in range(script.counts[1]):
            own = script.sender[k]
            for value in range(half):
                shift[value] += script.since_s[k] * shift[half + value]
            shift[2 * half + own] = 0.0
            count = by_tag(script.sight[own], dim, half, own, places, h)
            shift_by(shift, places, h, count, script.sight[own, 3], gains[update])
            update += 1
            for r in range(relay, script.end[k]):
                count = by_anchor(dim, half, own, script.heard[r], script.age_s[r], places, h)
                shift_by(shift, places, h, count, script.late_m[r], gains[update])
                update += 1
            relay = script.end[k]
            for axis in range(dim):
                row[BIAS] += script.share[k] * shift[axis] * shift[axis]
        if abs(row[BIAS] - before) <= SETTLED * row[BIAS]:
            break
        before = row[BIAS]


@kernel
def _finish(row: Vector, dim: int, motion: Vector) -> None:
    """Turn sums over a superframe into the columns; ``motion``: what accelerations have of each axis' variance."""
    heard, squares, told = row[FIX_SHARE], 0.0, 0.0
    for axis in range(dim):
        variance = row[SIGMA_X + axis] / heard
        told += variance
        variance = max(variance - motion[axis], 0.0)
        squares += variance
        row[SIGMA_X + axis] = math.sqrt(variance)
    row[SIGMA], row[CLAIMED] = math.sqrt(squares), math.sqrt(told)
    row[RMSE] = math.sqrt(squares + row[BIAS] / heard)
    row[BIAS] = math.sqrt(row[BIAS] / heard)


@kernel
def _fill_point(dim: int, script: Script, settings: Vector, qa: float, superframe_s: float, row: Vector) -> None:
    """Predict for one point; ``FIX_SHARE`` becomes the number of fixes in a superframe."""
    half, packets = dim + script.counts[0], script.counts[1]
    states = half + half + script.counts[0]
    work = Work(
        P=np.zeros((states, states)),
        gains=np.zeros((packets + script.counts[2], states)),
        places=np.zeros(MOST_PLACES, np.int64),
        h=np.zeros(MOST_PLACES),
        vector=np.zeros(states),
    )
    adjoint, motion, caused = np.zeros((dim, states)), np.zeros(dim), np.zeros(dim)
    begin(work.P, half, settings[TX_VAR])
    most = AS_LONG * settle_joint(work, dim, script, settings, qa, superframe_s, row)
    phases = min(PHASES, packets)
    for phase in range(phases):
        last = (phase + 1) * packets // phases - 1
        _by_motion(work, adjoint, last, dim, script, qa, most, caused)
        motion += caused / phases
    _by_walls(work, dim, script, most, row)
    _finish(row, dim, motion)


@threaded_kernel
def fill_joint_sigma(
    points: Matrix,
    dim: int,
    scene: Scene,
    clocks: AnchorClocks,
    relays: Relays,
    qa: float,
    settings: Vector,
    farthest: float,
    table: Matrix,
) -> None:
    """Fill ``table`` (points, columns) for the points, shape (m, 3)."""
    n, superframe_s = len(scene.anchors), clocks.gap_s.sum()
    share, sight = np.zeros(n), np.zeros((n, 4))
    seen, normal, inverse = np.zeros((n, 3)), np.zeros((4, 4)), np.zeros((4, 4))
    script = new_script(n, len(clocks.sender), len(relays.heard))
    for m in range(len(points)):
        row = table[m]
        observe(scene, points[m], share, sight)
        fill_dops(scene.anchors, share, points[m], dim, seen, normal, inverse, row)
        write_script(script, share, sight, clocks, relays)
        row[SIGMA:] = math.inf
        row[FIX_SHARE] = 0.0
        if script.counts[0] > dim:
            _fill_point(dim, script, settings, qa, superframe_s, row)
            row[FIX_SHARE] /= len(clocks.sender)
            if not row[SIGMA] < farthest:
                row[SIGMA:] = math.inf
                row[FIX_SHARE] = 0.0
