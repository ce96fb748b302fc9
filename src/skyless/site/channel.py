"""Channel model for a frame between two antennas: flight, walls, power, and the errors of the stamp.

Powers follow free space at channel 5. A DW1000 at the regulatory limit sends -41.3 dBm/MHz over 499.2 MHz, -14.3 dBm in
total; at 5 m this arrives with -77.0 dBm, where APS011's range bias crosses zero.
"""

import math
from typing import Final

import numpy as np
from msgspec import Struct, structs

from skyless.core.arrays import Array, Records
from skyless.core.site import FloorSite, WallSite
from skyless.core.ticks import CHANNEL_5_HZ, SPEED_OF_LIGHT_MPS
from skyless.site.kernels import kernel, part

FREE_SPACE_LOSS_1_M_DB: Final = 20.0 * math.log10(4.0 * math.pi * CHANNEL_5_HZ / SPEED_OF_LIGHT_MPS)
"""Free-space loss over the first metre on channel 5, 48.7 dB (Friis)."""

LINE_OF_SIGHT_FIRST_PATH_DB: Final = 2.0
"""First path's power below the total power with a clear line of sight (assumed)."""

BLOCKED_FIRST_PATH_DB: Final = 8.0
"""Further loss of the first path if the message is late or crossed a wall: as much as metal causes."""

FIRST_PATH_SCALE_M: Final = 0.1
"""Extra path at which all but 1/e of ``BLOCKED_FIRST_PATH_DB`` is lost; less with a shorter one."""

_POWER_BIAS_CM: Final = (
    -11.0, -10.5, -10.0, -9.3, -8.2, -6.9, -5.1, -2.7, 0.0, 2.1, 3.5, 4.2, 4.9, 6.2, 7.1, 7.6, 8.1, 8.6,
)  # fmt: skip
_POWER_BIAS_M: Final = np.array(_POWER_BIAS_CM) / 100.0
_POWER_BIAS_FIRST_DBM: Final = -61.0
_POWER_BIAS_STEP_DB: Final = 2.0


class ChannelModel(Struct, frozen=True, forbid_unknown_fields=True):
    """Propagation at a site, and errors of its receivers."""

    tx_power_dbm: float = -14.3
    """Power sent, antenna gains included (EIRP)."""
    sensitivity_dbm: float = -93.0
    """Power at which half of the frames are lost (assumed for 6.8 Mb/s: free space carries 31 m)."""
    sensitivity_width_db: float = 0.5
    """Scale of the loss as a logistic function of the power."""
    capture_db: float = 10.0
    """A frame survives concurrent frames if it is stronger than each of them by this (assumed)."""
    loss_probability: float = 0.0
    """Probability that any listener loses a message."""
    nlos_probability: float = 0.0
    """Probability that a message is late at a tag."""
    nlos_mean_m: float = 1.0
    """Mean of the exponentially distributed delay of late messages."""
    nlos_between_anchors: bool = False
    """Whether messages between anchors can also be late."""
    walls_between_anchors: bool = True
    """Whether walls also delay messages between anchors; they weaken all messages either way."""
    power_bias: bool = False
    """Whether RX stamps carry the power-dependent bias (APS011, 500 MHz, PRF 64 MHz)."""
    power_noise_db: float = 0.5
    """Noise of the reported powers (assumed)."""
    carrier_noise_ppm: float = 0.03
    """Noise of the reported carrier offset (assumed: the resolution of RX_TTCKO)."""


CHANNEL_RECORD: Final = np.dtype([(field.name, np.float64) for field in structs.fields(ChannelModel)])
"""A ``ChannelModel`` for the kernels; switches are 0 or 1."""


def pack_channel(model: ChannelModel) -> Records:
    """The model as a record for the kernels, shape (1,)."""
    return np.array([structs.astuple(model)], dtype=CHANNEL_RECORD)


def pack_walls(walls: tuple[WallSite, ...], floors: tuple[FloorSite, ...] = ()) -> Array:
    """Walls and slabs for the kernels, shape (n, 6): x1, y1, x2, y2, loss in dB, delay in metres.

    A slab, the ground of a floor above the lowest, has its height as y1, and NaN as x1.
    """
    rows = [structs.astuple(wall) for wall in walls]
    rows += [(math.nan, floor.low_m, math.nan, math.nan, *floor.slab) for floor in floors[1:]]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)


@kernel
def cross_walls(
    walls: Array, ax_m: float, ay_m: float, az_m: float, bx_m: float, by_m: float, bz_m: float
) -> tuple[float, float]:
    """Total loss in dB and delay in metres of all walls and slabs that the straight line from a to b crosses."""
    loss_db = 0.0
    delay_m = 0.0
    for w in range(walls.shape[0]):
        x1, y1, x2, y2 = walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3]
        if math.isnan(x1):
            if (az_m < y1) != (bz_m < y1):
                loss_db += walls[w, 4]
                delay_m += walls[w, 5]
            continue
        side_1 = (bx_m - ax_m) * (y1 - ay_m) - (by_m - ay_m) * (x1 - ax_m)
        side_2 = (bx_m - ax_m) * (y2 - ay_m) - (by_m - ay_m) * (x2 - ax_m)
        side_a = (x2 - x1) * (ay_m - y1) - (y2 - y1) * (ax_m - x1)
        side_b = (x2 - x1) * (by_m - y1) - (y2 - y1) * (bx_m - x1)
        if side_1 * side_2 < 0.0 and side_a * side_b < 0.0:
            loss_db += walls[w, 4]
            delay_m += walls[w, 5]
    return loss_db, delay_m


@part
def received_power_dbm(tx_power_dbm: float, distance_m: float, loss_db: float) -> float:
    """Received power after free space and walls; distances below 1 cm count as 1 cm."""
    return tx_power_dbm - FREE_SPACE_LOSS_1_M_DB - 20.0 * math.log10(max(distance_m, 0.01)) - loss_db


@part
def power_bias_m(rx_power_dbm: float) -> float:
    """Range bias of an RX stamp (APS011 in docs/radio.md), linearly interpolated and held beyond the ends."""
    position = (_POWER_BIAS_FIRST_DBM - rx_power_dbm) / _POWER_BIAS_STEP_DB
    position = min(max(position, 0.0), _POWER_BIAS_M.shape[0] - 1.0)
    low = min(int(position), _POWER_BIAS_M.shape[0] - 2)
    bias_m: float = _POWER_BIAS_M[low] + (position - low) * (_POWER_BIAS_M[low + 1] - _POWER_BIAS_M[low])
    return bias_m


@part
def first_path_loss_db(extra_m: float) -> float:
    """First path's power below the total power, for a message that is ``extra_m`` late."""
    late = 1.0 - math.exp(-max(extra_m, 0.0) / FIRST_PATH_SCALE_M)
    return LINE_OF_SIGHT_FIRST_PATH_DB + BLOCKED_FIRST_PATH_DB * late


@part
def delivery_probability(rx_power_dbm: float, sensitivity_dbm: float, width_db: float) -> float:
    """Probability of receiving a frame: logistic in the power, 1/2 at the sensitivity."""
    return 1.0 / (1.0 + math.exp(min((sensitivity_dbm - rx_power_dbm) / width_db, 700.0)))
