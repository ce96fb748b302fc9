"""The WebSocket of a phone; needs the package websockets."""

from asyncio import StreamWriter
from collections.abc import Iterator
from logging import Logger

from websockets.frames import Frame, Opcode
from websockets.http11 import Request
from websockets.protocol import State
from websockets.server import ServerProtocol

from skyless.files import MAX_LINE_BYTES, Drops


class WebSocketMessages:
    """Cuts what a WebSocket's client sends into messages, and answers it.

    Pages in browsers are refused: they state their origin, and apps do not.
    """

    def __init__(self, writer: StreamWriter, drops: Drops, logger: Logger) -> None:
        self._writer, self._drops = writer, drops
        self._protocol = ServerProtocol(origins=[None], max_size=MAX_LINE_BYTES, logger=logger)
        self._parts = b""

    def feed(self, chunk: bytes, /) -> Iterator[bytes]:
        """Messages that end in this piece; ends the connection after a goodbye or a fault."""
        self._protocol.receive_data(chunk)
        for event in self._protocol.events_received():
            if isinstance(event, Request):
                self._protocol.send_response(self._protocol.accept(event))
            elif isinstance(event, Frame) and event.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                self._parts += event.data
                if event.fin:
                    message, self._parts = self._parts, b""
                    yield message
        for data in self._protocol.data_to_send():
            if data:
                self._writer.write(data)
        if self._protocol.handshake_exc is not None or self._protocol.parser_exc is not None:
            self._drops["malformed-connection"] += 1
        if self._protocol.close_expected() or self._protocol.state is State.CLOSED:
            self._writer.close()
