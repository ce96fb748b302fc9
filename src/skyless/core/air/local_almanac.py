"""Protocol 2: the pages that are common to a site, and what a tag knows of anchors and pages from beacons alone."""

from collections.abc import Iterable
from itertools import islice, product
from typing import Annotated, Final
from zlib import crc32

from msgspec import Meta, Struct
from msgspec.structs import asdict

from skyless.core.air.almanac import AccuracyPage, GeoreferencePage, KeyPage, NoisePage, Page, SitePage
from skyless.core.air.beacon import StatedPosition
from skyless.core.air.frame import Malformed
from skyless.core.air.instants import period_ticks
from skyless.core.air.neighbours import Neighbour, Neighbours, StatedPlace
from skyless.core.air.page_check import PAGE_BYTES
from skyless.core.air.page_codec import decode_page, encode_page
from skyless.core.native.records import first
from skyless.core.site import AnchorSite, Site
from skyless.core.ticks import from_seconds

PRESENT_TICKS: Final = from_seconds(1.0)
"""Anchors received within this time take part in the majority."""

MIN_ANCHORS: Final = 3
"""With fewer no majority counts, unless that is all that a tag receives for ``PRESENT_TICKS``."""

MAX_ISSUES: Final = 4
MAX_ISSUE_PAGES: Final = 4
"""Contents of a page of one type that are kept in one issue."""

_MAX_TRIALS: Final = 256


def site_pages_of(site: Site) -> tuple[Page, ...]:
    """Return the pages of a validated site of protocol 2, in the order of their types on the air."""
    filters, earth = filter_pages_of(site), georeference_page_of(site)
    others: list[Page] = [filters[0], *([] if earth is None else [earth]), filters[1]]
    return (*others, SitePage(len(others) + 1, site.tags.height_m))


def filter_pages_of(site: Site) -> tuple[NoisePage, AccuracyPage]:
    """The pages for the filters of the site's tags."""
    noise = site.noise
    return (
        NoisePage(noise.tx_stamp_ps * 1e-12, noise.rx_stamp_ps * 1e-12, noise.white_fm, noise.random_walk_fm),
        AccuracyPage(**asdict(site.accuracy)),
    )


def georeference_page_of(site: Site) -> GeoreferencePage | None:
    """The page with the site's position on the Earth, None where that is not known."""
    earth = site.georeference
    if earth is None:
        return None
    return GeoreferencePage(earth.latitude_deg, earth.longitude_deg, earth.height_m, earth.heading_deg % 360.0)


def stated_position(site: Site, anchor: AnchorSite) -> StatedPosition:
    """What an anchor of a site states of its position."""
    std_m = site.accuracy.survey_std_m if anchor.std_m is None else anchor.std_m
    return StatedPosition(anchor.x_m, anchor.y_m, anchor.z_m, std_m, anchor.floor, anchor.zone)


def site_page_for(pages: tuple[Page, ...], sequence: int, anchor: int) -> Page:
    """Return the page that a frame carries: an anchor's successive frames carry one after the other."""
    return pages[(sequence + anchor) % len(pages)]


def site_issue(pages: Iterable[Page]) -> int:
    """Return 16 bits that depend on the contents of all pages and on nothing else."""
    checksum = crc32(b"".join(sorted(map(encode_page, pages))))
    return (checksum ^ checksum >> 16) & 0xFFFF


class CommonPages(Struct, frozen=True):
    """The pages of a site, complete."""

    site: SitePage
    noise: NoisePage
    accuracy: AccuracyPage
    georeference: GeoreferencePage | None = None


class CollectedPage(Struct, frozen=True):
    """A page of an issue that is not complete yet."""

    issue: int
    page: Annotated[bytes, Meta(min_length=PAGE_BYTES, max_length=PAGE_BYTES)]
    anchors: tuple[int, ...]
    """Those that have sent it."""


class LocalAlmanacState(Struct, frozen=True):
    """What a ``LocalAlmanac`` holds."""

    first_ticks: int | None
    issue: int | None
    pages: CommonPages | None
    collected: tuple[CollectedPage, ...]


