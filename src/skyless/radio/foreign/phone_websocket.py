"""The WebSocket of a phone; needs the package websockets."""

from asyncio import StreamWriter
from collections.abc import Iterator
from logging import Logger

from websockets.frames import Frame, Opcode
from websockets.http11 import Request
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
        protocol = self._protocol
        protocol.receive_data(chunk)
        for event in protocol.events_received():
            if isinstance(event, Request) and protocol.parser_exc is None:
                protocol.send_response(protocol.accept(event))
            elif protocol.handshake_exc is not None:
                break  # what follows a request that was refused
            elif isinstance(event, Frame) and event.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                self._parts += event.data
                if event.fin:
                    message, self._parts = self._parts, b""
                    yield message
        for data in protocol.data_to_send():
            if data:
                self._writer.write(data)
        if protocol.handshake_exc is not None or protocol.parser_exc is not None:
            self._drops["malformed-connection"] += 1
        if protocol.close_expected():
            self._writer.close()

    def finish(self) -> None:
        """Count a message without its end."""
        if self._parts:
            self._drops["unfinished-message"] += 1
