"""Compiling ahead in several processes: counts, marks, failures, two programs at once; and nothing is forgotten."""

import asyncio
import fcntl
import json
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest

from skyless.core.kernels import processes
from skyless.core.kernels.cache import KernelFolder
from skyless.core.kernels.processes import LAB, SIMULATED, Part, Preparation, compile_parts, missing, parts_of

pytestmark = pytest.mark.site

TINY = """
from skyless.core.kernels.compiled import kernel

@kernel
def first(value: float) -> float:
    return value + 1.0

@kernel
def second(value: float) -> float:
    return first(value) + 1.0

def compile_all(name: str) -> None:
    print(second(1.0), name)
    if name == "wrong":
        raise ValueError(name)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder of kernels, and a module ``tiny`` with two of them, for the processes that are started."""
    (tmp_path / "tiny.py").write_text(TINY)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    folder = KernelFolder(tmp_path / "marks", "key", writable=True, temporary=False)
    folder.path.mkdir()
    monkeypatch.setattr(processes, "kernel_folder", lambda: folder)
    return folder


def tiny(name, *after):
    return Part(name, "tiny:compile_all", (name,), after=after)


@pytest.mark.statistical
def test_parts_are_compiled_once_and_counted(folder):
    reports = []
    parts = (tiny("one"), tiny("two", "one"))
    assert missing(parts) == parts
    asyncio.run(compile_parts(parts, reports.append))
    assert missing(parts) == ()
    assert reports[0].done == 0
    assert all(earlier.done <= later.done for earlier, later in pairwise(reports))
    assert all(report.left_s is None or report.left_s >= 0.0 for report in reports)
    assert len(list((folder.path.parent / "kernels").rglob("*.nbi"))) == 2
    again = []
    asyncio.run(compile_parts(parts, again.append))
    assert again == []


def test_a_slow_machine_is_promised_nothing_before_it_is_measured_and_little_that_is_wrong_after():
    """Fourteen times slower than typical, one core: the first forecast may not be that of a fast machine."""
    begun, waiting = (processes._Progress(part.typical_s, part.timeline, total=100) for part in LAB)
    whole_s, waiting_s = 14.0 * begun.typical_s, 14.0 * waiting.typical_s
    begun.begun_s = 0.0
    for share in np.linspace(0.0, 0.99, 100):
        begun.done = int(np.interp(share, begun.timeline, np.linspace(0.0, 100.0, len(begun.timeline))))
        told_s = processes._time_left_s([begun, waiting], share * whole_s, 1)
        if share < 0.25:
            assert told_s is None
        elif share > 0.3:
            assert told_s == pytest.approx((1.0 - share) * whole_s + waiting_s, rel=0.25)
    assert processes._time_left_s([waiting], 0.0, 1) is None


@pytest.mark.statistical
def test_a_part_that_fails_is_reported_and_the_others_are_compiled(folder):
    parts = (tiny("wrong"), tiny("fine", "wrong"))
    failures = asyncio.run(compile_parts(parts, lambda _: None))
    assert failures == ("the kernels of wrong could not be compiled: ValueError: wrong",)
    assert missing(parts) == parts[:1]


def test_a_process_that_cannot_be_started_is_reported_too(folder, monkeypatch):
    start = asyncio.create_subprocess_exec

    async def refuse(*words, **more):
        if "wrong" in words:
            raise BlockingIOError("too many processes")
        return await start(*words, **more)

    monkeypatch.setattr(asyncio, "create_subprocess_exec", refuse)
    parts = (tiny("wrong"), tiny("fine", "wrong"))
    failures = asyncio.run(compile_parts(parts, lambda _: None))
    assert failures == ("the kernels of wrong could not be compiled: too many processes",)
    assert missing(parts) == parts[:1]


def test_a_second_program_waits_and_shows_what_the_first_reports(folder):
    async def compile_beside_another():
        reports = []
        with (folder.path / "compiling").open("wb") as held:
            fcntl.flock(held, fcntl.LOCK_EX)
            held.write(msgspec.json.encode(Preparation(37, 120, 25.0)))
            held.flush()
            waiting = asyncio.ensure_future(compile_parts((tiny("one"),), reports.append))
            while not reports:
                await asyncio.sleep(0.01)
            folder.mark_ready("one")
        await waiting
        return reports

    assert set(asyncio.run(compile_beside_another())) == {Preparation(37, 120, 25.0)}
    assert not (folder.path.parent / "kernels").exists()


def test_its_processes_end_with_it(folder):
    async def cancel():
        begun = asyncio.Event()
        running = asyncio.ensure_future(compile_parts((tiny("one"),), lambda _: begun.set()))
        await begun.wait()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children")
    before = children.read_text().split() if children.exists() else []  # other tests' resource tracker among them
    asyncio.run(cancel())
    assert not children.exists() or set(children.read_text().split()) <= set(before)
    assert not folder.is_ready("one")


def test_where_nothing_is_compiled_nothing_is_missing(folder, monkeypatch):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert missing(LAB) == ()


def test_a_folder_that_cannot_be_written_is_left_alone(folder, monkeypatch):
    closed = msgspec.structs.replace(folder, writable=False)
    monkeypatch.setattr(processes, "kernel_folder", lambda: closed)
    reports = []
    asyncio.run(compile_parts((tiny("one"),), reports.append))
    assert reports == []


def test_snapshots_need_no_estimator():
    assert parts_of("weighted") == (SIMULATED,)
    assert parts_of("joint") == LAB


NOTHING_NEW = """
import json
from numba.core import event
from skyless.cli.common.progress import loading_kernels
from skyless.core.kernels.processes import LAB, parts_of

compiled = []

class Listener(event.Listener):
    def on_start(self, event):
        compiled.append(event.data["dispatcher"].py_func.__qualname__)

    def on_end(self, event):
        pass

with loading_kernels(*LAB):
    event.register("numba:compile", Listener())
    from skyless.research.compile_ahead import compile_kernels
    from skyless.core.method_names import METHODS

    for method in METHODS:
        compile_kernels(method)
print(json.dumps(compiled))
"""


@pytest.mark.statistical
def test_after_the_parts_of_the_lab_nothing_is_left_to_compile():
    """What this finds missing is compiled first, as at any first start."""
    done = subprocess.run([sys.executable, "-c", NOTHING_NEW], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []
