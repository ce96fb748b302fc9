"""``skyless.replay``: a recording becomes fixes, judged against the truth where there is one."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from skyless.air.masterless_packets import Point
from skyless.api.fixes import Fixes, FixRecorder
from skyless.api.inputs import AnyPath, AnySite, Progress, left_out, requirement_of, silent, site_of
from skyless.api.result import Result, cm
from skyless.arguments import (
    check_choice,
    check_number,
    check_point,
    existing_file,
    named_as_arguments,
    process_noise,
    wrong,
)
from skyless.errors import SkylessError
from skyless.evaluation.judge import Judge, antenna_truth
from skyless.evaluation.statistics import dimensions
from skyless.method_names import METHODS
from skyless.positioning.fix import Fix
from skyless.recordings.anchor_table import read_anchors, read_calibration
from skyless.recordings.mcap.recording import McapRecording, is_mcap
from skyless.recordings.truth import Truth
from skyless.replays.capture_run import CaptureRequest, CaptureRun
from skyless.replays.captures import ReplayReport
from skyless.replays.inputs import HEIGHT_WORDS, anchors_of_site, known_truth
from skyless.replays.site import Replayed, SiteReplay, summary_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

Anchors = Mapping[int, tuple[float, float, float]] | AnyPath
"""Positions by identifier in metres, or the path of a table."""

AnyTruth = ArrayLike | AnyPath
"""Rows of time and position, shape (n, 4), or the path of a table."""

ARGUMENTS: Final = {
    "lever-arm": "lever_arm_m", "tag-height": "tag_height_m", "tag-height-std": "tag_height_std_m",
    "tdoa-std": "tdoa_std_m", "settle": "settle_s", "above": "above_m", "at": "positions_m",
}  # fmt: skip
"""Of recordings, by the options of commands, where they have a unit."""


class ReplayResult(Result, frozen=True, eq=False):
    """What a replay came to."""

    path: Path
    reports: dict[str, ReplayReport]
    """Figures of each tag, by its name."""
    fixes: Fixes
    """All fixes; ``truth_m`` is NaN where it is not known."""
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
        from skyless.replays.plot import track_figure  # noqa: PLC0415 - Matplotlib is loaded where it draws

        report = self.reports[self.tags[0] if tag not in self.reports else str(tag)]
        return track_figure(self.fixes.track(tag), f"{report.format}, {report.fixes} fixes")

    def _title(self) -> str:
        return f"{self.path.name} ({self.summary['format']})"

    def _facts(self) -> Iterator[tuple[str, str]]:
        for tag, report in self.reports.items():
            of_tag = f"{tag}: " if len(self.reports) > 1 else ""
            yield f"{of_tag}receptions", f"{report.receptions}"
            yield f"{of_tag}fixes", f"{report.fixes}" if report.reason is None else f"none: {report.reason}"
            yield f"{of_tag}height", self.height_note
            yield f"{of_tag}RMSE 2-D", cm(report.rmse_2d_m)
            yield f"{of_tag}RMSE 3-D", cm(report.rmse_3d_m)
            of_all = dimensions(planar=report.rmse_3d_m is None)
            yield f"{of_tag}95 % {of_all}", cm(report.p95_m)
            yield f"{of_tag}largest error {of_all}", cm(report.max_m)


def replay(
    file: AnyPath,
    *,
    anchors: Anchors | None = None,
    site: AnySite | None = None,
    truth: AnyTruth | None = None,
    lever_arm_m: tuple[float, float, float] | None = None,
    tag_height_m: float | str = "auto",
    tag_height_std_m: float | None = None,
    format: str | None = None,  # noqa: A002 - the name of the command's option
    listener: str | None = None,
    settle_s: float | None = None,
    above_m: float | None = None,
    qa: float | None = None,
    dynamics: str | None = None,
    tdoa_std_m: float | None = None,
    uncalibrated: bool = False,
    tag: str | None = None,
    method: str | None = None,
    measurements: str | None = None,
    integrity_risk: float | None = None,
    alert_limit_m: float | None = None,
    max_acceleration_mps2: float | None = None,
    progress: Progress | None = None,
) -> ReplayResult:
    """Turn a recording into fixes, as ``skyless replay`` does; judge them where the truth is known.

    A recording of ``skyless record`` knows its site and truth; of the arguments below it takes ``site``, ``tag``,
    ``method``, ``integrity_risk``, ``alert_limit_m``, ``max_acceleration_mps2``, ``tag_height_std_m``, ``settle_s`` and
    ``above_m``. One of another system needs ``anchors`` or ``site``, unless it holds their positions.

    Args:
        file: The recording, plain or gzip; its content says which format it has.
        anchors: Positions in metres by identifier, or a table ``id,x_m,y_m,z_m``, perhaps calibrated.
        site: A site instead, for its anchors and its tags' height. With a recording of ``skyless record``: replay as
            if its anchors had had the antenna delays of this site.
        truth: True positions: an array of shape (n, 4) with time, x, y, z, or a table ``t_s,x_m,y_m,z_m``.
        lever_arm_m: The antenna in the body's frame, added to the truth.
        tag_height_m: The tag's height in metres, or ``truth`` (its median), ``free`` (estimated), ``auto``.
        tag_height_std_m: Standard deviation of the given height, which fixes and levels then count.
        format: Name of the format, if the content should not decide.
        listener: Which receiver, in recordings with several.
        settle_s: Seconds from the start that are not judged; by default 3 with a truth, 2 without.
        above_m: Judge only while the true height exceeds this.
        qa: Process noise that the filter assumes, spectral density of the acceleration in m²/s³.
        dynamics: How tags move: ``walk`` (as people), ``robot`` or ``drone``, which sets the process noise instead.
        tdoa_std_m: Noise of what is new in a time difference.
        uncalibrated: Leave out the calibration that a table of anchors holds.
        tag: Name of the tag, in recordings of ``skyless record``; by default all.
        method: Another method than the tag's own, in recordings of ``skyless record``.
        measurements: ``packets`` or ``differences``, what the filter is given of other recordings.
        integrity_risk: Another probability than the tag's own that an error exceeds its protection level.
        alert_limit_m: Another alert limit than the tag's own.
        max_acceleration_mps2: Another largest acceleration than the tag's own.
        progress: Called now and then with the share done.

    Raises:
        SkylessError: one line that names the argument or file, its value and what it should be.
    """
    path = existing_file("file", file)
    check_number("settle_s", settle_s, least=0.0)
    check_number("above_m", above_m)
    check_number("qa", qa, above=0.0)
    check_number("tdoa_std_m", tdoa_std_m, above=0.0)
    if tag_height_m not in HEIGHT_WORDS:
        if isinstance(tag_height_m, str):
            raise wrong("tag_height_m", tag_height_m, f"metres, or {', '.join(HEIGHT_WORDS)}")
        check_number("tag_height_m", tag_height_m)
    if method is not None:
        check_choice("method", method, METHODS)
    required = requirement_of(method, integrity_risk, alert_limit_m, max_acceleration_mps2, tag_height_std_m)
    of_others = {
        "anchors": anchors, "truth": truth, "lever_arm_m": lever_arm_m, "format": format, "listener": listener,
        "qa": qa, "dynamics": dynamics, "tdoa_std_m": tdoa_std_m, "measurements": measurements,
        "uncalibrated": uncalibrated or None,
        "tag_height_m": None if isinstance(tag_height_m, str) and tag_height_m == "auto" else tag_height_m,
    }  # fmt: skip
    of_sites = {
        "tag": tag, "method": method, "integrity_risk": integrity_risk, "alert_limit_m": alert_limit_m,
        "max_acceleration_mps2": max_acceleration_mps2,
    }  # fmt: skip
    with named_as_arguments(ARGUMENTS):
        if is_mcap(path):
            left_out(of_others, "a recording of skyless record brings its own")
            wanted = None if site is None else site_of(site)[0]
            with McapRecording(path) as recording:
                tags = None if tag is None else (tag,)
                run = SiteReplay(
                    recording, tags, method, 2.0 if settle_s is None else settle_s, above_m, wanted, required
                )
                return _replay_site(path, recording, run, progress or silent)
        left_out(of_sites, "it is for recordings of skyless record")
        anchors_m, site_height_m = anchors_given(anchors, site)
        asked = CaptureRequest(
            path=path,
            anchors_m=anchors_m,
            site_height_m=site_height_m,
            truth=truth_given(path, truth, lever_arm_m, format, listener),
            tag_height=tag_height_m,
            tag_height_std_m=tag_height_std_m,
            settle_s=settle_s,
            above_m=above_m,
            qa=process_noise(qa, dynamics),
            tdoa_std_m=tdoa_std_m,
            calibration=read_calibration(anchors) if isinstance(anchors, str | Path) and not uncalibrated else None,
            measurements=measurements,
            format=format,
            listener=listener,
        )
        truth_table = Path(truth) if isinstance(truth, str | Path) else Path("truth")
        return _replay_capture(asked, None if truth is None else truth_table, progress or silent)


def _replay_capture(asked: CaptureRequest, truth_table: Path | None, progress: Progress) -> ReplayResult:
    run = CaptureRun(asked)
    recorder, gate = FixRecorder(("tag",)), _Judged(run.judge)

    def on_fix(fix: Fix) -> None:
        recorder.add(0, fix.time_s, fix, run.judge.newest_truth_m, judged=gate.is_new())

    size = max(asked.path.stat().st_size, 1)
    report = run.replay.run(on_fix, lambda read: progress(min(read / size, 1.0)))
    progress(1.0)
    run.check(report, truth_table)
    return ReplayResult(asked.path, {"tag": report}, recorder.fixes(), run.height_note, run.summary(report))


def _replay_site(path: Path, recording: McapRecording, run: SiteReplay, progress: Progress) -> ReplayResult:
    found = recording.summary()
    span_s = max((found.end_s or 0.0) - (found.start_s or 0.0), 1e-9)
    recorder, numbers = FixRecorder(tuple(run.tags)), {name: number for number, name in enumerate(run.tags)}
    gates = {name: _Judged(judge) for name, judge in run.judges.items()}

    def on_fix(name: str, made: Replayed) -> None:
        truth_m, judged = run.judges[name].newest_truth_m, gates[name].is_new()
        recorder.add(numbers[name], made.unix_s, made.fix, truth_m, judged=judged)

    reports = run.run(on_fix, lambda done_s: progress(min(max(done_s / span_s, 0.0), 1.0)))
    progress(1.0)
    by_tag: dict[str, ReplayReport] = {report.tag: report for report in reports}
    return ReplayResult(path, by_tag, recorder.fixes(), "from the site", summary_of(reports))


class _Judged:
    """Whether a judge has counted one more error since it was asked last."""

    def __init__(self, judge: Judge) -> None:
        self._judge = judge
        self._count = 0

    def is_new(self) -> bool:
        before, self._count = self._count, self._judge.judged
        return self._count > before


# From what programs have to what a replay and a calibration take


def anchors_given(anchors: Anchors | None, site: AnySite | None) -> tuple[dict[int, Point], float | None]:
    """Positions of the anchors, and the tags' height where a site states it. Raises SkylessError."""
    if anchors is not None and site is not None:
        raise SkylessError("give either anchors or site, not both")
    if site is not None:
        return anchors_of_site(site_of(site)[0])
    if anchors is None:
        return {}, None
    if not isinstance(anchors, Mapping):
        return read_anchors(existing_file("anchors", anchors)), None
    anchors_m: dict[int, Point] = {}
    for identifier, position_m in anchors.items():
        if not isinstance(identifier, int) or identifier < 0:
            raise wrong("anchors", identifier, "positions by identifiers, which are whole numbers")
        check_point(f"anchors[{identifier}]", position_m, (3,))
        x_m, y_m, z_m = map(float, position_m)
        anchors_m[identifier] = (x_m, y_m, z_m)
    return anchors_m, None


def truth_given(
    file: Path,
    truth: AnyTruth | None,
    lever_arm_m: tuple[float, float, float] | None,
    format_name: str | None,
    listener: str | None,
) -> Truth | None:
    """Where the antenna was, by an array, a table, or the recording itself. Raises SkylessError."""
    if lever_arm_m is not None:
        check_point("lever_arm_m", lever_arm_m, (3,))
    if truth is None or isinstance(truth, str | Path):
        table = None if truth is None else existing_file("truth", truth)
        return known_truth(file, table, lever_arm_m, format_name, listener)
    right = "an array of shape (n, 4), n at least 1: time in s, which does not decrease, x, y, z in metres, all finite"
    try:
        rows = np.array(truth, dtype=np.float64)
    except (TypeError, ValueError):
        raise wrong("truth", truth, right) from None
    is_table = rows.ndim == 2 and rows.shape[1] == 4 and len(rows) > 0
    if not (is_table and np.isfinite(rows).all() and (np.diff(rows[:, 0]) >= 0.0).all()):
        raise SkylessError(f"truth is an array of shape {rows.shape}; it should be {right}")
    known = Truth(rows[:, 0], rows[:, 1:], None)
    return known if lever_arm_m is None else antenna_truth(known, lever_arm_m)
