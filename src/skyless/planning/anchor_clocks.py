"""The anchors' clock errors in the steady state, as a tag's tracker meets them message by message.

The tracker takes them for white noise of the variance that each beacon tells. In truth they last for many superframes,
and the master's crystal and emission noise are common to all. Both matter: the true error follows from their joint
covariance, 2 × 2 blocks [offset, rate] for every pair of anchors, through one superframe.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyless.air.schedule import first_slots, schedule_of
from skyless.anchor import MAX_OFFSET_STD_M
from skyless.clocks.filter import clock_noise
from skyless.compiled import kernel
from skyless.constants import TICK_S
from skyless.planning.links import LEAST_SYNC
from skyless.site.model import Site
from skyless.uncertainty.tdoa import stamp_variance_m2

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_SETTLED: Final = 1e-7
_LONGEST: Final = 20_000
"""Superframes after which a filter counts as settled in any case."""


class AnchorClocks(NamedTuple):
    """One superframe of a site, message by message: who sends, when, and what its clock is worth."""

    speaks: NDArray[np.bool_]
    """Anchors whose clock is known well enough to send; shape (anchors,)."""
    sender: NDArray[np.int64]
    """Row of the sending anchor; shape (messages,)."""
    gap_s: Vector
    """Time since the message before."""
    variance_m2: Vector
    """What the beacon tells of its clock."""
    with_others: Matrix
    """Covariance of the sender's clock error with the offset and rate of every anchor's; (messages, 2·anchors)."""
    gain: Matrix
    """Of every anchor's filter at the master's messages; (anchors, 2)."""
    share: Vector
    """Share of the master's messages that each anchor follows; 0 for the master and for silent ones."""


def anchor_clocks(site: Site, share: Vector) -> AnchorClocks:
    """Steady state for anchors, in the order of the file, that hear these shares of the master's messages."""
    tx_var, rx_var = stamp_variances(site)
    noise = clock_noise(site.noise.white_fm, site.noise.random_walk_fm)
    master = [anchor.id for anchor in site.anchors].index(site.master)
    sender, time_s, superframe_s = _messages(site)
    n = len(share)
    gain, told = np.zeros((n, 2)), np.zeros((len(sender), n))
    speaks = share >= LEAST_SYNC
    for row in range(n):
        if row != master and speaks[row]:
            same = np.flatnonzero((share[:row] == share[row]) & (np.arange(row) != master))
            if len(same):
                gain[row], told[:, row] = gain[same[0]], told[:, same[0]]
                continue
            _settle(
                sender, time_s, superframe_s, master, share[row], tx_var + rx_var, noise.white, noise.walk, gain[row],
                told[:, row],
            )  # fmt: skip
    own = told[np.arange(len(sender)), sender]
    for row in range(n):
        if row != master and (own[sender == row] > MAX_OFFSET_STD_M**2).any():
            speaks[row] = False
    spoken = speaks[sender]
    sender, time_s = sender[spoken], time_s[spoken]
    heard = np.where(speaks & (np.arange(n) != master), share, 0.0)
    together = np.zeros((len(sender), 2 * n))
    _settle_together(
        sender, time_s, superframe_s, master, heard, tx_var, rx_var, noise.white / 2.0,
        noise.walk / 2.0, gain, together,
    )  # fmt: skip
    gap_s = np.diff(time_s, prepend=time_s[-1] - superframe_s) if len(time_s) else time_s
    return AnchorClocks(speaks, sender, gap_s, own[spoken], together, gain, heard)


def stamp_variances(site: Site) -> tuple[float, float]:
    """Variances, m², of a TX stamp and of an RX stamp with its rounding."""
    noise = site.noise
    tx_var = stamp_variance_m2(noise.tx_stamp_ps * 1e-12, rounded=False)
    return tx_var, stamp_variance_m2(noise.rx_stamp_ps * 1e-12, rounded=True)


def _messages(site: Site) -> tuple[NDArray[np.int64], Vector, float]:
    """Rows of the anchors in the order in which they send in a superframe, their times, and its length."""
    schedule, first = schedule_of(site), first_slots(site)
    slot_s = schedule.slot_ticks * TICK_S
    order = sorted((slot, row) for row, a in enumerate(site.anchors) for slot in schedule.slots_of(first[a.id]))
    senders = np.array([row for _, row in order], dtype=np.int64)
    return senders, np.array([slot * slot_s for slot, _ in order]), schedule.superframe_ticks * TICK_S


