"""Values as the bytes of CDR, little endian, as DDS carries them and rosbag2 keeps them.

Source: OMG, DDS Interoperability Wire Protocol (DDSI-RTPS) 2.5, section 10, and DDS-XTypes 1.3, section 7.4.1: XCDR
version 1 of final types. Everything stands at a multiple of its own size, counted from after the four bytes of the
header.
"""

import struct
from collections.abc import Iterable
from typing import Final

_LITTLE_ENDIAN: Final = b"\x00\x01\x00\x00"


class CdrWriter:
    """Gathers the fields of one message in their order."""

    def __init__(self) -> None:
        self._data = bytearray()

    def add(self, code: str, *values: float) -> None:
        """Numbers of one of ``struct``'s types: ``B b H h I i f d``; ``?`` for flags. Raises struct.error."""
        size = struct.calcsize(f"<{code}")
        self._data += bytes(-len(self._data) % size)
        self._data += struct.pack(f"<{len(values)}{code}", *values)

    def add_text(self, text: str) -> None:
        """A string: its length with the NUL that ends it, then both; without any other NUL."""
        data = text.replace("\0", "").encode() + b"\0"
        self.add("I", len(data))
        self._data += data

    def add_length(self, length: int) -> None:
        """The length of a sequence, whose elements are added next."""
        self.add("I", length)

    def add_doubles(self, values: Iterable[float]) -> None:
        """An array of double precision numbers."""
        self.add("d", *values)

    def message(self) -> bytes:
        """The whole message with its header."""
        return _LITTLE_ENDIAN + bytes(self._data)
