"""Choice of the site that a tag uses, among those it receives."""

from typing import Annotated, Final

from skyless.core.air.neighbours import PRESENT_TICKS
from skyless.core.air.site_pages import MIN_ANCHORS
from skyless.core.native.records import MAX_COUNTED, MAX_SITES, Array, Integers, Record, Ticks, record
from skyless.core.ticks import from_seconds

SITE_SILENCE_TICKS: Final = from_seconds(2.0)
"""A tag that may choose its site leaves one that has been silent, or has given no fix, for this long."""

TRIAL_TICKS: Final = from_seconds(5.0)
"""A site that has given no fix for this long is left for another, whatever its number of anchors."""

FOREIGN, USED, CHANGED = range(3)
"""What a beacon's site is to the tag; with the last value it is in use from this beacon on."""

NO_SITE: Final = -1

SITE_MASK: Final = 0xFFFF
OF_PROTOCOL_1: Final = SITE_MASK + 1
"""Added to the identifier of a site of protocol 1, which is another one than a site of protocol 2."""


@record
class CountedAnchor(Record):
    """An anchor of a counted site."""

    anchor: int
    rx_ticks: Ticks
    """RX stamp of its last beacon."""


@record
class CountedSite(Record):
    """A site that is received."""

    site: int
    newest_ticks: Ticks
    """RX stamp of its last beacon."""
    count: int
    anchors: Annotated[Array[CountedAnchor], MAX_COUNTED]


@record
class SiteChoice(Record):
    """The site in use and, if the tag may choose, how many anchors of other sites it receives.

    The tag uses the first site that it receives, but until there are fixes one with more anchors, so that a single
    foreign anchor cannot hold it. A site without fixes gives way to others and returns only after those have failed.
    """

    only_site: int = NO_SITE
    """Configured site; ``NO_SITE`` if the tag may choose."""
    site: int = NO_SITE
    """The site in use: its PAN identifier, and ``OF_PROTOCOL_1``."""
    heard_ticks: Ticks
    """RX stamp of its last accepted beacon."""
    since_ticks: Ticks
    """RX stamp of the beacon at which it was chosen."""
    has_fix: bool
    fix_ticks: Ticks
    """RX stamp of the last fix."""
    failed_count: int
    failed: Annotated[Integers, MAX_SITES]
    """Sites left since the last fix because they gave none, newest last."""
    count: int
    sites: Annotated[Array[CountedSite], MAX_SITES]


def choose_site(choice: SiteChoice, site: int, anchor: int, rx_ticks: Ticks) -> int:
    """Count an anchor of a site. Return whether its beacon is to be used."""
    if choice.only_site not in (NO_SITE, site & SITE_MASK):
        return FOREIGN
    counted = _index_of(choice, site)
    choice.sites[counted].newest_ticks = rx_ticks
    _count_anchor(choice.sites[counted], anchor, rx_ticks)
    if site == choice.site:
        return USED
    if choice.site != NO_SITE:
        if not _prefers(choice, counted, rx_ticks):
            return FOREIGN
        if _has_failed(choice, rx_ticks):
            _note_failed(choice)
    choice.site, choice.has_fix = site, False
    choice.heard_ticks = choice.since_ticks = rx_ticks
    return CHANGED


def note_fix(choice: SiteChoice, rx_ticks: Ticks) -> None:
    """Note that the site in use has given a fix."""
    choice.has_fix, choice.fix_ticks, choice.failed_count = True, rx_ticks, 0


def restart_choice(choice: SiteChoice, rx_ticks: Ticks) -> None:
    """Restart all times after the tag's counter has restarted at this reading."""
    choice.heard_ticks = choice.since_ticks = rx_ticks
    choice.has_fix, choice.count = False, 0


def _find_site(choice: SiteChoice, site: int) -> int:
    for one in range(choice.count):
        if choice.sites[one].site == site:
            return one
    return -1


def _index_of(choice: SiteChoice, site: int) -> int:
    """Return a site's index; a new site may replace the one received longest ago, except the one in use."""
    found = _find_site(choice, site)
    if found < 0:
        found = choice.count
        if choice.count == MAX_SITES:
            found = 0 if choice.sites[0].site != choice.site else 1
            for one in range(MAX_SITES):
                is_older = choice.sites[one].newest_ticks < choice.sites[found].newest_ticks
                if is_older and choice.sites[one].site != choice.site:
                    found = one
        choice.count = max(choice.count, found + 1)
        choice.sites[found].site, choice.sites[found].count = site, 0
    return found


def _count_anchor(counted: CountedSite, anchor: int, rx_ticks: Ticks) -> None:
    """Note when an anchor was received; if there are too many, forget the one received longest ago."""
    place, oldest = -1, 0
    for one in range(counted.count):
        if counted.anchors[one].anchor == anchor:
            place = one
        if counted.anchors[one].rx_ticks < counted.anchors[oldest].rx_ticks:
            oldest = one
    if place < 0:
        place = counted.count if counted.count < MAX_COUNTED else oldest
        counted.count = max(counted.count, place + 1)
    counted.anchors[place].anchor, counted.anchors[place].rx_ticks = anchor, rx_ticks


def _prefers(choice: SiteChoice, other: int, rx_ticks: Ticks) -> bool:
    """Whether another site is better than the one in use."""
    if rx_ticks - choice.heard_ticks >= SITE_SILENCE_TICKS:
        return True
    if choice.has_fix and rx_ticks - choice.fix_ticks < SITE_SILENCE_TICKS:
        return False
    present = _received(choice, other, rx_ticks)
    if _has_failed(choice, rx_ticks):
        return present >= MIN_ANCHORS
    for one in range(choice.failed_count):
        if choice.failed[one] == choice.sites[other].site:
            return False
    used = _find_site(choice, choice.site)
    return present > (_received(choice, used, rx_ticks) if used >= 0 else 0)


def _has_failed(choice: SiteChoice, rx_ticks: Ticks) -> bool:
    """Whether the site in use has given no fix for too long."""
    return rx_ticks - (choice.fix_ticks if choice.has_fix else choice.since_ticks) >= TRIAL_TICKS


def _note_failed(choice: SiteChoice) -> None:
    """Note that the site in use has failed; if there are too many, forget the first."""
    if choice.failed_count == MAX_SITES:
        for one in range(1, MAX_SITES):
            choice.failed[one - 1] = choice.failed[one]
        choice.failed_count -= 1
    choice.failed[choice.failed_count] = choice.site
    choice.failed_count += 1


def _received(choice: SiteChoice, counted: int, rx_ticks: Ticks) -> int:
    """Return how many anchors of a site are being received."""
    one, present = choice.sites[counted], 0
    for index in range(one.count):
        if 0 <= rx_ticks - one.anchors[index].rx_ticks < PRESENT_TICKS:
            present += 1
    return present