@kernel
def _settle(
    sender: NDArray[np.int64],
    time_s: Vector,
    superframe_s: float,
    master: int,
    share: float,
    variance: float,
    white: float,
    walk: float,
    gain: Vector,
    told: Vector,
) -> None:
    """Run one anchor's filter into its steady state: its gain, and its offset's variance at every message."""
    p00, p01, p11 = variance, 0.0, 144.0
    last_s = 0.0
    for _ in range(_LONGEST):
        before = p00
        for k in range(len(sender)):
            dt = time_s[k] - last_s if time_s[k] >= last_s else time_s[k] - last_s + superframe_s
            last_s = time_s[k]
            p00 += dt * (2.0 * p01 + dt * p11) + dt * (white + walk * dt * dt / 3.0)
            p01 += dt * (p11 + walk * dt / 2.0)
            p11 += walk * dt
            told[k] = p00
            if sender[k] == master:
                spread = p00 + variance
                gain[0], gain[1] = p00 / spread, p01 / spread
                p11 -= share * gain[1] * p01
                p01 -= share * gain[1] * p00
                p00 -= share * gain[0] * p00
        if abs(p00 - before) <= _SETTLED * share * p00:
            break


@kernel
def _settle_together(
    sender: NDArray[np.int64],
    time_s: Vector,
    superframe_s: float,
    master: int,
    share: Vector,
    tx_var: float,
    rx_var: float,
    white: float,
    walk: float,
    gain: Matrix,
    together: Matrix,
) -> None:
    """Run the joint covariance of all anchors' clock errors into its steady state; noise is that of one clock."""
    n = len(share)
    z = np.zeros((2 * n, 2 * n))
    last_s = 0.0
    for _ in range(_LONGEST):
        before = np.trace(z)
        for k in range(len(sender)):
            dt = time_s[k] - last_s if time_s[k] >= last_s else time_s[k] - last_s + superframe_s
            last_s = time_s[k]
            _carry(z, share, dt, white, walk)
            for column in range(2 * n):
                together[k, column] = z[2 * sender[k], column]
            if sender[k] == master:
                _hear_master(z, share, tx_var, rx_var, gain)
        if abs(np.trace(z) - before) <= 1e-6 * np.trace(z):
            break


@kernel
def _carry(z: Matrix, share: Vector, dt: float, white: float, walk: float) -> None:
    """Let time pass: own noise on the diagonal blocks, the master's in all."""
    q00, q01, q11 = dt * (white + walk * dt * dt / 3.0), walk * dt * dt / 2.0, walk * dt
    for i in range(len(share)):
        for j in range(len(share)):
            if share[i] == 0.0 or share[j] == 0.0:
                continue
            a, b = 2 * i, 2 * j
            times = 2.0 if i == j else 1.0
            z[a, b] += dt * (z[a, b + 1] + z[a + 1, b] + dt * z[a + 1, b + 1]) + times * q00
            z[a, b + 1] += dt * z[a + 1, b + 1] + times * q01
            z[a + 1, b] += dt * z[a + 1, b + 1] + times * q01
            z[a + 1, b + 1] += times * q11


@kernel
def _hear_master(z: Matrix, share: Vector, tx_var: float, rx_var: float, gain: Matrix) -> None:
    """One master message, heard by each anchor with its share; its emission noise is common."""
    for i in range(len(share)):
        for j in range(len(share)):
            if share[i] == 0.0 or share[j] == 0.0:
                continue
            a, b = 2 * i, 2 * j
            both = share[i] if i == j else share[i] * share[j]
            noise = tx_var + rx_var if i == j else tx_var
            z00, z01, z10, z11 = z[a, b], z[a, b + 1], z[a + 1, b], z[a + 1, b + 1]
            gi0, gi1, gj0, gj1 = gain[i, 0], gain[i, 1], gain[j, 0], gain[j, 1]
            pi, pj = share[i], share[j]
            quad = both * (z00 + noise)
            z[a, b] = z00 - pi * gi0 * z00 - pj * gj0 * z00 + quad * gi0 * gj0
            z[a, b + 1] = z01 - pi * gi0 * z01 - pj * gj1 * z00 + quad * gi0 * gj1
            z[a + 1, b] = z10 - pi * gi1 * z00 - pj * gj0 * z10 + quad * gi1 * gj0
            z[a + 1, b + 1] = z11 - pi * gi1 * z01 - pj * gj1 * z10 + quad * gi1 * gj1
