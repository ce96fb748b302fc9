"""What the paper's method leaves without any noise: e_{i,m}, the tag's scale, and the tag's motion.

Formulas are first order in what they describe; errors are measured minus true TDoA ρ_i − ρ_m, in metres.
"""

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from skyless.core.arrays import Array
from skyless.core.ticks import SPEED_OF_LIGHT_MPS
from skyless.research.uncertainty import Chain


def synchronisation_error_m(chain: Chain) -> Array:
    """−c·ν̄_m·e_{i,m} of ``eq:GPSTDoA``, shape (n,): the flight time δ is subtracted, the anchor's clock counted N·δ.

    e_{i,m} = (1 − ν_i)·δ/N; 0.2 mm at 10 m and 20 ppm.
    """
    return -SPEED_OF_LIGHT_MPS * chain.V * chain.e


def scale_error_m(chain: Chain) -> Array:
    """(ν − 1)(ρ_i − ρ_m), shape (n,): the tag's ticks are not seconds (erratum E11)."""
    return SPEED_OF_LIGHT_MPS * (chain.tag_rate - 1) * (chain.tag_tof_s - chain.tag_master_tof_s)


class Motion(Struct, frozen=True):
    """How the tag moves as one anchor sees it."""

    range_rate_mps: Array
    """ρ̇ = ûᵀv, û from the anchor to the tag, shape (n,)."""
    range_acceleration_mps2: Array
    """ρ̈ = |v across|²/ρ + ûᵀa, shape (n,)."""


def motion_seen(
    anchors_m: ArrayLike, position_m: ArrayLike, velocity_mps: ArrayLike, acceleration_mps2: ArrayLike = (0.0, 0.0, 0.0)
) -> Motion:
    """Rates of the ranges from ``anchors_m``, shape (n, 3), to a tag that moves; the rest has shape (3,)."""
    away = np.asarray(position_m, np.float64) - np.asarray(anchors_m, np.float64)
    velocity = np.asarray(velocity_mps, np.float64)
    ranges = np.sqrt((away**2).sum(axis=1))
    towards = away / ranges[:, None]
    rate = towards @ velocity
    across2 = velocity @ velocity - rate**2
    return Motion(rate, across2 / ranges + towards @ np.asarray(acceleration_mps2, np.float64))


def literal_motion_error_m(motion: Motion, delay_s: ArrayLike, spacing_s: ArrayLike) -> Array:
    """Of the first messages' TDoA, against the ranges when the master's first message was sent, shape (n,).

    The anchor's pair holds the anchor's own Doppler, which cancels ρ̇ whatever it is; what is left is the curvature,
    −½·ρ̈·Δ_im·(Δ_im + Δ_i), of a line through two later points carried back.
    """
    delay, spacing = np.asarray(delay_s, np.float64), np.asarray(spacing_s, np.float64)
    error: Array = -0.5 * motion.range_acceleration_mps2 * delay * (delay + spacing)
    return error


def bracketed_motion_error_m(motion: Motion, delay_s: ArrayLike, spacing_s: ArrayLike) -> Array:
    """Of ``bracketed``, and of the paper's delayed messages, against the ranges at the master's second message.

    The pair encloses the reference, so the chord lies above the curve: +½·ρ̈·Δ_im·(Δ_i − Δ_im), at most Δ_i²·ρ̈/8.
    """
    delay, spacing = np.asarray(delay_s, np.float64), np.asarray(spacing_s, np.float64)
    error: Array = 0.5 * motion.range_acceleration_mps2 * delay * (spacing - delay)
    return error


def smoothed_rate_motion_error_m(motion: Motion, delay_s: ArrayLike) -> Array:
    """Of a tag rate from a clock filter, which holds no Doppler, when motion is ignored: Δ_im·ρ̇, shape (n,).

    First order in the velocity, 30 to 100 times the above at walking speed. An estimator with the velocity as a
    state has none of it.
    """
    error: Array = motion.range_rate_mps * np.asarray(delay_s, np.float64)
    return error
