"""A process of its own for what would delay the pages, or would load NumPy into the server: one task at a time."""

import asyncio
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Final

_TIMEOUT_S: Final = 120.0
_IDLE_S: Final = 60.0
"""A process without a task for this long is ended: it has loaded a hundred megabytes."""

_LENGTH_BYTES: Final = 8
_NICE: Final = 19  # positioning on this machine has priority


class TaskError(Exception):
    """Why a task was not done."""


class TaskProcess:
    """Runs a module that does tasks, one after the other."""

    def __init__(self, module: str) -> None:
        """``module`` calls ``serve_tasks`` when it is run."""
        self._module = module
        self._process: subprocess.Popen[bytes] | None = None
        self._idle: asyncio.TimerHandle | None = None
        self._stopped = False

    def stop(self) -> None:
        """Stop the task at hand. No other starts."""
        self._stopped = True
        self._kill()

    async def run(self, task: bytes) -> bytes:
        """The result of a task, empty where the process failed and has written why. Raises TaskError."""
        if self._stopped:
            raise TaskError("the dashboard is stopping")
        if self._idle is not None:
            self._idle.cancel()
        try:
            async with asyncio.timeout(_TIMEOUT_S):
                result = await asyncio.to_thread(self._exchange, task)
        except TimeoutError:
            self._kill()
            raise TaskError("it takes too long") from None
        except BaseException:
            self._kill()  # what it would answer belongs to no later task
            raise
        self._idle = asyncio.get_running_loop().call_later(_IDLE_S, self._kill)
        return result

    def _exchange(self, task: bytes) -> bytes:
        process = self._process
        if process is None or process.poll() is not None:
            self._process = process = subprocess.Popen(
                (sys.executable, "-m", self._module),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,  # Ctrl-C stops the dashboard, which kills this process itself
            )
        if process.stdin is None or process.stdout is None:
            raise TaskError("its process has no pipes")
        try:
            process.stdin.write(len(task).to_bytes(_LENGTH_BYTES, "little") + task)
            process.stdin.flush()
            head = process.stdout.read(_LENGTH_BYTES)
            return process.stdout.read(int.from_bytes(head, "little"))
        except (OSError, ValueError):  # ValueError: it was killed meanwhile, and its pipes are closed
            return b""

    def _kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


def serve_tasks(answer: Callable[[bytes], bytes]) -> None:
    """Answer the tasks of standard input on standard output, until it is closed."""
    os.nice(_NICE)
    tasks, results = sys.stdin.buffer, sys.stdout.buffer
    while len(head := tasks.read(_LENGTH_BYTES)) == _LENGTH_BYTES:
        result = answer(tasks.read(int.from_bytes(head, "little")))
        results.write(len(result).to_bytes(_LENGTH_BYTES, "little") + result)
        results.flush()
