"""Questions to the history: one thread answers them one after the other, so that pages never wait for a long one."""

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from starlette.exceptions import HTTPException

from skyless.core.errors import SkylessError
from skyless.page.api.parameters import Begin, CellSize, Distance, End, Points, Step, TagName, TagNames, ZoneId, names
from skyless.run.history.answers import AlarmRow, Contact, Dwell, Heatmap, Occupancy, Span, Track

if TYPE_CHECKING:
    from skyless.run.history.queries import History

_T = TypeVar("_T")

QUERY_TIMEOUT_S: Final = 60.0
MAX_WAITING: Final = 20
"""Questions that may wait for their turn."""


class Past:
    """The history of the sites that the server shows."""

    def __init__(self, folder: Path | None) -> None:
        """Without a folder there is none."""
        self._folder = folder
        self._pool = ThreadPoolExecutor(1, "history")  # its thread begins with the first question
        self._waiting = 0
        self.is_busy = False
        """Whether a question is being answered. Nothing can end that, but the end of the process."""

    async def ask(self, site: int | None, question: "Callable[[History], _T]") -> _T:
        """The answer of a site's history. Raises HTTPException, also where it takes too long."""
        if self._folder is None:
            raise HTTPException(404, "this server has no history: start the page's server with --history FOLDER")
        if site is None:
            raise HTTPException(404, "no site is known yet")
        if self._waiting >= MAX_WAITING:
            raise HTTPException(503, f"{MAX_WAITING} questions to the history are waiting; ask again later")
        self._waiting += 1
        try:
            async with asyncio.timeout(QUERY_TIMEOUT_S):  # one that has begun goes on, and the next waits for its end
                loop = asyncio.get_running_loop()
                return await loop.run_in_executor(self._pool, self._answer, self._folder, site, question)
        except TimeoutError:
            fault = f"the history has not answered within {QUERY_TIMEOUT_S:g} s; ask for a shorter time"
            raise HTTPException(503, fault) from None
        finally:
            self._waiting -= 1

    def stop(self) -> None:
        """Begin no further question."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _answer(self, folder: Path, site: int, question: "Callable[[History], _T]") -> _T:
        from skyless.run.history.queries import History  # noqa: PLC0415 - of the extra history

        self.is_busy = True
        status = 404  # there is no such history
        try:
            history = History(folder, site)
            status = 400
            return question(history)
        except SkylessError as error:
            raise HTTPException(status, str(error)) from None
        finally:
            self.is_busy = False


def _span(begin: str, end: str) -> Span:
    from skyless.run.history.times import span_of  # noqa: PLC0415 - of the extra history

    return span_of(begin, end or None, time.time())


def tags(history: "History") -> tuple[str, ...]:
    """Tags that it has."""
    return history.tags()


def track(history: "History", *, tag: TagName, begin: Begin, end: End = "", points: Points = 2000) -> Track:
    """The way of a tag."""
    return history.track(tag, _span(begin, end), points)


def heatmap(history: "History", *, begin: Begin, end: End = "", cell_m: CellSize = 0.25, tag: TagNames = "") -> Heatmap:
    """How long tags were where."""
    return history.heatmap(_span(begin, end), cell_m, names(tag))


def dwell(
    history: "History", *, begin: Begin, end: End = "", tag: TagNames = "", zone: ZoneId = ""
) -> tuple[Dwell, ...]:
    """How long tags were in zones."""
    return history.dwell(_span(begin, end), names(tag), zone or None)


def occupancy(
    history: "History", *, begin: Begin, end: End = "", zone: ZoneId = "", step_s: Step = 300.0
) -> tuple[Occupancy, ...]:
    """How many tags were in zones."""
    return history.occupancy(_span(begin, end), zone or None, step_s)


def contacts(
    history: "History", *, tag: TagName, begin: Begin, end: End = "", distance_m: Distance = 2.0
) -> tuple[Contact, ...]:
    """Whom a tag was near to."""
    return history.contacts(tag, _span(begin, end), distance_m)


def alarms(history: "History", *, begin: Begin, end: End = "") -> tuple[AlarmRow, ...]:
    """Alarms of the past."""
    return history.alarms(_span(begin, end))
