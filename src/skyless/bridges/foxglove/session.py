"""One client of the server: what it has subscribed, and what waits to be sent to it."""

import asyncio
from collections import deque
from typing import Final

from websockets.asyncio.server import ServerConnection

from skyless.bridges.foxglove.protocol import WARNING, Channel, Subscribe, decode_request, message_data, status

_MOST_WAITING: Final = 500
"""Messages for one client; beyond it the oldest is dropped."""

STUCK_S: Final = 10.0
"""A client that has accepted nothing for so long, while its messages were being dropped, is disconnected."""

_MOST_TEXTS: Final = 2000
"""Texts for one client, which are never dropped; a client with more of them waiting is disconnected."""


class Session:
    """One client. Nothing here waits, but ``run``."""

    def __init__(self, connection: ServerConnection) -> None:
        self._connection = connection
        self._numbers: dict[int, int] = {}
        """The client's numbers of its subscriptions, by channel."""
        self._texts: deque[str] = deque()
        self._data: deque[bytes] = deque(maxlen=_MOST_WAITING)
        self._ready = asyncio.Event()
        self._sent_s = asyncio.get_running_loop().time()

    def wants(self, channel: int) -> bool:
        """Whether it has subscribed a channel."""
        return channel in self._numbers

    def send_text(self, text: str) -> None:
        """Send what must not be dropped."""
        self._texts.append(text)
        self._ready.set()
        if len(self._texts) > _MOST_TEXTS:
            self.end()

    def send_data(self, channel: int, unix_s: float, payload: bytes) -> bool:
        """Send a message of a channel that it wants; whether nothing was dropped for that."""
        full = len(self._data) == self._data.maxlen
        if not self._data and not self._texts:
            self._sent_s = asyncio.get_running_loop().time()
        elif full and asyncio.get_running_loop().time() - self._sent_s > STUCK_S:
            self.end()
        self._data.append(message_data(self._numbers[channel], unix_s, payload))
        self._ready.set()
        return not full

    def on_request(self, data: str | bytes, channels: dict[int, Channel]) -> tuple[tuple[int, ...], int]:
        """Do what the client asks for: which channels it has now subscribed, and how much could not be done."""
        request = decode_request(data)
        if request is None:
            self.send_text(status(WARNING, "skyless bridge offers subscriptions only; this request does nothing"))
            return (), 1
        added: list[int] = []
        wrong = 0
        if isinstance(request, Subscribe):
            for asked in request.subscriptions:
                channel, number = asked.channel_id, asked.id
                if channel not in channels or self.wants(channel) or number in self._numbers.values():
                    wrong += 1
                    self.send_text(status(WARNING, f"channel {channel} cannot be subscribed as {number}"))
                    continue
                self._numbers[channel] = number
                added.append(channel)
        else:
            gone = set(request.subscription_ids)
            self._numbers = {channel: number for channel, number in self._numbers.items() if number not in gone}
        return tuple(added), wrong

    async def run(self) -> None:
        """Send what waits until the connection closes."""
        loop = asyncio.get_running_loop()
        while True:
            await self._ready.wait()
            self._ready.clear()
            while self._texts or self._data:
                await self._connection.send(self._texts.popleft() if self._texts else self._data.popleft())
                self._sent_s = loop.time()

    def end(self) -> None:
        """Close the connection at once; what waits is dropped."""
        self._connection.transport.abort()
