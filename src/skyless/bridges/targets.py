"""The table of targets, opening a target by its address, and the senders that carry bytes to readers."""

import asyncio
import contextlib
import os
import socket
import time
from collections import Counter
from collections.abc import Callable
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Final, cast

from msgspec import Struct

from skyless.bridges.target import BridgeContext, BridgedSite, Encoder, Route, Target, TargetUrl, cannot_listen
from skyless.core.errors import SkylessError
from skyless.radio.serial.serial_port import Pty, SerialPort
from skyless.run.mqtt.messages import FixMessage
from skyless.run.web import BRIDGES as LIMITS

# Senders of bytes over TCP, UDP, a pseudo-terminal or a serial port.
#
# No sender waits for a reader: data that a reader does not accept in time are dropped and counted, so that it delays no
# fix for others. Data already in the buffers of this process and the system stay, with their own stamps, and are read
# first.

_WAITING_BYTES: Final = 1 << 15
"""Bytes that may wait for one reader in this process (or a single longer message), and again in the system."""

_MAX_DATAGRAM_BYTES: Final = 1 << 16

_STUCK_S: Final = 5.0
"""A TCP reader that has accepted nothing for this long is disconnected."""

_ANY_PROGRAM: Final = 0o666
"""Mode of a pseudo-terminal, for programs that drop their privileges before they open it, such as gpsd."""


class TcpServer:
    """Sends the same bytes to all programs that connect."""

    def __init__(self, text: str, host: str, port: int, greeting: Callable[[], list[bytes]]) -> None:
        """``greeting`` returns the first messages for a new reader."""
        self.dropped: Counter[str] = Counter()
        self.port = port
        """The port in use while the server runs, also if 0 was given."""
        self._text, self._host, self._greeting = text, host, greeting
        self._readers: set[_TcpReader] = set()

    def send(self, data: bytes) -> None:
        """Send to all readers except those whose buffers are full."""
        for reader in tuple(self._readers):
            if not reader.send(data):
                self.dropped["slow-reader"] += 1

    async def run(self) -> None:
        """Serve until cancelled. Raises SkylessError: it cannot listen there."""
        loop = asyncio.get_running_loop()
        try:
            server = await loop.create_server(
                lambda: _TcpReader(self._readers, self._greeting, self.dropped), self._host, self.port
            )
        except OSError as error:
            raise cannot_listen(self._text, self._host, self.port, error) from None
        self.port = server.sockets[0].getsockname()[1]
        try:
            await asyncio.Event().wait()  # serve_forever, when cancelled, waits until all readers have left
        finally:
            server.close()
            for reader in tuple(self._readers):
                reader.end()


