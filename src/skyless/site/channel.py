"""Channel model for a frame between two antennas: flight, walls, power, and the errors of the stamp.

Powers follow free space at channel 5. A DW1000 at the regulatory limit sends -41.3 dBm/MHz over 499.2 MHz, -14.3 dBm in
total; at 5 m this arrives with -77.0 dBm, where APS011's range bias crosses zero.
"""

from math import exp, log10, pi
from typing import Final, NamedTuple

import numpy as np
from msgspec import structs

from skyless.core.native.arithmetic import floor
from skyless.core.native.records import Array, Reals, Record, record
from skyless.core.site import FloorSite, WallSite
from skyless.core.ticks import CHANNEL_5_HZ, SPEED_OF_LIGHT_MPS

FREE_SPACE_LOSS_1_M_DB: Final = 20.0 * log10(4.0 * pi * CHANNEL_5_HZ / SPEED_OF_LIGHT_MPS)
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
POWER_BIAS_M: Final = np.array(_POWER_BIAS_CM) / 100.0
"""Range biases of an RX stamp at powers that fall in steps."""
_POWER_BIASES: Final = len(_POWER_BIAS_CM)
_POWER_BIAS_FIRST_DBM: Final = -61.0
_POWER_BIAS_STEP_DB: Final = 2.0


@record
class ChannelModel(Record):
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

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ChannelModel) and self.values() == other.values()

    def __hash__(self) -> int:
        return hash(tuple(self.values().values()))


@record
class Barrier(Record):
    """A wall, or a slab: the ground of a floor above the lowest."""

    is_slab: bool
    x1_m: float
    y1_m: float
    x2_m: float
    y2_m: float
    low_m: float
    """Height of a slab."""
    loss_db: float
    delay_m: float


class Barriers(NamedTuple):
    """Walls and slabs of a site, as an array and its length."""

    array: Array[Barrier]
    length: int


def barriers_of(walls: tuple[WallSite, ...], floors: tuple[FloorSite, ...] = ()) -> Barriers:
    """The walls of a site, and the grounds of its floors above the lowest."""
    found = [Barrier(**structs.asdict(wall)) for wall in walls]
    for one in floors[1:]:
        loss_db, delay_m = one.slab
        found.append(Barrier(is_slab=True, low_m=one.low_m, loss_db=loss_db, delay_m=delay_m))
    return Barriers((Barrier * len(found))(*found), len(found))


def cross_wall(b: Barrier, x1_m: float, y1_m: float, z1_m: float, x2_m: float, y2_m: float, z2_m: float) -> bool:
    """Whether the straight line from one point to another crosses a wall or slab."""
    if b.is_slab:
        return (z1_m < b.low_m) != (z2_m < b.low_m)
    side_1 = (x2_m - x1_m) * (b.y1_m - y1_m) - (y2_m - y1_m) * (b.x1_m - x1_m)
    side_2 = (x2_m - x1_m) * (b.y2_m - y1_m) - (y2_m - y1_m) * (b.x2_m - x1_m)
    side_a = (b.x2_m - b.x1_m) * (y1_m - b.y1_m) - (b.y2_m - b.y1_m) * (x1_m - b.x1_m)
    side_b = (b.x2_m - b.x1_m) * (y2_m - b.y1_m) - (b.y2_m - b.y1_m) * (x2_m - b.x1_m)
    return side_1 * side_2 < 0.0 and side_a * side_b < 0.0


def cross_walls(
    barriers: Array[Barrier], count: int, x1_m: float, y1_m: float, z1_m: float, x2_m: float, y2_m: float, z2_m: float
) -> tuple[float, float]:
    """Total loss in dB and delay in metres of the barriers that the straight line from one point to another crosses."""
    loss_db, delay_m = 0.0, 0.0
    for index in range(count):
        b = barriers[index]
        if cross_wall(b, x1_m, y1_m, z1_m, x2_m, y2_m, z2_m):
            loss_db += b.loss_db
            delay_m += b.delay_m
    return loss_db, delay_m


def received_power_dbm(tx_power_dbm: float, distance_m: float, loss_db: float) -> float:
    """Received power after free space and walls; distances below 1 cm count as 1 cm."""
    return tx_power_dbm - FREE_SPACE_LOSS_1_M_DB - 20.0 * log10(max(distance_m, 0.01)) - loss_db


def power_bias_m(rx_power_dbm: float, table_m: Reals = POWER_BIAS_M) -> float:
    """Range bias of an RX stamp (APS011 in docs/radio.md), linearly interpolated and held beyond the ends."""
    position = (_POWER_BIAS_FIRST_DBM - rx_power_dbm) / _POWER_BIAS_STEP_DB
    position = min(max(position, 0.0), _POWER_BIASES - 1.0)
    low = min(floor(position), _POWER_BIASES - 2)
    return table_m[low] + (position - low) * (table_m[low + 1] - table_m[low])


def first_path_loss_db(extra_m: float) -> float:
    """First path's power below the total power, for a message that is ``extra_m`` late."""
    late = 1.0 - exp(-max(extra_m, 0.0) / FIRST_PATH_SCALE_M)
    return LINE_OF_SIGHT_FIRST_PATH_DB + BLOCKED_FIRST_PATH_DB * late


def delivery_probability(rx_power_dbm: float, sensitivity_dbm: float, width_db: float) -> float:
    """Probability of receiving a frame: logistic in the power, 1/2 at the sensitivity."""
    return 1.0 / (1.0 + exp(min((sensitivity_dbm - rx_power_dbm) / width_db, 700.0)))
