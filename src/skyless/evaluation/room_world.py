"""The room: what is wrong in a real room beside the noise, as one value, and tags that wander about in it.

The sizes are those that recordings of DW1000s show after a survey and a calibration by hand (``docs/studies.md``).
"""

import math
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.kernels.arrays import Array
from skyless.simulation.impairments import AnchorDisplacement
from skyless.simulation.range_errors import RangeErrorModel
from skyless.simulation.streams import stream
from skyless.simulation.trajectory import Roaming
from skyless.site.model import Site

QA_M2PS3: Final = 0.3
"""Of the random accelerations of tags."""

WITHIN: Final = 3.0
"""The walls of the box in which tags wander lie so many standard deviations from its middle."""

_ROOM_KEY: Final = 4
_ROAM_KEY: Final = 6
"""Of streams of random numbers, beside those of the simulated world."""


class Room(Struct, frozen=True):
    """Errors of a site's survey and of its ranges, drawn from a world's seed."""

    axis_std_m: float = 0.02
    """Of the told positions of the anchors: each coordinate is off by a normal error; the height where it is used."""
    off_anchors: int = 0
    """So many anchors, drawn by chance, are off by ``off_m`` more, each in a direction drawn on the floor."""
    off_m: float = 0.0
    ranges: RangeErrorModel = RangeErrorModel(constant_m=0.05, slope_m=0.05)
    """Errors of the ranges at tags."""


def displacements(room: Room, site: Site, seed: int) -> tuple[AnchorDisplacement, ...]:
    """Where the anchors truly stand; the first draws are the same for all rooms of a seed."""
    draw = stream(seed, _ROOM_KEY, 0)
    count = len(site.anchors)
    shifts_m = room.axis_std_m * draw.standard_normal((count, 3))
    if site.tags.height_m is not None:
        shifts_m[:, 2] = 0.0
    off, directions = draw.permutation(count)[: room.off_anchors], draw.uniform(0.0, 2.0 * math.pi, count)
    shifts_m[off, 0] += room.off_m * np.cos(directions[off])
    shifts_m[off, 1] += room.off_m * np.sin(directions[off])
    return tuple(
        AnchorDisplacement(anchor.id, *shift) for anchor, shift in zip(site.anchors, shifts_m.tolist(), strict=True)
    )


def wanderer(low_m: Array, high_m: Array, seed: int, tag: int) -> Roaming:
    """A tag with random acceleration that is in the box for 99.7 % of the time along each axis."""
    own = int(stream(seed, _ROAM_KEY, tag).integers(2**62))
    return Roaming((low_m + high_m) / 2.0, (high_m - low_m) / (2.0 * WITHIN), qa_m2ps3=QA_M2PS3, seed=own)
