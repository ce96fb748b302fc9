"""The serial link, to the byte (``docs/serial.md``): framing, check, records and their values.

A record is ``kind | number | body | CRC-16``, made free of zeros (COBS) and ended by a 0 byte. The board's end is in C
(``firmware/source/link.c``), with the same names for the same numbers. Both ends are here, for emulated boards write
what real ones do. Ticks are numbers of 40 bits.
"""

import struct
from binascii import crc_hqx
from collections.abc import Callable, Sequence
from math import inf
from typing import Final

from msgspec import Struct
from msgspec.structs import astuple

from skyless.core.air.frame import Diagnostics, Reception
from skyless.core.ticks import DEFAULT_ANTENNA_DELAY_TICKS
from skyless.radio.tag_reports import BODY_AT, TagReport, anchor_place, board_fix, board_status, georeference

# How a tag on a board works, to the byte: kept in its flash, and sent over the serial link.
#
# The board's end is ``firmware/source/settings.c``, with the same names; a test compares both.

VERSION: Final = 1
MODES: Final = ("radio", "tag")
"""A radio for its host, or a tag that computes its own position; settings have their place here."""
OUTPUTS: Final = ("records", "nmea", "json", "none")
"""A tag's output on its serial port."""
ANY_SITE: Final = 0xFFFF
BAUDS: Final = (460_800, 1_000_000, 115_200, 230_400)
"""Rates of the serial port, in the order in which a board is looked for; a new board has the first."""

_WORDS: Final = struct.Struct("<11I2i3I3f")
SETTINGS_BYTES: Final = _WORDS.size + 2
"""Words and CRC."""


class BoardSettings(Struct, frozen=True):
    """Settings in the board's own units; the defaults are those of a new board."""

    mode: int = 0
    output: int = 0
    rate_hz: int = 10
    """Highest rate of its output; 0 for every fix."""
    baud: int = BAUDS[0]
    bluetooth_ms: int = 0
    """Interval of the Bluetooth advertisements; 0 for none."""
    site: int = ANY_SITE
    tag: int = 1
    tx_delay_ticks: int = DEFAULT_ANTENNA_DELAY_TICKS
    rx_delay_ticks: int = DEFAULT_ANTENNA_DELAY_TICKS
    has_bounds: int = 0
    low_mm: int = 0
    high_mm: int = 0
    sleep_ms: int = 0
    """Sleep between two fixes; 0 for always on."""
    superframes: int = 3
    """Superframes that it listens to after each sleep."""
    predicts: int = 0
    """1 if its receiver is on only when beacons are due."""
    qa_m2ps3: float = 0.3
    integrity_risk: float = 1e-4
    alert_limit_m: float = 0.0
    """0 for none."""


def pack(settings: BoardSettings) -> bytes:
    """Encode settings. Raises struct.error for values that do not fit."""
    words = _WORDS.pack(VERSION, *astuple(settings))
    return words + crc16(words).to_bytes(2, "big")


def unpack(data: bytes) -> BoardSettings | None:
    """Decode settings; None for bytes that no board of this version sends."""
    if len(data) != SETTINGS_BYTES or crc16(data) != 0:
        return None
    version, *words = _WORDS.unpack_from(data)
    made = BoardSettings(*words[:-3], *(float(f"{single:.7g}") for single in words[-3:]))
    is_known = version == VERSION and made.mode < len(MODES) and made.output < len(OUTPUTS)
    return made if is_known and 0.0 < made.integrity_risk <= 0.1 and 0.0 <= made.alert_limit_m < inf else None


MAJOR: Final = 1
"""Ends with different major versions are incompatible."""
MINOR: Final = 4
"""Grows with appended fields and new kinds, which older ends ignore."""

# From the board
HELLO: Final = 0x01
RX: Final = 0x02
TX_DONE: Final = 0x03
TX_LATE: Final = 0x04
STATUS: Final = 0x05
REFUSED: Final = 0x06
RX_PHASE: Final = 0x07
FIX: Final = 0x08
TAG_STATUS: Final = 0x09
ANCHOR_PLACE: Final = 0x0A
GEOREFERENCE: Final = 0x0B
TAG_CONFIG: Final = 0x0C
VALUE: Final = 0x0D
TEST: Final = 0x0E

