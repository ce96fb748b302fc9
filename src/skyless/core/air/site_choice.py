"""Which site a tag uses, of those that it receives."""

from enum import Enum, auto
from typing import Final

from msgspec import Struct

from skyless.core.ticks import from_seconds

SITE_SILENCE_TICKS: Final = from_seconds(2.0)
"""A tag that may choose its site leaves one that has been silent, or has given no fix, for this time."""

TRIAL_TICKS: Final = from_seconds(5.0)
"""A site that has given no fix for this time is left for another one: none holds a tag by its number of anchors."""

MIN_ANCHORS: Final = 3
"""That other one has at least as many: with fewer there is no fix."""

PRESENT_TICKS: Final = from_seconds(1.0)
"""Anchors received within this time count."""

MAX_SITES: Final = 8
MAX_COUNTED: Final = 32
"""Largest number of anchors of one site that is counted."""


class SiteUse(Enum):
    """What a beacon's site is to the tag."""

    USED = auto()
    CHANGED = auto()
    """Used from this beacon on."""
    FOREIGN = auto()


class SiteChoice(Struct):
    """The site in use and, where the tag may choose, how many anchors of others it receives.

    It uses the first site that it receives, but until there are fixes one with more anchors, so that a single foreign
    anchor cannot hold it. One that gives no fix makes way for others, and returns only after those have failed.
    """

    only_site: int | None = None
    """The site that was configured; None where the tag may choose."""
    site: int | None = None
    """The site in use, by its PAN identifier."""
    heard_ticks: int = 0
    """RX stamp of the last beacon of it that was accepted."""
    since_ticks: int = 0
    """RX stamp of the beacon with which it was chosen."""
    fix_ticks: int | None = None
    """RX stamp of the last fix."""
    failed: tuple[int, ...] = ()
    """Sites that were left since the last fix as they gave none."""
    anchors: dict[int, dict[int, int]] = {}
    """RX stamp of the last beacon of each anchor, by site and anchor."""

    def on_beacon(self, site: int, anchor: int, rx_ticks: int) -> SiteUse:
        """Count an anchor of a site; whether its beacon is to be used."""
        if self.only_site is not None and site != self.only_site:
            return SiteUse.FOREIGN
        self._count(site, anchor, rx_ticks)
        if site == self.site:
            return SiteUse.USED
        if self.site is not None and not self._prefers(site, rx_ticks):
            return SiteUse.FOREIGN
        if self.site is not None and self._has_failed(rx_ticks):
            self.failed = (*self.failed, self.site)[-MAX_SITES:]
        self.site, self.heard_ticks, self.since_ticks, self.fix_ticks = site, rx_ticks, rx_ticks, None
        return SiteUse.CHANGED

    def on_fix(self, rx_ticks: int) -> None:
        """The site in use has given a fix."""
        self.fix_ticks, self.failed = rx_ticks, ()

    def restart(self, rx_ticks: int) -> None:
        """The tag's counter has restarted, and reads this."""
        self.heard_ticks = self.since_ticks = rx_ticks
        self.fix_ticks = None
        self.anchors = {}

    def _count(self, site: int, anchor: int, rx_ticks: int) -> None:
        if site not in self.anchors and len(self.anchors) >= MAX_SITES:
            others = [one for one in self.anchors if one != self.site]
            del self.anchors[min(others, key=lambda one: max(self.anchors[one].values()))]
        anchors = self.anchors.setdefault(site, {})
        anchors.pop(anchor, None)
        anchors[anchor] = rx_ticks
        if len(anchors) > MAX_COUNTED:
            del anchors[next(iter(anchors))]

    def _prefers(self, site: int, rx_ticks: int) -> bool:
        """Whether another site is better than the one in use."""
        assert self.site is not None
        if rx_ticks - self.heard_ticks >= SITE_SILENCE_TICKS:
            return True
        if self.fix_ticks is not None and rx_ticks - self.fix_ticks < SITE_SILENCE_TICKS:
            return False
        if self._has_failed(rx_ticks):
            return self._present(site, rx_ticks) >= MIN_ANCHORS
        return site not in self.failed and self._present(site, rx_ticks) > self._present(self.site, rx_ticks)

    def _has_failed(self, rx_ticks: int) -> bool:
        """Whether the site in use has given no fix for long."""
        latest = self.since_ticks if self.fix_ticks is None else self.fix_ticks
        return rx_ticks - latest >= TRIAL_TICKS

    def _present(self, site: int, rx_ticks: int) -> int:
        return sum(0 <= rx_ticks - last < PRESENT_TICKS for last in self.anchors.get(site, {}).values())
