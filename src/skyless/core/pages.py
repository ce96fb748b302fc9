"""The pages of a site, as its anchors send them."""

from msgspec.structs import asdict

from skyless.core.air.almanac import AccuracyPage, GeoreferencePage, NoisePage, Page, SitePage
from skyless.core.air.beacon import StatedPosition
from skyless.core.site import AnchorSite, Site


def site_pages_of(site: Site) -> tuple[Page, ...]:
    """The pages of a validated site of protocol 2, in the order of their types on the air."""
    filters, earth = filter_pages_of(site), georeference_page_of(site)
    others: list[Page] = [filters[0], *([] if earth is None else [earth]), filters[1]]
    return (*others, SitePage(len(others) + 1, site.tags.height_m))


def filter_pages_of(site: Site) -> tuple[NoisePage, AccuracyPage]:
    """The pages for the filters of tags."""
    noise = site.noise
    return (
        NoisePage(noise.tx_stamp_ps * 1e-12, noise.rx_stamp_ps * 1e-12, noise.white_fm, noise.random_walk_fm),
        AccuracyPage(**asdict(site.accuracy)),
    )


def georeference_page_of(site: Site) -> GeoreferencePage | None:
    """The page with the site's position on the Earth; None if unknown."""
    earth = site.georeference
    if earth is None:
        return None
    return GeoreferencePage(earth.latitude_deg, earth.longitude_deg, earth.height_m, earth.heading_deg % 360.0)


def stated_position(site: Site, anchor: AnchorSite) -> StatedPosition:
    """The position that an anchor of a site states."""
    std_m = site.accuracy.survey_std_m if anchor.std_m is None else anchor.std_m
    return StatedPosition(anchor.x_m, anchor.y_m, anchor.z_m, std_m, anchor.floor, anchor.zone)


def site_page_for(pages: tuple[Page, ...], sequence: int, anchor: int) -> Page:
    """The page that a frame carries: an anchor's successive frames cycle through them."""
    return pages[(sequence + anchor) % len(pages)]
