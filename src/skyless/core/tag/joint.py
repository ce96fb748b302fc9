"""``joint``: the estimator as a positioning method: cold start, packet by packet updates, new starts when lost."""

from math import sqrt
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array
from skyless.core.constants import TICK_S
from skyless.core.estimator.estimator import NO_REPORT, Estimator, Report, SavedEstimator
from skyless.core.estimator.process import ACCEPTED, REJECTED, STALE
from skyless.core.estimator.settings import TUNING, EstimatorSettings
from skyless.core.fix import POSITION, PROTECTED_ROWS, PROTECTION, QUALITY, VELOCITY, Fix, NoFixReason
from skyless.core.integrity import UNAVAILABLE, IntegrityRequirement
from skyless.core.observation import Observation
from skyless.core.tag._acquisition import Acquisition, Start
from skyless.core.ticks import FixTime, from_seconds

SURELY_IN_REACH_TICKS: Final = from_seconds(TUNING.short_silence_s) - 1
"""Silences up to this need no check of the filter."""


class AnchorsInUseState(Struct, frozen=True):
    """What ``AnchorsInUse`` keeps."""

    used: tuple[Observation, ...]
    checked_ticks: int
    extent_m: float


class _Course(Struct):
    """What has become of the starts so far."""

    open_range_errors: bool = False
    """Whether the next start expects larger range errors than the settings state."""
    is_open: bool = False
    """Whether the last start did."""
    start_was_contradicted: bool = False
    relays_may_contradict: bool = True
    may_begin_again: bool = True
    """Whether a start that fits badly from the beginning is given up: not twice in a row."""
    master_less_tag_ticks: int = 0
    started_ticks: int = 0
    newest_ticks: int = 0
    heights_rejected: int = 0


class EstimationState(Struct, frozen=True, tag="joint"):
    """All that an ``Estimation`` keeps."""

    estimator: SavedEstimator
    start: Acquisition | None
    in_use: AnchorsInUseState
    course: _Course


