"""How long a frame is on the air (HRP UWB PHY, IEEE 802.15.4-2015, clause 16.2), and where its RMARKER lies.

The RMARKER, the instant that every stamp means, is the first chip of the PHY header: the preamble and the
start-of-frame delimiter fly before it, the header and the data after. Durations hold for the settings of
``docs/protocol.md``: 64 MHz PRF, 6.81 Mbit/s, standard delimiter of 8 symbols.
"""

from typing import Final

from skyless.constants import CHIP_RATE_HZ

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


def preamble_s(preamble_symbols: int = PREAMBLE_SYMBOLS, sfd_symbols: int = SFD_SYMBOLS) -> float:
    """Time on the air before the RMARKER: preamble and start-of-frame delimiter, 138.4 µs by default."""
    return (preamble_symbols + sfd_symbols) * PREAMBLE_SYMBOL_S


def after_rmarker_s(psdu_bytes: int) -> float:
    """Time on the air from the RMARKER on: PHY header, and the PSDU (FCS included) with its Reed–Solomon parity."""
    data_bits = 8 * psdu_bytes
    blocks = -(-data_bits // _BLOCK_BITS)
    return _HEADER_SYMBOLS * HEADER_SYMBOL_S + (data_bits + _PARITY_BITS * blocks) * DATA_SYMBOL_S


def air_time_s(psdu_bytes: int, preamble_symbols: int = PREAMBLE_SYMBOLS, sfd_symbols: int = SFD_SYMBOLS) -> float:
    """Time that a frame of so many bytes (FCS included) is on the air, first chip to last."""
    return preamble_s(preamble_symbols, sfd_symbols) + after_rmarker_s(psdu_bytes)
