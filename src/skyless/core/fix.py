"""``Fix``: the result of every positioning method."""

from enum import StrEnum
from math import sqrt
from struct import Struct as Format
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from skyless.core.alert import Alert
from skyless.core.arrays import Array
from skyless.core.geometry import Dops, dilution_of_precision
from skyless.core.integrity import Integrity, IntegrityRequirement, integrity_of

# What fixes carry: rows of three numbers in one array, which costs less than separate arrays.

POSITION: Final = 0
"""The position, then three rows of its covariance."""

QUALITY: Final = 4
"""Row of chi-square and mean squared residual in m²."""

VELOCITY: Final = 5
"""The velocity, then three rows of its covariance; only of methods that estimate it."""

PROTECTION: Final = 9
"""The first three levels (``estimator/levels.py``); only of methods that compute them."""

ORIENTATION: Final = 10
"""Quaternion w, x, y, z that turns the frame of a motion sensor into the site's, then the heading's standard deviation
[rad], in two rows; zeros if unknown. Only of methods that use one. Last the number of hypotheses on carrier phases."""

PROTECTED_ROWS: Final = 12


class NoFixReason(StrEnum):
    """Why there is no position; the values appear in reports and counters."""

    NO_BEACONS = "no-beacons"
    NO_ALMANAC = "no-almanac"
    TOO_FEW_ANCHORS = "too-few-anchors"
    BAD_GEOMETRY = "bad-geometry"
    MIRROR = "mirror-ambiguity"
    NOT_CONVERGED = "not-converged"
    RESIDUALS = "residuals-too-large"
    ACQUIRING = "acquiring"
    NO_MASTER = "no-master"
    """The method needs a master, and the site has none (protocol 2)."""


