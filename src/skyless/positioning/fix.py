"""What every positioning method returns."""

from enum import StrEnum

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.positioning.tracker import CHI2, RESIDUAL_SQUARED, RESTLESS_CHI2
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
    """Master time at which the position holds, since the receiver's first fix."""
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


def motion_fix(
    time_s: float,
    x: NDArray[np.float64],
    P: NDArray[np.float64],
    height_m: float | None,
    anchors: tuple[int, ...],
    anchors_m: NDArray[np.float64],
    statistics: NDArray[np.float64],
    method: str,
) -> Fix:
    """Make the fix of a filter whose state begins with position and velocity (2 axes each at a known height).

    ``statistics`` holds the running means of the normalised and of the plain squared innovation. While the former shows
    a tag more agile than the filter assumes, the covariances are scaled by its square: most of an innovation is the
    stamps' noise, so the state errs by more than the innovations tell (``docs/maths.md`` section 6).
    """
    chi2 = float(statistics[CHI2])
    scale = chi2**2 if chi2 > RESTLESS_CHI2 else 1.0
    dim = 3 if height_m is None else 2
    position, velocity = np.zeros(3), np.zeros(3)
    covariance, velocity_covariance = np.zeros((3, 3)), np.zeros((3, 3))
    position[:dim] = x[:dim]
    velocity[:dim] = x[dim : 2 * dim]
    covariance[:dim, :dim] = scale * P[:dim, :dim]
    velocity_covariance[:dim, :dim] = scale * P[dim : 2 * dim, dim : 2 * dim]
    if height_m is not None:
        position[2] = height_m
    return Fix(
        time_s=time_s,
        position_m=position,
        covariance_m2=covariance,
        velocity_mps=velocity,
        velocity_covariance=velocity_covariance,
        anchors=anchors,
        anchors_m=anchors_m,
        chi2=chi2,
        dof=1,
        residual_rms_m=float(np.sqrt(statistics[RESIDUAL_SQUARED])),
        method=method,
        height_known=height_m is not None,
    )
