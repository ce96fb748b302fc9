"""The table of targets, and how one is opened by its address."""

import time
from collections.abc import Callable
from difflib import get_close_matches
from importlib import import_module
from typing import Final, cast

from msgspec import Struct

from skyless.bridges._senders import PtySender, SerialSender, TcpServer, UdpSender
from skyless.bridges.hub import Route
from skyless.bridges.target import BridgeContext, BridgedSite, Encoder, Target, TargetUrl
from skyless.run.mqtt.messages import FixMessage

MAX_HZ: Final = 1000.0


Sender = TcpServer | UdpSender | PtySender | SerialSender


class Kind(Struct, frozen=True):
    """A scheme of addresses."""

    module: str
    """Below ``skyless.bridges``; imported when it is used. A stream's has ``make_encoder``, others ``make_target``."""
    hz: float
    """Usual rate of fixes for each tag."""
    max_hz: float
    summary: str
    port: int = 0
    """Usual port of a stream; other targets know their own."""


TARGET_KINDS: Final = {
    "jsonl+tcp": Kind("jsonl", 50.0, MAX_HZ, "one JSON object to a line, for programs that connect", 7010),
    "jsonl+udp": Kind("jsonl", 50.0, MAX_HZ, "one JSON object to a datagram", 7010),
    "nmea+tcp": Kind("nmea", 10.0, 50.0, "NMEA 0183 for programs that connect: gpsd, QGIS, OpenCPN", 10110),
    "nmea+udp": Kind("nmea", 10.0, 50.0, "NMEA 0183 as datagrams", 10110),
    "nmea+pty": Kind("nmea", 10.0, 50.0, "NMEA 0183 on a pseudo-terminal"),
    "nmea+serial": Kind("nmea", 10.0, 50.0, "NMEA 0183 on a serial port, as nmea+serial:/dev/ttyUSB0@115200"),
    "ros2": Kind("ros2.target", 50.0, MAX_HZ, "topics of ROS 2, published by DDS without ROS being installed"),
    "mavlink+udpout": Kind(
        "mavlink.encoder", 30.0, 100.0, "MAVLink 2 for an autopilot; ?profile= ardupilot, px4 or gps", 14550
    ),
    "mavlink+serial": Kind(
        "mavlink.encoder", 30.0, 100.0, "the same on a serial port, as mavlink+serial:/dev/ttyAMA0@921600"
    ),
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
    """Bytes of an encoder, carried by a sender."""

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
    """The target of an address, with its tag and its rate. Raises SkylessError: there is none."""
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
    """An encoder and the sender that the scheme names after ``+``."""
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
