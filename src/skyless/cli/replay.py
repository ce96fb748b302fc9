"""``skyless replay``: a recording becomes fixes, and is judged against the truth where there is one."""

import csv
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from cyclopts import App

from skyless.arguments import process_noise
from skyless.cli.common.options import (
    Finite,
    IntegrityRisk,
    NotNegative,
    Positive,
    ProtectionOptions,
    check_left_out,
    check_method,
    check_output,
    check_picture,
    options,
)
from skyless.cli.common.output import NO_FIX, new_table, number, print_facts, print_json, print_warnings
from skyless.cli.common.progress import loading_kernels, progress_bar
from skyless.cli.common.recording_inputs import is_mcap, lever_arm, wished_height
from skyless.errors import SkylessError
from skyless.method_names import DEFAULT_METHOD, SNAPSHOTS, Dynamics

if TYPE_CHECKING:
    from skyless.evaluation.judge import Judge
    from skyless.positioning.fix import Fix
    from skyless.replays.captures import Replay, ReplayReport
    from skyless.replays.site import SiteReplay, TagReport

FIXES_COLUMNS: Final = (
    *("t_s", "x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps"),
    *("cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2"),
    *("anchors", "anchor_ids", "chi2", "residual_rms_m"),
    *("hpl_m", "vpl_m", "integrity_risk", "alert"),
)
"""Columns of the file that --fixes-csv writes."""

_MANY_UNKNOWN: Final = 0.5
"""Share of a recording from unknown anchors that is warned of."""

_FEW_MEMBERS: Final = 0.8
"""Mean number of a snapshot's anchors over the largest, below which it is warned of."""

_MOST_DROPS: Final = 3
"""Reasons for drops that are named when there is no fix."""

app = App(
    name="replay",
    help_epilogue="Example: skyless replay flight_tdoa.csv.gz --anchors anchors.csv --truth flight_pose.csv.gz --json",
)


@options
class _OtherProtection(ProtectionOptions):
    """What is required of protection levels, instead of what the tag did."""

    integrity_risk: IntegrityRisk | None = None
    """Probability, for each fix, that the error exceeds its protection level, in recordings of skyless record (joint);
    by default the tag's own."""
    alert_limit_m: Positive | None = None
    """Fixes whose protection level exceeds this, in metres, carry an alert; by default the tag's own limit holds."""
    max_acceleration: NotNegative | None = None
    """The largest acceleration of the tags in m/s²; by default what the tag assumed. With any of these, or
    --tag-height-std, tags start from the beginning, as with another method, and those that are not given are as of
    a tag of which nothing was asked."""


@options
class ReplayOptions:
    """Options of ``skyless replay``."""

    anchors: Path | None = None
    """Table of anchors: id,x_m,y_m,z_m, with bias_m where skyless calibrate has been; that is then taken off."""
    site: Path | None = None
    """Site file instead of --anchors, for its anchors and its tags' height. With a recording of skyless record:
    replay as if its anchors had had the antenna delays of this file, as skyless calibrate writes them."""
    truth: Path | None = None
    """Table of true positions: t_s,x_m,y_m,z_m, with qx,qy,qz,qw if the body turns. MILUV ticks bring their own."""
    lever_arm: str | None = None
    """The antenna in the body's frame, x,y,z in metres, added to the truth."""
    tag_height: str = "auto"
    """The tags' height: metres, truth (its median), free (estimated), or auto: free where the anchors determine it."""
    tag_height_std: NotNegative | None = None
    """Standard deviation of the tag's height from the one that is given, in metres, which fixes and levels then
    count; by default 0.5 where the height is only taken for the anchors', else 0."""
    format: str | None = None
    """Name of the format, if the content should not decide."""
    listener: str | None = None
    """Which receiver, in recordings with several."""
    settle: NotNegative | None = None
    """Seconds from the start that are not judged; by default 3 with a truth table, 2 without."""
    above: Finite | None = None
    """Judge only while the true height exceeds this; by default 0.3 m for a table of differences that starts below
    it and later flies, as tags on the floor hear reflections only."""
    qa: Positive | None = None
    """Process noise that the filter assumes: spectral density of the acceleration, m²/s³."""
    dynamics: Dynamics | None = None
    """How tags move: walk (as people), robot or drone, which sets the process noise instead of --qa."""
    tdoa_std: Positive | None = None
    """Noise of what is new in a time difference, metres."""
    uncalibrated: bool = False
    """Leave out the calibration that the table of anchors holds."""
    tag: str | None = None
    """Name of the tag, in recordings of skyless record; by default all."""
    method: str | None = None
    """How positions are computed, in recordings of skyless record; by default as the tag did."""
    measurements: str | None = None
    """What the filter is given of other recordings: packets, as anchors sent them, which is the default for
    Bitcraze's and FiRa's; or differences, which are made of them."""
    protection: _OtherProtection = _OtherProtection()
    fixes_csv: Path | None = None
    """Write every fix into this table."""
    plot: Path | None = None
    """Draw the picture into this file (PNG, SVG or PDF): track, errors and histograms."""
    json: bool = False
    """Write one JSON object instead of the table."""


