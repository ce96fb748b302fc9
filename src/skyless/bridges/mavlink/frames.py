"""MAVLink frames: bytes of messages, and messages in received bytes.

A frame of version 2 is ``0xFD | length | incompatible | compatible | sequence | system | component | number (24 bits) |
payload | CRC``, one of version 1 ``0xFE | length | sequence | system | component | number (8 bits) | payload | CRC``.
Source: https://mavlink.io/en/guide/serialization.html.
"""

from collections.abc import Iterator, Mapping
from typing import Final

from msgspec import Struct

MAGIC_1: Final = 0xFE
MAGIC_2: Final = 0xFD
HEADER_BYTES_1: Final = 6
HEADER_BYTES_2: Final = 10
CHECK_BYTES: Final = 2
SIGNATURE_BYTES: Final = 13
IS_SIGNED: Final = 0x01
"""Of the incompatible flags, the only one that is defined: a signature stands after the check."""


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x8408 if crc & 1 else 0)
        table.append(crc)
    return tuple(table)


_CRC: Final = _crc_table()


def crc(data: bytes, crc_extra: int) -> int:
    """CRC-16/MCRF4XX of ``data`` and then of the byte that stands for a message's definition."""
    value = 0xFFFF
    for byte in data:
        value = (value >> 8) ^ _CRC[(value ^ byte) & 0xFF]
    return (value >> 8) ^ _CRC[(value ^ crc_extra) & 0xFF]


class Frame(Struct, frozen=True):
    """A received frame whose check is right."""

    number: int
    """Of the message."""
    system: int
    component: int
    payload: bytes
    """Without the zeros that its sender has cut off."""


def frame(number: int, crc_extra: int, payload: bytes, *, sequence: int, system: int, component: int) -> bytes:
    """A frame of version 2, unsigned; zeros at the payload's end are cut off, but for its first byte."""
    payload = payload.rstrip(b"\0") or payload[:1]
    body = bytes([len(payload), 0, 0, sequence & 0xFF, system, component]) + number.to_bytes(3, "little") + payload
    return bytes([MAGIC_2]) + body + crc(body, crc_extra).to_bytes(CHECK_BYTES, "little")


class FrameReader:
    """Finds frames of both versions in a stream of bytes; only those of messages in ``crc_extras`` are given.

    Signatures are skipped, not checked.
    """

    def __init__(self, crc_extras: Mapping[int, int]) -> None:
        """``crc_extras``: for each number of a message the byte that stands for its definition."""
        self._crc_extras = crc_extras
        self._buffer = bytearray()
        self.damaged = 0
        """How often something that began like a frame was none."""

    def frames(self, data: bytes) -> Iterator[Frame]:
        """The frames that end in ``data``, which continues what was given before."""
        self._buffer += data
        while self._find_magic():
            length = self._length()
            if length is None or len(self._buffer) < length:
                return
            found = self._checked(length)
            if found is None:
                # The magic byte was one of a payload, or the frame is damaged: the next may begin within it.
                self.damaged += 1
                del self._buffer[:1]
                continue
            del self._buffer[:length]
            if found.number in self._crc_extras:
                yield found

    def _find_magic(self) -> bool:
        starts = (self._buffer.find(MAGIC_1), self._buffer.find(MAGIC_2))
        at = min((start for start in starts if start >= 0), default=len(self._buffer))
        del self._buffer[:at]
        return bool(self._buffer)

    def _length(self) -> int | None:
        """Of the frame at the start; None while too little of it is here."""
        if len(self._buffer) < 3:
            return None
        if self._buffer[0] == MAGIC_1:
            return HEADER_BYTES_1 + self._buffer[1] + CHECK_BYTES
        signature = SIGNATURE_BYTES if self._buffer[2] & IS_SIGNED else 0
        return HEADER_BYTES_2 + self._buffer[1] + CHECK_BYTES + signature

    def _checked(self, length: int) -> Frame | None:
        """The whole frame at the start, None if it is damaged. That of an unknown message cannot be checked."""
        data = bytes(self._buffer[:length])
        payload_bytes = data[1]
        if data[0] == MAGIC_1:
            system, component, number, header = data[3], data[4], data[5], HEADER_BYTES_1
        else:
            system, component, header = data[5], data[6], HEADER_BYTES_2
            number = int.from_bytes(data[7:10], "little")
            if data[2] & ~IS_SIGNED:
                return None
        end = header + payload_bytes
        crc_extra = self._crc_extras.get(number)
        if crc_extra is not None:
            check = int.from_bytes(data[end : end + CHECK_BYTES], "little")
            if check != crc(data[1:end], crc_extra):
                return None
        return Frame(number, system, component, data[header:end])
