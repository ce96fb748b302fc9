"""``skyless paper``: the paper's figures and claims, simulated and judged, as one report."""

import sys
import time
from pathlib import Path

import msgspec
from cyclopts import App

from skyless.cli.common import JsonOptions, command, console, json_form, print_json, print_table, progress_bar
from skyless.core.arguments import Seed

app = App(name="paper", help_epilogue="Example: skyless paper --out report --seed 1")


@app.default
@command
def paper(*, out: Path, seed: Seed = 1, quick: bool = False, output: JsonOptions) -> None:
    """Reproduce every figure and claim of the paper, and judge which hold.

    Writes report.html, which needs no other file, every picture as PNG and SVG, and numbers.json. The full report takes
    some minutes on two cores: at most 360 s of CPU time, and 600 MB of memory.

    Parameters
    ----------
    out
        Write the result here, into a folder; files of the same names are replaced, others stay.
    seed
        Same seed, same numbers, except for times that are measured.
    quick
        Compute a fraction: ready in well under a minute, with more scatter.
    """
    from skyless.research.paper.plan import plan_of
    from skyless.research.paper.run import write_report

    started_s = time.perf_counter()
    try:
        with progress_bar("simulating the paper") as reach:
            report = write_report(plan_of(seed, quick=quick), out, reach)
    except KeyboardInterrupt:
        print("stopped; nothing was written", file=sys.stderr)
        raise
    if output.json:
        print_json({**msgspec.to_builtins(report, enc_hook=json_form), "wall_s": time.perf_counter() - started_s})
        return
    rows = ((f"{n}", f"{one['title']}", f"{one['verdict']}") for n, one in enumerate(report.sections, start=1))
    print_table("the paper, reproduced and corrected", ("", "figure", "verdict"), rows)
    console().print(f"{report.report}: {len(report.figures)} pictures and numbers.json next to it")