@app.default
def replay(file: Path, /, *, asked: ReplayOptions = ReplayOptions()) -> int:
    """Turn a recording into fixes; judge them where the truth is known.

    Reads recordings of skyless record (MCAP), Bitcraze sniffer captures (YAML, binary, text; TDoA2 and TDoA3), FiRa
    UCI logs (binary, text) and phones' records (JSON) of DL-TDoA, tables of time differences, MILUV passive ticks and
    Avalue receptions; the format is recognised by the content.

    A recording of skyless record knows its site and truth and gives the very fixes that the tags gave; of the options
    below it takes --site, --tag, --method, --integrity-risk, --alert-limit-m, --max-acceleration, --tag-height-std,
    --settle, --above, --fixes-csv, --plot and --json.

    Ends with exit code 1 if there is no fix at all, and names the likely reason.

    Parameters
    ----------
    file
        The recording, plain or gzip.
    """
    check_output("fixes-csv", asked.fixes_csv, file, asked.anchors, asked.site, asked.truth)
    check_output("plot", asked.plot, file, asked.anchors, asked.site, asked.truth, asked.fixes_csv)
    check_picture(asked.plot)
    reports: Sequence[ReplayReport] = _replay_site(file, asked) if is_mcap(file) else [_replay_foreign(file, asked)]
    for report in reports:
        _warn_of_unknown(report)
    if any(report.fixes for report in reports):
        return 0
    print(f"skyless: no fix: {_likely_reason(reports[0], asked)}", file=sys.stderr)
    return NO_FIX


_REASONS: Final = {
    "no-beacons": "the recording holds no reception that can be used",
    "no-almanac": "no reception is of an anchor in the table or site file; are these this recording's anchors?",
    "too-few-anchors": "too few anchors were received at a time: three at a known height, four without",
    "bad-geometry": "the anchors lie too flat to determine the position; --tag-height gives the height",
    "mirror-ambiguity": "the anchors leave two positions that fit as well; --tag-height gives the height",
    "residuals-too-large": "the receptions contradict the anchors' positions; is the table right?",
    "acquiring": "the recording is too short, or its receptions contradict the anchors' positions; is the table right?",
}
"""Why a recording gives no fix, by the reason that the filter gave last."""


def _warn_of_unknown(report: "ReplayReport") -> None:
    """Warn where fixes are of the lesser part of a recording."""
    unknown = report.drops.get("unknown-anchor", 0)
    if report.fixes and unknown >= _MANY_UNKNOWN * report.receptions:
        share = f"{unknown} of {report.receptions} receptions ({unknown / report.receptions:.0%})"
        _warn(f"{share} are of anchors that the table or site file does not have; is it that of this recording?")


def _warn_of_few_members(report: "TagReport") -> None:
    """Warn where a method that needs whole superframes was given parts of them."""
    mean, most = report.mean_anchors, report.most_anchors
    if report.method in SNAPSHOTS and mean is not None and mean < _FEW_MEMBERS * most:
        _warn(
            f"{report.tag}: {report.method} had {mean:.1f} anchors of a superframe on average, of {most} at best, as "
            "beacons are missing; errors are larger for it. joint (--method joint) uses every beacon that was received"
        )


def _warn(text: str) -> None:
    print(f"skyless: warning: {text}", file=sys.stderr)


def _likely_reason(report: "ReplayReport", asked: ReplayOptions) -> str:
    if report.receptions == 0:
        found = "the recording holds no reception that can be used"
    elif asked.anchors is None and asked.site is None and report.reason == "no-almanac":
        found = "no message of the recording says where its anchors are"
    else:
        found = _REASONS.get(report.reason or "", report.reason or "unknown")
    drops = sorted(report.drops.items(), key=lambda item: -item[1])[:_MOST_DROPS]
    return found + (f" (dropped: {', '.join(f'{count} × {name}' for name, count in drops)})" if drops else "")


# Recordings of other systems


