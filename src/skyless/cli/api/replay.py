"""``skyless.replay``: a recording becomes fixes, judged against the truth where there is one."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from skyless.cli.api._result import Result, cm
from skyless.cli.api.fixes import Fixes, FixRecorder
from skyless.core.air.masterless_packets import Point
from skyless.core.arguments import python_function, wrong
from skyless.core.errors import ConfigurationError
from skyless.core.fix import Fix
from skyless.core.kernels.arrays import Matrix
from skyless.core.method_names import DEFAULT_METHOD
from skyless.research.foreign.formats import Recording
from skyless.research.foreign.formats import open_recording as open_foreign
from skyless.research.replays.captures import CaptureReplay, ReplayReport, distances_of
from skyless.research.replays.options import ReplayOptions
from skyless.research.replays.site import SiteReplay, TagReport, summary_of
from skyless.run.recordings.recording import McapRecording, is_mcap
from skyless.sim.evaluation.judge import Judge
from skyless.sim.evaluation.statistics import dimensions
from skyless.site.file.load import site_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


class ReplayResult(Result, frozen=True, eq=False):
    """Result of a replay."""

    path: Path
    reports: dict[str, ReplayReport]
    """Figures of each tag, by its name."""
    fixes: Fixes
    """All fixes; ``truth_m`` is NaN where it is not known."""
    tracks: dict[str, Matrix]
    """Time, position and true position of each tag, shape (k, 7): an even sample, for drawing."""
    warnings: tuple[str, ...]
    height_note: str
    """Where the tags' height is from."""
    summary: dict[str, Any]
    """The object that ``skyless replay --json`` writes, in SI units, but for the version."""

    @property
    def tags(self) -> tuple[str, ...]:
        """Names of the tags; that of a recording with a single nameless one is ``tag``."""
        return self.fixes.tags

    def to_dataframe(self) -> "DataFrame":
        """See ``Fixes.to_dataframe``."""
        return self.fixes.to_dataframe()

    def plot(self, tag: str | None = None) -> "Figure":
        """Track, errors over time, their histograms and distribution of one tag, by default the first.

        Raises:
            SkylessError: there is no such tag.
        """
        from skyless.research.replays.plot import track_figure

        name = self.tags[0] if tag is None else tag
        if name not in self.reports:
            raise wrong("tag", tag, f"one of {', '.join(self.tags)}")
        report = self.reports[name]
        return track_figure(self.tracks[name], f"{report.format}, {report.fixes} fixes")

    def title(self) -> str:
        """What was replayed."""
        return f"{self.path.name} ({self.summary['format']})"

    def facts(self) -> Iterator[tuple[str, str]]:
        """The figures that matter, each with its name and unit."""
        for tag in self.reports:
            for name, value in self.facts_of(tag):
                yield f"{tag}: {name}" if len(self.reports) > 1 else name, value

    def facts_of(self, tag: str) -> Iterator[tuple[str, str]]:
        """The figures of one tag."""
        report = self.reports[tag]
        if isinstance(report, TagReport):
            yield "tag", tag
            yield "recorded fixes", _same(report)
            starts = "as the tag was" if report.cold_starts == 0 else f"{report.cold_starts} of {report.segments} cold"
            yield "starts", starts
        yield "receptions", f"{report.receptions}"
        yield "fixes", f"{report.fixes}" if report.reason is None else f"none: {report.reason}"
        yield "method", f"{report.method}" + (f", given {report.measurements}" if report.measurements else "")
        yield "rate", "–" if report.rate_hz is None else f"{report.rate_hz:.1f} Hz"
        note = self.height_note
        yield "height", note if report.height_m is None else f"{report.height_m:.3f} m, {note}"
        yield "median position", _triple(report.median_m)
        yield "scatter of the fixes", _triple(report.std_m)
        # without truth, the tag's own motion is in it
        truth_known = any(pair.against_truth for pair in report.pairs)
        yield "noise of a difference" if truth_known else "scatter of a difference", cm(report.tdoa_noise_m)
        yield "RMSE 2-D", cm(report.rmse_2d_m)
        yield "RMSE 3-D", cm(report.rmse_3d_m)
        of_all = dimensions(planar=report.rmse_3d_m is None)
        yield f"95 % {of_all}", cm(report.p95_m)
        yield f"largest error {of_all}", cm(report.max_m)
        yield "speed", f"{report.receptions_per_s:,.0f} receptions/s"
        for reason, count in report.drops.items():
            yield f"dropped: {reason}", str(count)
        for pair, by_m in report.contradictions_m.items():
            nearer = "nearer" if by_m < 0.0 else "farther"
            yield f"anchors {pair}", f"range each other {abs(by_m):.2f} m {nearer} than the table has them"
        for pair, distance_m in self.summary.get("anchor_distances_m", {}).items():
            yield f"distance {pair}", f"{distance_m:.3f} m"


def _same(report: TagReport) -> str:
    """How the fixes of a replay compare with the recorded ones."""
    found = report.identical
    if found is None:
        return "–"
    if found.compared == 0:
        return "nothing to compare"
    if found.different == 0:
        return f"identical, all {found.compared} of them"
    return f"{found.different} of {found.compared} differ"


def _triple(values_m: tuple[float, float, float] | None) -> str:
    return "–" if values_m is None else ", ".join(f"{value:.3f}" for value in values_m) + " m"


OnFix = Callable[[str, float, Fix], None]
"""Gets the tag's name, the fix's time in the recording's own scale (Unix time for one of skyless record), and the fix.
"""

