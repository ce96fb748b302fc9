"""What every positioning method returns."""

from enum import StrEnum

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.uncertainty.dop import Dops, dilution_of_precision


class NoFixReason(StrEnum):
    """Why there is no position; the values are what reports and counters show."""

    NO_BEACONS = "no-beacons"
    NO_ALMANAC = "no-almanac"
    TOO_FEW_ANCHORS = "too-few-anchors"
    BAD_GEOMETRY = "bad-geometry"
    MIRROR = "mirror-ambiguity"
    NOT_CONVERGED = "not-converged"
    RESIDUALS = "residuals-too-large"
    ACQUIRING = "acquiring"


class Fix(Struct, frozen=True, gc=False):
    """One position with all that is known of its quality. SI units, site frame."""

    time_s: float
    """Master time since the receiver's first beacon."""
    position_m: NDArray[np.float64]
    """Shape (3,)."""
    covariance_m2: NDArray[np.float64]
    """Of the position, shape (3, 3); a coordinate that was given (2-D, known height) has zeros."""
    velocity_mps: NDArray[np.float64] | None
    """Shape (3,), None where the method knows none."""
    velocity_covariance: NDArray[np.float64] | None
    """Shape (3, 3) in (m/s)²."""
    anchors: tuple[int, ...]
    """Identifiers of the anchors in use, the reference first."""
    anchors_m: NDArray[np.float64]
    """Their positions, shape (len(anchors), 3)."""
    chi2: float
    """Sum of squared normalised residuals (snapshots) or its running mean per message (filters)."""
    dof: int
    """Degrees of freedom of ``chi2``; 1 for the running mean of a filter."""
    residual_rms_m: float
    method: str
    height_known: bool
    """True for 2-D positioning at a given height."""

    @property
    def std_m(self) -> float:
        """One-sigma radial error: the root of the covariance's trace."""
        return float(np.sqrt(np.trace(self.covariance_m2)))

    @property
    def dops(self) -> Dops:
        """Dilutions of precision of the anchors in use, seen from the position."""
        return dilution_of_precision(self.anchors_m, self.position_m, height_known=self.height_known)
