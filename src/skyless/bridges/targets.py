"""The table of targets, opening one by its address, and the senders that carry bytes to readers."""

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

# How bytes get to readers: over TCP, UDP, a pseudo-terminal or a serial port.
#
# Nothing waits for a reader: what it does not accept in time is dropped and counted, so that no fix comes late
# because of one. What waits for it in this process and in the system stays, with its own stamps, and is what it reads
# first.

_WAITING_BYTES: Final = 1 << 15
"""Most bytes waiting for one reader in this process, or a single longer message; and as many in the system."""

_STUCK_S: Final = 5.0
"""A TCP reader that has accepted nothing for this time is disconnected."""

_ANY_PROGRAM: Final = 0o666
"""Mode of a pseudo-terminal: gpsd, for example, drops its privileges before it opens its devices."""


class TcpServer:
    """Sends the same bytes to all programs that connect."""

    def __init__(self, text: str, host: str, port: int, greeting: Callable[[], list[bytes]]) -> None:
        """``greeting`` returns what a new reader gets first."""
        self.dropped: Counter[str] = Counter()
        self.port = port
        """The port in use; with 0 configured, known once ``is_listening`` is set."""
        self.is_listening = asyncio.Event()
        self._text, self._host, self._greeting = text, host, greeting
        self._readers: set[_TcpReader] = set()

    def send(self, data: bytes) -> None:
        """Send to all readers; one with full buffers misses it."""
        for reader in tuple(self._readers):
            if not reader.send(data):
                self.dropped["slow-reader"] += 1

    async def run(self) -> None:
        """Serve until cancelled. Raises SkylessError if it cannot listen there."""
        loop = asyncio.get_running_loop()
        try:
            server = await loop.create_server(
                lambda: _TcpReader(self._readers, self._greeting, self.dropped), self._host, self.port
            )
        except OSError as error:
            raise cannot_listen(self._text, self._host, self.port, error) from None
        self.port = server.sockets[0].getsockname()[1]
        self.is_listening.set()
        try:
            await asyncio.Event().wait()  # serve_forever, when cancelled, waits until all readers have left
        finally:
            server.close()
            for reader in tuple(self._readers):
                reader.end()


class _TcpReader(asyncio.Protocol):
    """One connection; its input is ignored."""

    def __init__(self, readers: "set[_TcpReader]", greeting: Callable[[], list[bytes]], dropped: Counter[str]) -> None:
        self._readers, self._greeting, self._dropped = readers, greeting, dropped
        self._transport: asyncio.Transport | None = None
        self._stuck_since_s: float | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Greet the reader, if there are not too many."""
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
        self._readers.discard(self)

    def send(self, data: bytes) -> bool:
        """Write if there is room. Returns False if not; a connection stuck for too long is closed."""
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
        """Close the connection; waiting bytes are dropped."""
        if self._transport is not None:
            self._transport.abort()


class UdpSender:
    """Sends datagrams to one address: a host, a broadcast address or a multicast group."""

    def __init__(self, text: str, host: str, port: int, log: Callable[[str], None]) -> None:
        """Raises SkylessError if there is no such host."""
        self.dropped: Counter[str] = Counter()
        self.received: Callable[[bytes], None] | None = None
        """Called with each received datagram while it runs."""
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
        with contextlib.suppress(OSError):  # nothing to read after all, or what was sent found nobody
            received(self._socket.recv(1 << 16))


class PtySender:
    """Sends to the program that opens a pseudo-terminal, by its path or a link to it."""

    def __init__(self, text: str, link: str, log: Callable[[str], None]) -> None:
        """``link``: path of a link to create; empty for none."""
        self.dropped: Counter[str] = Counter()
        self._text, self._link, self._log = text, Path(link) if link else None, log
        self._pty: Pty | None = None
        """Exists only while running: a stale link would lead to the next terminal that the system opens."""

    def send(self, data: bytes) -> None:
        """Write; if nobody reads, this and everything unread is dropped."""
        if self._pty is None or not self._pty.send(data):
            self.dropped["not-read"] += 1

    async def run(self) -> None:
        """Keep it open until cancelled; programs' output is not read. Raises SkylessError if it cannot be created."""
        pty = Pty(self._link, held_bytes=0, asked=f"the target {self._text!r} has the path")
        try:
            os.chmod(pty.path, _ANY_PROGRAM)  # noqa: PTH101 - a device, not a file of ours
            which = "" if self._link is None else f", which is {pty.path}"
            self._log(f"{self._text}: programs read {pty.name}{which}")
            pty.start(lambda _data: None)
            self._pty = pty
            await asyncio.Event().wait()
        finally:
            self._pty = None
            pty.close()


