"""The frame check sequence that ends every frame of IEEE 802.15.4 (clause 7.2.10): a reflected CRC-16."""

from binascii import crc_hqx
from typing import Final

_REVERSED: Final = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
"""Each byte with its bits in reverse order: the radio sends bit 0 first, ``crc_hqx`` takes bit 7 first."""


def fcs(data: bytes) -> bytes:
    """Two bytes that follow ``data`` on the air: CRC-16 of x¹⁶ + x¹² + x⁵ + 1, initially 0, low byte first."""
    return crc_hqx(data.translate(_REVERSED), 0).to_bytes(2, "big").translate(_REVERSED)


def is_intact(frame: bytes) -> bool:
    """Whether a frame's last two bytes are the FCS of those before; the CRC over all of it is then 0."""
    return crc_hqx(frame.translate(_REVERSED), 0) == 0
