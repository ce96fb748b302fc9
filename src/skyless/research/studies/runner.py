"""How studies run: plans, cells over all cores, and finished parts that are kept.

``reached`` is called with the share of the work that is done, ``keep`` with number and result of each finished cell.
"""

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from hashlib import sha256
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec
import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.errors import SkylessError
from skyless.core.integrity import RISK
from skyless.core.version import installed_version, program_digest
from skyless.files import write_whole
from skyless.machine import cores

# What a study is: independent cells of work, and rows of a table that come of their results.


class Plan(Struct, frozen=True):
    """How much is simulated, and with what."""

    method: str = "joint"
    seed: int = 1
    quick: bool = False
    conditions: str = "usual"
    """Cases of the study ``room``, a key of ``CONDITIONS``."""
    noise_ps: float = 100.0
    """Noise of every TX and RX stamp, which filters know."""
    worlds: int = 12
    """Independent worlds of a case; what scatters between them gives the standard errors."""
    seconds: float = 20.0
    """True time for which each world is judged."""
    tags: int = 4
    """In each world."""
    episodes: int = 2000
    """Episodes in a case of the studies ``efficiency`` and ``integrity``."""
    integrity_risk: float = RISK
    """Stated probability that a fix's error exceeds its protection level (``integrity``)."""
    alert_limit_m: float | None = None
    """Fixes with a higher level count as not available (``integrity``)."""


_QUICK_PLAN: Final = Plan(worlds=6, seconds=10.0, tags=2, episodes=200)

_QUICK_PLANS: Final = {"room": replace(_QUICK_PLAN, worlds=3, seconds=5.0)}

_USUAL: Final = {
    "room": Plan(worlds=20, seconds=15.0, tags=5),
    "large": Plan(worlds=24, seconds=30.0),
    "survey": Plan(worlds=200, seconds=10.0),
    "survey-room": Plan(worlds=8, seconds=15.0, tags=8),
    "watch": Plan(worlds=20),
}
"""Amounts of studies that need others than those of ``Plan``; ``room`` has fewer worlds in all but its first case."""


def plan_of(method: str, seed: int, *, study: str = "", quick: bool = False, **given: Any) -> Plan:  # noqa: ANN401 - of Plan
    """The plan: default amounts, or few with ``quick``, where none are given."""
    known = {name: value for name, value in given.items() if value is not None}
    if known.get("conditions", "usual") != "usual":
        study = ""
    usual = _QUICK_PLANS.get(study, _QUICK_PLAN) if quick else _USUAL.get(study, Plan())
    return replace(usual, method=method, seed=seed, quick=quick, **known)


class Cell(Struct, frozen=True):
    """Independent work, which may run in any process of any machine."""

    name: str
    """Name of the case to which it belongs."""
    function: Callable[[], Any]
    """A function defined at the top of a module, with its arguments."""
    weight_s: float
    """Approximate duration: the longest cells begin first."""


AnyCase = TypeVar("AnyCase")


def of_cases(cases: Sequence[AnyCase], results: Sequence[Any]) -> list[tuple[AnyCase, Sequence[Any]]]:
    """Each case with the results of its cells, of which all cases have the same number."""
    each = len(results) // len(cases)
    return [(case, results[each * number : each * (number + 1)]) for number, case in enumerate(cases)]


class Limit(Struct, frozen=True):
    """What a figure of a row should be at least, at most, or both."""

    figure: str
    """Name of the row's field."""
    least: float | None = None
    most: float | None = None

    def __str__(self) -> str:
        low, high = ("" if one is None else f"{one:g}" for one in (self.least, self.most))
        return f"{self.figure}:{low}..{high}"

    def holds(self, row: "Row") -> bool:
        """Whether a row's figure is within. A missing one exceeds nothing (levels that no fix gives)."""
        value = getattr(row, self.figure)
        if value is None:
            return self.least is None
        return bool((self.least is None or value >= self.least) and (self.most is None or value <= self.most))


