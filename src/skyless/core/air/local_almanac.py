"""Protocol 2: the pages that are common to a site, and what a tag knows of anchors and pages as Python has them."""

from collections.abc import Iterable
from zlib import crc32

from msgspec import Struct
from msgspec.structs import asdict

from skyless.core.air.almanac import AccuracyPage, GeoreferencePage, NoisePage, Page, SitePage
from skyless.core.air.beacon import StatedPosition
from skyless.core.air.neighbours import Neighbours, StatedPlace
from skyless.core.air.page_codec import decode_page, encode_page
from skyless.core.air.site_pages import NO_ISSUE, SitePages
from skyless.core.native.records import first
from skyless.core.site import AnchorSite, Site


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


class LocalAlmanac:
    """What a tag has learned of a site of protocol 2."""

    def __init__(self, site_pages: SitePages, neighbours: Neighbours) -> None:
        """The site's pages, and the anchors with what each states of itself, which go on changing."""
        self._site_pages, self._neighbours = site_pages, neighbours

    @property
    def issue(self) -> int | None:
        """Issue of the pages in use."""
        return None if self._site_pages.issue == NO_ISSUE else self._site_pages.issue

    @property
    def pages(self) -> CommonPages | None:
        """The pages in use, None until they are complete."""
        if self._site_pages.issue == NO_ISSUE:
            return None
        noise, earth, accuracy, site = (decode_page(bytes(one.contents)) for one in self._site_pages.used)
        return CommonPages(site, noise, accuracy, earth)  # type: ignore[arg-type]  # in the order of their types

    def points_m(self) -> dict[int, tuple[float, float, float]]:
        """Position of each anchor that has stated one."""
        rows = first(self._neighbours.rows, self._neighbours.count)
        return {row.anchor: _point_m(row.place) for row in rows if row.has_place}


def _point_m(place: StatedPlace) -> tuple[float, float, float]:
    """The position that an anchor states."""
    x_m, y_m, z_m = (one_mm / 1000 for one_mm in place.position_mm)
    return x_m, y_m, z_m
