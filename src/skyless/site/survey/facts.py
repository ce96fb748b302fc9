"""Input and output of a survey: ranges, facts given by the user, positions and delays."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final, Literal

from msgspec import Struct, structs


class TagReceived(Struct, frozen=True, eq=False):
    """A tag's receptions from the anchors: always a ``TagEpochs``, whose arrays are not sent in messages."""


class PairRange(Struct, frozen=True, gc=False):
    """Mean range of one pair: distance plus both anchors' delays, ``d + h_a + h_b``."""

    a: int
    b: int
    """Identifiers, a < b."""
    range_m: float
    std_m: float
    """Standard deviation of the mean, from noise that no other pair shares."""
    exchanges: int
    """Number of two-way exchanges, or of single ranges, in the mean."""
    late_share: float = 0.0
    """Share of exchanges left out because they came later than the rest."""


class PairRanges(Struct, frozen=True):
    """Ranges of all pairs of a site; pairs that do not receive each other are missing."""

    pairs: tuple[PairRange, ...]
    anchors: tuple[int, ...]
    """All anchors in ascending order, including those without a pair."""
    tx_std_m: dict[int, float] = {}
    """Error of each anchor's TX stamps in the mean, which all its ranges share like a delay; 0 if missing."""
    duration_s: float = 0.0

    def without_delays(self, delays_m: Mapping[int, float]) -> "PairRanges":
        """Subtract known anchor delays from the ranges."""
        shorter = (
            structs.replace(pair, range_m=pair.range_m - delays_m.get(pair.a, 0.0) - delays_m.get(pair.b, 0.0))
            for pair in self.pairs
        )
        return structs.replace(self, pairs=tuple(shorter))


class PairBlock(Struct, frozen=True, gc=False):
    """Mean range of one pair within a block of about a second."""

    a: int
    b: int
    """Identifiers, a < b."""
    t_s: float
    """Middle of the block."""
    mean_m: float
    """Distance plus both anchors' delays, ``d + h_a + h_b``."""
    std_m: float
    """Standard deviation of the mean from stamp noise, shared or not."""
    exchanges: int


Point = tuple[float, float, float | None]
"""Site coordinates x, y, z in metres; z is None if unknown."""


class Tape(Struct, frozen=True):
    """A distance between two anchors, by tape or laser."""

    a: int
    b: int
    distance_m: float
    std_m: float = 0.005


class Gauge(Struct, frozen=True):
    """Anchors that define the frame: one at the origin, one on the positive x axis, one on its left (y > 0)."""

    origin: int
    x_axis: int
    left: int | None = None


class Facts(Struct, frozen=True):
    """Facts given by the user. The frame follows from ``gauge``, else from ``points``, else from ``sketch_m``."""

    dimensions: Literal[2, 3] = 2
    """2: heights are given, or all anchors are at one height (0 m); 3: heights are estimated."""
    heights_m: dict[int, float] = {}
    height_std_m: float = 0.02
    tapes: tuple[Tape, ...] = ()
    points: dict[int, Point] = {}
    """Anchors whose positions are known."""
    point_std_m: float = 0.005
    sketch_m: dict[int, Point] = {}
    """Rough positions, such as those of the current site file."""
    sketch_std_m: float = 0.3
    keep_positions: bool = False
    """Keep the positions of ``sketch_m``, known to ``sketch_std_m``, and estimate only delays."""
    delay_std_m: float = 0.07
    """Standard deviation of each anchor's own part of the delay h; 0 if delays are known."""
    common_delay_std_m: float = 0.1
    """Standard deviation of the part of the delays that all anchors share; not used if delays are known."""
    pair_std_m: float = 0.03
    """Constant error of each pair's range, which averaging does not remove."""
    gauge: Gauge | None = None
    tags: tuple[TagReceived, ...] = ()
    """Tags that were carried around or stood at known positions."""


MIN_CHECKS: Final = 3
"""Spare ranges needed to find a late range."""
_RIGID: Final = {2: 3, 3: 6}  # rigid motions of the whole site, by dimensions; no range depends on them


class Count(Struct, frozen=True):
    """Numbers of measurements and unknowns of a survey."""

    anchors: int
    """Anchors with at least one range."""
    pairs: int
    possible: int
    unknowns: int
    """Coordinates and delays, less the rigid motions of the whole site."""
    spare: int
    """Ranges and facts less unknowns."""

    @property
    def sentence(self) -> str:
        """The counts in words."""
        many = f"{self.anchors} anchors, {self.pairs} of {self.possible} pairs, {self.unknowns} unknowns"
        if self.spare < 0:
            return f"{many}: {-self.spare} ranges or facts too few, so expected delays decide what is left open"
        return f"{many}: {self.spare} ranges check the result, and up to {self.spare // 2} late ones can be found"

    @property
    def warning(self) -> str | None:
        """Advice if too few ranges check the survey; otherwise None."""
        if self.spare >= MIN_CHECKS:
            return None
        return (
            "too few ranges check this survey, so a range that comes late would not be noticed: add links, measured "
            "distances (--distance), known points (--point) or known delays (--delay-std 0)"
        )


