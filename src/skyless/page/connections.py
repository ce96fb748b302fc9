"""The connections of the page's server: how many there may be, and which end because nothing is asked on them."""

import asyncio
import logging
import math
import time
from typing import Any, Final

from uvicorn.protocols.http.h11_impl import H11Protocol

from skyless.run.limits import PAGE as LIMITS

_REFUSAL: Final = b"this server has %d connections%s, the most that it takes; try again, or close other pages\n"
_RESPONSE: Final = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: %d\r\n"
    b"Retry-After: 10\r\nConnection: close\r\n\r\n%b"
)


class Connection(H11Protocol):
    """A connection of HTTP, which becomes one of a WebSocket where that is asked.

    Where there are too many, the one that has waited longest for the rest of a request makes room. Only where none
    does, the new one is refused.
    """

    since_s = 0.0
    """When the connection began."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take the connection, if there is room."""
        super().connection_made(transport)
        self.since_s = self.loop.time()
        others: list[Any] = [one for one in self.connections if one is not self and not one.transport.is_closing()]
        of_address = [one for one in others if (one.client or "")[:1] == (self.client or "")[:1]]
        if len(of_address) >= LIMITS.connections_per_address:
            self._make_room(of_address, b" of this address")
        elif len(others) >= LIMITS.connections:
            self._make_room(others, b"")

    def _make_room(self, crowd: list[Any], which: bytes) -> None:
        unfinished = [one for one in crowd if is_unfinished(one)]
        if unfinished:
            # One that has been answered and is silent, as a browser keeps it, is the last that makes room.
            min(unfinished, key=lambda one: (one.timeout_keep_alive_task is not None, one.since_s)).transport.abort()
            return
        text = _REFUSAL % (len(crowd), which)
        self.transport.write(_RESPONSE % (len(text), text))
        self.transport.close()


def is_unfinished(connection: object) -> bool:
    """Whether a connection waits for a request, or the rest of one. A WebSocket never does."""
    if not isinstance(connection, Connection):
        return False
    cycle = connection.cycle
    return cycle is None or cycle.more_body or cycle.response_complete


async def end_unfinished(
    connections: set[Any], timeout_s: float = LIMITS.request_s, body_timeout_s: float = LIMITS.body_s
) -> None:
    """End connections that have been without a whole request for too long, until cancelled; uvicorn ends idle ones."""
    since_s: dict[object, float] = {}
    while True:
        await asyncio.sleep(timeout_s / 4)
        now_s = asyncio.get_running_loop().time()
        waiting = {(one, one.cycle): one for one in list(connections) if is_unfinished(one)}
        since_s = {key: since_s.get(key, now_s) for key in waiting}
        for key, connection in waiting.items():
            reads_body = connection.cycle is not None and not connection.cycle.response_complete
            if now_s - since_s[key] >= (body_timeout_s if reads_body else timeout_s):
                connection.transport.abort()


class FailedAccepts(logging.Filter):
    """Lets the event loop log failed accepts, as for want of open files, once a minute, and without a traceback."""

    said_s = -math.inf

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a line is logged."""
        if "accept()" not in record.getMessage():
            return True
        now_s, record.exc_info = time.monotonic(), None
        is_due = now_s - self.said_s >= LIMITS.accepts_log_s
        self.said_s = now_s if is_due else self.said_s
        return is_due
