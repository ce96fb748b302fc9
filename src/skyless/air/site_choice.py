"""Which site a tag uses, of those that it receives."""

from enum import Enum, auto
from typing import Final

from msgspec import Struct

from skyless.ticks import from_seconds

SITE_SILENCE_TICKS: Final = from_seconds(2.0)
"""A tag that may choose its site leaves one that has been silent, or has given no fix, for this time."""

TRIAL_TICKS: Final = from_seconds(5.0)
"""A site that has given no fix for this time is left for another one: none holds a tag by its number of anchors."""

LEAST_ANCHORS: Final = 3
"""That other one has at least as many: with fewer there is no fix."""

PRESENT_TICKS: Final = from_seconds(1.0)
"""Anchors received within this time count."""

MOST_SITES: Final = 8
MOST_COUNTED: Final = 32
"""Of one site, as far as they are counted."""


class SiteKey(Struct, frozen=True, gc=False):
    """A site on the air."""

    site: int
    """PAN identifier."""
    version: int
    """Of the protocol: anchors of two versions do not make one site."""


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
    key: SiteKey | None = None
    """The site in use."""
    heard_ticks: int = 0
    """RX stamp of the last beacon of it that was accepted."""
    since_ticks: int = 0
    """RX stamp of the beacon with which it was chosen."""
    fix_ticks: int | None = None
    """RX stamp of the last fix."""
    failed: tuple[int, ...] = ()
    """Sites, each as a number, that were left since the last fix as they gave none."""
    anchors: dict[int, dict[int, int]] = {}
    """RX stamp of the last beacon of each anchor, by site and version in one number and anchor."""

    def on_beacon(self, key: SiteKey, anchor: int, rx_ticks: int) -> SiteUse:
        """Count an anchor of a site; whether its beacon is to be used."""
        if self.only_site is not None and key.site != self.only_site:
            return SiteUse.FOREIGN
        self._count(key, anchor, rx_ticks)
        if key == self.key:
            return SiteUse.USED
        if self.key is not None and not self._prefers(key, rx_ticks):
            return SiteUse.FOREIGN
        if self.key is not None and self._has_failed(rx_ticks):
            self.failed = (*self.failed, _number(self.key))[-MOST_SITES:]
        self.key, self.heard_ticks, self.since_ticks, self.fix_ticks = key, rx_ticks, rx_ticks, None
        return SiteUse.CHANGED

    def on_fix(self, rx_ticks: int) -> None:
        """The site in use has given a fix."""
        self.fix_ticks, self.failed = rx_ticks, ()

    def restart(self, rx_ticks: int) -> None:
        """The tag's counter has restarted, and reads this."""
        self.heard_ticks = self.since_ticks = rx_ticks
        self.fix_ticks = None
        self.anchors = {}

    def _count(self, key: SiteKey, anchor: int, rx_ticks: int) -> None:
        number = _number(key)
        if number not in self.anchors and len(self.anchors) >= MOST_SITES:
            others = [one for one in self.anchors if self.key is None or one != _number(self.key)]
            del self.anchors[min(others, key=lambda one: max(self.anchors[one].values()))]
        anchors = self.anchors.setdefault(number, {})
        anchors.pop(anchor, None)
        anchors[anchor] = rx_ticks
        if len(anchors) > MOST_COUNTED:
            del anchors[next(iter(anchors))]

    def _prefers(self, key: SiteKey, rx_ticks: int) -> bool:
        """Whether another site is better than the one in use."""
        assert self.key is not None
        if rx_ticks - self.heard_ticks >= SITE_SILENCE_TICKS:
            return True
        if self.fix_ticks is not None and rx_ticks - self.fix_ticks < SITE_SILENCE_TICKS:
            return False
        if self._has_failed(rx_ticks):
            return self._present(key, rx_ticks) >= LEAST_ANCHORS
        return _number(key) not in self.failed and self._present(key, rx_ticks) > self._present(self.key, rx_ticks)

    def _has_failed(self, rx_ticks: int) -> bool:
        """Whether the site in use has given no fix for long."""
        latest = self.since_ticks if self.fix_ticks is None else self.fix_ticks
        return rx_ticks - latest >= TRIAL_TICKS

    def _present(self, key: SiteKey, rx_ticks: int) -> int:
        return sum(0 <= rx_ticks - last < PRESENT_TICKS for last in self.anchors.get(_number(key), {}).values())


def _number(key: SiteKey) -> int:
    return key.site << 8 | key.version
