"""Fixes from time differences of pairs: cold start from a window of them, then the filter, and again when lost."""

from collections import Counter, deque
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyless.air.packet import PairTdoa
from skyless.positioning.fix import Fix, NoFixReason, motion_fix
from skyless.positioning.pair_calibration import PairCalibration
from skyless.positioning.pair_rest import Rest
from skyless.positioning.pair_start import Start, find_start
from skyless.positioning.pair_state import PairArrays, PairSettings
from skyless.positioning.pair_tracker import PairTracker
from skyless.positioning.solver import NoSolution

WINDOW: Final = 60
"""Differences that a start looks at, the newest ones ..."""

WINDOW_S: Final = 20.0
"""... and none older than this."""

MAX_GAP_S: Final = 10.0
"""After a longer silence the state says less than a new start would."""

SPEED_STD_MPS: Final = 1.0
"""Of the velocity at the start."""

IN_USE_S: Final = 0.5
"""An anchor counts as in use while its last accepted difference is younger."""

MAX_STD_M: Final = 3.0
"""While the horizontal standard deviation is larger, there is no fix; a silence that makes it so means a new start."""

SHORT_SILENCE_S: Final = 0.1
"""Over shorter silences no state grows much wider."""

TRY_EVERY: Final = 6
"""Differences between two attempts at a start."""

AFTER_LOSS: Final = 30
AFTER_LOSS_S: Final = 1.0
"""Where a state was just wrong, a new start waits for so many differences or so long."""


