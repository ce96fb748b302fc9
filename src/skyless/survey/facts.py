"""What a user states about a site besides the ranges between its anchors."""

from typing import Literal

from msgspec import Struct

from skyless.survey.tags.received import TagReceived

Point = tuple[float, float, float | None]
"""Site coordinates x, y, z in metres; z None where it is not known."""


class Tape(Struct, frozen=True):
    """A distance between two anchors, by tape or laser."""

    a: int
    b: int
    distance_m: float
    std_m: float = 0.005


class KnownDelay(Struct, frozen=True):
    """The delay ``h`` of an anchor, half the error of its TX and RX antenna delays together, found by a tag."""

    anchor: int
    delay_m: float
    std_m: float


class Gauge(Struct, frozen=True):
    """The anchors that define the frame: one at the origin, one on the positive x axis, and one on its left (y > 0)."""

    origin: int
    x_axis: int
    left: int | None = None


class Facts(Struct, frozen=True):
    """All that a user has given. The frame follows from ``gauge``, else from ``points``, else from ``sketch_m``."""

    dimensions: Literal[2, 3] = 2
    """2: heights are given, or all anchors hang at one height (0 m); 3: they are estimated."""
    heights_m: dict[int, float] = {}
    height_std_m: float = 0.02
    tapes: tuple[Tape, ...] = ()
    points: dict[int, Point] = {}
    """Anchors whose positions are known."""
    point_std_m: float = 0.005
    sketch_m: dict[int, Point] = {}
    """Rough positions, such as those of the present site file."""
    sketch_std_m: float = 0.3
    keep_positions: bool = False
    """Only delays are wanted: the positions of ``sketch_m`` stay, and are as good as ``sketch_std_m``."""
    delay_std_m: float = 0.07
    """Standard deviation of each delay h, apart from the part that all share; 0 if delays are known."""
    common_delay_std_m: float = 0.1
    """Standard deviation of the part of the delays that all anchors share; not used if delays are known."""
    pair_std_m: float = 0.03
    """Constant error of each pair's range, which no averaging removes."""
    delays: tuple[KnownDelay, ...] = ()
    gauge: Gauge | None = None
    tags: tuple[TagReceived, ...] = ()
    """Tags that were carried around or stood at known positions."""
