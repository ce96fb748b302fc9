"""Which nodes receive a frame, with which stamp, and why others do not: one compiled step over all nodes.

A sending node receives nothing (half duplex). Frames that overlap at a listener destroy each other unless one is
stronger than every other by the capture margin. Not modelled: real receivers that locked on the weaker one first lose
both.
"""

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array, Integers, Records
from skyless.core.site import AnchorSite
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_MASK, TICK_S
from skyless.sim.impairments import AnchorDisplacement, DelayError, Impairments, Outage, slope_error_m
from skyless.sim.oscillator import advance, clock_rate
from skyless.sim.streams import draw_normal, draw_uniform
from skyless.sim.trajectory import Piece, Trajectory
from skyless.site.channel import (
    cross_walls,
    delivery_probability,
    first_path_loss_db,
    power_bias_m,
    received_power_dbm,
)
from skyless.site.kernels import kernel, part

# Positions, motion and radio noise of a world's nodes, as records for the kernels.


class TagSpec(Struct, frozen=True):
    """A tag of a world, without its computations."""

    trajectory: Trajectory
    outages: tuple[Outage, ...] = ()


STATION: Final = np.dtype(
    [
        ("on", np.int64),
        ("is_tag", np.int64),
        ("origin_s", np.float64),  # position and velocity hold here, the acceleration around it
        ("position_m", np.float64, (3,)),
        ("velocity_mps", np.float64, (3,)),
        ("acceleration_mps2", np.float64, (3,)),
        ("tx_noise_ticks", np.float64),
        ("rx_noise_ticks", np.float64),
        ("tx_error_ticks", np.float64),  # true minus configured antenna delay
        ("rx_error_ticks", np.float64),
        ("body_m", np.float64),  # delay through the person who carries the tag, 0 for none
        ("body_direction_rad", np.float64),
        ("body_cosine", np.float64),  # of half the sector's width
    ],
    align=True,
)
"""A node's antenna and radio, anchors first, then tags."""


def make_stations(anchors: Sequence[AnchorSite], tags: Sequence[TagSpec], impairments: Impairments) -> Records:
    """Stations of a world, shape (anchors + tags,), all off; the tags' positions are not set yet."""
    stations = np.zeros(len(anchors) + len(tags), dtype=STATION)
    stations["tx_noise_ticks"] = impairments.tx_stamp_ps * 1e-12 / TICK_S
    stations["rx_noise_ticks"] = impairments.rx_stamp_ps * 1e-12 / TICK_S
    stations["is_tag"][len(anchors) :] = 1
    body = impairments.body
    if body is not None:
        carried = stations[len(anchors) :]
        carried["body_m"], carried["body_direction_rad"] = body.delay_m, body.direction_rad
        carried["body_cosine"] = math.cos(0.5 * body.sector_rad)
    errors = {error.anchor: error for error in impairments.delay_errors if error.from_s <= 0.0}
    shifts = {shift.anchor: shift for shift in impairments.anchor_displacements if shift.from_s <= 0.0}
    for node, anchor in enumerate(anchors):
        displace(stations, node, anchor, shifts.get(anchor.id, AnchorDisplacement(anchor.id)))
        if anchor.id in errors:
            set_delays(stations, node, errors[anchor.id])
    return stations


def displace(stations: Records, node: int, anchor: AnchorSite, shift: AnchorDisplacement) -> None:
    """Move an anchor to its displaced position."""
    stations[node]["position_m"] = np.add((anchor.x_m, anchor.y_m, anchor.z_m), (shift.x_m, shift.y_m, shift.z_m))


def set_delays(stations: Records, node: int, error: DelayError) -> None:
    """Set the errors of an anchor's antenna delays."""
    stations[node]["tx_error_ticks"], stations[node]["rx_error_ticks"] = error.tx_ticks, error.rx_ticks


def set_piece(stations: Records, node: int, piece: Piece) -> None:
    """Let a node move along a piece of its trajectory."""
    stations[node]["origin_s"] = piece.origin_s
    stations[node]["position_m"] = piece.position_m
    stations[node]["velocity_mps"] = piece.velocity_mps
    stations[node]["acceleration_mps2"] = piece.acceleration_mps2


