"""``joint``: the estimator as a positioning method, with cold start, updates by packet, and restarts when lost."""

from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.air.frame import two_bytes, unsigned
from skyless.core.air.site_pages import STD_STEPS_PER_M, STEPS_PER_M, STEPS_PER_S
from skyless.core.arrays import Array, Vector
from skyless.core.estimator.estimator import NO_REPORT, Estimator
from skyless.core.estimator.process import ACCEPTED
from skyless.core.estimator.settings import TUNING, EstimatorSettings
from skyless.core.estimator.state import AXES
from skyless.core.fix import Fix, NoFixReason
from skyless.core.integrity import IntegrityRequirement, limits_of
from skyless.core.native.arithmetic import square
from skyless.core.native.library import compiled
from skyless.core.native.records import Bytes
from skyless.core.native.views import view
from skyless.core.tag.acquisition import Acquisition
from skyless.core.tag.following import (
    BAD_GEOMETRY,
    FIX,
    HAS_TOO_FEW,
    IS_MIRRORED,
    IS_UNSETTLED,
    LOST,
    OUTLIER,
    SEARCHING,
    START_CONTRADICTED,
    START_FIX,
    Course,
    begin_again,
    begin_course,
    follow,
    settle,
)
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_S, FixTime


class Observation(Struct, frozen=True, gc=False):
    """A packet of a system without a master as the tag received it; integers never wrap."""

    anchor: int
    anchor_m: Vector
    """Shape (3,)."""
    sequence: int
    rx_ticks_tag: int
    tx_ticks_anchor: int
    relays: tuple[tuple[int, int, int], ...]
    """The anchor's receptions of others: (anchor, sequence number, own RX stamp, unwrapped)."""
    phase_cycles: float = -1.0
    """Carrier phase as the tag received it, negative if unknown."""
    relay_phases: tuple[float, ...] = ()
    """Phases of ``relays``, as anchors received each other."""


_PERIOD_SHARE: Final = 0.1
"""Smaller changes of a period do not begin the search again."""


class Estimation:
    """One tag's estimator, from its first beacon on."""

    def __init__(
        self,
        settings: EstimatorSettings,
        z_bounds_m: tuple[float, float] | None = None,
        fix_time: FixTime | None = None,
        superframe_s: float = 0.0,
        *,
        course: Course | None = None,
    ) -> None:
        """``fix_time``: the receiver's, if it outlives this object. ``superframe_s``: of slow sites, otherwise 0.

        ``course``: an existing tag's, with its settings.
        """
        if z_bounds_m is not None:
            settings = settings.changed(lowest_m=z_bounds_m[0], highest_m=z_bounds_m[1])
        self.search = Acquisition()
        self._estimator = Estimator(settings)
        self._time = fix_time or FixTime()
        self._listed = -1
        """Value of ``course.changes`` at which the next three were listed."""
        self._anchors: tuple[int, ...] = ()
        self._anchors_m: Array = np.empty((0, 3))
        self._height_known = False
        self._requirement = IntegrityRequirement(settings.integrity_risk, settings.alert_limit, settings.height_std_m)
        if course is None:
            course = Course(settings=settings, tuning=TUNING, dim=settings.dim, superframe_s=superframe_s)
            course.horizontal_k, course.vertical_k = limits_of(settings.integrity_risk)
            _begin_course(course, self.search)
        self.course = course

    @property
    def estimator(self) -> Estimator:
        """The filter."""
        return self._estimator

    @property
    def is_starting(self) -> bool:
        """Whether there is no position yet."""
        return self.course.is_starting

    def expect_period(self, period_s: float) -> None:
        """Let a search for a start expect anchors that send once in this time."""
        if abs(period_s - self.course.superframe_s) > _PERIOD_SHARE * self.course.superframe_s:
            self.course.superframe_s = period_s
            fill_ages(self.course.settings, period_s)
            _begin_course(self.course, self.search)

    def clock(self, anchor: int) -> tuple[int, float, float] | None:
        """Tag's clock minus an anchor's: whole ticks, the rest in m, rate in m/s. None if it is not in the state."""
        return self._estimator.clock(anchor)

    @property
    def excluded(self) -> tuple[int, ...]:
        """Anchors whose range error has jumped and not returned."""
        return self._estimator.obstructed

    def update(self, observation: Observation) -> Fix | NoFixReason:
        """Process one observation. Once started, every accepted packet gives a fix."""
        o, state = observation, self._estimator.state
        self._estimator.know_anchor(o.anchor, o.anchor_m)
        packet, relays = self._estimator.packet_of(
            o.anchor, o.sequence, o.rx_ticks_tag, o.tx_ticks_anchor, o.relays, NO_REPORT, 1.0, o.phase_cycles,
            o.relay_phases,
        )  # fmt: skip
        packet.place.is_open = o.anchor == self.course.misfit
        return self.result_of(_follow(self.course, state, self.search, self._time, packet, relays, b"", 0))

    def result_of(self, outcome: int) -> Fix | NoFixReason:
        """Convert a packet's outcome to a fix or a reason."""
        if outcome == FIX:
            return self.fix(self._estimator.rows)
        return self.fix(view(self.course.alone).tobytes()) if outcome == START_FIX else REASONS[outcome]

    def fix(self, rows: bytes) -> Fix:
        """The fix of the last packet, from its rows."""
        course = self.course
        if course.changes != self._listed:
            self._list_anchors()
        time_s, anchors, anchors_m = course.time_ticks * TICK_S, self._anchors, self._anchors_m
        # positional arguments: keywords would take as long as all the rest
        return Fix(time_s, rows, anchors, anchors_m, "joint", self._height_known, 1, self._requirement)

    def _list_anchors(self) -> None:
        used = view(self.course.used)[: self.course.count]
        self._anchors, self._anchors_m = tuple(used["anchor"].tolist()), used["position_m"].copy()
        self._listed, self._height_known = self.course.changes, self.course.dim == AXES - 1

    def update_height(self, height_m: float, std_m: float) -> bool:
        """Process a height sensor's measurement at the time of the newest packet. Returns True if it was used.

        Before a start it bounds the search. Many rejections in a row mean that the start was wrong.
        """
        if self.is_starting:
            margin_m = self.course.settings.gate * std_m
            self.search.has_bounds = True
            self.search.low_m, self.search.high_m = height_m - margin_m, height_m + margin_m
            return False
        used = self._estimator.process_height(height_m, std_m) == ACCEPTED
        self.course.heights_rejected = 0 if used else self.course.heights_rejected + 1
        if self.course.heights_rejected >= TUNING.heights_in_row and self.course.dim == AXES:
            self.course.heights_rejected = 0
            _begin_again(self.course, self._estimator.state, self.search)
        return used

    def coast(self, observation: Observation) -> Fix | NoFixReason:
        """A fix for a packet that was not used itself, from all others and from the relays that it carried."""
        if self.is_starting:
            return NoFixReason.RESIDUALS
        return self.result_of(settle(self.course, self._estimator.state, self._time, observation.rx_ticks_tag))


