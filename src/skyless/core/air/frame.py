"""What the frames of both protocols share: the header, relayed receptions, and reasons why bytes are not a beacon.

A beacon is an IEEE 802.15.4 data frame of at most 127 bytes, little endian throughout. 40-bit stamps travel as a low
word of 32 bits and a high byte.
"""

import math
import struct
from binascii import crc_hqx
from collections.abc import Iterator
from enum import StrEnum
from typing import Final

from msgspec import Struct

from skyless.core.native.arithmetic import exp
from skyless.core.native.records import Bytes, Ticks
from skyless.core.ticks import CHIP_RATE_HZ, nearest, wrap

MAX_FRAME_BYTES: Final = 127
"""Longest PSDU (IEEE 802.15.4-2015, aMaxPhyPacketSize)."""
FCS_BYTES: Final = 2

FRAME_CONTROL: Final = 0x8841
"""Data frame, PAN identifier compressed, 16-bit addresses."""
BROADCAST: Final = 0xFFFF
BEACON_MAGIC: Final = 0xB053
"""Bytes 53 B0; the low half of the second is the version."""
MAGIC_MASK: Final = 0xF0FF
_MAGIC_AT: Final = slice(9, 11)
_START: Final = struct.Struct("<HBHHHH")

HEARD: Final = struct.Struct("<HBIB")
"""One ``heard`` entry: anchor, sequence number, low word and high byte of the RX stamp."""
HEARD_BYTES: Final = HEARD.size

# In beacons with phases a code replaces the stamp's high byte: 128 plus the phase in steps, or 0 without a phase.
SHORT_BITS: Final = 32
"""Bits of the stamp of such an entry."""
PHASE_STEPS: Final = 128
"""Phase steps in a cycle; also the bit that marks the presence of a phase."""


class Heard(Struct, frozen=True, gc=False):
    """When a beacon of another anchor was last received: a raw stamp of the relaying anchor's own counter."""

    anchor: int
    """Identifier of the anchor that was heard, 16 bits."""
    sequence: int
    """Sequence number (8 bits) of the frame that was heard."""
    rx_ticks: int
    """RX stamp in the relaying anchor's clock, 40 bits."""
    phase_cycles: float | None = None
    """Carrier phase at this reception, in [0, 1); only in beacons with phases."""
    is_short: bool = False
    """Whether only the lowest 32 bits of the stamp are known, as in beacons with phases."""

    def rx_ticks_near(self, expected_ticks: int) -> int:
        """Return the 40-bit stamp; of a short stamp, the candidate nearest to the expected one."""
        return wrap(nearest(self.rx_ticks, expected_ticks, SHORT_BITS)) if self.is_short else self.rx_ticks


class PackedHeard(Struct, frozen=True, gc=False, eq=False):
    """``heard`` entries kept as frame bytes and decoded on access; equal to a tuple of the same entries."""

    packed: bytes
    has_phases: bool = False

    def __len__(self) -> int:
        return len(self.packed) // HEARD.size

    def __iter__(self) -> Iterator[Heard]:
        for anchor, sequence, low, high in HEARD.iter_unpack(self.packed):
            if self.has_phases:
                phase_cycles = None if high < PHASE_STEPS else (high - PHASE_STEPS) / PHASE_STEPS
                yield Heard(anchor, sequence, low, phase_cycles, is_short=True)
            else:
                yield Heard(anchor, sequence, low | high << 32)

    def __contains__(self, entry: object) -> bool:
        return entry in tuple(self)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, tuple | PackedHeard) and tuple(self) == tuple(other)

    def __hash__(self) -> int:
        return hash(tuple(self))


class Malformed(StrEnum):
    """Reason why bytes are not a beacon of this version (``docs/protocol.md``, "What is dropped")."""

    TOO_SHORT = "too-short"
    """Shorter than any IEEE 802.15.4 frame, or a beacon that ends within its fixed part."""
    TOO_LONG = "too-long"
    """Longer than the 127 bytes of a PSDU."""
    BAD_FCS = "bad-fcs"
    """The frame check sequence does not match the bytes."""
    NOT_A_BEACON = "not-a-beacon"
    """An intact frame of another system."""
    UNKNOWN_VERSION = "unknown-version"
    """A beacon of another version of the protocol."""
    BAD_FLAGS = "bad-flags"
    """A reserved flag is set."""
    BAD_LENGTH = "bad-length"
    """The length does not match the flags and the number of relayed stamps."""
    BAD_HEARD = "bad-heard"
    """Impossible stamps: of the sender itself, of the master in the wrong field, or twice of one anchor."""
    BAD_PAGE = "bad-page"
    """A page of the almanac with an impossible value."""
    BAD_PERIOD = "bad-period"
    """A mean period that no anchor has (protocol 2)."""


