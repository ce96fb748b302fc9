"""Compile parts of the kernels, each by a process, on all cores, unless another program is doing so already.

A process compiles its part by running it. Two parts of one computation differ in the packages whose kernels they
compile: the others' run as plain Python, slowly, which a fifth of a second of the lab can afford.
"""

import asyncio
import contextlib
import fcntl
import os
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterable
from typing import IO, Final

import msgspec
from msgspec import Struct

from skyless.core.kernels.cache import ONLY_VARIABLE, KernelFolder, kernel_folder
from skyless.core.kernels.processors import cores
from skyless.core.method_names import FILTERS, SNAPSHOTS


class Part(Struct, frozen=True):
    """Kernels that one process compiles."""

    name: str
    run: str
    """``module:function`` to call."""
    arguments: tuple[str, ...] = ()
    only: tuple[str, ...] = ()
    """Packages whose kernels are compiled; those with a minus are left out. If empty, the kernels of all packages."""
    after: tuple[str, ...] = ()
    """Parts that have to be compiled first, because this one is made of them."""
    typical_s: float = 15.0
    """Seconds of one core of 2024, only to compare parts: what the running ones take gives those that wait."""
    timeline: tuple[float, ...] = (0.0, 1.0)
    """Shares of its time that are over when 0 ... 100 % of its kernels are compiled, at equal distances."""


_ESTIMATOR: Final = "skyless.core.estimator"
_LAB: Final = "skyless.research.compile_ahead:compile_kernels"

_AIR_TIMELINE: Final = (0.0, 0.22, 0.44, 0.7, 0.73, 0.83, 0.96, 1.0, 1.0, 1.0, 1.0)
_ESTIMATOR_TIMELINE: Final = (0.0, 0.07, 0.11, 0.14, 0.18, 0.23, 0.29, 0.41, 0.61, 0.99, 1.0)

ESTIMATOR: Final = Part(
    "estimator", _LAB, FILTERS, (_ESTIMATOR, "skyless.core.kernels"), typical_s=60.0, timeline=_ESTIMATOR_TIMELINE
)
SIMULATED: Final = Part("air", _LAB, SNAPSHOTS, (f"-{_ESTIMATOR}",), typical_s=12.0, timeline=_AIR_TIMELINE)
"""The simulated radio world, anchors, and positions from snapshots, from which the estimator starts."""

PAIRS: Final = Part("pairs", "skyless.research.compile_ahead:compile_pair_kernels", typical_s=20.0)
"""Differences of ranges, as some recordings hold them."""

_PACKETS: Final = Part(
    "packets", "skyless.research.compile_ahead:compile_packet_kernels", after=("estimator",), typical_s=5.0
)

LAB: Final = (ESTIMATOR, SIMULATED)
SNIFFERS: Final = (ESTIMATOR, _PACKETS)
EVERY_PART: Final = (*LAB, PAIRS, _PACKETS)
"""Every method, at sites of every kind of radio."""


def parts_of(method: str) -> tuple[Part, ...]:
    """What the programs of a site with this method need."""
    return LAB if method in FILTERS else (SIMULATED,)


_WAIT_S: Final = 0.25
_REPORT_S: Final = 0.25
_SURE_SHARE: Final = 0.25
"""From here on the time left of a part follows from the time spent; before, nothing is promised."""


class Preparation(Struct, frozen=True):
    """How far the compilation is."""

    done: int
    total: int
    left_s: float | None
    """Estimated from what has been done; None while that is too little."""


Report = Callable[[Preparation], None]


def missing(parts: Iterable[Part]) -> tuple[Part, ...]:
    """Parts that have not been compiled for these sources and this processor."""
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"} or ONLY_VARIABLE in os.environ:
        return ()  # nothing is compiled, or this is the process that compiles
    folder = kernel_folder()
    return tuple(part for part in parts if not folder.is_ready(part.name))


async def compile_parts(parts: Iterable[Part], report: Report) -> tuple[str, ...]:
    """Compile what is missing of these parts; ``report`` is called a few times a second while it lasts.

    Returns a sentence for each part that could not be compiled; what needs its kernels will try again itself. Where no
    folder can be written this does nothing: every program then compiles for itself.
    """
    folder = kernel_folder()
    wanted = missing(parts)
    if not wanted or not folder.writable:
        return ()
    async with _only_one(folder, report) as notes:
        return await _Run(missing(wanted), folder, report, notes).run()


class _Progress(Struct):
    """How far one part is."""

    typical_s: float
    timeline: tuple[float, ...]
    done: int = 0
    total: int = 0
    begun_s: float | None = None
    ended_s: float | None = None

    @property
    def ended(self) -> bool:
        return self.ended_s is not None

    def whole_s(self, now_s: float) -> float | None:
        """Time from begin to end as the share done shows it; None while that is too little."""
        if self.begun_s is None:
            return None
        share = 1.0 if self.ended else self._share()
        end_s = now_s if self.ended_s is None else self.ended_s
        return None if share < _SURE_SHARE else (end_s - self.begun_s) / share

    def _share(self) -> float:
        """Share of its time that is over, by its kernels."""
        if not self.total:
            return 0.0
        at = self.done / self.total * (len(self.timeline) - 1)
        before = min(int(at), len(self.timeline) - 2)
        begin, end = self.timeline[before : before + 2]
        return begin + (at - before) * (end - begin)


