"""What goes into a survey: ranges of pairs of anchors, what a user states, and how much of it checks the result."""

from collections.abc import Mapping
from typing import Final, Literal

from msgspec import Struct, structs


class TagReceived(Struct, frozen=True, eq=False):
    """What a tag received of the anchors. It is always a ``TagEpochs``, whose arrays are not sent in messages."""


class PairRange(Struct, frozen=True, gc=False):
    """The mean of one pair's ranges: its distance plus both anchors' delays, ``d + h_a + h_b``."""

    a: int
    b: int
    """Identifiers, a < b."""
    range_m: float
    std_m: float
    """Standard deviation of the mean, from noise that no other pair shares."""
    exchanges: int
    """Number of two-way exchanges, or of single ranges, in the mean."""
    late_share: float = 0.0
    """Part of them that was left out because it came later than the rest."""


class PairRanges(Struct, frozen=True):
    """What is known of all pairs of a site; a pair that does not receive one another is missing."""

    pairs: tuple[PairRange, ...]
    anchors: tuple[int, ...]
    """All anchors, in ascending order; those without a pair, too."""
    tx_std_m: dict[int, float] = {}
    """Error of an anchor's TX stamps in the mean, which all its ranges share as if it were a delay; 0 where missing."""
    duration_s: float = 0.0

    def without_delays(self, delays_m: Mapping[int, float]) -> "PairRanges":
        """The ranges less delays of some of the anchors."""
        shorter = (
            structs.replace(pair, range_m=pair.range_m - delays_m.get(pair.a, 0.0) - delays_m.get(pair.b, 0.0))
            for pair in self.pairs
        )
        return structs.replace(self, pairs=tuple(shorter))


class PairBlock(Struct, frozen=True, gc=False):
    """The mean of one pair's ranges within a block of time, a second or so."""

    a: int
    b: int
    """Identifiers, a < b."""
    t_s: float
    """Middle of the block."""
    mean_m: float
    """Distance plus both anchors' delays, ``d + h_a + h_b``."""
    std_m: float
    """Standard deviation of the mean, from stamps' noise, shared or not."""
    exchanges: int


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


MIN_CHECKS: Final = 3
"""Ranges more than unknowns below which a late range cannot be found."""
_RIGID: Final = {2: 3, 3: 6}  # rigid motions of the whole site, by dimensions; no range depends on them


class Count(Struct, frozen=True):
    """Numbers of measurements and unknowns of a survey."""

    anchors: int
    """With at least one range."""
    pairs: int
    possible: int
    unknowns: int
    """Coordinates and delays, less the rigid motions of the whole site."""
    spare: int
    """Ranges and facts less unknowns."""

    @property
    def sentence(self) -> str:
        """These numbers in words."""
        many = f"{self.anchors} anchors, {self.pairs} of {self.possible} pairs, {self.unknowns} unknowns"
        if self.spare < 0:
            return f"{many}: {-self.spare} ranges or facts too few, so expected delays decide what is left open"
        return f"{many}: {self.spare} ranges check the result, and up to {self.spare // 2} late ones can be found"

    @property
    def warning(self) -> str | None:
        """What to do before a survey that nothing checks; None if enough does."""
        if self.spare >= MIN_CHECKS:
            return None
        return (
            "too few ranges check this survey, so a range that comes late would not be noticed: add links, measured "
            "distances (--distance), known points (--point) or known delays (--delays-known)"
        )


def count(ranges: PairRanges, facts: Facts) -> Count:
    """Count before a survey; anchors without a range are left out."""
    anchors = {anchor for pair in ranges.pairs for anchor in (pair.a, pair.b)}
    n = len(anchors)
    delays = n if facts.delay_std_m > 0.0 else 0
    if facts.keep_positions:
        unknowns, known = delays, 0
    else:
        coordinates = sum(_given(facts, anchor) for anchor in anchors)
        rigid = _RIGID[facts.dimensions]
        unknowns = max(facts.dimensions * n - rigid, 0) + delays
        known = len(facts.tapes) + max(coordinates - rigid, 0)
    pairs = len(ranges.pairs)
    return Count(n, pairs, n * (n - 1) // 2, unknowns, pairs + known + len(facts.delays) - unknowns)


def _given(facts: Facts, anchor: int) -> int:
    if anchor in facts.points:
        return 2 if facts.dimensions == 2 or facts.points[anchor][2] is None else 3
    return int(facts.dimensions == 3 and anchor in facts.heights_m)
