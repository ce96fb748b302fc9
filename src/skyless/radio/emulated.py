"""Emulated radios: the nodes of one process on the air of ``skyless ether``, over one TCP connection."""

import asyncio
import math
import os
import socket
import struct
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final, Literal

import msgspec
from msgspec import Struct

from skyless.core.air.frame import Diagnostics, Reception, Transmission
from skyless.core.ticks import TICK_RATE_HZ, wrap
from skyless.radio.interface import Gone, Late, Listener, RadioEvent, Restarted, Sent, ignore

# Messages between processes and the emulated air over TCP: msgpack, each message after its length (u32, LE).

DEFAULT_PORT: Final = 7784
MAX_MESSAGE_BYTES: Final = 1 << 20
_LENGTH: Final = struct.Struct("<I")


class WireError(ValueError):
    """The other side does not use this protocol; the connection must be closed."""


class Join(Struct, frozen=True, tag="join"):
    """A process puts its nodes on the air; later messages number them in this order, from 0."""

    kind: Literal["anchor", "tag"]
    names: tuple[str, ...]
    tx_delays_ticks: tuple[int, ...] = ()
    """TX antenna delays set by the process, one per node; empty: those of the ether's site."""


class Send(Struct, frozen=True, tag="send", gc=False):
    """A node wants to transmit."""

    node: int
    tx_ticks: int
    frame: bytes


class Joined(Struct, frozen=True, tag="joined"):
    """All nodes have joined the air with fresh counters."""

    machine: str
    """The machine whose clock ``host_s`` is."""
    host_s: float
    ticks: tuple[int, ...]
    """The nodes' 40-bit counters at ``host_s``."""


class Refused(Struct, frozen=True, tag="refused"):
    """The nodes were not admitted to the air."""

    reason: str


class Clocks(Struct, frozen=True, tag="clocks"):
    """The nodes' counters at a later time."""

    host_s: float
    ticks: tuple[int, ...]


class HeardRow(Struct, frozen=True, array_like=True, gc=False):
    """A frame at one node that received it."""

    node: int
    rx_ticks: int
    rx_power_dbm: float
    first_path_power_dbm: float
    carrier_offset_ppm: float
    carrier_phase_cycles: float | None = None


class Arrival(Struct, frozen=True, tag="arrival"):
    """A frame that has just ended at some of the process's nodes."""

    frame: bytes
    host_s: float
    rows: tuple[HeardRow, ...]


class Done(Struct, frozen=True, tag="done", gc=False):
    """The end of a transmission."""

    node: int
    tx_ticks: int
    late: bool


ToEther = Join | Send
FromEther = Joined | Refused | Clocks | Arrival | Done

to_ether: Final = msgspec.msgpack.Decoder(ToEther)
from_ether: Final = msgspec.msgpack.Decoder(FromEther)
_encoder: Final = msgspec.msgpack.Encoder()


def pack(message: Struct) -> bytes:
    """Encode a message with its length."""
    body = _encoder.encode(message)
    return _LENGTH.pack(len(body)) + body


class Unpacker:
    """Cuts a stream of bytes into message bodies."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Bodies completed by this piece of the stream.

        Raises WireError: a message is longer than any of this protocol.
        """
        buffer = self._buffer
        buffer += data
        begin = 0
        while len(buffer) - begin >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(buffer, begin)
            if length > MAX_MESSAGE_BYTES:
                raise WireError(f"a message of {length} bytes; at most {MAX_MESSAGE_BYTES} are allowed")
            end = begin + _LENGTH.size + length
            if end > len(buffer):
                break
            yield bytes(buffer[begin + _LENGTH.size : end])
            begin = end
        del buffer[:begin]


def this_machine() -> str:
    """Identifier of this machine's present boot; processes with equal ones share the monotonic clock."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""


_SHIFT_S: Final = 15.0
"""The offset to another machine's clock is measured again after this: computers' clocks drift by 0.1 ms a second."""
_RECEIVE_BUFFER_BYTES: Final = 1 << 16
"""A radio keeps few frames for a slow host; this buffer holds 0.2 s of them."""

_LEAD_S: Final = 1.8e-3
"""Preamble, transfer to the ether, and the host's timers."""


class EmulatedRadio:
    """One node's radio (``skyless.radio.interface.Radio``)."""

    def __init__(self, connection: "EtherConnection", node: int, name: str) -> None:
        self.name = name
        self.counters: Counter[str] = Counter()
        self.lead_s = _LEAD_S
        self._connection = connection
        self._node = node
        self._listener: Listener = ignore
        self._ticks: int | None = None
        self._ticks_s = 0.0

    async def run(self, listener: Listener) -> None:
        """Receive until cancelled; a lost ether is searched for."""
        self._listener = listener
        await self._connection.run()

    def advice(self) -> str:
        """Where to look if nothing is received."""
        return "no frame on the emulated air: are anchors running?"

    def now_ticks(self) -> int | None:
        """The node's counter, extrapolated from the ether's newest reading."""
        if self._ticks is None:
            return None
        return wrap(self._ticks + round((time.monotonic() - self._ticks_s) * TICK_RATE_HZ))

    def transmit(self, transmission: Transmission) -> None:
        """Send a frame; without an ether it is late."""
        if not self._connection.send(Send(self._node, transmission.tx_ticks, transmission.frame)):
            self.notify(Late(transmission.tx_ticks))

    def notify(self, event: RadioEvent) -> None:
        """Call the node's listener."""
        self._listener(event)

    def set_clock(self, ticks: int | None, host_s: float) -> None:
        """Set the counter's reading at a time of the host's monotonic clock."""
        self._ticks, self._ticks_s = ticks, host_s


