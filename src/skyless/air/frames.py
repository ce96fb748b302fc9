"""Frames of either version of the protocol."""

from functools import lru_cache
from typing import Final

from skyless.air.beacon import Beacon, Malformed
from skyless.air.beacon2 import Beacon2
from skyless.air.codec import decode
from skyless.air.codec2 import VERSION_2, decode_2

AnyBeacon = Beacon | Beacon2

_MAGIC_AT: Final = slice(9, 11)
_VERSION_2_BYTES: Final = VERSION_2.to_bytes(2, "little")


@lru_cache(maxsize=256)
def decode_any(frame: bytes) -> AnyBeacon | Malformed:
    """Return the beacon in a whole frame (FCS included), or why there is none; never raises.

    Remembers the last 256 frames, for a program that runs many tags which receive the same bytes.
    """
    return decode_2(frame) if frame[_MAGIC_AT] == _VERSION_2_BYTES else decode(frame)