Begin = Callable[[Mapping[str, Judge], str], OnFix | None]
"""Gets, before a replay begins, the judge of each tag, and the method or what the filter is given."""


def replay_recording(asked: ReplayOptions, begin: Begin) -> ReplayResult:
    """Replay a recording; ``begin`` says what gets the fixes, and the result holds none. Raises SkylessError."""
    return _replay_site(asked, begin) if is_mcap(asked.file) else _replay_capture(asked, begin)


def _replay_capture(asked: ReplayOptions, begin: Begin) -> ReplayResult:
    run, path = CaptureReplay(asked), Path(asked.file)
    write = begin({"tag": run.judge}, run.measurements)
    size = max(path.stat().st_size, 1)
    on_fix = None if write is None else lambda fix: write("tag", fix.time_s, fix)
    report = run.run(on_fix, lambda read: asked.progress(min(read / size, 1.0)))
    asked.progress(1.0)
    summary = {**msgspec.to_builtins(report), "height_note": run.height_note}
    summary["anchor_distances_m"] = distances_of(path, report.format)
    return _result(path, {"tag": report}, {"tag": run.judge}, run.height_note, summary)


def _replay_site(asked: ReplayOptions, begin: Begin) -> ReplayResult:
    why, path = "a recording of skyless record brings its own", Path(asked.file)
    asked.leave_out(
        *("anchors", "truth", "lever_arm_m", "format", "listener", "qa", "dynamics", "tdoa_std_m", "measurements"),
        *("uncalibrated", "tag_height_m"),
        why=why,
    )
    wanted = None if asked.site is None else site_of(asked.site)[0]
    tags, settle_s = None if asked.tag is None else (asked.tag,), 2.0 if asked.settle_s is None else asked.settle_s
    with McapRecording(path) as recording:
        run = SiteReplay(recording, tags, asked.method, settle_s, asked.above_m, wanted, asked.requirement)
        found = recording.summary()
        span_s = max((found.end_s or 0.0) - (found.start_s or 0.0), 1e-9)
        write = begin(run.judges, asked.method or DEFAULT_METHOD)
        on_fix = None if write is None else lambda tag, made: write(tag, made.unix_s, made.fix)
        reports = run.run(on_fix, lambda done_s: asked.progress(min(max(done_s / span_s, 0.0), 1.0)))
    asked.progress(1.0)
    unfinished = f"{path} has no end: it was cut off, or is still being written; later fixes are missing"
    by_tag: dict[str, ReplayReport] = {report.tag: report for report in reports}
    warnings = () if found.finished else (unfinished,)
    return _result(path, by_tag, run.judges, "from the site", summary_of(reports), warnings)


def _result(
    path: Path,
    reports: dict[str, ReplayReport],
    judges: Mapping[str, Judge],
    height_note: str,
    summary: dict[str, Any],
    warnings: tuple[str, ...] = (),
) -> ReplayResult:
    tracks = {tag: judges[tag].track.rows for tag in reports}
    return ReplayResult(path, reports, FixRecorder(tuple(reports)).fixes(), tracks, warnings, height_note, summary)


def run_replay(asked: ReplayOptions) -> ReplayResult:
    """Turn a recording into fixes, as ``skyless replay`` does; judge them where the truth is known.

    A recording of ``skyless record`` knows its site and truth; of the arguments below it takes ``site``, ``tag``,
    ``method``, ``integrity_risk``, ``alert_limit_m``, ``max_acceleration_mps2``, ``tag_height_std_m``, ``settle_s`` and
    ``above_m``. One of another system needs ``anchors`` or ``site``, unless it holds their positions.
    """
    recorders: list[FixRecorder] = []

    def begin(judges: Mapping[str, Judge], _given: str) -> OnFix:
        tags, judged_before = tuple(judges), Counter[str]()
        recorder = FixRecorder(tags)
        recorders.append(recorder)

        def on_fix(tag: str, time_s: float, fix: Fix) -> None:
            judge = judges[tag]
            is_judged, judged_before[tag] = judge.judged > judged_before[tag], judge.judged
            recorder.add(tags.index(tag), time_s, fix, judge.newest_truth_m, judged=is_judged)

        return on_fix

    result = replay_recording(asked, begin)
    return replace(result, fixes=recorders[0].fixes())


replay = python_function(ReplayOptions, run_replay)


def open_recording(
    path: str | PathLike[str],
    format_name: str | None = None,
    listener: str | None = None,
    anchors_m: Mapping[int, Point] | None = None,
) -> Recording | McapRecording:
    """Open a recording of a named format, or of the one that its first bytes show.

    An MCAP gives an ``McapRecording``, whose methods give fixes, truth and raw receptions by time; any other format a
    ``Recording``, to be iterated over once. Close either, or use ``with``.

    Args:
        path: The recording; those of other systems also gzip.
        format_name: Name of the format of another system.
        listener: Chooses one receiver where a recording of another system holds several.
        anchors_m: Positions that replace all that the anchors of a recording of DL-TDoA state.

    Raises:
        ConfigurationError: the file cannot be opened, its format is not known, or an argument makes no sense.
    """
    if format_name is not None or not is_mcap(path):
        return open_foreign(path, format_name, listener, anchors_m)
    if listener is not None:
        raise ConfigurationError(path, "listener", listener, "left out: recordings of a site give each tag by its name")
    if anchors_m is not None:
        raise ConfigurationError(path, "anchors_m", "given", "left out: recordings of a site hold their anchors")
    return McapRecording(path)