@part
def coordinate_m(stations: Records, node: int, axis: int, t_s: float) -> float:
    """One coordinate of a node at a true time."""
    s = stations[node]
    dt_s = t_s - s["origin_s"]
    turned = s["velocity_mps"][axis] + 0.5 * dt_s * s["acceleration_mps2"][axis]
    coordinate: float = s["position_m"][axis] + dt_s * turned
    return coordinate


@part
def velocity_mps(stations: Records, node: int, axis: int, t_s: float) -> float:
    """One component of a node's velocity at a true time."""
    s = stations[node]
    velocity: float = s["velocity_mps"][axis] + (t_s - s["origin_s"]) * s["acceleration_mps2"][axis]
    return velocity


@kernel
def body_m(stations: Records, sender: int, node: int, t_s: float) -> float:
    """Delay of a sender's messages through the body that carries a listener, 0 if it is not in between."""
    s = stations[node]
    delay_m: float = s["body_m"]
    if delay_m == 0.0:
        return 0.0
    east_m = coordinate_m(stations, sender, 0, t_s) - coordinate_m(stations, node, 0, t_s)
    north_m = coordinate_m(stations, sender, 1, t_s) - coordinate_m(stations, node, 1, t_s)
    heading = math.atan2(velocity_mps(stations, node, 1, t_s), velocity_mps(stations, node, 0, t_s))
    towards = heading + s["body_direction_rad"]
    along_m = east_m * math.cos(towards) + north_m * math.sin(towards)
    return delay_m if along_m >= s["body_cosine"] * math.hypot(east_m, north_m) else 0.0


class Outcome(StrEnum):
    """Outcome of a frame at a listener; the values appear in reports."""

    HEARD = "heard"
    WEAK = "below-sensitivity"
    HALF_DUPLEX = "half-duplex"
    COLLISION = "collision"
    LOST = "message-loss"


OUTCOMES: Final = tuple(Outcome)
_HEARD: Final = OUTCOMES.index(Outcome.HEARD)
_WEAK: Final = OUTCOMES.index(Outcome.WEAK)
_HALF_DUPLEX: Final = OUTCOMES.index(Outcome.HALF_DUPLEX)
_COLLISION: Final = OUTCOMES.index(Outcome.COLLISION)
_LOST: Final = OUTCOMES.index(Outcome.LOST)

RECEPTION_RECORD: Final = np.dtype(
    [
        ("node", np.int64),
        ("rx_ticks", np.int64),  # the listener's 40-bit counter
        ("position_m", np.float64, (3,)),
        ("rx_power_dbm", np.float64),
        ("first_path_power_dbm", np.float64),
        ("carrier_offset_ppm", np.float64),
        ("reading_ticks", np.float64),  # the listener's counter modulo 128 when the carrier arrived, without noise
        ("extra_m", np.float64),  # by how much the way was longer than the distance
        ("phase_cycles", np.float64),  # of the carrier (``Carriers``), where that is simulated
    ],
    align=True,
)
"""One frame at one node that received it; the position is the true one at the frame's emission."""


@kernel
def link(
    stations: Records,
    channel: Records,
    walls: Array,
    sender: int,
    listener: int,
    t_s: float,
) -> tuple[float, float, float, float]:
    """Distance, walls' delay (m), power (dBm) and range rate (m/s) between two nodes at a true time."""
    squared_m2, product = 0.0, 0.0
    for axis in range(3):
        step_m = coordinate_m(stations, listener, axis, t_s) - coordinate_m(stations, sender, axis, t_s)
        squared_m2 += step_m * step_m
        product += step_m * (velocity_mps(stations, listener, axis, t_s) - velocity_mps(stations, sender, axis, t_s))
    distance_m = math.sqrt(squared_m2)
    loss_db, delay_m = 0.0, 0.0
    if walls.shape[0] > 0:
        loss_db, delay_m = cross_walls(
            walls,
            coordinate_m(stations, sender, 0, t_s),
            coordinate_m(stations, sender, 1, t_s),
            coordinate_m(stations, sender, 2, t_s),
            coordinate_m(stations, listener, 0, t_s),
            coordinate_m(stations, listener, 1, t_s),
            coordinate_m(stations, listener, 2, t_s),
        )
        if stations[listener]["is_tag"] == 0 and channel[0]["walls_between_anchors"] == 0.0:
            delay_m = 0.0
    power_dbm = received_power_dbm(channel[0]["tx_power_dbm"], distance_m, loss_db)
    return distance_m, delay_m, power_dbm, product / max(distance_m, 1e-9)


