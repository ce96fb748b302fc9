"""What waits for one page: the newest of each kind, so that a slow page gets less and never a longer queue."""

import asyncio
from collections import deque
from typing import Final

from skyless.dashboard.state import Board

MOST_EVENTS: Final = 50


class Mailbox:
    """Messages for one page, taken when its socket is ready for them."""

    def __init__(self, hello: bytes) -> None:
        self.closed = False
        self._latest: dict[str, bytes] = {"hello": hello}
        self._events: deque[bytes] = deque(maxlen=MOST_EVENTS)
        self._seen = 0
        self._state_due = True
        self._wake = asyncio.Event()
        self._wake.set()

    def put(self, kind: str, message: bytes) -> None:
        """Leave a message; it takes the place of one of its kind that still waits."""
        self._latest[kind] = message
        self._wake.set()

    def event(self, message: bytes) -> None:
        """Leave a message that does not replace others, until there are too many."""
        self._events.append(message)
        self._wake.set()

    def state_due(self) -> None:
        """Let the page have the state if there is anything new."""
        self._state_due = True
        self._wake.set()

    def close(self) -> None:
        """Let the page go."""
        self.closed = True
        self._wake.set()

    async def take(self, board: Board) -> list[str]:
        """Wait for messages and take them all, in the order in which the page must get them."""
        await self._wake.wait()
        self._wake.clear()
        messages = [*self._latest.values(), *self._events]
        self._latest.clear()
        self._events.clear()
        if self._state_due and board.serial > self._seen:
            messages.append(board.state_since(self._seen))
            self._seen = board.serial
        self._state_due = False
        return [message.decode() for message in messages]
