"""Connections of the page's server: their limits, time-outs, WebSockets and access control."""

import asyncio
import hmac
import logging
import math
import time
from collections.abc import Callable, Coroutine, Iterable
from hashlib import sha256
from typing import Any, Final

import msgspec
from msgspec import Struct
from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from skyless.run.web import PAGE as LIMITS
from skyless.run.web import is_own_host, same_origin

JSON: Final = "application/json"


def json_answer(value: object, status: int = 200, media_type: str = JSON) -> Response:
    """Answer with a value, or bytes that are JSON, and a newline, so that a terminal's prompt starts a new line."""
    whole = value if isinstance(value, bytes) else msgspec.json.encode(value)
    return Response(whole + b"\n", status, media_type=media_type)


_REFUSAL: Final = b"this server has %d connections%s, the most that it takes; try again, or close other pages\n"
_RESPONSE: Final = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: %d\r\n"
    b"Retry-After: 10\r\nConnection: close\r\n\r\n%b"
)


class Connection(H11Protocol):
    """An HTTP connection, which may be upgraded to a WebSocket.

    If there are too many, the one that has waited longest for the rest of a request is closed. Only if none waits is
    the new one refused.
    """

    since_s = 0.0
    """Time when the connection began."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept the connection if there is room."""
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
            # Idle connections that have been answered, as browsers keep them, are closed last.
            min(unfinished, key=lambda one: (one.timeout_keep_alive_task is not None, one.since_s)).transport.abort()
            return
        text = _REFUSAL % (len(crowd), which)
        self.transport.write(_RESPONSE % (len(text), text))
        self.transport.close()


def is_unfinished(connection: object) -> bool:
    """Whether a connection waits for a request, or the rest of one; never for a WebSocket."""
    if not isinstance(connection, Connection):
        return False
    cycle = connection.cycle
    return cycle is None or cycle.more_body or cycle.response_complete


async def end_unfinished(
    connections: set[Any], timeout_s: float = LIMITS.request_s, body_timeout_s: float = LIMITS.body_s
) -> None:
    """Until cancelled, close connections that take too long for a request; uvicorn closes idle ones."""
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
    """Limits logs of failed accepts, as for lack of open files, to one a minute without a traceback."""

    said_s = -math.inf

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to log a record."""
        if "accept()" not in record.getMessage():
            return True
        now_s, record.exc_info = time.monotonic(), None
        is_due = now_s - self.said_s >= LIMITS.accepts_log_s
        self.said_s = now_s if is_due else self.said_s
        return is_due


# WebSockets: a reader gets messages until it closes, or accepts none for too long.

SEND_TIMEOUT_S: Final = 10.0
"""A reader that accepts no message for this long is disconnected."""

GOING_AWAY: Final = 1001
POLICY_VIOLATION: Final = 1008
TRY_LATER: Final = 1013


async def serve_socket(
    socket: WebSocket, sending: Coroutine[Any, Any, None], receive: Callable[[str], None] = lambda _text: None
) -> None:
    """Run ``sending``, and pass received texts to ``receive``, until either ends."""

    async def read() -> None:
        while (message := await socket.receive())["type"] != "websocket.disconnect":
            receive(message.get("text") or "")

    parts = [asyncio.ensure_future(part) for part in (read(), sending)]
    try:
        done, _ = await asyncio.wait(parts, return_when=asyncio.FIRST_COMPLETED)
        for part in done:
            part.result()
    except (WebSocketDisconnect, RuntimeError, TimeoutError):
        pass  # the reader has gone, or does not respond
    finally:
        for part in parts:
            part.cancel()


async def send(socket: WebSocket, messages: Iterable[bytes], kind: str = "text") -> None:
    """Send messages as text, or with another ``kind`` as bytes. Raises TimeoutError if they are not accepted."""
    async with asyncio.timeout(SEND_TIMEOUT_S):
        for message in messages:
            await (socket.send_text(message.decode()) if kind == "text" else socket.send_bytes(message))


# Access control: requests of other sites' pages are refused, and those of other machines need a token.
#
# If the server has tokens, the reader's admits only reading: GET, HEAD and WebSockets. Everything else needs the
# operator's.

_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; img-src 'self' data: blob:; "
    "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}

_AT_HUB: Final = "this page is at a hub, which only reads; the site's own page changes it"


class AccessRules(Struct, frozen=True):
    """Rules of the guard."""

    token: str | None = None
    """The operator's token, which requests must carry; None if only programs of this machine can reach the server."""
    reader_token: str | None = None
    """Token of requests that only read; needs an operator's token."""
    names: frozenset[str] = frozenset()
    """Valid host names, in lower case, in addition to ``localhost``."""
    read_only: bool = False
    """Whether nothing can be changed here, as at a hub."""
    remote: bool = False
    """Whether other machines can reach the server: then any IP address is a valid host."""
    cookie: str = "skyless"
    """Name of the cookie, different for each port, as browsers share cookies between the ports of a machine."""


