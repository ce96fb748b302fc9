"""Results as arrays: fixes of several tags, measurements, and maps."""

from array import array
from collections.abc import Iterator, Mapping
from html import escape
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec import Struct

from skyless.arguments import check_choice
from skyless.core.air.masterless_packets import Packet, PairTdoa
from skyless.core.arrays import Array, Integers, Mask, Matrix, Vector
from skyless.core.fix import Fix
from skyless.machine import extra_module
from skyless.sim.evaluation.figures import axes_std_m

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

# Common to all results: a short table in a notebook, one line elsewhere, a table for pandas.


class Result(Struct, frozen=True, eq=False):
    """A result; compared by identity, as its arrays have no single truth value."""

    def title(self) -> str:
        """Title of the result."""
        raise NotImplementedError

    def facts(self) -> Iterator[tuple[str, str]]:
        """The main figures: name, and value with its unit."""
        raise NotImplementedError

    def __repr__(self) -> str:
        facts = "; ".join(f"{name} {value}" for name, value in self.facts())
        return f"{type(self).__name__}({self.title()}: {facts})"

    def _repr_html_(self) -> str:
        """The figures as a table, for notebooks."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{escape(name)}</th><td style='text-align:right'>{escape(value)}</td></tr>"
            for name, value in self.facts()
        )
        return f"<table><caption>{escape(self.title())}</caption><tbody>{rows}</tbody></table>"


def data_frame(columns: Mapping[str, Any]) -> "DataFrame":
    """Columns as a pandas table. Raises SkylessError if pandas is not installed."""
    frame: DataFrame = extra_module("pandas", "to_dataframe").DataFrame(dict(columns))
    return frame


def axes_columns(prefix: str, values: Array, suffix: str = "") -> dict[str, Array]:
    """An array of shape (n, 3) as columns x, y, z."""
    return {f"{prefix}{axis}{suffix}": values[:, number] for number, axis in enumerate("xyz")}


def figures(values: Any) -> Array:  # noqa: ANN401 - whatever has numbers and None
    """Numbers as an array of floats, with NaN for None."""
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


_UNKNOWN: Final = (np.nan, np.nan, np.nan)


class Fixes(Struct, frozen=True, eq=False):
    """n fixes in the order in which they were made; NaN where a figure is unknown."""

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
    """Shape (n,): number of anchors that the fix uses."""
    chi2: Vector
    """Shape (n,): sum of squared normalised residuals; for filters its running mean per message."""
    residual_rms_m: Vector
    """Shape (n,)."""
    hpl_m: Vector
    """Shape (n,): horizontal protection level."""
    vpl_m: Vector
    """Shape (n,): vertical protection level."""
    alert: tuple[str, ...]
    """n words: whether the levels can be relied on (``skyless.core.alert.Alert``); empty without levels."""
    truth_m: Matrix
    """Shape (n, 3): true position of the tag."""
    judged: Mask
    """Shape (n,): whether the fix counts in the summary's errors."""

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def std_m(self) -> Vector:
        """Shape (n,): predicted one-sigma radial error, the square root of the covariance's trace."""
        std_m: Vector = np.sqrt(np.trace(self.covariance_m2, axis1=1, axis2=2))
        return std_m

    @property
    def error_m(self) -> Matrix:
        """Shape (n, 3): position less truth."""
        error_m: Matrix = self.position_m - self.truth_m
        return error_m

    def of_tag(self, name: str | None) -> Mask:
        """Mask of a tag's fixes, shape (n,); by default of the first tag. Raises SkylessError."""
        mask: Mask = self.tag == (0 if name is None else self.tags.index(check_choice("tag", name, self.tags)))
        return mask

    def track(self, name: str | None) -> Matrix:
        """Rows of time, position, true position and σ of x, y and z of one tag, shape (k, 10)."""
        mask = self.of_tag(name)
        std_m = axes_std_m(self.covariance_m2[mask])
        return np.column_stack([self.time_s[mask], self.position_m[mask], self.truth_m[mask], std_m])

    def to_dataframe(self) -> "DataFrame":
        """One row per fix: ``t_s``, ``tag`` (its name), ``x_m`` … ``cov_zz_m2`` … as in ``--fixes-csv``.

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
    """Gathers fixes, 220 bytes each."""

    def __init__(self, tags: tuple[str, ...]) -> None:
        self._tags = tags
        self._numbers = array("d")
        self._alerts: list[str] = []

    def add(
        self, tag: int, time_s: float, fix: Fix, truth_m: Array | tuple[float, ...] | None, *, judged: bool
    ) -> None:
        """Add a fix; ``tag``: index of the tag."""
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
        """All fixes so far."""
        rows = np.array(self._numbers).reshape(-1, 26)  # as many as ``add`` keeps of each fix
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


class FixesResult(Result, frozen=True, eq=False, kw_only=True):
    """A result with fixes of one or more tags."""

    fixes: Fixes = FixRecorder(()).fixes()
    """All fixes, with the truth, which is NaN where unknown; ``judged`` marks those that count in the figures."""

    @property
    def tags(self) -> tuple[str, ...]:
        """Names of the tags."""
        return self.fixes.tags

    def track(self, tag: str) -> Matrix:
        """Rows of time, position, true position and σ of x, y and z of a tag, shape (k, 10)."""
        return self.fixes.track(tag)

    def to_dataframe(self) -> "DataFrame":
        """See ``Fixes.to_dataframe``."""
        return self.fixes.to_dataframe()

    def plot(self, tag: str | None = None) -> "Figure":
        """Draw track, height, errors and stated σ over time, and error distributions of a tag, by default the first.

        Raises:
            SkylessError: there is no such tag.
        """
        from skyless.research.replays.plot import track_figure

        name: str = check_choice("tag", self.tags[0] if tag is None else tag, self.tags)
        rows = self.track(name)
        return track_figure(rows, self._heading(name, len(rows)))

    def _heading(self, tag: str, count: int) -> str:
        """Title of the picture of a tag's fixes."""
        raise NotImplementedError


