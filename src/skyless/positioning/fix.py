"""What every positioning method returns."""

from enum import StrEnum
from math import sqrt
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.positioning.alert import Alert
from skyless.positioning.motion_rows import MOTION_ROWS, fill_motion
from skyless.positioning.protection import Integrity
from skyless.positioning.tracker import CHI2, RESIDUAL_SQUARED
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


_OF_POSITION: Final = slice(2, 5)
_OF_VELOCITY: Final = slice(5, MOTION_ROWS)


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
    """Make the fix of a filter whose state begins with position and velocity (``fill_motion``).

    ``statistics`` holds the running means of the normalised and of the plain squared innovation.
    """
    rows, known = np.zeros((MOTION_ROWS, 3)), height_m is not None
    chi2 = statistics.item(CHI2)
    fill_motion(rows, x, P, 2 if known else 3, chi2, height_m or 0.0)
    return fix_of(time_s, rows, known, anchors, anchors_m, chi2, statistics.item(RESIDUAL_SQUARED), method)


def fix_of(
    time_s: float,
    rows: NDArray[np.float64],
    height_known: bool,
    anchors: tuple[int, ...],
    anchors_m: NDArray[np.float64],
    chi2: float,
    squared_m2: float,
    method: str,
    integrity: Integrity | None = None,
) -> Fix:
    """Make the fix of what ``fill_motion`` has written; the fix keeps ``rows``.

    ``chi2`` and ``squared_m2`` are the running means of the normalised and of the plain squared innovation.
    """
    position_m, velocity_mps = rows[0], rows[1]
    covariance_m2, velocity_covariance = rows[_OF_POSITION], rows[_OF_VELOCITY]
    # in the order of the fields: with their names it takes as long as all the rest
    if integrity is None:
        return Fix(
            time_s, position_m, covariance_m2, velocity_mps, velocity_covariance,
            anchors, anchors_m, chi2, 1, sqrt(squared_m2), method, height_known,
        )  # fmt: skip
    return Fix(
        time_s, position_m, covariance_m2, velocity_mps, velocity_covariance,
        anchors, anchors_m, chi2, 1, sqrt(squared_m2), method, height_known,
        integrity.hpl_m, integrity.vpl_m, integrity.risk, integrity.alert,
    )  # fmt: skip
