"""What the anchors in view make of points: shares, delays, and DOPs."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyless.planning.columns import ANCHORS, GDOP, PDOP, TDOP
from skyless.planning.links import IN_VIEW, links
from skyless.uncertainty.dop import dops_at

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class Scene(NamedTuple):
    """Anchors, and what stands between them and points."""

    anchors: Matrix
    """Positions, shape (anchors, 3)."""
    speaks: NDArray[np.bool_]
    """Those that send at all, shape (anchors,)."""
    budget: Vector
    """``link_budget``."""
    walls: Matrix
    """``pack_walls``."""

    def heard_at(self, points: Matrix) -> tuple[Matrix, Matrix]:
        """Share of each anchor's frames that arrives at points, and the walls' delay, metres; shape (m, anchors)."""
        share, delay_m = links(self.anchors, points, self.budget, self.walls)
        return share * self.speaks, delay_m


def fill_dops(scene: Scene, points: Matrix, share: Matrix, dim: int, table: Matrix) -> None:
    """Fill the number of anchors in view and the columns of their DOPs."""
    in_view = share >= IN_VIEW
    table[:, ANCHORS] = in_view.sum(axis=1)
    table[:, GDOP : TDOP + 1] = dops_at(scene.anchors, points, height_known=dim == 2, weights=in_view)


def weighted_pdop(scene: Scene, points: Matrix, share: Matrix, dim: int) -> Vector:
    """PDOP with every anchor weighted by its share of frames, so that none comes or goes at once; may be infinite."""
    return dops_at(scene.anchors, points, height_known=dim == 2, weights=share)[:, PDOP - GDOP]