class SerialSender:
    """Sends on a serial port of this computer, which is reopened whenever it was unplugged."""

    def __init__(self, text: str, path: str, baud: int, log: Callable[[str], None]) -> None:
        self.dropped: Counter[str] = Counter()
        self.received: Callable[[bytes], None] | None = None
        """Called with received bytes."""
        self._port = SerialPort(path, baud, lambda reason: log(f"{text}: {reason}"))
        self._write: Callable[[bytes], None] | None = None

    def send(self, data: bytes) -> None:
        """Write, or drop if there is no port or it does not keep up."""
        if self._write is None:
            self.dropped["no-port"] += 1
        elif self._port.waiting_bytes() > self._port.baud // 40:  # what it carries in a quarter of a second
            self.dropped["slow-port"] += 1
        else:
            self._write(data)

    async def run(self) -> None:
        """Keep the port open until cancelled."""
        await self._port.run(self)

    # What the port calls

    def on_open(self, send: Callable[[bytes], None]) -> None:
        """The port is open."""
        self._write = send
        self._port.clear_report()

    def on_data(self, data: bytes) -> None:
        """Bytes have come."""
        if self.received is not None:
            self.received(data)

    def on_close(self) -> None:
        """The port is closed."""
        self._write = None


MAX_HZ: Final = 1000.0

Sender = TcpServer | UdpSender | PtySender | SerialSender


class Kind(Struct, frozen=True):
    """A scheme of addresses."""

    module: str
    """Below ``skyless.bridges``, imported on use. Stream modules have ``make_encoder``, others ``make_target``."""
    hz: float
    """Usual rate of fixes for each tag."""
    max_hz: float
    summary: str
    port: int = 0
    """Usual port of a stream; other targets have their own."""


TARGET_KINDS: Final = {
    "jsonl+tcp": Kind("jsonl", 50.0, MAX_HZ, "one JSON object to a line, for programs that connect", 7010),
    "jsonl+udp": Kind("jsonl", 50.0, MAX_HZ, "one JSON object to a datagram", 7010),
    "nmea+tcp": Kind("nmea", 10.0, 50.0, "NMEA 0183 for programs that connect: gpsd, QGIS, OpenCPN", 10110),
    "nmea+udp": Kind("nmea", 10.0, 50.0, "NMEA 0183 as datagrams", 10110),
    "nmea+pty": Kind("nmea", 10.0, 50.0, "NMEA 0183 on a pseudo-terminal"),
    "nmea+serial": Kind("nmea", 10.0, 50.0, "NMEA 0183 on a serial port, as nmea+serial:/dev/ttyUSB0@115200"),
    "ros2": Kind("ros2", 50.0, MAX_HZ, "topics of ROS 2, published by the node of ros2/skyless_ros2 on this computer"),
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


class StreamTarget(Target):
    """An encoder's bytes, carried by a sender."""

    def __init__(self, text: str, encoder: Encoder, sender: Sender) -> None:
        super().__init__(text)
        self._encoder, self._sender = encoder, sender
        self.one_tag = encoder.one_tag
        self.dropped = encoder.dropped = sender.dropped

    def on_site(self, site: BridgedSite) -> None:
        """See ``Target``."""
        self._send(self._encoder.on_site(site))

    def on_fix(self, fix: FixMessage) -> None:
        """See ``Target``."""
        self._send(self._encoder.on_fix(fix))

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> None:
        """See ``Target``."""
        self._send(self._encoder.on_no_fix(tag, unix_s, reason))

    def on_second(self, unix_s: float) -> None:
        """See ``Target``."""
        self._send(self._encoder.on_second(unix_s))

    def on_bytes(self, data: bytes) -> None:
        """See ``Target``."""
        self._send(self._encoder.on_bytes(data, time.time_ns()))

    async def run(self) -> None:
        """See ``Target``."""
        await self._sender.run()

    def _send(self, messages: list[bytes]) -> None:
        for message in messages:
            self._sender.send(message)


def open_route(text: str, context: BridgeContext) -> Route:
    """Open the target of an address, with its tag and rate. Raises SkylessError if there is none."""
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


def _stream(url: TargetUrl, kind: Kind, encoder: Encoder, context: BridgeContext) -> StreamTarget:
    """Combine an encoder with the sender named after ``+`` in the scheme."""
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
    target = StreamTarget(url.text, encoder, sender)
    if isinstance(sender, UdpSender | SerialSender):
        sender.received = target.on_bytes
    return target
