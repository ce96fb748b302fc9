"""Beacons per second that reach tags at a site of protocol 2, whose anchors send at random instants.

A frame arrives if its power is above the sensitivity and exceeds that of each concurrent frame by the capture margin.
"""

import math
from math import exp, log10, sqrt
from typing import Any, Final

import msgspec
import numpy as np
from msgspec import Struct

from skyless.core.air.frame import MAX_FRAME_BYTES, air_time_s
from skyless.core.any_anchor import beacon_period_s
from skyless.core.arrays import Integers, Matrix, Vector
from skyless.core.geometry import anchor_positions
from skyless.core.native.arithmetic import square
from skyless.core.native.library import KERNELS, compiled
from skyless.core.native.records import Array, Reals
from skyless.core.site import Site
from skyless.site.channel import (
    Barrier,
    ChannelModel,
    barriers_of,
    cross_walls,
    delivery_probability,
    received_power_dbm,
)
from skyless.site.file.advice import warnings_of
from skyless.site.planning.links import IN_VIEW, Floor, range_of
from skyless.site.planning.maps import Grid, grid_of

RECEIVED_HZ: Final = 2.0
"""An anchor received more rarely is useless to a tag, whose estimator forgets it after a second."""

FEWEST_ANCHORS: Final = 5
"""A plan warns of fewer in the worst twentieth of the positions: one more than a 3-D position needs."""

_ENOUGH_ANCHORS: Final = 7
_CERTAIN_LOSS_WIDTHS: Final = 10.0  # a frame counts as lost this many widths below the sensitivity
_POINTS: Final = 3000
_PLASTIC: Final = np.array([0.7548776662, 0.5698402910])  # multiples of these, modulo 1, fill a square evenly


class TagRates(Struct, frozen=True):
    """A tag's reception at points; shape (points,) each."""

    beacons_per_s: Vector
    in_reach: Integers
    """Anchors of which at least half of the frames would arrive if no other sent."""
    received: Integers
    """Anchors of which at least ``RECEIVED_HZ`` beacons per second arrive."""


def tag_rates(site: Site, points_m: Matrix, channel: ChannelModel, exponent: float = 2.0) -> TagRates:
    """Predict the reception of tags at points, shape (m, 3); anchors without a position are left out.

    ``exponent``: path loss exponent; the power falls by ten times this many decibels per factor of ten in distance.
    """
    anchors_m, period_s = anchor_positions(site), beacon_period_s(site)
    order = np.argsort(anchors_m[:, 0], kind="stable")
    weakest_dbm = channel.sensitivity_dbm - _CERTAIN_LOSS_WIDTHS * channel.sensitivity_width_db - channel.capture_db
    settings = np.array(
        [
            channel.tx_power_dbm,
            channel.sensitivity_dbm,
            channel.sensitivity_width_db,
            channel.capture_db,
            1.0 - channel.loss_probability,
            exponent,
            range_of(channel.changed(sensitivity_dbm=weakest_dbm), exponent),
            2.0 * air_time_s(MAX_FRAME_BYTES) / period_s,
            RECEIVED_HZ * period_s,
        ]
    )
    table = np.zeros((len(points_m), 3))
    compiled(fill_rates, KERNELS)(
        np.ascontiguousarray(points_m, np.float64).reshape(-1),
        len(points_m),
        anchors_m[order].reshape(-1),
        len(anchors_m),
        settings,
        *barriers_of(site.walls, site.storeys),
        np.empty(len(anchors_m)),
        table.reshape(-1),
    )
    return TagRates(table[:, 0] / period_s, table[:, 1].astype(np.int64), table[:, 2].astype(np.int64))


def fill_rates(
    points_m: Reals,
    points: int,
    anchors_m: Reals,
    anchors: int,
    settings: Reals,
    barriers: Array[Barrier],
    count: int,
    powers_dbm: Reals,
    table: Reals,
) -> None:
    """Fill beacons per period, anchors in reach and anchors received, point by point; anchors in the order of x.

    ``settings``: transmit power, sensitivity, its width, capture margin, share not lost at random, exponent, distance
    beyond which anchors are ignored, share of the time in which another anchor's frame would overlap, and share of an
    anchor's frames that makes it count as received. ``powers_dbm`` has room for one number of each anchor.
    """
    tx_dbm, sensitivity_dbm, width_db, capture_db = settings[0], settings[1], settings[2], settings[3]
    kept, exponent, farthest_m, overlap, useful = settings[4], settings[5], settings[6], settings[7], settings[8]
    for i in range(points):
        x_m, y_m, z_m = points_m[3 * i], points_m[3 * i + 1], points_m[3 * i + 2]
        near = 0
        for j in range(anchors):
            from_x_m, from_y_m, from_z_m = anchors_m[3 * j], anchors_m[3 * j + 1], anchors_m[3 * j + 2]
            if from_x_m > x_m + farthest_m:
                break
            if from_x_m < x_m - farthest_m:
                continue
            distance_m = sqrt(square(from_x_m - x_m) + square(from_y_m - y_m) + square(from_z_m - z_m))
            if distance_m > farthest_m:
                continue
            loss_db = 10.0 * (exponent - 2.0) * log10(max(distance_m, 1.0))
            walls_db, _delay_m = cross_walls(barriers, count, from_x_m, from_y_m, from_z_m, x_m, y_m, z_m)
            powers_dbm[near] = received_power_dbm(tx_dbm, distance_m, loss_db + walls_db)
            near += 1
        for k in range(near):
            power_dbm = powers_dbm[k]
            delivered = kept * delivery_probability(power_dbm, sensitivity_dbm, width_db)
            if delivered < 1e-6:
                continue
            rivals = -1  # itself
            for other in range(near):
                if power_dbm - powers_dbm[other] < capture_db:
                    rivals += 1
            arrives = delivered * exp(-overlap * rivals)
            table[3 * i] += arrives
            table[3 * i + 1] += 1.0 if delivered >= IN_VIEW * kept else 0.0
            table[3 * i + 2] += 1.0 if arrives >= useful else 0.0


