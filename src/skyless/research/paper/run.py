"""Runs all simulations of the report on every core, then draws and writes it."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.research.paper import _checks as checks
from skyless.research.paper import _claim as claim
from skyless.research.paper import _distributions as distributions
from skyless.research.paper import _dop_map as dop_map
from skyless.research.paper import _rate as rate
from skyless.research.paper import _scale as scale
from skyless.research.paper import _scenario as scenario
from skyless.research.paper import _static as static
from skyless.research.paper import _timeline as timeline
from skyless.research.paper import _walk as walk
from skyless.research.paper._html import Heading, report_page
from skyless.research.paper.plan import Plan, Section, Task
from skyless.research.studies.common.plan import Cell
from skyless.research.studies.common.runner import run_cells
from skyless.site.report.figures import picture, report_style

_FIGURES: Final = (scenario, checks, distributions, static, walk, dop_map, timeline, rate, claim, scale)
"""In the order of the report."""

_REPORT: Final = "report.html"
_NUMBERS: Final = "numbers.json"


class Report(Struct, frozen=True):
    """What was written."""

    seed: int
    quick: bool
    command: str
    report: str
    figures: tuple[str, ...]
    """Paths of the pictures."""
    checks: tuple[dict[str, object], ...]
    """Standard deviations of the paper's quantities against the draws."""
    sections: tuple[dict[str, object], ...]
    """Key, title, label, verdict, reason and numbers of every figure."""


def write_report(plan: Plan, out: Path, reached: Callable[[float], None], processes: int | None = None) -> Report:
    """Simulate, draw, write; ``reached`` is called with the share of the work that is done.

    The files appear in ``out`` when all are ready; other files there stay.

    Raises:
        SkylessError: ``out`` cannot be a folder with the report.
    """
    with _scratch(out) as folder:
        cells = [Cell(task.name, _run, task, task.weight_s) for figure in _FIGURES for task in figure.tasks(plan)]
        results = dict(zip((cell.name for cell in cells), run_cells(cells, reached, processes), strict=True))
        with report_style():
            sections = [figure.section(plan, results) for figure in _FIGURES]
            report = _write(plan, sections, results, folder, out)
        _move(folder, out)
    return report


def _run(task: Task) -> Any:  # noqa: ANN401 - each task has a result of its own
    return task.function(**task.arguments)


@contextmanager
def _scratch(out: Path) -> Iterator[Path]:
    """A folder next to ``out`` for unfinished files, removed at the end in any case."""
    if out.exists() and not out.is_dir():
        raise SkylessError(f"--out is {str(out)!r}, which is a file; it should be a folder, or not exist yet")
    parent = out.absolute().parent
    try:
        parent.mkdir(parents=True, exist_ok=True)
        if out.is_dir():
            tempfile.TemporaryFile(dir=out).close()
        folder = Path(tempfile.mkdtemp(prefix=f".{out.absolute().name}.", dir=parent))
    except OSError as error:
        raise SkylessError(f"--out is {str(out)!r}, where no folder can be written: {error.strerror}") from None
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _write(plan: Plan, sections: list[Section], results: dict[str, Any], folder: Path, out: Path) -> Report:
    pictures: dict[str, bytes] = {}
    files = []
    for section in sections:
        for panel in section.panels:
            pictures[panel.name] = picture(panel.figure, "svg")
            (folder / f"{panel.name}.svg").write_bytes(pictures[panel.name])
            (folder / f"{panel.name}.png").write_bytes(picture(panel.figure, "png", 200.0))
            files += [str(out / f"{panel.name}.{kind}") for kind in ("png", "svg")]
    command = f"skyless paper --out {out} --seed {plan.seed}{' --quick' if plan.quick else ''}"
    heading = Heading(plan.seed, plan.quick, version("skyless"), command)
    (folder / _REPORT).write_text(report_page(heading, sections, pictures), encoding="utf-8")
    report = Report(
        seed=plan.seed,
        quick=plan.quick,
        command=command,
        report=str(out / _REPORT),
        figures=tuple(files),
        checks=tuple(msgspec.to_builtins(check) for check in results["checks"]),
        sections=tuple(_as_fields(section) for section in sections),
    )
    (folder / _NUMBERS).write_bytes(msgspec.json.format(msgspec.json.encode(report, enc_hook=_json_value), indent=1))
    return report


def _as_fields(section: Section) -> dict[str, object]:
    """A section without its figures."""
    return {
        "key": section.key,
        "title": section.title,
        "label": section.label,
        "verdict": str(section.verdict),
        "reason": section.reason,
        "pictures": [panel.name for panel in section.panels],
        "numbers": section.numbers,
        "command": section.command,
    }


def _json_value(value: object) -> object:
    """NumPy's scalars and arrays as plain numbers and lists."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no form in JSON")


def _move(folder: Path, out: Path) -> None:
    """Move the files to where they belong, the page last, so that a page never lacks its pictures."""
    if not out.exists():
        folder.chmod(0o777 & ~_umask())
        folder.rename(out)
        return
    for file in sorted(folder.iterdir(), key=lambda file: file.name == _REPORT):
        file.replace(out / file.name)


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask
