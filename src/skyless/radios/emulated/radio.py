"""Emulated radios: the nodes of one process on the air of ``skyless ether``, over one TCP connection."""

import asyncio
import os
import socket
import time
from collections import Counter
from typing import Final

import msgspec

from skyless.air.reception import Diagnostics, Reception, Transmission
from skyless.constants import TICK_RATE_HZ
from skyless.radios.emulated.ether_wire import (
    Arrival,
    Clocks,
    Done,
    Join,
    Joined,
    Refused,
    Send,
    Unpacker,
    WireError,
    from_ether,
    pack,
    this_machine,
)
from skyless.radios.interface import Gone, Late, Listener, RadioEvent, Restarted, Sent
from skyless.ticks import wrap

RETRY_S: Final = 0.2
RECEIVE_BUFFER_BYTES: Final = 1 << 16
"""A radio keeps few frames for a host that does not fetch them; so does this one, 0.2 s of them."""


class EmulatedRadio:
    """One node's radio (``skyless.radios.interface.Radio``)."""

    def __init__(self, connection: "EtherConnection", node: int, name: str) -> None:
        self.name = name
        self.counters: Counter[str] = Counter()
        self._connection = connection
        self._node = node
        self._listener: Listener = _nobody
        self._ticks: int | None = None
        self._ticks_s = 0.0

    async def run(self, listener: Listener) -> None:
        """Receive until cancelled; an ether that goes away is looked for."""
        self._listener = listener
        await self._connection.keep()

    def advice(self) -> str:
        """Where to look when nothing comes."""
        return "no frame on the emulated air: are anchors running?"

    def now_ticks(self) -> int | None:
        """The node's counter, extrapolated from when the ether last told it."""
        if self._ticks is None:
            return None
        return wrap(self._ticks + round((time.monotonic() - self._ticks_s) * TICK_RATE_HZ))

    def transmit(self, transmission: Transmission) -> None:
        """Send a frame; without an ether it is late."""
        if not self._connection.send(Send(self._node, transmission.tx_ticks, transmission.frame)):
            self.tell(Late(transmission.tx_ticks))

    def tell(self, event: RadioEvent) -> None:
        """Give the node's program an event."""
        self._listener(event)

    def set_clock(self, ticks: int | None, host_s: float) -> None:
        """What the counter was at a moment of the host's monotonic clock."""
        self._ticks, self._ticks_s = ticks, host_s


def _nobody(event: RadioEvent) -> None:
    pass


class EtherConnection:
    """The connection of one process; it comes back by itself."""

    def __init__(self, host: str, port: int, join: Join) -> None:
        self._host, self._port, self._join = host, port, join
        self.radios = tuple(EmulatedRadio(self, node, name) for node, name in enumerate(join.names))
        self._transport: asyncio.Transport | None = None
        self._task: asyncio.Task[None] | None = None
        self._users = 0

    async def keep(self) -> None:
        """Stay connected until cancelled; all radios share one connection, which ends with the last of them."""
        self._users += 1
        if self._task is None:
            self._task = asyncio.create_task(self._run())
        task = self._task
        try:
            await asyncio.shield(task)
        finally:
            self._users -= 1
            if not self._users:
                self._task = None
                task.cancel()

    def send(self, message: Send) -> bool:
        """Whether the message could be handed to the connection."""
        if self._transport is None:
            return False
        self._transport.write(pack(message))
        return True

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        told = ""
        while True:
            try:
                endpoint = _connect(self._host, self._port)
                transport, protocol = await loop.create_connection(lambda: _Client(self), sock=await endpoint)
            except OSError as error:
                reason = f"no ether at {self._host}:{self._port} ({_why(error)})"
            else:
                transport.write(pack(self._join))
                try:
                    reason = await protocol.ended
                finally:
                    transport.abort()
                    self._lose()
            if reason != told:
                told = reason
                self._tell_all(Gone(reason))
            await asyncio.sleep(RETRY_S)

    def joined(self, message: Joined, transport: asyncio.Transport) -> None:
        """The nodes are on the air."""
        self._transport = transport
        self._set_clocks(message.host_s, message.ticks)
        self._tell_all(Restarted())

    def _lose(self) -> None:
        self._transport = None
        for radio in self.radios:
            radio.set_clock(None, 0.0)

    def _tell_all(self, event: RadioEvent) -> None:
        for radio in self.radios:
            radio.tell(event)

    def _set_clocks(self, host_s: float, ticks: tuple[int, ...]) -> None:
        for radio, reading in zip(self.radios, ticks, strict=True):
            radio.set_clock(reading, host_s)

    def hear(self, message: Clocks | Arrival | Done, shift_s: float) -> None:
        """Give what the ether tells to the radios; ``shift_s`` turns its clock into this machine's."""
        if isinstance(message, Arrival):
            host_s = message.host_s + shift_s
            for row in message.rows:
                measured = Diagnostics(row.rx_power_dbm, row.first_path_power_dbm, row.carrier_offset_ppm)
                self.radios[row.node].tell(Reception(message.frame, row.rx_ticks, host_s, measured))
        elif isinstance(message, Done):
            event = Late(message.tx_ticks) if message.late else Sent(message.tx_ticks)
            self.radios[message.node].tell(event)
        else:
            self._set_clocks(message.host_s + shift_s, message.ticks)


class _Client(asyncio.Protocol):
    """One life of the connection; ``ended`` says why it is over."""

    def __init__(self, connection: EtherConnection) -> None:
        self._connection = connection
        self._unpacker = Unpacker()
        self._transport: asyncio.Transport | None = None
        self._shift_s = 0.0
        self.ended: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        try:
            for body in self._unpacker.feed(data):
                self._hear(body)
        except (WireError, msgspec.MsgspecError) as error:
            self._end(f"what answers is no ether ({error})")

    def _hear(self, body: bytes) -> None:
        message = from_ether.decode(body)
        if isinstance(message, Refused):
            self._end(message.reason)
        elif isinstance(message, Joined):
            assert self._transport is not None
            if message.machine != this_machine():
                self._shift_s = time.monotonic() - message.host_s
            self._connection.joined(
                msgspec.structs.replace(message, host_s=message.host_s + self._shift_s), self._transport
            )
        else:
            self._connection.hear(message, self._shift_s)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - the reason is all one here
        self._end("the ether has gone")

    def _end(self, reason: str) -> None:
        if not self.ended.done():
            self.ended.set_result(reason)
        if self._transport is not None:
            self._transport.abort()


def _why(error: OSError) -> str:
    """In words; what asyncio says of a failed connection repeats the address and leaves the cause out."""
    known = error.errno is not None and error.errno > 0
    return os.strerror(error.errno) if known else error.strerror or str(error)  # type: ignore[arg-type]


async def _connect(host: str, port: int) -> socket.socket:
    """A connected socket with a small receive buffer, which can only be set before it connects."""
    loop = asyncio.get_running_loop()
    family, kind, protocol, _, address = (await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM))[0]
    endpoint = socket.socket(family, kind, protocol)
    endpoint.setblocking(False)
    endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    try:
        await loop.sock_connect(endpoint, address)
    except BaseException:
        endpoint.close()
        raise
    endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return endpoint
