"""``skyless replay``: a recording becomes fixes, and is judged against the truth where there is one."""

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

from skyless.cli.common.options import (
    Finite,
    IntegrityRisk,
    NotNegative,
    Positive,
    integrity_of,
    see_that_a_height_is_given,
    spare_inputs,
)
from skyless.cli.common.output import print_json
from skyless.cli.common.progress import progress_bar, status
from skyless.cli.replay_input import flight_height, height_to_hold, known_anchors, known_truth
from skyless.cli.replay_output import check_plot_path, draw_track, fix_writer, show
from skyless.cli.replay_site import Options, is_mcap, replay_site, see_that_they_are_left_out
from skyless.errors import ConfigurationError, SkylessError

if TYPE_CHECKING:
    from skyless.evaluation.judge import Judge
    from skyless.recordings.truth import Truth
    from skyless.replay.captures import Replay, ReplayReport

app = App(
    name="replay",
    help_epilogue="Example: skyless replay flight_tdoa.csv.gz --anchors anchors.csv --truth flight_pose.csv.gz --json",
)


@app.default
def replay(
    file: Path,
    /,
    *,
    anchors: Path | None = None,
    site: Path | None = None,
    truth: Path | None = None,
    lever_arm: str | None = None,
    height: str = "auto",
    height_std: NotNegative | None = None,
    format: str | None = None,  # noqa: A002 - the option's natural name
    listener: str | None = None,
    settle: NotNegative | None = None,
    above: Finite | None = None,
    qa: Positive | None = None,
    tdoa_std: Positive | None = None,
    uncalibrated: bool = False,
    tag: str | None = None,
    method: str | None = None,
    measurements: str | None = None,
    integrity_risk: IntegrityRisk | None = None,
    alert_limit_m: Positive | None = None,
    max_acceleration: NotNegative | None = None,
    fixes: Path | None = None,
    plot: Path | None = None,
    json: bool = False,
) -> None:
    """Turn a recording into fixes; judge them where the truth is known.

    Reads recordings of skyless record (MCAP), Bitcraze sniffer captures (YAML, binary, text; TDoA2 and TDoA3), tables
    of time differences, MILUV passive ticks and Avalue receptions; the format is recognised by the content.

    A recording of skyless record knows its site and truth and gives the very fixes that the tags gave; of the options
    below it takes --site, --tag, --method, --integrity-risk, --alert-limit-m, --max-acceleration, --height-std,
    --settle, --above, --fixes, --plot and --json.

    Parameters
    ----------
    file
        The recording, plain or gzip.
    anchors
        Table of anchors: id,x_m,y_m,z_m, with bias_m where skyless calibrate has been; that is then taken off.
    site
        A site file instead, for its anchors and its tags' height. With a recording of skyless record: replay as if
        its anchors had had the antenna delays of this file, as skyless calibrate writes them.
    truth
        Table of true positions: t_s,x_m,y_m,z_m, with qx,qy,qz,qw if the body turns. MILUV ticks bring their own.
    lever_arm
        The antenna in the body's frame, x,y,z in metres, added to the truth.
    height
        The tag's height: metres, truth (its median), free (estimated), or auto: free where the anchors can tell it.
    height_std
        Standard deviation of the tag's height from the one that is given, in metres, which fixes and levels then
        count; by default 0.5 where the height is only taken for the anchors', else 0.
    format
        Name of the format, if the content should not decide.
    listener
        Whose ears, in recordings with several listeners.
    settle
        Seconds from the start that are not judged; by default 3 with a truth table, 2 without.
    above
        Judge only while the true height exceeds this; by default 0.3 m for a table of differences that starts below
        it and later flies, as tags on the floor hear reflections only.
    qa
        Agility that the filter assumes, m²/s³.
    tdoa_std
        Noise of what is new in a time difference, metres.
    uncalibrated
        Leave out the calibration that the table of anchors holds.
    tag
        Name of the tag, in recordings of skyless record; by default all.
    method
        Another method than the tag's own, in recordings of skyless record.
    measurements
        What the filter is given of other recordings: packets, as anchors sent them, which is the default for
        Bitcraze's; or differences, which are made of them.
    integrity_risk
        Another probability than the tag's own that an error exceeds its protection level, in recordings of skyless
        record (joint).
    alert_limit_m
        Another alert limit than the tag's own, in metres.
    max_acceleration
        Another largest acceleration than the tag's own, in m/s². With any of these, or --height-std, tags begin anew,
        as with another method, and those that are not given are as of a tag of which nothing was asked.
    fixes
        Write every fix into this table.
    plot
        Draw track, errors and histograms into this PNG, SVG or PDF.
    json
        Write one JSON object instead of the table.
    """
    from skyless.evaluation.judge import Judge
    from skyless.recordings.anchor_table import read_calibration
    from skyless.recordings.foreign.formats import format_of
    from skyless.replay.captures import MEASUREMENTS, Replay, ReplayRequest

    spare_inputs("fixes", fixes, file, anchors, site, truth)
    spare_inputs("plot", plot, file, anchors, site, truth, fixes)
    check_plot_path(plot)
    if is_mcap(file):
        useless = {
            "--anchors": anchors, "--truth": truth, "--lever-arm": lever_arm, "--format": format,
            "--listener": listener, "--qa": qa, "--tdoa-std": tdoa_std,
            "--measurements": measurements,
            "--height": None if height == "auto" else height, "--uncalibrated": uncalibrated or None,
        }  # fmt: skip
        see_that_they_are_left_out(useless, "a recording of skyless record brings its own")
        asked = None
        if (integrity_risk, alert_limit_m, max_acceleration, height_std) != (None,) * 4:
            asked = integrity_of(integrity_risk, alert_limit_m, max_acceleration, method, height_std)
        replay_site(file, Options(tag, method, asked, settle, above, site, fixes, plot, json))
        return
    of_sites = {
        "--tag": tag, "--method": method, "--integrity-risk": integrity_risk, "--alert-limit-m": alert_limit_m,
        "--max-acceleration": max_acceleration,
    }  # fmt: skip
    see_that_they_are_left_out(of_sites, "it is for recordings of skyless record")
    if measurements not in {None, *MEASUREMENTS}:
        raise SkylessError(f"--measurements is {measurements!r}; it should be one of {', '.join(MEASUREMENTS)}")
    places, site_height_m = known_anchors(anchors, site)
    known = known_truth(file, truth, lever_arm, format, listener)
    height_m, std_m, note = height_to_hold(height, places, site_height_m, known, format_of(file, format).name)
    settle_s = settle if settle is not None else (2.0 if known is None else 3.0)
    see_that_a_height_is_given(height_std, height_m)
    judge = Judge(known, planar=height_m is not None, settle_s=settle_s, above_m=flight_height(above, known))
    request = ReplayRequest(
        path=file,
        anchors_m=places,
        format=format,
        listener=listener,
        height_m=height_m,
        height_std_m=std_m if height_std is None else height_std,
        qa=qa,
        tdoa_std_m=tdoa_std,
        calibration=None if anchors is None or uncalibrated else read_calibration(anchors),
        measurements=measurements,
    )
    report = _run(Replay(request, judge), file, fixes)
    _see_that_it_was_heard(file, listener, report)
    if truth is not None and known is not None:
        _see_that_truth_matches(truth, known, judge)
    distances = _distances(file, report.format)
    if plot is not None:
        draw_track(plot, judge, report)
    if json:
        import msgspec

        print_json({**msgspec.to_builtins(report), "height_note": note, "anchor_distances_m": distances})
    else:
        show(report, note, distances)