REASONS: Final = {
    OUTLIER: NoFixReason.RESIDUALS,
    LOST: NoFixReason.RESIDUALS,
    START_CONTRADICTED: NoFixReason.ACQUIRING,
    BAD_GEOMETRY: NoFixReason.BAD_GEOMETRY,
    SEARCHING: NoFixReason.ACQUIRING,
    HAS_TOO_FEW: NoFixReason.TOO_FEW_ANCHORS,
    IS_MIRRORED: NoFixReason.MIRROR,
    IS_UNSETTLED: NoFixReason.NOT_CONVERGED,
}

_begin_course: Final = compiled(begin_course)
_begin_again: Final = compiled(begin_again)
_follow: Final = compiled(follow)


# What the estimator assumes at a site, from its pages of noise and accuracy

DROP_S: Final = 1.0
"""An anchor leaves the estimator after this silence, or after four superframes if that is longer."""

# Relays of older packets are not used; the longer of the two counts.
RELAY_AGE_S: Final = 1.0
RELAY_SUPERFRAMES: Final = 2.5

_LIGHT_2: Final = SPEED_OF_LIGHT_MPS**2
_ROUNDING_S2: Final = TICK_S**2 / 12.0
"""Variance of rounding to whole ticks."""


def read_accuracy(e: EstimatorSettings, noise: Bytes, accuracy: Bytes) -> None:
    """Fill in the settings that the pages state."""
    fill_noise(e, _float_at(noise, 1), _float_at(noise, 5), _float_at(noise, 9), _float_at(noise, 13))
    e.survey_std_m = two_bytes(accuracy, 1) / STD_STEPS_PER_M
    e.range_std_m = two_bytes(accuracy, 3) / STD_STEPS_PER_M
    e.slope_std_m = two_bytes(accuracy, 5) / STD_STEPS_PER_M
    e.place_std_m = two_bytes(accuracy, 7) / STD_STEPS_PER_M
    e.place_distance_m = two_bytes(accuracy, 9) / STEPS_PER_M
    e.place_time_s = two_bytes(accuracy, 11) / STEPS_PER_S


def fill_noise(
    e: EstimatorSettings, tx_stamp_s: float, rx_stamp_s: float, white_fm: float, random_walk_fm: float
) -> None:
    """Fill in the variances of stamps and oscillators (``NoisePage``)."""
    e.tx_variance_m2 = _LIGHT_2 * square(tx_stamp_s)
    e.rx_variance_m2 = _LIGHT_2 * (square(rx_stamp_s) + _ROUNDING_S2)
    e.white, e.walk = _LIGHT_2 * square(white_fm), _LIGHT_2 * square(random_walk_fm)


def fill_ages(e: EstimatorSettings, superframe_s: float) -> None:
    """Fill in the ages beyond which packets and anchors are dropped."""
    e.drop_s = max(DROP_S, 4.0 * superframe_s)
    e.relay_age_s = max(RELAY_AGE_S, RELAY_SUPERFRAMES * superframe_s)


def _float_at(data: Bytes, at: int) -> float:
    """Decode an IEEE 754 number from four bytes; checked pages hold only 0 and positive numbers below 1."""
    bits = unsigned(data, at, 4)
    halvings, value = 150 - (bits >> 23), float(bits & 0x7FFFFF | 0x800000)
    if bits < 0x800000 or bits >= 0x80000000:
        halvings, value = 149, float(bits & 0x7FFFFF)
    for _ in range(halvings):
        value *= 0.5
    return value
