"""Covariance of the vector of TDoAs, all against the master, in m² (``docs/maths.md`` sections 2 and 5).

κ_i = Δ_im / Δ_i is the anchor's delay after the reference message over the spacing of its pair. Rates against each
other differ from one by less than 40 ppm and are left out of the variances.
"""

import numpy as np
from numpy.typing import NDArray

from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_S

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


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
