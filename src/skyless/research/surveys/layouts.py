"""Sites on which surveys of anchors are studied."""

from typing import Final, Literal

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array
from skyless.sim.world import lab_site

SLOT_S: Final = 2.5e-3
_ROOM_M: Final = (
    (0.0, 0.0, 0.4),
    (8.0, 0.0, 2.6),
    (8.0, 6.0, 0.4),
    (0.0, 6.0, 2.6),
    (4.0, 0.0, 2.6),
    (8.0, 3.0, 0.4),
    (4.0, 6.0, 2.6),
    (0.0, 3.0, 0.4),
)


class SurveyLayout(Struct, frozen=True, eq=False):
    """Anchors 1 to n."""

    name: str
    dimensions: Literal[2, 3]
    position_m: Array
    """Shape (n, 3)."""
    tag_height_m: float

    @property
    def anchors(self) -> tuple[int, ...]:
        """Identifiers, in the order of the positions."""
        return tuple(range(1, len(self.position_m) + 1))

    @property
    def heights_m(self) -> dict[int, float]:
        """What a survey in two dimensions is given; empty in three."""
        heights = dict(zip(self.anchors, self.position_m[:, 2].tolist(), strict=True))
        return heights if self.dimensions == 2 else {}


def survey_layouts() -> dict[str, SurveyLayout]:
    """``lab``: the reference site. ``room``: 8 m × 6 m in 3-D. ``hall``: 3 × 4 anchors, 12 m apart, at 6 m."""
    lab = np.array([[anchor.x_m, anchor.y_m, 0.0] for anchor in lab_site().anchors])
    room = np.array(_ROOM_M)
    room += np.random.default_rng(7).uniform(-0.3, 0.3, room.shape)
    hall = np.array([(12.0 * column, 12.0 * row, 6.0) for row in range(3) for column in range(4)])
    hall[:, :2] += np.random.default_rng(8).uniform(-1.0, 1.0, (len(hall), 2))
    return {
        "lab": SurveyLayout("lab", 2, lab, 0.0),
        "room": SurveyLayout("room", 3, room, 1.2),
        "hall": SurveyLayout("hall", 2, hall, 1.2),
    }
