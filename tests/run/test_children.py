"""Programs that a program starts: what becomes of them when they die, will not die, or never live."""

import asyncio
import os
import re
import signal
import sys

import pytest
from msgspec import structs

from skyless.run import process
from skyless.run.process import Child, Program, end
from support.mqtt_brokers import stopped
from support.processes import free_port, lives
from support.waiting import until

pytestmark = pytest.mark.site

PYTHON = (sys.executable, "-c")


async def stop(task):
    await stopped(task)


async def first_line(code, name, **options):
    """What is logged first of a program that runs this Python."""
    said = []
    task = asyncio.ensure_future(Child(Program(name, (code,), command=PYTHON, **options), said.append).run())
    await until(lambda: said or task.done(), 10)
    await stop(task)
    return said[0]


async def test_a_program_that_is_killed_is_started_again_and_logged():
    said = []
    child = Child(Program("air", ("ether", "--mqtt", "none", "--listen", f"127.0.0.1:{free_port()}")), said.append)
    task = asyncio.ensure_future(child.run())
    await until(lambda: child.pid is not None)
    first = child.pid
    os.kill(first, signal.SIGKILL)
    await until(lambda: child.pid is not None and child.pid != first)
    second = child.pid
    assert child.starts == 2
    assert said == ["air ended (signal 9); it wrote no message; started again"]
    assert not lives(first)
    assert lives(second)
    child.restart()
    await until(lambda: child.pid not in (None, second))
    assert (child.starts, len(said), lives(second)) == (2, 1, False)
    second = child.pid
    await stop(task)
    assert not lives(second)
    assert child.pid is None


@pytest.mark.statistical
async def test_a_program_that_cannot_live_is_tried_ever_more_seldom_and_its_last_lines_are_reported(monkeypatch):
    waits = []

    said = []
    child = Child(Program("air", ("ether", "--site", "/nowhere.toml")), said.append)
    sleep = asyncio.sleep

    async def note(seconds):
        waits.append(seconds)
        await sleep(0)

    monkeypatch.setattr(process.asyncio, "sleep", note)
    task = asyncio.ensure_future(child.run())
    for _ in range(3000):
        if len(waits) >= 3:
            break
        await sleep(0.01)
    await stop(task)
    expected = r'air ended \(exit code 2\); its last message: "skyless: .*/nowhere.toml.*"; started again'
    assert all(re.fullmatch(expected, line) for line in said)
    assert waits[:3] == sorted(set(waits[:3]))
    assert waits[0] >= 0.2


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("print('tag 2: listening', file=sys.stderr)", 'its last message: "tag 2: listening"'),
        (r"sys.stderr.write('begun\ntag 2: rece')", 'its last message, unfinished: "tag 2: rece"'),
        (r"sys.stderr.write('tag 2: listening\n\n  ')", 'its last message: "tag 2: listening"'),
        ("pass", "it wrote no message"),
    ],
)
@pytest.mark.parametrize("is_held", [False, True])
async def test_what_a_killed_program_wrote_last_is_not_taken_for_why_it_ended(code, message, is_held):
    """Also where it dies in the middle of a line, or its own child holds its standard error open."""
    hold = "import subprocess; subprocess.Popen(['sleep', '5'])" if is_held else "pass"
    code = f"import os, sys; {hold}; {code}; sys.stderr.flush(); os.kill(os.getpid(), 9)"
    assert await first_line(code, "tag 2") == f"tag 2 ended (signal 9); {message}; started again"


async def test_a_program_that_will_not_end_is_made_to(monkeypatch):
    monkeypatch.setattr(process, "_STOP_S", 0.2)

    child = await asyncio.create_subprocess_exec(
        "sh", "-c", "trap '' TERM; echo ready; while :; do sleep 1; done", stdout=asyncio.subprocess.PIPE
    )
    await child.stdout.readline()
    await end(child)
    assert child.returncode == -signal.SIGKILL
    await end(child)  # once more does nothing


async def test_a_very_long_line_of_a_program_s_does_not_end_its_keeper():
    line = await first_line("import sys; sys.stderr.write('x' * 1_000_000)", "page")
    assert line.startswith("page ended (exit code 0); its last message")
    assert 500 < len(line) < 1100


async def test_what_a_program_writes_is_logged_as_it_comes_where_that_is_asked_for():
    code = "import sys, time; print('disk full', file=sys.stderr, flush=True); time.sleep(60)"
    assert await first_line(code, "history", logs_lines=True) == "history: disk full"


async def test_a_program_with_a_new_file_gets_another_at_every_start_and_ends_when_it_logs_it(tmp_path):
    program = Program("recorder", ("record", str(tmp_path / "a.mcap"), "--x"), 1)
    assert program.start(1) == program.arguments
    assert program.start(3) == ("record", str(tmp_path / "a-3.mcap"), "--x")

    said = []
    child = Child(structs.replace(program, command=(*PYTHON, "raise SystemExit(1)")), said.append)
    await asyncio.wait_for(child.run(), 10)
    assert child.starts == 1
    assert len(said) == 1
    child = Child(structs.replace(program, command=(*PYTHON, "import os; os.kill(os.getpid(), 9)")), said.append)
    task = asyncio.ensure_future(child.run())
    await until(lambda: child.starts >= 3, 10)
    await stop(task)