class _Run:
    """The processes of one compilation."""

    def __init__(self, parts: tuple[Part, ...], folder: KernelFolder, report: Report, notes: IO[bytes]) -> None:
        self._parts, self._folder, self._report, self._notes = parts, folder, report, notes
        self._progress = {part.name: _Progress(part.typical_s, part.timeline) for part in parts}
        self._failures: list[str] = []
        self._ended = {part.name: asyncio.Event() for part in parts}
        self._free = asyncio.Semaphore(cores())

    async def run(self) -> tuple[str, ...]:
        reporting = asyncio.ensure_future(self._report_all())
        try:
            async with asyncio.TaskGroup() as group:
                for part in sorted(self._parts, key=lambda part: -part.typical_s):
                    group.create_task(self._compile(part))
        finally:
            reporting.cancel()
        return tuple(self._failures)

    async def _compile(self, part: Part) -> None:
        for name in part.after:
            if name in self._ended:
                await self._ended[name].wait()
        progress = self._progress[part.name]
        async with self._free:
            progress.begun_s = time.monotonic()
            try:
                problem = await self._run_worker(part, progress)
            except OSError as error:  # a full disk, or too many processes
                problem = str(error)
        progress.done, progress.ended_s = progress.total, time.monotonic()
        self._ended[part.name].set()
        if problem:
            self._failures.append(f"the kernels of {part.name} could not be compiled: {problem}")
        else:
            self._folder.mark_ready(part.name)

    async def _run_worker(self, part: Part, progress: _Progress) -> str:
        """Compile a part; the reason where that fails. Raises OSError."""
        with tempfile.TemporaryFile(dir=self._folder.path) as errors:
            async with _worker(part, errors) as process:
                assert process.stdout is not None
                async for line in process.stdout:
                    progress.done, progress.total = msgspec.json.decode(line, type=tuple[int, int])
                code = await process.wait()
            errors.seek(0)
            last = errors.read().decode(errors="replace").strip().rpartition("\n")[2]
        return "" if code == 0 else last or f"exit code {code}"

    async def _report_all(self) -> None:
        while True:
            now = self._now()
            self._report(now)
            with contextlib.suppress(OSError):
                self._notes.truncate(0)
                self._notes.write(msgspec.json.encode(now))
                self._notes.flush()
            await asyncio.sleep(_REPORT_S)

    def _now(self) -> Preparation:
        progress = self._progress.values()
        left_s = _time_left_s(progress, time.monotonic(), cores())
        return Preparation(sum(one.done for one in progress), sum(one.total for one in progress), left_s)


def _time_left_s(parts: Iterable[_Progress], now_s: float, at_once: int) -> float | None:
    """Time until all parts are compiled, with a number of them running at once; None where too little is known.

    Parts that wait take as much longer than is typical as those that were begun.
    """
    wholes_s = [(part, part.whole_s(now_s)) for part in parts]
    if any(whole_s is None for part, whole_s in wholes_s if part.begun_s is not None):
        return None
    slowness = [whole_s / part.typical_s for part, whole_s in wholes_s if whole_s is not None]
    if not slowness:
        return None
    left_s = [
        part.typical_s * max(slowness)
        if whole_s is None or part.begun_s is None
        else 0.0
        if part.ended
        else max(whole_s - (now_s - part.begun_s), 0.0)
        for part, whole_s in wholes_s
    ]
    return max(*left_s, sum(left_s) / at_once)


@contextlib.asynccontextmanager
async def _worker(part: Part, errors: IO[bytes]) -> AsyncIterator[asyncio.subprocess.Process]:
    """The process of a part, ended where its owner is cancelled."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "skyless.core.kernels.worker",
        part.run,
        *part.arguments,
        stdin=asyncio.subprocess.PIPE,  # closed when this program has gone, however that came about
        stdout=asyncio.subprocess.PIPE,
        stderr=errors,
        start_new_session=True,  # Ctrl-C in a terminal is for its parent
        env={**os.environ, ONLY_VARIABLE: ",".join(part.only)},
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()


@contextlib.asynccontextmanager
async def _only_one(folder: KernelFolder, report: Report) -> AsyncIterator[IO[bytes]]:
    """Wait until no other program compiles, reporting what it reports; gives a file for the own reports."""
    with (folder.path / "compiling").open("ab+") as notes:
        while not _lock(notes):
            notes.seek(0)
            with contextlib.suppress(msgspec.MsgspecError):
                report(msgspec.json.decode(notes.read(), type=Preparation))
            await asyncio.sleep(_WAIT_S)
        yield notes


def _lock(file: IO[bytes]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True
