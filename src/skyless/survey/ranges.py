"""Ranges of pairs of anchors, as a survey uses them."""

from msgspec import Struct


class PairRange(Struct, frozen=True, gc=False):
    """The mean of one pair's ranges: its distance plus both anchors' delays, ``d + h_a + h_b``."""

    a: int
    b: int
    """Identifiers, a < b."""
    range_m: float
    std_m: float
    """Of the mean, from noise that no other pair shares."""
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
    """Of the mean, from stamps' noise, that which other pairs share included."""
    exchanges: int