def not_a_beacon(frame: bytes, version: int) -> Malformed | None:
    """Return why an intact frame is not a beacon of a version (judging by its magic number), None if it is one."""
    if len(frame) < _START.size + FCS_BYTES:
        return Malformed.NOT_A_BEACON
    control, _, _, destination, _, magic = _START.unpack_from(frame)
    if control != FRAME_CONTROL or destination != BROADCAST or magic & MAGIC_MASK != BEACON_MAGIC:
        return Malformed.NOT_A_BEACON
    return Malformed.UNKNOWN_VERSION if magic != version else None


def has_version(frame: bytes, version: int) -> bool:
    """Whether bytes look like a beacon of a version, judging by the magic number."""
    return frame[_MAGIC_AT] == version.to_bytes(2, "little")


# Frames of IEEE 802.15.4. The RMARKER, the instant that every stamp refers to, is the first chip of the PHY header
# (HRP UWB PHY, IEEE 802.15.4-2015, clause 16.2). Durations hold for the settings of ``docs/protocol.md``: 64 MHz PRF,
# 6.81 Mbit/s, standard delimiter of 8 symbols.

PREAMBLE_SYMBOLS: Final = 128
SFD_SYMBOLS: Final = 8

PREAMBLE_SYMBOL_S: Final = 508 / CHIP_RATE_HZ
"""One symbol of preamble or delimiter at 64 MHz PRF: a code of 127 elements, each spread over 4 chips; 1017.63 ns."""
HEADER_SYMBOL_S: Final = 512 / CHIP_RATE_HZ
"""One symbol of the PHY header, which is sent at 850 kbit/s; 1025.64 ns."""
DATA_SYMBOL_S: Final = 64 / CHIP_RATE_HZ
"""One bit of the data at 6.81 Mbit/s; 128.21 ns."""

_HEADER_SYMBOLS: Final = 21
"""PHY header: 19 bits (13 of contents, 6 of SECDED) plus 2 that flush the convolutional code."""
_BLOCK_BITS: Final = 330
"""Data bits in one Reed–Solomon block (clause 16.3.3), the last one shortened."""
_PARITY_BITS: Final = 48

_REVERSED: Final = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
"""Table of bytes with their bits reversed: the radio sends bit 0 first, ``crc_hqx`` processes bit 7 first."""


def preamble_s(preamble_symbols: int = PREAMBLE_SYMBOLS, sfd_symbols: int = SFD_SYMBOLS) -> float:
    """Return the time on the air before the RMARKER: preamble and start-of-frame delimiter, 138.4 µs by default."""
    return (preamble_symbols + sfd_symbols) * PREAMBLE_SYMBOL_S


