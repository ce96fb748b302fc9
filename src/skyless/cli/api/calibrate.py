"""``skyless.calibrate``: the errors of antenna delays from a tag at known positions."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from matplotlib.figure import Figure

from skyless.arguments import python_function
from skyless.cli.api.fixes import Result, data_frame, figures
from skyless.cli.api.survey import SurveyResult, gathered, solved
from skyless.cli.common import cm
from skyless.core.arrays import Integers, Vector
from skyless.research.calibration.biases import Biases, biases_of, known_tags
from skyless.research.calibration.options import CalibrateOptions, calibration_facts
from skyless.research.replays.inputs import known_truth
from skyless.research.replays.site import recorded_site
from skyless.run.recordings.recording import McapRecording, is_mcap
from skyless.site.report import BLUE, panel, report_style
from skyless.site.survey.facts import Count
from skyless.site.tables import calibrated_table, new_table

if TYPE_CHECKING:
    from pandas import DataFrame


class BiasResult(Result, frozen=True, eq=False):
    """Constants of n anchors of another system, ordered by identifier; NaN where not determined."""

    path: Path
    found: Biases
    """All estimates."""
    table: Path | None
    """The table of anchors to correct; None for a new one."""

    @property
    def anchors(self) -> Integers:
        """Shape (n,): identifiers."""
        return np.array([one.anchor for one in self.found.estimate.anchors], dtype=np.int64)

    @property
    def bias_m(self) -> Vector:
        """Shape (n,): apparent lateness of each anchor's signals, relative to the mean."""
        return figures(one.bias_m for one in self.found.estimate.anchors)

    @property
    def std_m(self) -> Vector:
        """Shape (n,): standard error of ``bias_m``."""
        return figures(one.std_m for one in self.found.estimate.anchors)

    @property
    def summary(self) -> dict[str, Any]:
        """The object that ``skyless calibrate --json`` writes, in SI units, without version and written file."""
        found = self.found
        estimated = msgspec.to_builtins(found.estimate)
        return {"format": found.format, **estimated, "drops": found.drops, "notes": found.notes}

    def corrected_file(self) -> str:
        """The table of anchors with the biases in it, as ``skyless calibrate --out`` writes it. Raises SkylessError."""
        known = self.found.estimate.calibration()
        if self.table is not None:
            return calibrated_table(self.table, known)
        return new_table(self.found.anchors_m, known, addresses=self.found.addresses)

    def to_dataframe(self) -> "DataFrame":
        """One row per anchor: ``anchor``, ``bias_m``, ``std_m``, ``noise_m``, ``count``.

        Raises:
            SkylessError: pandas is not installed.
        """
        found = self.found.estimate.anchors
        columns = {"anchor": self.anchors, "bias_m": self.bias_m, "std_m": self.std_m}
        return data_frame(
            columns | {"noise_m": figures(one.noise_m for one in found), "count": [o.count for o in found]}
        )

    def plot(self) -> Figure:
        """Draw the constants with their standard errors, one bar per anchor."""
        with report_style():
            figure, axes = panel(f"{self.path.name}: constants of the anchors, zero is their mean")
            at = np.arange(len(self.anchors))
            axes.bar(at, 100.0 * self.bias_m, yerr=100.0 * self.std_m, color=BLUE, capsize=3.0)
            axes.set_xticks(at, [self.found.name_of(anchor) for anchor in self.anchors.tolist()])
            axes.set(xlabel="anchor", ylabel="signals seem late by, in cm")
        return figure

    def title(self) -> str:
        """Title of the calibration."""
        found = self.found.estimate
        return f"{self.found.format}: {found.used} differences used, {found.rejected} outliers"

    def facts(self) -> Iterator[tuple[str, str]]:
        """The main figures: name, and value with its unit."""
        found = self.found.estimate
        for one in found.anchors:
            value = "not determined" if one.bias_m is None else f"{cm(one.bias_m)} ± {cm(one.std_m)}"
            yield (
                f"anchor {self.found.name_of(one.anchor)}",
                f"{value}; noise {cm(one.noise_m)}, {one.count} differences",
            )
        yield "zero", "of biases only differences can be seen; the zero is the mean of the constants"
        yield "noise of a difference", f"{cm(found.noise_before_m)} before, {cm(found.noise_m)} after"
        if found.slope_m is not None:
            slope = f"{found.slope_m:.3f} ± {found.slope_std_m or 0.0:.3f} m while the range grows by the factor e"
            yield "range bias (received power)", slope
        for note in self.found.notes:
            yield "note", note
        for reason, number in self.found.drops.items():
            yield f"left out: {reason}", str(number)


def delays_of_site(asked: CalibrateOptions, on_count: Callable[[Count], None]) -> SurveyResult:
    """Find the delays of a site's anchors from its ranges and a tag at known positions. Raises SkylessError.

    A tag's differences hold the delays of the recording, so the ranges must, too; the result is relative to the site's.
    """
    if asked.truth is None:
        asked.leave_out("lever_arm_m", why="it moves the truth, which --truth must give")
    given = gathered(asked.file, asked.site, asked.format, asked.progress)
    assert given.site is not None  # a recording of skyless record holds its site
    truth = None if asked.truth is None else known_truth(Path(asked.file), asked)
    with McapRecording(asked.file) as recording:
        tags = known_tags(recording, recorded_site(recording, given.site.id), asked, truth)
    return solved(given, calibration_facts(given.site, tags), asked.site, on_count, given.delays_m)


def biases_of_other(asked: CalibrateOptions) -> BiasResult:
    """Find by how much the anchors of another system seem late. Raises SkylessError."""
    table = Path(asked.anchors) if isinstance(asked.anchors, str | Path) else None
    return BiasResult(Path(asked.file), biases_of(asked), table)


def run_calibrate(asked: CalibrateOptions) -> SurveyResult | BiasResult:
    """Find the errors of antenna delays from a tag at known positions, as ``skyless calibrate`` does.

    The anchors' positions are kept. In a recording of another system the tag shows each anchor's apparent lateness, up
    to a common constant: a ``BiasResult``.
    """
    return delays_of_site(asked, lambda _: None) if is_mcap(asked.file) else biases_of_other(asked)


calibrate = python_function(CalibrateOptions, run_calibrate)
