"""A process of its own for what would delay the pages, or would load NumPy into the server: one task at a time."""

import asyncio
import sys
from typing import Final

_TIMEOUT_S: Final = 120.0


class TaskError(Exception):
    """Why a task was not done."""


class TaskProcess:
    """Runs a module for each task."""

    def __init__(self, module: str) -> None:
        """``module`` reads a task from standard input, and writes the result to standard output."""
        self._module = module
        self._process: asyncio.subprocess.Process | None = None
        self._stopped = False

    def stop(self) -> None:
        """Stop the task at hand. No other starts."""
        self._stopped = True
        if self._process is not None and self._process.returncode is None:
            self._process.kill()

    async def run(self, task: bytes) -> bytes:
        """The result of a task. Raises TaskError."""
        if self._stopped:
            raise TaskError("the dashboard is stopping")
        self._process = process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", self._module),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            start_new_session=True,  # Ctrl-C stops the dashboard, which kills this process itself
        )
        try:
            async with asyncio.timeout(_TIMEOUT_S):
                output, _ = await process.communicate(task)
            return output
        except TimeoutError:
            raise TaskError("it takes too long") from None
        finally:
            if process.returncode is None:
                process.kill()