def _replay_foreign(file: Path, asked: ReplayOptions) -> "ReplayReport":
    """Replay a recording that another program made. Raises SkylessError."""
    from skyless.recordings.anchor_table import read_calibration
    from skyless.replays.capture_run import CaptureRequest, CaptureRun
    from skyless.replays.inputs import TOO_FLAT, known_anchors, known_truth

    protection = asked.protection
    of_sites = {
        "tag": asked.tag, "method": asked.method, "integrity-risk": protection.integrity_risk,
        "alert-limit-m": protection.alert_limit_m, "max-acceleration": protection.max_acceleration,
    }  # fmt: skip
    check_left_out(of_sites, "it is for recordings of skyless record")
    anchors_m, site_height_m = known_anchors(asked.anchors, asked.site)
    run = CaptureRun(
        CaptureRequest(
            path=file,
            anchors_m=anchors_m,
            site_height_m=site_height_m,
            truth=known_truth(file, asked.truth, lever_arm(asked.lever_arm), asked.format, asked.listener),
            tag_height=wished_height(asked.tag_height),
            tag_height_std_m=asked.tag_height_std,
            settle_s=asked.settle,
            above_m=asked.above,
            qa=process_noise(asked.qa, asked.dynamics),
            tdoa_std_m=asked.tdoa_std,
            calibration=None if asked.anchors is None or asked.uncalibrated else read_calibration(asked.anchors),
            measurements=asked.measurements,
            format=asked.format,
            listener=asked.listener,
        )
    )
    report = _run_foreign(run.replay, file, asked.fixes_csv)
    run.check(report, asked.truth)
    summary = run.summary(report)
    if asked.plot is not None:
        _draw_track(asked.plot, run.judge, report)
    if asked.json:
        print_json(summary)
    else:
        more = " (--tag-height free estimates it all the same)" if run.height_note == TOO_FLAT else ""
        _show(report, run.height_note + more, summary["anchor_distances_m"])
    return report


def _run_foreign(run: "Replay", file: Path, fixes: Path | None) -> "ReplayReport":
    from skyless.evaluation.compile_ahead import compile_packet_kernels, compile_pair_kernels
    from skyless.preparation.parts import PAIRS, SNIFFERS

    with loading_kernels(*(SNIFFERS if run.measurements == "packets" else (PAIRS,))):
        if run.measurements == "packets":
            compile_packet_kernels()
        else:
            compile_pair_kernels()
    with progress_bar("replaying", file.stat().st_size) as bar, _table_of_fixes(fixes, FIXES_COLUMNS) as write:
        return run.run(None if write is None else lambda fix: write(_row(fix)), bar.reach)


# Recordings of skyless record


def _replay_site(file: Path, asked: ReplayOptions) -> "list[TagReport]":
    """Replay all tags of a recording of skyless record, or one. Raises SkylessError."""
    from skyless.recordings.mcap.recording import McapRecording
    from skyless.replays.site import SiteReplay, summary_of
    from skyless.site.load import load_site

    useless = {
        "anchors": asked.anchors, "truth": asked.truth, "lever-arm": asked.lever_arm, "format": asked.format,
        "listener": asked.listener, "qa": asked.qa, "dynamics": asked.dynamics, "tdoa-std": asked.tdoa_std,
        "measurements": asked.measurements, "tag-height": None if asked.tag_height == "auto" else asked.tag_height,
        "uncalibrated": asked.uncalibrated or None,
    }  # fmt: skip
    check_left_out(useless, "a recording of skyless record brings its own")
    required = None
    if asked.protection.given or asked.tag_height_std is not None:
        required = asked.protection.requirement(asked.method, asked.tag_height_std)
    if asked.method is not None:
        check_method(asked.method)
    with McapRecording(file) as recording:
        tags = None if asked.tag is None else (asked.tag,)
        settle_s = 2.0 if asked.settle is None else asked.settle
        wanted = None if asked.site is None else load_site(asked.site)
        run = SiteReplay(recording, tags, asked.method, settle_s, asked.above, wanted, required)
        if asked.plot is not None and len(run.tags) > 1:
            raise SkylessError(f"--plot draws one tag; choose it with --tag, one of {', '.join(run.tags)}")
        summary = recording.summary()
        span_s = (summary.end_s or 0.0) - (summary.start_s or 0.0)
        reports = _run_site(run, span_s, asked)
    if asked.plot is not None:
        _draw_track(asked.plot, run.judges[reports[0].tag], reports[0])
    for report in reports:
        _warn_of_few_members(report)
    if asked.json:
        print_json(summary_of(reports))
    else:
        for report in reports:
            _show(report, "from the site", {}, _site_facts(report))
        if not summary.finished:
            print_warnings([f"{file} has no end: it was cut off, or is still being written; later fixes are missing"])
    return reports


def _run_site(run: "SiteReplay", span_s: float, asked: ReplayOptions) -> "list[TagReport]":
    """The table of fixes has the tag's name at the end of each row; its ``t_s`` is Unix time."""
    from skyless.evaluation.compile_ahead import compile_kernels
    from skyless.preparation.parts import parts_of

    method = asked.method or DEFAULT_METHOD
    with loading_kernels(*parts_of(method)):
        compile_kernels(method)
    with progress_bar("replaying", span_s) as bar, _table_of_fixes(asked.fixes_csv, (*FIXES_COLUMNS, "tag")) as write:
        if write is None:
            return run.run(None, bar.reach)
        return run.run(lambda tag, made: write((f"{made.unix_s:.6f}", *_row(made.fix)[1:], tag)), bar.reach)


