"""What ``skyless replay`` writes: a table of fixes row by row, and the report for people."""

import csv
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from skyless.cli.common.options import open_for_writing
from skyless.cli.common.output import console
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from skyless.evaluation.judge import Judge
    from skyless.positioning.fix import Fix
    from skyless.replay.captures import ReplayReport

PICTURES = (".png", ".svg", ".pdf")

COLUMNS = (
    *("t_s", "x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps"),
    *("cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2"),
    *("anchors", "anchor_ids", "chi2", "residual_rms_m"),
    *("hpl_m", "vpl_m", "integrity_risk", "alert"),
)
"""Columns of the file that --fixes writes."""


def fix_writer(stack: ExitStack, path: Path) -> "Callable[[Fix], None]":
    """Open the table, closed by the stack; the result writes one fix."""
    writer = csv.writer(stack.enter_context(open_for_writing(path)))
    writer.writerow(COLUMNS)
    return lambda fix: writer.writerow(row_of(fix))


def check_plot_path(plot: Path | None) -> None:
    """Look at the option --plot before the long work, not after it. Raises SkylessError."""
    if plot is None:
        return
    if plot.suffix.lower() not in PICTURES:
        raise SkylessError(f"--plot is {str(plot)!r}; its ending should be one of {', '.join(PICTURES)}")
    if plot.is_dir() or not plot.parent.is_dir():
        raise SkylessError(f"--plot is {str(plot)!r}; it should be a file in a folder that exists")


def draw_track(path: Path, judge: "Judge", report: "ReplayReport") -> None:
    """Draw what --plot asks for. Raises SkylessError."""
    from skyless.replay.plot import draw

    try:
        draw(path, judge.track.rows, f"{report.format}, {report.fixes} fixes")
    except (OSError, ValueError) as error:
        raise SkylessError(f"{path} cannot be drawn: {error}") from None


def row_of(fix: "Fix") -> list[str]:
    """A fix as a row of ``COLUMNS``."""
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


def show(report: "ReplayReport", note: str, distances: dict[str, float], more: Sequence[tuple[str, str]] = ()) -> None:
    """Show a replay as a table; ``note`` says where the height is from, ``more`` comes first."""
    from rich.table import Table

    table = Table("replay", "", title=f"{report.format}: {report.receptions} receptions", show_header=False)
    for name, value in (*more, *_lines(report, note)):
        table.add_row(name, value)
    for reason, count in report.drops.items():
        table.add_row(f"dropped: {reason}", str(count))
    for pair, by_m in report.contradictions_m.items():
        nearer = "nearer" if by_m < 0.0 else "farther"
        table.add_row(f"anchors {pair}", f"range each other {abs(by_m):.2f} m {nearer} than the table has them")
    for pair, metres in distances.items():
        table.add_row(f"distance {pair}", f"{metres:.3f} m")
    console().print(table)


def _lines(report: "ReplayReport", note: str) -> list[tuple[str, str]]:
    fixes = str(report.fixes) if report.reason is None else f"none: {report.reason}"
    if report.reason == "no-almanac":
        fixes += " (give a table of the anchors' places with --anchors, or --site)"
    height = note if report.height_m is None else f"{report.height_m:.3f} m, {note}"
    truth_known = any(pair.against_truth for pair in report.pairs)
    return [
        ("fixes", fixes),
        ("method", _method(report)),
        ("rate", "–" if report.rate_hz is None else f"{report.rate_hz:.1f} Hz"),
        ("height", height),
        ("median position", _triple(report.median_m)),
        ("standard deviation", _triple(report.std_m)),
        # without truth, the tag's own motion is in it
        ("noise of a difference" if truth_known else "spread of a difference", _metres(report.tdoa_noise_m)),
        ("RMSE 2-D", _metres(report.rmse_2d_m)),
        ("RMSE 3-D", _metres(report.rmse_3d_m)),
        ("95 %", _metres(report.p95_m)),
        ("largest error", _metres(report.max_m)),
        ("speed", f"{report.receptions_per_s:,.0f} receptions/s"),
    ]


def _method(report: "ReplayReport") -> str:
    return f"{report.method}" if report.measurements is None else f"{report.method}, given {report.measurements}"


def _metres(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f} m"


def _triple(values: tuple[float, float, float] | None) -> str:
    return "–" if values is None else ", ".join(f"{value:.3f}" for value in values) + " m"
