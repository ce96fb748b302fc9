"""Who is on the air of an ether: processes, each with its nodes, over TCP."""

import asyncio
import socket
from typing import Final, Protocol

import msgspec

from skyless.radios.emulated.ether_wire import Join, Refused, Send, Unpacker, WireError, pack, to_ether

SEND_BUFFER_BYTES: Final = 1 << 16
OVERRUN_BYTES: Final = 1 << 16
"""Frames for a process that does not read are lost beyond so many bytes, as from a radio whose host is asleep."""


class Host(Protocol):
    """What receives the guests."""

    def join(self, guest: "Client", message: Join) -> "Session | str":
        """Put a process's nodes on the air; or why not."""

    def leave(self, seat: "Session") -> None:
        """Take a process's nodes off the air."""

    def send(self, seat: "Session", message: Send) -> None:
        """Plan a transmission."""


class Session:
    """The nodes of one process."""

    def __init__(self, guest: "Client", nodes: tuple[int, ...]) -> None:
        self._guest = guest
        self.nodes = nodes
        self.index = {node: index for index, node in enumerate(nodes)}

    def tell(self, message: msgspec.Struct) -> bool:
        """Send a message, unless the process has not read for long."""
        return self._guest.tell(message)


class Client(asyncio.Protocol):
    """A process's connection."""

    def __init__(self, ether: Host) -> None:
        self._ether = ether
        self._seat: Session | None = None
        self._unpacker = Unpacker()
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """A process has come."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        endpoint = transport.get_extra_info("socket")
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def tell(self, message: msgspec.Struct) -> bool:
        """Send a message, unless too much waits already."""
        transport = self._transport
        if transport is None or transport.is_closing() or transport.get_write_buffer_size() > OVERRUN_BYTES:
            return False
        transport.write(pack(message))
        return True

    def data_received(self, data: bytes) -> None:
        """It says something; one that is not understood is sent away."""
        try:
            for body in self._unpacker.feed(data):
                self._hear(body)
        except (WireError, msgspec.MsgspecError) as error:
            self._refuse(f"not understood: {error}")

    def _hear(self, body: bytes) -> None:
        message = to_ether.decode(body)
        if isinstance(message, Join) and self._seat is None:
            answer = self._ether.join(self, message)
            if isinstance(answer, str):
                self._refuse(answer)
            else:
                self._seat = answer
        elif isinstance(message, Send) and self._seat is not None and 0 <= message.node < len(self._seat.nodes):
            self._ether.send(self._seat, message)
        else:
            raise WireError("a message that does not belong here")

    def _refuse(self, reason: str) -> None:
        self.tell(Refused(reason))
        if self._transport is not None:
            self._transport.close()

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - the reason is all one here
        """It has gone, and its nodes with it."""
        if self._seat is not None:
            self._ether.leave(self._seat)
