"""``skyless study``: how accurate the receiver is under which conditions, over many runs in the simulated world."""

import csv
import io
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import msgspec
from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.arguments import process_noise
from skyless.cli.common.options import (
    IntegrityRisk,
    Picoseconds,
    Positive,
    Seed,
    check_method,
    check_picture,
    options,
)
from skyless.cli.common.output import console, print_json, to_json
from skyless.cli.common.progress import loading_kernels, progress_bar
from skyless.errors import SkylessError
from skyless.method_names import DEFAULT_METHOD, Dynamics
from skyless.whole_files import write_whole

if TYPE_CHECKING:
    from rich.table import Table

    from skyless.studies.common.plan import Plan, Row, Study

_Name = Literal[
    "efficiency",
    "loss",
    "nlos",
    "motion",
    "sync",
    "integrity",
    "room",
    "large",
    "claims",
    "survey",
    "survey-room",
    "watch",
    "sitetime",
    "scale",
]

_WIDEST: Final = 220
"""Columns of a table that is not shown on a terminal."""

_OF_ERRORS: Final = (
    "Simulated. ± standard errors. NEES: per dimension, with the interval where 99 % of honest ones lie.",
    "Fixes: superframes with one. CPU: of a tag for a message, measured.",
)
_OF_LEVELS: Final = (
    "Simulated. Level: share of fixes with a protection level. HPL, VPL: its median. Misleading, vertical: share of",
    "fixes whose error exceeds it, in 10⁻⁴, with the interval where it truly lies with 99 %; held unless the risk lies",
    "below that. Ratio: how many times smaller levels could be on clean data.",
)
_OF_THE_ROOM: Final = (
    "Simulated. ± standard errors. NEES: per dimension. Fixes: superframes with one.",
    "Level: share of fixes with a protection level. HPL: its median. Exceeded: share of those whose error is larger,",
    "in 10⁻⁴, with the interval where it truly lies with 99 % (tags as units); unwarned: those without an alert.",
)
_OF_A_LARGE_SITE: Final = (
    "Simulated; every fix counts. ± standard errors. NEES: per dimension. First fix: from a tag's first beacon on,",
    "knowing nothing; 95 % of them are faster. Gap: the longest time between two fixes.",
)
_OF_CLAIMS: Final = (
    "Simulated. Superframes until all anchors follow one claim whose root lives; longest: the slowest run.",
    "Changes: anchors that changed their claim once all was settled, in all runs.",
    "Limits: 10 in the hall, 40 in the corridor; 25 and 100 for cut in half and a fifth dead.",
)
_OF_SURVEYS: Final = (
    "Simulated air. RMSE, bound: of anchors after the best rigid alignment. Delays: less their mean. Tag: what its",
    "position is off by the survey alone; by hand: by positions good to 2 cm per axis and unknown delays. < 10 cm:",
    "share of runs. Flagged: not determined, ambiguous or not checked. Wrong: 10 cm and four of their own sigmas off.",
)
_OF_SURVEYED_ROOMS: Final = (
    "Simulated air. Site files by those who know the truth, by a survey, and by hand; the same tags with each.",
    "Ratio: RMSE over that with the truth. NEES: per dimension. Level: share of fixes with a protection level.",
    "HPL: its median. Exceeded: share of those whose error is larger, in 10⁻⁴, with the interval where it lies, 99 %.",
)
_OF_SITE_TIME: Final = (
    "Simulated. RMSE: error of an anchor's timeline, or difference of two in range. σ: as anchors state it.",
    "Ratio: σ over RMSE. Max: largest difference of two anchors in range.",
)
_OF_THE_WATCH: Final = (
    "Simulated: drawn ranges, with drift of 2 cm. Found: events found within 30 s (moved slowly: within its time; fast",
    "windows: 0.15 s); 99 %: time from the event. Named: of these, with the right anchors or links and no others;",
    "kind: and what has happened to them. Wrong: an anchor said to have moved, or its delay to have changed, that",
    "has not. Alarms: findings while nothing happens.",
)
_LEGENDS: Final = {
    "integrity": _OF_LEVELS,
    "room": _OF_THE_ROOM,
    "large": _OF_A_LARGE_SITE,
    "claims": _OF_CLAIMS,
    "survey": _OF_SURVEYS,
    "survey-room": _OF_SURVEYED_ROOMS,
    "watch": _OF_THE_WATCH,
    "sitetime": _OF_SITE_TIME,
}

