"""Why a beacon is not accepted, or an anchor sends without a code."""

from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass


class Fault(StrEnum):
    """The values are what counters and reports show."""

    NO_CODE = "no-code"
    """The frame carries no authentication."""
    BAD_CODE = "bad-code"
    """The code is not that of these bytes: the frame was forged or altered, or its anchor has a wrong seed."""
    REVOKED_CHAIN = "revoked-chain"
    """Its anchor uses a key chain that the site has replaced."""
    LATE = "late-frame"
    """Keys of its interval may have been disclosed when it came: it was delayed or repeated, or a clock is wrong."""
    EARLY = "early-frame"
    """Its interval has not begun."""
    REPEATED = "repeated-frame"
    """The same frame was received before."""
    FIRST = "first-frame"
    """The first genuine frame of its anchor: another one has to agree with when it came."""
    NO_KEY = "no-key"
    """The key of its interval did not come in time."""
    TOO_MANY = "too-many-frames"
    """More frames wait for their keys than a radio can receive."""
    NO_TIME = "no-time"
    """The anchor's host has not stated the time yet."""
    NO_CHAIN = "no-chain"
    """The anchor has no key chain for the present: none has begun, or the last has ended."""
    CLOCK_WRONG = "clock-wrong"
    """The clock of the host is not that of the site's anchors."""
