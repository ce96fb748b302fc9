"""Site time of a tag's own counter, for the time stamps of its fixes.

A tag composes it as an anchor does, from three anchors in view, and keeps them for as long as they are in view.
"""

from collections import Counter
from typing import Final

from skyless.air.beacon2 import Beacon2
from skyless.clocks.composed_time import MOST_PARENTS, ComposedTime
from skyless.clocks.filter import ClockNoise
from skyless.constants import TICK_S
from skyless.site.slots import Schedule

KEPT_S: Final = 2.0
"""An anchor that was silent for longer is replaced."""


class TagTime:
    """Own counter to site time; distances come from the tag's own fixes."""

    def __init__(self, noise: ClockNoise, variance_m2: float, schedule: Schedule, counters: Counter[str]) -> None:
        """``variance_m2`` of a TX and an RX stamp and of a distance together."""
        self._time = ComposedTime(noise, variance_m2, schedule, counters)
        self._last_ticks: dict[int, int] = {}

    def on_beacon(self, beacon: Beacon2, rx_ticks_tag: int, range_m: float) -> bool:
        """Process a beacon with a site time, received at an unwrapped own reading; False where it changes nothing."""
        if beacon.slot_time is None or beacon.site_time is None:
            return False
        self._last_ticks = {
            anchor: ticks for anchor, ticks in self._last_ticks.items() if (rx_ticks_tag - ticks) * TICK_S < KEPT_S
        }
        if beacon.anchor in self._last_ticks or len(self._last_ticks) < MOST_PARENTS:
            self._last_ticks[beacon.anchor] = rx_ticks_tag
        if set(self._time.parents) != set(self._last_ticks):
            self._time.set_parents(self._last_ticks)
        return self._time.on_beacon(
            beacon.anchor, beacon.tx_ticks, rx_ticks_tag, range_m, beacon.slot_time, beacon.site_time
        )

    def restart(self) -> None:
        """Forget the site time, as the anchors follow another root from now on."""
        self._time.restart()

    def at(self, ticks_tag: int) -> tuple[int, float] | None:
        """Site time of an own reading in 1/256 tick, and its variance in m²; None before it is known."""
        if not self._time.is_settled(ticks_tag):
            return None
        return self._time.subticks(ticks_tag), self._time.variance_m2(ticks_tag)