@part
def overlap_outcome(
    stations: Records,
    channel: Records,
    walls: Array,
    others: Array,
    listener: int,
    t_s: float,
    arrival_s: tuple[float, float],
    power_dbm: float,
) -> int:
    """Outcome at a listener of overlapping frames: heard, half duplex or collision.

    ``arrival_s``: begin and end of the frame at the listener, relative to its RMARKER's emission.
    """
    outcome = _HEARD
    for k in range(others.shape[0]):
        sender = int(others[k, 0])
        if sender == listener:
            if others[k, 1] < arrival_s[1] and others[k, 2] > arrival_s[0]:
                return _HALF_DUPLEX
            continue
        distance_m, delay_m, other_dbm, _ = link(stations, channel, walls, sender, listener, t_s)
        flight_s = (distance_m + delay_m) / SPEED_OF_LIGHT_MPS
        overlap = others[k, 1] + flight_s < arrival_s[1] and others[k, 2] + flight_s > arrival_s[0]
        if overlap and power_dbm - other_dbm < channel[0]["capture_db"]:
            outcome = _COLLISION
    return outcome


@part
def reception_outcome(channel: Records, normals: Array, cursors: Integers, node: int, power_dbm: float) -> int:
    """Outcome at a listener by power and chance: heard, weak or lost. Draws only if chance decides."""
    sensitivity_dbm, width_db = channel[0]["sensitivity_dbm"], channel[0]["sensitivity_width_db"]
    margin = (power_dbm - sensitivity_dbm) / width_db
    if margin < -30.0:
        return _WEAK
    if margin < 30.0:
        probability = delivery_probability(power_dbm, sensitivity_dbm, width_db)
        if draw_uniform(normals, cursors, node) > probability:
            return _WEAK
    loss = channel[0]["loss_probability"]
    if loss > 0.0 and draw_uniform(normals, cursors, node) < loss:
        return _LOST
    return _HEARD


@part
def extra_path_m(
    stations: Records,
    channel: Records,
    normals: Array,
    cursors: Integers,
    node: int,
    bias_m: float,
) -> float:
    """Extra path of a message: the sender's present bias (tags only) and, by chance, an exponential delay."""
    is_tag = stations[node]["is_tag"] != 0
    extra_m = bias_m if is_tag else 0.0
    probability = channel[0]["nlos_probability"]
    affected = is_tag or channel[0]["nlos_between_anchors"] != 0.0
    if affected and probability > 0.0 and draw_uniform(normals, cursors, node) < probability:
        extra_m -= channel[0]["nlos_mean_m"] * math.log(draw_uniform(normals, cursors, node))
    return extra_m


@part
def stamp(
    clocks: Records,
    normals: Array,
    cursors: Integers,
    stations: Records,
    node: int,
    emission_ticks: int,
    arrival_ticks: float,
    error_ticks: float,
) -> int:
    """RX stamp of a node, rounded to ticks; ``arrival_ticks`` counts from ``emission_ticks``."""
    carry = math.floor(arrival_ticks)
    advance(clocks, normals, cursors, node, emission_ticks + int(carry), arrival_ticks - carry)
    noise_ticks = stations[node]["rx_noise_ticks"] * draw_normal(normals, cursors, node)
    fraction = clocks[node]["local_fraction"] + error_ticks + noise_ticks
    rx_ticks: int = (clocks[node]["local_ticks"] + math.floor(fraction + 0.5)) & TICK_MASK
    return rx_ticks


