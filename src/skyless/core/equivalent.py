"""What a filter has learned since an earlier estimate, as a measurement that another filter may take as new.

With the earlier position predicted to now, x₀ with P₀, and the one now, x₁ with P₁, what was measured in between is
R (P₁⁻¹ x₁ − P₀⁻¹ x₀) with R = (P₁⁻¹ − P₀⁻¹)⁻¹ (equivalent measurement; Drummond, Proc. SPIE 3163, 1997).
"""

from math import sqrt
from typing import Final

import numpy as np

from skyless.core.arrays import Array

CORRELATION: Final = sqrt(0.5)
"""Of the errors of position and velocity in the steady state of a filter for constant velocity, whose variances are
√2 q^¼ r^¾ and √2 q^¾ r^¼, and whose covariance is √(q r), with noise q of the acceleration and r of the position."""

LEAST_NEW: Final = 0.05
"""Smallest part of a variance whose loss counts as information: less may come from changed process noise."""


def predicted(states: Array, spreads: Array, elapsed_s: float) -> tuple[Array, Array]:
    """The position later, shape (n,), and its covariance, (n, n), less the process noise; SI units.

    ``states``: position and velocity, shape (2, n); ``spreads``: the covariance of each, (2, n, n). The one between
    them is the steady state's along each principal axis of the position.
    """
    variances, axes = np.linalg.eigh(spreads[0])
    both = CORRELATION * np.sqrt(np.maximum(variances * np.diag(axes.T @ spreads[1] @ axes), 0.0))
    grown = 2.0 * elapsed_s * np.asarray((axes * both) @ axes.T) + elapsed_s**2 * spreads[1]
    return states[0] + elapsed_s * states[1], spreads[0] + grown


def equivalent_measurement(x0_m: Array, P0_m2: Array, x1_m: Array, P1_m2: Array) -> tuple[Array, Array]:
    """The measurement, shape (n,), that turns one estimate into the other, and its covariance, (n, n).

    Where the variance has not shrunk by ``LEAST_NEW`` it is x₁ with a variance that makes it count for little. Raises
    LinAlgError if P₀ is not positive definite.
    """
    root = np.linalg.cholesky(P0_m2)
    kept, axes = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, P1_m2).T))
    is_new = kept < 1.0 - LEAST_NEW
    new = np.where(is_new, 1.0 - kept, LEAST_NEW)
    change, directions = axes.T @ np.linalg.solve(root, x1_m - x0_m), root @ axes
    spread_m2 = (directions * np.where(is_new, kept, 1.0) / new) @ directions.T
    return x0_m + directions @ np.where(is_new, change / new, change), spread_m2
