"""How many beacons a second reach a tag at a site of protocol 2, whose anchors speak at once.

A frame arrives if its power is above the sensitivity and, of all frames on the air with it, exceeds each by the
capture margin. In mode slots the others are the anchors of the same slot; in mode free whoever happens to send.
"""

import math
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.air.codec import MAX_FRAME_BYTES
from skyless.air.ieee802154 import air_time_s
from skyless.kernels.arrays import Integers, Matrix, Vector
from skyless.kernels.compiled import threaded_kernel
from skyless.planning.links import IN_VIEW
from skyless.simulation.channel import (
    FREE_SPACE_LOSS_1_M_DB,
    ChannelModel,
    cross_walls,
    delivery_probability,
    pack_walls,
    received_power_dbm,
)
from skyless.site.model import Site
from skyless.site.near import anchor_positions
from skyless.site.slots import beacon_period_s, first_slots

RECEIVED_HZ: Final = 2.0
"""An anchor received more rarely than this is of no use to a tag, whose estimator forgets it after a second."""

_CERTAIN_LOSS_WIDTHS: Final = 10.0
"""Steps of the sensitivity's width below it at which a frame counts as lost."""


class TagRates(Struct, frozen=True):
    """What a tag receives at points; shape (points,) each."""

    beacons_per_s: Vector
    in_reach: Integers
    """Anchors of whose frames at least half would arrive if nobody else sent."""
    received: Integers
    """Anchors of which at least ``RECEIVED_HZ`` beacons a second arrive."""


def tag_rates(site: Site, points_m: Matrix, channel: ChannelModel, exponent: float = 2.0) -> TagRates:
    """Return what tags at points, shape (m, 3), receive of a site in mode slots (with slots) or free.

    ``exponent``: of the path loss; the power falls by ten times this many decibels for each factor of ten in distance.
    Anchors without a position are left out.
    """
    anchors_m = anchor_positions(site)
    order = np.argsort(anchors_m[:, 0], kind="stable")
    first = {} if site.schedule.mode == "free" else first_slots(site)
    slots = np.array([first.get(anchor.id, -1) for anchor in site.anchors], np.int64)
    weakest_dbm = channel.sensitivity_dbm - _CERTAIN_LOSS_WIDTHS * channel.sensitivity_width_db - channel.capture_db
    budget_db = channel.tx_power_dbm - FREE_SPACE_LOSS_1_M_DB - weakest_dbm
    settings = np.array(
        [
            channel.tx_power_dbm,
            channel.sensitivity_dbm,
            channel.sensitivity_width_db,
            channel.capture_db,
            1.0 - channel.loss_probability,
            exponent,
            10.0 ** (budget_db / (10.0 * exponent)),
            2.0 * air_time_s(MAX_FRAME_BYTES) / beacon_period_s(site),
            RECEIVED_HZ * beacon_period_s(site),
        ]
    )
    table = np.zeros((len(points_m), 3))
    walls = pack_walls(site.walls)
    _fill_rates(np.ascontiguousarray(points_m), anchors_m[order], slots[order], settings, walls, table)
    return TagRates(table[:, 0] / beacon_period_s(site), table[:, 1].astype(np.int64), table[:, 2].astype(np.int64))


@threaded_kernel
def _fill_rates(
    points_m: Matrix, anchors_m: Matrix, slots: Integers, settings: Vector, walls: Matrix, table: Matrix
) -> None:
    """Fill beacons per period, anchors in reach and anchors received; anchors in the order of x, slots -1 in mode free.

    ``settings``: power sent, sensitivity, its width, capture margin, share not lost by chance, exponent, distance
    beyond which nothing matters, the share of the time in which another anchor's frame would overlap, and the share
    of an anchor's frames that make it received.
    """
    tx_dbm, sensitivity_dbm, width_db, capture_db, kept = (
        settings[0],
        settings[1],
        settings[2],
        settings[3],
        settings[4],
    )
    exponent, farthest_m, overlap, useful = settings[5], settings[6], settings[7], settings[8]
    near = np.empty(len(anchors_m), np.int64)
    power_dbm = np.empty(len(anchors_m))
    for i in range(len(points_m)):
        x, y, z = points_m[i, 0], points_m[i, 1], points_m[i, 2]
        count = 0
        start, end = np.searchsorted(anchors_m[:, 0], x - farthest_m), np.searchsorted(anchors_m[:, 0], x + farthest_m)
        for j in range(start, end):
            dx, dy, dz = anchors_m[j, 0] - x, anchors_m[j, 1] - y, anchors_m[j, 2] - z
            distance_m = math.sqrt(dx * dx + dy * dy + dz * dz)
            if distance_m > farthest_m:
                continue
            loss_db = 10.0 * (exponent - 2.0) * math.log10(max(distance_m, 1.0))
            if walls.shape[0] > 0:
                loss_db += cross_walls(walls, anchors_m[j, 0], anchors_m[j, 1], x, y)[0]
            near[count] = j
            power_dbm[count] = received_power_dbm(tx_dbm, distance_m, loss_db)
            count += 1
        for k in range(count):
            delivered = kept * delivery_probability(power_dbm[k], sensitivity_dbm, width_db)
            if delivered < 1e-6:
                continue
            rivals = 0
            for other in range(count):
                if other != k and power_dbm[k] - power_dbm[other] < capture_db:
                    rivals += slots[near[k]] < 0 or slots[near[other]] == slots[near[k]]
            arrives = delivered
            if slots[near[k]] < 0:
                arrives *= math.exp(-overlap * rivals)
            elif rivals > 0:
                arrives = 0.0
            table[i, 0] += arrives
            table[i, 1] += delivered >= IN_VIEW * kept
            table[i, 2] += arrives >= useful
