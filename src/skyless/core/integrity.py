"""Integrity of ``joint``'s fixes: fault tests, protection levels, alerts (``docs/maths.md`` section 8)."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.alert import Alert
from skyless.core.native.arithmetic import log, normal_quantile, sqrt

RISK: Final = 1e-4

MARGIN: Final = 1.05
"""Factor on all standard deviations, as errors are not quite Gaussian and noise figures not quite right."""


HPL, VPL, STATE = range(3)
"""Elements of a fix's row of levels."""

SOUND, OBSTRUCTED, CONTRADICTED, UNAVAILABLE = range(4)
"""States of a position: no known faults; anchors whose range error has jumped or was wrong from the start; a fault that
the levels may not cover; no levels."""

_ALERTS: Final = (Alert.NONE, Alert.EXCLUDED, Alert.NOT_EXCLUDED, Alert.UNAVAILABLE)


class Integrity(Struct, frozen=True, gc=False):
    """The error bounds of a fix."""

    hpl_m: float | None
    """The horizontal error exceeds it with a probability of at most ``risk``; None if there is no level."""
    vpl_m: float | None
    """The same for the vertical error; None also if the height is given."""
    risk: float
    """For each fix and each of the two levels."""
    alert: Alert


class IntegrityRequirement(Struct, frozen=True):
    """An application's requirements for the levels. Raises ValueError: a field is out of range."""

    risk: float = RISK
    """Probability, for each fix, that an error exceeds its protection level."""
    alert_limit_m: float | None = None
    """Fixes with a higher horizontal protection level have an alert."""
    height_std_m: float = 0.0
    """Standard deviation of the tag's true height from the given one, which fixes then include."""

    def __post_init__(self) -> None:
        limits_of(self.risk)
        if self.alert_limit_m is not None and not 0.0 < self.alert_limit_m < np.inf:
            raise ValueError(f"alert_limit_m is {self.alert_limit_m!r}; it should be more than 0 m")
        if not 0.0 <= self.height_std_m < np.inf:
            raise ValueError(f"height_std_m is {self.height_std_m!r}; it should be a finite number from 0 on")


def integrity_of(levels: Sequence[float], risk: float, height_known: bool, alert_limit_m: float | None) -> Integrity:
    """The levels that ``protect`` has written, as values.

    While an anchor's fault is in the fix the levels cover it, up to a size beyond which there is none.
    """
    state = int(levels[STATE])
    if state >= CONTRADICTED:
        return Integrity(None, None, risk, _ALERTS[state])
    hpl_m, vpl_m = levels[HPL], None if height_known else levels[VPL]
    exceeded = alert_limit_m is not None and hpl_m > alert_limit_m
    return Integrity(hpl_m, vpl_m, risk, Alert.LIMIT if exceeded else _ALERTS[state])


def limits_of(risk: float = RISK) -> tuple[float, float]:
    """Multiples of the standard deviation, horizontal and vertical, that errors of a fix exceed with this risk.

    Raises ValueError: the probability is not between 0 and 0.1.
    """
    if not 0.0 < risk <= 0.1:
        raise ValueError(f"risk is {risk!r}; it should be above 0 and at most 0.1")
    return horizontal_limit(risk), vertical_limit(risk)


def horizontal_limit(risk: float) -> float:
    """``limits_of`` for the horizontal plane."""
    return MARGIN * sqrt(-2.0 * log(risk))


def vertical_limit(risk: float) -> float:
    """``limits_of`` for one axis."""
    return MARGIN * normal_quantile(0.5 * risk)
