"""Tasks that the server has computed by separate processes."""

import asyncio
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final, Literal, TypeVar

import msgspec
from msgspec import Raw, Struct
from msgspec.structs import replace
from starlette.exceptions import HTTPException

from skyless.core.errors import SkylessError
from skyless.core.site import AnchorSite, Site
from skyless.run.web import PAGE as LIMITS
from skyless.site.file.check import check_site

Kind = Literal["pdop", "hdop", "sigma"]
KINDS: Final[tuple[Kind, ...]] = ("pdop", "hdop", "sigma")


class OverlayTask(Struct, frozen=True):
    """An overlay of the map."""

    site: Site
    kind: Kind
    step_m: float
    """Least side of the cells."""
    plan_px: tuple[int, int] | None
    """Size of the floor plan's image."""


class WhatIfTask(Struct, frozen=True):
    """The packets of one tag, which a page recomputes with an anchor left out or moved, or other noise."""

    path: str
    tag: str
    begin_unix_s: float
    """The packets begin with the first fix from this time on."""
    seconds: float


class MovedAnchors(Struct, frozen=True):
    """A page's question about the site with some anchors moved."""

    anchors: tuple[AnchorSite, ...] = ()
    """Only the positions are used."""

    def site_of(self, site: Site) -> Site:
        """The site with its anchors moved. Raises ConfigurationError."""
        at = {anchor.id: anchor for anchor in self.anchors}
        anchors = tuple(
            replace(one, x_m=at[one.id].x_m, y_m=at[one.id].y_m, z_m=at[one.id].z_m) if one.id in at else one
            for one in site.anchors
        )
        moved = replace(site, anchors=anchors)
        check_site(moved, Path("the moved anchors"))
        return moved


# A separate process for work that would delay the pages, or load NumPy into the server: one task at a time.
#
# Tasks and answers are lines of JSON.

_TIMEOUT_S: Final = 120.0
_IDLE_S: Final = 60.0
"""A process without a task for this long is ended, as it uses a hundred megabytes."""

_NICE: Final = 19  # positioning on this machine has priority

_Task = TypeVar("_Task", bound=Struct)


class _Answer(Struct):
    value: Raw = Raw(b"null")
    error: str | None = None


class TaskProcess:
    """Runs a module in a process that does tasks, one after the other."""

    def __init__(self, module: str, fault: int = 422) -> None:
        """``module`` calls ``serve_tasks`` when run; ``fault``: HTTP status for its errors."""
        self._module, self._fault = module, fault
        self._lock = asyncio.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._idle: asyncio.TimerHandle | None = None
        self._stopped = False

    def stop(self) -> None:
        """Stop the current task, and start no further one."""
        self._stopped = True
        self._kill()

    async def run(self, task: Struct) -> bytes:
        """Have a task done. Returns the answer as JSON. Raises HTTPException."""
        async with self._lock:
            if self._stopped:
                raise HTTPException(422, "the dashboard is stopping")
            if self._idle is not None:
                self._idle.cancel()
            try:
                async with asyncio.timeout(_TIMEOUT_S):
                    line = await asyncio.to_thread(self._exchange, msgspec.json.encode(task))
            except TimeoutError:
                self._kill()
                raise HTTPException(422, f"it takes longer than {_TIMEOUT_S:g} s") from None
            except BaseException:
                self._kill()  # a later answer would be taken for that of another task
                raise
            self._idle = asyncio.get_running_loop().call_later(_IDLE_S, self._kill)
        if not line:
            raise HTTPException(422, "it could not be computed; the dashboard's terminal shows why")
        answer = msgspec.json.decode(line, type=_Answer)
        if answer.error is not None:
            raise HTTPException(self._fault, answer.error)
        return bytes(answer.value)

    def _exchange(self, task: bytes) -> bytes:
        """Send a task, and return the process's answer; empty if it has failed."""
        process = self._process
        if process is None or process.poll() is not None:
            self._process = process = subprocess.Popen(
                (sys.executable, "-m", self._module),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,  # Ctrl-C stops the dashboard, which kills this process itself
            )
        if process.stdin is None or process.stdout is None:
            raise HTTPException(422, "its process has no pipes")
        try:
            process.stdin.write(task + b"\n")
            process.stdin.flush()
            return process.stdout.readline()
        except (OSError, ValueError):  # ValueError: the process was killed meanwhile, and its pipes are closed
            return b""

    def _kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


def serve_tasks(kind: type[_Task], answer: Callable[[_Task], object]) -> None:
    """Answer tasks from standard input on standard output until it closes. A SkylessError is also an answer."""
    os.nice(_NICE)
    for line in sys.stdin.buffer:
        try:
            value = msgspec.json.encode(answer(msgspec.json.decode(line, type=kind)))
            found = _Answer(Raw(value))
            if len(value) > LIMITS.answer_bytes:
                size, most = (f"{1e-6 * count:.0f} MB" for count in (len(value), LIMITS.answer_bytes))
                found = _Answer(error=f"the answer has {size}, and may have {most}; ask for less")
        except SkylessError as error:
            found = _Answer(error=str(error))
        sys.stdout.buffer.write(msgspec.json.encode(found) + b"\n")
        sys.stdout.buffer.flush()