_FIGURES: Final = {
    "superframes_most": "superframes",
    "changes": "changes",
    "max_m": "max",
    "rmse_m": "RMSE",
    "nees": "NEES",
    "level": "level",
    "exceeded": "exceeded",
    "hpl_m": "HPL",
    "ratio": "ratio",
    "p95_m": "95 %",
    "beacons_per_s": "beacons",
    "first_fix_s": "first fix",
    "gap_s": "gap",
    "gap_superframes": "gap",
    "restarts": "restarts",
    "near": "< 10 cm",
    "undetermined": "not determined",
    "flagged": "flagged",
    "wrong_flagged": "of wrong flagged",
    "excluded_wrongly": "wrongly out",
    "delay_m": "delays",
    "tag_m": "tag",
    "found": "found",
    "named": "named",
    "wrong": "wrong",
    "alarms": "alarms",
    "alarms_per_day": "alarms a day",
}
"""How the table names what may have limits."""

app = App(name="study", help_epilogue="Example: skyless study loss --seed 7 --plot loss.png")


@options
class StudyOptions:
    """Options of ``skyless study``."""

    method: str | None = None
    """How positions are computed; by default the best method."""
    seed: Seed = 1
    """Same seed, same rows, whatever computes them; CPU times apart."""
    episodes: Annotated[int, Parameter(validator=Number(gte=1, lte=10**6))] | None = None
    """Episodes of two seconds for each case (efficiency, integrity)."""
    worlds: Annotated[int, Parameter(validator=Number(gte=2, lte=10**5))] | None = None
    """Independent worlds for each case (all others, but for the tags of scale; room: a quarter but for its first)."""
    seconds: Annotated[float, Parameter(validator=Number(gte=1, lte=1e6))] | None = None
    """Simulated seconds for which each world is judged."""
    noise_ps: Picoseconds | None = None
    """Noise of every TX and RX stamp in picoseconds, known to the filters; by default 100."""
    qa: Positive | None = None
    """Process noise that the filters assume at rest: spectral density of the acceleration, m²/s³; by default 0.3."""
    dynamics: Dynamics | None = None
    """How tags move: walk (as people), robot or drone, which sets the process noise instead of --qa."""
    integrity_risk: IntegrityRisk | None = None
    """Probability, for each fix, that the error exceeds its protection level (integrity); 1e-4 by default."""
    alert_limit_m: Positive | None = None
    """Fixes whose protection level exceeds this, in metres, count as not available (integrity)."""
    without_mesh: bool = False
    """Anchors relay only when they heard the master."""
    quick: bool = False
    """Simulate a fraction, with more scatter."""
    json: bool = False
    """Write one JSON object instead of the table."""
    plot: Path | None = None
    """Draw the picture into this file."""
    out: Path | None = None
    """Write the result here, into a folder: the rows as JSON and CSV, the picture as PNG and SVG."""
    scheduler: str | None = None
    """Address of a Dask scheduler whose workers do the work, for example tcp://127.0.0.1:8786."""
    processes: Annotated[int, Parameter(validator=Number(gte=1, lte=1024))] | None = None
    """Processes on this machine; by default one for each core."""


@app.default
def study(name: _Name, /, *, asked: StudyOptions = StudyOptions()) -> None:
    """Measure errors over many simulated runs: a table with standard errors, a picture, JSON.

    Parameters
    ----------
    name
        efficiency: RMSE over the Cramér–Rao bound. loss: lost messages. nlos: late ones. motion: speed and turns.
        sync: masters that die, superframes, crystals. integrity: protection levels with a faulty anchor.
        room: the errors of real rooms, and what goes wrong in them. large: 1,024 anchors without a master.
        claims: whose counter leads protocol 2. survey: anchors that survey themselves. survey-room: tags in rooms
        whose site files a survey wrote. watch: anchors that have moved. sitetime: one timeline over many hops.
        scale: numbers of tags and anchors.
    """
    from skyless.studies.catalogue import STUDIES

    _check(name, asked)
    plan = _plan(name, asked)
    started_s = time.perf_counter()
    chosen = STUDIES[name]
    rows = _run(chosen, plan, asked)
    _write(chosen, rows, asked.plot, asked.out)
    print_rows(chosen, plan, rows, time.perf_counter() - started_s, json=asked.json)


