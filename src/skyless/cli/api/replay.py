"""``skyless.replay``: turn a recording into fixes, judged against the truth if there is one."""

from collections.abc import Callable, Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from skyless.arguments import python_function
from skyless.cli.api.fixes import FixesResult, FixRecorder, MeasurementRecorder, Measurements
from skyless.cli.common import cm, number
from skyless.core.air.masterless_packets import Packet, PairTdoa, Point
from skyless.core.arrays import Matrix
from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.method_names import DEFAULT_METHOD
from skyless.research.foreign.formats import Recording
from skyless.research.foreign.formats import open_recording as open_foreign
from skyless.research.replays.captures import NAMELESS, CaptureReplay, OnFix, OnMeasured, ReplayReport, distances_of
from skyless.research.replays.options import ReplayOptions
from skyless.research.replays.site import SiteReplay, TagReport, summary_of
from skyless.run.recordings.recording import McapRecording, is_mcap
from skyless.sim.evaluation.figures import FixSamples, Judged, axes_std_m, truth_at
from skyless.site.file.load import site_of

_WORTH_SHIFTING_S: Final = 0.05
"""Offsets of the truth's times up to this are due to the filter itself."""


class ReplayResult(FixesResult, frozen=True, eq=False, kw_only=True):
    """Result of a replay."""

    path: Path
    reports: dict[str, ReplayReport]
    """Figures of each tag, by its name."""
    samples: Mapping[str, FixSamples]
    """An even sample of the fixes of each tag."""
    judged: dict[str, Judged]
    """Which fixes of each tag are judged, and against which truth."""
    measurements: Measurements = MeasurementRecorder(()).measurements()
    """The estimator's input, and whether it was used."""
    warnings: tuple[str, ...] = ()
    height_note: str
    """Source of the tags' height."""
    summary: dict[str, Any]
    """The object that ``skyless replay --json`` writes, in SI units, without the version."""

    @property
    def tags(self) -> tuple[str, ...]:
        """Names of the tags; ``tag`` for a single nameless one."""
        return tuple(self.reports)

    def track(self, tag: str) -> Matrix:
        """Time, position, true position and σ of x, y and z of an even sample of a tag's fixes, shape (k, 10)."""
        table = self.samples[tag].table()
        truth_m = truth_at(self.judged[tag].truth, table.time_s)
        return np.column_stack([table.time_s, table.position_m, truth_m, axes_std_m(table.covariance_m2)])

    @property
    def report(self) -> ReplayReport:
        """Figures of a recording's only tag, named as those of a ``SimulationResult``; for several see ``reports``.

        Raises:
            SkylessError: the recording has several tags.
        """
        if len(self.reports) != 1:
            raise SkylessError(f"{self.path} has {len(self.reports)} tags; reports has the figures of each")
        return next(iter(self.reports.values()))

    def _heading(self, tag: str, _count: int) -> str:
        report = self.reports[tag]
        return f"{self.path.name}, {tag} ({report.format}): {report.fixes} fixes"

    def title(self) -> str:
        """Title of the replay."""
        return f"{self.path.name} ({self.summary['format']})"

    def facts(self) -> Iterator[tuple[str, str]]:
        """The main figures: name, and value with its unit."""
        for tag in self.reports:
            for name, value in self.facts_of(tag):
                yield f"{tag}: {name}" if len(self.reports) > 1 else name, value

    def facts_of(self, tag: str) -> Iterator[tuple[str, str]]:
        """The main figures of one tag."""
        report = self.reports[tag]
        if isinstance(report, TagReport):
            yield "tag", tag
        yield "receptions", f"{report.receptions}"
        yield "fixes", f"{report.fixes}" if report.reason is None else f"none: {report.reason}"
        yield "method", f"{report.method}" + (f", given {report.measurements}" if report.measurements else "")
        yield "rate", number(report.rate_hz, "{:.1f} Hz")
        note = self.height_note
        yield "height", note if report.height_m is None else f"{report.height_m:.3f} m, {note}"
        yield "median position", _triple(report.median_m)
        yield "scatter of the fixes", _triple(report.std_m)
        # Without truth the scatter includes the tag's own motion.
        truth_known = any(pair.against_truth for pair in report.pairs)
        yield "noise of a difference" if truth_known else "scatter of a difference", cm(report.tdoa_noise_m)
        yield from _judged_facts(report)
        yield "speed", f"{report.receptions_per_s:,.0f} receptions/s"
        for reason, count in report.drops.items():
            yield f"dropped: {reason}", str(count)
        for pair, by_m in report.contradictions_m.items():
            nearer = "nearer" if by_m < 0.0 else "farther"
            yield f"anchors {pair}", f"range each other {abs(by_m):.2f} m {nearer} than the table has them"
        for note in report.notes:
            yield "note", note
        for pair, distance_m in self.summary.get("anchor_distances_m", {}).items():
            yield f"distance {pair}", f"{distance_m:.3f} m"


