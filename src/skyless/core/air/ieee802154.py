"""Frames of IEEE 802.15.4: their check sequence, how long they are on the air, and where the RMARKER lies.

The RMARKER, the instant that every stamp means, is the first chip of the PHY header: the preamble and the
start-of-frame delimiter come before it, the header and the data after (HRP UWB PHY, IEEE 802.15.4-2015, clause 16.2).
Durations hold for the settings of ``docs/protocol.md``: 64 MHz PRF, 6.81 Mbit/s, standard delimiter of 8 symbols.
"""

from binascii import crc_hqx
from typing import Final

from skyless.core.constants import CHIP_RATE_HZ

PREAMBLE_SYMBOLS: Final = 128
SFD_SYMBOLS: Final = 8

PREAMBLE_SYMBOL_S: Final = 508 / CHIP_RATE_HZ
"""One symbol of preamble or delimiter at 64 MHz PRF: a code of 127 elements, each spread over 4 chips; 1017.63 ns."""
HEADER_SYMBOL_S: Final = 512 / CHIP_RATE_HZ
"""One symbol of the PHY header, which is sent at 850 kbit/s; 1025.64 ns."""
DATA_SYMBOL_S: Final = 64 / CHIP_RATE_HZ
"""One bit of the data at 6.81 Mbit/s; 128.21 ns."""

_HEADER_SYMBOLS: Final = 21
"""19 bits (13 of contents, 6 of SECDED) and 2 that flush the convolutional code."""
_BLOCK_BITS: Final = 330
"""Data bits in one Reed–Solomon block (clause 16.3.3), the last one shortened."""
_PARITY_BITS: Final = 48

_REVERSED: Final = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
"""Each byte with its bits in reverse order: the radio sends bit 0 first, ``crc_hqx`` processes bit 7 first."""


def preamble_s(preamble_symbols: int = PREAMBLE_SYMBOLS, sfd_symbols: int = SFD_SYMBOLS) -> float:
    """Time on the air before the RMARKER: preamble and start-of-frame delimiter, 138.4 µs by default."""
    return (preamble_symbols + sfd_symbols) * PREAMBLE_SYMBOL_S


def after_rmarker_s(psdu_bytes: int) -> float:
    """Time on the air from the RMARKER on: PHY header, and the PSDU (FCS included) with its Reed–Solomon parity."""
    data_bits = 8 * psdu_bytes
    blocks = -(-data_bits // _BLOCK_BITS)
    return _HEADER_SYMBOLS * HEADER_SYMBOL_S + (data_bits + _PARITY_BITS * blocks) * DATA_SYMBOL_S


def air_time_s(psdu_bytes: int, preamble_symbols: int = PREAMBLE_SYMBOLS, sfd_symbols: int = SFD_SYMBOLS) -> float:
    """Time that a frame (FCS included) is on the air, first chip to last."""
    return preamble_s(preamble_symbols, sfd_symbols) + after_rmarker_s(psdu_bytes)


def fcs(data: bytes) -> bytes:
    """Frame check sequence of ``data`` (clause 7.2.10): CRC-16 of x¹⁶ + x¹² + x⁵ + 1, initially 0, low byte first."""
    return crc_hqx(data.translate(_REVERSED), 0).to_bytes(2, "big").translate(_REVERSED)


def is_intact(frame: bytes) -> bool:
    """Whether a frame's last two bytes are the FCS of those before; the CRC over all of it is then 0."""
    return crc_hqx(frame.translate(_REVERSED), 0) == 0
