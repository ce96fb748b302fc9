"""A plain rectangular room with anchors along its walls, as a site to start from."""

from typing import Final

from skyless.site.model import AnchorSite, ScheduleSite, Site, TagsSite

_FROM_FLOOR_AND_CEILING_M: Final = 0.5


def room_site(width_m: float, depth_m: float, anchors: int, height_m: float, tag_height_m: float | None) -> Site:
    """A site of so many anchors, evenly along the walls of a room from its corner (0, 0) on.

    They alternate between half a metre above the floor and half a metre below the ceiling, so that heights can
    be estimated; with a known ``tag_height_m`` all hang below the ceiling.
    """
    high = round(max(height_m - _FROM_FLOOR_AND_CEILING_M, 0.0), 3)
    low = high if tag_height_m is not None else min(_FROM_FLOOR_AND_CEILING_M, high)
    places = [_along_walls(index / anchors, width_m, depth_m) for index in range(anchors)]
    return Site(
        name="room",
        id=1,
        master=1,
        anchors=tuple(
            AnchorSite(id=number, x_m=x, y_m=y, z_m=high if number % 2 else low)
            for number, (x, y) in enumerate(places, start=1)
        ),
        schedule=ScheduleSite(slot_s=2.5e-3),
        tags=TagsSite(height_m=tag_height_m),
    )


def _along_walls(share: float, width_m: float, depth_m: float) -> tuple[float, float]:
    """The point at a share of the way around the walls, to the millimetre."""
    way = share * 2 * (width_m + depth_m)
    if way <= width_m:
        x, y = way, 0.0
    elif way <= width_m + depth_m:
        x, y = width_m, way - width_m
    elif way <= 2 * width_m + depth_m:
        x, y = 2 * width_m + depth_m - way, depth_m
    else:
        x, y = 0.0, 2 * (width_m + depth_m) - way
    return round(x, 3), round(y, 3)
