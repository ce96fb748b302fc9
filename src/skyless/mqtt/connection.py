"""One connection to a broker, from its beginning until it breaks: paho's client, driven by our event loop."""

import asyncio
import contextlib
import logging
import socket
import ssl
from collections.abc import Callable, Iterable, Mapping
from typing import Final, cast

from msgspec import Struct
from paho.mqtt import client as paho
from paho.mqtt.enums import MQTTErrorCode
from paho.mqtt.reasoncodes import ReasonCode

from skyless.mqtt.address import MqttAddress
from skyless.mqtt.paho_client import Introduction, connect, make_client

ANSWER_S: Final = 5.0
"""How long a broker may take to accept a connection."""

_GOODBYE_S: Final = 1.0

_SEND_BUFFER: Final = 262_144
"""Bytes that wait in the kernel, and as many in the process: what is older than the newest fix should not be many."""

_MOST_PACKETS: Final = 100
"""Read at once, before others of the event loop have their turn."""

_QUICK_ACK: Final = getattr(socket, "TCP_QUICKACK", None)
"""Linux forgets it and must be told again. mosquitto holds a message back until the one before is acknowledged, which
TCP otherwise delays by 40 ms."""

_REFUSALS: Final = {
    "Bad user name or password": "wrong user name or password",
    "Not authorized": "wrong user name or password, or no permission",
}

_log = logging.getLogger("skyless.mqtt")


class RefusedError(Exception):
    """The broker does not want this client; the text says why."""


class Reactions(Struct, frozen=True):
    """Functions that the event loop calls."""

    message: Callable[[str, bytes], None] = lambda _topic, _payload: None
    acknowledged: Callable[[int], None] = lambda _number: None
    """The broker has the message of QoS 1 that ``publish`` gave this number."""
    writable: Callable[[], None] = lambda: None
    """The connection takes more again."""


