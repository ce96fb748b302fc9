"""What a listener knows of the site's time: between which bounds it lies, and whether its own clock is right."""

from collections import deque
from typing import Final

from msgspec import Struct

from skyless.authentication.certificate import ChainTiming
from skyless.authentication.key_chain import SECTION_BITS, SECTION_INTERVALS
from skyless.constants import TICK_S

DRIFT: Final = 50e-6
"""How much the own counter's rate may be off."""

RECENT_KEYS: Final = 10
"""Of this number of keys the one that came soonest after its disclosure shows how far the host's clock is off."""

RESTART_S: Final = 1.0
"""A counter that goes back farther has restarted."""


class SiteClock(Struct):
    """Bounds of the site's time in Unix seconds.

    They come from the host's clock and its stated bound. Once a key has been verified they are carried on by the own
    counter, and the host's clock narrows them. One that is set back does no harm. One that is ahead of the upper bound
    counts, as a bound that is too early would let forged frames pass.
    """

    bound_s: float
    """How far the host's clock may be from the clocks of anchors."""
    lower_s: float = 0.0
    upper_s: float = 0.0
    rx_ticks: int | None = None
    """Own counter, unwrapped, to which they refer."""
    is_verified: bool = False
    """Whether a key has been verified since the counter started."""
    is_late: bool = False
    """Whether a verified key showed that the site's time is beyond the upper bound: nothing can be verified then."""
    host_s: float = 0.0
    """The host's clock at the last frame."""
    section_offset_s: float = 0.0
    """The host's clock less the beginning of the section of the last certificate, where it is not near that."""
    offsets_s: deque[float] = deque()
    """The host's clock less the disclosure of recent keys, at their first reception."""

    def advance(self, rx_ticks: int, unix_s: float) -> None:
        """A frame was received: own counter, unwrapped, and the host's clock."""
        self.host_s = unix_s
        low, high = unix_s - self.bound_s, unix_s + self.bound_s
        before = self.rx_ticks
        elapsed_s = 0.0 if before is None else (rx_ticks - before) * TICK_S
        if before is None or not self.is_verified or elapsed_s < -RESTART_S:
            self.lower_s, self.upper_s, self.is_verified = low, high, False
        elif elapsed_s >= 0.0:
            self.lower_s += elapsed_s * (1.0 - DRIFT)
            self.upper_s += elapsed_s * (1.0 + DRIFT)
            if (
                low > self.upper_s
            ):  # the counter, or the host's monotonic clock, stood still, or the host's clock is wrong
                self.lower_s, self.upper_s, self.is_verified = low, high, False
            elif high >= self.lower_s:
                self.lower_s, self.upper_s = max(self.lower_s, low), min(self.upper_s, high)
        else:
            return  # out of order
        self.rx_ticks = rx_ticks

    def on_key(self, interval: int, timing: ChainTiming) -> None:
        """A key was verified for the first time: the site's time is at least that of its disclosure."""
        disclosed_s = timing.start_s(interval + timing.lag)
        self.offsets_s.append(self.host_s - disclosed_s)
        if len(self.offsets_s) > RECENT_KEYS:
            self.offsets_s.popleft()
        if disclosed_s > self.upper_s:
            self.is_late, self.is_verified = True, False
            return
        self.is_late, self.is_verified = False, True
        self.lower_s = max(self.lower_s, disclosed_s)

    def on_section(self, section: int, timing: ChainTiming) -> None:
        """A certificate was received that anchors send during this section or the one before it."""
        offset_s = self.host_s - timing.start_s(section << SECTION_BITS)
        length_s = SECTION_INTERVALS * timing.interval_s
        self.section_offset_s = 0.0 if -length_s - self.bound_s <= offset_s <= length_s + self.bound_s else offset_s

    @property
    def present_s(self) -> float:
        """The middle of the bounds."""
        return 0.5 * (self.lower_s + self.upper_s)

    @property
    def error_s(self) -> float | None:
        """How far the host's clock is from the site's time where that is more than the bound: positive if it is ahead.

        Where it is ahead frames may be late as well: somebody may have delayed them. None where all is well, or nothing
        is known.
        """
        if not self.is_verified and self.section_offset_s:
            return self.section_offset_s
        if not self.offsets_s:
            return None
        offset_s = min(self.offsets_s)
        return offset_s if abs(offset_s) > self.bound_s else None
