"""Which page of the almanac flies in which frame."""

from functools import lru_cache
from zlib import crc32

from msgspec.structs import asdict

from skyless.air.almanac import AccuracyPage, AnchorPage, GeoreferencePage, NoisePage, Page, SchedulePage
from skyless.air.page_codec import encode_page
from skyless.site.model import Site
from skyless.site.slots import first_slots, schedule_of


def pages_of(site: Site) -> tuple[Page, ...]:
    """Return all pages of a validated site: schedule, noise, accuracy, anchors in the order of the file, georeference.

    Raises:
        ValueError: two anchors would share a slot (see ``first_slots``).
    """
    schedule, slots, earth = schedule_of(site), first_slots(site), site.georeference
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
    if earth is not None:
        heading_deg = earth.heading_deg % 360.0
        pages.append(GeoreferencePage(earth.latitude_deg, earth.longitude_deg, earth.height_m, heading_deg))
    return tuple(pages)


def filter_pages_of(site: Site) -> tuple[NoisePage, AccuracyPage]:
    """What the site tells the filters of its tags."""
    noise = site.noise
    return (
        NoisePage(noise.tx_stamp_ps * 1e-12, noise.rx_stamp_ps * 1e-12, noise.white_fm, noise.random_walk_fm),
        AccuracyPage(**asdict(site.accuracy)),
    )


def page_for(pages: tuple[Page, ...], superframe: int, slot: int) -> Page:
    """Return the page that flies in a slot of a superframe; ``pages`` must not be empty.

    The rotation has a prime number P of positions, the first pages filling those beyond the last. A slot moves on by
    one position each superframe, and the next slot is ahead by about P/1.618 positions. As P is prime, a tag that
    hears one slot in every k-th superframe (k no multiple of P) hears all positions in P receptions, and any P slots
    in a row carry all positions; the golden ratio spreads the slots of one superframe evenly, whichever are heard.
    """
    positions, stride = _rotation(len(pages))
    return pages[(superframe + stride * slot) % positions % len(pages)]


def almanac_issue(pages: tuple[Page, ...]) -> int:
    """Return 8 bits that depend on the contents of all pages and on nothing else.

    A changed almanac keeps its issue once in 256 times; then pages replace each other one by one (``AlmanacAssembly``).
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
