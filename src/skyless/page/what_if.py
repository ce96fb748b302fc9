"""What a page needs to recompute a recording itself, with an anchor left out or moved, or other noise.

The page runs the estimator's WebAssembly (``browser/what_if.js``) over the packets of one tag.
"""

import asyncio

import msgspec
from msgspec import Struct

from skyless.page.task_process import TaskError, TaskProcess


class NoWhatIfError(Exception):
    """Why a recording cannot be recomputed."""


class WhatIfTask(Struct, frozen=True):
    """Input of the process, as JSON."""

    path: str
    tag: str
    begin_unix_s: float
    """It begins with the first fix from then on."""
    seconds: float


class WhatIfAnchor(Struct, frozen=True):
    """An anchor of the packets, in the order of their table."""

    id: int
    position_m: tuple[float, float, float]


class WhatIf(Struct, frozen=True):
    """Output of the process: an error, or tables in the memory layout of ``skyless_core.h``."""

    error: str | None = None
    digest: str = ""
    """Of the source from which the WebAssembly has to be made."""
    begin_s: float = 0.0
    """Since ``begin_unix_s``."""
    times_s: list[float] = []
    """Of the packets, since the first."""
    recorded: list[tuple[float, float, float, float | None] | None] = []
    """What the tag made of each packet: position and horizontal protection level, or no fix."""
    anchors: list[WhatIfAnchor] = []
    layout: dict[str, int] = {}
    """Sizes of records, and offsets of the fields that the page reads or changes."""
    state: list[tuple[int, bytes]] = []
    """Where the filter's first state is not zero, and what stands there."""
    places: bytes = b""
    packets: bytes = b""
    relays: bytes = b""


class WhatIfs:
    """Answers requests. One is prepared at a time."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._process = TaskProcess("skyless.page.what_if_process")

    def stop(self) -> None:
        """Stop the task at hand. No other starts."""
        self._process.stop()

    async def get(self, task: WhatIfTask) -> bytes:
        """The answer as JSON. Raises NoWhatIfError."""
        async with self._lock:
            try:
                output = await self._process.run(msgspec.json.encode(task))
                found = msgspec.json.decode(output, type=WhatIf)
            except TaskError as error:
                raise NoWhatIfError(f"the recording cannot be prepared: {error}") from None
            except msgspec.MsgspecError:
                raise NoWhatIfError("the recording cannot be prepared; the dashboard's terminal shows why") from None
        if found.error is not None:
            raise NoWhatIfError(found.error)
        return output
