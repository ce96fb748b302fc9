"""Which anchors are received where, by the simulated channel's own formulas without its chance.

Also the columns of the tables that predictions fill.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array, Integers, Matrix, Vector
from skyless.core.geometry import dops_at
from skyless.site.channel import (
    FREE_SPACE_LOSS_1_M_DB,
    ChannelModel,
    cross_walls,
    delivery_probability,
    received_power_dbm,
)
from skyless.site.kernels.compiled import kernel, threaded_kernel

PLAN_COLUMNS: Final = (
    "anchors",  # number in view
    "gdop",
    "pdop",
    "hdop",
    "vdop",
    "tdop",
    "sigma_m",  # standard deviation of the position, all axes together
    "sigma_x_m",
    "sigma_y_m",
    "sigma_z_m",
    "bias_m",  # length of the mean error that walls leave
    "rmse_m",  # both together
    "fix_share",  # of the rounds that give a fix
    "claimed_m",  # the standard deviation that the fixes themselves will report
)
"""Names of a prediction's columns, metres; infinite where there is no fix."""

ANCHORS_IN_VIEW, GDOP, PDOP, HDOP, VDOP, TDOP, SIGMA, SIGMA_X, SIGMA_Y, SIGMA_Z, BIAS, RMSE, FIX_SHARE, CLAIMED = range(
    14
)


def fill_errors(
    table: Array,
    rows: Integers,
    variance_m2: Array,
    square_bias_m2: Array,
    claimed_m2: Array,
) -> None:
    """Fill the columns of errors in some rows of a table: variances of three axes, shape (k, 3), the others (k,)."""
    table[rows, SIGMA_X : SIGMA_Z + 1] = np.sqrt(variance_m2)
    table[rows, SIGMA] = np.sqrt(variance_m2.sum(axis=1))
    table[rows, BIAS] = np.sqrt(square_bias_m2)
    table[rows, RMSE] = np.hypot(table[rows, SIGMA], table[rows, BIAS])
    table[rows, CLAIMED] = np.sqrt(claimed_m2)


IN_VIEW: Final = 0.5
"""An anchor is in view where at least this share of its frames arrives."""

_NEGLIGIBLE_SHARE: Final = 1e-4  # a share below this, in free space already, counts as none
_NEGLIGIBLE_LOSS: Final = 1e-7  # a share of losses below this, in free space, counts as none
MIN_SYNC: Final = 0.01
"""An anchor that misses more of the master's frames than all but these stays silent, for planning."""


class AnchorLinks(Struct, frozen=True):
    """How the anchors of a site, in the order of its file, receive their master; shape (anchors,) each."""

    share: Vector
    """Share of the master's frames that arrive; 1 for the master itself."""
    delay_m: Vector
    """By how much walls delay them."""


def range_of(channel: ChannelModel, exponent: float = 2.0) -> float:
    """Distance in metres at which half of the frames arrive with nothing between, by the path loss's exponent."""
    budget_db = channel.tx_power_dbm - FREE_SPACE_LOSS_1_M_DB - channel.sensitivity_dbm
    return float(10.0 ** (budget_db / (10.0 * exponent)))


def with_range(channel: ChannelModel, range_m: float, exponent: float = 2.0) -> ChannelModel:
    """A channel like this one with another range, by another sensitivity."""
    sensitivity_dbm = channel.tx_power_dbm - FREE_SPACE_LOSS_1_M_DB - 10.0 * exponent * math.log10(range_m)
    values = {name: getattr(channel, name) for name in channel.__struct_fields__}
    return ChannelModel(**{**values, "sensitivity_dbm": sensitivity_dbm})


def link_budget(channel: ChannelModel) -> Vector:
    """What ``link`` needs of a channel.

    Power sent, sensitivity, its width, share lost by chance, and the squared
    distances, m², beyond which nothing arrives and within which all does.
    """
    farthest_db = math.log(1.0 / _NEGLIGIBLE_SHARE) * channel.sensitivity_width_db
    farthest_m = range_of(channel) * 10.0 ** (farthest_db / 20.0)
    certain_m = range_of(channel) * 10.0 ** (math.log(_NEGLIGIBLE_LOSS) * channel.sensitivity_width_db / 20.0)
    return np.array(
        [
            channel.tx_power_dbm,
            channel.sensitivity_dbm,
            channel.sensitivity_width_db,
            channel.loss_probability,
            farthest_m**2,
            certain_m**2,
        ]
    )


