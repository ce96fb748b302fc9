"""Running the dashboard: its socket, its work, and its shutdown."""

import asyncio
import contextlib
import errno
import logging
import signal
import socket
from collections.abc import Coroutine, Iterator
from typing import Any, Final

import uvicorn
from msgspec import Struct

from skyless.core.errors import SkylessError
from skyless.page.app import Services, make_app
from skyless.page.connections import Connection, FailedAccepts, end_unfinished
from skyless.page.guard import AccessRules
from skyless.page.sockets import SEND_TIMEOUT_S
from skyless.run.limits import PAGE as LIMITS
from skyless.run.process import ending_signals, reserve

PORT: Final = 8080
_MORE_PORTS: Final = 50
_PING_S: Final = 5.0
_GRACE_S: Final = 0.4
_SEND_BUFFER_BYTES: Final = 262_144  # data for a slow page that waits in the kernel and is sent before anything newer


class ListenAddress(Struct, frozen=True):
    """Where the server listens."""

    host: str
    port: int | None
    """None: 8080, or the next one that is free."""


def bind(listen: ListenAddress) -> socket.socket:
    """A socket at the address, or at the next free port where none is given.

    Raises:
        SkylessError: the socket cannot listen there.
    """
    if listen.port is not None:
        return _bind(listen.host, listen.port)
    for port in range(PORT, PORT + _MORE_PORTS):
        held = reserve(listen.host, port)
        if held is None:  # a demo that has just started names this port and is about to listen there
            continue
        with held, contextlib.suppress(_PortInUseError):
            return _bind(listen.host, port)
    return _bind(listen.host, 0)


class _PortInUseError(SkylessError):
    """Another program uses the port."""


def _bind(host: str, port: int) -> socket.socket:
    text = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, kind, _, _, address = addresses[0]
        sock = socket.socket(family, kind)
        try:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)  # every page's socket inherits it
            if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux; elsewhere the system's own time-out applies
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * SEND_TIMEOUT_S))
            sock.bind(address)
            sock.listen(socket.SOMAXCONN)  # two sockets may be bound to one port, but not both listen
        except BaseException:
            sock.close()
            raise
    except (OSError, UnicodeError) as error:
        if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
            raise _PortInUseError(
                f"--listen is {text!r}; another program uses this port; without --listen a free one is taken"
            ) from None
        reason = error.strerror if isinstance(error, OSError) else error
        raise SkylessError(f"--listen is {text!r}, where this machine cannot listen: {reason}") from None
    return sock


async def serve(services: Services, rules: AccessRules, sock: socket.socket, sites: Coroutine[Any, Any, None]) -> None:
    """Serve pages until Ctrl-C, SIGTERM or SIGHUP. ``sites`` keeps the sites connected."""
    config = uvicorn.Config(
        make_app(services, rules),
        http=Connection,
        lifespan="off",
        log_config=None,
        log_level="error",
        access_log=False,
        proxy_headers=False,
        server_header=False,
        ws="websockets-sansio",
        ws_per_message_deflate=False,  # on the same machine it would only cost time
        ws_ping_interval=_PING_S,
        ws_ping_timeout=SEND_TIMEOUT_S,
        ws_max_size=LIMITS.message_bytes,
        timeout_graceful_shutdown=1,
    )
    server = _Server(config)
    jobs = [sites, end_unfinished(server.server_state.connections)]
    if services.gathered is not None:
        jobs.append(services.gathered.run(services.sites))
    work = [asyncio.create_task(job) for job in jobs]
    loop = asyncio.get_running_loop()
    logging.getLogger("asyncio").addFilter(FailedAccepts())
    for number in (signal.SIGINT, *ending_signals()):
        loop.add_signal_handler(number, _stop, server, services)
    serving = asyncio.create_task(server.serve(sockets=[sock]))
    try:
        await asyncio.wait([serving, *work], return_when=asyncio.FIRST_COMPLETED)
    finally:
        _stop(server, services)
        for task in work:
            task.cancel()
        ended = await asyncio.gather(serving, *work, return_exceptions=True)
    for result in ended:
        if isinstance(result, Exception):
            raise result


def _stop(server: "_Server", services: Services) -> None:
    """Shut down soon, even if pages do not respond."""
    if not server.should_exit:
        server.should_exit = True
        for live in services.sites.all:
            live.close()
        services.playback.stop()
        services.overlays.stop()
        services.what_ifs.stop()
        services.sheets.stop()
        services.past.stop()
        asyncio.get_running_loop().call_later(_GRACE_S, server.drop_connections)


class _Server(uvicorn.Server):
    """A server that does not handle signals. Its owner does."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    def drop_connections(self) -> None:
        """Close connections that have not ended."""
        self.force_exit = True
        for connection in list(self.server_state.connections):
            transport = getattr(connection, "transport", None)
            if transport is not None:
                transport.abort()