class Row(Struct, frozen=True, kw_only=True):
    """Results of a case; lengths in metres, None where it does not apply. All is simulated.

    Studies add figures of their own. All depends on the plan alone, except for ``MEASURED``.
    """

    study: str
    method: str
    case: str
    series: str
    """Cases of a series differ in one thing."""
    x: float | None = None
    """The amount of that thing, where it is a number."""
    mesh: bool | None = None
    """None for methods that do not use anchors' receptions of each other."""
    noise_ps: float
    runs: int
    """Independent runs: worlds, or episodes."""
    fixes: int = 0
    """Fixes that were judged."""
    rmse_m: float | None = None
    rmse_error_m: float | None = None
    """Standard error of ``rmse_m``."""
    p95_m: float | None = None
    max_m: float | None = None
    said_m: float | None = None
    """Predicted by the fixes: root of the mean trace of their covariances."""
    nees: float | None = None
    """Mean normalised error squared over the degrees of freedom: 1 for fixes whose covariances are right."""
    nees_interval: tuple[float, float] | None = None
    """Where ``nees`` lies with a probability of 99 % if they are."""
    available: float | None = None
    """Superframes with a fix over all superframes."""
    bound_m: float | None = None
    """Cramér–Rao bound of what the tag knew."""
    ratio: float | None = None
    """RMSE over the bound, or over the RMSE of another case."""
    ratio_error: float | None = None
    limits: tuple[Limit, ...] = ()
    missed: tuple[str, ...] = ()
    """Figures outside of them."""
    passed: bool | None = None


AnyRow = TypeVar("AnyRow", bound=Row)


def with_limits(row: AnyRow, limits: Sequence[Limit]) -> AnyRow:
    """Add limits and the figures that miss them to a row. Without a fix there is no error, which misses its limit."""
    if not limits:
        return row
    lacking = {one.figure for one in limits if getattr(row, one.figure) is None} - {"level", "exceeded"}
    missed = tuple(one.figure for one in limits if not one.holds(row) or (one.figure in lacking and not row.fixes))
    return replace(row, limits=tuple(limits), missed=missed, passed=not missed)


class Study(Struct, frozen=True):
    """A study: its cells, their rows, and its picture."""

    name: str
    title: str
    cells: Callable[[Plan], list[Cell]]
    rows: Callable[[Plan, Sequence[Any]], Sequence[Row]]
    """Takes the results in the order of the cells."""
    panels: tuple[str, ...]
    """Panels of the picture (``picture.PANELS``), side by side."""
    x: str = ""
    """What the numbers of a series mean; by default the series says it."""


MEASURED: Final = ("cpu_us_per_message", "cpu_ms_per_tag_s")
"""Fields of a row that differ between runs of the same plan."""


def seed_of(seed: int, *numbers: int) -> int:
    """A seed for one of many independent runs."""
    return int(np.random.SeedSequence([seed, *numbers]).generate_state(1, np.uint64)[0])


_POLL_S: Final = 0.2

_ENDING_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
"""SIGALRM among them: the command line delays by it an interrupt that came during an import."""

Reached = Callable[[float], None]
Keep = Callable[[int, Any], None]


class UnfinishedError(SkylessError):
    """Why work ended early."""


def run_cells(
    cells: Sequence[Cell], reached: Reached, processes: int | None = None, keep: Keep = lambda *_: None
) -> list[Any]:
    """Results in the order of the cells, computed by ``processes`` processes, by default one for each core.

    One process is this one, which computes one cell after the other. An interrupt ends all processes at once.

    Raises UnfinishedError: a process died.
    """
    if processes == 1 or not cells:
        return _one_by_one(cells, reached, keep)
    with _pool(min(processes or cores(), len(cells))) as pool:
        try:
            return _map(lambda cell: pool.submit(cell.function), cells, reached, keep)
        except BrokenProcessPool:
            raise UnfinishedError("a process died, killed from outside or for want of memory") from None


def _one_by_one(cells: Sequence[Cell], reached: Reached, keep: Keep) -> list[Any]:
    total_s, done_s, results = sum(cell.weight_s for cell in cells), 0.0, []
    for number, cell in enumerate(cells):
        results.append(cell.function())
        keep(number, results[-1])
        done_s += cell.weight_s
        reached(done_s / total_s)
    return results


