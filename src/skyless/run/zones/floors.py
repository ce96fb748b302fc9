"""On which floor of a site a tag is."""

from typing import Final

from skyless.core.site import FloorSite

_MARGIN_SIGMAS: Final = 3.0
_MIN_MARGIN_M: Final = 0.1


def floor_at(floors: tuple[FloorSite, ...], z_m: float, std_m: float, before: int | None) -> int | None:
    """The number of the floor at a height, whose standard deviation is given; None at a site without floors.

    A tag stays on the floor where it was before until it is beyond the boundary by the margin, so that noise on a
    ladder or a stair changes nothing. The margin is at most a third of the height between two floors.
    """
    if not floors:
        return None
    row = max((index for index, floor in enumerate(floors) if floor.low_m <= z_m), default=0)
    rows = {floor.number: index for index, floor in enumerate(floors)}
    if before not in rows or abs(row - rows[before]) != 1:
        return floors[row].number
    low, high = sorted((row, rows[before]))
    boundary_m = floors[high].low_m
    margin_m = min(max(_MIN_MARGIN_M, _MARGIN_SIGMAS * std_m), (boundary_m - floors[low].low_m) / 3.0)
    return before if abs(z_m - boundary_m) < margin_m else floors[row].number
