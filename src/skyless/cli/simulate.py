"""``skyless simulate``: simulate a site, and judge its fixes against the truth."""

import csv
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Final

from cyclopts import App
from msgspec.structs import replace

from skyless.cli.api.options import SimulateOptions
from skyless.cli.common import (
    NO_FIX,
    JsonOptions,
    check_output,
    command,
    dropped,
    new_table,
    print_facts,
    print_json,
    progress_bar,
)
from skyless.cli.nodes.options import name_unplaced

if TYPE_CHECKING:
    from skyless.cli.api.simulate import Simulation
    from skyless.sim.evaluation.fleet import FleetReport, JudgedFix

FIXES_CSV_COLUMNS: Final = (
    *("t_s", "tag"),
    *("x_m", "y_m", "z_m", "var_x_m2", "var_y_m2", "var_z_m2", "truth_x_m", "truth_y_m", "truth_z_m", "anchors"),
    *("hpl_m", "vpl_m", "integrity_risk", "alert"),
)
"""Columns of the file that --fixes-csv writes."""


app = App(
    name="simulate",
    help_epilogue=(
        "Example: skyless simulate --scenario lab --method joint --noise-ps 100 --position 3,4 --fixes 3000 --seed 7"
    ),
)


class _Output(JsonOptions, frozen=True, kw_only=True):
    fixes_csv: Path | None = None
    """Write every fix with its truth into this file."""


@app.default
@command
def simulate(*, asked: SimulateOptions, output: _Output) -> int:
    """Run a site faster than real time and report the errors of its tags.

    Anchors and tags are the machines that would run on radios; clocks, noise, air and motion are simulated.

    Ends with exit code 1 if no fix was judged, and names the reason.
    """
    check_output("fixes-csv", output.fixes_csv, asked.site if isinstance(asked.site, Path) else None)
    from skyless.cli.api.simulate import Simulation, SimulationResult

    with progress_bar("simulating") as reach:
        simulation = Simulation(replace(asked, progress=reach))
        name_unplaced(simulation.request.site)
        with nullcontext() if output.fixes_csv is None else new_table(output.fixes_csv) as file:
            write = None if file is None else csv.writer(file).writerow
            if write is not None:
                write(FIXES_CSV_COLUMNS)
            found = simulation.run(None if write is None else lambda judged: write(_row(judged)))
    result = SimulationResult(simulation.request, found)
    if output.json:
        print_json(result.summary)
    else:
        print_facts(result.title(), result.facts())
    if found.fixes:
        return 0
    print(f"skyless: no fix: {_why_none(found, simulation)}", file=sys.stderr)
    return NO_FIX


def _why_none(result: "FleetReport", simulation: "Simulation") -> str:
    from skyless.core.geometry import RADIO_REACH_M
    from skyless.site.file.advice import too_few_anchors

    if result.tags_without_fix < result.tags:
        return f"all came before --settle, {simulation.request.settle_s:g} s; the run should last longer (--duration)"
    if too_few := too_few_anchors(simulation.request.site):
        return too_few
    if result.messages == 0:
        reach = f"no anchor within {RADIO_REACH_M:.0f} m, the range in the open, or none that is on (--outage)"
        return f"the tags heard nothing: {reach}"
    if result.drops.get("radio-off") == result.messages:
        return f"the tags' radios were off all the time (--silence); {result.messages} messages were lost on them"
    drops = f"; {dropped(result.drops)}" if result.drops else ""
    reason = simulation.fleet.receivers[0].reason
    return f"tags heard {result.messages} messages in {result.simulated_s:g} s, and had no position: {reason}{drops}"


def _row(judged: "JudgedFix") -> tuple[object, ...]:
    """One fix as a row of ``FIXES_CSV_COLUMNS``."""
    fix = judged.fix
    numbers = [*fix.position_m, *fix.covariance_m2.diagonal(), *judged.truth_m]
    levels = ("" if one is None else f"{one:.4g}" for one in (fix.hpl_m, fix.vpl_m, fix.integrity_risk))
    return (
        *(f"{judged.time_s:.6f}", judged.tag, *(f"{value:.6g}" for value in numbers)),
        *(" ".join(map(str, fix.anchors)), *levels, fix.alert or ""),
    )