def _map(submit: Callable[[Cell], Future[Any]], cells: Sequence[Cell], reached: Reached, keep: Keep) -> list[Any]:
    """The longest cells begin first."""
    order = sorted(range(len(cells)), key=lambda number: -cells[number].weight_s)
    with _uninterrupted():
        waiting = {submit(cells[number]): number for number in order}
    total_s, done_s, results = sum(cell.weight_s for cell in cells), 0.0, {}
    while waiting:
        for future in wait(waiting, _POLL_S, FIRST_COMPLETED).done:
            number = waiting.pop(future)
            results[number] = future.result()
            keep(number, results[number])
            done_s += cells[number].weight_s
        reached(done_s / total_s)
    return [results[number] for number in range(len(cells))]


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Hold back what ends this process until the block ends; processes that start in it never get Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    # Processes inherit the mask. This program needs handlers as well: where its main thread masks a signal, the system
    # gives it to another thread, such as one of NumPy's, and Python would interrupt the main thread all the same.
    signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING_SIGNALS)
    handlers = {number: signal.signal(number, lambda number, _: came.append(number)) for number in _ENDING_SIGNALS}
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING_SIGNALS)  # what was held back by it comes to these handlers
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if came:
        signal.raise_signal(came[0])


@contextmanager
def _pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that end when the block is left by an exception, or when this process ends."""
    context = multiprocessing.get_context("spawn")
    reader, writer = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(processes, context, _start_worker, (reader,))
    try:
        yield pool
    except BaseException:
        writer.close()
        pool.shutdown(wait=True, cancel_futures=True)
        raise
    else:
        pool.shutdown()
    finally:
        writer.close()
        reader.close()


def _start_worker(parent: Connection) -> None:
    """End this process as soon as the other end of the pipe is closed, in the middle of a cell if need be."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})

    def watch() -> None:
        try:
            parent.recv_bytes()
        except (EOFError, OSError):
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# Results of a study's finished cells in a folder, from which a later call goes on.
#
# Each is a file of its own, which is there whole or not at all, and begins with a digest of the study and of itself.
# They are pickles of Python: a folder of somebody else can run any program.


class KeptResults:
    """The folder of one study."""

    def __init__(self, folder: str | Path, study: str, plan: Plan) -> None:
        """Raises SkylessError: the folder cannot be used, or is of another study, plan or program."""
        self._folder = folder = Path(folder)
        program = {"version": installed_version(), "source digest": program_digest()}
        asked = {"study": study, **msgspec.to_builtins(plan), **program}
        self._head = msgspec.json.encode(asked)
        head = folder / "study.json"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            there = msgspec.json.decode(head.read_bytes(), type=dict[str, Any]) if head.exists() else asked
        except OSError as error:
            raise SkylessError(f"--resume is {str(folder)!r}, which cannot be used: {error.strerror}") from None
        except (msgspec.MsgspecError, UnicodeError):
            raise SkylessError(f"--resume: {head} is damaged; give another folder") from None
        for name, value in asked.items():
            if there.get(name) != value:
                raise SkylessError(
                    f"--resume is {str(folder)!r}, of another study: {name} is {there.get(name)!r} there, "
                    f"{value!r} here; give another folder"
                )
        self._write(head, self._head)

    def read(self, cells: int) -> tuple[dict[int, Any], tuple[str, ...]]:
        """The kept results by the numbers of their cells, and the names of damaged files."""
        results, damaged = {}, []
        for number in range(cells):
            file = self._file(number)
            try:
                read = file.read_bytes()
            except OSError:
                continue
            digest, data = read[:32], read[32:]
            if digest == self._digest(data):
                results[number] = pickle.loads(data)
            else:
                damaged.append(str(file))
        return results, tuple(damaged)

    def keep(self, number: int, result: object) -> None:
        """Write the result of a cell. Raises SkylessError."""
        data = pickle.dumps(result)
        self._write(self._file(number), self._digest(data) + data)

    def _file(self, number: int) -> Path:
        return self._folder / f"{number:05}.part"

    def _digest(self, data: bytes) -> bytes:
        return sha256(self._head + data).digest()

    def _write(self, file: Path, data: bytes) -> None:
        try:
            write_whole(file, data)
        except OSError as error:
            raise SkylessError(f"--resume: {file} cannot be written: {error.strerror}") from None
