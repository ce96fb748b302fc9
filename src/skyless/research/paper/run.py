"""Runs all simulations of the report on every core, then draws and writes it."""

import tempfile
from collections.abc import Callable
from operator import methodcaller
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.files import replace_files
from skyless.research.paper.claims import CLAIMS
from skyless.research.paper.plan import Plan, Section, report_page
from skyless.research.studies.runner import run_cells
from skyless.site.report import picture, report_style

_PRINTED: Final = ("key", "title", "label", "verdict", "reason", "numbers", "command")
"""Fields of a section that are in the report's numbers."""


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

    Raises SkylessError: ``out`` cannot be a folder with the report.
    """
    is_new = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise SkylessError(f"--out is {str(out)!r}, where no folder can be written: {error.strerror}") from None
    try:
        cells = [cell for claim in CLAIMS for cell in claim.cells(plan)]
        results = dict(zip((cell.name for cell in cells), run_cells(cells, reached, processes), strict=True))
        with report_style():
            return _written(plan, [claim.section(plan, results) for claim in CLAIMS], results, out)
    except BaseException:
        if is_new:
            out.rmdir()
        raise


def _written(plan: Plan, sections: list[Section], results: dict[str, Any], out: Path) -> Report:
    panels = [panel for section in sections for panel in section.panels]
    pictures = {panel.name: picture(panel.figure, "svg") for panel in panels}
    files = {out / f"{panel.name}.png": picture(panel.figure, "png", 200.0) for panel in panels}
    files |= {out / f"{name}.svg": drawn for name, drawn in pictures.items()}
    command = f"skyless paper --out {out} --seed {plan.seed}{' --quick' if plan.quick else ''}"
    report = Report(
        seed=plan.seed,
        quick=plan.quick,
        command=command,
        report=str(out / "report.html"),
        figures=tuple(map(str, files)),
        checks=tuple(msgspec.to_builtins(check) for check in results["checks"]),
        sections=tuple(
            {name: getattr(section, name) for name in _PRINTED} | {"pictures": [one.name for one in section.panels]}
            for section in sections
        ),
    )
    numbers = msgspec.json.format(msgspec.json.encode(report, enc_hook=methodcaller("tolist")), indent=1)
    page = report_page(command, sections, pictures, quick=plan.quick)
    replace_files({**files, out / "numbers.json": numbers, out / "report.html": page.encode()})
    return report
