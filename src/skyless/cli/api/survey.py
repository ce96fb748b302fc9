"""``skyless.survey_site``: anchors from their receptions; ``skyless.calibrate``: delays from a tag at known places."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from msgspec.structs import replace

from skyless.arguments import Progress, python_function
from skyless.cli.api.fixes import Result, data_frame, figures
from skyless.cli.common import cm
from skyless.core.arrays import Integers, Vector
from skyless.core.errors import SkylessError
from skyless.core.site import Site
from skyless.files import has_columns, read_head
from skyless.research.calibration.biases import Biases, Gathered, biases_of, known_tags, ranges_of, walk_of
from skyless.research.calibration.options import CalibrateOptions, SurveyOptions, Walk, calibration_facts, facts_of
from skyless.research.replays.captures import known_truth
from skyless.research.replays.site import recorded_site
from skyless.run.recordings.recording import McapRecording, is_mcap
from skyless.site.file.load import site_of
from skyless.site.report import BLUE, GRID, INK, MUTED, ORANGE, RED, panel, report_style
from skyless.site.survey.facts import Count, Facts, PairRanges, Survey, SurveyedAnchor, count
from skyless.site.survey.pair_ranger import PairRanger
from skyless.site.survey.solve import run_survey
from skyless.site.survey.surveyed_site import delay_differences_m, surveyed_text
from skyless.site.survey.watch import drop_moved, with_changes
from skyless.site.tables import RANGE_COLUMNS, calibrated_table, new_table, read_ranges

if TYPE_CHECKING:
    from pandas import DataFrame


# Picture of a survey from above: anchors with their ellipses, ranges, those left out, and other solutions.

_SIGMAS: Final = 3.0
_SMALLEST_SHARE: Final = 0.01
"""Least size of the median ellipse, as a share of the picture; smaller ellipses are magnified by 10, 100 …"""


def survey_figure(survey: Survey) -> Figure:
    """Draw a survey from above."""
    at_m = {one.id: (one.x_m, one.y_m) for one in survey.anchors if one.x_m is not None and one.y_m is not None}
    with report_style():
        figure, axes = panel("survey, from above", 4.2)
        _ranges(axes, survey, at_m)
        scale = _magnification(survey, at_m)
        for one in survey.anchors:
            if one.id in at_m:
                _anchor(axes, one, at_m[one.id], scale)
        for ambiguity in survey.ambiguities:
            for anchor, (x_m, y_m, _) in ambiguity.positions_m.items():
                if anchor in at_m:
                    axes.plot([at_m[anchor][0], x_m], [at_m[anchor][1], y_m], ":", color=ORANGE, linewidth=1.0)
                axes.plot(x_m, y_m, "s", color=ORANGE, markerfacecolor="none")
        axes.set(xlabel="x in m", ylabel="y in m", aspect="equal")
        axes.set_title(_legend(survey, at_m, scale), loc="right", fontsize=7.0, color=MUTED)
    return figure


def _ranges(axes: Axes, survey: Survey, at_m: dict[int, tuple[float, float]]) -> None:
    for pair in survey.pairs:
        if pair.a in at_m and pair.b in at_m:
            (xa, ya), (xb, yb) = at_m[pair.a], at_m[pair.b]
            colour, line = (RED, "--") if pair.excluded else (GRID, "-")
            axes.plot([xa, xb], [ya, yb], line, color=colour, linewidth=0.8, zorder=2 if pair.excluded else 1)


def _anchor(axes: Axes, one: SurveyedAnchor, at_m: tuple[float, float], scale: float) -> None:
    axes.plot(*at_m, "s", color=INK if one.determined else RED, markersize=4, zorder=4)
    axes.annotate(str(one.id), at_m, (4, 4), textcoords="offset points", fontsize=8.0, color=INK, zorder=5)
    if one.covariance_m2 is None:
        return
    values, vectors = np.linalg.eigh(np.array(one.covariance_m2)[:2, :2])
    width, height = 2.0 * scale * _SIGMAS * np.sqrt(np.maximum(values, 0.0))
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    axes.add_patch(Ellipse(at_m, width, height, angle=angle, facecolor=BLUE, alpha=0.35, edgecolor=BLUE, zorder=3))


def _magnification(survey: Survey, at_m: dict[int, tuple[float, float]]) -> float:
    """Power of ten that makes the median ellipse visible."""
    std_m = [one.std_m for one in survey.anchors if one.id in at_m and one.std_m]
    if not std_m:
        return 1.0
    points_m = np.array(list(at_m.values()))
    size_m = float(np.ptp(points_m, axis=0).max())
    needed = _SMALLEST_SHARE * size_m / (_SIGMAS * float(np.median(std_m)))
    return float(10.0 ** np.ceil(np.log10(needed))) if needed > 1.0 else 1.0


def _legend(survey: Survey, at_m: dict[int, tuple[float, float]], scale: float) -> str:
    magnified = "" if scale == 1.0 else f", {scale:g} × magnified"
    parts = [f"ellipses {_SIGMAS:g} σ{magnified}"]
    if any(pair.excluded for pair in survey.pairs):
        parts.append("red: left out as late")
    if survey.ambiguities:
        parts.append("orange: another solution")
    missing = ", ".join(str(one.id) for one in survey.anchors if one.id not in at_m)
    if missing:
        parts.append(f"not determined: {missing}")
    return "\n".join(parts)


class SurveyResult(Result, frozen=True, eq=False):
    """Positions and delays of n anchors."""

    survey: Survey
    """All results."""
    count: Count
    warnings: tuple[str, ...]
    """Warnings about the input and the stated facts."""
    drops: tuple[str, ...]
    """Unusable parts of the recording, by reason."""
    site: Site | None
    file: Path | None
    """The site's file, if there is one."""
    ranges: PairRanges
    """Measured ranges, with the antenna delays of the site."""

    @property
    def anchors(self) -> Integers:
        """Shape (n,): identifiers."""
        return np.array([one.id for one in self.survey.anchors], dtype=np.int64)

    @property
    def delay_m(self) -> Vector:
        """Shape (n,): half the error of TX and RX delay together; NaN if not determined."""
        return figures(one.delay_m for one in self.survey.anchors)

    @property
    def usable(self) -> bool:
        """Whether any anchor is determined, and by a range."""
        found = any(anchor.determined for anchor in self.survey.anchors)
        return found and any(pair.residual_m is not None for pair in self.survey.pairs)

    @property
    def unchanged(self) -> tuple[int, ...]:
        """Anchors of the site that the survey does not change."""
        known = () if self.site is None else self.site.all_anchors
        return tuple(anchor.id for anchor in known if anchor.id not in self.survey.determined)

    @property
    def summary(self) -> dict[str, Any]:
        """The object that ``skyless survey --json`` writes, in SI units, without the version and the files written."""
        survey: dict[str, Any] = msgspec.to_builtins(self.survey)
        survey["ambiguous"] = survey.pop("ambiguities")
        survey["excluded_pairs"] = [[pair.a, pair.b] for pair in self.survey.pairs if pair.excluded]
        return survey | {
            "usable": self.usable,
            "count": msgspec.to_builtins(self.count),
            "warnings": list(self.warnings),
            "drops": list(self.drops),
        }

    def corrected_file(self) -> str:
        """The site's file with the survey in it, as ``skyless survey --out`` writes it.

        Raises:
            SkylessError: no file of the site was given.
        """
        if self.site is None or self.file is None:
            raise SkylessError("--site was no path; it should be the path of the site file, which is then corrected")
        return surveyed_text(self.file.read_bytes().decode("utf-8-sig"), self.survey, self.site, self.file)

    def to_dataframe(self) -> "DataFrame":
        """One row per anchor, with all fields of ``skyless.site.survey.facts.SurveyedAnchor`` except the covariance.

        Raises:
            SkylessError: pandas is not installed.
        """
        names = [name for name in self.survey.anchors[0].__struct_fields__ if name != "covariance_m2"]
        return data_frame({name: [getattr(one, name) for one in self.survey.anchors] for name in names})

    def plot(self) -> "Figure":
        """Draw the anchors from above, with their ellipses."""
        return survey_figure(self.survey)

    def title(self) -> str:
        """Title of the survey."""
        return self.count.sentence

    def facts(self) -> Iterator[tuple[str, str]]:
        """The main figures: name, and value with its unit."""
        for one in self.survey.anchors:
            delay = "" if one.delay_m is None else f", delay {cm(one.delay_m)} ± {cm(one.delay_std_m)}"
            at = f"({one.x_m:.3f}, {one.y_m:.3f}, {one.z_m or 0.0:.3f}) m ± {cm(one.std_m)}" if one.determined else ""
            yield f"anchor {one.id}", at + delay if one.determined else "not determined"
        yield "constant error of a pair", cm(self.survey.range_std_m)
        for warning in self.warnings:
            yield "warning", warning


def gathered(
    recording: str | Path, site: Site | str | Path | None, format_name: str | None, on_progress: Progress
) -> Gathered:
    """Read the ranges of a recording or table, and the site if known. Raises SkylessError."""
    present = None if site is None else site_of(site)[0]
    if has_columns(RANGE_COLUMNS, read_head(recording)):
        return Gathered(read_ranges(recording), present)
    identifier = None if present is None else present.id
    found = ranges_of(recording, format_name, identifier=identifier, on_progress=on_progress)
    if present is None or found.site is None:
        return replace(found, site=present or found.site)
    return replace(found, site=present, delays_m=delay_differences_m(found.site, present))


def surveyed(asked: SurveyOptions, given: Gathered) -> SurveyResult:
    """Run the survey. Raises SkylessError."""
    facts = facts_of(asked, given.ranges.anchors, given.site, is_foreign=given.is_foreign)
    if asked.walks:
        if asked.recording is None or given.site is None or not is_mcap(asked.recording):
            raise SkylessError("--walk names a tag of a recording of skyless record")
        with McapRecording(asked.recording) as recording:
            walks = [
                walk_of(recording, given.site.id, walk.tag, (walk.from_s, walk.to_s), walk.height_m)
                for walk in asked.walks
                if isinstance(walk, Walk)
            ]
        facts = replace(facts, tags=tuple(walks))
    return solved(given, facts, asked.site)