# From the host
ASK_HELLO: Final = 0x41
CONFIG: Final = 0x42
TX_AT: Final = 0x43
RX_ON: Final = 0x44
ASK_STATUS: Final = 0x45
SET_TAG_CONFIG: Final = 0x46
ASK_TAG_CONFIG: Final = 0x47
SET_TIME: Final = 0x48
READ: Final = 0x49
TEST_LINE: Final = 0x4A

OTP: Final = 0x40
FACTS: Final = 0x80
CLOCKS: Final = 0x81
COUNTS: Final = 0x82
"""What READ reads besides register files of the chip, which are below ``OTP``: a word of the chip's one-time
programmable memory, facts of the processor, three clocks at once, and counts since the start."""
READ_BYTES: Final = 16
READ_TIMES: Final = 1000
"""Limits of READ: bytes of a register, and how many times it is read."""
READ_DATA_AT: Final = 9
READ_SLOWLY: Final = 0x01
"""Flag in READ: at the slow SPI clock."""
TEST_OVERHEAD: Final = 6
"""Bytes of a record on the line besides its body."""

RX_FRAME_AT: Final = 13
RX_PHASE_FRAME_AT: Final = 15
TX_FRAME_AT: Final = 7
SETTINGS_AT: Final = 3
"""In both records of settings, after the flags."""
MAX_FRAME_BYTES: Final = 127

HELLO_BYTES: Final = 21
"""Length in version 1.0; later versions append the reset cause."""
STATUS_BYTES: Final = 36
CONFIG_BYTES: Final = 13
"""Lengths of whole records, kind and number included."""

NOT_MEASURED: Final = -32768
"""Marks a measurement that the board does not have."""
NO_VOLTAGE: Final = 0xFFFF

CAN_TRANSMIT: Final = 0x01
HAS_PHASES: Final = 0x02
CAN_COMPUTE: Final = 0x04
"""Capabilities in HELLO."""
WANTS_PHASES: Final = 0x01
"""Flag in CONFIG: report receptions with a phase as RX_PHASE."""
IN_FLASH: Final = 0x01
"""Flag in the records of settings: store them in flash, or they are stored there."""
RESET_BY_PIN: Final = 0x01
RESET_BY_WATCHDOG: Final = 0x02
RESET_BY_SOFTWARE: Final = 0x04
RESET_BY_LOCKUP: Final = 0x08
RESET_BY_FAULT: Final = 0x80
"""Bits of the reset cause in HELLO: the first four are those of the nRF52832's RESETREAS; a fault is one noticed by
the firmware. None set: power-on or undervoltage."""
IS_CONFIGURED: Final = 0x01
IS_RECEIVING: Final = 0x02
HAS_FRAME_WAITING: Final = 0x04
IS_POLLED: Final = 0x08
"""Bits of the state in STATUS; polled: the chip's interrupt line does not follow its events."""

LATE_FOR_RADIO: Final = 1
LATE_BUSY: Final = 2
LATE_NOT_READY: Final = 3
"""Why a frame was not sent: too late, another one queued, or the radio not configured."""

REFUSED_SETTING: Final = 1
REFUSED_MALFORMED: Final = 2
REFUSED_RADIO: Final = 3
"""Why a command was refused."""

STATUS_OCTETS: Final = 5
"""Of the chip's SYS_STATUS in REFUSED."""

RATE_KHZ: Final = 63_897_600
COUNTER_BITS: Final = 40
COUNT_MASK: Final = 0x3FFF_FFFF
"""Counts in STATUS wrap at 30 bits."""

MAX_RECORD_BYTES: Final = 250
"""Including its check: one block of COBS, with room for later versions."""
MAX_STUFFED_BYTES: Final = MAX_RECORD_BYTES + 2
"""Longest stretch before a 0; a record needs one byte less."""


def crc16(data: bytes) -> int:
    """CRC-16/IBM-3740: x¹⁶ + x¹² + x⁵ + 1 from 0xFFFF; 0 over data that ends with its own CRC, high byte first."""
    return crc_hqx(data, 0xFFFF)


def stuff(record: bytes) -> bytes:
    """A record without zeros (COBS: Cheshire and Baker, 1999), followed by a 0.

    Raises:
        ValueError: 255 bytes without a zero; no record is that long.
    """
    return b"".join([bytes((len(block) + 1,)) + block for block in record.split(b"\0")]) + b"\0"


def unstuff(line: bytes) -> bytes | None:
    """Inverse of ``stuff`` for at most ``MAX_STUFFED_BYTES`` without zeros; None if a block is incomplete."""
    blocks, at = [], 0
    while at < len(line):
        end = at + line[at]
        if end > len(line):
            return None
        blocks.append(line[at + 1 : end])
        at = end
    return b"\0".join(blocks)


