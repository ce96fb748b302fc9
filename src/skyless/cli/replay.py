"""``skyless replay``: turn a recording into fixes, judged against the truth if there is one."""

import csv
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from cyclopts import App
from msgspec.structs import replace

from skyless.arguments import existing_file
from skyless.cli.common import (
    NO_FIX,
    USER_ERROR,
    JsonOptions,
    check_output,
    check_picture,
    command,
    dropped,
    new_table,
    print_facts,
    print_json,
    print_warnings,
    progress_bar,
    write_picture,
)
from skyless.core.errors import SkylessError
from skyless.core.method_names import METHODS, SNAPSHOTS
from skyless.research.replays.options import ReplayOptions

if TYPE_CHECKING:
    from skyless.core.fix import Fix
    from skyless.research.replays.captures import OnFix, ReplayReport

FIXES_COLUMNS: Final = (
    *("t_s", "x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps"),
    *("cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2"),
    *("anchors", "anchor_ids", "chi2", "residual_rms_m"),
    *("hpl_m", "vpl_m", "integrity_risk", "alert"),
)
"""Columns of the file that --fixes-csv writes; for a recording of skyless record ``tag`` is added."""

_MANY_UNKNOWN: Final = 0.5
"""Warn if at least this share of a recording is from unknown anchors."""

_FEW_MEMBERS: Final = 0.8
"""Warn if the mean number of anchors in a snapshot is below this share of the largest."""

app = App(
    name="replay",
    help_epilogue="Example: skyless replay flight_tdoa.csv.gz --anchors anchors.csv --truth flight_pose.csv.gz --json",
)


class _Output(JsonOptions, frozen=True, kw_only=True):
    fixes_csv: Path | None = None
    """Write every fix into this table."""
    plot: Path | None = None
    """Draw the picture into this file (PNG, SVG or PDF): track, errors and histograms."""


@app.default
@command
def replay(asked: ReplayOptions, *more: Path, output: _Output) -> int:
    """Turn a recording, or each of several, into fixes; judge them where the truth is known.

    Reads recordings of skyless record (MCAP), Bitcraze sniffer captures (YAML, binary, text; TDoA2 and TDoA3), FiRa
    UCI logs (binary, text) and phones' records (JSON) of DL-TDoA, tables of time differences, MILUV passive ticks,
    Avalue receptions, and recordings of MULoc and STARLOC; the format is recognised by the content.

    A recording of skyless record knows its site and truth and gives the very fixes that the tags gave; of the options
    below it takes --site, --tag, --method, --integrity-risk, --alert-limit-m, --tag-height-std,
    --settle, --above, --fixes-csv, --plot and --json.

    Of several recordings each has its own report, and --json writes one line with all of them, under recordings; one
    that cannot be replayed is named, and the others still are.

    Ends with exit code 1 if a recording gives no fix at all, and names the likely reason; with 2 if one cannot be
    replayed.
    """
    if not more:
        code, summary = _replayed(asked, output)
        if output.json:
            print_json(summary)
        return code
    output.leave_out("fixes_csv", "plot", why="it is one file, and there are several recordings")
    for file in more:
        existing_file("FILE", file)
    codes, summaries = [], []
    for one in (asked.file, *more):
        try:
            code, summary = _replayed(replace(asked, file=one), output, f"{one}: ")
        except (SkylessError, OSError) as error:
            named = "" if str(one) in str(error) else f"{one}: "
            print(f"skyless: {named}{error}", file=sys.stderr)
            code, summary = USER_ERROR, {"error": str(error)}
        codes.append(code)
        summaries.append({"file": one, **summary})
    if output.json:
        print_json({"recordings": summaries})
    return max(codes)


