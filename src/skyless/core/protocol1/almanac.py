"""A site's almanac in protocol 1: its pages, which of them each frame carries, and their assembly by a listener."""

from functools import lru_cache
from typing import Final
from zlib import crc32

from msgspec.structs import asdict

from skyless.core.air.almanac import (
    AccuracyPage,
    AnchorPage,
    GeoreferencePage,
    KeyPage,
    NoisePage,
    Page,
    SchedulePage,
    SitePage,
)
from skyless.core.air.site_pages import encode_page
from skyless.core.pages import filter_pages_of, georeference_page_of
from skyless.core.protocol1.beacon import first_slots, schedule_of
from skyless.core.site import AccuracySite, Site

_CONFIRMATIONS: Final = 2
"""A frame corrupted on the air passes its FCS once in 65,536 times; the same error twice in a row is not expected."""

_MAX_ANCHORS: Final = 255
"""Most anchors of a site; forged pages beyond that use no memory."""

_ASSUMED_ACCURACY: Final = AccuracyPage(**asdict(AccuracySite()))


def pages_of(site: Site) -> tuple[Page, ...]:
    """Return all pages of a validated site: schedule, noise, accuracy, anchors in the order of the file, georeference.

    Raises ValueError: two anchors would share a slot (see ``first_slots``).
    """
    schedule, slots, earth = schedule_of(site), first_slots(site), georeference_page_of(site)
    pages: list[Page] = [
        SchedulePage(
            schedule.slot_ticks,
            schedule.slots,
            schedule.frames_per_node,
            site.master,
            len(site.anchors),
            site.tags.height_m,
        ),
        *filter_pages_of(site),
    ]
    pages += [AnchorPage(node.id, node.x_m, node.y_m, node.z_m, slots[node.id]) for node in site.anchors]
    return (*pages,) if earth is None else (*pages, earth)


def page_for(pages: tuple[Page, ...], superframe: int, slot: int) -> Page:
    """Return the page that the frame in a slot of a superframe carries; ``pages`` must not be empty.

    The rotation has a prime number P of positions, the first pages filling those beyond the last. A slot moves on by
    one position each superframe, and the next slot is ahead by about P/1.618 positions. As P is prime, a tag that
    hears one slot in every k-th superframe (k no multiple of P) hears all positions in P receptions, and any P slots
    in a row carry all positions; the golden ratio distributes the slots of one superframe evenly, whichever are heard.
    """
    positions, stride = _rotation(len(pages))
    return pages[(superframe + stride * slot) % positions % len(pages)]


def almanac_issue(pages: tuple[Page, ...]) -> int:
    """An 8-bit checksum of the contents of all pages.

    A changed almanac has the same issue once in 256 times; then pages replace each other one by one
    (``AlmanacAssembly``).
    """
    folded = crc32(b"".join(map(encode_page, pages)))
    folded ^= folded >> 16
    return (folded ^ folded >> 8) & 0xFF


@lru_cache
def _rotation(pages: int) -> tuple[int, int]:
    """Number of positions, the least prime not below ``pages``, and the step from slot to slot."""
    positions = max(pages, 2)
    while any(positions % divisor == 0 for divisor in range(2, int(positions**0.5) + 1)):
        positions += 1
    return positions, round(positions * (5**0.5 - 1) / 2)


class AlmanacAssembly:
    """Collects the pages of one site from its beacons.

    Contradictions must be received twice. A new issue replaces all pages once two consecutive frames carry it. A page
    that differs from the one held under the same issue replaces it once it was received twice without another page of
    its key in between. So one corrupt frame that passed its FCS cannot do lasting harm.
    """

    def __init__(self) -> None:
        self.issue: int | None = None
        """Issue of the almanac held; None before the first beacon."""
        self._next_issue: int | None = None
        self._next_frames = 0
        self._next_pages: list[Page] = []
        self._clear()

    def _clear(self) -> None:
        self._pages: dict[object, Page] = {}
        self._unconfirmed: dict[object, Page] = {}
        self.anchors_m: dict[int, tuple[float, float, float]] = {}
        """Position of each anchor known so far: another dict whenever one changes, never changed in place."""
        self.schedule: SchedulePage | None = None
        self.noise: NoisePage | None = None
        self.accuracy = _ASSUMED_ACCURACY
        """How good survey and ranges are. Some sites never send it."""
        self.georeference: GeoreferencePage | None = None

    def slot_of(self, anchor: int | None) -> int | None:
        """First slot of an anchor, once its page was received."""
        page = self._pages.get(anchor)
        return page.slot if isinstance(page, AnchorPage) else None

    @property
    def complete(self) -> bool:
        """Whether schedule, noise and all anchors are known."""
        schedule = self.schedule
        return schedule is not None and self.noise is not None and len(self.anchors_m) >= schedule.anchors

    def add_page(self, issue: int, page: Page | None) -> bool:
        """Process the issue and the page (if any) of a beacon. Returns True if the almanac changed."""
        if issue != self.issue:
            if self.issue is not None:
                return self._add_to_next_issue(issue, page)
            self.issue = issue
        self._next_issue = None
        if page is None:
            return False
        key = page.anchor if type(page) is AnchorPage else type(page)  # as _page_key does, here for every beacon
        if self._pages.get(key) is page and not self._unconfirmed:  # pages come from a cache, so mostly the very same
            return False
        return self._add(key, page)

    def _add_to_next_issue(self, issue: int, page: Page | None) -> bool:
        if issue != self._next_issue:
            self._next_issue, self._next_frames, self._next_pages = issue, 0, []
        self._next_frames += 1
        if page is not None:
            self._next_pages.append(page)
        if self._next_frames < _CONFIRMATIONS:
            return False
        self._clear()
        self.issue, self._next_issue = issue, None
        for next_page in self._next_pages:
            self._add(_page_key(next_page), next_page)
        return True

    def _add(self, key: object, page: Page) -> bool:
        if isinstance(page, SitePage | KeyPage):  # of protocol 2
            return False
        held = self._pages.get(key)
        if held == page:
            if self._unconfirmed:
                self._unconfirmed.pop(key, None)
            return False
        if held is not None and self._unconfirmed.get(key) != page:
            self._unconfirmed[key] = page
            return False
        if held is None and isinstance(page, AnchorPage) and len(self.anchors_m) >= _MAX_ANCHORS:
            return False
        self._unconfirmed.pop(key, None)
        self._pages[key] = page
        match page:
            case AnchorPage():
                self.anchors_m = self.anchors_m | {page.anchor: (page.x_m, page.y_m, page.z_m)}
            case SchedulePage():
                self.schedule = page
            case NoisePage():
                self.noise = page
            case AccuracyPage():
                self.accuracy = page
            case GeoreferencePage():
                self.georeference = page
        return True


def _page_key(page: Page) -> object:
    """Key of a page: another page of the same key replaces it."""
    return page.anchor if type(page) is AnchorPage else type(page)
