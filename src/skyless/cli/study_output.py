"""What ``skyless study`` writes: the table, the JSON, pictures and files."""

import csv
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from skyless.cli.common.output import console, print_json, to_json, write_atomically
from skyless.cli.replay_output import check_plot_path
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from rich.table import Table

    from skyless.studies.plan import Plan, Row, Study

WIDEST = 220
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
_LEGENDS: Final = {"integrity": _OF_LEVELS, "room": _OF_THE_ROOM}

_FIGURES: Final = {
    "rmse_m": "RMSE",
    "nees": "NEES",
    "level": "level",
    "exceeded": "exceeded",
    "hpl_m": "HPL",
    "ratio": "ratio",
}
"""What the table calls what may have limits."""


def see_that_it_can_be_written(plot: Path | None, out: Path | None) -> None:
    """Look at --plot and --out before the long work, not after it. Raises SkylessError."""
    check_plot_path(plot)
    if out is None:
        return
    if out.exists() and not out.is_dir():
        raise SkylessError(f"--out is {str(out)!r}, which is a file; it should be a folder, or not exist yet")
    place = next(folder for folder in (out, *out.absolute().parents) if folder.is_dir())
    if not os.access(place, os.W_OK):
        raise SkylessError(f"--out is {str(out)!r}, where no folder can be written")


def write(study: "Study", rows: "Sequence[Row]", plot: Path | None, out: Path | None) -> None:
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
            write_atomically(out / f"{study.name}.json", to_json(rows).encode())
            write_atomically(out / f"{study.name}.csv", _csv(rows).encode())
        for path, kind in files.items():
            write_atomically(path, picture(figure, kind))
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
    """Tell what came out."""
    if json:
        told = {"study": study.name, "simulated": True, **msgspec.to_builtins(plan), "wall_s": wall_s, "rows": rows}
        print_json(told)
        return
    out = console()
    if not out.is_terminal:
        out.width = WIDEST
    out.print(_table(study, plan, rows))
    for line in _LEGENDS.get(study.name, _OF_ERRORS):
        out.print(line)


def _table(study: "Study", plan: "Plan", rows: "Sequence[Row]") -> "Table":
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, title=f"{study.title}: {plan.method}, seed {plan.seed}")
    heads = (
        *("case", "RMSE in cm", "95 %", "max", "said", "NEES", "", "fixes", "bound"),
        *("level", "HPL in cm", "VPL", "misleading", "", "vertical", "", "exceeded", "", "unwarned"),
        *("ratio", "limit", "CPU in µs"),
    )
    cells = [_cells(row) for row in rows]
    for column, head in enumerate(heads):
        if any(line[column] for line in cells):
            table.add_column(head, justify="left" if column == 0 else "right")
    used = [column for column in range(len(heads)) if any(line[column] for line in cells)]
    for line in cells:
        table.add_row(*(line[column] for column in used))
    return table


def _cells(row: "Row") -> tuple[str, ...]:
    in_a_room = row.study == "room"  # whose table has columns enough without what its limits say nothing of
    return (
        row.case,
        _number(row.rmse_m, 100.0, row.rmse_error_m),
        _number(row.p95_m, 100.0),
        _number(row.max_m, 100.0),
        _number(row.said_m, 100.0),
        _number(row.nees),
        "" if row.nees_interval is None or in_a_room else "{:.2f}–{:.2f}".format(*row.nees_interval),
        "" if row.risk is not None else _percent(row.available),
        _number(row.bound_m, 100.0),
        _percent(row.level if row.risk is None else row.available),
        _number(row.hpl_m, 100.0, digits=1),
        _number(row.vpl_m, 100.0, digits=1),
        _number(row.hmi, 1e4),
        _interval(row.hmi_interval),
        _number(row.hmi_vertical, 1e4),
        _interval(row.hmi_vertical_interval),
        _rare(row.exceeded),
        "" if row.exceeded_interval is None else "–".join(map(_rare, row.exceeded_interval)),
        _rare(row.exceeded_unwarned),
        _number(row.ratio, 1.0, row.ratio_error, 3),
        _limit(row),
        "" if in_a_room else _number(row.cpu_us_per_message, digits=0),
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


def _number(value: float | None, factor: float = 1.0, error: float | None = None, digits: int = 2) -> str:
    if value is None:
        return ""
    after = "" if error is None else f" ± {factor * error:.{digits}f}"
    return f"{factor * value:.{digits}f}{after}"