def _judged_facts(report: ReplayReport) -> Iterator[tuple[str, str]]:
    """Figures of judged fixes, protection levels and alerts."""
    if report.first_fix_s is not None:
        off = "" if report.first_fix_error_m is None else f", {cm(report.first_fix_error_m)} off"
        yield "first fix", f"after {report.first_fix_s:.2f} s{off}"
        yield "available", number(report.availability, "{:.1f} %", 100.0)
    left_out = ", ".join(f"{count} {reason}" for reason, count in report.left_out.items())
    yield "judged", f"{report.judged} fixes, {report.judged_s:.1f} s" + (f" (left out: {left_out})" if left_out else "")
    for of in ("2d", "3d"):
        rmse_m, *others_m = (getattr(report, f"{name}_{of}_m") for name in ("rmse", "p50", "p75", "p95", "max"))
        if rmse_m is not None:
            name = of.upper().replace("D", "-D")
            yield f"RMSE {name}", cm(rmse_m)
            yield f"50, 75, 95, 100 % {name}", ", ".join(cm(value) for value in others_m)
    if report.bias_m is not None and report.rmse_axes_m is not None:
        yield "RMSE x, y, z", _triple(report.rmse_axes_m)
        yield "bias x, y, z", _triple(report.bias_m)
        yield "claimed σ", cm(report.sigma_2d_m if report.sigma_3d_m is None else report.sigma_3d_m)
        beyond = number(report.beyond_95, "{:.1f} %", 100.0)
        yield "NEES", "–" if report.nees is None else f"{report.nees:.2f}; {beyond} beyond 95 %"
        yield "trajectory errors", f"absolute {cm(report.ate_m)}, relative {cm(report.rpe_m)} in a metre"
    if report.levels:
        exceeded = f"exceeded by {report.exceeded_horizontal} horizontally, {report.exceeded_vertical} vertically"
        yield "protection levels", f"{report.levels}, {exceeded} ({report.exceeded_unalerted} without alert)"
    if report.hpl_m is not None:
        yield "median level", cm(report.hpl_m) + ("" if report.vpl_m is None else f", vertical {cm(report.vpl_m)}")
    if alerts := ", ".join(f"{alert} {count}" for alert, count in report.alerts.items() if alert != "none"):
        yield "alerts", alerts
    if report.truth_offset_s is not None and abs(report.truth_offset_s) > _WORTH_SHIFTING_S:
        yield "truth", f"fits best {report.truth_offset_s:+.3f} s later: see --truth-offset"


def _triple(values_m: tuple[float, float, float] | None) -> str:
    return "–" if values_m is None else ", ".join(f"{value:.3f}" for value in values_m) + " m"


Begin = Callable[[tuple[str, ...], str], OnFix | None]
"""Called before a replay with the tags' names, and the method or the kind of measurements; returns the fixes' sink."""


def replay_recording(asked: ReplayOptions, begin: Begin, on_measured: OnMeasured | None = None) -> ReplayResult:
    """Replay a recording. Fixes go to the sink that ``begin`` returns; the result has no fixes and no measurements.

    Raises SkylessError.
    """
    return (_replay_site if is_mcap(asked.file) else _replay_capture)(asked, begin, on_measured)


def _replay_capture(asked: ReplayOptions, begin: Begin, on_measured: OnMeasured | None) -> ReplayResult:
    run, path = CaptureReplay(asked), Path(asked.file)
    report = run.run(begin((NAMELESS,), run.measurements), asked.progress, on_measured)
    asked.progress(1.0)
    summary = {**msgspec.to_builtins(report), "height_note": run.height_note}
    summary["anchor_distances_m"] = distances_of(path, report.format)
    return ReplayResult(
        path=path,
        reports={NAMELESS: report},
        samples={NAMELESS: run.samples},
        judged={NAMELESS: run.judged},
        height_note=run.height_note,
        summary=summary,
    )


