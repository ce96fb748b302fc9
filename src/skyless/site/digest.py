"""A short name for what a survey changes in a site, by which programs see whether they mean the same."""

from hashlib import sha256
from typing import Final

import msgspec

from skyless.site.model import AnchorSite, Site

_DIGITS: Final = 16


def site_digest(site: Site) -> str:
    """16 hexadecimal digits that depend on the site's name and number, and on its anchors, and on nothing else.

    Of the anchors their identifiers, positions, slots and antenna delays count, whatever their order.
    """
    anchors = [
        (
            anchor.id,
            (anchor.x_m, anchor.y_m, anchor.z_m) if isinstance(anchor, AnchorSite) else None,
            anchor.slot,
            anchor.tx_antenna_delay_ticks,
            anchor.rx_antenna_delay_ticks,
        )
        for anchor in sorted(site.all_anchors, key=lambda one: one.id)
    ]
    return sha256(msgspec.json.encode((site.name, site.id, anchors))).hexdigest()[:_DIGITS]


def is_same_but_placed(one: Site, other: Site) -> bool:
    """Whether two sites have the same number, anchors, slots and schedule, so that only positions and delays differ."""
    return _frame_of(one) == _frame_of(other)


def _frame_of(site: Site) -> object:
    slots = sorted((anchor.id, anchor.slot) for anchor in site.all_anchors)
    return (
        site.id,
        site.schedule,
        slots,
        (site.master, [one.id for one in site.anchors]) if site.schedule.needs_master else None,
    )
