"""TDoAs in the axes in which their solution is simplest: the anchors' own, or the floor where the height is given."""

from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.positioning.closed_form import FREE, HEIGHT, PLANE, spread

Array = NDArray[np.float64]

COLLINEAR: Final = 1e-6
"""Anchors are in one line, or one point, if their figure's width is below this part of its length."""
THIN_SIGMAS: Final = 0.1
"""Anchors are in one plane if they leave it by less than this part of the smallest TDoA sigma."""


class Problem(Struct, frozen=True, gc=False):
    """TDoAs in the local frame of ``closed_form``: p = origin + axesᵀ·local."""

    kind: int
    anchors: Array
    tdoa: Array
    covariance: Array
    factor: Array
    weighted: bool
    extent: float
    height: float
    origin: Array
    axes: Array

    @property
    def dof(self) -> int:
        """Measurements beyond the unknowns."""
        return len(self.tdoa) - (2 if self.kind == HEIGHT else 3)


def frame(anchors: Array, height: float | None, sigma: float) -> tuple[int, Array, float, Array]:
    """Kind of problem, anchors in its axes, their extent (0 if they are in one line), and the axes as rows."""
    axes = np.zeros((3, 3))
    flat = anchors.copy()
    if height is not None:
        flat[:, 2] = 0.0
    extent, width, thickness = spread(flat, axes)
    if not width > COLLINEAR * extent:
        return FREE, anchors, 0.0, axes
    if height is not None:
        return HEIGHT, anchors, extent, np.eye(3)
    local = anchors @ axes.T
    if thickness > max(1e-9 * extent, THIN_SIGMAS * sigma):
        return FREE, local, extent, axes
    local[:, 2] = 0.0
    return PLANE, local, extent, axes
