"""A single connection to a broker until it breaks: paho's client, driven by our event loop. The queue of messages."""

import asyncio
import contextlib
import logging
import math
import re
import secrets
import socket
import ssl
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from threading import Thread
from typing import Final, Self, cast

from msgspec import Struct
from paho.mqtt import client as paho
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode
from paho.mqtt.reasoncodes import ReasonCode

from skyless.core.errors import SkylessError
from skyless.run.mqtt.address import MqttAddress

BROKER_ANSWER_S: Final = 3.0
"""How long a broker may take to accept a connection."""

_LEAVE_S: Final = 1.0
_KEPT_S: Final = 0.5
_LONGEST_KEPT: Final = 20

_SEND_BUFFER: Final = 262_144
"""Size of the send buffers in the kernel and in the process; small, so that few outdated fixes wait in them."""

_MAX_PACKETS: Final = 100
"""Packets read at once, before the event loop continues with other work."""

_QUICK_ACK: Final = getattr(socket, "TCP_QUICKACK", None)
"""Without this option TCP delays acknowledgements by 40 ms, and mosquitto holds messages back until the one before is
acknowledged. Linux resets it after each use."""

_REFUSALS: Final = {
    "Bad user name or password": "wrong user name or password",
    "Not authorized": "wrong user name or password, or no permission",
}

_log = logging.getLogger("skyless.run.mqtt")


class Introduction(Struct, frozen=True):
    """What a client tells the broker about itself."""

    client: str
    """Client identifier; a random one if it is empty."""
    keepalive_s: int
    """The connection is given up when the broker has been silent for this long."""
    persistent: bool = False
    """Whether the broker keeps subscriptions, and messages of QoS 1, for this identifier."""
    will: tuple[str, bytes] | None = None
    """Topic and payload that the broker publishes, retained and at QoS 1, if the client vanishes without leaving."""


class Reactions(Struct, frozen=True):
    """Callbacks from the event loop."""

    message: Callable[[str, bytes], None] = lambda _topic, _payload: None
    acknowledged: Callable[[int], None] = lambda _number: None
    """The broker has acknowledged the message of QoS 1 with this number, which ``publish`` returned."""
    writable: Callable[[], None] = lambda: None
    """The connection accepts more data again."""
    subscribed: Callable[[str, bool], None] = lambda _filter, _granted: None
    """The broker has granted or refused a subscription."""


class RefusedError(Exception):
    """The broker refuses this client; the message says why."""


