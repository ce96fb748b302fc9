"""Frames of either version of the protocol."""

from typing import Final

from skyless.air.beacon import Beacon, Malformed
from skyless.air.beacon2 import Beacon2
from skyless.air.codec import decode_cached
from skyless.air.codec2 import VERSION_2, decode_2_cached

AnyBeacon = Beacon | Beacon2

_MAGIC_AT: Final = slice(9, 11)
_VERSION_2_BYTES: Final = VERSION_2.to_bytes(2, "little")


def decode_any(frame: bytes) -> AnyBeacon | Malformed:
    """Return the beacon in a whole frame (FCS included), or why there is none; never raises.

    The last 256 frames of each version are remembered, for a program that runs many tags which receive the same bytes.
    """
    return decode_2_cached(frame) if frame[_MAGIC_AT] == _VERSION_2_BYTES else decode_cached(frame)
