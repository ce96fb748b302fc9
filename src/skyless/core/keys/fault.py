"""Why a beacon is not accepted, or an anchor sends without a code."""

from enum import StrEnum
from typing import Final


class Fault(StrEnum):
    """Values of counters and reports."""

    NO_CODE = "no-code"
    """The frame carries no authentication."""
    BAD_CODE = "bad-code"
    """The code does not match these bytes: the frame was forged or altered, or its anchor has a wrong seed."""
    REVOKED_CHAIN = "revoked-chain"
    """Its anchor uses a key chain that the site has replaced."""
    LATE = "late-frame"
    """Keys of its interval may have been disclosed when it arrived: it was delayed or repeated, or a clock is wrong."""
    EARLY = "early-frame"
    """Its interval has not begun."""
    REPEATED = "repeated-frame"
    """The same frame was received before."""
    FIRST = "first-frame"
    """The first genuine frame of its anchor: a second one has to confirm its time of arrival."""
    NO_KEY = "no-key"
    """The key of its interval did not arrive in time."""
    TOO_MANY = "too-many-frames"
    """More frames are waiting for keys than a radio can receive."""
    NO_TIME = "no-time"
    """The anchor's host has not stated the time yet."""
    NO_CHAIN = "no-chain"
    """The anchor has no valid key chain: none has begun, or the last has ended."""
    CLOCK_WRONG = "clock-wrong"
    """The host's clock differs from those of the site's anchors."""


NOT_FORGED: Final = (Fault.NO_KEY, Fault.FIRST)
"""Faults of frames that may be genuine."""
