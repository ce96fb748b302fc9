"""``tracker`` as a positioning method: cold start, message by message updates, and starting again when lost."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyless.constants import TICK_S
from skyless.positioning.acquisition import Acquisition, Start
from skyless.positioning.fix import Fix, NoFixReason, motion_fix
from skyless.positioning.observation import Observation
from skyless.positioning.tracker import PseudorangeTracker, TrackerSettings
from skyless.ticks import from_seconds

MAX_GAP_S: Final = 5.0
"""After a longer silence the state says less than a new start would."""

IN_USE_S: Final = 0.1
"""An anchor counts as in use while its last accepted message is younger."""


class Tracking:
    """One tag's tracker from the first beacon on."""

    def __init__(self, settings: TrackerSettings, z_bounds_m: tuple[float, float] | None = None) -> None:
        self._settings = settings
        self._z_bounds_m = z_bounds_m
        self._tracker = PseudorangeTracker(settings)
        self._acquisition: Acquisition | None = self._new_acquisition()
        self._first_ticks_master: int | None = None
        self._last: tuple[float, int] | None = None
        self._used: dict[int, Observation] = {}
        self._anchors: tuple[int, ...] = ()
        self._anchors_m: NDArray[np.float64] = np.empty((0, 3))
        self._checked_ticks = 0
        self._heard_ticks = 0

    @property
    def state(self) -> NDArray[np.float64]:
        """The filter's state vector (a copy)."""
        return self._tracker.x.copy()

    def hear(self, observation: Observation) -> Fix | NoFixReason:
        """Take one observation; a fix for every accepted message once started."""
        if observation.tx_ticks_master is None:
            return NoFixReason.ACQUIRING
        if self._acquisition is None and self._is_silent_too_long(observation):
            self._acquisition = self._new_acquisition()
        if self._acquisition is not None:
            start = self._acquisition.hear(observation)
            if isinstance(start, NoFixReason):
                return start
            self._begin(start, observation)
            return self._fix(observation)
        accepted = self._tracker.hear(
            observation.anchor_m,
            observation.rx_ticks_tag,
            observation.tx_ticks_master,
            observation.tx_fraction_ticks,
            observation.tx_variance_m2,
        )
        self._heard_ticks = observation.rx_ticks_tag
        if not accepted:
            if self._tracker.lost:
                self._acquisition = self._new_acquisition()
            return NoFixReason.RESIDUALS
        self._use(observation)
        return self._fix(observation)

    def _new_acquisition(self) -> Acquisition:
        return Acquisition(self._settings.height_m, self._settings.stamp_variance_m2, self._z_bounds_m)

    def _is_silent_too_long(self, observation: Observation) -> bool:
        return (observation.rx_ticks_tag - self._heard_ticks) * TICK_S > MAX_GAP_S

    def _begin(self, start: Start, observation: Observation) -> None:
        """Start the filter; where there was one before, the time of its fixes goes on by the tag's own clock."""
        self._acquisition = None
        self._heard_ticks = observation.rx_ticks_tag
        self._used.clear()
        self._use(observation)
        assert observation.tx_ticks_master is not None
        self._first_ticks_master = observation.tx_ticks_master
        if self._last is not None:
            last_s, last_rx_ticks = self._last
            self._first_ticks_master -= from_seconds(last_s) + observation.rx_ticks_tag - last_rx_ticks
        self._tracker.start(
            start.rx_ticks_tag,
            start.whole_offset_ticks,
            start.solution,
            start.covariance,
            start.clock_rate_mps,
            start.clock_rate_variance,
            start.speed_variance,
        )

    def _use(self, observation: Observation) -> None:
        """Remember which anchors are in use; their list is made anew only when it changes."""
        now = observation.rx_ticks_tag
        changed = observation.anchor not in self._used
        self._used[observation.anchor] = observation
        if (now - self._checked_ticks) * TICK_S > IN_USE_S:
            self._checked_ticks = now
            stale = [a for a, o in self._used.items() if (now - o.rx_ticks_tag) * TICK_S > IN_USE_S]
            changed = changed or bool(stale)
            for anchor in stale:
                del self._used[anchor]
        if changed:
            self._anchors = tuple(self._used)
            self._anchors_m = np.array([o.anchor_m for o in self._used.values()])

    def _fix(self, observation: Observation) -> Fix:
        assert observation.tx_ticks_master is not None
        assert self._first_ticks_master is not None
        time_s = (observation.tx_ticks_master - self._first_ticks_master) * TICK_S
        self._last = (time_s, observation.rx_ticks_tag)
        tracker, height_m = self._tracker, self._settings.height_m
        return motion_fix(
            time_s, tracker.x, tracker.P, height_m, self._anchors, self._anchors_m, tracker.statistics, "tracker"
        )