def count(ranges: PairRanges, facts: Facts) -> Count:
    """Count the measurements and unknowns of a survey; anchors without a range are left out."""
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
    return Count(n, pairs, n * (n - 1) // 2, unknowns, pairs + known - unknowns)


def _given(facts: Facts, anchor: int) -> int:
    if anchor in facts.points:
        return 2 if facts.dimensions == 2 or facts.points[anchor][2] is None else 3
    return int(facts.dimensions == 3 and anchor in facts.heights_m)


# Result of a survey


class SurveyedAnchor(Struct, frozen=True):
    """Survey result of one anchor; without figures if it is not determined."""

    id: int
    determined: bool
    x_m: float | None = None
    y_m: float | None = None
    z_m: float | None = None
    std_m: float | None = None
    """Standard deviation per axis, RMS over the estimated axes, after the best rigid alignment."""
    covariance_m2: tuple[tuple[float, float, float], ...] | None = None
    """Shape (3, 3), after the best rigid alignment; rows of coordinates that were not estimated are 0."""
    delay_m: float | None = None
    """h: half the error of TX and RX delay together. The TX antenna delay grows by 2·h."""
    delay_std_m: float | None = None
    reason: str | None = None
    """Why the anchor is not determined."""


class SurveyedPair(Struct, frozen=True):
    """A pair's range compared with the result."""

    a: int
    b: int
    range_m: float
    residual_m: float | None
    """Range less distance and delays; None if an anchor is not determined."""
    std_m: float
    excluded: bool
    """Whether the range was left out as late."""


class Ambiguity(Struct, frozen=True):
    """Another result that fits the ranges as well."""

    sentence: str
    anchors: tuple[int, ...]
    """Anchors that would be elsewhere."""
    positions_m: dict[int, tuple[float, float, float]]
    """Their alternative positions."""


class TapeAdvice(Struct, frozen=True):
    """A distance that is worth measuring."""

    a: int
    b: int
    std_before_m: float
    std_after_m: float
    """RMS of ``std_m`` over all determined anchors, with the earlier tapes measured."""


class Survey(Struct, frozen=True):
    """Result of a survey."""

    anchors: tuple[SurveyedAnchor, ...]
    pairs: tuple[SurveyedPair, ...]
    range_std_m: float
    """Constant error of a pair that the result assumes: as given, or as the residuals show if that is more."""
    redundancy: int = 0
    """Ranges in use less unknowns: the number of ranges that check the result."""
    unchecked: str | None = None
    """A sentence if too few ranges check the result; otherwise None."""
    not_determined: tuple[str, ...] = ()
    """Sentences on what is not determined, and why."""
    ambiguities: tuple[Ambiguity, ...] = ()
    tapes: tuple[TapeAdvice, ...] = ()
    """The best first; each assumes that those before it have been measured."""
    frame: str = ""
    """A sentence on what defines origin and axes."""
    gauge: Gauge | None = None
    notes: tuple[str, ...] = ()
    """Sentences, for instance on facts that do not fit."""
    assumed_heights: str | None = None
    """A sentence if heights are assumed, being neither given nor estimated; otherwise None."""

    @property
    def determined(self) -> dict[int, SurveyedAnchor]:
        """The determined anchors by identifier."""
        return {anchor.id: anchor for anchor in self.anchors if anchor.determined}


# Lists of anchors in sentences


def joined(names: Iterable[object]) -> str:
    """Join names as in ``1, 2 and 3``."""
    texts = [str(name) for name in names]
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}" if texts else "none"


def anchors_named(anchors: Sequence[int]) -> str:
    """``anchor 1``, ``anchors 1 and 2``."""
    return f"anchor{'s' if len(anchors) != 1 else ''} {joined(anchors)}"


def are(anchors: Sequence[int]) -> str:
    """The verb for these anchors: ``is`` or ``are``."""
    return "is" if len(anchors) == 1 else "are"


def distances_named(pairs: Sequence[tuple[int, int]]) -> str:
    """``the distance between 1 and 5``, ``the distances 1–5 and 2–4``."""
    if len(pairs) == 1:
        return f"the distance between {pairs[0][0]} and {pairs[0][1]}"
    return f"the distances {joined(f'{a}–{b}' for a, b in pairs)}"