class Distribution(Struct, frozen=True):
    """Distribution of a quantity over the region's positions."""

    median: float
    worst_5_percent: float
    """Least value in all but the worst twentieth of the positions."""
    least: float


class Reception(Struct, frozen=True):
    """Tags' reception over the region."""

    beacons_per_s: Distribution
    anchors_in_reach: Distribution
    """Without collisions."""
    anchors_received: Distribution
    """With collisions."""


class RateMap(Struct, frozen=True):
    """Beacons per second at one point of each cell of a grid."""

    grid: Grid
    beacons_per_s: Matrix
    """Shape (heights, ny, nx); NaN outside the outline."""
    reception: Reception


def rate_map(
    site: Site, floor: Floor, heights_m: tuple[float, ...], step_m: float | None, channel: ChannelModel, exponent: float
) -> RateMap:
    """Predict tags' reception over the region; by default at some three thousand points.

    Raises ValueError: the region has no area or no point inside the outline, or there would be too many points.
    """
    x1, y1, x2, y2 = floor.region_m
    grid = grid_of(floor, heights_m, step_m or math.sqrt(max((x2 - x1) * (y2 - y1), 1e-6) * len(heights_m) / _POINTS))
    flat = _points_in_cells(grid)
    points = np.concatenate([np.column_stack([flat, np.full(len(flat), height)]) for height in grid.heights_m])
    rates = tag_rates(site, points, channel, exponent)
    values = np.full((len(grid.heights_m), *grid.within.shape), np.nan)
    values[:, grid.within] = rates.beacons_per_s.reshape(len(grid.heights_m), -1)
    found = (_distribution(one) for one in (rates.beacons_per_s, rates.in_reach, rates.received))
    return RateMap(grid, values, Reception(*found))


def _points_in_cells(grid: Grid) -> Matrix:
    """A point in each cell within the outline, at varying places in the cells, shape (m, 2).

    Cell centres would sample a regular grid of anchors only at the same few places between its anchors.
    """
    centres = np.stack(np.meshgrid(grid.x_m, grid.y_m), axis=-1)[grid.within]
    shares = np.arange(1, len(centres) + 1)[:, None] * _PLASTIC % 1.0 - 0.5
    cell_m = [np.diff(axis_m).min(initial=grid.step_m) for axis_m in (grid.x_m, grid.y_m)]
    points: Matrix = centres + shares * cell_m
    return points


def _distribution(values: Vector | Integers) -> Distribution:
    worst = np.percentile(values, 5.0, method="lower")
    return Distribution(float(np.median(values)), float(worst), float(values.min()))


def rate_report(
    site: Site, floor: Floor | None, mapped: RateMap | None, channel: ChannelModel, exponent: float
) -> dict[str, Any]:
    """The whole report, SI units; without placed anchors ``floor`` and ``mapped`` are None."""
    return {
        "site": site.name,
        "mode": site.schedule.mode,
        "exponent": exponent,
        "range_m": range_of(channel, exponent),
        "beacons_per_s_of_each_anchor": 1.0 / beacon_period_s(site),
        "outline_m": None if floor is None else floor.outline_m,
        "region_m": None if floor is None else floor.region_m,
        "heights_m": None if mapped is None else mapped.grid.heights_m,
        "step_m": None if mapped is None else mapped.grid.step_m,
        "points": None if mapped is None else mapped.grid.points,
        "reception": None if mapped is None else msgspec.to_builtins(mapped.reception),
        "accuracy": None,
        "anchors": [
            {"id": anchor.id, "x_m": anchor.x_m, "y_m": anchor.y_m, "z_m": anchor.z_m} for anchor in site.anchors
        ],
        "unplaced": [{"id": anchor.id} for anchor in site.unplaced],
        "warnings": [
            *warnings_of(site),
            *([] if mapped is None else _reception_warnings(site, mapped.reception, channel, exponent)),
        ],
    }


def described_rates(result: dict[str, Any]) -> str:
    """Mode and beacon rate in one line."""
    return f"mode {result['mode']}, {result['beacons_per_s_of_each_anchor']:.1f} beacons/s of each anchor"


def _reception_warnings(site: Site, found: Reception, channel: ChannelModel, exponent: float) -> list[str]:
    in_reach, received = found.anchors_in_reach.worst_5_percent, found.anchors_received.worst_5_percent
    if in_reach < FEWEST_ANCHORS:
        share = math.sqrt(max(in_reach, 1.0) / _ENOUGH_ANCHORS)
        return [
            f"at the worst 5 % of the positions only {in_reach:.0f} anchors are in reach "
            f"({range_of(channel, exponent):.0f} m in the open with a path loss of exponent {exponent:g}), and "
            f"positions need {FEWEST_ANCHORS} or more: hang anchors at {100.0 * share:.0f} % of their distances, or "
            "more where walls are between"
        ]
    if received < FEWEST_ANCHORS:
        return [
            f"at the worst 5 % of the positions beacons of only {received:.0f} anchors arrive, though {in_reach:.0f} "
            "are in reach: others are on the air at once; "
            f"another schedule.rate_hz than {1.0 / beacon_period_s(site):.3g} may suit these anchors better"
        ]
    return []
