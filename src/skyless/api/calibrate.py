"""``skyless.calibrate``: the anchors' antenna delays from a recording during which it was known where the tag was."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from skyless.api.inputs import AnyPath, AnySite, left_out, site_of
from skyless.api.replay import ARGUMENTS, Anchors, AnyTruth, anchors_given, truth_given
from skyless.api.result import Result, cm, data_frame, figures
from skyless.arguments import check_number, check_point, check_whole, existing_file, named_as_arguments, wrong
from skyless.errors import SkylessError
from skyless.kernels.arrays import Integers, Vector
from skyless.recordings.mcap.recording import is_mcap
from skyless.replays.inputs import flight_height
from skyless.survey_inputs.report import calibration_report, corrected_text
from skyless.survey_inputs.run import Calibrated, CalibrationRequest, calibrate_capture, calibrate_site
from skyless.survey_inputs.samples import First, Stay

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


class CalibrationResult(Result, frozen=True, eq=False):
    """Constants of n anchors, ordered by identifier; NaN where one is not determined."""

    path: Path
    found: Calibrated
    """Everything that was estimated."""
    anchors: Integers
    """Shape (n,): identifiers."""
    bias_m: Vector
    """Shape (n,): by how much the anchor's signals seem late; only differences count, see ``zero``."""
    std_m: Vector
    """Shape (n,): standard error of ``bias_m``."""
    noise_m: Vector
    """Shape (n,): of the anchor's differences."""
    counts: Integers
    """Shape (n,): differences in use."""
    delay_m: Vector
    """Shape (n,): half of what TX and RX delay together are off; only of recordings of ``skyless record``."""
    delay_std_m: Vector
    """Shape (n,)."""
    summary: dict[str, Any]
    """The object that ``skyless calibrate --json`` writes, in SI units, but for the version and the file written."""
    table: Path | None
    """The table of anchors, or the file of the site, that is to be corrected; None for a new table."""

    @property
    def zero(self) -> str:
        """Whose constant is 0: ``mean`` of the anchors, or ``anchor N``."""
        return self.found.estimate.zero

    @property
    def tx_delays_ticks(self) -> dict[int, tuple[int, int]]:
        """Old and new TX antenna delay by anchor; empty for recordings of other systems."""
        return self.found.tx_delays_ticks()

    def corrected_file(self) -> str:
        """The table of anchors or site file with the calibration in it, as ``skyless calibrate --out`` writes it.

        Raises:
            SkylessError: the delays are a site's, and no file of it was given.
        """
        if self.found.site is None:
            return corrected_text(self.found, self.table, None)
        if self.table is None:
            raise SkylessError("site was no path; it should be that of the site file, which is then corrected")
        return corrected_text(self.found, None, self.table)

    def to_dataframe(self) -> "DataFrame":
        """One row an anchor: ``anchor``, ``bias_m``, ``std_m``, ``noise_m``, ``count``, ``delay_m``, ``delay_std_m``.

        Raises:
            SkylessError: pandas is not installed.
        """
        return data_frame(
            {
                "anchor": self.anchors, "bias_m": self.bias_m, "std_m": self.std_m, "noise_m": self.noise_m,
                "count": self.counts, "delay_m": self.delay_m, "delay_std_m": self.delay_std_m,
            }
        )  # fmt: skip

    def plot(self) -> "Figure":
        """The constants with their standard errors, one bar an anchor."""
        from skyless.evaluation.figures import BLUE, panel, report_style  # noqa: PLC0415 - Matplotlib, where it draws

        zero = "their mean" if self.zero == "mean" else self.zero
        with report_style():
            figure, axes = panel(f"{self.path.name}: constants of the anchors, zero is {zero}")
            at = np.arange(len(self.anchors))
            axes.bar(at, 100.0 * self.bias_m, yerr=100.0 * self.std_m, color=BLUE, capsize=3.0)
            axes.set_xticks(at, [str(anchor) for anchor in self.anchors])
            axes.set(xlabel="anchor", ylabel="signals seem late by, in cm")
        return figure

    def _title(self) -> str:
        found = self.found.estimate
        return f"{self.path.name}: {found.used} differences used, {found.rejected} outliers"

    def _facts(self) -> Iterator[tuple[str, str]]:
        found = self.found.estimate
        for anchor, bias_m, std_m in zip(self.anchors, self.bias_m, self.std_m, strict=True):
            value = "not determined" if np.isnan(bias_m) else f"{cm(bias_m)} ± {cm(std_m)}"
            yield f"anchor {anchor}", value
        yield "zero", self.zero
        yield "noise of a difference before", cm(found.noise_before_m)
        yield "noise of a difference after", cm(found.noise_m)
        for note in self.summary["notes"]:
            yield "note", note