class Writer:
    """Encodes records with consecutive numbers; each method returns a line ready to send.

    Records of one or two bytes are made by ``record``. Ticks are from 0 to 2**40 - 1. Values that do not fit raise
    struct.error or OverflowError.
    """

    def __init__(self) -> None:
        self._number = 0

    def record(self, kind: int, body: bytes = b"") -> bytes:
        """Encode a record of any kind."""
        record = bytes((kind, self._number)) + body
        self._number = (self._number + 1) & 0xFF
        return stuff(record + crc16(record).to_bytes(2, "big"))

    def hello(self, firmware: tuple[int, int, int], device_id: bytes, capabilities: int, reset_cause: int = 0) -> bytes:
        """Identity of the board; ``device_id`` has 8 bytes."""
        fixed = struct.pack("<5B8sIBB", MAJOR, MINOR, *firmware, device_id, RATE_KHZ, COUNTER_BITS, capabilities)
        return self.record(HELLO, fixed + bytes((reset_cause,)))

    def rx(
        self,
        rx_ticks: int,
        rx_power_cdbm: int,
        first_path_cdbm: int,
        offset_ppb: int,
        frame: bytes,
        phase: int | None = None,
    ) -> bytes:
        """A frame, its stamp, powers in 0.01 dBm, the sender's carrier offset in 1e-9, and, in RX_PHASE, its phase."""
        fixed = _stamp(rx_ticks) + struct.pack("<3h", rx_power_cdbm, first_path_cdbm, offset_ppb)
        if phase is None:
            return self.record(RX, fixed + frame)
        return self.record(RX_PHASE, fixed + phase.to_bytes(2, "little") + frame)

    def tx_done(self, dx_ticks: int, tx_ticks: int) -> bytes:
        """The frame of ``dx_ticks`` has left with this TX stamp."""
        return self.record(TX_DONE, _stamp(dx_ticks) + _stamp(tx_ticks))

    def tx_late(self, dx_ticks: int, reason: int) -> bytes:
        """The frame of ``dx_ticks`` was not sent."""
        return self.record(TX_LATE, _stamp(dx_ticks) + bytes((reason,)))

    def status(
        self,
        ticks: int,
        state: int,
        counts: Sequence[int],
        temperature_cc: int = NOT_MEASURED,
        millivolts: int = NO_VOLTAGE,
    ) -> bytes:
        """Counter now, state, and six counts: received, errors, sent, late, garbled commands, records not sent."""
        wrapped = (count & COUNT_MASK for count in counts)
        return self.record(STATUS, _stamp(ticks) + struct.pack("<B6IhH", state, *wrapped, temperature_cc, millivolts))

    def ask_hello(self) -> bytes:
        """Ask for the board's identity; states our version."""
        return self.record(ASK_HELLO, bytes((MAJOR, MINOR)))

    def config(self, tx_delay_ticks: int, rx_delay_ticks: int, flags: int = 0) -> bytes:
        """Channel 5, 64 MHz PRF, 6.8 Mbit/s, preamble of 128 symbols with code 9; antenna delays."""
        return self.record(CONFIG, struct.pack("<4B3HB", 5, 64, 2, 9, 128, tx_delay_ticks, rx_delay_ticks, flags))

    def tx_at(self, dx_ticks: int, frame: bytes) -> bytes:
        """Send ``frame`` so that its RMARKER leaves the radio at ``dx_ticks``."""
        return self.record(TX_AT, _stamp(dx_ticks) + frame)

    def set_tag_config(self, settings: BoardSettings, *, keep: bool) -> bytes:
        """Use these settings from now on; ``keep``: store them in flash."""
        return self.record(SET_TAG_CONFIG, bytes((keep * IN_FLASH,)) + pack(settings))


def _stamp(ticks: int) -> bytes:
    return ticks.to_bytes(5, "little")