def _see_that_it_was_heard(file: Path, listener: str | None, report: "ReplayReport") -> None:
    if listener is not None and report.receptions == 0:
        raise ConfigurationError(file, "listener", listener, "one that the recording names")


def _see_that_truth_matches(table: Path, truth: "Truth", judge: "Judge") -> None:
    """Fixes without any truth beside them mean that the table belongs to another recording, or to another clock."""
    import numpy as np

    times_s, true_x_m = judge.track.rows[:, 0], judge.track.rows[:, 4]
    if len(times_s) and np.isnan(true_x_m).all():
        span = f"{truth.t_s[0]:.3f} to {truth.t_s[-1]:.3f}"
        expected = f"in the time of the recording, whose fixes are from {times_s.min():.3f} to {times_s.max():.3f}"
        raise ConfigurationError(table, "column t_s", span, expected)


def _run(run: "Replay", file: Path, fixes: Path | None) -> "ReplayReport":
    from skyless.evaluation.compile_ahead import compile_packet_kernels, compile_pair_kernels

    with status("loading the kernels; the first start compiles them, which takes some ten seconds"):
        if run.measurements == "packets":
            compile_packet_kernels()
        else:
            compile_pair_kernels()
    with ExitStack() as stack:
        bar = stack.enter_context(progress_bar("replaying", file.stat().st_size))
        on_fix = None if fixes is None else fix_writer(stack, fixes)
        return run.run(on_fix, bar.reach)


def _distances(file: Path, name: str) -> dict[str, float]:
    """Distances of the anchors, where the recording itself measures them."""
    if name != "avalue":
        return {}
    from collections import Counter

    from skyless.recordings.foreign.avalue import anchor_distances_m

    return {f"{a:X}-{b:X}": metres for (a, b), metres in sorted(anchor_distances_m(file, Counter()).items())}
