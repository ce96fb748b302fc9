"""``skyless study``, ``skyless paper`` and ``skyless benchmark``: research from the command line."""

import csv
import io
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias

import msgspec
from cyclopts import App
from msgspec.structs import replace

from skyless.arguments import Rule, Seed, folder_to_write
from skyless.cli.api.options import StudyOptions
from skyless.cli.common import (
    JsonOptions,
    check_picture,
    command,
    console,
    json_form,
    make_folder,
    print_json,
    print_table,
    progress_bar,
    say_written,
    to_json,
)
from skyless.core.errors import SkylessError
from skyless.files import write_whole
from skyless.research.replays.options import BenchmarkOptions

if TYPE_CHECKING:
    from skyless.cli.api.study import StudyResult
    from skyless.research.studies.runner import Row

_LEGENDS: Final = {
    "efficiency": (
        "Simulated. ± standard errors. NEES: per dimension, with the interval where 99 % of honest ones lie."
    ),
    "integrity": (
        "Simulated. Level: share of fixes with a protection level. HPL, VPL: its median. Misleading, vertical: share "
        "of fixes whose error exceeds it, in 10⁻⁴, with the interval where it truly lies with 99 %; held unless the "
        "risk lies below that. Ratio: how many times smaller levels could be on clean data."
    ),
    "room": (
        "Simulated. ± standard errors. NEES: per dimension. Fixes: superframes with one. Level: share of fixes with a "
        "protection level. HPL: its median. Exceeded: share of those whose error is larger, in 10⁻⁴, with the interval "
        "where it truly lies with 99 % (tags as units); unwarned: those without an alert. CPU: of a tag for a message, "
        "measured."
    ),
    "large": (
        "Simulated; every fix counts. ± standard errors. NEES: per dimension. First fix: from a tag's first beacon on, "
        "knowing nothing; 95 % of them are faster. Gap: the longest time between two fixes."
    ),
    "survey": (
        "Simulated air. RMSE, bound: of anchors after the best rigid alignment. Delays: less their mean. Tag: what its "
        "position is off by the survey alone; by hand: by positions good to 2 cm per axis and unknown delays. < 10 cm: "
        "share of runs. Flagged: not determined, ambiguous or not checked. "
        "Wrong: 10 cm and four of their own sigmas off."
    ),
    "survey-room": (
        "Simulated air. Site files by those who know the truth, by a survey, and by hand; the same tags with each. "
        "Ratio: RMSE over that with the truth. NEES: per dimension. Level: share of fixes with a protection level. "
        "HPL: its median. "
        "Exceeded: share of those whose error is larger, in 10⁻⁴, with the interval where it lies, 99 %."
    ),
    "watch": (
        "Simulated: drawn ranges, with drift of 2 cm. Found: events found within 30 s (moved slowly: within its time; "
        "fast windows: 0.15 s); 99 %: time from the event. Named: of these, with the right anchors or links and no "
        "others; kind: and what has happened to them. Wrong: an anchor said to have moved, or its delay to have "
        "changed, that has not. Alarms: findings while nothing happens."
    ),
}
"""What the columns of a study's table mean."""

app = App(name="study", help_epilogue="Example: skyless study room --conditions loss --plot loss.png")


class _Output(JsonOptions, frozen=True, kw_only=True):
    plot: Path | None = None
    """Draw the picture into this file."""
    out: Annotated[Path | None, Rule(folder_to_write)] = None
    """Write the result here, into a folder: the rows as JSON and CSV, the picture as PNG and SVG."""


@app.default
@command
def study(asked: StudyOptions, output: _Output) -> None:
    """Measure errors over many simulated runs: a table with standard errors, a picture, JSON."""
    check_picture(output.plot)
    from skyless.cli.api.study import run_study
    from skyless.research.studies.run import way_on

    try:
        with progress_bar(f"studying {asked.name}") as reach:
            result = run_study(replace(asked, progress=reach))
    except KeyboardInterrupt:
        print(f"stopped; {way_on(asked.resume)}", file=sys.stderr)
        raise
    for file in result.parts.damaged:
        print(f"skyless: {file} is damaged; its part was computed again", file=sys.stderr)
    _write(result, output)
    if output.json:
        print_json(result.summary)
    else:
        print_rows(result)