# An estimator's input from a recording as arrays, one row per reception or time difference.

_NONE: Final = -1


class Measurements(Struct, frozen=True, eq=False):
    """n measurements in the order in which the estimator got them: receptions of anchors, or time differences.

    Missing values are -1, or NaN in ``tdoa_m``. Addresses from 2⁶³ on are negative: ``anchor_b.view(np.uint64)`` has
    them all. Relays in packets are not included; ``skyless.open_recording`` gives whole packets.
    """

    tags: tuple[str, ...]
    """Names of the tags."""
    tag: Integers
    """Shape (n,): which of ``tags`` measured it."""
    time_s: Vector
    """Shape (n,): time of the measurement, on the scale of the fixes' times."""
    anchor_a: Integers
    """Shape (n,): first anchor of a time difference."""
    anchor_b: Integers
    """Shape (n,): second anchor of a time difference, or the sender of a packet."""
    tdoa_m: Vector
    """Shape (n,): range to b less range to a."""
    sequence: Integers
    """Shape (n,): sequence number of the packet."""
    tx_ticks: Integers
    """Shape (n,): time of sending, on the sender's clock."""
    rx_ticks: Integers
    """Shape (n,): time of reception, on the tag's own clock."""
    used: Mask
    """Shape (n,): whether the filter used the measurement; for an own estimator, for methods that wait for whole
    superframes, and with ``smooth``, whether it made a fix."""

    def __len__(self) -> int:
        return len(self.time_s)

    def to_dataframe(self) -> "DataFrame":
        """One row per measurement: ``t_s``, ``tag`` (its name), and the other arrays by their names.

        Raises:
            SkylessError: pandas is not installed.
        """
        others = "anchor_a", "anchor_b", "tdoa_m", "sequence", "tx_ticks", "rx_ticks", "used"
        return data_frame(
            {
                "t_s": self.time_s,
                "tag": np.array(self.tags, dtype=object)[self.tag],
                **{name: getattr(self, name) for name in others},
            }
        )


class MeasurementRecorder:
    """Gathers measurements, 72 bytes each."""

    def __init__(self, tags: tuple[str, ...]) -> None:
        self._tags = tags
        self._whole = array("q")
        self._numbers = array("d")

    def add(self, tag: str, time_s: float, measured: Packet | PairTdoa, used: bool) -> None:
        """Add a measurement that a tag's estimator was given."""
        number = self._tags.index(tag)
        if isinstance(measured, PairTdoa):
            self._whole.extend((number, measured.anchor_a, measured.anchor_b, _NONE, _NONE, _NONE, used))
            self._numbers.extend((time_s, measured.tdoa_m))
        else:
            stamps = measured.sequence, measured.tx_ticks, measured.rx_ticks
            self._whole.extend((number, _NONE, measured.anchor - (measured.anchor >> 63 << 64), *stamps, used))
            self._numbers.extend((time_s, np.nan))

    def measurements(self) -> Measurements:
        """All measurements so far."""
        whole = np.array(self._whole, dtype=np.int64).reshape(-1, 7)  # as many as ``add`` keeps of each
        numbers = np.array(self._numbers).reshape(-1, 2)
        for rows in (whole, numbers):
            rows.setflags(write=False)
        tag, anchor_a, anchor_b, sequence, tx_ticks, rx_ticks, used = whole.T
        return Measurements(
            tags=self._tags,
            tag=tag,
            time_s=numbers[:, 0],
            anchor_a=anchor_a,
            anchor_b=anchor_b,
            tdoa_m=numbers[:, 1],
            sequence=sequence,
            tx_ticks=tx_ticks,
            rx_ticks=rx_ticks,
            used=used > 0,
        )
