"""What a snapshot's TDoAs are made of at a site: each anchor's delay κ in the round, and the covariance that follows.

To the stamps' noise of ``uncertainty/tdoa.py`` comes what the crystals do between the stamps, which counts in long
superframes: a TDoA with its pair at κ and κ + 1 rounds holds (1 + κ)·x(κ) − κ·x(κ + 1) − x(0) of a clock's phase x, and
the anchor's own clock enters with the same weights. For the delayed messages and the bracketed form, which refer to
the second message, it is (1 − κ)·x(κ + 1) + κ·x(κ) − x(1).
"""

from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.air.schedule import first_slots, schedule_of
from skyless.clocks.filter import ClockNoise, clock_noise
from skyless.constants import TICK_S
from skyless.planning.anchor_clocks import stamp_variances
from skyless.positioning.snapshots import SnapshotMethod
from skyless.site.model import Site
from skyless.uncertainty.tdoa import bracketed_covariance, literal_covariance

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_KEPT: Final = 1e-3
"""Part of the largest eigenvalue below which a common error is left out."""


class Rounds(Struct, frozen=True):
    """Errors of the TDoAs of a site's anchors (the master's row is not used), in the order of its file."""

    usable: NDArray[np.bool_]
    """Whether the anchor sends after the master within a round, as the snapshot methods need; shape (n,)."""
    assumed_own: Vector
    """Variance of each TDoA that the method assumes, beyond the common part; m², shape (n,)."""
    assumed_common: float
    true_own: Vector
    """The same with the crystals' part."""
    common: Matrix
    """Errors that several TDoAs share: their covariance is common·commonᵀ; shape (n, k), metres."""


def rounds_of(site: Site, method: SnapshotMethod) -> Rounds:
    """What the snapshot methods meet at a site whose noise figures hold."""
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
    master = slots[[anchor.id for anchor in site.anchors].index(site.master)]
    return (slots - master) / spacing, spacing * schedule.slot_ticks * TICK_S


def phase_covariance(kappa: Vector, round_s: float, noise: ClockNoise, *, first: bool) -> Matrix:
    """Covariance, m², of what one clock's noise does to TDoAs with these κ; shape (n, n)."""
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
    kept = values > _KEPT * values[-1]
    factors: Matrix = np.ascontiguousarray(vectors[:, kept] * np.sqrt(values[kept]))
    return factors