def _write(result: "StudyResult", output: _Output) -> None:
    """Write the requested files, each whole or not at all. Raises SkylessError."""
    plot, out, rows = output.plot, output.out, result.rows
    if plot is None and out is None:
        return
    from skyless.site.report import picture

    figure = result.plot()
    files = {} if plot is None else {plot: plot.suffix.removeprefix(".")}
    try:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            files |= {out / f"{result.name}.{kind}": kind for kind in ("png", "svg")}
            write_whole(out / f"{result.name}.json", to_json(rows).encode())
            write_whole(out / f"{result.name}.csv", _csv(rows).encode())
        for path, kind in files.items():
            write_whole(path, picture(figure, kind))
            if path == plot:
                say_written(path)
    except OSError as error:
        raise SkylessError(f"{error.filename or plot or out} cannot be written: {error.strerror}") from None


def _csv(rows: "Sequence[Row]") -> str:
    text = io.StringIO()
    table = csv.writer(text)
    table.writerow(rows[0].__struct_fields__)
    for row in rows:
        values = ["" if value is None else value for value in msgspec.structs.astuple(row)]
        table.writerow([" ".join(map(str, value)) if isinstance(value, tuple) else value for value in values])
    return text.getvalue()


def print_rows(result: "StudyResult") -> None:
    """Print the rows as a table."""
    cells = [[cell(row) for _, cell in _COLUMNS] for row in result.rows]
    used = [column for column in range(len(_COLUMNS)) if any(line[column] for line in cells)]
    heads = [_COLUMNS[column][0] for column in used]
    caption = "RMSE, 95 %, max and σ: 2-D where the tags' height is given, else 3-D" if "95 %" in heads else ""
    rows = ([line[column] for column in used] for line in cells)
    print_table(result.title(), heads, rows, figures=True, caption=caption)
    console().print(_LEGENDS[result.name])


def _limit(row: "Row") -> str:
    """Missed limits in words, or whether limits, or the levels' risk, were held."""
    if row.missed:
        return "missed: " + ", ".join(_NAMES.get(one, one.removesuffix("_m").removesuffix("_s")) for one in row.missed)
    risk = getattr(row, "risk", None)
    verdict = {None: "", True: "held", False: "missed"}[row.passed]
    return verdict if risk is None else f"{risk:g} {verdict}"


def _rare(share: float | None) -> str:
    """Format a share in units of 10⁻⁴."""
    return "" if share is None else f"{1e4 * share:.{0 if share >= 1e-2 else 2}f}"


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100.0 * share:.1f} %"


_Cell: TypeAlias = Callable[["Row"], str]


def _number(name: str, factor: float = 1.0, digits: int = 2, error: str = "") -> _Cell:
    def cell(row: "Row") -> str:
        value, std = (getattr(row, one, None) for one in (name, error))
        after = "" if std is None else f" ± {factor * std:.{digits}f}"
        return "" if value is None else f"{factor * value:.{digits}f}{after}"

    return cell


def _share(name: str, words: Callable[[float | None], str] = _percent) -> _Cell:
    return lambda row: words(getattr(row, name, None))


def _span(name: str, words: Callable[[float], str]) -> _Cell:
    return lambda row: "–".join(map(words, getattr(row, name, None) or ()))


