"""Runs all simulations of the report on every core, then draws and writes it."""

import multiprocessing
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from importlib.metadata import version
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.core.kernels.processors import cores
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
from skyless.site.report.figures import picture, report_style

_FIGURES: Final = (scenario, checks, distributions, static, walk, dop_map, timeline, rate, claim, scale)
"""In the order of the report."""

_REPORT: Final = "report.html"
_NUMBERS: Final = "numbers.json"

_POLL_S: Final = 0.2


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


class StoppedError(Exception):
    """The report was given up while this task ran."""


# Set in each worker process by its initializer: a share of the work done, and whether to stop.
_shared: dict[str, Any] = {}


def write_report(plan: Plan, out: Path, reached: Callable[[float], None], processes: int | None = None) -> Report:
    """Simulate, draw, write; ``reached`` is called with the share of the work that is done.

    The files appear in ``out`` when all are ready; other files there stay.

    Raises:
        SkylessError: ``out`` cannot be a folder with the report.
    """
    with _scratch(out) as folder:
        results = run_tasks([task for figure in _FIGURES for task in figure.tasks(plan)], reached, processes)
        with report_style():
            sections = [figure.section(plan, results) for figure in _FIGURES]
            report = _write(plan, sections, results, folder, out)
        _move(folder, out)
    return report


def run_tasks(tasks: list[Task], reached: Callable[[float], None], processes: int | None = None) -> dict[str, Any]:
    """Results of the tasks by name; the longest begin first. An interrupt stops all of them."""
    context = multiprocessing.get_context("spawn")
    total_s = sum(task.weight_s for task in tasks)
    done_s, stop = context.Value("d", 0.0), context.Event()
    workers = min(processes or cores(), len(tasks))
    with ProcessPoolExecutor(workers, context, _start_worker, (done_s, stop)) as pool:
        try:
            futures = {pool.submit(_run, task): task.name for task in sorted(tasks, key=lambda task: -task.weight_s)}
            waiting: set[Future[Any]] = set(futures)
            while waiting:
                finished, waiting = wait(waiting, _POLL_S, FIRST_COMPLETED)
                for future in finished:
                    future.result()
                reached(done_s.value / total_s)
        except BaseException:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return {name: future.result() for future, name in futures.items()}


def _start_worker(done_s: "Synchronized[float]", stop: Event) -> None:
    """An interrupt reaches all processes of a terminal; the parent alone acts on it and stops the others."""
    import signal  # noqa: PLC0415 - only workers need it

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _shared.update(done_s=done_s, stop=stop)


def _run(task: Task) -> Any:  # noqa: ANN401 - each task has a result of its own
    """Run one task in a worker."""
    done_s, stop = _shared["done_s"], _shared["stop"]
    reported = 0.0

    def progress(share: float) -> None:
        nonlocal reported
        if stop.is_set():
            raise StoppedError
        if share - reported >= 0.01 or share >= 1.0 > reported:
            with done_s.get_lock():
                done_s.value += (share - reported) * task.weight_s
            reported = share

    result = task.function(progress, **task.arguments)
    progress(1.0)
    return result


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