def solved(given: Gathered, facts: Facts, file: object, before_m: Mapping[int, float] = {}) -> SurveyResult:
    """Solve for what the facts leave open; ``before_m``: changes of delays by anchor that the tags' differences lack.

    ``file``: the site's file, if it is a path.
    """
    changes = drop_moved(given.ranger, facts) if isinstance(given.ranger, PairRanger) else ()
    ranges = given.ranges
    counted = count(ranges, facts)
    result = run_survey(ranges.without_delays({anchor: -half_m for anchor, half_m in before_m.items()}), facts)
    result = replace(result, anchors=tuple(_less(one, before_m.get(one.id, 0.0)) for one in result.anchors))
    return SurveyResult(
        survey=with_changes(result, changes, ranges.duration_s) if changes else result,
        count=counted,
        warnings=() if counted.warning is None else (counted.warning,),
        drops=tuple(f"left out: {number} × {reason}" for reason, number in given.drops.items()),
        site=given.site,
        file=Path(file) if isinstance(file, str | Path) else None,
        ranges=ranges,
    )


def _less(anchor: SurveyedAnchor, half_m: float) -> SurveyedAnchor:
    return anchor if anchor.delay_m is None or not half_m else replace(anchor, delay_m=anchor.delay_m - half_m)


def run_survey_site(asked: SurveyOptions) -> SurveyResult:
    """Find the anchors' positions and the errors of their antenna delays, as ``skyless survey`` does."""
    if asked.recording is None:
        raise SkylessError("--recording is missing; it should be a recording, or a table of ranges")
    return surveyed(asked, gathered(asked.recording, asked.site, None, asked.progress))


survey_site = python_function(SurveyOptions, run_survey_site)


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


def delays_of_site(asked: CalibrateOptions) -> SurveyResult:
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
    return solved(given, calibration_facts(given.site, tags), asked.site, given.delays_m)


def biases_of_other(asked: CalibrateOptions) -> BiasResult:
    """Find by how much the anchors of another system seem late. Raises SkylessError."""
    table = Path(asked.anchors) if isinstance(asked.anchors, str | Path) else None
    return BiasResult(Path(asked.file), biases_of(asked), table)


def run_calibrate(asked: CalibrateOptions) -> SurveyResult | BiasResult:
    """Find the errors of antenna delays from a tag at known positions, as ``skyless calibrate`` does.

    The anchors' positions are kept. In a recording of another system the tag shows each anchor's apparent lateness, up
    to a common constant: a ``BiasResult``.
    """
    return delays_of_site(asked) if is_mcap(asked.file) else biases_of_other(asked)


calibrate = python_function(CalibrateOptions, run_calibrate)
