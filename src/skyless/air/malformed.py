"""Why a frame from the air is dropped: the names of the counters."""

from enum import StrEnum


class Malformed(StrEnum):
    """Reason why bytes are not a beacon of this version (``docs/protocol.md``, "What is dropped")."""

    TOO_SHORT = "too-short"
    """Shorter than any frame of IEEE 802.15.4, or a beacon that ends before its fixed part does."""
    TOO_LONG = "too-long"
    """Longer than the 127 bytes of a PSDU."""
    BAD_FCS = "bad-fcs"
    """The frame check sequence does not fit the bytes."""
    NOT_A_BEACON = "not-a-beacon"
    """An intact frame of somebody else's."""
    UNKNOWN_VERSION = "unknown-version"
    """A beacon of another version of the protocol."""
    BAD_FLAGS = "bad-flags"
    """A reserved flag is set."""
    BAD_LENGTH = "bad-length"
    """The length does not fit the flags and the number of relayed stamps."""
    BAD_HEARD = "bad-heard"
    """Stamps that cannot be: of the sender by itself, of the master in the wrong place, twice of one anchor."""
    BAD_PAGE = "bad-page"
    """A page of the almanac with a value out of all bounds."""
