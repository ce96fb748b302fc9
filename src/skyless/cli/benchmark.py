"""``skyless benchmark``: every recording below a folder by every method."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from cyclopts import App

from skyless.cli.common import JsonOptions, command, console, print_json, print_table, progress_bar
from skyless.core.air.site_pages import MAX_COORDINATE_M
from skyless.core.arguments import Option, Options, Positive, Rule, Text, numbers, point
from skyless.core.errors import SkylessError
from skyless.research.replays.options import check_estimator, read_estimator

if TYPE_CHECKING:
    from collections.abc import Callable

    from skyless.research.masterless.smoothing import OwnEstimator

_QUICK_S: Final = 12.0

app = App(name="benchmark", help_epilogue="Example: skyless benchmark recordings --quick --out compared")


class BenchmarkOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless benchmark``."""

    out: Path = Path("benchmark")
    """Write the result here, into a folder: index.html, results.csv and results.json. What is there already is kept."""
    only: str = ""
    """Only recordings whose name holds this text."""
    lever_arm_m: Annotated[
        tuple[float, float, float] | None,
        Option("lever-arm"),
        numbers(3, form="x,y,z"),
        point(3, farthest_m=MAX_COORDINATE_M),
    ] = None
    """The antenna in the body's frame, in metres, added to the truth of tables."""
    calibrate_on: Annotated[tuple[str, ...], Option("calibrate-on"), Text(lambda _, text: text, "NAME", many=True)] = ()
    """Calibrate anchors on recordings whose names hold this text, for each table of anchors on the first; others with
    the same table are replayed with that as well."""
    estimator: Annotated[
        "Callable[[], OwnEstimator] | None", Text(read_estimator, "FILE.py:CLASS"), Rule(check_estimator)
    ] = None
    """Your own estimator as one more method: a class with hear(observation)."""
    first_s: Annotated[Positive | None, Option("only-first")] = None
    """Replay only this number of seconds of each recording."""
    quick: bool = False
    """Compute a fraction: the first twelve seconds of each recording, without smoothing; about a minute for thirty."""


@app.default
@command
def benchmark(folder: Path, /, *, asked: BenchmarkOptions, output: JsonOptions) -> None:
    """Compare methods on every recording below a folder.

    Finds what skyless replay can read, and beside NAME_tdoa.csv its truth, NAME_pose.csv, and above it the anchors,
    anchors*.csv. Runs joint, joint smoothed and calibrated, a plain filter with a gate, one with Bitcraze's rule of
    refusing outliers, a gradient, least squares, and estimators of your own. Continues where it was interrupted.
    """
    if not folder.is_dir():
        raise SkylessError(f"FOLDER is {str(folder)!r}; it should be a folder with recordings")
    from skyless.research.benchmark import (
        SUMMARY_HEADS,
        Asked,
        recordings_below,
        results_of,
        summary_rows,
        with_best,
        write,
    )

    found = [one for one in recordings_below(folder) if asked.only in one.name]
    if not found:
        raise SkylessError(f"FOLDER is {str(folder)!r}; it should hold recordings that skyless replay can read")
    kept = asked.out / "results"
    try:
        kept.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SkylessError(f"--out is {str(asked.out)!r}; it should be a folder: {error.strerror}") from None
    first_s = _QUICK_S if asked.quick and asked.first_s is None else asked.first_s
    own = asked.estimator
    estimators = {} if own is None else {getattr(own, "__name__", "own"): own}
    code = getattr(getattr(own, "hear", own), "__code__", None)
    programs = () if code is None else (Path(code.co_filename),)
    how = Asked(asked.lever_arm_m, first_s, asked.calibrate_on, estimators, programs, not asked.quick)
    try:
        with progress_bar("replaying") as reach:
            results = list(with_best(list(results_of(found, how, kept, reach))))
        title = f"{len(found)} recording{'s' * (len(found) != 1)}" + (
            "" if first_s is None else f", the first {first_s:g} s of each"
        )
        write(asked.out, results, title, shlex.join(["skyless", *sys.argv[1:]]))
    except KeyboardInterrupt:
        print("stopped; the same command continues where it was", file=sys.stderr)
        raise
    except OSError as error:
        raise SkylessError(f"{asked.out} cannot be written: {error.strerror}") from None
    summary = list(summary_rows(results))
    if output.json:
        rows = [dict(zip(SUMMARY_HEADS, row, strict=True)) for row in summary]
        print_json({"recordings": len(found), "seconds": first_s, "methods": rows})
        return
    print_table(title, SUMMARY_HEADS, summary, figures=True)
    console().print(f"{asked.out / 'index.html'}: each recording; results.csv and results.json beside it")
