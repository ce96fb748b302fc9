"""Running the dashboard: its socket, its link to the broker, and its end."""

import asyncio
import contextlib
import errno
import signal
import socket
from collections.abc import Iterator
from typing import Final

import uvicorn
from msgspec import Struct

from skyless.dashboard.app import DEAD_S, Parts, make_app
from skyless.dashboard.guard import Rules
from skyless.errors import SkylessError
from skyless.mqtt.address import MqttAddress
from skyless.mqtt.link import Link
from skyless.nodes.find_site import find_site
from skyless.nodes.process import ending_signals

PORT: Final = 8080
_MORE_PORTS: Final = 50
_PING_S: Final = 5.0
_LARGEST_PING: Final = 1024
_GRACE_S: Final = 0.4
_SEND_BUFFER: Final = 262_144
"""Bytes that wait in the kernel for a slow page, which it gets before anything newer."""


class Listen(Struct, frozen=True):
    """Where the server listens."""

    host: str
    port: int | None
    """None: 8080, or the next one that is free."""


def bind(listen: Listen) -> socket.socket:
    """A socket at the address, or at the next free port where none was asked for.

    Raises:
        SkylessError: naming the address and why it cannot be had.
    """
    if listen.port is not None:
        return _bind(listen.host, listen.port)
    for port in range(PORT, PORT + _MORE_PORTS):
        try:
            return _bind(listen.host, port)
        except _TakenError:
            continue
    return _bind(listen.host, 0)


class _TakenError(SkylessError):
    """Another program has the port."""


def _bind(host: str, port: int) -> socket.socket:
    place = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[
            0
        ]
        sock = socket.socket(family, kind)
        try:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)  # every page's socket inherits it
            if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux; elsewhere the system's own patience counts
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * DEAD_S))
            sock.bind(address)
            sock.listen(socket.SOMAXCONN)  # two sockets may be bound to one port, but not both listen
        except BaseException:
            sock.close()
            raise
    except (OSError, UnicodeError) as error:
        if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
            raise _TakenError(f"--listen is {place!r}; another program has this port") from None
        reason = error.strerror if isinstance(error, OSError) else error
        raise SkylessError(f"--listen is {place!r}, where this machine cannot listen: {reason}") from None
    return sock


async def serve(parts: Parts, rules: Rules, sock: socket.socket, address: MqttAddress, site_id: int | None) -> None:
    """Serve pages until Ctrl-C, SIGTERM or SIGHUP."""
    config = uvicorn.Config(
        make_app(parts, rules),
        lifespan="off",
        log_config=None,
        log_level="error",
        access_log=False,
        proxy_headers=False,
        server_header=False,
        ws="websockets-sansio",
        ws_per_message_deflate=False,  # on the own machine it would only cost time
        ws_ping_interval=_PING_S,
        ws_ping_timeout=DEAD_S,
        ws_max_size=_LARGEST_PING,
        timeout_graceful_shutdown=1,
    )
    server = _Server(config)
    work = [asyncio.create_task(_follow(parts, address, site_id)), asyncio.create_task(parts.live.run())]
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, *ending_signals()):
        loop.add_signal_handler(number, _stop, server, parts)
    serving = asyncio.create_task(server.serve(sockets=[sock]))
    try:
        await asyncio.wait([serving, *work], return_when=asyncio.FIRST_COMPLETED)
    finally:
        _stop(server, parts)
        for task in work:
            task.cancel()
        ended = await asyncio.gather(serving, *work, return_exceptions=True)
    for result in ended:
        if isinstance(result, Exception):
            raise result


def _stop(server: "_Server", parts: Parts) -> None:
    """End soon, whatever pages do."""
    if not server.should_exit:
        server.should_exit = True
        parts.live.close()
        parts.playback.stop()
        parts.overlays.stop()
        asyncio.get_running_loop().call_later(_GRACE_S, server.drop_connections)


class _Server(uvicorn.Server):
    """A server that leaves signals to its owner."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    def drop_connections(self) -> None:
        """Wait no longer for those who do not read."""
        self.force_exit = True
        for connection in list(self.server_state.connections):
            transport = getattr(connection, "transport", None)
            if transport is not None:
                transport.abort()


async def _follow(parts: Parts, address: MqttAddress, site_id: int | None) -> None:
    """Keep the link to the broker."""
    live = parts.live
    if site_id is None:
        site_id = await find_site(address, live.connection)
    link = Link(address, live.name, site=site_id, kind="dashboard")
    link.on_state.append(live.connection)
    live.attach(link, site_id)
    await link.run()