class Guard:
    """ASGI middleware: checks Host, Origin and token of every request and WebSocket, and adds security headers.

    For the checks of Host and Origin see ``skyless.run.web``.
    """

    def __init__(self, app: ASGIApp, rules: AccessRules) -> None:
        self._app, self._rules = app, rules
        self._secret = None if rules.token is None else _digest(rules.token)
        self._reader_secret = None if rules.reader_token is None else _digest(rules.reader_token)
        self._secrets = {secret for secret in (self._secret, self._reader_secret) if secret is not None}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request to the application, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        request = HTTPConnection(scope)
        fault = self._fault(request)
        if fault is None:
            await self._app(scope, receive, self._with_headers(request, send))
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": fault[1]})
        else:
            answer = json_answer({"error": fault[1]}, fault[0])
            await answer(scope, receive, self._with_headers(request, send))

    def _fault(self, request: HTTPConnection) -> tuple[int, str] | None:
        hosts = request.headers.getlist("host")
        host = hosts[0].lower() if len(hosts) == 1 else ""
        if not is_own_host(host, self._rules.names, remote=self._rules.remote):
            return 421, "unknown host name: open the address that the dashboard has printed"
        origin = request.headers.get("origin")
        # Requests by another site's image or link have no Origin; a link may lead to the page itself.
        is_own = request.headers.get("sec-fetch-site", "none") in {"none", "same-origin"} or request.url.path == "/"
        if not is_own or (origin is not None and not same_origin(origin, host)):
            return 403, "requests of other sites are refused"
        reads = request.scope.get("method", "GET") in {"GET", "HEAD"}
        if self._secret is None or self._carries(request, self._secret):
            return (403, _AT_HUB) if self._rules.read_only and not reads else None
        if self._reader_secret is None or not self._carries(request, self._reader_secret):
            return 401, "the token is missing or wrong: open the address that the dashboard has printed"
        if not reads:
            return 403, "the reader's token does not allow changes: they need the operator's, --token of the dashboard"
        return None

    def _carries(self, request: HTTPConnection, secret: str) -> bool:
        """Whether a request carries the token with this digest, or the digest as a cookie."""
        kind, _, bearer = request.headers.get("authorization", "").partition(" ")
        tokens = request.query_params.getlist("token")[:1] + ([bearer.strip()] if kind.lower() == "bearer" else [])
        digests = [*map(_digest, tokens), request.cookies.get(self._rules.cookie, "")]
        return any(hmac.compare_digest(digest.encode(), secret.encode()) for digest in digests)

    def _with_headers(self, request: HTTPConnection, send: Send) -> Send:
        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers[name] = value
                # Browsers keep files, and check each time whether they have changed.
                headers.setdefault("Cache-Control", "no-cache" if "etag" in headers else "no-store")
                if message["status"] == 200:
                    for secret in {*map(_digest, request.query_params.getlist("token")[:1])} & self._secrets:
                        cookie = f"{self._rules.cookie}={secret}; Path=/; HttpOnly; SameSite=Strict"
                        headers.append("Set-Cookie", cookie)
            await send(message)

        return sending


def _digest(token: str) -> str:
    return sha256(token.encode()).hexdigest()
