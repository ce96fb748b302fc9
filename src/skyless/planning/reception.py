"""How the anchors of a site with a master receive it, by the link budget; and which of them should be the master."""

from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.kernels.arrays import Integers, Mask, Matrix, Vector
from skyless.planning.anchor_clocks import anchor_clocks
from skyless.planning.links import anchor_links, link_budget, masters_by_links
from skyless.simulation.channel import ChannelModel, pack_walls
from skyless.site.model import Site
from skyless.site.near import anchor_positions

_RELIABLE: Final = 0.9
"""An anchor should receive at least this share of the master's frames; a tenth less hardly matters to its clock."""

_MOST_NAMED: Final = 8
"""Anchors named in one warning."""


class MasterReception(Struct, frozen=True):
    """How the anchors of a site, in the order of its file, receive their master; shape (anchors,) each."""

    distance_m: Vector
    """From the master."""
    share: Vector
    """Share of its frames that arrives; 1 for the master itself."""
    sends: Mask
    """Those whose clock is known well enough to send."""


def reception_of(site: Site, channel: ChannelModel) -> MasterReception:
    """Predict how the anchors receive their master, with the losses of the site's walls."""
    anchors_m, master = anchor_positions(site), _row_of_master(site)
    share = anchor_links(anchors_m, master, link_budget(channel), pack_walls(site.walls)).share
    return MasterReception(
        np.linalg.norm(anchors_m - anchors_m[master], axis=1), share, anchor_clocks(site, share).sends
    )


def with_best_master(site: Site, channel: ChannelModel) -> Site:
    """The same site with the master that the others receive best; of equals that in the middle."""
    best = _masters(site, channel)[0]
    return replace(site, master=site.anchors[best].id)


def master_warnings(site: Site, channel: ChannelModel) -> list[str]:
    """Anchors that receive the master badly have a poor clock, or none and stay silent; a better master, if any."""
    found = reception_of(site, channel)
    poor = found.share < _RELIABLE
    warnings = [
        text
        for text in (
            _named(site, found, np.flatnonzero(~found.sends), "stay silent", "stays silent"),
            _named(
                site, found, np.flatnonzero(found.sends & poor), "follow its clock badly", "follows its clock badly"
            ),
        )
        if text
    ]
    if not warnings:
        return []
    best = int(_masters(site, channel)[0])
    other = replace(site, master=site.anchors[best].id)
    left = int((reception_of(other, channel).share < _RELIABLE).sum())
    if left < int(poor.sum()):
        receive = f"all would receive {_RELIABLE:.0%} or more" if left == 0 else f"{left} would receive it that badly"
        warnings[0] += f"; with anchor {other.master} as the master {receive}"
    return warnings


def _named(site: Site, found: MasterReception, rows: Integers, do: str, does: str) -> str:
    """One sentence for all anchors that do the same, each with its share, the worst first."""
    if len(rows) == 0:
        return ""
    rows = rows[np.argsort(found.share[rows].round(2), kind="stable")]
    first = rows[0]
    if len(rows) == 1:
        where = f"{found.distance_m[first]:.0f} m from the master"
        return f"anchor {site.anchors[first].id}, {where}, receives {found.share[first]:.0%} of its frames and {does}"
    each = [f"{site.anchors[row].id} ({found.share[row]:.0%})" for row in rows[:_MOST_NAMED]]
    more = f" and {len(rows) - _MOST_NAMED} more" if len(rows) > _MOST_NAMED else ""
    nearest_m = float(found.distance_m[rows].min())
    listed = ", ".join(each) + more
    return f"anchors {listed}, {nearest_m:.0f} m or more from the master, receive this share of its frames and {do}"


def _masters(site: Site, channel: ChannelModel) -> Integers:
    anchors_m: Matrix = anchor_positions(site)
    return masters_by_links(anchors_m, link_budget(channel), pack_walls(site.walls))


def _row_of_master(site: Site) -> int:
    return [anchor.id for anchor in site.anchors].index(site.master)
