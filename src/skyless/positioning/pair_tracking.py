"""Fixes from time differences of pairs: cold start from a window of them, then the filter, and again when lost."""

from collections import Counter, deque
from collections.abc import Sequence
from typing import Final

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from skyless.air.packet import PairTdoa, Point
from skyless.positioning.fix import Fix, NoFixReason, motion_fix
from skyless.positioning.pair_calibration import PairCalibration
from skyless.positioning.pair_tracker import PairSettings, PairTracker
from skyless.positioning.pairs import against_reference
from skyless.positioning.solver import NoSolution, Solution, locate

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

STEADY_S: Final = 2.0
STEADY_SHARE: Final = 0.4
"""So long after a start, or while a larger share of the differences lies beyond it, the narrow gate stays open."""

MAX_STD_M: Final = 3.0
"""While the horizontal standard deviation is larger, there is no fix; a silence that makes it so means a new start."""

SHORT_SILENCE_S: Final = 0.1
"""Over shorter silences no state grows much wider."""

TRY_EVERY: Final = 6
"""Differences between two attempts at a start."""

NEIGHBOURHOOD: Final = 1.5
"""A tag farther from the anchors' centre than this part of their figure's diagonal, in x or y, is lost."""


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

        ``calibration`` is taken off every difference, and narrows the gate while all goes well.
        """
        self._calibration = calibration
        self._narrow_gate = settings.gate if calibration is None else calibration.gate(settings)
        self.counters: Counter[str] = Counter()
        self.reason: NoFixReason = NoFixReason.NO_BEACONS
        self._settings = settings
        self._places = {anchor: np.array(place) for anchor, place in anchors_m.items()}
        self._z_bounds_m = z_bounds_m
        self._tracker = PairTracker(settings)
        self._window: deque[PairTdoa] = deque(maxlen=WINDOW)
        self._started = False
        self._started_s = self._last_s = 0.0
        self._heard_s: dict[int, float] = {}
        self._since_try = 0
        self._area_m = (0.0, 0.0, 0.0)
        self._extent_m = 0.0

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
                used = self._take(self._calibrated(pair, *places), *places) or used
        return used and self._started and self._is_sane()

    def _places_of(self, pair: PairTdoa) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        places = self._places
        if pair.a_m is not None:
            places[pair.anchor_a] = np.array(pair.a_m)
        if pair.b_m is not None:
            places[pair.anchor_b] = np.array(pair.b_m)
        a_m, b_m = places.get(pair.anchor_a), places.get(pair.anchor_b)
        return None if a_m is None or b_m is None else (a_m, b_m)

    def _calibrated(self, pair: PairTdoa, a_m: NDArray[np.float64], b_m: NDArray[np.float64]) -> PairTdoa:
        """The difference without the anchors' biases, those that change with the range as at the last position."""
        if self._calibration is None:
            return pair
        at_m = self.position_m if self._started else None
        correction_m = self._calibration.correction_m(pair, _point(a_m), _point(b_m), at_m)
        return structs.replace(pair, tdoa_m=pair.tdoa_m + correction_m)

    def _take(self, pair: PairTdoa, a_m: NDArray[np.float64], b_m: NDArray[np.float64]) -> bool:
        time_s = pair.time_s
        dt_s = time_s - self._last_s
        if self._started and self._is_out_of_reach(dt_s):
            self._stop()
        self._last_s = time_s
        if not self._started:
            return self._try_start(pair)
        self._tracker.set_gate(self._narrow_gate if self._is_steady(time_s) else self._settings.gate)
        if self._tracker.hear(a_m, b_m, dt_s, pair.tdoa_m):
            self._heard_s[pair.anchor_a] = self._heard_s[pair.anchor_b] = time_s
            return True
        self.counters["outlier"] += 1
        self.reason = NoFixReason.RESIDUALS
        if self._tracker.lost:
            self._stop()
        return False

    def _is_steady(self, time_s: float) -> bool:
        """Whether the state can be trusted with a narrow gate, behind which a wrong one would stay wrong."""
        return time_s - self._started_s > STEADY_S and self._tracker.rejected_share < STEADY_SHARE

    def _is_out_of_reach(self, dt_s: float) -> bool:
        """Whether the filter cannot predict so far: too long a silence for it, or a clock that went back."""
        if not 0.0 <= dt_s <= MAX_GAP_S:
            return True
        return dt_s > SHORT_SILENCE_S and self._tracker.horizontal_variance_m2(dt_s) > MAX_STD_M**2

    def _is_sane(self) -> bool:
        """Whether the state is near the anchors, beyond which differences tell nothing, and known well enough."""
        x_m, y_m, radius_m = self._area_m
        x, P = self._tracker.x, self._tracker.P
        if abs(x[0] - x_m) > radius_m or abs(x[1] - y_m) > radius_m:
            self.reason = NoFixReason.NOT_CONVERGED
            self._stop()
            return False
        if P[0, 0] + P[1, 1] > MAX_STD_M**2:
            self.reason = NoFixReason.ACQUIRING
            return False
        if self._tracker.dim == 3 and P[2, 2] > self._extent_m**2:
            self.reason = NoFixReason.BAD_GEOMETRY
            return False
        return True

    @property
    def position_m(self) -> tuple[float, float, float]:
        """The newest position."""
        x, _, *z = self._tracker.x[: self._tracker.dim].tolist()
        return x, float(self._tracker.x[1]), z[0] if z else self._settings.height_m or 0.0

    def fix(self) -> Fix:
        """The newest position with all that is known of it; only after a ``hear`` that made one."""
        used = [anchor for anchor, when_s in self._heard_s.items() if self._last_s - when_s <= IN_USE_S]
        anchors_m = np.array([self._places[anchor] for anchor in used]).reshape(-1, 3)
        tracker, height_m = self._tracker, self._settings.height_m
        return motion_fix(
            self._last_s, tracker.x, tracker.P, height_m, tuple(used), anchors_m, tracker.statistics, "tracker"
        )

    def _stop(self) -> None:
        """Forget the state; a new start is looked for."""
        self.counters["restart"] += 1
        self._started = False
        self._window.clear()

    def _try_start(self, pair: PairTdoa) -> bool:
        """Look for a start at every sixth difference; medians of each pair keep single outliers out of it."""
        self._window.append(pair)
        while pair.time_s - self._window[0].time_s > WINDOW_S:
            self._window.popleft()
        self._since_try += 1
        if self._since_try < TRY_EVERY:
            return False
        self._since_try = 0
        solution = self._solve()
        if isinstance(solution, NoSolution):
            self.reason = solution.reason
            return False
        dim = self._tracker.dim
        self._tracker.start(solution.position_m[:dim], solution.covariance_m2[:dim, :dim], SPEED_STD_MPS**2)
        self._started, self._started_s = True, pair.time_s
        self._heard_s = {anchor: pair.time_s for kept in self._window for anchor in (kept.anchor_a, kept.anchor_b)}
        self._window.clear()
        self.counters["start"] += 1
        return True

    def _solve(self) -> Solution | NoSolution:
        grouped: dict[tuple[int, int], list[float]] = {}
        for pair in self._window:
            grouped.setdefault((pair.anchor_a, pair.anchor_b), []).append(pair.tdoa_m)
        values = [float(np.median(group)) for group in grouped.values()]
        variance = self._settings.tdoa_std_m**2
        joined = against_reference(list(grouped), values, [variance] * len(values))
        if not joined.anchors:
            return NoSolution(NoFixReason.TOO_FEW_ANCHORS, "no pair of anchors was heard")
        anchors_m = np.array([self._places[anchor] for anchor in joined.anchors])
        self._extent_m = float(np.ptp(anchors_m, axis=0).max())
        low, high = anchors_m.min(axis=0)[:2], anchors_m.max(axis=0)[:2]
        x_m, y_m = ((low + high) / 2.0).tolist()
        self._area_m = (x_m, y_m, NEIGHBOURHOOD * max(float(np.linalg.norm(high - low)), 5.0))
        return locate(
            anchors_m,
            joined.tdoa_m,
            joined.covariance_m2,
            height_m=self._settings.height_m,
            z_bounds_m=self._z_bounds_m,
        )


def _point(place_m: NDArray[np.float64]) -> Point:
    x_m, y_m, z_m = place_m.tolist()
    return x_m, y_m, z_m
