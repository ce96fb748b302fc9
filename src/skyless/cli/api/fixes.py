"""Fixes of several tags as arrays, one row a fix."""

from array import array
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec import Struct

from skyless.cli.api._result import axes_columns, data_frame
from skyless.core.arguments import wrong
from skyless.core.arrays import Array, Integers, Mask, Matrix, Vector
from skyless.core.fix import Fix
from skyless.sim.evaluation.figures import axes_std_m

if TYPE_CHECKING:
    from pandas import DataFrame

_UNKNOWN: Final = (np.nan, np.nan, np.nan)
_COLUMNS: Final = 26


class Fixes(Struct, frozen=True, eq=False):
    """n fixes in the order in which they were made; NaN where a figure is not known."""

    tags: tuple[str, ...]
    """Names of the tags."""
    tag: Integers
    """Shape (n,): which of ``tags`` made the fix."""
    time_s: Vector
    """Shape (n,): true time of a simulation, the recording's own time, Unix time of a recording of ``skyless record``;
    seconds."""
    position_m: Matrix
    """Shape (n, 3): x, y, z."""
    covariance_m2: Array
    """Shape (n, 3, 3), of the position; zeros for a height that was given."""
    velocity_mps: Matrix
    """Shape (n, 3)."""
    anchor_count: Integers
    """Shape (n,): how many anchors the fix uses."""
    chi2: Vector
    """Shape (n,): sum of squared normalised residuals, of filters its running mean for a message."""
    residual_rms_m: Vector
    """Shape (n,)."""
    hpl_m: Vector
    """Shape (n,): horizontal protection level."""
    vpl_m: Vector
    """Shape (n,): vertical protection level."""
    alert: tuple[str, ...]
    """n words: whether the levels can be relied on (``skyless.core.integrity.Alert``); empty without levels."""
    truth_m: Matrix
    """Shape (n, 3): where the tag truly was."""
    judged: Mask
    """Shape (n,): whether the fix counts in the summary's errors."""

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def std_m(self) -> Vector:
        """Shape (n,): one-sigma radial error that each fix predicts, the root of its covariance's trace."""
        std_m: Vector = np.sqrt(np.trace(self.covariance_m2, axis1=1, axis2=2))
        return std_m

    @property
    def error_m(self) -> Matrix:
        """Shape (n, 3): position less truth."""
        error_m: Matrix = self.position_m - self.truth_m
        return error_m

    def of_tag(self, name: str | None) -> Mask:
        """Which fixes are of a tag, shape (n,); of the first one where None is named. Raises SkylessError."""
        if name is not None and name not in self.tags:
            raise wrong("tag", name, f"one of {', '.join(self.tags)}")
        mask: Mask = self.tag == (0 if name is None else self.tags.index(name))
        return mask

    def track(self, name: str | None) -> Matrix:
        """Rows of time, position, true position and σ of x, y and z of one tag, shape (k, 10)."""
        mask = self.of_tag(name)
        std_m = axes_std_m(self.covariance_m2[mask])
        return np.column_stack([self.time_s[mask], self.position_m[mask], self.truth_m[mask], std_m])

    def to_dataframe(self) -> "DataFrame":
        """One row a fix: ``t_s``, ``tag`` (its name), ``x_m`` … ``cov_zz_m2`` … as ``--fixes-csv`` calls them.

        Raises:
            SkylessError: pandas is not installed.
        """
        covariance = {
            f"cov_{'xyz'[i]}{'xyz'[j]}_m2": self.covariance_m2[:, i, j] for i in range(3) for j in range(i, 3)
        }
        return data_frame(
            {
                "t_s": self.time_s,
                "tag": np.array(self.tags, dtype=object)[self.tag],
                **axes_columns("", self.position_m, "_m"),
                **axes_columns("v", self.velocity_mps, "_mps"),
                **covariance,
                "std_m": self.std_m,
                "anchors": self.anchor_count,
                "chi2": self.chi2,
                "residual_rms_m": self.residual_rms_m,
                "hpl_m": self.hpl_m,
                "vpl_m": self.vpl_m,
                "alert": list(self.alert),
                **axes_columns("truth_", self.truth_m, "_m"),
                "judged": self.judged,
            }
        )


class FixRecorder:
    """Gathers fixes as they are made, 220 bytes each."""

    def __init__(self, tags: tuple[str, ...]) -> None:
        self._tags = tags
        self._numbers = array("d")
        self._alerts: list[str] = []

    def add(
        self, tag: int, time_s: float, fix: Fix, truth_m: Array | tuple[float, ...] | None, *, judged: bool
    ) -> None:
        """Add a fix of the tag with that number."""
        velocity_mps, levels = fix.velocity_mps, fix.integrity
        self._numbers.extend((tag, time_s))
        self._numbers.extend(fix.position_m)
        self._numbers.extend(fix.covariance_m2.ravel())
        self._numbers.extend(_UNKNOWN if velocity_mps is None else velocity_mps)
        self._numbers.extend((len(fix.anchors), fix.chi2, fix.residual_rms_m))
        hpl_m, vpl_m = (None, None) if levels is None else (levels.hpl_m, levels.vpl_m)
        self._numbers.extend(np.nan if level_m is None else level_m for level_m in (hpl_m, vpl_m))
        self._numbers.extend(_UNKNOWN if truth_m is None else truth_m)
        self._numbers.append(judged)
        self._alerts.append("" if levels is None else str(levels.alert))

    def fixes(self) -> Fixes:
        """All so far."""
        rows = np.array(self._numbers).reshape(-1, _COLUMNS)
        rows.setflags(write=False)
        return Fixes(
            tags=self._tags,
            tag=rows[:, 0].astype(np.int64),
            time_s=rows[:, 1],
            position_m=rows[:, 2:5],
            covariance_m2=rows[:, 5:14].reshape(-1, 3, 3),
            velocity_mps=rows[:, 14:17],
            anchor_count=rows[:, 17].astype(np.int64),
            chi2=rows[:, 18],
            residual_rms_m=rows[:, 19],
            hpl_m=rows[:, 20],
            vpl_m=rows[:, 21],
            alert=tuple(self._alerts),
            truth_m=rows[:, 22:25],
            judged=rows[:, 25] > 0.0,
        )
