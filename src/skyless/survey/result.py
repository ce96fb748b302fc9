"""What a survey has found, and how far it is to be relied on."""

from msgspec import Struct

from skyless.survey.facts import Gauge


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
    """Of x, y, z, shape (3, 3), after the best rigid alignment; rows of coordinates that were not estimated are 0."""
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
