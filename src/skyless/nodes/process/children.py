"""Programs that a program starts: watched, started again when they die, ended together."""

import asyncio
import contextlib
import os
import sys
from collections import deque
from pathlib import Path
from typing import Final

from msgspec import Struct

from skyless.nodes.process.loop import end_with_parent
from skyless.nodes.process.running import Log

_AGAIN_S: Final = 0.2
_LONGEST_S: Final = 5.0
_SOUND_S: Final = 10.0
"""A program that has run for so long was not faulty from the start."""

_STOP_S: Final = 5.0
_LINES: Final = 20
_LINE_BYTES: Final = 500
_COMMAND: Final = (sys.executable, "-m", "skyless.cli.main")


class Program(Struct, frozen=True):
    """A command of ``skyless`` to run."""

    name: str
    arguments: tuple[str, ...]
    new_file: int | None = None
    """Place among the arguments of a file that must not exist; later starts get another one, and there are none after
    an end of its own (a full disk, its limit reached)."""

    def start(self, number: int) -> tuple[str, ...]:
        """Arguments of its first, second ... start."""
        if self.new_file is None or number == 1:
            return self.arguments
        path = Path(self.arguments[self.new_file])
        renamed = str(path.with_stem(f"{path.stem}-{number}"))
        return (*self.arguments[: self.new_file], renamed, *self.arguments[self.new_file + 1 :])


class Child:
    """One program, started again whenever it ends."""

    def __init__(self, program: Program, say: Log) -> None:
        self.program = program
        self.starts = 0
        self.pid: int | None = None
        """Of its present life."""
        self._say = say
        self._last_words: deque[str] = deque(maxlen=_LINES)
        self._line = b""

    async def run(self) -> None:
        """Keep it alive until cancelled, or until it has ended for good."""
        wait_s = _AGAIN_S
        while True:
            begun_s = asyncio.get_running_loop().time()
            code = await self._one_life()
            words = self._last_words[-1] if self._last_words else "it said nothing"
            if self.program.new_file is not None and code >= 0:
                self._say(f"{self.program.name} ended ({_how(code)}): {words}")
                return
            self._say(f"{self.program.name} ended ({_how(code)}): {words}; started again")
            sound = asyncio.get_running_loop().time() - begun_s > _SOUND_S
            wait_s = _AGAIN_S if sound else min(2.0 * wait_s, _LONGEST_S)
            await asyncio.sleep(wait_s)

    async def _one_life(self) -> int:
        self.starts += 1
        self._last_words.clear()
        self._line = b""
        # with asyncio's own pipes a program's death is only seen when its children have closed them too
        ours, theirs = os.pipe()
        os.set_blocking(ours, False)
        loop = asyncio.get_running_loop()
        loop.add_reader(ours, self._listen, ours)
        try:
            process = await self._start(theirs)
            self.pid = process.pid
            try:
                code = await process.wait()
                self._listen(ours)
                return code
            finally:
                self.pid = None
                await end(process)
        finally:
            loop.remove_reader(ours)
            os.close(ours)

    async def _start(self, words: int) -> asyncio.subprocess.Process:
        """Start the program; standard error goes to a pipe, whose end on this side is closed."""
        try:
            return await asyncio.create_subprocess_exec(
                *_COMMAND,
                *self.program.start(self.starts),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.DEVNULL,
                stderr=words,
                start_new_session=True,  # Ctrl-C in a terminal is for the one that started it
                preexec_fn=end_with_parent(),
            )
        finally:
            os.close(words)

    def _listen(self, pipe: int) -> None:
        """Keep the last lines; of a very long one, its end."""
        with contextlib.suppress(BlockingIOError):
            while piece := os.read(pipe, _LINE_BYTES):
                *lines, self._line = (self._line + piece).split(b"\n")
                self._line = self._line[-_LINE_BYTES:]
                self._last_words.extend(line.decode(errors="replace").rstrip() for line in lines)
            asyncio.get_running_loop().remove_reader(pipe)
            if self._line:
                self._last_words.append(self._line.decode(errors="replace").rstrip())


async def end(process: asyncio.subprocess.Process) -> None:
    """Ask a process to end, and make it."""
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


def _how(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"