def _replay_site(asked: ReplayOptions, begin: Begin, on_measured: OnMeasured | None) -> ReplayResult:
    why, path = "a recording of skyless record brings its own", Path(asked.file)
    asked.leave_out(
        *("anchors", "truth", "truth_offset_s", "lever_arm_m", "format", "listener", "tdoa_std_m"),
        *("measurements", "uncalibrated", "tag_height_m", "z_bounds_m", "heights", "imu", "first_s"),
        why=why,
    )
    asked.leave_out(
        "channel", "smooth", "estimator", why="it is for time differences, and these are receptions of beacons"
    )
    wanted = None if asked.site is None else site_of(asked.site)[0]
    tags, settle_s = None if asked.tag is None else (asked.tag,), 2.0 if asked.settle_s is None else asked.settle_s
    with McapRecording(path) as recording:
        run = SiteReplay(
            recording, tags, asked.method, settle_s, asked.above_m, wanted, asked.requirement, asked.stamps_only
        )
        found = recording.summary()
        span_s = max((found.end_s or 0.0) - (found.start_s or 0.0), 1e-9)
        on_fix = begin(tuple(run.tags), asked.method or DEFAULT_METHOD)
        reports = run.run(on_fix, lambda done_s: asked.progress(min(max(done_s / span_s, 0.0), 1.0)), on_measured)
    asked.progress(1.0)
    unfinished = f"{path} has no end: it was cut off, or is still being written; later fixes are missing"
    return ReplayResult(
        path=path,
        reports={report.tag: report for report in reports},
        samples={tag: replayed.samples for tag, replayed in run.tags.items()},
        judged={report.tag: run.judged(report.tag) for report in reports},
        warnings=() if found.finished else (unfinished,),
        height_note="from the site",
        summary=summary_of(reports),
    )


def run_replay(asked: ReplayOptions) -> ReplayResult:
    """Turn a recording into fixes, as ``skyless replay`` does, and judge them where the truth is known.

    A recording of ``skyless record`` contains its site and truth; of the arguments below it takes ``site``, ``tag``,
    ``method``, ``integrity_risk``, ``alert_limit_m``, ``tag_height_std_m``, ``settle_s`` and ``above_m``. A recording
    of another system needs ``anchors`` or ``site``, unless it contains the positions.
    """
    recorders: list[tuple[FixRecorder, MeasurementRecorder]] = []

    def begin(tags: tuple[str, ...], _given: str) -> OnFix:
        recorders.append((recorder := FixRecorder(tags), MeasurementRecorder(tags)))
        return lambda tag, time_s, fix: recorder.add(tags.index(tag), time_s, fix, None, judged=False)

    def on_measured(tag: str, time_s: float, measured: Packet | PairTdoa, used: bool) -> None:
        recorders[0][1].add(tag, time_s, measured, used)

    result = replay_recording(asked, begin, on_measured)
    fixes, measurements = recorders[0][0].fixes(), recorders[0][1].measurements()
    truth_m, judged = np.full((len(fixes), 3), np.nan), np.zeros(len(fixes), dtype=bool)
    for tag in result.tags:
        of_tag = fixes.of_tag(tag)
        truth_m[of_tag], judged[of_tag] = result.judged[tag].of(fixes.time_s[of_tag])
    return replace(result, fixes=replace(fixes, truth_m=truth_m, judged=judged), measurements=measurements)


replay = python_function(ReplayOptions, run_replay)


def open_recording(
    path: str | PathLike[str],
    format_name: str | None = None,
    listener: str | None = None,
    anchors_m: Mapping[int, Point] | None = None,
) -> Recording | McapRecording:
    """Open a recording in a named format, or in the one recognised by its first bytes.

    An MCAP gives an ``McapRecording``, whose methods give fixes, truth and raw receptions by time; any other format a
    ``Recording``, to be iterated over once. Close either, or use ``with``.

    Args:
        path: The recording; those of other systems may be gzipped.
        format_name: Name of the format of another system.
        listener: Chooses one receiver if a recording of another system has several.
        anchors_m: Positions that replace those stated by the anchors of a DL-TDoA recording.

    Raises:
        ConfigurationError: the file cannot be opened, its format is unknown, or an argument does not apply.
    """
    if format_name is not None or not is_mcap(path):
        return open_foreign(path, format_name, listener, anchors_m)
    if listener is not None:
        raise ConfigurationError(path, "listener", listener, "left out: recordings of a site give each tag by its name")
    if anchors_m is not None:
        raise ConfigurationError(path, "anchors_m", "given", "left out: recordings of a site hold their anchors")
    return McapRecording(path)