class Estimation:
    """One tag's estimator from the first beacon on."""

    def __init__(
        self,
        settings: EstimatorSettings,
        z_bounds_m: tuple[float, float] | None = None,
        fix_time: FixTime | None = None,
        superframe_s: float = 0.0,
        most_anchors: int | None = None,
    ) -> None:
        """``fix_time``: the receiver's, where it outlives this method; ``superframe_s``: of slow sites.

        ``most_anchors``: with which to begin, the nearest, and none that does not belong to the start; None: with all.
        """
        if z_bounds_m is not None:
            settings = settings.changed(lowest_m=z_bounds_m[0], highest_m=z_bounds_m[1])
        self._settings = settings
        self._height_m = settings.known_height_m
        self._height_known = settings.dim == 2
        self._requirement = IntegrityRequirement(
            settings.integrity_risk, settings.alert_limit, settings.max_acceleration_mps2, settings.height_std_m
        )
        self._superframe_s = superframe_s
        self._most_anchors = most_anchors
        self._max_relative_std = (
            TUNING.curved_std if superframe_s < TUNING.slow_superframe_s else TUNING.slow_curved_std
        )
        self._z_bounds_m = z_bounds_m
        self._course = _Course()
        self._estimator = Estimator(settings)
        self._start: Acquisition | None = self._new_start()
        self._time = fix_time or FixTime()
        self._in_use = AnchorsInUse(superframe_s)

    def state(self) -> EstimationState:
        """All that it keeps, as it is now."""
        return EstimationState(self._estimator.save(), self._start, self._in_use.state(), self._course)

    def restore(self, state: EstimationState) -> None:
        """Continue from the state of one with the same settings.

        Raises:
            ValueError: the estimator's arrays are not sound.
        """
        self._start = state.start
        self._estimator.restore(state.estimator)
        self._in_use.restore(state.in_use)
        self._course = state.course

    @property
    def estimator(self) -> Estimator:
        """The filter with all its states."""
        return self._estimator

    def remove_anchor(self, anchor: int) -> int:
        """Use nothing more of what was received of an anchor; how many others remain, if a position is known."""
        self._estimator.remove_anchor(anchor)
        if self._start is None:
            return len(self._estimator.anchors)
        self._start.remove_anchor(anchor)
        return 0

    @property
    def is_starting(self) -> bool:
        """Whether no position is known yet."""
        return self._start is not None

    def clock(self, anchor: int) -> tuple[int, float, float] | None:
        """The tag's clock less that of an anchor in the state: whole ticks, the rest in metres, rate in m/s."""
        return self._estimator.clock(anchor)

    @property
    def excluded(self) -> tuple[int, ...]:
        """Anchors whose range error has jumped and not come back."""
        return self._estimator.obstructed

    def update(self, observation: Observation) -> Fix | NoFixReason:
        """Process one observation; a fix for every accepted packet once started."""
        ticks_master, rx_ticks = observation.tx_ticks_master, observation.rx_ticks_tag
        if ticks_master is not None:
            self._course.master_less_tag_ticks = ticks_master - rx_ticks
        if (
            self._start is None
            and not 0 <= rx_ticks - self._course.newest_ticks < SURELY_IN_REACH_TICKS
            and self._is_out_of_reach(observation)
        ):
            self._start = self._new_start()
        if self._start is not None:
            return self._try_start(self._start, observation)
        outcome = self._process(observation)
        self._course.newest_ticks = max(self._course.newest_ticks, rx_ticks)
        if outcome in {REJECTED, STALE}:
            if self._estimator.is_lost:
                self._start = self._new_start()
            return NoFixReason.RESIDUALS
        if self._is_contradicted(rx_ticks):
            self._start = self._new_start()
            return NoFixReason.ACQUIRING
        self._in_use.add(observation)
        return self._fix(observation)

    def _try_start(self, starting: Acquisition, observation: Observation) -> Fix | NoFixReason:
        starting.add_relays(observation)
        start = starting.add(observation)
        if isinstance(start, NoFixReason):
            return start
        if start.is_contradicted and not start.misfitting and self._estimator.is_late_often:
            return NoFixReason.RESIDUALS  # single packets are late: others will not be
        if self._superframe_s > TUNING.longest_superframe_s:
            return self._fix_of(start, observation)
        return self._fix(observation) if self._begin(start, starting.packets()) else NoFixReason.ACQUIRING

    def update_height(self, height_m: float, std_m: float) -> bool:
        """Process the tag's height as a sensor measures it, at the newest packet; True if it was used.

        Before a start it bounds the heights of the search. Where many in a row do not fit, the start was wrong.
        """
        if self._start is not None:
            margin_m = TUNING.height_sigmas * std_m
            self._start.expect_height(height_m - margin_m, height_m + margin_m)
            return False
        used = self._estimator.process_height(height_m, std_m) == ACCEPTED
        self._course.heights_rejected = 0 if used else self._course.heights_rejected + 1
        if self._course.heights_rejected >= TUNING.heights_in_row and not self._height_known:
            self._course.heights_rejected = 0
            self._start = self._new_start()
        return used

    def coast(self, observation: Observation) -> Fix | NoFixReason:
        """A fix when a packet came that was not used itself: by all others, and by what was relayed with it."""
        return NoFixReason.RESIDUALS if self._start is not None else self._fix(observation)

    def _is_contradicted(self, rx_ticks: int) -> bool:
        """Whether a new start is needed, as relays or faults contradict this one; decides what that has to expect."""
        if self._course.start_was_contradicted and self._estimator.is_late_often:
            self._course.open_range_errors = self._course.start_was_contradicted = (
                False  # it was by single late packets
            )
            return True
        age_s = (rx_ticks - self._course.started_ticks) * TICK_S
        if age_s >= TUNING.new_start_s:
            self._course.may_begin_again = True
        elif self._course.may_begin_again and self._estimator.state.fix[QUALITY][0] > TUNING.early_nis:
            self._course.may_begin_again = False  # if it does not help, all is noisier than stated
            return True
        if self._course.is_open and age_s > TUNING.new_start_s and self._estimator.fits_settings:
            self._course.open_range_errors = False
            return True
        if self._estimator.state.fix[QUALITY][2] > TUNING.sure_chi2:
            limit = TUNING.sure_chi2 if self._course.start_was_contradicted else TUNING.uncovered_chi2
            if self._estimator.fault_test > limit and (not self._course.is_open or age_s > TUNING.new_start_s):
                self._course.open_range_errors = not self._estimator.is_late_often
                return True
        if not self._course.relays_may_contradict:
            self._course.relays_may_contradict = self._estimator.relays_fit
        elif self._estimator.is_contradicted:
            self._course.relays_may_contradict = (
                False  # if a new start does not help, the anchors are wrong, not the position
            )
            return True
        return False

    def _new_start(self) -> Acquisition:
        settings = self._settings
        max_age_s = max(TUNING.start_age_s, 2.5 * self._superframe_s)
        variance = settings.tx_variance_m2 + settings.rx_variance_m2
        errors = _error_variance_m2(settings)
        speed_mps = settings.start_speed_std_mps
        return Acquisition(self._height_m, variance, self._z_bounds_m, max_age_s, speed_mps, errors)

    def _is_out_of_reach(self, observation: Observation) -> bool:
        """Whether the filter cannot predict up to here: too long a silence for it, or the tag's counter fell back."""
        silent_s = (observation.rx_ticks_tag - self._course.newest_ticks) * TICK_S
        if not -TUNING.short_silence_s <= silent_s <= TUNING.longest_silence_s:
            return True
        if silent_s < TUNING.short_silence_s:
            return False
        std_m = sqrt(self._estimator.horizontal_variance_m2(silent_s))
        mean_range_m = self._in_use.mean_range_m(self._estimator.position_m())
        return std_m > self._max_relative_std * mean_range_m

    def _begin(self, start: Start, packets: list[Observation]) -> bool:
        """Begin at the start's position, and process the packets that led there.

        False where anchors that are late may have moved it by more than their distance: it says nothing then.
        """
        settings, dim = self._settings, self._estimator.dim
        if self._most_anchors is not None:
            kept = _nearest(start, self._most_anchors)
            packets = [packet for packet in packets if packet.anchor in kept]
        is_contradicted = start.is_contradicted and not self._estimator.is_late_often
        is_open = self._course.open_range_errors or (is_contradicted and not start.misfitting)
        expected_m2 = settings.tx_variance_m2 + settings.rx_variance_m2 + _error_variance_m2(settings)
        inflation = 1.0 + TUNING.late_std_m**2 / expected_m2 if is_open or is_contradicted else TUNING.start_margin
        begin_ticks, speed_m2ps2 = packets[0].rx_ticks_tag, settings.start_speed_std_mps**2
        age_s = (start.rx_ticks_tag - begin_ticks) * TICK_S
        covariance = inflation * start.covariance[:dim, :dim] + age_s**2 * speed_m2ps2 * np.eye(dim)
        self._in_use.begin(start.used)
        if np.trace(covariance[:2, :2]) > self._in_use.mean_range_m(start.solution[:dim]) ** 2:
            return False
        self._start = None
        self._course.newest_ticks = self._course.started_ticks = packets[-1].rx_ticks_tag
        self._course.is_open, self._course.start_was_contradicted = is_open, is_open or is_contradicted
        self._estimator.start(
            begin_ticks,
            start.solution[:dim],
            covariance,
            speed_m2ps2,
            is_open,
            TUNING.late_std_m if self._course.start_was_contradicted else TUNING.lasting_std_m,
            start.misfitting if is_contradicted else (),
        )
        for packet in packets:
            self._process(packet)
        return True

    def _process(self, observation: Observation) -> int:
        estimator, relays = self._estimator, observation.relays
        estimator.know_anchor(observation.anchor, observation.anchor_m, observation.anchor_std_m)
        return estimator.process(
            observation.anchor,
            observation.sequence,
            observation.rx_ticks_tag,
            observation.tx_ticks_anchor,
            relays,
            packed=observation.packed_relays,
            report=self._report(observation),
            variance_factor=observation.rx_variance_factor,
        )

    def _report(self, observation: Observation) -> Report:
        """What the anchor reports of its clock against the master's."""
        if observation.report is None or observation.tx_variance_m2 <= 0.0:
            return NO_REPORT
        return Report(*observation.report, observation.tx_variance_m2)

    def _fix_of(self, start: Start, observation: Observation) -> Fix:
        """What a start knows by itself: a position, and of the velocity that it is a tag's; no protection level."""
        dim, rows = self._estimator.dim, np.zeros((PROTECTED_ROWS, 3))
        rows[POSITION, :dim] = start.solution[:dim]
        if self._height_m is not None:
            rows[POSITION, 2] = self._height_m
        rows[POSITION + 1 : POSITION + 1 + dim, :dim] = start.covariance[:dim, :dim]
        rows[VELOCITY + 1 : VELOCITY + 1 + dim, :dim] = self._settings.start_speed_std_mps**2 * np.eye(dim)
        rows[PROTECTION, 2] = UNAVAILABLE
        self._in_use.begin(start.used)
        rx_ticks, in_use = observation.rx_ticks_tag, self._in_use
        time_s = self._time.time_s(rx_ticks + self._course.master_less_tag_ticks, rx_ticks)
        return Fix(
            time_s, rows.tobytes(), in_use.anchors, in_use.anchors_m, "joint", self._height_known, 1, self._requirement
        )

    def _fix(self, observation: Observation) -> Fix | NoFixReason:
        in_use, estimator, known = self._in_use, self._estimator, self._height_known
        if not known and estimator.state.P[2][2] > in_use.extent_m**2:
            return NoFixReason.BAD_GEOMETRY
        rx_ticks = observation.rx_ticks_tag
        time_s = self._time.time_s(rx_ticks + self._course.master_less_tag_ticks, rx_ticks)
        # in the order of the fields: with their names it takes as long as all the rest
        return Fix(time_s, estimator.rows, in_use.anchors, in_use.anchors_m, "joint", known, 1, self._requirement)