def _site_facts(report: "TagReport") -> list[tuple[str, str]]:
    """What only the replay of a site reports."""
    found = report.identical
    if found is None:
        same = "–"
    elif found.compared == 0:
        same = "nothing to compare"
    elif found.different == 0:
        same = f"identical, all {found.compared} of them"
    else:
        same = f"{found.different} of {found.compared} differ"
    started = "as the tag was" if report.cold_starts == 0 else f"{report.cold_starts} of {report.segments} cold"
    return [("tag", report.tag), ("recorded fixes", same), ("starts", started)]


# Tables and pictures


@contextmanager
def _table_of_fixes(path: Path | None, columns: tuple[str, ...]) -> Iterator[Callable[[Sequence[str]], None] | None]:
    """A function that writes a row of the table; None where none is asked for. Raises SkylessError."""
    if path is None:
        yield None
        return
    with new_table(path) as file:
        writer = csv.writer(file)
        writer.writerow(columns)

        def write(row: Sequence[str]) -> None:
            writer.writerow(row)

        yield write


def _row(fix: "Fix") -> list[str]:
    """A fix as a row of ``FIXES_COLUMNS``."""
    velocity = ("", "", "") if fix.velocity_mps is None else (f"{value:.5g}" for value in fix.velocity_mps)
    covariance = fix.covariance_m2[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return [
        f"{fix.time_s:.6f}",
        *(f"{value:.5f}" for value in fix.position_m),
        *velocity,
        *(f"{value:.5g}" for value in covariance),
        str(len(fix.anchors)),
        " ".join(map(str, fix.anchors)),
        f"{fix.chi2:.4g}",
        f"{fix.residual_rms_m:.4g}",
        *("" if level is None else f"{level:.4g}" for level in (fix.hpl_m, fix.vpl_m, fix.integrity_risk)),
        fix.alert or "",
    ]


def _draw_track(path: Path, judge: "Judge", report: "ReplayReport") -> None:
    """Draw what --plot asks for. Raises SkylessError."""
    from skyless.replays.plot import draw

    try:
        draw(path, judge.track.rows, f"{report.format}, {report.fixes} fixes")
    except (OSError, ValueError) as error:
        raise SkylessError(f"{path} cannot be drawn: {error}") from None


def _show(report: "ReplayReport", note: str, distances: dict[str, float], more: Sequence[tuple[str, str]] = ()) -> None:
    """Show a replay as a table; ``note`` says where the height is from, ``more`` comes first."""
    from skyless.evaluation.statistics import dimensions

    fixes = str(report.fixes) if report.reason is None else f"none: {report.reason}"
    of_all = dimensions(planar=report.rmse_3d_m is None)
    truth_known = any(pair.against_truth for pair in report.pairs)
    facts = [
        *more,
        ("fixes", fixes),
        ("method", f"{report.method}" + ("" if report.measurements is None else f", given {report.measurements}")),
        ("rate", number(report.rate_hz, "{:.1f} Hz")),
        ("height", note if report.height_m is None else f"{report.height_m:.3f} m, {note}"),
        ("median position", _triple(report.median_m)),
        ("scatter of the fixes", _triple(report.std_m)),
        # without truth, the tag's own motion is in it
        ("noise of a difference" if truth_known else "scatter of a difference", _metres(report.tdoa_noise_m)),
        ("RMSE 2-D", _metres(report.rmse_2d_m)),
        ("RMSE 3-D", _metres(report.rmse_3d_m)),
        (f"95 % {of_all}", _metres(report.p95_m)),
        (f"largest error {of_all}", _metres(report.max_m)),
        ("speed", f"{report.receptions_per_s:,.0f} receptions/s"),
    ]
    facts += [(f"dropped: {reason}", str(count)) for reason, count in report.drops.items()]
    for pair, by_m in report.contradictions_m.items():
        nearer = "nearer" if by_m < 0.0 else "farther"
        facts.append((f"anchors {pair}", f"range each other {abs(by_m):.2f} m {nearer} than the table has them"))
    facts += [(f"distance {pair}", _metres(metres)) for pair, metres in distances.items()]
    print_facts(f"{report.format}: {report.receptions} receptions", facts)


def _metres(value: float | None) -> str:
    return number(value, "{:.3f} m")


def _triple(values: tuple[float, float, float] | None) -> str:
    return "–" if values is None else ", ".join(f"{value:.3f}" for value in values) + " m"
