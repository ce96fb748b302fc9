"""Lines of the uwb-apps listener (Mynewt): one JSON object for each frame, as it was received.

Used keys: ``ts`` (RX stamp), ``rssi`` (dBm), ``d`` (the whole PSDU, hexadecimal) and ``dlen``, its length.
"""

from typing import Final

import msgspec

from skyless.air.codec import MAX_FRAME_BYTES
from skyless.air.reception import Diagnostics, Reception
from skyless.recordings.source import Drops
from skyless.ticks import wrap


class _Line(msgspec.Struct):
    """What a line must hold; further keys are of no interest."""

    ts: int
    dlen: int
    d: str
    rssi: float | None = None


_decode: Final = msgspec.json.Decoder(_Line).decode


def reception_of(line: bytes, host_s: float, drops: Drops) -> Reception | None:
    """Reception of a line that arrived then; None, and a count, for what is none."""
    if not line:
        return None
    try:
        told = _decode(line)
        frame = bytes.fromhex(told.d)
    except (msgspec.MsgspecError, ValueError):
        drops["malformed-line"] += 1
        return None
    if len(frame) != told.dlen or not 1 <= len(frame) <= MAX_FRAME_BYTES:
        drops["wrong-length"] += 1
        return None
    if told.ts < 0:
        drops["impossible-stamp"] += 1
        return None
    return Reception(frame, wrap(told.ts), host_s, Diagnostics(rx_power_dbm=told.rssi))
