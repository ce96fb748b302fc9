"""What a survey changes in a site: a short name, by which programs see whether they mean the same, and how much."""

import math
from hashlib import sha256
from typing import Final

import msgspec

from skyless.constants import TICK_M
from skyless.site.model import AnchorSite, Site, UnplacedAnchor

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


def largest_change_m(one: Site, other: Site) -> float:
    """The largest displacement of an anchor between two sites, or change of one of its delays as a distance.

    Both have the same anchors. One that has a position in the second site alone has an infinite change.
    """
    others = {anchor.id: anchor for anchor in other.all_anchors}
    return max(max(_changes_m(anchor, others[anchor.id])) for anchor in one.all_anchors)


def _changes_m(one: AnchorSite | UnplacedAnchor, other: AnchorSite | UnplacedAnchor) -> tuple[float, float, float]:
    moved_m = 0.0
    if isinstance(other, AnchorSite):
        moved_m = math.inf
        if isinstance(one, AnchorSite):
            moved_m = math.dist((one.x_m, one.y_m, one.z_m), (other.x_m, other.y_m, other.z_m))
    return (
        moved_m,
        abs(other.tx_antenna_delay_ticks - one.tx_antenna_delay_ticks) * TICK_M,
        abs(other.rx_antenna_delay_ticks - one.rx_antenna_delay_ticks) * TICK_M,
    )


def _frame_of(site: Site) -> object:
    slots = sorted((anchor.id, anchor.slot) for anchor in site.all_anchors)
    return (
        site.id,
        site.schedule,
        slots,
        (site.master, [one.id for one in site.anchors]) if site.schedule.needs_master else None,
    )