def _check(name: str, asked: StudyOptions) -> None:
    """See that the options fit the study and that its files can be written. Raises SkylessError."""
    from skyless.studies.run import check_amounts

    check_amounts(
        name,
        episodes=asked.episodes,
        worlds=asked.worlds,
        seconds=asked.seconds,
        noise_ps=asked.noise_ps,
        qa=asked.qa,
        dynamics=asked.dynamics,
        integrity_risk=asked.integrity_risk,
        alert_limit_m=asked.alert_limit_m,
    )
    if asked.scheduler is not None and asked.processes is not None:
        raise SkylessError("--processes are on this machine, --scheduler is for others; give either")
    check_picture(asked.plot)
    if (out := asked.out) is None:
        return
    if out.exists() and not out.is_dir():
        raise SkylessError(f"--out is {str(out)!r}, which is a file; it should be a folder, or not exist yet")
    parent = next(folder for folder in (out, *out.absolute().parents) if folder.is_dir())
    if not os.access(parent, os.W_OK):
        raise SkylessError(f"--out is {str(out)!r}, where no folder can be written")


def _plan(name: str, asked: StudyOptions) -> "Plan":
    from skyless.positioning.integrity import RISK
    from skyless.studies.common.plan import plan_of

    return plan_of(
        asked.method or DEFAULT_METHOD,
        asked.seed,
        study=name,
        quick=asked.quick,
        noise_ps=asked.noise_ps or 100.0,
        qa=process_noise(asked.qa, asked.dynamics) or 0.3,
        mesh=not asked.without_mesh,
        worlds=asked.worlds,
        seconds=asked.seconds,
        episodes=asked.episodes,
        integrity_risk=asked.integrity_risk or RISK,
        alert_limit_m=asked.alert_limit_m,
    )


def _run(chosen: "Study", plan: "Plan", asked: StudyOptions) -> "list[Row]":
    from skyless.evaluation.compile_ahead import compile_kernels
    from skyless.preparation.parts import parts_of
    from skyless.studies.run import WITHOUT_POSITIONS, run_study

    check_method(plan.method)
    if chosen.name not in WITHOUT_POSITIONS:
        with loading_kernels(*parts_of(plan.method)):
            compile_kernels(plan.method)
    try:
        with progress_bar(f"studying {chosen.title}", 1.0) as bar:
            return run_study(chosen, plan, bar.reach, asked.processes, asked.scheduler)
    except KeyboardInterrupt:
        print("stopped; nothing was written", file=sys.stderr)
        raise


def _write(study: "Study", rows: "Sequence[Row]", plot: Path | None, out: Path | None) -> None:
    """Write the files that were asked for, each whole or not at all. Raises SkylessError."""
    if plot is None and out is None:
        return
    from skyless.evaluation.figures import picture

    figure = study.draw(rows)
    files = {} if plot is None else {plot: plot.suffix.removeprefix(".")}
    try:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            files |= {out / f"{study.name}.{kind}": kind for kind in ("png", "svg")}
            write_whole(out / f"{study.name}.json", to_json(rows).encode())
            write_whole(out / f"{study.name}.csv", _csv(rows).encode())
        for path, kind in files.items():
            write_whole(path, picture(figure, kind))
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


def print_rows(study: "Study", plan: "Plan", rows: "Sequence[Row]", wall_s: float, *, json: bool) -> None:
    """Print the result."""
    if json:
        built = msgspec.to_builtins(plan)
        print_json({"study": study.name, "simulated": True, **built, "wall_s": wall_s, "rows": rows})
        return
    out = console()
    if not out.is_terminal:
        out.width = _WIDEST
    out.print(_table(study, plan, rows))
    for line in _LEGENDS.get(study.name, _OF_ERRORS):
        out.print(line)