@kernel
def link(budget: Vector, walls: Matrix, a_m: Vector, b_m: Vector) -> tuple[float, float]:
    """Share of the frames that arrive over the straight line from a to b, and the walls' delay in metres."""
    loss_db, delay_m = 0.0, 0.0
    x, y, z = b_m[0] - a_m[0], b_m[1] - a_m[1], b_m[2] - a_m[2]
    squared_m2 = x * x + y * y + z * z
    if squared_m2 > budget[4]:
        return 0.0, 0.0
    if walls.shape[0] > 0:
        loss_db, delay_m = cross_walls(walls, a_m[0], a_m[1], a_m[2], b_m[0], b_m[1], b_m[2])
    if loss_db == 0.0 and squared_m2 < budget[5]:
        return 1.0 - budget[3], delay_m
    power_dbm = received_power_dbm(budget[0], math.sqrt(squared_m2), loss_db)
    return (1.0 - budget[3]) * delivery_probability(power_dbm, budget[1], budget[2]), delay_m


@threaded_kernel
def _fill_links(
    senders_m: Matrix, listeners_m: Matrix, budget: Vector, walls: Matrix, share: Matrix, delay_m: Matrix
) -> None:
    for i in range(len(listeners_m)):
        for j in range(len(senders_m)):
            share[i, j], delay_m[i, j] = link(budget, walls, senders_m[j], listeners_m[i])


def links(senders_m: Matrix, listeners_m: Matrix, budget: Vector, walls: Matrix) -> tuple[Matrix, Matrix]:
    """Share of each sender's frames that reach each listener, and their delay in metres; shape (listeners, senders)."""
    share, delay_m = np.empty((2, len(listeners_m), len(senders_m)))
    _fill_links(senders_m, listeners_m, budget, walls, share, delay_m)
    return share, delay_m


def anchor_links(anchors_m: Matrix, master: int, budget: Vector, walls: Matrix) -> AnchorLinks:
    """How anchors, shape (anchors, 3), receive the anchor in row ``master``."""
    share, delay_m = links(anchors_m[master : master + 1], anchors_m, budget, walls)
    share[master] = 1.0
    return AnchorLinks(share[:, 0], delay_m[:, 0])


def masters_by_links(anchors_m: Matrix, budget: Vector, walls: Matrix) -> Integers:
    """Rows of anchors, best master first, which all others hear best; equals by distance from the middle."""
    heard, _ = links(anchors_m, anchors_m, budget, walls)
    total = np.round(np.minimum(heard, 0.99).sum(axis=0), 3)
    middle = np.linalg.norm(anchors_m[:, :2] - anchors_m[:, :2].mean(axis=0), axis=1)
    return np.lexsort((middle, -total))


class Scene(NamedTuple):
    """Anchors, and the walls between them and points."""

    anchors: Matrix
    """Positions, shape (anchors, 3)."""
    sends: Vector
    """Share of each one's frames that is sent and not destroyed by others, shape (anchors,)."""
    budget: Vector
    """``link_budget``."""
    walls: Matrix
    """``pack_walls``."""

    def heard_at(self, points: Matrix) -> tuple[Matrix, Matrix]:
        """Share of each anchor's frames that arrives at points, and the walls' delay, metres; shape (m, anchors)."""
        share, delay_m = links(self.anchors, points, self.budget, self.walls)
        return share * self.sends, delay_m

    def strongest(self, point: Vector, rows: Integers, most: int) -> Integers:
        """Those of these rows of anchors, at most ``most``, from which a point receives the most power; ascending."""
        if len(rows) <= most:
            return rows
        power_dbm = [
            received_power_dbm(
                self.budget[0],
                float(np.linalg.norm(point - anchor_m)),
                cross_walls(self.walls, *anchor_m, *point)[0],
            )
            for anchor_m in self.anchors[rows]
        ]
        return np.sort(rows[np.argsort(power_dbm, kind="stable")[-most:]])


def fill_dops(scene: Scene, points: Matrix, share: Matrix, dim: int, table: Matrix) -> None:
    """Fill the number of anchors in view and the columns of their DOPs."""
    in_view = share >= IN_VIEW
    table[:, ANCHORS_IN_VIEW] = in_view.sum(axis=1)
    table[:, GDOP : TDOP + 1] = dops_at(scene.anchors, points, height_known=dim == 2, weights=in_view)


def weighted_pdop(scene: Scene, points: Matrix, share: Matrix, dim: int) -> Vector:
    """PDOP of anchors weighted by their shares of frames, without steps where one comes into view; may be infinite."""
    return dops_at(scene.anchors, points, height_known=dim == 2, weights=share)[:, PDOP - GDOP]
