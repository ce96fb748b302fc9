"""Programs that a program starts: watched, started again when they die, ended together."""

import asyncio
import contextlib
import os
import signal
import sys
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from msgspec import Struct

from skyless.run.process import Log, end_with_parent

_RESTART_S: Final = 0.2
_LONGEST_RESTART_S: Final = 5.0
"""Pause before a program is started again. It doubles while the program ends soon after each start."""
_GOOD_RUN_S: Final = 10.0  # a program that has run for this time was not faulty from the start

_STOP_S: Final = 5.0
_LINES: Final = 20
_LINE_BYTES: Final = 500
_COMMAND: Final = (sys.executable, "-m", "skyless.cli.main")


class Program(Struct, frozen=True):
    """A command of ``skyless`` to run."""

    name: str
    arguments: tuple[str, ...]
    new_file: int | None = None
    """Index among the arguments of a file that must not exist: later starts get another name, and the program is not
    started again when it has ended by itself (a full disk, its limit reached)."""
    start_after_s: float = 0.0
    """Its first start is so much later."""
    logs_lines: bool = False
    """Whether its lines on standard error are logged as they come; otherwise the last one is, when it ends."""
    environment: Mapping[str, str] = {}
    """Variables in addition to those of this program."""

    def start(self, number: int) -> tuple[str, ...]:
        """Arguments of its first, second ... start."""
        if self.new_file is None or number == 1:
            return self.arguments
        path = Path(self.arguments[self.new_file])
        renamed = str(path.with_stem(f"{path.stem}-{number}"))
        return (*self.arguments[: self.new_file], renamed, *self.arguments[self.new_file + 1 :])


class Child:
    """One program, started again whenever it ends."""

    def __init__(self, program: Program, log: Log) -> None:
        self.program = program
        self.starts = 0
        self.pid: int | None = None  # of the running process
        self._log = log
        self._is_asked = False
        self._last_lines: deque[str] = deque(maxlen=_LINES)
        self._line = b""

    def restart(self) -> None:
        """Start it again now, with no word about it: what it read at its start has changed."""
        if self.pid is not None:
            self._is_asked = True
            with contextlib.suppress(ProcessLookupError):  # it has just ended by itself
                os.kill(self.pid, signal.SIGTERM)

    async def run(self) -> None:
        """Keep it alive until cancelled, or until it has ended for good."""
        if self.program.start_after_s > 0.0:
            await asyncio.sleep(self.program.start_after_s)
        wait_s = _RESTART_S
        while True:
            begun_s = asyncio.get_running_loop().time()
            code = await self._run_once()
            if self._is_asked:
                self._is_asked = False
                self.starts -= 1
                continue
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            ended = f"{self.program.name} ended ({how}); {self._last_message()}"
            if self.program.new_file is not None and code >= 0:
                self._log(ended)
                return
            self._log(f"{ended}; started again")
            was_good = asyncio.get_running_loop().time() - begun_s > _GOOD_RUN_S
            wait_s = _RESTART_S if was_good else min(2.0 * wait_s, _LONGEST_RESTART_S)
            await asyncio.sleep(wait_s)

    async def _run_once(self) -> int:
        self.starts += 1
        self._last_lines.clear()
        self._line = b""
        # asyncio's own pipes report a program's end only when its children have closed them too
        read_end, write_end = os.pipe()
        os.set_blocking(read_end, False)
        loop = asyncio.get_running_loop()
        loop.add_reader(read_end, self._read_lines, read_end)
        try:
            process = await self._start(write_end)
            self.pid = process.pid
            try:
                code = await process.wait()
                self._read_lines(read_end)
                return code
            finally:
                self.pid = None
                await end(process)
        finally:
            loop.remove_reader(read_end)
            os.close(read_end)

    async def _start(self, stderr: int) -> asyncio.subprocess.Process:
        """Start the program. Standard error goes to a pipe, whose end on this side is closed."""
        try:
            return await asyncio.create_subprocess_exec(
                *(*_COMMAND, *self.program.start(self.starts)),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.DEVNULL,
                stderr=stderr,
                env={**os.environ, **self.program.environment},
                start_new_session=True,  # Ctrl-C in a terminal is for its parent
                preexec_fn=end_with_parent(),
            )
        finally:
            os.close(stderr)

    def _read_lines(self, pipe: int) -> None:
        """Keep the last lines, and only the end of a very long one."""
        with contextlib.suppress(BlockingIOError):
            while piece := os.read(pipe, _LINE_BYTES):
                *lines, self._line = (self._line + piece).split(b"\n")
                self._line = self._line[-_LINE_BYTES:]
                for line in (line.decode(errors="replace").rstrip() for line in lines):
                    self._last_lines.append(line)
                    if self.program.logs_lines:
                        self._log(f"{self.program.name}: {line}")
            asyncio.get_running_loop().remove_reader(pipe)

    def _last_message(self) -> str:
        """What it wrote last, which need not be why it ended: a program that is killed cannot say so."""
        if begun := self._line.decode(errors="replace").strip():
            return f'its last message, unfinished: "{begun}"'
        line = next((line for line in reversed(self._last_lines) if line), None)
        return "it wrote no message" if line is None else f'its last message: "{line}"'


async def end(process: asyncio.subprocess.Process) -> None:
    """Terminate a process. Kill it if it does not end."""
    if process.returncode is not None:
        return
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    try:
        async with asyncio.timeout(_STOP_S):
            await process.wait()
    except TimeoutError:
        process.kill()
        await process.wait()