@part
def measure(
    clocks: Records,
    channel: Records,
    normals: Array,
    cursors: Integers,
    sender: int,
    node: int,
    observed: tuple[float, float, float],
    row: np.void,
) -> None:
    """Fill in the diagnostics of a reception from (power in dBm, extra path in m, range rate in m/s)."""
    power_dbm, extra_m, range_rate_mps = observed
    row["rx_power_dbm"] = power_dbm + channel[0]["power_noise_db"] * draw_normal(normals, cursors, node)
    row["first_path_power_dbm"] = row["rx_power_dbm"] - first_path_loss_db(extra_m)
    offset = clock_rate(clocks, sender) - clock_rate(clocks, node) - range_rate_mps / SPEED_OF_LIGHT_MPS
    noise_ppm = channel[0]["carrier_noise_ppm"] * draw_normal(normals, cursors, node)
    row["carrier_offset_ppm"] = 1e6 * offset + noise_ppm


@kernel
def receive_frame(
    clocks: Records,
    normals: Array,
    cursors: Integers,
    stations: Records,
    channel: Records,
    walls: Array,
    others: Array,
    sender: int,
    emission_ticks: int,
    emission_fraction: float,
    span_s: tuple[float, float],
    bias_m: float,
    range_errors_m: Array,
    slope_m: float,
    diagnostics: bool,
    heard: Records,
    tally: Integers,
) -> tuple[int, int, int]:
    """Deliver one frame to every node that is on, or lose it.

    ``span_s``: begin and end of the frame relative to its RMARKER. ``others`` comes from ``OnAir.others``.
    ``range_errors_m`` has shape (nodes, anchors), with infinity if the sender does not reach the listener, and
    ``slope_m`` is that of ``RangeErrorModel``. Fills ``heard`` (``RECEPTION_RECORD``, one row per receiving node) and
    counts into ``tally``, shape (2, outcomes), for anchors and tags. Returns the numbers of anchors and of nodes that
    received it, and the highest cursor.
    """
    t_s = (emission_ticks + emission_fraction) * TICK_S
    anchors, count, highest = 0, 0, 0
    for node in range(stations.shape[0]):
        station = stations[node]
        if node == sender or station["on"] == 0:
            continue
        distance_m, extra_m, power_dbm, range_rate_mps = link(stations, channel, walls, sender, node, t_s)
        flight_s = (distance_m + extra_m) / SPEED_OF_LIGHT_MPS
        arrival_s = (span_s[0] + flight_s, span_s[1] + flight_s)
        outcome = overlap_outcome(stations, channel, walls, others, node, t_s, arrival_s, power_dbm)
        if outcome == _HEARD and range_errors_m[node, sender] == math.inf:
            outcome = _WEAK
        elif outcome == _HEARD:
            outcome = reception_outcome(channel, normals, cursors, node, power_dbm)
        tally[station["is_tag"], outcome] += 1
        if outcome == _HEARD:
            row = heard[count]
            row["node"] = node
            for axis in range(3):
                row["position_m"][axis] = coordinate_m(stations, node, axis, t_s)
            extra_m += extra_path_m(stations, channel, normals, cursors, node, bias_m) + body_m(
                stations, sender, node, t_s
            )
            error_m = range_errors_m[node, sender]
            if station["is_tag"] != 0:
                error_m += slope_error_m(slope_m, distance_m)
            arrival_ticks = emission_fraction + (distance_m + extra_m + error_m) / TICK_M
            if diagnostics:
                measure(clocks, channel, normals, cursors, sender, node, (power_dbm, extra_m, range_rate_mps), row)
            error_ticks = station["rx_error_ticks"] + channel[0]["power_bias"] * power_bias_m(power_dbm) / TICK_M
            row["rx_ticks"] = stamp(
                clocks, normals, cursors, stations, node, emission_ticks, arrival_ticks, error_ticks
            )
            row["extra_m"] = extra_m
            row["reading_ticks"] = (
                (clocks[node]["local_ticks"] & 127) + clocks[node]["local_fraction"] - error_m / TICK_M
            )
            count += 1
            anchors += 1 - station["is_tag"]
        highest = max(highest, cursors[node])
    return anchors, count, highest
