"""Access control: requests of other sites' pages are refused, and those of other machines need a token.

Where the server has tokens, the reader's admits what only reads: GET, HEAD and WebSockets. All else needs the
operator's.
"""

import hmac
from hashlib import sha256
from typing import Final

from msgspec import Struct
from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skyless.page.api.json_answer import json_answer
from skyless.run.web import is_own_host, same_origin

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
_POLICY_VIOLATION: Final = 1008


class AccessRules(Struct, frozen=True):
    """What the guard checks."""

    token: str | None = None
    """The operator's, which requests must carry; None where only programs of this machine can reach the server."""
    reader_token: str | None = None
    """Carried by requests that only read; not without an operator's token."""
    names: frozenset[str] = frozenset()
    """Valid host names, in lower case, in addition to ``localhost``."""
    read_only: bool = False
    """Whether nothing can be changed here, as at a hub."""
    remote: bool = False
    """Whether other machines can reach the server: then any IP address is a valid host."""
    cookie: str = "skyless"
    """Name of the cookie: browsers keep one for all ports of a machine."""


class Guard:
    """ASGI middleware: checks Host, Origin and token of every request and WebSocket, and adds security headers.

    ``skyless.run.web`` says what Host and Origin are refused for.
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
            await send({"type": "websocket.close", "code": _POLICY_VIOLATION, "reason": fault[1]})
        else:
            answer = json_answer({"error": fault[1]}, fault[0])
            await answer(scope, receive, self._with_headers(request, send))

    def _fault(self, request: HTTPConnection) -> tuple[int, str] | None:
        hosts = request.headers.getlist("host")
        host = hosts[0].lower() if len(hosts) == 1 else ""
        if not is_own_host(host, self._rules.names, remote=self._rules.remote):
            return 421, "unknown host name: open the address that the dashboard has printed"
        origin = request.headers.get("origin")
        # An image or a link of another site has no Origin; a link may lead to the page.
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
        digests = [*map(_digest, _tokens(request)), request.cookies.get(self._rules.cookie, "")]
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


def _tokens(request: HTTPConnection) -> list[str]:
    """Tokens in the query or as a bearer token."""
    kind, _, bearer = request.headers.get("authorization", "").partition(" ")
    return request.query_params.getlist("token")[:1] + ([bearer.strip()] if kind.lower() == "bearer" else [])
