"""What a survey has found, how far it is to be relied on, and the record that is kept of it."""

from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Final

import msgspec
from msgspec import Struct

from skyless.core.errors import ConfigurationError
from skyless.core.ticks import TICK_M
from skyless.site.survey.facts import Gauge, PairRanges


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