class Reader:
    """Finds the records in an arbitrary stream of bytes.

    ``garbled`` counts stretches between two zeros that are no record, ``overlong`` those too long for any.
    """

    def __init__(self) -> None:
        self.garbled = 0
        self.overlong = 0
        self._line = b""
        self._skipping = False

    def read(self, data: bytes) -> list[bytes]:
        """The records that end in ``data``, without their checks: kind at 0, body from ``BODY_AT``."""
        *ended, rest = data.split(b"\0")
        records = []
        for piece in ended:
            self._append(piece)
            record = self._finish()
            if record is not None:
                records.append(record)
        self._append(rest)
        return records

    def _append(self, piece: bytes) -> None:
        if self._skipping:
            return
        self._line += piece
        if len(self._line) > MAX_STUFFED_BYTES:
            self.overlong += 1
            self._skipping, self._line = True, b""

    def _finish(self) -> bytes | None:
        """The record in the bytes before a zero, if they are one."""
        line, self._line = self._line, b""
        if self._skipping:
            self._skipping = False
            return None
        if not line:
            return None
        record = unstuff(line)
        if record is None or len(record) < BODY_AT + 2 or crc16(record) != 0:
            self.garbled += 1
            return None
        return record[:-2]


# Records as values, and the rounding of measured values to the link's units

_STEPS: Final = (100, 100, 1000)
"""Units of powers and carrier offset: steps per dB and per ppm."""
_GREATEST: Final = 0x7FFF
_TURN: Final = 1 << 16
DEVICE_ID: Final = 0xDECA0130
_NO_LOCK: Final = 2
_NO_FAST_ANSWER: Final = 3


class Hello(Struct, frozen=True):
    """The board's version and capabilities."""

    major: int
    minor: int
    firmware: tuple[int, int, int]
    device_id: bytes
    rate_khz: int
    counter_bits: int
    can_transmit: bool
    reset_cause: int | None
    """Cause of its start as bits (``RESET_BY_PIN`` …); None for a board of version 1.0."""
    has_phases: bool = False
    can_compute: bool = False


class Done(Struct, frozen=True, gc=False):
    """A frame was sent."""

    dx_ticks: int
    tx_ticks: int


class TooLate(Struct, frozen=True, gc=False):
    """A frame was not sent."""

    dx_ticks: int
    reason: int


class Status(Struct, frozen=True):
    """The board's state and counts."""

    ticks: int
    configured: bool
    receiving: bool
    polled: bool
    """Whether the chip is polled because its interrupt line does not follow its events."""
    received: int
    errors: int
    sent: int
    late: int
    garbled: int
    unsent_records: int
    temperature_c: float | None
    supply_v: float | None


class NotDone(Struct, frozen=True):
    """The board has refused a command."""

    command: int
    reason: int
    start_step: int | None = None
    """Where the chip's start ended (``dw1000.h``); None if it started, or for a board of version 1.3."""
    identifier: int = 0
    """Of the chip, as it was read last."""


class Value(Struct, frozen=True):
    """What READ has read."""

    file: int
    sub: int
    differing: int
    """Readings that differed from the first, or from what was written."""
    data: bytes


class Test(Struct, frozen=True):
    """A record that tests the line; ``length`` as it was on the line."""

    length: int


class TagConfig(Struct, frozen=True):
    """The settings in use, and whether they are in flash."""

    settings: BoardSettings
    in_flash: bool


Record = Hello | Reception | Done | TooLate | Status | NotDone | Value | Test | TagConfig | TagReport
"""A reception has no time of the host yet."""


def decode(record: bytes) -> Record | str:
    """Decode a board's record (without its CRC), or return why it is invalid."""
    if record[0] not in _DECODERS:
        return "unknown-record"
    try:
        return _DECODERS[record[0]](record) or "malformed-record"
    except (struct.error, IndexError):
        return "malformed-record"  # it is too short


def start_failure(step: int, identifier: int) -> str:
    """Why a DW1000 did not start, in words: ``start_step`` of ``dw1000.h``, and the identifier that was read last."""
    if step == _NO_LOCK:
        return "the DW1000's clock does not lock: is its crystal or supply sound?"
    when = " at full speed" if step == _NO_FAST_ANSWER else ""
    return f"no DW1000{when}: its identifier is {DEVICE_ID:08X}, read was {identifier:08X}"


def to_steps(measured: Diagnostics) -> tuple[int, int, int]:
    """Received and first-path power and carrier offset, rounded to the link's units."""
    values = (measured.rx_power_dbm, measured.first_path_power_dbm, measured.carrier_offset_ppm)
    whole = [None if value is None else round(value * per_unit) for value, per_unit in zip(values, _STEPS, strict=True)]
    rx_power, first_path, offset = (NOT_MEASURED if n is None or abs(n) > _GREATEST else n for n in whole)
    return rx_power, first_path, offset