def _error_variance_m2(settings: EstimatorSettings) -> float:
    """Variance of a range by the errors of anchors and ranges."""
    return settings.range_std_m**2 + settings.survey_std_m**2


def _nearest(start: Start, most: int) -> set[int]:
    """The anchors of a start that are nearest to its position, and those that do not fit."""
    dim = len(start.solution) - 1
    away = [float(np.linalg.norm(one.anchor_m[:dim] - start.solution[:dim])) for one in start.used]
    nearest = np.argsort(away, kind="stable")[:most]
    return {start.used[index].anchor for index in nearest} | set(start.misfitting)


# Anchors in use


class AnchorsInUse:
    """The anchors whose messages were accepted recently. Their list is made again only when it changes."""

    def __init__(self, superframe_s: float) -> None:
        # one counts as in use while its last accepted message is younger than this
        self._in_use_s = max(TUNING.short_silence_s, 1.5 * superframe_s)
        self._used: dict[int, Observation] = {}
        self._checked_ticks = 0
        self.anchors: tuple[int, ...] = ()
        self.anchors_m: Array = np.empty((0, 3))
        """Their positions, shape (len(anchors), 3)."""
        self.extent_m = 0.0
        """The largest span in x, y or z that anchors in use have had since the start."""

    def state(self) -> AnchorsInUseState:
        """All that it keeps."""
        return AnchorsInUseState(tuple(self._used.values()), self._checked_ticks, self.extent_m)

    def restore(self, state: AnchorsInUseState) -> None:
        """Continue from a state."""
        self._used = {observation.anchor: observation for observation in state.used}
        self._checked_ticks, self.extent_m = state.checked_ticks, state.extent_m
        self._list()

    def begin(self, observations: tuple[Observation, ...]) -> None:
        """Keep only the anchors of these observations."""
        self._used.clear()
        self.extent_m = 0.0
        for observation in observations:
            self.add(observation)

    def add(self, observation: Observation) -> None:
        """Add an accepted message."""
        now = observation.rx_ticks_tag
        before = self._used.get(observation.anchor)
        changed = before is None or before.anchor_m is not observation.anchor_m
        self._used[observation.anchor] = observation
        if (now - self._checked_ticks) * TICK_S > self._in_use_s:
            self._checked_ticks = now
            stale = [a for a, o in self._used.items() if (now - o.rx_ticks_tag) * TICK_S > self._in_use_s]
            changed = changed or bool(stale)
            for anchor in stale:
                del self._used[anchor]
        if changed:
            self._list()
            self.extent_m = max(self.extent_m, float(np.ptp(self.anchors_m, axis=0).max()))

    def _list(self) -> None:
        self.anchors = tuple(self._used)
        self.anchors_m = np.array([o.anchor_m for o in self._used.values()]).reshape(-1, 3)

    def mean_range_m(self, position_m: Array) -> float:
        """From a position, shape (2,) or (3,), to the anchors."""
        away = self.anchors_m[:, : len(position_m)] - position_m
        return float(np.linalg.norm(away, axis=1).mean())