def after_rmarker_s(psdu_bytes: int) -> float:
    """Return the time on the air from the RMARKER on: PHY header, PSDU (FCS included) and Reed–Solomon parity."""
    data_bits = 8 * psdu_bytes
    blocks = -(-data_bits // _BLOCK_BITS)
    return _HEADER_SYMBOLS * HEADER_SYMBOL_S + (data_bits + _PARITY_BITS * blocks) * DATA_SYMBOL_S


def air_time_s(psdu_bytes: int, preamble_symbols: int = PREAMBLE_SYMBOLS, sfd_symbols: int = SFD_SYMBOLS) -> float:
    """Return the time that a frame (FCS included) is on the air, first chip to last."""
    return preamble_s(preamble_symbols, sfd_symbols) + after_rmarker_s(psdu_bytes)


def fcs(data: bytes, initial: int = 0) -> bytes:
    """Return the frame check sequence (clause 7.2.10): CRC-16 x¹⁶ + x¹² + x⁵ + 1, low byte first."""
    return crc_hqx(data.translate(_REVERSED), initial).to_bytes(2, "big").translate(_REVERSED)


def is_intact(frame: bytes) -> bool:
    """Whether a frame ends in its own FCS; the CRC over all of it is then 0."""
    return crc_hqx(frame.translate(_REVERSED), 0) == 0


# Whole numbers in frames, lowest byte first.

SIGN: Final = 0x80000000
"""The highest bit of four bytes; as a float32 on its own it is −0."""


def unsigned(data: Bytes, at: int, size: int) -> Ticks:
    """Read an unsigned integer of this many bytes."""
    number: Ticks = 0
    for byte in range(size - 1, -1, -1):
        number = number << 8 | data[at + byte]
    return number


def two_bytes(data: Bytes, at: int) -> int:
    """Read an unsigned integer of two bytes, in an ``int``."""
    return data[at] | data[at + 1] << 8


def signed(data: Bytes, at: int) -> Ticks:
    """Read a signed integer of four bytes."""
    number = unsigned(data, at, 4)
    return number if number < SIGN else number - 2 * SIGN


class Diagnostics(Struct, frozen=True, gc=False):
    """What a radio measured of one frame besides its time. A value is None if the radio does not report it.

    Powers follow the chip's formulas without corrections (``core/air/frame.py``).
    """

    rx_power_dbm: float | None = None
    first_path_power_dbm: float | None = None
    carrier_offset_ppm: float | None = None


class Reception(Struct, frozen=True, gc=False):
    """One frame as a radio received it.

    ``frame`` is the whole PSDU, FCS included. ``rx_ticks`` is the receiver's 40-bit counter at the frame's RMARKER,
    antenna delay already subtracted. ``host_s`` is the host's clock, needed only to bridge gaps over 8.6 s.
    ``carrier_phase_cycles`` is the carrier's phase at the first path, in [0, 1), if the radio measured it: it
    falls by one cycle per carrier period of ``rx_ticks`` (docs/phases.md).
    """

    frame: bytes
    rx_ticks: int
    host_s: float | None = None
    diagnostics: Diagnostics | None = None
    carrier_phase_cycles: float | None = None

    def __post_init__(self) -> None:
        """Refuse values that are not a frame or a tick count. Raises TypeError."""
        if type(self.frame) is bytes and type(self.rx_ticks) is int:
            return  # one is made for each frame: check nothing else
        if not isinstance(self.frame, bytes):
            raise TypeError(f"frame is {self.frame!r:.80}; it should be bytes, the whole PSDU with its FCS")
        if not hasattr(self.rx_ticks, "__index__"):
            raise TypeError(f"rx_ticks is {self.rx_ticks!r}; it should be an integer, ticks of the receiver")


def phase_of(reception: Reception) -> float:
    """Return the carrier phase of a reception in cycles, below 0 if unknown: the form that compiled functions take."""
    return -1.0 if reception.carrier_phase_cycles is None else reception.carrier_phase_cycles


class Transmission(Struct, frozen=True, gc=False):
    """One frame to send, with its RMARKER leaving the antenna at ``tx_ticks`` (40-bit, sender's counter)."""

    frame: bytes
    tx_ticks: int


# Receptions with a weak first path: they may be late, so they get less weight.

CLEAR_DB: Final = 7.0
BLOCKED_DB: Final = 11.0
"""Difference of powers in dB at which the factor starts to rise and at which it is greatest: the maker's 6 and 10, plus
1 dB. Lines of sight of the UTIL data set reach 8.4 dB; paths through metal, the only ones much later, start at 11.3."""

MAX_VARIANCE_FACTOR: Final = 36.0
"""Factor on the variance of a blocked path: metal delayed messages by 0.2 to 0.4 m, 4 to 8 times the noise."""


_LOG_FACTOR: Final = math.log(MAX_VARIANCE_FACTOR)
_MAX_DIFFERENCE_DB: Final = 1000.0
"""Magnitude above which a value is not a valid power."""


def variance_factor(rx_power_dbm: float, first_path_power_dbm: float) -> float:
    """Return the factor on a reception's variance, 1 to ``MAX_VARIANCE_FACTOR``, growing with the powers' difference.

    The factor is 1 if a power is missing (NaN), not finite or impossible (a first path above the total).
    """
    difference_db = rx_power_dbm - first_path_power_dbm
    if not CLEAR_DB < difference_db <= _MAX_DIFFERENCE_DB:
        return 1.0
    part = min((difference_db - CLEAR_DB) / (BLOCKED_DB - CLEAR_DB), 1.0)
    return MAX_VARIANCE_FACTOR * exp((part * part * (3.0 - 2.0 * part) - 1.0) * _LOG_FACTOR)


def variance_factor_of(diagnostics: Diagnostics | None) -> float:
    """Return ``variance_factor`` of a radio's measurements of a frame."""
    return variance_factor(*powers_dbm(diagnostics))


def powers_dbm(diagnostics: Diagnostics | None) -> tuple[float, float]:
    """Return the received power and the first path's power, NaN if the radio does not report it."""
    if diagnostics is None:
        return math.nan, math.nan
    rx_dbm, first_path_dbm = diagnostics.rx_power_dbm, diagnostics.first_path_power_dbm
    return (math.nan if rx_dbm is None else rx_dbm), (math.nan if first_path_dbm is None else first_path_dbm)


WEAK_FACTOR: Final = math.sqrt(MAX_VARIANCE_FACTOR)
"""Factor from which an anchor flags a relayed reception as having a weak first path: 9 dB."""


def is_weak_first_path(diagnostics: Diagnostics | None) -> bool:
    """Whether a reception may be late because its first path is weak; False if a power is missing or impossible."""
    return variance_factor_of(diagnostics) >= WEAK_FACTOR