class Connection:
    """A client of paho for one connection: what breaks is thrown away, and nothing waits here for the next one.

    paho writes at once (it would wait for a turn of the event loop if it had ``on_socket_register_write``). What the
    socket does not take waits in paho until the event loop finds the socket writable, and what is published while paho
    reads, until it has read.
    """

    def __init__(self, address: MqttAddress, tls: ssl.SSLContext | None, who: Introduction, react: Reactions) -> None:
        self.writable = False
        """Whether the connection takes more; false while a slow broker has its buffers full, and once it is lost."""
        self.lost = asyncio.Event()
        self.reason = "the broker has closed the connection"
        """Why it was lost."""
        self._address = address
        self._keepalive_s = who.keepalive_s
        self._react = react
        self._loop = asyncio.get_running_loop()
        self._client = make_client(address, tls, who, ANSWER_S)
        self._accepted: asyncio.Future[None] = self._loop.create_future()
        self._socket: socket.socket | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._heard = False
        self._messages = 0
        self._reading = self._awaits_socket = False
        self._waiting_bytes = 0
        self._flying: dict[int, paho.MQTTMessageInfo] = {}
        self._asked: dict[int, tuple[str, ...]] = {}

    async def open(self) -> None:
        """Connect, and wait until the broker accepts.

        Raises:
            RefusedError: it does not.
            OSError: it cannot be reached, or does not answer (TimeoutError).
        """
        try:
            async with asyncio.timeout(ANSWER_S):
                await connect(self._client, self._address, max(1, self._keepalive_s // 2))
                self._begin()
                await self._accepted
        except BaseException as error:
            self.abort("gave up")
            if isinstance(error, TimeoutError) and not error.args:
                raise TimeoutError(self._no_answer()) from None
            raise
        self.writable = not self.lost.is_set()
        self._look()

    def publish(self, topic: str, payload: bytes, qos: int, *, retain: bool) -> int:
        """Send a message, or let it wait for the socket; never blocks. Its number until it is acknowledged."""
        info = self._client.publish(topic, payload, qos, retain)
        while info.rc == MQTTErrorCode.MQTT_ERR_QUEUE_SIZE:  # its number still flies, 65 535 messages later
            info = self._client.publish(topic, payload, qos, retain)
        if qos and not info.rc:
            self._flying[info.mid] = info
        if self._client.want_write():
            self._waiting_bytes += len(topic) + len(payload)
            self.writable = self.writable and self._waiting_bytes < _SEND_BUFFER
            self._await_socket()
        return info.mid

    def subscribe(self, filters: Mapping[str, int]) -> None:
        """Ask for the messages of topic filters, each with its QoS."""
        _, number = self._client.subscribe(list(filters.items()))
        if number is not None:
            self._asked[number] = tuple(filters)
        self._await_socket()

    def unsubscribe(self, filters: Iterable[str]) -> None:
        """Ask for them no more."""
        self._client.unsubscribe(list(filters))
        self._await_socket()

    def abort(self, reason: str) -> None:
        """Drop the connection at once."""
        if not self.lost.is_set():
            self._lose(reason)
        if self._socket is not None:
            sock = self._socket
            self._client.on_socket_close = None
            self._leave_loop()
            sock.close()

    async def leave(self) -> None:
        """Say goodbye, and close when all is sent, or without it after a second."""
        self.writable = False
        if not self.lost.is_set():
            self._client.disconnect()
            self._await_socket()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_GOODBYE_S):
                await self.lost.wait()
        self.abort("left")

    # What the event loop calls

    def _begin(self) -> None:
        """Keep buffers small, so that nothing old piles up in them, and watch the socket."""
        self._socket = cast(socket.socket | None, self._client.socket())
        if self._socket is None:
            raise ConnectionError(self.reason)
        self._client.on_connect = self._on_connect
        self._client.on_disconnect = self._on_disconnect
        self._client.on_socket_close = self._on_socket_close
        self._client.on_message = self._on_message
        self._client.on_subscribe = self._on_subscribe
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self._loop.add_reader(self._socket, self._read)
        self._await_socket()

    def _read(self) -> None:
        """Read all that has come, one packet after the other."""
        self._heard = self._reading = True
        left = _MOST_PACKETS
        while self._socket is not None:
            seen = self._messages
            self._client.loop_read()
            left -= 1
            # What TLS has decrypted already, the socket does not announce any more.
            if not _decrypted(self._socket) and (left <= 0 or self._messages == seen):
                break
        self._reading = False
        if self._socket is not None and _QUICK_ACK is not None:
            self._socket.setsockopt(socket.IPPROTO_TCP, _QUICK_ACK, 1)
        # paho's on_publish would also come for each message of QoS 0, whose number may be that of another in flight.
        for number in [number for number, info in self._flying.items() if info.is_published()]:
            del self._flying[number]
            self._react.acknowledged(number)
        self._write()

    def _write(self) -> None:
        """Write what waits, and let more come when nothing waits any more."""
        if self._client.want_write():
            self._client.loop_write()
        if not self._client.want_write():
            self._waiting_bytes = 0
            if not self.writable and self._accepted.done() and not self.lost.is_set():
                self.writable = True
                self._react.writable()
        self._await_socket()

    def _await_socket(self) -> None:
        """Be called when the socket takes more, as long as paho has more for it."""
        wanted = self._client.want_write() and self._socket is not None
        if self._reading or self._socket is None or wanted == self._awaits_socket:
            return
        self._awaits_socket = wanted
        if wanted:
            self._loop.add_writer(self._socket, self._write)
        else:
            self._loop.remove_writer(self._socket)

    def _look(self) -> None:
        """Let paho ask for a sign of life after half the keepalive time, and give up after the other half."""
        self._client.loop_misc()
        self._await_socket()
        if self._socket is not None:
            self._timer = self._loop.call_later(self._keepalive_s / 20, self._look)

    def _leave_loop(self) -> None:
        if self._socket is not None:
            self._loop.remove_reader(self._socket)
            self._loop.remove_writer(self._socket)
            self._socket = None
        if self._timer is not None:
            self._timer.cancel()

    def _lose(self, reason: str) -> None:
        self.reason = reason
        self.writable = False
        if not self._accepted.done():
            self._accepted.set_exception(ConnectionError(reason))
            self._accepted.exception()  # retrieved, should nobody wait for it any more
        self.lost.set()

    def _no_answer(self) -> str:
        return "the broker does not speak MQTT" if self._heard else f"no answer within {ANSWER_S:g} s"

    # What paho calls

    def _on_connect(self, _client: object, _data: object, _flags: object, code: ReasonCode, _more: object) -> None:
        if self._accepted.done():
            return
        if code.is_failure:
            self._accepted.set_exception(RefusedError(_REFUSALS.get(str(code), str(code))))
        else:
            self._accepted.set_result(None)

    def _on_disconnect(self, _client: object, _data: object, _flags: object, code: ReasonCode, _more: object) -> None:
        if self.lost.is_set():
            return
        if code == "Keep alive timeout":
            self._lose(f"the broker has been silent for {self._keepalive_s} s")
        elif code == "Protocol error":
            self._lose("the broker does not speak MQTT")
        else:
            self._lose(self.reason)

    def _on_socket_close(self, _client: object, _data: object, _socket: object) -> None:
        self._leave_loop()

    def _on_message(self, _client: object, _data: object, message: paho.MQTTMessage) -> None:
        self._messages += 1
        try:
            topic = message.topic
        except UnicodeDecodeError:
            self.abort("the broker does not speak MQTT: a topic that is not UTF-8")
            return
        self._react.message(topic, bytes(message.payload))

    def _on_subscribe(
        self, _client: object, _data: object, number: int, codes: list[ReasonCode], _more: object
    ) -> None:
        for name, code in zip(self._asked.pop(number, ()), codes, strict=False):
            if code.is_failure:
                _log.warning("the broker %s does not let this user subscribe to %s", self._address, name)


def _decrypted(sock: socket.socket) -> int:
    """Bytes that wait in TLS."""
    return sock.pending() if isinstance(sock, ssl.SSLSocket) else 0
