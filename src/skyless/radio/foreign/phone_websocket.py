"""The WebSocket of a phone; needs the package websockets."""

from asyncio import StreamWriter
from collections.abc import Iterator, Sequence
from http import HTTPStatus
from ipaddress import ip_address
from logging import NullHandler, getLogger
from typing import Final
from urllib.parse import urlsplit

from websockets.frames import Frame, Opcode
from websockets.http11 import Request
from websockets.server import ServerProtocol

from skyless.files import MAX_LINE_BYTES, Drops

_CONTENT: Final = (Opcode.TEXT, Opcode.BINARY, Opcode.CONT)
_quiet = getLogger("skyless.radio.phone")  # connections that break are no news
_quiet.addHandler(NullHandler())
_quiet.propagate = False


class WebSocketMessages:
    """Cuts what a WebSocket's client sends into messages, and answers it; pages in browsers are refused."""

    def __init__(self, writer: StreamWriter, drops: Drops) -> None:
        self._writer, self._drops = writer, drops
        self._protocol = ServerProtocol(max_size=MAX_LINE_BYTES, logger=_quiet)
        self._is_open = False
        self._parts = b""

    def feed(self, chunk: bytes, /) -> Iterator[bytes]:
        """Messages that end in this piece; ends the connection after a goodbye or a fault."""
        protocol = self._protocol
        protocol.receive_data(chunk)
        for event in protocol.events_received():
            if isinstance(event, Request) and protocol.parser_exc is None:
                self._answer(event)
            elif self._is_open and isinstance(event, Frame) and event.opcode in _CONTENT:
                self._parts += event.data
                if event.fin:
                    message, self._parts = self._parts, b""
                    yield message
        for data in protocol.data_to_send():
            if data:
                self._writer.write(data)
        if protocol.parser_exc is not None or protocol.handshake_exc is not None:
            self._drops["malformed-connection"] += 1
        if protocol.close_expected():
            self._writer.close()

    def _answer(self, request: Request) -> None:
        if _is_page(request.headers.get_all("Origin"), request.headers.get_all("Host")):
            self._drops["page-refused"] += 1
            response = self._protocol.reject(HTTPStatus.FORBIDDEN, "pages may not connect\n")
        else:
            response = self._protocol.accept(request)
        self._is_open = response.status_code == HTTPStatus.SWITCHING_PROTOCOLS
        self._protocol.send_response(response)


def _is_page(origins: Sequence[str], hosts: Sequence[str]) -> bool:
    """Whether a request comes from a page of a browser.

    Apps state no origin, or this server's address; a page could only state that under a name that leads here.
    """
    if not origins:
        return False
    try:
        origin = urlsplit(origins[0])
        ip_address(origin.hostname or "")
    except ValueError:
        return True
    return [origin.netloc.lower()] != [host.lower() for host in hosts]
