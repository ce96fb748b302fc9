"""Covariance of the vector of TDoAs, all against the master, in m² (``docs/maths.md`` sections 2 and 5).

``chain_covariance`` is the paper's chain in full. The other three are what the positioning methods use, all with a
synchronisation packet as the reference: κ_i = Δ_im / Δ_i is the anchor's delay after the reference message over the
spacing of its pair, and rates, which differ from one by less than 40 ppm, are left out of the variances.
"""

from enum import StrEnum

import numpy as np

from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_S
from skyless.kernels.arrays import Matrix, Vector
from skyless.uncertainty.chain import Chain


class Reference(StrEnum):
    """Which packet of the master the TDoAs refer to (t_m), as far as it matters."""

    APART = "apart"
    """None of the synchronisation packets: the paper's assumption."""
    FIRST_SYNC = "first-sync"
    SECOND_SYNC = "second-sync"


def chain_covariance(chain: Chain, reference: Reference) -> Matrix:
    """Of the paper's TDoAs (``eq:GPSTDoA``) of n anchors, shape (n, n), first order in the noise.

    The tag's stamp of the reference packet is common to all, and so are the master's stamps: with weights w1 and w2
    those of the synchronisation, and with one that of the reference packet. If that is one of the two, its weights
    cancel and the master's noise is gone, with the rate error β. ``chain.reference_s`` must be the time of that packet.

    Raises:
        ValueError: it is not.
    """
    expected_s = {Reference.FIRST_SYNC: chain.sync_s, Reference.SECOND_SYNC: chain.sync_s + chain.sync_spacing_s}
    if reference in expected_s and chain.reference_s != expected_s[reference]:
        raise ValueError(f"reference_s is {chain.reference_s}, the {reference} packet is at {expected_s[reference]}")
    w1, w2 = 0.5 - chain.u / chain.L, 0.5 + chain.u / chain.L
    masters = 1.0 + w1**2 + w2**2 if reference is Reference.APART else 0.0
    common = chain.sigma_tag_s**2 + chain.V**2 * chain.sigma_master_s**2 * masters
    anchors = (chain.V / chain.N) ** 2 * chain.sigma_anchor_s**2 * (chain.Q + w1**2 + w2**2)
    covariance: Matrix = np.diag(chain.Q * chain.sigma_tag_s**2 + anchors) + common
    return SPEED_OF_LIGHT_MPS**2 * covariance


def stamp_variance_m2(stamp_s: float, *, rounded: bool) -> float:
    """Variance of a stamp in m²; rounding to whole ticks adds a twelfth of a tick squared."""
    rounding = TICK_S**2 / 12.0 if rounded else 0.0
    return SPEED_OF_LIGHT_MPS**2 * (stamp_s**2 + rounding)


def literal_covariance(kappa: Vector, tx_var_m2: float, rx_var_m2: float) -> Matrix:
    """Of ``eq:GPSTDoA`` for the first messages, whose reference is one of the two sync messages; shape (n, n).

    There the master's noise and the rate error β cancel exactly: Q_i + 1 stamps of the tag and of the anchor remain,
    Q = (1 + κ)² + κ².
    """
    return _shared_reference((1.0 + kappa) ** 2 + kappa**2, tx_var_m2, rx_var_m2)


def literal_delayed_covariance(kappa: Vector, tx_var_m2: float, rx_var_m2: float) -> Matrix:
    """Of ``eq:GPSTDoA`` for the delayed messages: the anchor's pair encloses the reference, Q = (1 - κ)² + κ²."""
    return _shared_reference((1.0 - kappa) ** 2 + kappa**2, tx_var_m2, rx_var_m2)


def bracketed_covariance(kappa: Vector, tx_var_m2: float, rx_var_m2: float) -> Matrix:
    """Of the bracketed TDoAs; the same stamps with the same weights as the delayed messages, so the same variance."""
    return literal_delayed_covariance(kappa, tx_var_m2, rx_var_m2)


def _shared_reference(q: Vector, tx_var_m2: float, rx_var_m2: float) -> Matrix:
    """Each TDoA holds its pair (factor Q) and one RX stamp of the anchor; the tag's reference stamp is common."""
    own = q * (tx_var_m2 + rx_var_m2) + rx_var_m2
    covariance: Matrix = np.full((len(q), len(q)), rx_var_m2) + np.diag(own)
    return covariance
