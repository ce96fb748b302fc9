"""One connection to a broker, from CONNECT until it breaks."""

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Callable
from typing import Final, cast

from skyless.errors import SkylessError
from skyless.outputs import packets
from skyless.outputs.address import MqttAddress
from skyless.outputs.packets import Message, PacketError, Splitter

ANSWER_S: Final = 5.0
"""How long a broker may take to accept a connection."""

_GOODBYE_S: Final = 1.0

_SEND_BUFFER: Final = 262_144
"""Bytes that wait in the kernel, and as many in the process: what is older than the newest fix should not be many."""

_QUICK_ACK: Final = getattr(socket, "TCP_QUICKACK", None)
"""Linux forgets it and must be told again. mosquitto holds a message back until the one before is acknowledged, which
TCP otherwise delays by 40 ms."""


class RefusedError(Exception):
    """The broker does not want this client; the text says why."""


class Connection(asyncio.Protocol):
    """Reads packets, answers messages of QoS 1, and finds out when the broker has gone silent.

    Its callbacks are called from the event loop: with a message, with the number of a message that the broker has, when
    the connection takes more again, and with the number of a subscription and a code for each of its filters.
    """

    def __init__(
        self,
        keepalive_s: int,
        on_message: Callable[[Message], None],
        on_acknowledged: Callable[[int], None],
        on_writable: Callable[[], None],
        on_subscribed: Callable[[int, bytes], None],
    ) -> None:
        self.writable = False
        """Whether the connection takes more; false while a slow broker has its buffers full, and once it is lost."""
        self.lost = asyncio.Event()
        self.reason = "the broker has closed the connection"
        """Why it was lost."""
        self._keepalive_s = keepalive_s
        self._on_message = on_message
        self._on_acknowledged = on_acknowledged
        self._on_writable = on_writable
        self._on_subscribed = on_subscribed
        self._splitter = Splitter()
        self._accepted: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._transport: asyncio.Transport | None = None
        self._socket: socket.socket
        self._timer: asyncio.TimerHandle | None = None
        self._heard = False
        self._asked = False

    # What asyncio calls

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep buffers small, so that nothing old piles up in them."""
        self._transport = cast(asyncio.Transport, transport)
        self._transport.set_write_buffer_limits(high=_SEND_BUFFER)
        self._socket = transport.get_extra_info("socket")
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)

    def data_received(self, data: bytes) -> None:
        """Handle every packet that is complete."""
        self._heard = True
        if _QUICK_ACK is not None:
            self._socket.setsockopt(socket.IPPROTO_TCP, _QUICK_ACK, 1)
        try:
            for head, body in self._splitter.feed(data):
                self._handle(head, body)
        except PacketError as error:
            self.abort(f"the broker does not speak MQTT: {error}")

    def connection_lost(self, exc: Exception | None) -> None:
        """Tell whoever waits."""
        self.writable = False
        self._transport = None
        if exc is not None and not self.lost.is_set():
            self.reason = str(exc)
        if self._timer is not None:
            self._timer.cancel()
        if not self._accepted.done():
            self._accepted.set_exception(ConnectionError(self.reason))
            self._accepted.exception()  # retrieved, should nobody wait for it any more
        self.lost.set()

    def pause_writing(self) -> None:
        """The buffer is full."""
        self.writable = False

    def resume_writing(self) -> None:
        """The buffer is empty again."""
        if self._accepted.done() and self._transport is not None:
            self.writable = True
            self._on_writable()

    # What a link calls

    async def introduce(self, greeting: bytes) -> None:
        """Send the CONNECT and wait until the broker accepts.

        Raises:
            RefusedError: it does not.
            OSError: the connection broke.
        """
        self.write(greeting)
        await self._accepted
        self.writable = self._transport is not None
        self._timer = asyncio.get_running_loop().call_later(self._keepalive_s / 2, self._look)

    def write(self, packet: bytes) -> None:
        """Send a packet; never blocks."""
        if self._transport is not None:
            self._transport.write(packet)

    def abort(self, reason: str) -> None:
        """Drop the connection at once."""
        self.reason = reason
        self.writable = False
        if self._transport is not None:
            self._transport.abort()

    async def leave(self) -> None:
        """Say goodbye, and close when all is sent, or without it after a second."""
        if self._transport is not None:
            self._transport.write(packets.GOODBYE)
            self._transport.close()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_GOODBYE_S):
                await self.lost.wait()
        self.abort("left")

    def _handle(self, head: int, body: bytes) -> None:
        kind = head >> 4
        if not self._accepted.done():
            self._answer(kind, body)
        elif kind == packets.PUBLISH:
            message = packets.read_message(head, body)
            self._on_message(message)
            if message.packet:
                self.write(packets.puback(message.packet))
        elif kind == packets.PUBACK:
            self._on_acknowledged(int.from_bytes(body[:2], "big"))
        elif kind == packets.SUBACK:
            self._on_subscribed(int.from_bytes(body[:2], "big"), body[2:])

    def _answer(self, kind: int, body: bytes) -> None:
        if kind != packets.CONNACK:
            raise PacketError("no CONNACK at the beginning")
        reason = packets.refusal(body)
        if reason is None:
            self._accepted.set_result(None)
        else:
            self._accepted.set_exception(RefusedError(reason))

    def _look(self) -> None:
        """Twice in a keepalive time: ask for a sign of life, and give up when the last question stayed unanswered."""
        if self._asked and not self._heard:
            self.abort(f"the broker has been silent for {self._keepalive_s} s")
            return
        self._asked, self._heard = True, False
        self.write(packets.PING)
        self._timer = asyncio.get_running_loop().call_later(self._keepalive_s / 2, self._look)


async def open_connection(
    address: MqttAddress, tls: ssl.SSLContext | None, greeting: bytes, make: Callable[[], Connection]
) -> Connection:
    """A connection that the broker has accepted.

    Raises:
        RefusedError: it does not want this client.
        OSError: it cannot be reached, or does not answer (TimeoutError).
    """
    loop = asyncio.get_running_loop()
    connection = None
    try:
        async with asyncio.timeout(ANSWER_S):
            _, connection = await loop.create_connection(make, address.host, address.port, ssl=tls)
            await connection.introduce(greeting)
    except BaseException as error:
        if connection is not None:
            connection.abort("gave up")
        if isinstance(error, TimeoutError) and not error.args:
            raise TimeoutError(f"no answer within {ANSWER_S:g} s") from None
        raise
    return connection


async def check_broker(address: MqttAddress, tls: ssl.SSLContext | None = None) -> None:
    """See whether a broker lets us in; ``tls`` takes the place of the address's own checks of its certificate.

    Raises:
        SkylessError: it does not, and why.
    """
    greeting = packets.connect("", clean=True, keepalive_s=60, user=address.user, password=address.password, will=None)

    def make() -> Connection:
        return Connection(60, lambda _: None, lambda _: None, lambda: None, lambda _, __: None)

    try:
        connection = await open_connection(address, tls or address.tls_context(), greeting, make)
    except (OSError, RefusedError) as error:
        raise SkylessError(trouble_with(address, error)) from None
    await connection.leave()


def trouble_with(address: MqttAddress, error: OSError | RefusedError) -> str:
    """One line for people about a connection that does not come about."""
    if isinstance(error, RefusedError):
        hint = "; the password stands in SKYLESS_MQTT_PASSWORD or after the user's name" if "user" in str(error) else ""
        return f"the broker {address} refuses: {error}{hint}"
    if isinstance(error, ssl.SSLCertVerificationError):
        return (
            f"the certificate of the broker {address} is not trusted: {error.verify_message}; --mqtt-ca names another"
        )
    if isinstance(error, ssl.SSLError):
        return f"the broker {address} does not speak TLS as expected: {error.reason or error}"
    return f"the broker {address} cannot be reached: {error.strerror or error}"
