"""Predicted errors of the snapshot methods at points: the TDoAs' covariance through the geometry, G·Σ·Gᵀ.

Where frames arrive only at times, fixes come from changing sets of anchors: the sets that the most uncertain anchors
make are gone through one by one, each with its probability; other anchors count by whether they mostly take part.

The crystals' noise between the stamps, which matters in long superframes, is added to the stamps' noise of
``uncertainty/tdoa.py``: a TDoA with its pair at κ and κ + 1 rounds holds (1 + κ)·x(κ) − κ·x(κ + 1) − x(0) of a clock's
phase x, and the anchor's own clock enters with the same weights. For the delayed messages and the bracketed form, which
refer to the second message, it is (1 − κ)·x(κ + 1) + κ·x(κ) − x(1).
"""

from collections.abc import Iterator
from itertools import product
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array, Mask, Matrix, Vector
from skyless.core.clock_filter import ClockNoise, clock_noise
from skyless.core.geometry import inverses
from skyless.core.protocol1.beacon import first_slots, schedule_of
from skyless.core.protocol1.snapshots import SnapshotMethod, bracketed_covariance, literal_covariance
from skyless.core.site import Site
from skyless.core.ticks import TICK_S
from skyless.site.planning.anchor_clocks import row_of_master, stamp_variances
from skyless.site.planning.links import FIX_SHARE, SIGMA, AnchorLinks, Scene, fill_dops, fill_errors

_MAX_UNCERTAIN: Final = 4  # anchors whose presence and absence are both gone through
_UNCERTAIN: Final = 0.01  # an anchor whose part is within this of 0 or 1 is sure not to take part, or to
_MIN_EIGENVALUE: Final = 1e-3  # part of the largest eigenvalue below which a common error is left out


class Rounds(Struct, frozen=True):
    """Errors of the TDoAs of a site's anchors (the master's row is not used), in the order of its file."""

    usable: Mask
    """Whether the anchor sends after the master within a round, as the snapshot methods need; shape (n,)."""
    assumed_own: Vector
    """Variance of each TDoA that the method assumes, beyond the common part; m², shape (n,)."""
    assumed_common: float
    true_own: Vector
    """``assumed_own`` plus the variance from the crystals' noise."""
    common: Matrix
    """Errors that several TDoAs share: their covariance is common·commonᵀ; shape (n, k), metres."""


def rounds_of(site: Site, method: SnapshotMethod) -> Rounds:
    """Errors of the snapshot methods' TDoAs at a site whose noise figures hold."""
    noise = site.noise
    tx_var, rx_var = stamp_variances(site)
    kappa, round_s = delays(site)
    first = method in {SnapshotMethod.LITERAL, SnapshotMethod.WEIGHTED}
    covariance_of = literal_covariance if first else bracketed_covariance
    covariance = covariance_of(kappa, tx_var, rx_var)
    own = covariance.diagonal() - rx_var
    clock = phase_covariance(
        np.maximum(kappa, 0.0), round_s, clock_noise(noise.white_fm, noise.random_walk_fm, clocks=1), first=first
    )
    return Rounds(
        usable=kappa > 0.0,
        assumed_own=own,
        assumed_common=rx_var,
        true_own=own + clock.diagonal(),
        common=_factors(clock + rx_var),
    )


def delays(site: Site) -> tuple[Vector, float]:
    """κ of each anchor, shape (n,), negative where it sends before the master; and the round's length in s."""
    schedule = schedule_of(site)
    first = first_slots(site)
    spacing = schedule.slots // schedule.frames_per_node
    slots = np.array([first[anchor.id] % spacing for anchor in site.anchors])
    master = slots[row_of_master(site)]
    return (slots - master) / spacing, spacing * schedule.slot_ticks * TICK_S


def phase_covariance(kappa: Vector, round_s: float, noise: ClockNoise, *, first: bool) -> Matrix:
    """Covariance, m², of what one clock's noise contributes to TDoAs with these κ; shape (n, n)."""
    reference = 0.0 if first else 1.0
    near, far = (1.0 + kappa, -kappa) if first else (kappa, 1.0 - kappa)
    times = np.array([kappa, kappa + 1.0, np.full_like(kappa, reference)]) * round_s
    weights = np.array([near, far, -np.ones_like(kappa)])
    total: Matrix = np.zeros((len(kappa), len(kappa)))
    for a in range(3):
        for b in range(3):
            total += np.outer(weights[a], weights[b]) * _phase(times[a][:, None], times[b][None, :], noise)
    return total


def _phase(s: Matrix, t: Matrix, noise: ClockNoise) -> Matrix:
    """Covariance of the phase of a clock at two times after an instant at which phase and rate are exact."""
    low, high = np.maximum(np.minimum(s, t), 0.0), np.maximum(s, t)
    covariance: Matrix = noise.white * low + noise.walk * low * low * (3.0 * high - low) / 6.0
    return covariance


def _factors(covariance: Matrix) -> Matrix:
    values, vectors = np.linalg.eigh(covariance)
    kept = values > _MIN_EIGENVALUE * values[-1]
    factors: Matrix = np.ascontiguousarray(vectors[:, kept] * np.sqrt(values[kept]))
    return factors


