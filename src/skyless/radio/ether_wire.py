"""Messages between processes and the emulated air over TCP: msgpack, each message after its length (u32, LE)."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final, Literal

import msgspec
from msgspec import Struct

DEFAULT_PORT: Final = 7784
MAX_MESSAGE_BYTES: Final = 1 << 20
_LENGTH: Final = struct.Struct("<I")


class WireError(ValueError):
    """The other side does not use this protocol; the connection is to be closed."""


class Join(Struct, frozen=True, tag="join"):
    """A process puts its nodes on the air; later messages number them in this order, from 0."""

    kind: Literal["anchor", "tag"]
    names: tuple[str, ...]
    tx_delays_ticks: tuple[int, ...] = ()
    """TX antenna delays that the process sets in its radios, one a node; empty: those of the ether's site."""


class Send(Struct, frozen=True, tag="send", gc=False):
    """A node wants to transmit."""

    node: int
    tx_ticks: int
    frame: bytes


class Joined(Struct, frozen=True, tag="joined"):
    """The nodes are on the air, with new counters."""

    machine: str
    """Which machine's clock ``host_s`` is of."""
    host_s: float
    ticks: tuple[int, ...]
    """The nodes' 40-bit counters at ``host_s``."""


class Refused(Struct, frozen=True, tag="refused"):
    """The nodes are not on the air."""

    reason: str


class Clocks(Struct, frozen=True, tag="clocks"):
    """The nodes' counters at a later time."""

    host_s: float
    ticks: tuple[int, ...]


class HeardRow(Struct, frozen=True, array_like=True, gc=False):
    """A frame at one node that heard it."""

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
    """Bytes of a message, its length before it."""
    body = _encoder.encode(message)
    return _LENGTH.pack(len(body)) + body


class Unpacker:
    """Cuts a stream of bytes into message bodies."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Bodies that are complete with this piece of the stream.

        Raises:
            WireError: a message is longer than any of this protocol.
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
    """Identifier of this machine's present run; processes with an equal one share the monotonic clock."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""