class Fix(Struct, frozen=True, gc=False):
    """A position and its quality. SI units, site frame.

    Keeps the rows as the method wrote them; arrays are read-only views created on access.
    """

    time_s: float
    """Master time of validity since the receiver's first fix; without a master, on the tag's own clock."""
    rows: bytes
    """Rows of float64 (``POSITION`` and the following), as many as the method provides."""
    anchors: tuple[int, ...]
    """Identifiers of the anchors in use, the reference first."""
    anchors_m: Array
    """Their positions, shape (len(anchors), 3)."""
    method: str
    height_known: bool
    """True for 2-D positioning at a given height."""
    dof: int = 1
    """Degrees of freedom of ``chi2``; 1 for the running mean of a filter."""
    requirement: IntegrityRequirement | None = None
    """The requirement that the protection levels meet; None for methods without levels."""
    verified_until_s: float | None = None
    """All beacons in use up to this time, on the scale of ``time_s``, are verified; None if none is."""
    unverified: float = 1.0
    """Share of the last second's beacons that are not verified, or not yet."""

    @classmethod
    def of(
        cls,
        time_s: float,
        position_m: ArrayLike,
        covariance_m2: ArrayLike | None = None,
        *,
        anchors: tuple[int, ...] = (),
        method: str = "own",
    ) -> "Fix":
        """A fix of another estimator: shapes (3,) and (3, 3); without a covariance it states no accuracy.

        Raises:
            ValueError: the shapes are wrong, or the time or the position is not finite.
        """
        rows = np.full((VELOCITY, 3), np.nan)
        rows[POSITION] = position_m
        if not (np.isfinite(time_s) and np.isfinite(rows[POSITION]).all()):
            raise ValueError(f"time_s is {time_s} and position_m {rows[POSITION].tolist()}; both should be finite")
        if covariance_m2 is not None:
            rows[POSITION + 1 : QUALITY] = covariance_m2
        return cls(time_s, rows.tobytes(), anchors, np.empty((0, 3)), method, height_known=False)

    def __repr__(self) -> str:
        return (
            f"Fix(time_s={self.time_s}, position_m={self.position_m.tolist()}, std_m={self.std_m}, "
            f"anchors={self.anchors}, method={self.method!r}, hpl_m={self.hpl_m}, alert={self.alert})"
        )

    @property
    def position_m(self) -> Array:
        """Shape (3,)."""
        return _vector(self.rows, POSITION)

    @property
    def covariance_m2(self) -> Array:
        """Covariance of the position, shape (3, 3); zeros for a given coordinate (2-D, known height)."""
        return _matrix(self.rows, POSITION + 1)

    @property
    def velocity_mps(self) -> Array | None:
        """Shape (3,); None if the method does not estimate it."""
        return _vector(self.rows, VELOCITY) if len(self.rows) > VELOCITY * ROW_BYTES else None

    @property
    def velocity_covariance(self) -> Array | None:
        """Shape (3, 3) in (m/s)²."""
        return _matrix(self.rows, VELOCITY + 1) if len(self.rows) > VELOCITY * ROW_BYTES else None

    @property
    def orientation(self) -> tuple[float, float, float, float] | None:
        """Quaternion w, x, y, z that turns the motion sensor's frame into the site's; None if unknown."""
        if len(self.rows) <= (ORIENTATION + 1) * ROW_BYTES:
            return None
        w, x, y, z = *_row(self.rows, ORIENTATION), _row(self.rows, ORIENTATION + 1)[0]
        return (w, x, y, z) if any((w, x, y, z)) else None

    @property
    def heading_std_rad(self) -> float | None:
        """Standard deviation of the orientation's heading; None if unknown."""
        return None if self.orientation is None else _row(self.rows, ORIENTATION + 1)[1]

    @property
    def hypotheses(self) -> int:
        """Positions that are possible by carrier phases: 1 when locked, several while locking, 0 if none are in use."""
        return int(_row(self.rows, ORIENTATION + 1)[2]) if len(self.rows) > (ORIENTATION + 1) * ROW_BYTES else 0

    @property
    def chi2(self) -> float:
        """Sum of squared normalised residuals (snapshots) or its running mean per message (filters)."""
        return _row(self.rows, QUALITY)[0]

    @property
    def residual_rms_m(self) -> float:
        """Root of the mean squared residual (filters: running mean)."""
        return sqrt(_row(self.rows, QUALITY)[1])

    @property
    def integrity(self) -> Integrity | None:
        """Protection levels and whether they are reliable; None for methods without levels."""
        requirement = self.requirement
        if requirement is None:
            return None
        return integrity_of(_row(self.rows, PROTECTION), requirement.risk, self.height_known, requirement.alert_limit_m)

    @property
    def hpl_m(self) -> float | None:
        """Horizontal protection level: the error exceeds it with a probability of at most ``integrity_risk``."""
        integrity = self.integrity
        return None if integrity is None else integrity.hpl_m

    @property
    def vpl_m(self) -> float | None:
        """Vertical protection level; None if the height is given."""
        integrity = self.integrity
        return None if integrity is None else integrity.vpl_m

    @property
    def integrity_risk(self) -> float | None:
        """The risk of the levels; None for methods without levels."""
        return None if self.requirement is None else self.requirement.risk

    @property
    def alert(self) -> Alert | None:
        """Whether the levels are reliable; None for methods without levels."""
        integrity = self.integrity
        return None if integrity is None else integrity.alert

    @property
    def std_m(self) -> float:
        """One-sigma radial error: the root of the covariance's trace."""
        return float(np.sqrt(np.trace(self.covariance_m2)))

    @property
    def dops(self) -> Dops:
        """Dilutions of precision of the anchors in use, seen from the position."""
        return dilution_of_precision(self.anchors_m, self.position_m, height_known=self.height_known)


_ROW: Final = Format("3d")

ROW_BYTES: Final = _ROW.size


def _row(rows: bytes, row: int) -> tuple[float, ...]:
    return _ROW.unpack_from(rows, row * ROW_BYTES)


def _vector(rows: bytes, row: int) -> Array:
    return np.frombuffer(rows, count=3, offset=row * ROW_BYTES)


def _matrix(rows: bytes, row: int) -> Array:
    return np.frombuffer(rows, count=9, offset=row * ROW_BYTES).reshape(3, 3)
