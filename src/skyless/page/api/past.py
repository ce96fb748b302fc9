"""Questions to the history: one thread answers them one after the other, so that pages never wait for a long one."""

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from starlette.exceptions import HTTPException

from skyless.core.errors import SkylessError
from skyless.run.history.answers import Span

if TYPE_CHECKING:
    from skyless.run.history.queries import History

_T = TypeVar("_T")

QUERY_TIMEOUT_S: Final = 60.0
MAX_WAITING: Final = 20
"""Questions that may wait for their turn."""

_LIBRARIES: Final = ("duckdb", "pyarrow", "dateparser")


class Past:
    """The history of the sites that the server shows, or why there is none."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._pool: ThreadPoolExecutor | None = None
        self._waiting = 0

    @property
    def fault(self) -> str | None:
        """Why there is no history; None where there is one."""
        if self._folder is None:
            return "this server has no history: start the page's server with --history FOLDER"
        missing = [name for name in _LIBRARIES if find_spec(name) is None]
        if missing:
            return (
                f"this server has no history: it needs {missing[0]}; pip install 'skyless[history]', then start the "
                "page's server with --history FOLDER"
            )
        return None

    async def ask(self, site: int | None, question: "Callable[[History], _T]") -> _T:
        """The answer of a site's history. Raises HTTPException, also where it takes too long."""
        if self.fault is not None or self._folder is None:
            raise HTTPException(404, self.fault or "")
        if site is None:
            raise HTTPException(404, "no site is known yet")
        if self._waiting >= MAX_WAITING:
            raise HTTPException(503, f"{MAX_WAITING} questions to the history are waiting; ask again later")
        self._pool = self._pool or ThreadPoolExecutor(1, "history")
        self._waiting += 1
        answer = asyncio.get_running_loop().run_in_executor(self._pool, _ask, self._folder, site, question)
        answer.add_done_callback(self._on_done)
        try:
            async with asyncio.timeout(QUERY_TIMEOUT_S):
                return await asyncio.shield(answer)
        except TimeoutError:
            answer.cancel()  # of no effect once it has begun: then the next question waits for its end
            fault = f"the history has not answered within {QUERY_TIMEOUT_S:g} s; ask for a shorter time"
            raise HTTPException(503, fault) from None
        except _NoHistoryError as error:
            raise HTTPException(404, str(error)) from None
        except SkylessError as error:
            raise HTTPException(400, str(error)) from None

    def _on_done(self, answer: "asyncio.Future[_T]") -> None:
        self._waiting -= 1
        if not answer.cancelled():
            answer.exception()  # it was seen: nobody may be waiting for it any more

    def stop(self) -> None:
        """Begin no further question."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)


def _ask(folder: Path, site: int, question: "Callable[[History], _T]") -> _T:
    from skyless.run.history.queries import History  # noqa: PLC0415 - of the extra history

    try:
        history = History(folder, site)
    except SkylessError as error:
        raise _NoHistoryError(str(error)) from None
    return question(history)


class _NoHistoryError(SkylessError):
    """The folder has no history of the site."""


def read_span(begin: str, end: str) -> Span:
    """The time range between two texts, as people type them. Raises SkylessError."""
    from skyless.run.history.times import span_of  # noqa: PLC0415 - of the extra history

    return span_of(begin, end or None, time.time())
