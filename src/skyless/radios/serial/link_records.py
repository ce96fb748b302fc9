"""Records of the serial link as values; what is rounded to the line's units is rounded here, for all who ask."""

from typing import Final

from msgspec import Struct

from skyless.air.reception import Diagnostics
from skyless.firmware import link

POWER_STEPS_PER_DB: Final = 100
OFFSET_STEPS_PER_PPM: Final = 1000
_GREATEST: Final = 0x7FFF


class Hello(Struct, frozen=True):
    """Who the board is."""

    major: int
    minor: int
    firmware: tuple[int, int, int]
    device_id: bytes
    rate_khz: int
    counter_bits: int
    can_transmit: bool


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
    """How the board does."""

    ticks: int
    configured: bool
    receiving: bool
    received: int
    errors: int
    sent: int
    late: int
    garbled: int
    unsent_records: int
    temperature_c: float | None
    supply_v: float | None


class NotDone(Struct, frozen=True):
    """The board does not follow a command."""

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


def quantised(diagnostics: Diagnostics) -> Diagnostics:
    """What is left of measured values after the serial link."""
    powers = (diagnostics.rx_power_dbm, diagnostics.first_path_power_dbm)
    rx_power, first_path = (_value(to_steps(power, POWER_STEPS_PER_DB), POWER_STEPS_PER_DB) for power in powers)
    offset = to_steps(diagnostics.carrier_offset_ppm, OFFSET_STEPS_PER_PPM)
    return Diagnostics(rx_power, first_path, _value(offset, OFFSET_STEPS_PER_PPM))


def to_steps(value: float | None, steps: int) -> int:
    """A measured value in the line's units; ``NOT_MEASURED`` for none and for what does not fit."""
    whole = None if value is None else round(value * steps)
    return link.NOT_MEASURED if whole is None or abs(whole) > _GREATEST else whole


def _value(steps: int, per_unit: int) -> float | None:
    return None if steps == link.NOT_MEASURED else steps / per_unit


def _signed(record: bytes, at: int) -> int:
    return int.from_bytes(record[at : at + 2], "little", signed=True)


def _ticks(record: bytes, at: int = link.BODY_AT) -> int:
    return int.from_bytes(record[at : at + 5], "little")


def _hello(record: bytes) -> Hello | None:
    """Of another major version only the version is known."""
    if len(record) < link.BODY_AT + 2:
        return None
    major, minor = record[2], record[3]
    if major != link.MAJOR:
        return Hello(major, minor, (0, 0, 0), b"", 0, 0, can_transmit=False)
    if len(record) < link.HELLO_BYTES:
        return None
    firmware = (record[4], record[5], record[6])
    rate_khz = int.from_bytes(record[15:19], "little")
    return Hello(major, minor, firmware, record[7:15], rate_khz, record[19], bool(record[20] & link.CAN_TRANSMIT))


def _heard(record: bytes) -> Heard | None:
    if not 1 <= len(record) - link.RX_FRAME_AT <= link.MAX_FRAME_BYTES:
        return None
    powers = [_value(_signed(record, at), POWER_STEPS_PER_DB) for at in (7, 9)]
    offset_ppm = _value(_signed(record, 11), OFFSET_STEPS_PER_PPM)
    return Heard(_ticks(record), Diagnostics(powers[0], powers[1], offset_ppm), record[link.RX_FRAME_AT :])


def _done(record: bytes) -> Done | None:
    return Done(_ticks(record), _ticks(record, 7)) if len(record) >= 12 else None


def _late(record: bytes) -> TooLate | None:
    return TooLate(_ticks(record), record[7]) if len(record) >= 8 else None


def _status(record: bytes) -> Status | None:
    if len(record) < link.STATUS_BYTES:
        return None
    received, errors, sent, late, garbled, unsent = (
        int.from_bytes(record[at : at + 4], "little") for at in range(8, 32, 4)
    )
    millivolts = int.from_bytes(record[34:36], "little")
    return Status(
        ticks=_ticks(record),
        configured=bool(record[7] & link.IS_CONFIGURED),
        receiving=bool(record[7] & link.IS_RECEIVING),
        received=received,
        errors=errors,
        sent=sent,
        late=late,
        garbled=garbled,
        unsent_records=unsent,
        temperature_c=_value(_signed(record, 32), 100),
        supply_v=None if millivolts == link.NO_VOLTAGE else millivolts / 1000,
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
