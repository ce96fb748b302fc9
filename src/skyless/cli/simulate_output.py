"""What ``skyless simulate`` writes: a table of fixes row by row, and the report for people."""

from typing import TYPE_CHECKING, Final

from skyless.cli.common.output import console

if TYPE_CHECKING:
    from skyless.evaluation.fleet import FleetReport, JudgedFix

COLUMNS: Final = (
    *("t_s", "tag"),
    *("x_m", "y_m", "z_m", "var_x_m2", "var_y_m2", "var_z_m2", "truth_x_m", "truth_y_m", "truth_z_m", "anchors"),
    *("hpl_m", "vpl_m", "integrity_risk", "alert"),
)
"""Columns of the file that --fixes-csv writes."""


def row_of(judged: "JudgedFix") -> tuple[object, ...]:
    """One fix as a row of ``COLUMNS``."""
    fix = judged.fix
    numbers = [*fix.position_m, *fix.covariance_m2.diagonal(), *judged.truth_m]
    anchors = " ".join(map(str, fix.anchors))
    levels = (
        *("" if one is None else f"{one:.4g}" for one in (fix.hpl_m, fix.vpl_m, fix.integrity_risk)),
        fix.alert or "",
    )
    return (f"{judged.time_s:.6f}", judged.tag, *(f"{number:.6g}" for number in numbers), anchors, *levels)


def show(result: "FleetReport") -> None:
    """Show a run as a table."""
    from rich.table import Table

    table = Table("simulated", "", title=f"{result.method}, {result.tags} tag(s)", show_header=False)
    lines = (
        ("simulated time", f"{result.simulated_s:.1f} s in {result.wall_s:.1f} s ({result.speed:.1f} × real time)"),
        ("messages at tags", f"{result.messages} ({result.dropped} dropped)"),
        ("fixes judged", f"{result.fixes}"),
        ("updates", f"{result.updates_per_s:.1f} per second and tag"),
        ("first fix", _seconds(result.first_fix_s)),
        ("RMSE", _centimetres(result.rmse_m)),
        ("said by the fixes", _centimetres(result.sigma_m)),
        ("95 %", _centimetres(result.p95_m)),
        ("largest", _centimetres(result.max_m)),
    )
    for name, value in (*lines, *_levels(result)):
        table.add_row(name, value)
    for reason, count in result.drops.items():
        table.add_row(f"dropped: {reason}", str(count))
    console().print(table)


def _levels(result: "FleetReport") -> list[tuple[str, str]]:
    """How the protection levels did, where the method gives some."""
    levels = result.levels
    if levels is None:
        return []
    alerts = ", ".join(f"{alert} {count}" for alert, count in levels.alerts.items() if alert != "none")
    return [
        ("protection level", f"median {_centimetres(levels.hpl_m)}, for {100 * levels.available:.1f} % of the fixes"),
        ("errors beyond it", f"{levels.misleading} (stated risk {levels.integrity_risk:g})"),
        ("alerts", alerts or "none"),
    ]


def _centimetres(value_m: float | None) -> str:
    return "–" if value_m is None else f"{100 * value_m:.2f} cm"


def _seconds(value_s: float | None) -> str:
    return "none" if value_s is None else f"{value_s:.3f} s after power-on"
