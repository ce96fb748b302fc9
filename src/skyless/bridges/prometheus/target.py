"""``prometheus:``: serves the site's figures at ``/metrics``."""

import asyncio
import time
from typing import Final

from skyless.bridges.feed import BridgedSite
from skyless.bridges.prometheus.exposition import CONTENT_TYPE
from skyless.bridges.prometheus.metrics import SiteMetrics
from skyless.bridges.target import BridgeContext, Target, cannot_listen
from skyless.bridges.target_url import TargetUrl
from skyless.mqtt.messages import AnchorHealth, FixMessage, StatusMessage, TagHealth

_PORT: Final = 9464

_MOST_CONNECTIONS: Final = 32
_MOST_REQUEST_BYTES: Final = 8192
_ANSWER_S: Final = 5.0
"""A connection is ended after this time, whatever it has sent or read."""


class Prometheus(Target):
    """An HTTP server with one page; each connection carries one request.

    Made by hand, as the servers of libraries wait for ever for the end of a request: here each connection has a limit
    of time and of bytes, and where there are too many the oldest is ended, so that none keeps a scrape out.
    """

    def __init__(self, text: str, host: str, port: int, *, positions: bool) -> None:
        super().__init__(text)
        self.metrics = SiteMetrics(positions=positions)
        self.dropped = self.metrics.dropped
        self.port = port
        """The one that is used, where 0 was asked for and the server runs."""
        self._host = host
        self._open: dict[asyncio.StreamWriter, None] = {}
        """The oldest first."""

    def on_site(self, site: BridgedSite) -> None:
        """The site is known, or has changed."""
        self.metrics.on_site(site)

    def on_fix(self, fix: FixMessage) -> None:
        """Count it."""
        self.metrics.on_fix(fix, time.monotonic())

    def on_health(self, health: TagHealth | AnchorHealth) -> None:
        """Keep its figures."""
        self.metrics.on_health(health, time.monotonic())

    def on_status(self, status: StatusMessage) -> None:
        """A tag or an anchor has come or gone."""
        self.metrics.on_status(status)

    async def run(self) -> None:
        """Serve until cancelled. Raises SkylessError: it cannot listen there."""
        try:
            server = await asyncio.start_server(self._serve, self._host, self.port, limit=_MOST_REQUEST_BYTES)
        except OSError as error:
            raise cannot_listen(self.text, self._host, self.port, error) from None
        self.port = server.sockets[0].getsockname()[1]
        try:
            await asyncio.Event().wait()  # serve_forever, when cancelled, waits until all connections have ended
        finally:
            server.close()
            for writer in tuple(self._open):
                writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._open) >= _MOST_CONNECTIONS:
            oldest = next(iter(self._open))
            del self._open[oldest]
            oldest.transport.abort()
        self._open[writer] = None
        try:
            async with asyncio.timeout(_ANSWER_S):
                request = await reader.readuntil(b"\r\n\r\n")
                writer.write(self._answer(request))
                await writer.drain()
                writer.close()
                await writer.wait_closed()
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            self.dropped["request"] += 1
        finally:
            self._open.pop(writer, None)
            writer.transport.abort()

    def _answer(self, request: bytes) -> bytes:
        method, _, rest = request.partition(b" ")
        path = rest.partition(b" ")[0].partition(b"?")[0]
        if method not in (b"GET", b"HEAD"):
            return _response("405 Method Not Allowed", "only GET is answered here\n")
        if path == b"/metrics":
            whole = _response("200 OK", self.metrics.text(time.monotonic()), CONTENT_TYPE)
        else:
            whole = _response("404 Not Found", "the figures are at /metrics\n")
        return whole if method == b"GET" else whole.partition(b"\r\n\r\n")[0] + b"\r\n\r\n"


def _response(status: str, text: str, content_type: str = "text/plain; charset=utf-8") -> bytes:
    body = text.encode()
    head = (
        f"HTTP/1.1 {status}\r\nContent-Type: {content_type}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + body


def make_target(url: TargetUrl, _context: BridgeContext) -> Prometheus:
    """``prometheus://[HOST][:PORT]``; with ``position=yes`` it gives where tags are. Raises SkylessError."""
    positions = url.choice("position", ("no", "yes"), "no") == "yes"
    return Prometheus(url.text, url.host(), url.port(_PORT), positions=positions)
