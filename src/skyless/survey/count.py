"""How many ranges check a survey, counted before it is made: measurements less unknowns."""

from typing import Final

from msgspec import Struct

from skyless.survey.facts import Facts
from skyless.survey.ranges import PairRanges

LEAST_CHECKS: Final = 3
"""Ranges more than unknowns below which a late range cannot be found."""
_RIGID: Final = {2: 3, 3: 6}
"""Rigid motions of the whole site, by dimensions; no range depends on them."""


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
        if self.spare >= LEAST_CHECKS:
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
    """How many of an anchor's estimated coordinates a user has given."""
    if anchor in facts.points:
        return 2 if facts.dimensions == 2 or facts.points[anchor][2] is None else 3
    return int(facts.dimensions == 3 and anchor in facts.heights_m)
