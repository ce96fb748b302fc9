"""What goes into a survey and what comes out, as values: ranges, facts of the user, positions and delays."""

from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Final, Literal

import msgspec
from msgspec import Struct, structs

from skyless.core.errors import ConfigurationError
from skyless.core.ticks import TICK_M


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


# What a survey has found, how far it is to be relied on, and the record that is kept of it.


class SurveyedAnchor(Struct, frozen=True):
    """One anchor. Where it is not determined there are no figures."""

    id: int
    determined: bool
    x_m: float | None = None
    y_m: float | None = None
    z_m: float | None = None
    std_m: float | None = None
    """Standard deviation per axis, rms over the axes that were estimated, after the best rigid alignment."""
    covariance_m2: tuple[tuple[float, float, float], ...] | None = None
    """Shape (3, 3), x, y, z, after the best rigid alignment; rows of coordinates that were not estimated are 0."""
    delay_m: float | None = None
    """h: half of what TX and RX delay together are off. The TX antenna delay grows by 2·h."""
    delay_std_m: float | None = None
    reason: str | None = None
    """Why it is not determined."""


class SurveyedPair(Struct, frozen=True):
    """A pair's range against the result."""

    a: int
    b: int
    range_m: float
    residual_m: float | None
    """Range less distance and delays; None where one of the anchors is not determined."""
    std_m: float
    excluded: bool
    """Whether it was left out, as late."""


class Ambiguity(Struct, frozen=True):
    """Another result that fits the ranges as well."""

    sentence: str
    anchors: tuple[int, ...]
    """Those that would be elsewhere."""
    positions_m: dict[int, tuple[float, float, float]]
    """Where they would be."""


class TapeAdvice(Struct, frozen=True):
    """The distance that would help most if it were measured."""

    a: int
    b: int
    std_before_m: float
    std_after_m: float
    """rms over the ``std_m`` of all anchors that are determined, with the earlier tapes measured."""


class Survey(Struct, frozen=True):
    """A survey's result."""

    anchors: tuple[SurveyedAnchor, ...]
    pairs: tuple[SurveyedPair, ...]
    range_std_m: float
    """Constant error of a pair that the result assumes: the given one, or what the residuals show if that is more."""
    redundancy: int
    """Ranges in use less unknowns: how many ranges check the result."""
    unchecked: str | None
    """A sentence where too little checks the result; None otherwise."""
    not_determined: tuple[str, ...]
    """Sentences: what is not determined, and why."""
    ambiguities: tuple[Ambiguity, ...]
    tapes: tuple[TapeAdvice, ...]
    """The best first; the later ones after the earlier ones have been measured."""
    frame: str
    """A sentence: what names origin and axes."""
    gauge: Gauge | None
    notes: tuple[str, ...]
    """Sentences about facts that do not fit, and the like."""
    assumed_heights: str | None = None
    """A sentence where heights are assumed, as they are neither given nor estimated; None otherwise."""


# The record next to the site's file, ``NAME.survey.json``, for the watch


FORMAT: Final = "skyless survey 1"


class SurveyRecord(Struct, frozen=True, tag=FORMAT, tag_field="format"):
    """A survey that has been written into a site's file."""

    site: str
    site_id: int
    unix_s: float
    ranges: PairRanges
    """Ranges measured with the antenna delays before the survey."""
    survey: Survey
    delay_changes_ticks: dict[int, int]
    """What was added to the TX antenna delays."""


def record_path(site_file: str | PathLike[str]) -> Path:
    """Where the record of a site's file lies."""
    return Path(site_file).with_suffix(".survey.json")


def encode_record(record: SurveyRecord) -> bytes:
    """Its bytes."""
    return msgspec.json.format(msgspec.json.encode(record), indent=1) + b"\n"


def read_record(path: str | PathLike[str]) -> SurveyRecord:
    """The record in a file.

    Raises:
        ConfigurationError: it cannot be read, or is not the record of a survey.
    """
    try:
        return msgspec.json.decode(Path(path).read_bytes(), type=SurveyRecord)
    except OSError as error:
        raise ConfigurationError(path, "", None, f"a file that can be read ({error.strerror})") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigurationError(path, "", None, f"the record of a survey: {error}") from None


def baseline(record: SurveyRecord) -> PairRanges:
    """The ranges as they are measured with the new antenna delays: what the watch compares with.

    A range holds half of each anchor's TX delay.
    """
    return record.ranges.without_delays(
        {anchor: ticks * TICK_M / 2.0 for anchor, ticks in record.delay_changes_ticks.items()}
    )


# Lists of anchors in sentences


def joined(names: Iterable[object]) -> str:
    """1, 2 and 3."""
    texts = [str(name) for name in names]
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}" if texts else "none"


def anchors_named(anchors: Sequence[int]) -> str:
    """``anchor 1``, ``anchors 1 and 2``."""
    return f"anchor{'s' if len(anchors) != 1 else ''} {joined(anchors)}"


def are(anchors: Sequence[int]) -> str:
    """The verb that goes with them."""
    return "is" if len(anchors) == 1 else "are"


def distances_named(pairs: Sequence[tuple[int, int]]) -> str:
    """``the distance between 1 and 5``, ``the distances 1–5 and 2–4``."""
    if len(pairs) == 1:
        return f"the distance between {pairs[0][0]} and {pairs[0][1]}"
    return f"the distances {joined(f'{a}–{b}' for a, b in pairs)}"