class LocalAlmanac:
    """What a tag has learned of a site of protocol 2.

    An anchor's own beacons state its position. The common pages count once a majority of the anchors received recently
    states their issue, and they fit it; those in use stay until all pages of another such issue are there.
    """

    def __init__(self, neighbours: Neighbours) -> None:
        """``neighbours``: the anchors, with what each states of itself."""
        self.pages: CommonPages | None = None
        """None until they are complete."""
        self.issue: int | None = None
        """Issue of the pages in use."""
        self._neighbours = neighbours
        self._first_ticks: int | None = None
        self._contents: dict[int, dict[type[Page], dict[Page, set[int]]]] = {}
        """For each issue the pages received, and from which anchors."""

    def state(self) -> LocalAlmanacState:
        """All that it holds, but for the anchors."""
        collected = tuple(
            CollectedPage(issue, encode_page(page), tuple(sorted(anchors)))
            for issue, by_type in self._contents.items()
            for contents in by_type.values()
            for page, anchors in contents.items()
        )
        return LocalAlmanacState(self._first_ticks, self.issue, self.pages, collected)

    def restore(self, state: LocalAlmanacState) -> None:
        """Continue from a state.

        Raises:
            ValueError: it holds something that is not a page.
        """
        self._first_ticks, self.issue, self.pages = state.first_ticks, state.issue, state.pages
        for one in state.collected:
            page = decode_page(one.page)
            if page is None or isinstance(page, Malformed):
                raise ValueError("a page of the almanac is damaged")
            for anchor in one.anchors:
                self._collect(anchor, one.issue, page)

    @property
    def newest(self) -> Neighbour:
        """The anchor whose beacon is processed."""
        return self._neighbours.rows[self._neighbours.row]

    @property
    def rows(self) -> list[Neighbour]:
        """All anchors, also those that are only relayed."""
        return first(self._neighbours.rows, self._neighbours.count)

    def points_m(self) -> dict[int, tuple[float, float, float]]:
        """Position of each anchor that has stated one."""
        return {row.anchor: point_m(row.place) for row in self.rows if row.has_place}

    def placed_since(self, rx_ticks: int) -> set[int]:
        """Anchors with a position that were received later than this, and by other anchors, too."""
        return {row.anchor for row in self.rows if row.has_place and row.was_relayed and row.rx_ticks > rx_ticks}

    def longest_period_ticks(self) -> int:
        """Longest mean time between two beacons of an anchor, of the anchors that were received last."""
        stated = [row for row in self.rows if row.frames > 0]
        oldest_ticks = max((row.rx_ticks for row in stated), default=0) - PRESENT_TICKS
        return max((period_ticks(row.period_code) for row in stated if row.rx_ticks >= oldest_ticks), default=0)

    def forget_times(self) -> None:
        """The tag's counter has restarted."""
        self._first_ticks = None

    def on_beacon(self, page: Page | None, rx_ticks: int) -> bool:
        """Process the page in the beacon of the newest anchor; whether other common pages are in use from now on."""
        if self._first_ticks is None:
            self._first_ticks = rx_ticks
        sender = self.newest
        issue = sender.almanac_issue
        if issue == self.issue:
            return False
        if page is not None and not isinstance(page, KeyPage):
            self._collect(sender.anchor, issue, page)
        return self._is_majority(issue, rx_ticks) and self._complete(issue)

    def _collect(self, anchor: int, issue: int, page: Page) -> None:
        if issue not in self._contents and len(self._contents) >= MAX_ISSUES:
            del self._contents[min(self._contents, key=self._issue_support)]
        contents = self._contents.setdefault(issue, {}).setdefault(type(page), {})
        if page not in contents and len(contents) >= MAX_ISSUE_PAGES:
            del contents[min(contents, key=lambda one: self._page_support(contents[one]))]
        contents.setdefault(page, set()).add(anchor)

    def _issue_support(self, issue: int) -> int:
        """By how many anchors an issue is stated, of those that others have received: strangers are any number."""
        return sum(row.was_relayed and row.almanac_issue == issue for row in self.rows)

    def _page_support(self, anchors: set[int]) -> int:
        """How many of the anchors that have sent a page others have received."""
        return sum(row.was_relayed and row.anchor in anchors for row in self.rows)

    def _is_majority(self, issue: int, rx_ticks: int) -> bool:
        """Whether most of the anchors that are there state this issue."""
        assert self._first_ticks is not None
        oldest = rx_ticks - PRESENT_TICKS
        present = [row.almanac_issue for row in self.rows if row.was_relayed and row.rx_ticks > oldest]
        enough = len(present) >= MIN_ANCHORS or (present and self._first_ticks <= oldest)
        return bool(enough) and 2 * present.count(issue) > len(present)

    def _complete(self, issue: int) -> bool:
        """Use the pages of an issue if they are all there; of several contents those of most anchors that fit it."""
        by_type = self._contents.get(issue, {})
        ranked = [
            sorted(by, key=lambda page, by=by: -self._page_support(by[page]))  # type: ignore[misc]
            for by in by_type.values()
        ]
        for pages in islice(product(*ranked), _MAX_TRIALS):
            found = _common_pages(pages)
            if found is not None and site_issue(pages) == issue:
                self.issue, self.pages, self._contents = issue, found, {}
                return True
        return False


def _common_pages(pages: tuple[Page, ...]) -> CommonPages | None:
    """The pages of a site, None where one is missing."""
    by_type = {type(page): page for page in pages}
    match by_type.get(SitePage), by_type.get(NoisePage), by_type.get(AccuracyPage), by_type.get(GeoreferencePage):
        case SitePage() as site, NoisePage() as noise, AccuracyPage() as accuracy, (GeoreferencePage() | None) as earth:
            return CommonPages(site, noise, accuracy, earth) if site.pages == len(pages) else None
        case _:
            return None


def point_m(place: StatedPlace) -> tuple[float, float, float]:
    """The position that an anchor states."""
    x_m, y_m, z_m = (one_mm / 1000 for one_mm in place.position_mm)
    return x_m, y_m, z_m
