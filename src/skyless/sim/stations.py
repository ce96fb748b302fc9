"""Positions, motion and radio noise of a world's nodes, as records for the kernels."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Records
from skyless.core.site import AnchorSite
from skyless.core.ticks import TICK_S
from skyless.sim.impairments import AnchorDisplacement, DelayError, Impairments, Outage
from skyless.sim.trajectory import Piece, Trajectory
from skyless.site.kernels import kernel, part


class TagSpec(Struct, frozen=True):
    """A tag of a world, without what it computes."""

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
    """Stations of a world, shape (anchors + tags,), all off; the tags' positions are not yet set."""
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
    """Delay of a sender's messages through the body that carries a listener, 0 where it is not in between."""
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
