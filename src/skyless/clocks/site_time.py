"""The site's time on a master's counter: an affine map in integers, so that nothing is lost however long it runs."""

from typing import Final

from msgspec import Struct

SUBTICKS: Final = 256
"""Parts of a tick that beacons tell."""

_RATE_BITS: Final = 64


class SiteTime(Struct, frozen=True):
    """Own counter to site time and back, exact to 1/256 tick at any distance (``docs/maths.md`` section 6)."""

    epoch_own_ticks: int
    epoch_subticks: int
    """Site time at that reading, in 1/256 tick."""
    subticks_per_tick: int
    """Site time that passes in one own tick, in 2⁻⁶⁴ of 1/256 tick."""

    def subticks(self, ticks_own: int) -> int:
        """Site time of an own reading, in 1/256 tick, both unwrapped."""
        return self.epoch_subticks + ((ticks_own - self.epoch_own_ticks) * self.subticks_per_tick >> _RATE_BITS)

    def ticks_own(self, ticks_site: int) -> int:
        """Nearest own reading of a site time in whole ticks."""
        elapsed = (ticks_site * SUBTICKS - self.epoch_subticks) << _RATE_BITS
        return self.epoch_own_ticks + (elapsed + self.subticks_per_tick // 2) // self.subticks_per_tick

    @property
    def rate(self) -> float:
        """Fractional rate of the own counter against the site's time."""
        return (SUBTICKS << _RATE_BITS) / self.subticks_per_tick - 1.0


def own_counter() -> SiteTime:
    """Return the time of a site that its first master starts: the master's own counter."""
    return SiteTime(0, 0, SUBTICKS << _RATE_BITS)


def continued(ticks_own: int, ticks_site: int, fraction_ticks: float, rate: float) -> SiteTime:
    """Return the map that goes on from a reading and the site time known for it; ``rate`` is the own clock's."""
    subticks_per_tick = int(SUBTICKS / (1.0 + rate) * 2.0**_RATE_BITS)
    return SiteTime(ticks_own, ticks_site * SUBTICKS + round(fraction_ticks * SUBTICKS), subticks_per_tick)