def _table(study: "Study", plan: "Plan", rows: "Sequence[Row]") -> "Table":
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, title=f"{study.title}: {plan.method}, seed {plan.seed}")
    heads = (
        *("case", "RMSE in cm", "95 %", "max", "σ", "NEES", "", "fixes", "bound"),
        *("level", "HPL in cm", "VPL", "misleading", "", "vertical", "", "exceeded", "", "unwarned"),
        *("beacons/s", "first fix in s", "gap in s", "superframes", "joins", "restarts"),
        *("superframes", "longest", "changes"),
        *("found", "99 % in s", "named", "kind", "wrong", "alarms", "a day", "ratio"),
        *(
            "delays in cm",
            "tag",
            "by hand",
            "< 10 cm",
            "late found",
            "wrongly out",
            "flagged",
            "wrong",
            "these flagged",
        ),
        *("limit", "CPU in µs"),
    )
    cells = [_cells(row) for row in rows]
    used = [column for column in range(len(heads)) if any(line[column] for line in cells)]
    if "95 %" in {heads[column] for column in used}:
        table.caption = "RMSE, 95 %, max and σ: 2-D where the tags' height is given, else 3-D"
    for column in used:
        table.add_column(heads[column], justify="left" if column == 0 else "right")
    for line in cells:
        table.add_row(*(line[column] for column in used))
    return table


def _cells(row: "Row") -> tuple[str, ...]:
    in_a_room = row.study in {
        "room",
        "large",
        "survey-room",
    }  # its table is wide enough without the columns that have no limits
    return (
        row.case,
        _figure(row.rmse_m, 100.0, row.rmse_error_m),
        _figure(row.p95_m, 100.0),
        _figure(row.max_m, 100.0),
        _figure(row.said_m, 100.0),
        _figure(row.nees),
        "" if row.nees_interval is None or in_a_room else "{:.2f}–{:.2f}".format(*row.nees_interval),
        "" if row.risk is not None else _percent(row.available),
        _figure(row.bound_m, 100.0),
        _percent(row.level if row.risk is None else row.available),
        _figure(row.hpl_m, 100.0, digits=1),
        _figure(row.vpl_m, 100.0, digits=1),
        _figure(row.hmi, 1e4),
        _interval(row.hmi_interval),
        _figure(row.hmi_vertical, 1e4),
        _interval(row.hmi_vertical_interval),
        _rare(row.exceeded),
        "" if row.exceeded_interval is None else "–".join(map(_rare, row.exceeded_interval)),
        _rare(row.exceeded_unwarned),
        _figure(row.beacons_per_s, digits=0),
        _figure(row.first_fix_s, digits=3),
        _figure(row.gap_s, digits=3),
        _figure(row.gap_superframes, digits=1),
        "" if row.joins is None else str(row.joins),
        "" if row.restarts is None else str(row.restarts),
        _figure(row.superframes, digits=0),
        _figure(row.superframes_most, digits=0),
        _figure(row.changes, digits=0),
        _percent(row.found),
        _figure(row.found_s, digits=3 if (row.found_s or 1.0) < 1.0 else 0),
        _percent(row.named),
        _percent(row.kind),
        _percent(row.wrong),
        _figure(row.alarms, digits=0),
        _figure(row.alarms_per_day),
        _figure(row.ratio, 1.0, row.ratio_error, 3),
        _figure(row.delay_m, 100.0),
        _figure(row.tag_m, 100.0),
        _figure(row.hand_tag_m, 100.0),
        _percent(row.near),
        _percent(row.found_late),
        _percent(row.excluded_wrongly),
        _percent(row.flagged),
        "" if row.wrong_runs is None else str(row.wrong_runs),
        _percent(row.wrong_flagged),
        _limit(row),
        "" if in_a_room else _figure(row.cpu_us_per_message, digits=0),
    )


def _limit(row: "Row") -> str:
    """Which limits were missed; or the largest ratio that is accepted, else the risk of levels, and whether it held."""
    if row.limits:
        return "missed: " + ", ".join(map(_FIGURES.__getitem__, row.missed)) if row.missed else "held"
    limit = row.risk if row.limit is None else row.limit
    return "" if limit is None else f"{limit:g} {'held' if row.passed else 'missed'}"


def _rare(share: float | None) -> str:
    """In 10⁻⁴."""
    return "" if share is None else f"{1e4 * share:.{0 if share >= 1e-2 else 2}f}"


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100.0 * share:.1f} %"


def _interval(shares: tuple[float, float] | None) -> str:
    return "" if shares is None else "{:.2f}–{:.2f}".format(*(1e4 * share for share in shares))


def _figure(value: float | None, factor: float = 1.0, error: float | None = None, digits: int = 2) -> str:
    if value is None:
        return ""
    after = "" if error is None else f" ± {factor * error:.{digits}f}"
    return f"{factor * value:.{digits}f}{after}"