def gains(towards: Array, weights: Matrix, common: float) -> Array:
    """G of the least squares over TDoAs, shape (m, n, dim); infinite where singular.

    ``towards``: rows of H, shape (m, n, dim). The weight matrix is that of variances 1/weights, shape (m, n), and
    ``common`` in all (Sherman-Morrison).
    """
    weighted = weights[..., None] * towards
    mean = weighted.sum(axis=1)
    share = common / (1.0 + common * weights.sum(axis=1))[:, None, None]
    normal = towards.transpose(0, 2, 1) @ weighted - share * (mean[:, :, None] * mean[:, None])
    inverse, is_determined = inverses(normal)
    gain: Array = (weighted - share * (weights[..., None] * mean[:, None])) @ inverse
    gain[~is_determined] = np.inf
    return gain


def variances(gain: Array, own: Matrix, common: Array) -> Matrix:
    """The diagonal of G·(diag(own) + common·commonᵀ)·Gᵀ, shape (m, dim); shapes (m, n) and (m, n, k)."""
    together = gain.transpose(0, 2, 1) @ common
    found: Matrix = np.einsum("mna,mna,mn->ma", gain, gain, own) + (together * together).sum(axis=2)
    return found


def anchor_sets(part: Matrix) -> Iterator[tuple[Vector, Mask]]:
    """Sets of anchors from which points' fixes come: their probabilities, shape (m,), and masks, shape (m, n).

    ``part``: each anchor's part in the rounds, shape (m, n).
    """
    uncertain = (part > _UNCERTAIN) & (part < 1.0 - _UNCERTAIN)
    order = np.argsort(np.where(uncertain, np.abs(part - 0.5), np.inf), axis=1, kind="stable")[:, :_MAX_UNCERTAIN]
    order = order[:, np.take_along_axis(uncertain, order, axis=1).any(axis=0)]
    uncertain_here, there = np.take_along_axis(uncertain, order, axis=1), np.take_along_axis(part, order, axis=1)
    usual = part >= 0.5
    usual_here = np.take_along_axis(usual, order, axis=1)
    for present in product((False, True), repeat=order.shape[1]):
        chances = np.where(uncertain_here, np.where(present, there, 1.0 - there), np.logical_not(present))
        np.put_along_axis(usual, order, np.where(uncertain_here, present, usual_here), axis=1)
        yield chances.prod(axis=1), usual


def fill_snapshot_sigma(
    points: Matrix,
    dim: int,
    scene: Scene,
    master: int,
    links: AnchorLinks,
    rounds: Rounds,
    weighted: bool,
    farthest_m: float,
    table: Matrix,
) -> None:
    """Fill ``table`` (points, columns) for the points, shape (m, 3).

    Sets of anchors whose error would exceed ``farthest_m`` give no fix.
    """
    share, delay_m = scene.heard_at(points)
    fill_dops(scene, points, share, dim, table)
    part = share * share * np.where(rounds.usable & (scene.sends > 0.0), links.share**2, 0.0)
    part[:, master] = 0.0
    # of each point only the anchors that take part, in the order of how much
    some = np.argsort(-part, axis=1, kind="stable")[:, : int((part > _UNCERTAIN).sum(axis=1).max())]
    part = np.take_along_axis(part, some, axis=1)
    towards = (_directions(scene.anchors[some], points) - _directions(scene.anchors[master], points))[..., :dim]
    late_m = np.take_along_axis(delay_m, some, axis=1) - delay_m[:, master, None] + links.delay_m[some]
    assumed, true, common = rounds.assumed_own[some], rounds.true_own[some], rounds.common[some]
    assumed_common = np.full((*some.shape, 1), rounds.assumed_common**0.5)
    weights = 1.0 / assumed if weighted else np.ones(some.shape)
    fixes, claimed = np.zeros((2, len(points)))
    total, bias = np.zeros((2, len(points), 3))
    for probability, chosen in anchor_sets(part):
        rows = np.flatnonzero((probability > 0.0) & (chosen.sum(axis=1) >= dim))
        gain = gains(towards[rows], chosen[rows] * weights[rows], rounds.assumed_common if weighted else 0.0)
        with np.errstate(invalid="ignore"):
            predicted = variances(gain, assumed[rows], assumed_common[rows]).sum(axis=1)
        good = predicted < farthest_m**2
        rows, gain = rows[good], gain[good]
        chance = probability[rows]
        shift = np.einsum("mna,mn->ma", gain, late_m[rows])
        fixes[rows] += chance
        claimed[rows] += chance * predicted[good]
        bias[rows, :dim] += chance[:, None] * shift
        total[rows, :dim] += chance[:, None] * (variances(gain, true[rows], common[rows]) + shift * shift)
    table[:, SIGMA:] = np.inf
    table[:, FIX_SHARE] = fixes * share[:, master] ** 2
    known = np.flatnonzero(table[:, FIX_SHARE] >= _UNCERTAIN)
    shift = bias[known] / fixes[known, None]
    variance = np.maximum(total[known] / fixes[known, None] - shift * shift, 0.0)
    fill_errors(table, known, variance, (shift * shift).sum(axis=1), claimed[known] / fixes[known])


def _directions(anchors: Array, points: Matrix) -> Array:
    """Unit vectors from anchors, shape (m, n, 3) or (3,), to points, shape (m, 3)."""
    away = points[:, None] - anchors
    unit: Array = away / np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-6)
    return unit