def _replayed(asked: ReplayOptions, output: _Output, name: str = "") -> tuple[int, dict[str, Any]]:
    """Replay one recording; ``name`` prefixes its reports. Returns the exit code, and the object for --json."""
    inputs = [path for path in (asked.file, asked.anchors, asked.site, asked.truth) if isinstance(path, Path)]
    check_output("fixes-csv", output.fixes_csv, *inputs)
    check_output("plot", output.plot, *inputs, output.fixes_csv)
    check_picture(output.plot)
    from skyless.cli.api.replay import replay_recording
    from skyless.research.foreign.formats import format_of

    with ExitStack() as until_done:
        reach = until_done.enter_context(progress_bar("replaying"))

        def begin(tags: tuple[str, ...], given: str) -> "OnFix | None":
            if output.plot is not None and len(tags) > 1:
                raise SkylessError(f"--plot draws one tag; choose it with --tag, one of {', '.join(tags)}")
            if output.fixes_csv is None:
                return None
            write = csv.writer(until_done.enter_context(new_table(output.fixes_csv))).writerow
            of_site = given in METHODS
            write((*FIXES_COLUMNS, "tag") if of_site else FIXES_COLUMNS)
            name = str if of_site else format_of(asked.file, asked.format).anchor_name
            return lambda tag, time_s, fix: write([*_row(time_s, fix, name), *([tag] if of_site else [])])

        result = replay_recording(replace(asked, progress=reach), begin)
    if output.plot is not None:
        write_picture(output.plot, result.plot())
    for tag, report in result.reports.items():
        _warn_of_few_members(f"{name}{tag}", report)
    if not output.json:
        for tag, report in result.reports.items():
            print_facts(f"{name}{report.format}: {report.receptions} receptions", result.facts_of(tag))
        print_warnings(result.warnings)
    reports = list(result.reports.values())
    for report in reports:
        _warn_of_unknown(name, report)
    if any(report.fixes for report in reports):
        return 0, result.summary
    print(f"skyless: {name}no fix: {_likely_reason(reports[0], asked)}", file=sys.stderr)
    return NO_FIX, result.summary


_REASONS: Final = {
    "no-beacons": "the recording holds no reception that can be used",
    "no-almanac": "no reception is of an anchor in the table or site file; are these this recording's anchors?",
    "too-few-anchors": "too few anchors were received at a time: three at a known height, four without",
    "bad-geometry": "the anchors lie too flat to determine the position; --tag-height gives the height",
    "mirror-ambiguity": "the anchors leave two positions that fit as well; --tag-height gives the height",
    "residuals-too-large": "the receptions contradict the anchors' positions; is the table right?",
    "acquiring": "the recording is too short, or its receptions contradict the anchors' positions; is the table right?",
}
"""Why a recording gives no fix, by the filter's last reason."""


def _warn_of_unknown(name: str, report: "ReplayReport") -> None:
    unknown = report.drops.get("unknown-anchor", 0)
    if report.fixes and unknown >= _MANY_UNKNOWN * report.receptions:
        share = f"{unknown} of {report.receptions} receptions ({unknown / report.receptions:.0%})"
        _warn(
            f"{name}{share} are of anchors that the table or site file does not have; does it belong to this recording?"
        )


def _warn_of_few_members(tag: str, report: "ReplayReport") -> None:
    """Warn if a method that needs whole superframes got only parts of them."""
    if report.method not in SNAPSHOTS:
        return
    from skyless.research.replays.site import TagReport

    assert isinstance(report, TagReport)
    mean, most = report.mean_anchors, report.most_anchors
    if mean is not None and mean < _FEW_MEMBERS * most:
        _warn(
            f"{tag}: {report.method} had {mean:.1f} anchors of a superframe on average, of {most} at best, as "
            "beacons are missing; errors are larger for it. joint (--method joint) uses every beacon that was received"
        )


def _warn(text: str) -> None:
    print(f"skyless: warning: {text}", file=sys.stderr)


def _likely_reason(report: "ReplayReport", asked: ReplayOptions) -> str:
    if report.receptions == 0:
        found = "the recording holds no reception that can be used"
    elif asked.anchors is None and asked.site is None and report.reason == "no-almanac":
        from skyless.research.foreign.formats import format_of
        from skyless.research.replays.captures import how_to_find_anchors

        found = "no message of the recording says where its anchors are"
        found += how_to_find_anchors(asked.file, format_of(asked.file, asked.format))
    else:
        found = "; ".join((_REASONS.get(report.reason or "", report.reason or "unknown"), *report.notes))
    return found + (f" ({dropped(report.drops)})" if report.drops else "")


def _row(time_s: float, fix: "Fix", name: Callable[[int], str]) -> list[str]:
    """A fix as a row of ``FIXES_COLUMNS``; ``name`` is that of an anchor."""
    velocity = ("", "", "") if fix.velocity_mps is None else (f"{value:.5g}" for value in fix.velocity_mps)
    covariance = fix.covariance_m2[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return [
        f"{time_s:.6f}",
        *(f"{value:.5f}" for value in fix.position_m),
        *velocity,
        *(f"{value:.5g}" for value in covariance),
        str(len(fix.anchors)),
        " ".join(map(name, fix.anchors)),
        f"{fix.chi2:.4g}",
        f"{fix.residual_rms_m:.4g}",
        *("" if level is None else f"{level:.4g}" for level in (fix.hpl_m, fix.vpl_m, fix.integrity_risk)),
        fix.alert or "",
    ]