_COLUMNS: Final[tuple[tuple[str, _Cell], ...]] = (
    ("case", lambda row: row.case),
    ("RMSE in cm", _number("rmse_m", 100.0, error="rmse_error_m")),
    ("95 %", _number("p95_m", 100.0)),
    ("max", _number("max_m", 100.0)),
    ("σ", _number("said_m", 100.0)),
    ("NEES", _number("nees")),
    ("", lambda row: _span("nees_interval", "{:.2f}".format)(row) if row.study == "efficiency" else ""),
    ("fixes", lambda row: "" if row.study == "integrity" else _percent(row.available)),
    ("bound", _number("bound_m", 100.0)),
    ("level", lambda row: _percent(row.available if row.study == "integrity" else getattr(row, "level", None))),
    ("HPL in cm", _number("hpl_m", 100.0, 1)),
    ("VPL", _number("vpl_m", 100.0, 1)),
    ("misleading", _number("hmi", 1e4)),
    ("", _span("hmi_interval", lambda share: f"{1e4 * share:.2f}")),
    ("vertical", _number("hmi_vertical", 1e4)),
    ("", _span("hmi_vertical_interval", lambda share: f"{1e4 * share:.2f}")),
    ("exceeded", _share("exceeded", _rare)),
    ("", _span("exceeded_interval", _rare)),
    ("unwarned", _share("exceeded_unwarned", _rare)),
    ("beacons/s", _number("beacons_per_s", digits=0)),
    ("first fix in s", _number("first_fix_s", digits=3)),
    ("gap in s", _number("gap_s", digits=3)),
    ("joins", _number("joins", digits=0)),
    ("restarts", _number("restarts", digits=0)),
    ("found", _share("found")),
    ("99 % in s", lambda row: _number("found_s", digits=3 if (getattr(row, "found_s", None) or 1.0) < 1.0 else 0)(row)),
    ("named", _share("named")),
    ("kind", _share("kind")),
    ("wrong", _share("wrong")),
    ("alarms", _number("alarms", digits=0)),
    ("a day", _number("alarms_per_day")),
    ("ratio", _number("ratio", 1.0, 3, "ratio_error")),
    ("delays in cm", _number("delay_m", 100.0)),
    ("tag", _number("tag_m", 100.0)),
    ("by hand", _number("hand_tag_m", 100.0)),
    ("< 10 cm", _share("near")),
    ("late found", _share("found_late")),
    ("wrongly out", _share("excluded_wrongly")),
    ("flagged", _share("flagged")),
    ("wrong", _number("wrong_runs", digits=0)),
    ("these flagged", _share("wrong_flagged")),
    ("limit", _limit),
    ("CPU in µs", lambda row: "" if row.x is None else _number("cpu_us_per_message", digits=0)(row)),
)
"""Heads of the table's columns, and functions for their cells; columns that no row fills are left out."""

_NAMES: Final = {
    "rmse_m": "RMSE",
    "nees": "NEES",
    "hpl_m": "HPL",
    "p95_m": "95 %",
    "beacons_per_s": "beacons",
    "first_fix_s": "first fix",
    "near": "< 10 cm",
    "undetermined": "not determined",
    "wrong_flagged": "of wrong flagged",
    "excluded_wrongly": "wrongly out",
    "delay_m": "delays",
    "alarms_per_day": "alarms a day",
}
"""Names in the table of figures that missed their limits, if different from the field's name."""


paper_app = App(name="paper", help_epilogue="Example: skyless paper --out report --seed 1")


@paper_app.default
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


benchmark_app = App(name="benchmark", help_epilogue="Example: skyless benchmark recordings --quick --out compared")


@benchmark_app.default
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
    make_folder("--out", kept)
    try:
        with progress_bar("replaying") as reach:
            results = list(with_best(list(results_of(found, asked, kept, reach))))
        title = f"{len(found)} recording{'s' * (len(found) != 1)}" + (
            "" if asked.seconds is None else f", the first {asked.seconds:g} s of each"
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
        print_json({"recordings": len(found), "seconds": asked.seconds, "methods": rows})
        return
    print_table(title, SUMMARY_HEADS, summary, figures=True)
    console().print(f"{asked.out / 'index.html'}: each recording; results.csv and results.json beside it")
