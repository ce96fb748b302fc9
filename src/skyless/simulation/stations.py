"""Where the nodes of a world are and how good their radios are, as the kernels see it."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.compiled import part
from skyless.constants import TICK_S
from skyless.simulation.impairments import Impairments, Outage
from skyless.simulation.trajectory import Piece, Trajectory
from skyless.site.model import AnchorSite


class TagSpec(Struct, frozen=True):
    """A tag of a world; what it computes is its owner's affair."""

    trajectory: Trajectory
    rx_delay_error_ticks: float = 0.0
    """True minus configured antenna delay."""
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
    ],
    align=True,
)
"""A node's antenna and radio, anchors first, then tags."""


def make_stations(anchors: Sequence[AnchorSite], tags: Sequence[TagSpec], impairments: Impairments) -> NDArray[np.void]:
    """Stations of a world, shape (anchors + tags,), all off; the tags' positions are to be set yet."""
    stations = np.zeros(len(anchors) + len(tags), dtype=STATION)
    stations["tx_noise_ticks"] = impairments.tx_stamp_ps * 1e-12 / TICK_S
    stations["rx_noise_ticks"] = impairments.rx_stamp_ps * 1e-12 / TICK_S
    stations["is_tag"][len(anchors) :] = 1
    stations["rx_error_ticks"][len(anchors) :] = [tag.rx_delay_error_ticks for tag in tags]
    errors = {error.anchor: error for error in impairments.delay_errors}
    for station, anchor in zip(stations, anchors, strict=False):
        station["position_m"] = (anchor.x_m, anchor.y_m, anchor.z_m)
        if anchor.id in errors:
            station["tx_error_ticks"] = errors[anchor.id].tx_ticks
            station["rx_error_ticks"] = errors[anchor.id].rx_ticks
    return stations


def set_piece(stations: NDArray[np.void], node: int, piece: Piece) -> None:
    """Let a node move along a piece of its trajectory."""
    stations[node]["origin_s"] = piece.origin_s
    stations[node]["position_m"] = piece.position_m
    stations[node]["velocity_mps"] = piece.velocity_mps
    stations[node]["acceleration_mps2"] = piece.acceleration_mps2


@part
def coordinate_m(stations: NDArray[np.void], node: int, axis: int, t_s: float) -> float:
    """One coordinate of a node at a true time."""
    s = stations[node]
    dt_s = t_s - s["origin_s"]
    turned = s["velocity_mps"][axis] + 0.5 * dt_s * s["acceleration_mps2"][axis]
    coordinate: float = s["position_m"][axis] + dt_s * turned
    return coordinate


@part
def velocity_mps(stations: NDArray[np.void], node: int, axis: int, t_s: float) -> float:
    """One component of a node's velocity at a true time."""
    s = stations[node]
    velocity: float = s["velocity_mps"][axis] + (t_s - s["origin_s"]) * s["acceleration_mps2"][axis]
    return velocity