class Connection:
    """A paho client for one connection. It is discarded when it breaks; no data wait here for the next connection.

    paho writes at once, because it has no ``on_socket_register_write``. Data that the socket does not accept wait in
    paho until the socket is writable; data published while paho reads wait until it has read.
    """

    def __init__(
        self, address: MqttAddress, tls: ssl.SSLContext | None, who: Introduction, react: Reactions | None
    ) -> None:
        self.writable = False
        """Whether the connection accepts more data; false while a slow broker's buffers are full, and once lost."""
        self.lost = asyncio.Event()
        self.reason = "the broker has closed the connection"
        """Why the connection was lost."""
        self.unread_since_s: float | None = None
        """Since when, by the loop's clock, messages from the broker have waited to be read; None if none wait."""
        self._address = address
        self._keepalive_s = who.keepalive_s
        self._react = react or Reactions()
        self._loop = asyncio.get_running_loop()
        self._client = _make_client(address, tls, who)
        self._accepted: asyncio.Future[None] = self._loop.create_future()
        self._socket: socket.socket | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._has_answered = False
        self._messages = 0
        self._reading = self._awaits_socket = False
        self._waiting_bytes = 0
        self._flying: dict[int, paho.MQTTMessageInfo] = {}
        self._asked: dict[int, tuple[str, ...]] = {}

    async def open(self) -> Self:
        """Connect, and wait until the broker accepts; it may raise what ``open_connection`` raises."""
        try:
            async with asyncio.timeout(BROKER_ANSWER_S):
                await _connect(self._client, self._address, max(1, self._keepalive_s // 2))
                self._begin()
                await self._accepted
        except BaseException as error:
            self.abort("gave up")
            if isinstance(error, TimeoutError) and not error.args:
                late = f"no answer within {BROKER_ANSWER_S:g} s"
                raise TimeoutError("its answer is not MQTT" if self._has_answered else late) from None
            raise
        self.writable = not self.lost.is_set()
        self._keep_alive()
        return self

    def publish(self, topic: str, payload: bytes, qos: int, *, retain: bool) -> int:
        """Send a message, or queue it for the socket; never blocks. Returns its number for ``acknowledged``."""
        info = self._client.publish(topic, payload, qos, retain)
        while info.rc == MQTTErrorCode.MQTT_ERR_QUEUE_SIZE:  # the number is still in use, 65 535 messages later
            info = self._client.publish(topic, payload, qos, retain)
        if qos and not info.rc:
            self._flying[info.mid] = info
        if self._client.want_write():
            self._waiting_bytes += len(topic) + len(payload)
            self.writable = self.writable and self._waiting_bytes < _SEND_BUFFER
            self._await_socket()
        return info.mid

    def subscribe(self, filters: Mapping[str, int]) -> None:
        """Subscribe to topic filters, each with its QoS."""
        _, number = self._client.subscribe(list(filters.items()))
        if number is not None:
            self._asked[number] = tuple(filters)
        self._await_socket()

    def unsubscribe(self, filters: Iterable[str]) -> None:
        """End subscriptions."""
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
        """Disconnect, and close once everything is sent, or after a second."""
        self.writable = False
        if not self.lost.is_set():
            self._client.disconnect()
            self._await_socket()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_LEAVE_S):
                await self.lost.wait()
        self.abort("left")

    # Called by the event loop

    def _begin(self) -> None:
        """Set the socket's options and paho's callbacks, and watch the socket. Raises ConnectionError if it is gone."""
        self._socket = cast(socket.socket | None, self._client.socket())
        if self._socket is None:
            raise ConnectionError(self.reason)
        self._client.on_connect = self._on_connect
        self._client.on_disconnect = self._on_disconnect
        self._client.on_socket_close = lambda *_: self._leave_loop()
        self._client.on_message = self._on_message
        self._client.on_subscribe = self._on_subscribe
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self._loop.add_reader(self._socket, self._read)
        self._await_socket()

    def _read(self) -> None:
        """Read everything available, packet by packet."""
        self._has_answered = self._reading = True
        left = _MAX_PACKETS
        while self._socket is not None:
            seen = self._messages
            self._client.loop_read()
            left -= 1
            # The socket does not signal data that TLS has already decrypted.
            decrypted = self._socket.pending() if isinstance(self._socket, ssl.SSLSocket) else 0
            if not decrypted and (left <= 0 or self._messages == seen):
                break
        self._reading = False
        if left > 0:
            self.unread_since_s = None
        elif self.unread_since_s is None:
            self.unread_since_s = self._loop.time()
        if self._socket is not None and _QUICK_ACK is not None:
            self._socket.setsockopt(socket.IPPROTO_TCP, _QUICK_ACK, 1)
        # paho's on_publish would also be called for QoS 0, whose number may equal that of another message in flight.
        for number in [number for number, info in self._flying.items() if info.is_published()]:
            del self._flying[number]
            self._react.acknowledged(number)
        self._write()

    def _write(self) -> None:
        """Write waiting data; once none are left, accept more."""
        if self._client.want_write():
            self._client.loop_write()
        if not self._client.want_write():
            self._waiting_bytes = 0
            if not self.writable and self._accepted.done() and not self.lost.is_set():
                self.writable = True
                self._react.writable()
        self._await_socket()

    def _await_socket(self) -> None:
        """Watch for the socket to become writable while paho has data for it."""
        wanted = self._client.want_write() and self._socket is not None
        if self._reading or self._socket is None or wanted == self._awaits_socket:
            return
        self._awaits_socket = wanted
        if wanted:
            self._loop.add_writer(self._socket, self._write)
        else:
            self._loop.remove_writer(self._socket)

    def _keep_alive(self) -> None:
        """Let paho ping the broker after half the keepalive time, and give up after the other half."""
        self._client.loop_misc()
        self._await_socket()
        if self._socket is not None:
            self._timer = self._loop.call_later(self._keepalive_s / 20, self._keep_alive)

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
            self._accepted.exception()  # retrieved, in case nothing awaits it
        self.lost.set()

    # Called by paho

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
            self._lose("its answer is not MQTT")
        else:
            self._lose(self.reason)

    def _on_message(self, _client: object, _data: object, message: paho.MQTTMessage) -> None:
        self._messages += 1
        try:
            topic = message.topic
        except UnicodeDecodeError:
            self.abort("its answer is not MQTT: a topic that is not UTF-8")
            return
        self._react.message(topic, bytes(message.payload))

    def _on_subscribe(
        self, _client: object, _data: object, number: int, codes: list[ReasonCode], _more: object
    ) -> None:
        for name, code in zip(self._asked.pop(number, ()), codes, strict=False):
            self._react.subscribed(name, not code.is_failure)


async def open_connection(
    address: MqttAddress, tls: ssl.SSLContext | None, who: Introduction, react: Reactions | None = None
) -> Connection:
    """Open a connection, to the first of several brokers that accepts.

    Raises:
        RefusedError: the broker, or the last of several, refuses this client.
        OSError: it cannot be reached, or does not answer (TimeoutError).
    """
    *others, last = address.brokers
    for broker in others:
        with contextlib.suppress(OSError, RefusedError):
            return await Connection(broker, tls, who, react).open()
    return await Connection(last, tls, who, react).open()


async def check_broker(address: MqttAddress, tls: ssl.SSLContext | None = None) -> None:
    """Check that a broker accepts this client; ``tls`` replaces the address's own TLS settings.

    Raises SkylessError: it does not; the message says why.
    """
    try:
        connection = await open_connection(address, tls or address.tls_context(), Introduction("", 60))
    except (OSError, RefusedError) as error:
        raise SkylessError(trouble_with(address, error)) from None
    await connection.leave()


async def kept_messages(address: MqttAddress, filters: Iterable[str]) -> dict[str, bytes]:
    """Return the retained messages that match the filters, by topic, and any others that arrive meanwhile.

    Nothing marks the last one: reading ends after half a second without any, once a broker, which may be busy, has
    answered the subscriptions. Raises OSError and RefusedError.
    """
    found: dict[str, bytes] = {}
    unanswered = set(filters)
    react = Reactions(message=found.__setitem__, subscribed=lambda name, _granted: unanswered.discard(name))
    connection = await open_connection(address, address.tls_context(), Introduction("", 60), react)
    try:
        connection.subscribe(dict.fromkeys(unanswered, 1))
        before = -1
        for _ in range(_LONGEST_KEPT):
            if len(found) == before and not unanswered:
                break
            before = len(found)
            await asyncio.sleep(_KEPT_S)
    finally:
        connection.abort("all has come")
    return found


def trouble_with(address: MqttAddress, error: OSError | RefusedError) -> str:
    """Describe in one line, for a person, why a connection failed."""
    if isinstance(error, RefusedError):
        hint = ""
        if "user" in str(error):
            place = "the password goes in SKYLESS_MQTT_PASSWORD or after the user's name"
            hint = f"; {place}" if address.user is not None else "; the address has no user: it should be USER@HOST"
        return f"the broker {address} refuses: {error}{hint}"
    if isinstance(error, ssl.SSLCertVerificationError):
        return (
            f"the certificate of the broker {address} is not trusted: {error.verify_message}; --mqtt-ca names another"
        )
    if isinstance(error, ssl.SSLError):
        return f"the broker {address} does not use TLS as expected: {error.reason or error}"
    return f"the broker {address} cannot be reached: {error.strerror or error}"


def _make_client(address: MqttAddress, tls: ssl.SSLContext | None, who: Introduction) -> paho.Client:
    """Make a paho client that neither limits the messages in flight nor reconnects: a link does both."""
    client = paho.Client(
        CallbackAPIVersion.VERSION2,
        who.client or f"skyless-{secrets.token_hex(4)}",
        clean_session=not who.persistent,
        reconnect_on_failure=False,
    )
    client.connect_timeout = BROKER_ANSWER_S
    client.max_inflight_messages_set(0)
    client.username_pw_set(address.user, address.password)
    if who.will is not None:
        client.will_set(*who.will, qos=1, retain=True)
    if tls is not None:
        client.tls_set_context(tls)
        client.tls_insecure_set(not tls.check_hostname)  # otherwise paho compares the names itself
    return client


async def _connect(client: paho.Client, address: MqttAddress, keepalive_s: int) -> None:
    """Let paho connect, which blocks, in a daemon thread: not even the program's end waits for it.

    Raises OSError: the broker cannot be reached.
    """
    loop = asyncio.get_running_loop()
    done: asyncio.Future[None] = loop.create_future()

    def finish(error: BaseException | None) -> None:
        if done.cancelled():
            _close(client)
        elif error is None:
            done.set_result(None)
        else:
            done.set_exception(error)

    def work() -> None:
        error: BaseException | None = None
        try:
            client.connect(address.host, address.port, keepalive_s)
        except Exception as caught:  # noqa: BLE001 - raised where the future is awaited
            error = caught
        try:
            loop.call_soon_threadsafe(finish, error)
        except RuntimeError:  # the event loop has ended meanwhile
            _close(client)

    Thread(target=work, name="MQTT connect", daemon=True).start()
    try:
        await done
    except asyncio.CancelledError:
        if not done.cancelled():  # it connected at the same moment
            _close(client)
        raise


def _close(client: paho.Client) -> None:
    sock = client.socket()
    if sock is not None:
        sock.close()


# Messages waiting for a broker. Their number is limited, so that a slow or absent broker costs limited memory.

_TOPIC: Final = re.compile(r"[^\s+#\x00-\x1f\x7f]{1,250}")
"""Topics that every broker accepts; nats-server refuses blanks."""


class Limits(Struct, frozen=True):
    """Limits on waiting messages. Payloads in bytes."""

    topics: int = 1000
    """Topics of QoS 0, each with its newest message; the same number again of retained topics."""
    topic_bytes: int = 16_000_000
    messages: int = 20_000
    """Messages of QoS 1."""
    bytes: int = 64_000_000
    window: int = 64
    """Messages of QoS 1 that may be in flight: sent, but not yet acknowledged."""
    payload: int = 8_000_000
    """The largest payload; the embedded broker takes no larger one."""


class Waiting(Struct, frozen=True, gc=False):
    """One message to be sent."""

    topic: str
    payload: bytes
    qos: int
    retain: bool
    until_s: float = math.inf
    """A message of QoS 0 is not sent after this time, by the clock of ``next_message``."""


class Outbox:
    """Messages not yet sent, and those of QoS 1 not yet acknowledged.

    QoS 0: only the newest message of a topic is kept; if there are too many topics, the oldest is dropped. QoS 1: all
    messages are kept in order; if there are too many, the oldest that is not in flight is dropped. Retained: the newest
    message of each topic is kept, and sent again after each reconnect.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._newest: OrderedDict[str, Waiting] = OrderedDict()
        self._newest_bytes = 0
        self._queue: deque[Waiting] = deque()
        self._queue_bytes = 0
        self._again: deque[Waiting] = deque()
        self._flying: dict[int, Waiting] = {}
        self._retained: dict[str, Waiting] = {}
        self._retained_bytes = 0
        self._to_retain: dict[str, Waiting] = {}
        self.dropped = 0
        self.late = 0
        """Messages dropped because they had waited too long."""
        self.sent = 0
        """Messages of QoS 0 given to the connection, and messages of QoS 1 acknowledged."""

    def add(self, topic: str, payload: bytes, qos: int, *, retain: bool, until_s: float = math.inf) -> str | None:
        """Add a message. Returns its fault if brokers would not accept it.

        A message of QoS 0 that has not been taken by ``until_s``, on the clock of ``next_message``, is dropped.
        """
        fault = self._fault(topic, payload)
        if fault is not None:
            self.dropped += 1
            return fault
        message = Waiting(topic, payload, qos, retain, until_s)
        if retain:
            self._retain(message)
        elif qos:
            self._queue.append(message)
            self._queue_bytes += len(payload)
            self._shorten_queue()
        else:
            self._replace(message)
        return None

    def next_message(self, now_s: float) -> Waiting | None:
        """Return the next message to send; None if nothing is left, or the window is full."""
        open_window = len(self._flying) < self._limits.window
        if self._again:
            return self._again.popleft()
        if self._to_retain and (open_window or not next(iter(self._to_retain.values())).qos):
            return self._to_retain.pop(next(iter(self._to_retain)))
        if self._queue and open_window:
            return self._queue.popleft()
        while self._newest:
            message = self._newest.popitem(last=False)[1]
            self._newest_bytes -= len(message.payload)
            if now_s <= message.until_s:
                return message
            self.dropped += 1
            self.late += 1
        return None

    def mark_sent(self, message: Waiting, number: int) -> None:
        """Note that a message was given to the connection, under this number."""
        if message.qos:
            self._flying[number] = message
        else:
            self.sent += 1

    def acknowledge(self, number: int) -> None:
        """Note that the broker has acknowledged the message of QoS 1 with this number."""
        message = self._flying.pop(number, None)
        if message is None:
            return
        self.sent += 1
        if not message.retain:
            self._queue_bytes -= len(message.payload)

    def restart(self) -> None:
        """Prepare for a new connection: resend unacknowledged messages and all retained ones."""
        self._again.extendleft(message for message in reversed(self._flying.values()) if not message.retain)
        self._flying.clear()
        self._to_retain = dict(self._retained)

    def forget(self, topic: str) -> None:
        """Stop sending a topic's retained message, because another node has published a newer one."""
        self._to_retain.pop(topic, None)
        old = self._retained.pop(topic, None)
        self._retained_bytes -= len(old.payload) if old else 0

    @property
    def unacknowledged(self) -> int:
        """Number of messages of QoS 1, and retained ones, that the broker may not have."""
        return len(self._flying) + len(self._again) + len(self._queue) + len(self._to_retain)

    def _fault(self, topic: str, payload: bytes) -> str | None:
        if not _TOPIC.fullmatch(topic):
            return f"the topic {topic!r} is not one that every broker accepts"
        if len(payload) > self._limits.payload:
            return f"the message for {topic} has {len(payload)} bytes; {self._limits.payload} are the most"
        return None

    def _replace(self, message: Waiting) -> None:
        old = self._newest.get(message.topic)
        if old is not None:
            self._newest_bytes -= len(old.payload)
            self.dropped += 1
        self._newest[message.topic] = message
        self._newest_bytes += len(message.payload)
        while len(self._newest) > self._limits.topics or self._newest_bytes > self._limits.topic_bytes:
            self._newest_bytes -= len(self._newest.popitem(last=False)[1].payload)
            self.dropped += 1

    def _shorten_queue(self) -> None:
        sent = len(self._flying) + len(self._again)
        while self._queue and (
            len(self._queue) + sent > self._limits.messages or self._queue_bytes > self._limits.bytes
        ):
            self._queue_bytes -= len(self._queue.popleft().payload)
            self.dropped += 1

    def _retain(self, message: Waiting) -> None:
        """Replace the retained message of a topic; drop it if there is no room."""
        self.forget(message.topic)
        more = len(self._retained) >= self._limits.topics
        if more or self._retained_bytes + len(message.payload) > self._limits.topic_bytes:
            self.dropped += 1
            return
        self._retained[message.topic] = message
        self._retained_bytes += len(message.payload)
        self._to_retain[message.topic] = message
