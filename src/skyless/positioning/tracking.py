"""``tracker`` as a positioning method: cold start, message by message updates, and starting again when lost."""

import numpy as np
from numpy.typing import NDArray

from skyless.constants import TICK_S
from skyless.positioning.acquisition import (
    EARLY_S,
    MAX_AGE_S,
    MAX_GAP_S,
    MAX_SPEED_STD_MPS,
    MAX_SPREAD,
    SHORT_SILENCE_S,
    SLOW_S,
    SLOW_SPREAD,
    SPEED_STD_GROWTH,
    SPEED_STD_MPS,
    Acquisition,
    Start,
)
from skyless.positioning.fix import Fix, NoFixReason, motion_fix
from skyless.positioning.fix_time import FixTime
from skyless.positioning.in_use import AnchorsInUse
from skyless.positioning.observation import Observation
from skyless.positioning.tracker import PseudorangeTracker, TrackerSettings


class Tracking:
    """One tag's tracker from the first beacon on."""

    def __init__(
        self,
        settings: TrackerSettings,
        z_bounds_m: tuple[float, float] | None = None,
        fix_time: FixTime | None = None,
        superframe_s: float = 0.0,
    ) -> None:
        """``fix_time``: the receiver's, where it outlives this method; ``superframe_s``: of slow sites."""
        self._settings = settings
        self._superframe_s = superframe_s
        self._max_spread = MAX_SPREAD if superframe_s < SLOW_S else SLOW_SPREAD
        self._z_bounds_m = z_bounds_m
        self._tracker = PseudorangeTracker(settings)
        self._speed_std_mps = SPEED_STD_MPS
        self._started_ticks = 0
        self._acquisition: Acquisition | None = self._new_acquisition()
        self._time = fix_time or FixTime()
        self._in_use = AnchorsInUse(superframe_s)
        self._heard_ticks = 0

    @property
    def state(self) -> NDArray[np.float64]:
        """The filter's state vector (a copy)."""
        return self._tracker.x.copy()

    def hear(self, observation: Observation) -> Fix | NoFixReason:
        """Take one observation; a fix for every accepted message once started.

        Anchors in the tag's own plane cannot tell its height: where that is known no better than to the anchors'
        extent, there is no fix.
        """
        if observation.tx_ticks_master is None:
            return NoFixReason.ACQUIRING
        if self._acquisition is None and self._is_out_of_reach(observation):
            self._acquisition = self._new_acquisition()
        if self._acquisition is not None:
            start = self._acquisition.hear(observation)
            if isinstance(start, NoFixReason):
                return start
            self._begin(start, observation)
            return self._fix(observation)
        doubt_m2 = (observation.rx_variance_factor - 1.0) * self._settings.stamp_variance_m2
        accepted = self._tracker.hear(
            observation.anchor_m,
            observation.rx_ticks_tag,
            observation.tx_ticks_master,
            observation.tx_fraction_ticks,
            observation.tx_variance_m2,
            doubt_m2,
        )
        self._heard_ticks = observation.rx_ticks_tag
        if not accepted:
            if self._tracker.lost:
                soon = (observation.rx_ticks_tag - self._started_ticks) * TICK_S < EARLY_S
                self._speed_std_mps = (
                    min(SPEED_STD_GROWTH * self._speed_std_mps, MAX_SPEED_STD_MPS) if soon else SPEED_STD_MPS
                )
                self._acquisition = self._new_acquisition()
            return NoFixReason.RESIDUALS
        self._in_use.use(observation)
        return self._fix(observation)

    def _new_acquisition(self) -> Acquisition:
        max_age_s = max(MAX_AGE_S, 2.5 * self._superframe_s)
        settings = self._settings
        return Acquisition(
            settings.height_m, settings.stamp_variance_m2, self._z_bounds_m, max_age_s, self._speed_std_mps
        )

    def _is_out_of_reach(self, observation: Observation) -> bool:
        """Whether the filter cannot predict up to here: too long a silence for it, or the tag's counter fell back."""
        silent_s = (observation.rx_ticks_tag - self._heard_ticks) * TICK_S
        if not 0.0 <= silent_s <= MAX_GAP_S:
            return True
        if silent_s < SHORT_SILENCE_S:
            return False
        std_m = self._tracker.horizontal_variance_m2(silent_s) ** 0.5
        return bool(std_m > self._max_spread * self._in_use.mean_range_m(self._tracker.x[: self._tracker.dim]))

    def _begin(self, start: Start, observation: Observation) -> None:
        self._acquisition = None
        self._heard_ticks = self._started_ticks = observation.rx_ticks_tag
        self._in_use.begin(start.used)
        self._tracker.start(
            start.rx_ticks_tag,
            start.whole_offset_ticks,
            start.solution,
            start.covariance,
            start.clock_rate_mps,
            start.clock_rate_variance,
            start.speed_variance,
        )

    def _fix(self, observation: Observation) -> Fix | NoFixReason:
        assert observation.tx_ticks_master is not None
        tracker, height_m, in_use = self._tracker, self._settings.height_m, self._in_use
        if height_m is None and tracker.P[2, 2] > in_use.extent_m**2:
            return NoFixReason.BAD_GEOMETRY
        time_s = self._time.time_s(observation.tx_ticks_master, observation.rx_ticks_tag)
        return motion_fix(
            time_s, tracker.x, tracker.P, height_m, in_use.anchors, in_use.anchors_m, tracker.statistics, "tracker"
        )
