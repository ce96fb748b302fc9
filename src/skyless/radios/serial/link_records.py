"""Records of the serial link as values, and the rounding of measured values to the link's units."""

import struct
from typing import Final

from msgspec import Struct

from skyless.air.reception import Diagnostics
from skyless.radios.serial import link

_STEPS: Final = (100, 100, 1000)
"""Units of powers and carrier offset: steps per dB and per ppm."""
_GREATEST: Final = 0x7FFF


class Hello(Struct, frozen=True):
    """The board's version and abilities."""

    major: int
    minor: int
    firmware: tuple[int, int, int]
    device_id: bytes
    rate_khz: int
    counter_bits: int
    can_transmit: bool
    reset_cause: int | None
    """Why it has started, as bits (``link.RESET_BY_PIN`` …); None for a board of version 1.0."""


class Heard(Struct, frozen=True, gc=False):
    """A frame that the board received."""

    rx_ticks: int
    diagnostics: Diagnostics
    frame: bytes


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


Record = Hello | Heard | Done | TooLate | Status | NotDone


def decode(record: bytes) -> Record | str:
    """Value of a record from a board (without its CRC), or why there is none."""
    try:
        decoder = _DECODERS[record[0]]
    except KeyError:
        return "unknown-record"
    return decoder(record) or "malformed-record"


def to_steps(measured: Diagnostics) -> tuple[int, int, int]:
    """Received and first-path power and carrier offset, rounded to the link's units."""
    values = (measured.rx_power_dbm, measured.first_path_power_dbm, measured.carrier_offset_ppm)
    whole = [None if value is None else round(value * per_unit) for value, per_unit in zip(values, _STEPS, strict=True)]
    rx_power, first_path, offset = (link.NOT_MEASURED if n is None or abs(n) > _GREATEST else n for n in whole)
    return rx_power, first_path, offset


def from_steps(rx_power: int, first_path: int, offset: int) -> Diagnostics:
    """The measured values of a record in the link's units."""
    return Diagnostics(
        *(_value(n, per_unit) for n, per_unit in zip((rx_power, first_path, offset), _STEPS, strict=True))
    )


def _value(steps: int, per_unit: int) -> float | None:
    return None if steps == link.NOT_MEASURED else steps / per_unit


def _ticks(record: bytes, at: int = link.BODY_AT) -> int:
    return int.from_bytes(record[at : at + 5], "little")


def _hello(record: bytes) -> Hello | None:
    """Of another major version only the version is known."""
    if len(record) < link.BODY_AT + 2:
        return None
    major, minor = record[2], record[3]
    if major != link.MAJOR:
        return Hello(major, minor, (0, 0, 0), b"", 0, 0, can_transmit=False, reset_cause=None)
    if len(record) < link.HELLO_BYTES:
        return None
    *firmware, device_id, rate_khz, bits, abilities = struct.unpack_from("<3B8sIBB", record, 4)
    can_transmit = bool(abilities & link.CAN_TRANSMIT)
    reset_cause = record[link.HELLO_BYTES] if len(record) > link.HELLO_BYTES else None
    return Hello(major, minor, tuple(firmware), device_id, rate_khz, bits, can_transmit, reset_cause)


def _heard(record: bytes) -> Heard | None:
    if not 1 <= len(record) - link.RX_FRAME_AT <= link.MAX_FRAME_BYTES:
        return None
    return Heard(_ticks(record), from_steps(*struct.unpack_from("<3h", record, 7)), record[link.RX_FRAME_AT :])


def _done(record: bytes) -> Done | None:
    return Done(_ticks(record), _ticks(record, 7)) if len(record) >= 12 else None


def _late(record: bytes) -> TooLate | None:
    return TooLate(_ticks(record), record[7]) if len(record) >= 8 else None


def _status(record: bytes) -> Status | None:
    if len(record) < link.STATUS_BYTES:
        return None
    state, received, errors, sent, late, garbled, unsent, centidegrees, millivolts = struct.unpack_from(
        "<B6IhH", record, 7
    )
    supply_v = None if millivolts == link.NO_VOLTAGE else millivolts / 1000
    return Status(
        _ticks(record),
        bool(state & link.IS_CONFIGURED),
        bool(state & link.IS_RECEIVING),
        bool(state & link.IS_POLLED),
        *(received, errors, sent, late, garbled, unsent),
        _value(centidegrees, 100),
        supply_v,
    )


def _refused(record: bytes) -> NotDone | None:
    return NotDone(record[2], record[3]) if len(record) >= 4 else None


_DECODERS: Final = {
    link.HELLO: _hello,
    link.RX: _heard,
    link.TX_DONE: _done,
    link.TX_LATE: _late,
    link.STATUS: _status,
    link.REFUSED: _refused,
}
