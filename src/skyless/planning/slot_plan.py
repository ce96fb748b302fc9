"""The plan of a site of protocol 2: who shares a slot, how often each sends, and what reaches tags."""

import math
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.kernels.arrays import Array, Integers, Matrix, Vector
from skyless.planning.floor import Floor
from skyless.planning.links import range_of
from skyless.planning.maps import Grid, grid_of
from skyless.planning.tag_rates import TagRates, tag_rates
from skyless.simulation.channel import ChannelModel
from skyless.site.advice import anchors_in_reach, best_offered_hz, warnings_of
from skyless.site.model import Site
from skyless.site.near import anchor_positions, pairs_within_groups
from skyless.site.slots import beacon_period_s

FEWEST_ANCHORS: Final = 5
"""With fewer in the worst twentieth of the positions a plan warns: one more than a position with its height needs."""

_ENOUGH_ANCHORS: Final = 7
_POINTS: Final = 3000
_PLASTIC: Final = np.array([0.7548776662, 0.5698402910])
"""Multiples of these, modulo 1, fill a square evenly."""

_WORST_SHARE: Final = 5.0


class Distribution(Struct, frozen=True):
    """A quantity over the region's positions."""

    median: float
    worst_5_percent: float
    """What all but the worst twentieth of the positions have at least."""
    least: float


class Reception(Struct, frozen=True):
    """What tags receive over the region."""

    beacons_per_s: Distribution
    anchors_in_reach: Distribution
    """If one anchor sent at a time."""
    anchors_received: Distribution
    """With all that are on the air at once."""
    beacons_per_s_if_free: float
    """Median in mode free at its best rate."""


class RateMap(Struct, frozen=True):
    """Beacons per second at one point of each cell of a grid."""

    grid: Grid
    beacons_per_s: Array
    """Shape (heights, ny, nx); NaN outside the outline."""
    reception: Reception


def rate_map(
    site: Site, floor: Floor, heights_m: tuple[float, ...], step_m: float | None, channel: ChannelModel, exponent: float
) -> RateMap:
    """Return what reaches tags over the region; without a step, at some three thousand points.

    Raises:
        ValueError: the region has no area or no point inside the outline, or there would be too many points.
    """
    grid = grid_of(floor, heights_m, step_m or _step_m(floor, len(heights_m)))
    flat = _points_in_cells(grid)
    points = np.concatenate([np.column_stack([flat, np.full(len(flat), height)]) for height in grid.heights_m])
    rates = tag_rates(site, points, channel, exponent)
    free = tag_rates(_free(site), points, channel, exponent)
    values = np.full((len(grid.heights_m), *grid.within.shape), np.nan)
    values[:, grid.within] = rates.beacons_per_s.reshape(len(grid.heights_m), -1)
    return RateMap(grid, values, _reception(rates, float(np.median(free.beacons_per_s))))


def _step_m(floor: Floor, heights: int) -> float:
    x1, y1, x2, y2 = floor.region_m
    return math.sqrt(max((x2 - x1) * (y2 - y1), 1e-6) * heights / _POINTS)


def _points_in_cells(grid: Grid) -> Matrix:
    """A point in each cell within the outline, shape (m, 2), each elsewhere in its cell.

    On the cells' centres a grid of anchors would be met at the same few positions between its anchors only.
    """
    centres = np.stack(np.meshgrid(grid.x_m, grid.y_m), axis=-1)[grid.within]
    shares = np.arange(1, len(centres) + 1)[:, None] * _PLASTIC % 1.0 - 0.5
    cell_m = [np.diff(axis_m).min(initial=grid.step_m) for axis_m in (grid.x_m, grid.y_m)]
    points: Matrix = centres + shares * cell_m
    return points


def _free(site: Site) -> Site:
    """The same anchors in mode free, at the rate that gives tags most."""
    rate_hz = best_offered_hz() / float(np.median(anchors_in_reach(site)))
    return replace(site, schedule=replace(site.schedule, mode="free", rate_hz=min(max(rate_hz, 1.0), 200.0)))


def _reception(rates: TagRates, free_hz: float) -> Reception:
    return Reception(
        _distribution(rates.beacons_per_s), _distribution(rates.in_reach), _distribution(rates.received), free_hz
    )


def _distribution(values: Vector | Integers) -> Distribution:
    worst = np.percentile(values, _WORST_SHARE, method="lower")
    return Distribution(float(np.median(values)), float(worst), float(values.min()))


def nearest_sharing_m(site: Site) -> float | None:
    """Return the least distance between two placed anchors that share a slot, up to twice ``reuse_m``; else None."""
    slots = np.array([-1 if anchor.slot is None else anchor.slot for anchor in site.anchors], np.int64)
    batches = pairs_within_groups(anchor_positions(site), slots, 2.0 * site.schedule.reuse_m)
    least_m = min((float(apart_m.min(initial=math.inf)) for _, _, apart_m in batches), default=math.inf)
    return least_m if math.isfinite(least_m) else None


def slot_warnings(site: Site, mapped: RateMap | None, channel: ChannelModel, exponent: float) -> list[str]:
    """All that may cost accuracy or the fix, each in a sentence with what to change."""
    return [*warnings_of(site), *([] if mapped is None else _reception_warnings(site, mapped, channel, exponent))]


def _reception_warnings(site: Site, mapped: RateMap, channel: ChannelModel, exponent: float) -> list[str]:
    found = mapped.reception
    in_reach, received = found.anchors_in_reach.worst_5_percent, found.anchors_received.worst_5_percent
    if in_reach < FEWEST_ANCHORS:
        return [_too_few(mapped, channel, exponent)]
    if received < FEWEST_ANCHORS:
        change = (
            f"a larger schedule.reuse_m than {site.schedule.reuse_m:g} m keeps those of one slot apart"
            if site.schedule.mode == "slots"
            else f"another schedule.rate_hz than {site.schedule.rate_hz:g} may suit these anchors better"
        )
        return [
            f"at the worst 5 % of the positions beacons of only {received:.0f} anchors arrive, though {in_reach:.0f} "
            f"are in reach: others are on the air at once; {change}"
        ]
    if site.schedule.mode == "slots" and found.beacons_per_s.median < 0.95 * found.beacons_per_s_if_free:
        each_hz = 1.0 / beacon_period_s(site)
        return [
            f"slots of {1e3 * site.schedule.slot_s:g} ms give a tag {found.beacons_per_s.median:.0f} beacons/s "
            f"({each_hz:.1f} of each anchor); mode free would give {found.beacons_per_s_if_free:.0f}: take shorter "
            "slots, or mode free"
        ]
    return []


def _too_few(mapped: RateMap, channel: ChannelModel, exponent: float) -> str:
    """Anchors farther apart than the range allows: how near each other they would have to be."""
    worst = mapped.reception.anchors_in_reach.worst_5_percent
    share = math.sqrt(max(worst, 1.0) / _ENOUGH_ANCHORS)
    return (
        f"at the worst 5 % of the positions only {worst:.0f} anchors are in reach "
        f"({range_of(channel, exponent):.0f} m in the open with a path loss of exponent {exponent:g}), and "
        f"positions need {FEWEST_ANCHORS} or more: hang anchors at {100.0 * share:.0f} % of their distances, or more "
        "where walls are between"
    )
