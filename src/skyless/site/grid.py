"""A large site to start from: anchors on a square grid under one ceiling, without a master."""

from typing import Final

import numpy as np
from msgspec.structs import replace

from skyless.site.advice import anchors_in_reach, best_offered_hz
from skyless.site.check import ANY_ADDRESS
from skyless.site.model import AnchorSite, ScheduleMode, ScheduleSite, Site, TagsSite
from skyless.site.slot_colours import with_slots

_SLOT_S: Final = 1e-3
"""Shorter than of a site with a master: with 2.1 ms anchors at random instants would reach a tag more often."""

_FARTHEST_M: Final = 8388.0
"""From the origin, along each axis, that an anchor can state."""


def grid_site(
    width_m: float,
    depth_m: float,
    spacing_m: float,
    height_m: float,
    tag_height_m: float | None = None,
    mode: ScheduleMode = "slots",
) -> Site:
    """A hall from the corner (0, 0) on, its anchors on a square grid, half a spacing or so from the walls.

    In mode slots they have their slots, in mode free the rate that gives tags most beacons. A side too long for
    positions on the air is centred on the origin.

    Raises:
        ValueError: there are more anchors than identifiers.
        SlotShortageError: a superframe has not enough slots for the anchors that are near each other.
    """
    count = _along(width_m, spacing_m) * _along(depth_m, spacing_m)
    if count > ANY_ADDRESS:
        raise ValueError(f"{count} anchors are too many: a site has identifiers for {ANY_ADDRESS}")
    x_m, y_m = _coordinates(width_m, spacing_m), _coordinates(depth_m, spacing_m)
    points = [(x, y) for x in x_m for y in y_m]
    site = Site(
        name="grid",
        id=1,
        master=1,
        anchors=tuple(
            AnchorSite(id=number, x_m=x, y_m=y, z_m=height_m) for number, (x, y) in enumerate(points, start=1)
        ),
        schedule=ScheduleSite(mode=mode, slot_s=_SLOT_S),
        tags=TagsSite(height_m=tag_height_m),
    )
    if mode == "slots":
        return with_slots(site)
    rate_hz = best_offered_hz() / float(np.median(anchors_in_reach(site)))
    return replace(site, schedule=replace(site.schedule, rate_hz=float(np.clip(round(rate_hz), 1.0, 200.0))))


def _along(length_m: float, spacing_m: float) -> int:
    return max(1, round(length_m / spacing_m))


def _coordinates(length_m: float, spacing_m: float) -> list[float]:
    """Coordinates along one side, to the millimetre, as far from one end as from the other."""
    count = _along(length_m, spacing_m)
    first_m = (length_m - (count - 1) * spacing_m) / 2.0
    origin_m = 0.0 if length_m <= _FARTHEST_M else length_m / 2.0
    return [round(first_m + number * spacing_m - origin_m, 3) for number in range(count)]
