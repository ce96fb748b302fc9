"""A phone that sends its DL-TDoA records while it measures: a server for lines of JSON, by TCP or WebSocket.

One port serves both: a connection whose first line is that of an HTTP request is a WebSocket's. There is one phone: the
first message of a new connection ends the old one, as phones reconnect without having closed theirs.
"""

import asyncio
import os
import re
from asyncio import StreamReader, StreamWriter
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from skyless.core.air.masterless_packets import Packet
from skyless.core.errors import SkylessError
from skyless.files import CHUNK_BYTES, MAX_LINE_BYTES, LineCutter
from skyless.radio.foreign.phones import Phone
from skyless.radio.foreign.uci import AnchorFrame
from skyless.radio.interface import Gone, Hint, Restarted, ignore

if TYPE_CHECKING:
    from skyless.radio.foreign.phone_websocket import WebSocketMessages

MAX_CONNECTIONS: Final = 16
"""Connections at once; for a further one the oldest that is not the phone's is ended."""

FLUSH_S = 0.2
"""Longest time for which records of an unordered stream wait for others."""

_REQUEST: Final = re.compile(rb"[A-Z]+ \S+ HTTP/\d")


class PhoneRadio:
    """One phone's DL-TDoA measurements: the packets that the same records in a file give, in the phone's own time."""

    def __init__(self, host: str, port: int, name: str, frame: AnchorFrame) -> None:
        self.name = name
        self.port = port
        """The port in use; with 0 given, known once the server runs."""
        self.counters: Counter[str] = Counter()
        self.frame = frame
        self._host = host
        self._records = Phone(self.counters, frame)
        self._listener: Callable[[Packet | Restarted | Gone | Hint], None] = ignore
        self._connections: dict[StreamWriter, None] = {}
        self._phone: StreamWriter | None = None

    async def run(self, listener: Callable[[Packet | Restarted | Gone | Hint], None]) -> None:
        """Receive until cancelled. Raises SkylessError if it cannot listen there."""
        self._listener = listener
        try:
            server = await asyncio.start_server(self._serve, self._host, self.port)
        except (OSError, UnicodeError) as error:  # a name that no host can have
            number = getattr(error, "errno", None) or 0
            reason = os.strerror(number) if number > 0 else error
            raise SkylessError(f"--radio cannot listen on {self._host}:{self.port}: {reason}") from None
        self.port = server.sockets[0].getsockname()[1]
        listener(Hint(f"waits for a phone at {self._host}:{self.port}"))
        try:
            await server.serve_forever()
        finally:
            for writer in self._connections:  # a server waits for its connections to end
                writer.transport.abort()

    def advice(self) -> str:
        """Where to look if nothing is received."""
        return f"the phone at {self._host}:{self.port} sends no records; does its session with anchors go on?"

    async def _serve(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Serve one connection until it ends or is replaced."""
        if len(self._connections) >= MAX_CONNECTIONS:
            self.counters["too-many-connections"] += 1
            oldest = next(one for one in self._connections if one is not self._phone)
            del self._connections[oldest]
            oldest.transport.abort()
        self._connections[writer] = None
        try:
            await self._receive(reader, writer)
        except OSError:
            pass  # it broke
        finally:
            self._connections.pop(writer, None)
            writer.close()
            if self._phone is writer:
                self._phone = None
                self._listener(Gone("the phone has ended its connection"))

    async def _receive(self, reader: StreamReader, writer: StreamWriter) -> None:
        data = chunk = await reader.read(CHUNK_BYTES)
        while chunk and b"\n" not in data and len(data) <= MAX_LINE_BYTES:
            data += (chunk := await reader.read(CHUNK_BYTES))
        messages: LineCutter | WebSocketMessages = LineCutter(self.counters)
        if _REQUEST.match(data):
            try:
                from skyless.radio.foreign import phone_websocket  # noqa: PLC0415 - an extra
            except ImportError:
                self._listener(Hint("a phone asks for a WebSocket, which needs skyless[page]; lines by TCP do not"))
                return
            messages = phone_websocket.WebSocketMessages(writer, self.counters)
        while data and not writer.is_closing():
            for message in messages.feed(data):
                self._take(writer)
                for packet in self._records.on_message(message):
                    self._listener(packet)
            await writer.drain()
            reading = asyncio.ensure_future(reader.read(CHUNK_BYTES))
            await asyncio.wait([reading], timeout=FLUSH_S if self._records.is_waiting else None)
            if not reading.done():
                self._flush(writer)
            data = await reading
        if isinstance(messages, LineCutter):
            messages.finish()
        self._flush(writer)

    def _flush(self, writer: StreamWriter) -> None:
        """Let the phone's records not wait any longer."""
        for packet in self._records.finish() if self._phone is writer else ():
            self._listener(packet)

    def _take(self, writer: StreamWriter) -> None:
        """Let this connection be the phone's."""
        if self._phone is writer:
            return
        if self._phone is not None:
            self._phone.transport.abort()
        self._phone = writer
        self._listener(Restarted())