class EtherConnection:
    """One process's connection, which reconnects by itself."""

    def __init__(self, host: str, port: int, join: Join) -> None:
        self._host, self._port, self._join = host, port, join
        self.radios = tuple(EmulatedRadio(self, node, name) for node, name in enumerate(join.names))
        self._transport: asyncio.Transport | None = None
        self._task: asyncio.Task[None] | None = None
        self._users = 0

    async def run(self) -> None:
        """Stay connected until cancelled; all radios share one connection, which ends with the last of them."""
        self._users += 1
        if self._task is None:
            self._task = asyncio.create_task(self._keep_connected())
        task = self._task
        try:
            await asyncio.shield(task)
        finally:
            self._users -= 1
            if not self._users:
                self._task = None
                task.cancel()

    def send(self, message: Send) -> bool:
        """Pass a message to the connection. Returns False without one."""
        if self._transport is None:
            return False
        self._transport.write(pack(message))
        return True

    async def _keep_connected(self) -> None:
        loop = asyncio.get_running_loop()
        reported = ""
        while True:
            try:
                endpoint = _connect(self._host, self._port)
                transport, protocol = await loop.create_connection(lambda: _Stream(self), sock=await endpoint)
            except OSError as error:
                # asyncio's message repeats the address and omits the cause
                known = error.errno is not None and error.errno > 0
                why = os.strerror(error.errno) if known else error.strerror or str(error)  # type: ignore[arg-type]
                reason = f"no ether at {self._host}:{self._port} ({why})"
            else:
                transport.write(pack(self._join))
                try:
                    reason = await protocol.ended
                finally:
                    transport.abort()
                    self._transport = None
                    for radio in self.radios:
                        radio.set_clock(None, 0.0)
            if reason != reported:
                reported = reason
                self._notify_all(Gone(reason))
            await asyncio.sleep(0.2)

    def on_joined(self, message: Joined, shift_s: float, transport: asyncio.Transport) -> None:
        """The nodes have joined the air."""
        self._transport = transport
        self._set_clocks(message.host_s + shift_s, message.ticks)
        self._notify_all(Restarted())

    def _notify_all(self, event: RadioEvent) -> None:
        for radio in self.radios:
            radio.notify(event)

    def _set_clocks(self, host_s: float, ticks: tuple[int, ...]) -> None:
        for radio, reading in zip(self.radios, ticks, strict=True):
            radio.set_clock(reading, host_s)

    def on_message(self, message: Clocks | Arrival | Done, shift_s: float) -> None:
        """Pass a message on to the radios; ``shift_s`` converts the ether's clock into this machine's."""
        if isinstance(message, Arrival):
            host_s = message.host_s + shift_s
            for row in message.rows:
                measured = Diagnostics(row.rx_power_dbm, row.first_path_power_dbm, row.carrier_offset_ppm)
                self.radios[row.node].notify(
                    Reception(message.frame, row.rx_ticks, host_s, measured, row.carrier_phase_cycles)
                )
        elif isinstance(message, Done):
            self.radios[message.node].notify(Late(message.tx_ticks) if message.late else Sent(message.tx_ticks))
        else:
            self._set_clocks(message.host_s + shift_s, message.ticks)


class ClockShift:
    """Offset to another machine's clock, from messages with their sending time.

    The fastest message of the last half minute or so decides: the clocks drift apart, and some messages are slow.
    """

    def __init__(self, shift_s: float) -> None:
        self.shift_s = shift_s
        self._least_s = self._least_before_s = shift_s
        self._begun_s: float | None = None

    def note(self, sent_s: float, now_s: float) -> None:
        """Process a message sent at ``sent_s`` of the other clock."""
        if self._begun_s is None or now_s - self._begun_s > _SHIFT_S:
            self._begun_s, self._least_before_s, self._least_s = now_s, self._least_s, math.inf
        self._least_s = min(self._least_s, now_s - sent_s)
        self.shift_s = min(self._least_s, self._least_before_s)


class _Stream(asyncio.Protocol):
    """The connection from start to end; ``ended`` gives the reason."""

    def __init__(self, connection: EtherConnection) -> None:
        self._connection = connection
        self._unpacker = Unpacker()
        self._transport: asyncio.Transport | None = None
        self._shift: ClockShift | None = None
        """Only for an ether on another machine."""
        self.ended: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        try:
            for body in self._unpacker.feed(data):
                self._process(body)
        except (WireError, msgspec.MsgspecError) as error:
            self._end(f"what answers is no ether ({error})")

    def _process(self, body: bytes) -> None:
        message = from_ether.decode(body)
        if isinstance(message, Refused):
            self._end(message.reason)
        elif isinstance(message, Joined):
            assert self._transport is not None
            if message.machine != this_machine():
                self._shift = ClockShift(time.monotonic() - message.host_s)
            self._connection.on_joined(message, self._shift_s, self._transport)
        else:
            if self._shift is not None and isinstance(message, Clocks):
                self._shift.note(message.host_s, time.monotonic())
            self._connection.on_message(message, self._shift_s)

    @property
    def _shift_s(self) -> float:
        return 0.0 if self._shift is None else self._shift.shift_s

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - the reason makes no difference
        self._end("the ether has gone")

    def _end(self, reason: str) -> None:
        if not self.ended.done():
            self.ended.set_result(reason)
        if self._transport is not None:
            self._transport.abort()


async def _connect(host: str, port: int) -> socket.socket:
    """A connected socket with a small receive buffer, which can only be set before it connects."""
    loop = asyncio.get_running_loop()
    family, kind, protocol, _, address = (await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM))[0]
    endpoint = socket.socket(family, kind, protocol)
    endpoint.setblocking(False)
    endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
    try:
        await loop.sock_connect(endpoint, address)
    except BaseException:
        endpoint.close()
        raise
    endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return endpoint