def calibrate(
    file: AnyPath,
    *,
    anchors: Anchors | None = None,
    site: AnySite | None = None,
    truth: AnyTruth | None = None,
    lever_arm_m: tuple[float, float, float] | None = None,
    at_m: Sequence[float] | None = None,
    stays: Sequence[Stay] = (),
    first_s: float | None = None,
    first_count: int | None = None,
    first_share: float | None = None,
    above_m: float | None = None,
    format: str | None = None,  # noqa: A002 - the name of the command's option
    listener: str | None = None,
    tag: str | None = None,
) -> CalibrationResult:
    """Estimate by how much each anchor's signals seem late, from a tag at known positions, as ``skyless calibrate``.

    Args:
        file: The recording, plain or gzip; what ``skyless.replay`` takes.
        anchors: Positions in metres by identifier, or a table ``id,x_m,y_m,z_m``.
        site: A site instead; of a recording of ``skyless record`` that whose antenna delays are to be corrected.
        truth: True positions: an array of shape (n, 4) with time, x, y, z, or a table ``t_s,x_m,y_m,z_m``.
        lever_arm_m: The antenna in the body's frame, added to the truth.
        at_m: Where the tag stood still instead: (x, y, z), or (x, y) where the site knows its tags' height.
        stays: Several positions, each with its times: values of ``skyless.survey_inputs.samples.Stay``.
        first_s: Use the first seconds only, or ...
        first_count: ... this number of differences, or ...
        first_share: ... this part of the time, above 0, at most 1.
        above_m: Use the truth only while its height exceeds this.
        format: Name of the format, if the content should not decide.
        listener: Which receiver, in recordings with several.
        tag: Name of the tag, in recordings of ``skyless record``; by default all whose truth is known.

    Raises:
        SkylessError: one line that names the argument or file, its value and what it should be.
    """
    path = existing_file("file", file)
    check_number("above_m", above_m)
    known_stays = _stays(at_m, stays)
    beginning = _first(first_s, first_count, first_share)
    if known_stays and (truth is not None or lever_arm_m is not None):
        raise SkylessError("at_m and stays say where the antenna was; give them without truth and lever_arm_m")
    own = is_mcap(path)
    if own:
        useless = {
            "anchors": anchors, "format": format, "listener": listener,
            "lever_arm_m": lever_arm_m if truth is None else None,
        }  # fmt: skip
        left_out(useless, "a recording of skyless record brings its own")
    else:
        left_out({"tag": tag}, "it is for recordings of skyless record")
    with named_as_arguments(ARGUMENTS):
        known = None
        if not known_stays and not (own and truth is None):
            known = truth_given(path, truth, lever_arm_m, format, listener)
        if own:
            request = CalibrationRequest(path, known_stays, known, above_m, beginning, tag=tag)
            done = calibrate_site(request, None if site is None else site_of(site)[0].id)
        else:
            anchors_m, height_m = anchors_given(anchors, site)
            at_least_m = flight_height(above_m, known)
            request = CalibrationRequest(
                path, known_stays, known, at_least_m, beginning, anchors_m, height_m, format, listener
            )
            done = calibrate_capture(request)
    source = site if own else anchors
    return _result(path, done, Path(source) if isinstance(source, str | Path) else None)


def _result(path: Path, done: Calibrated, table: Path | None) -> CalibrationResult:
    found = sorted(done.estimate.anchors, key=lambda one: one.anchor)
    surveyed = {} if done.survey is None else {one.id: one for one in done.survey.anchors}
    delays = [surveyed.get(one.anchor) for one in found]
    return CalibrationResult(
        path=path,
        found=done,
        anchors=np.array([one.anchor for one in found], dtype=np.int64),
        bias_m=figures(one.bias_m for one in found),
        std_m=figures(one.std_m for one in found),
        noise_m=figures(one.noise_m for one in found),
        counts=np.array([one.count for one in found], dtype=np.int64),
        delay_m=figures(None if one is None else one.delay_m for one in delays),
        delay_std_m=figures(None if one is None else one.delay_std_m for one in delays),
        summary=calibration_report(done),
        table=table,
    )


def _stays(at_m: Sequence[float] | None, stays: Sequence[Stay]) -> tuple[Stay, ...]:
    if at_m is not None:
        if len(stays):
            raise SkylessError("give either at_m or stays, not both")
        check_point("at_m", at_m, (2, 3))
        return (Stay(*map(float, at_m)),)
    for number, stay in enumerate(stays):
        if not isinstance(stay, Stay):
            raise wrong(f"stays[{number}]", stay, "a skyless.survey_inputs.samples.Stay")
        height = () if stay.z_m is None else (stay.z_m,)
        check_point(f"stays[{number}]", (stay.x_m, stay.y_m, *height), (2, 3))
        if not stay.from_s < stay.to_s:
            raise wrong(f"stays[{number}].to_s", stay.to_s, f"above from_s, which is {stay.from_s:g}")
    return tuple(stays)


def _first(seconds: float | None, count: int | None, share: float | None) -> First:
    check_number("first_s", seconds, above=0.0)
    check_whole("first_count", count, least=1)
    check_number("first_share", share, above=0.0, most=1.0)
    if sum(value is not None for value in (seconds, count, share)) > 1:
        raise SkylessError("give one of first_s, first_count and first_share, not several")
    return First(count=count, seconds=seconds, part=share)
