"""What every positioning method returns."""

from enum import StrEnum
from math import sqrt

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.compiled import borrowing_kernel
from skyless.positioning.protection import Alert, Integrity
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
    hpl_m: float | None = None
    """Horizontal protection level: the error is larger with a probability of at most ``integrity_risk``."""
    vpl_m: float | None = None
    """Vertical protection level; None where the height is given."""
    integrity_risk: float | None = None
    """None for methods that know no protection levels."""
    alert: Alert | None = None
    """Whether the levels can be relied on; None for methods without any."""

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
    integrity: Integrity | None = None,
) -> Fix:
    """Make the fix of a filter whose state begins with position and velocity (2 axes each at a known height).

    ``statistics`` holds the running means of the normalised and of the plain squared innovation. While the former shows
    a tag more agile than the filter assumes, the covariances are scaled by its square: most of an innovation is the
    stamps' noise, so the state errs by more than the innovations tell (``docs/maths.md`` section 6).
    """
    chi2: float = statistics.item(CHI2)
    scale = chi2**2 if chi2 > RESTLESS_CHI2 else 1.0
    rows = np.zeros((8, 3))
    if height_m is None:
        _fill(rows, x, P, 3, scale)
    else:
        _fill(rows, x, P, 2, scale)
        rows[0, 2] = height_m
    return Fix(
        time_s=time_s,
        position_m=rows[0],
        covariance_m2=rows[2:5],
        velocity_mps=rows[1],
        velocity_covariance=rows[5:],
        anchors=anchors,
        anchors_m=anchors_m,
        chi2=chi2,
        dof=1,
        residual_rms_m=sqrt(statistics.item(RESIDUAL_SQUARED)),
        method=method,
        height_known=height_m is not None,
        hpl_m=None if integrity is None else integrity.hpl_m,
        vpl_m=None if integrity is None else integrity.vpl_m,
        integrity_risk=None if integrity is None else integrity.risk,
        alert=None if integrity is None else integrity.alert,
    )


@borrowing_kernel
def _fill(rows: NDArray[np.float64], x: NDArray[np.float64], P: NDArray[np.float64], dim: int, scale: float) -> None:
    """Write position, velocity and the covariance of either, shape (8, 3): one array costs less than four."""
    for one in range(dim):
        rows[0, one] = x[one]
        rows[1, one] = x[dim + one]
        for other in range(dim):
            rows[2 + one, other] = scale * P[one, other]
            rows[5 + one, other] = scale * P[dim + one, dim + other]