class PairTracking:
    """One tag that hears pairs of anchors."""

    def __init__(
        self,
        settings: PairSettings,
        anchors_m: dict[int, tuple[float, float, float]],
        z_bounds_m: tuple[float, float] | None = None,
        calibration: PairCalibration | None = None,
    ) -> None:
        """``anchors_m`` places the anchors; a difference that brings its own positions needs none.

        ``calibration`` is taken off every difference; anchors that are not in it are taken for ordinary ones.
        """
        self._calibration = PairCalibration({}) if calibration is None else calibration
        self.counters: Counter[str] = Counter()
        self.reason: NoFixReason = NoFixReason.NO_BEACONS
        self._settings = settings
        self._places = {anchor: np.array(place) for anchor, place in anchors_m.items()}
        self._z_bounds_m = z_bounds_m
        self._tracker = PairTracker(settings, self._calibration)
        self._rest = Rest(self._tracker)
        self._window: deque[PairTdoa] = deque(maxlen=WINDOW)
        self._last_s = 0.0
        self._heard_s: dict[int, float] = {}
        self._since_try = 0
        self._start: Start | None = None
        self._was_wrong = False

    def hear(self, pairs: Sequence[PairTdoa]) -> bool:
        """Take the differences of one reception, receptions in the order of time.

        True if they made a fix, else ``reason`` says why not.
        """
        used = False
        for pair in pairs:
            places = self._places_of(pair)
            if places is None:
                self.counters["unknown-anchor"] += 1
                self.reason = NoFixReason.NO_ALMANAC
            else:
                used = self._take(pair, *places) or used
        return used and self._start is not None and self._is_sane()

    def _places_of(self, pair: PairTdoa) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        places = self._places
        if pair.a_m is not None:
            places[pair.anchor_a] = np.array(pair.a_m)
        if pair.b_m is not None:
            places[pair.anchor_b] = np.array(pair.b_m)
        a_m, b_m = places.get(pair.anchor_a), places.get(pair.anchor_b)
        return None if a_m is None or b_m is None else (a_m, b_m)

    def _take(self, pair: PairTdoa, a_m: NDArray[np.float64], b_m: NDArray[np.float64]) -> bool:
        time_s = pair.time_s
        dt_s = time_s - self._last_s
        if self._start is not None and self._is_out_of_reach(dt_s):
            self._stop()
        self._last_s = time_s
        if self._start is None:
            return self._try_start(pair)
        used = self._tracker.hear(pair.anchor_a, pair.anchor_b, a_m, b_m, dt_s, pair.tdoa_m)
        tracker = self._tracker
        self._rest.hear(tracker.slot(pair.anchor_a), tracker.slot(pair.anchor_b), a_m, b_m, dt_s, pair.tdoa_m)
        if used:
            self._heard_s[pair.anchor_a] = self._heard_s[pair.anchor_b] = time_s
        else:
            self.counters["outlier"] += 1
            self.reason = NoFixReason.RESIDUALS
        if self._tracker.lost:
            self._stop()
            self._was_wrong = True
        return used

    def _is_out_of_reach(self, dt_s: float) -> bool:
        """Whether the filter cannot predict so far: too long a silence for it, or a clock that went back."""
        if not 0.0 <= dt_s <= MAX_GAP_S:
            return True
        return dt_s > SHORT_SILENCE_S and self._tracker.horizontal_variance_m2(dt_s) > MAX_STD_M**2

    def _is_sane(self) -> bool:
        """Whether the state is near the anchors, beyond which differences tell nothing, and known well enough."""
        start, x, P = self._start, self._tracker.x, self._tracker.P
        if start is None or not start.holds(x[: self._tracker.dim]):
            self.reason = NoFixReason.NOT_CONVERGED
            self._stop()
            return False
        if P[0, 0] + P[1, 1] > MAX_STD_M**2:
            self.reason = NoFixReason.ACQUIRING
            return False
        if self._tracker.dim == 3 and P[2, 2] > start.extent_m**2:
            self.reason = NoFixReason.BAD_GEOMETRY
            return False
        return True

    @property
    def position_m(self) -> tuple[float, float, float]:
        """The newest position."""
        x, y, *z = self._believed.x[: self._tracker.dim].tolist()
        return x, y, z[0] if z else self._settings.height_m or 0.0

    @property
    def _believed(self) -> PairArrays:
        """The state that counts: the one at rest while that lasts."""
        return self._rest.arrays if self._rest.lasts else self._tracker.arrays

    def fix(self) -> Fix:
        """The newest position with all that is known of it; only after a ``hear`` that made one."""
        used = [anchor for anchor, when_s in self._heard_s.items() if self._last_s - when_s <= IN_USE_S]
        anchors_m = np.array([self._places[anchor] for anchor in used]).reshape(-1, 3)
        s, height_m = self._believed, self._settings.height_m
        return motion_fix(self._last_s, s.x, s.P, height_m, tuple(used), anchors_m, s.statistics, "tracker")

    def _stop(self) -> None:
        """Forget the state; a new start is looked for."""
        self.counters["restart"] += 1
        self._start = None
        self._was_wrong = False
        self._window.clear()

    def _try_start(self, pair: PairTdoa) -> bool:
        """Look for a start at every sixth difference; medians of each pair keep single outliers out of it."""
        self._window.append(pair)
        while pair.time_s - self._window[0].time_s > WINDOW_S:
            self._window.popleft()
        self._since_try += 1
        if self._since_try < TRY_EVERY or (self._was_wrong and not self._is_enough_after_loss()):
            return False
        self._since_try = 0
        start = find_start(self._window, self._places, self._calibration, self._settings.height_m, self._z_bounds_m)
        if isinstance(start, NoSolution):
            self.reason = start.reason
            return False
        dim, solution = self._tracker.dim, start.solution
        self._tracker.start(solution.position_m[:dim], solution.covariance_m2[:dim, :dim], SPEED_STD_MPS**2)
        if start.without is not None:
            self._tracker.leave_out(start.without)
        self._rest.begin()
        self._start = start
        self._heard_s = {anchor: pair.time_s for kept in self._window for anchor in (kept.anchor_a, kept.anchor_b)}
        self._window.clear()
        self.counters["start"] += 1
        return True

    def _is_enough_after_loss(self) -> bool:
        return len(self._window) >= AFTER_LOSS or self._last_s - self._window[0].time_s >= AFTER_LOSS_S