class _TcpReader(asyncio.Protocol):
    """One connection; data from it are ignored."""

    def __init__(self, readers: "set[_TcpReader]", greeting: Callable[[], list[bytes]], dropped: Counter[str]) -> None:
        self._readers, self._greeting, self._dropped = readers, greeting, dropped
        self._transport: asyncio.Transport | None = None
        self._stuck_since_s: float | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Send the greeting, or close the connection if there are too many readers."""
        assert isinstance(transport, asyncio.Transport)
        if len(self._readers) >= LIMITS.readers:
            self._dropped["too-many-readers"] += 1
            transport.abort()
            return
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _WAITING_BYTES)
        self._transport = transport
        self._readers.add(self)
        for message in self._greeting():
            self.send(message)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - the reason makes no difference
        """Forget the reader."""
        self._readers.discard(self)

    def send(self, data: bytes) -> bool:
        """Send data if there is room; return whether they were accepted. A stuck connection is closed."""
        if self._transport is None or self._transport.is_closing():
            return False
        waiting = self._transport.get_write_buffer_size()
        if not waiting or waiting + len(data) <= _WAITING_BYTES:
            self._stuck_since_s = None
            self._transport.write(data)
            return True
        now_s = asyncio.get_running_loop().time()
        if self._stuck_since_s is None:
            self._stuck_since_s = now_s
        elif now_s - self._stuck_since_s > _STUCK_S:
            self.end()
        return False

    def end(self) -> None:
        """Close the connection; waiting data are dropped."""
        if self._transport is not None:
            self._transport.abort()


class UdpSender:
    """Sends datagrams to one address: a host, a broadcast address or a multicast group."""

    def __init__(self, text: str, host: str, port: int, log: Callable[[str], None]) -> None:
        """Raises SkylessError: there is no such host."""
        self.dropped: Counter[str] = Counter()
        self.received: Callable[[bytes], None] | None = None
        """Called with each datagram received while ``run`` runs; set it before."""
        self._text, self._log, self._trouble = text, log, ""
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except (OSError, UnicodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "no name of a host"
            raise SkylessError(f"the target {text!r} has a host that cannot be found: {reason}") from None
        self._address = address
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)
        if family == socket.AF_INET:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

    def send(self, data: bytes) -> None:
        """Send a datagram; the network may lose it."""
        try:
            self._socket.sendto(data, self._address)
        except OSError as error:
            self.dropped["not-sent"] += 1
            reason = error.strerror or str(error)
            if reason != self._trouble and not isinstance(error, BlockingIOError):
                self._trouble = reason
                self._log(f"{self._text}: datagrams cannot be sent: {reason}")

    async def run(self) -> None:
        """Keep the socket until cancelled."""
        loop = asyncio.get_running_loop()
        with self._socket:
            if self.received is not None:
                loop.add_reader(self._socket, self._read, self.received)
            try:
                await asyncio.Event().wait()
            finally:
                loop.remove_reader(self._socket)

    def _read(self, received: Callable[[bytes], None]) -> None:
        with contextlib.suppress(OSError):  # nothing to read after all, or a datagram sent earlier found no receiver
            received(self._socket.recv(_MAX_DATAGRAM_BYTES))


class PtySender:
    """Sends to the program that opens a pseudo-terminal, by its path or by a link to it."""

    def __init__(self, text: str, link: str, log: Callable[[str], None]) -> None:
        """``link`` is the path of the link to it; empty for none."""
        self.dropped: Counter[str] = Counter()
        self._text, self._link, self._log = text, Path(link) if link else None, log
        self._pty: Pty | None = None
        """Exists while it runs: a link left behind would lead to the terminal that the system opens next."""

    def send(self, data: bytes) -> None:
        """Write data; if no program reads, these and any unread data are dropped."""
        if self._pty is None or not self._pty.send(data):
            self.dropped["not-read"] += 1

    async def run(self) -> None:
        """Keep the terminal open until cancelled; its input is ignored. Raises SkylessError if it cannot be made."""
        pty = Pty(self._link, held_bytes=0, asked=f"the target {self._text!r} has the path")
        try:
            os.chmod(pty.path, _ANY_PROGRAM)  # noqa: PTH101 - a device, not one of our files
            which = "" if self._link is None else f", which is {pty.path}"
            self._log(f"{self._text}: programs read {pty.name}{which}")
            pty.start(lambda _data: None)
            self._pty = pty
            await asyncio.Event().wait()
        finally:
            self._pty = None
            pty.close()


class SerialSender:
    """Sends on a serial port of this computer, which is opened again after it was unplugged."""

    def __init__(self, text: str, path: str, baud: int, log: Callable[[str], None]) -> None:
        self.dropped: Counter[str] = Counter()
        self.received: Callable[[bytes], None] | None = None
        """Called with received data."""
        self._port = SerialPort(path, baud, lambda reason: log(f"{text}: {reason}"))
        self._write: Callable[[bytes], None] | None = None

    def send(self, data: bytes) -> None:
        """Write data; drop them if there is no port, or if it does not keep up."""
        if self._write is None:
            self.dropped["no-port"] += 1
        elif self._port.waiting_bytes() > self._port.baud // 40:  # a quarter of a second's worth
            self.dropped["slow-port"] += 1
        else:
            self._write(data)

    async def run(self) -> None:
        """Keep the port open until cancelled."""
        await self._port.run(self)

    # Called by the port

    def on_open(self, send: Callable[[bytes], None]) -> None:
        """Note that the port is open."""
        self._write = send
        self._port.clear_report()

    def on_data(self, data: bytes) -> None:
        """Pass on received bytes."""
        if self.received is not None:
            self.received(data)

    def on_close(self) -> None:
        """Note that the port is closed."""
        self._write = None


MAX_HZ: Final = 1000.0

Sender = TcpServer | UdpSender | PtySender | SerialSender


class Kind(Struct, frozen=True):
    """A scheme of addresses."""

    module: str
    """Module in ``skyless.bridges``, imported when used, with ``make_encoder`` for a stream, else ``make_target``."""
    hz: float
    """Default rate of fixes for each tag."""
    max_hz: float
    summary: str
    port: int = 0
    """Default port of a stream; other targets know their own."""


TARGET_KINDS: Final = {
    "jsonl+tcp": Kind("jsonl", 50.0, MAX_HZ, "one JSON object to a line, for programs that connect", 7010),
    "jsonl+udp": Kind("jsonl", 50.0, MAX_HZ, "one JSON object to a datagram", 7010),
    "nmea+tcp": Kind("nmea", 10.0, 50.0, "NMEA 0183 for programs that connect: gpsd, QGIS, OpenCPN", 10110),
    "nmea+udp": Kind("nmea", 10.0, 50.0, "NMEA 0183 as datagrams", 10110),
    "nmea+pty": Kind("nmea", 10.0, 50.0, "NMEA 0183 on a pseudo-terminal"),
    "nmea+serial": Kind("nmea", 10.0, 50.0, "NMEA 0183 on a serial port, as nmea+serial:/dev/ttyUSB0@115200"),
    "ros2": Kind("ros2", 50.0, MAX_HZ, "topics of ROS 2, published by DDS without ROS being installed"),
    "mavlink+udpout": Kind(
        "mavlink", 30.0, 100.0, "MAVLink 2 for an autopilot; ?profile= ardupilot, px4 or gps", 14550
    ),
    "mavlink+serial": Kind("mavlink", 30.0, 100.0, "the same on a serial port, as mavlink+serial:/dev/ttyAMA0@921600"),
    "foxglove": Kind("foxglove", 20.0, MAX_HZ, "live pages of Foxglove and Lichtblick"),
    "homeassistant": Kind("home_assistant", 10.0, 50.0, "tags as devices of Home Assistant, with their rooms"),
    "prometheus": Kind("prometheus", 50.0, MAX_HZ, "figures for Prometheus at /metrics"),
    "omlox+ws": Kind("omlox", 10.0, 10.0, "locations for an omlox hub: omlox+ws://HOST/v2/ws/socket?zone=UUID"),
    "omlox+wss": Kind("omlox", 10.0, 10.0, "the same over TLS; ?token_file= signs in"),
    "webhook+https": Kind(
        "webhook", 1.0, MAX_HZ, "alarms, posted as signed JSON: webhook+https://HOST/PATH?secret_file="
    ),
    "webhook+http": Kind("webhook", 1.0, MAX_HZ, "the same unencrypted"),
    "smtp": Kind("mail", 1.0, MAX_HZ, "alarms as mails: smtp://USER@HOST?starttls&to=NAME@HOST&password_file="),
    "smtps": Kind("mail", 1.0, MAX_HZ, "the same over TLS from the first byte"),
}


class _StreamTarget(Target):
    """A target whose encoder makes bytes for a sender."""

    def __init__(self, text: str, encoder: Encoder, sender: Sender) -> None:
        super().__init__(text)
        self._encoder, self._sender = encoder, sender
        self.one_tag = encoder.one_tag
        self.dropped = encoder.dropped = sender.dropped

    def on_site(self, site: BridgedSite) -> None:
        self._send(self._encoder.on_site(site))

    def on_fix(self, fix: FixMessage) -> None:
        self._send(self._encoder.on_fix(fix))

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> None:
        self._send(self._encoder.on_no_fix(tag, unix_s, reason))

    def on_second(self, unix_s: float) -> None:
        self._send(self._encoder.on_second(unix_s))

    def on_bytes(self, data: bytes) -> None:
        self._send(self._encoder.on_bytes(data, time.time_ns()))

    async def run(self) -> None:
        await self._sender.run()

    def _send(self, messages: list[bytes]) -> None:
        for message in messages:
            self._sender.send(message)


def open_route(text: str, context: BridgeContext) -> Route:
    """Create the target for an address, with its tag and rate. Raises SkylessError."""
    url = TargetUrl(text)
    kind = TARGET_KINDS.get(url.scheme)
    if kind is None:
        near = [scheme for scheme in TARGET_KINDS if scheme.startswith(f"{url.scheme}+")]
        near = near or get_close_matches(url.scheme, TARGET_KINDS)
        nearest = f"{' or '.join(f'{scheme}:' for scheme in near)}, if that was meant, or " if near else ""
        names = ", ".join(f"{scheme}:" for scheme in TARGET_KINDS)
        raise url.wrong(f"{nearest}one of {names} as skyless bridge --help shows")
    tag = url.tag()
    hz = url.number("hz", kind.hz, 0.1, kind.max_hz)
    module = import_module(f"skyless.bridges.{kind.module}")
    target: Target
    if hasattr(module, "make_encoder"):
        encoder = cast(Callable[[TargetUrl, BridgeContext], Encoder], module.make_encoder)(url, context)
        target = _stream(url, kind, encoder, context)
    else:
        target = cast(Callable[[TargetUrl, BridgeContext], Target], module.make_target)(url, context)
    url.check_all_read()
    return Route(target, tag, hz, others=tag is not None)


def _stream(url: TargetUrl, kind: Kind, encoder: Encoder, context: BridgeContext) -> _StreamTarget:
    """Connect an encoder to the sender that the scheme names after ``+``."""
    sender: Sender
    match url.scheme.partition("+")[2]:
        case "tcp":
            sender = TcpServer(url.text, url.host(), url.port(kind.port), encoder.greeting)
        case "pty":
            sender = PtySender(url.text, url.path(), context.log)
        case "serial":
            path, _, baud = url.path().partition("@")
            if not path or (baud and not (baud.isdecimal() and 300 <= int(baud) <= 10_000_000)):
                raise url.wrong(f"{url.scheme}:PATH@BAUD, as {url.scheme}:/dev/ttyAMA0@921600")
            sender = SerialSender(url.text, path, int(baud or 115_200), context.log)
        case _:
            sender = UdpSender(url.text, url.host(), url.port(kind.port), context.log)
    target = _StreamTarget(url.text, encoder, sender)
    if isinstance(sender, UdpSender | SerialSender):
        sender.received = target.on_bytes
    return target
