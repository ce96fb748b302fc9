"""Questions to the history: a process of its own answers them one after the other.

So a long one takes neither memory nor time from the server, which raises alarms as well, and can be ended.
"""

import asyncio
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import Struct
from starlette.exceptions import HTTPException

from skyless.page.api.parameters import Begin, CellSize, Distance, End, Points, Step, TagName, TagNames, ZoneId, names
from skyless.page.task_process import TaskProcess, serve_tasks
from skyless.run.history.answers import AlarmRow, Contact, Dwell, Heatmap, Occupancy, Span, Track
from skyless.run.history.layout import site_folder
from skyless.run.limits import PAGE as LIMITS

if TYPE_CHECKING:
    from skyless.run.history.queries import History


class _Question(Struct, frozen=True):
    folder: str
    site: int
    name: str
    given: dict[str, Any]


class Past:
    """The history of the sites that the server shows."""

    def __init__(self, folder: Path | None) -> None:
        """Without a folder there is none."""
        self._folder = folder
        self._process = TaskProcess("skyless.page.api.past", fault=400)
        self._waiting = 0

    async def ask(self, site: int | None, name: str, given: dict[str, Any]) -> bytes:
        """The answer of a site's history to a function of this file, as JSON. Raises HTTPException."""
        if self._folder is None:
            raise HTTPException(404, "this server has no history: start the page's server with --history FOLDER")
        if site is None:
            raise HTTPException(404, "no site is known yet")
        if not site_folder(self._folder, site).is_dir():
            raise HTTPException(404, f"{self._folder} holds no history of site {site}; skyless history run writes one")
        if self._waiting >= LIMITS.questions:
            raise HTTPException(503, f"{LIMITS.questions} questions to the history are waiting; ask again later")
        self._waiting += 1
        try:
            async with asyncio.timeout(LIMITS.question_s):
                return await self._process.run(_Question(str(self._folder), site, name, given))
        except TimeoutError:
            fault = f"the history has not answered within {LIMITS.question_s:g} s; ask for a shorter time"
            raise HTTPException(503, fault) from None
        finally:
            self._waiting -= 1

    def stop(self) -> None:
        """End the question at hand, and begin no further one."""
        self._process.stop()


def _span(begin: str, end: str) -> Span:
    from skyless.run.history.answers import span_of  # noqa: PLC0415 - of the extra history

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


def _answer(question: _Question) -> object:
    """What the process answers; a tuple as an object with one key. Raises SkylessError."""
    from skyless.run.history.queries import History  # noqa: PLC0415 - of the extra history

    functions = {one.__name__: one for one in (tags, track, heatmap, dwell, occupancy, contacts, alarms)}
    found = functions[question.name](History(Path(question.folder), question.site), **question.given)
    return {question.name: found} if isinstance(found, tuple) else found


if __name__ == "__main__":
    serve_tasks(_Question, _answer)