def from_steps(rx_power: int, first_path: int, offset: int) -> Diagnostics:
    """Measured values from the link's units."""
    return Diagnostics(
        *(_value(n, per_unit) for n, per_unit in zip((rx_power, first_path, offset), _STEPS, strict=True))
    )


def to_turn(phase_cycles: float) -> int:
    """A phase in the link's unit, 2**-16 turns, rounded."""
    return round(phase_cycles * _TURN) % _TURN


def cycles(phase: int) -> float:
    """A phase in cycles from the link's unit; exact."""
    return phase / _TURN


def _value(steps: int, per_unit: int) -> float | None:
    return None if steps == NOT_MEASURED else steps / per_unit


def _ticks(record: bytes, at: int = BODY_AT) -> int:
    return int.from_bytes(record[at : at + 5], "little")


def _hello(record: bytes) -> Hello:
    """Decode HELLO; only the version if the major number differs."""
    major, minor = record[2], record[3]
    if major != MAJOR:
        return Hello(major, minor, (0, 0, 0), b"", 0, 0, can_transmit=False, reset_cause=None)
    *firmware, device_id, rate_khz, bits, abilities = struct.unpack_from("<3B8sIBB", record, 4)
    can_transmit = bool(abilities & CAN_TRANSMIT)
    reset_cause = record[HELLO_BYTES] if len(record) > HELLO_BYTES else None
    return Hello(
        *(major, minor, tuple(firmware), device_id, rate_khz, bits, can_transmit, reset_cause),
        has_phases=bool(abilities & HAS_PHASES),
        can_compute=bool(abilities & CAN_COMPUTE),
    )


def _heard(record: bytes) -> Reception | None:
    if not 1 <= len(record) - RX_FRAME_AT <= MAX_FRAME_BYTES:
        return None
    measured = from_steps(*struct.unpack_from("<3h", record, 7))
    return Reception(record[RX_FRAME_AT:], _ticks(record), None, measured)


def _heard_with_phase(record: bytes) -> Reception | None:
    if not 1 <= len(record) - RX_PHASE_FRAME_AT <= MAX_FRAME_BYTES:
        return None
    *measured, phase = struct.unpack_from("<3hH", record, 7)
    return Reception(record[RX_PHASE_FRAME_AT:], _ticks(record), None, from_steps(*measured), cycles(phase))


def _done(record: bytes) -> Done | None:
    return Done(_ticks(record), _ticks(record, 7)) if len(record) >= 12 else None


def _status(record: bytes) -> Status:
    state, received, errors, sent, late, garbled, unsent, centidegrees, millivolts = struct.unpack_from(
        "<B6IhH", record, 7
    )
    supply_v = None if millivolts == NO_VOLTAGE else millivolts / 1000
    return Status(
        _ticks(record),
        bool(state & IS_CONFIGURED),
        bool(state & IS_RECEIVING),
        bool(state & IS_POLLED),
        *(received, errors, sent, late, garbled, unsent),
        _value(centidegrees, 100),
        supply_v,
    )


def _refused(record: bytes) -> NotDone:
    if record[2] == CONFIG and record[3] == REFUSED_RADIO and len(record) >= BODY_AT + 2 + 5:
        return NotDone(record[2], record[3], *struct.unpack_from("<BI", record, 4))
    return NotDone(record[2], record[3])


def _read_value(record: bytes) -> Value:
    file, sub, differing = struct.unpack_from("<BHH", record, BODY_AT)
    return Value(file, sub, differing, record[BODY_AT + 5 :])


def _tag_config(record: bytes) -> TagConfig | None:
    settings = unpack(record[SETTINGS_AT:])
    return None if settings is None else TagConfig(settings, bool(record[BODY_AT] & IN_FLASH))


_DECODERS: Final[dict[int, Callable[[bytes], Record | None]]] = {
    HELLO: _hello,
    RX: _heard,
    TX_DONE: _done,
    TX_LATE: lambda record: TooLate(_ticks(record), record[7]),
    STATUS: _status,
    REFUSED: _refused,
    RX_PHASE: _heard_with_phase,
    FIX: board_fix,
    TAG_STATUS: board_status,
    ANCHOR_PLACE: anchor_place,
    GEOREFERENCE: georeference,
    TAG_CONFIG: _tag_config,
    VALUE: _read_value,
    TEST: lambda record: Test(len(record) - BODY_AT + TEST_OVERHEAD),
}
