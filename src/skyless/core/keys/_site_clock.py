"""What a listener knows of the site's time: how late it may be, and whether its own clock is right."""

import math
from collections import deque
from typing import Final

from msgspec import Struct

from skyless.core.constants import TICK_S
from skyless.core.keys.key_chain import SECTION_BITS, SECTION_INTERVALS, ChainTiming

DRIFT: Final = 50e-6
"""How much the own counter's rate may be off."""

KEY_WAIT_INTERVALS: Final = 2
"""The newest key is known to have been disclosed within this number of intervals, by the quickest of those before."""

RECENT_KEYS: Final = 10
"""Number of recent keys. The quickest of them after its disclosure shows how far the host's clock is off."""

AHEAD_S: Final = 1.0
"""A host's clock that is farther ahead of the lower bound has been set; without keys that bound loses 0.2 s an hour."""

RESTART_S: Final = 1.0
"""A counter that goes back farther has restarted."""


class SiteClock(Struct):
    """Bounds of the site's time, which is that of the anchor whose clock is furthest ahead, in Unix seconds.

    Only keys prove a lower bound, which the own counter carries on. The upper bound comes from the host's clock and
    its stated bound. A host's clock that is set or dragged back lowers it no farther than to shortly after the lower
    bound. One that is ahead raises it for as long as it is ahead: then frames are refused as late, and nothing of that
    remains afterwards.
    """

    bound_s: float
    """How far the host's clock may be off."""
    lower_s: float = -math.inf
    """Lower bound; none before the first key, and after a restart of the counter."""
    rx_ticks: int | None = None
    """Own counter, unwrapped, to which the lower bound refers."""
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
        elapsed_s = 0.0 if self.rx_ticks is None else (rx_ticks - self.rx_ticks) * TICK_S
        if elapsed_s < -RESTART_S:
            self.lower_s = -math.inf
        elif elapsed_s < 0.0:
            return  # out of order
        self.lower_s += elapsed_s * (1.0 - DRIFT)
        self.rx_ticks = rx_ticks

    def upper_s(self, timing: ChainTiming) -> float:
        """Upper bound of the site's time."""
        return max(self.upper_at(self.host_s, timing), self.lower_s + KEY_WAIT_INTERVALS * timing.interval_s)

    def upper_at(self, unix_s: float, timing: ChainTiming) -> float:
        """Upper bound that follows from the host's clock alone, when it showed this."""
        return unix_s + self.bound_s + timing.anchor_lead_s

    def on_key(self, interval: int, timing: ChainTiming) -> None:
        """A key was verified for the first time: the site's time is at least that of its disclosure."""
        disclosed_s = timing.start_s(interval + timing.lag)
        self.offsets_s.append(self.host_s - disclosed_s)
        if len(self.offsets_s) > RECENT_KEYS:
            self.offsets_s.popleft()
        self.is_late = disclosed_s > self.upper_s(timing)
        if not self.is_late:
            self.lower_s = max(self.lower_s, disclosed_s)

    def on_section(self, section: int, timing: ChainTiming) -> None:
        """A certificate was received that anchors send during this section or the one before it."""
        offset_s = self.host_s - timing.start_s(section << SECTION_BITS)
        length_s = SECTION_INTERVALS * timing.interval_s
        self.section_offset_s = 0.0 if -length_s - self.bound_s <= offset_s <= length_s + self.bound_s else offset_s

    @property
    def is_verified(self) -> bool:
        """Whether a key has been verified since the counter started."""
        return self.lower_s > -math.inf

    @property
    def present_s(self) -> float:
        """The host's clock, but no earlier than the lower bound."""
        return max(self.host_s, self.lower_s)

    @property
    def error_s(self) -> float | None:
        """How far the host's clock is from the site's time where that is more than the bound: positive if it is ahead.

        Where it is ahead frames may be late as well: somebody may have delayed them. None where all is well, or nothing
        is known.
        """
        if not self.is_verified and self.section_offset_s:
            return self.section_offset_s
        ahead_s = self.host_s - self.lower_s
        if self.is_verified and ahead_s > self.bound_s + AHEAD_S:
            return ahead_s
        if not self.offsets_s:
            return None
        offset_s = min(self.offsets_s)
        return offset_s if abs(offset_s) > self.bound_s else None
