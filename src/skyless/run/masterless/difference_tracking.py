"""Fixes from given time differences: a start from a window of them, then the estimator; a new start when lost."""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from itertools import combinations, product
from math import dist
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from skyless.core.air.masterless_packets import PairTdoa
from skyless.core.arrays import Array
from skyless.core.estimator.estimator import Estimator
from skyless.core.estimator.process import ACCEPTED
from skyless.core.estimator.settings import TUNING, EstimatorSettings
from skyless.core.estimator.state import at
from skyless.core.fix import Fix, NoFixReason
from skyless.core.integrity import CONTRADICTED, SOUND, IntegrityRequirement
from skyless.core.motion_sample import MotionSample
from skyless.core.native.records import MAX_ANCHORS
from skyless.core.tag.position import NoSolution, locate
from skyless.core.ticks import TICK_RATE_HZ
from skyless.site.survey.anchor_errors import KNOWN_STD_M, DifferenceCalibration

DIFFERENCES: Final = EstimatorSettings(
    start_speed_std_mps=1.0,
    gate=3.0,
    white=0.0,
    walk=0.0,
    drop_s=30.0,
    range_std_m=0.04,
    slope_std_m=0.02,
    place_std_m=0.12,
    place_distance_m=0.5,
    place_time_s=30.0,
    change_memory_s=1.5,
    earliest_m=-0.25,
    stationary_s=3.0,
)
"""Settings from recorded flights of DW1000s (docs/recordings.md): reflections change within half a metre, by amounts
that differ between anchors."""

_XX, _YY, _ZZ = (at(axis, axis) for axis in range(3))


class DifferenceTracking:
    """Tracks one tag from differences of its ranges to pairs of anchors."""

    def __init__(
        self,
        settings: EstimatorSettings,
        anchors_m: dict[int, tuple[float, float, float]],
        z_bounds_m: tuple[float, float] | None = None,
        calibration: DifferenceCalibration | None = None,
    ) -> None:
        """``anchors_m``: the anchors' positions, not needed for differences that contain them.

        ``calibration`` is subtracted from every difference; anchors without one are taken as typical.
        """
        self._calibration = DifferenceCalibration({}) if calibration is None else calibration
        self.counters: Counter[str] = Counter()
        self.reason: NoFixReason = NoFixReason.NO_BEACONS
        self.used: list[bool] = []
        """For each difference of the last update, whether the filter used it."""
        is_calibrated = bool(self._calibration.anchors)
        self._settings = settings.changed(
            difference_std_m=self._calibration.difference_std_m(settings.difference_std_m),
            range_std_m=min(settings.range_std_m, KNOWN_STD_M) if is_calibrated else settings.range_std_m,
            lowest_m=settings.lowest_m if z_bounds_m is None else z_bounds_m[0],
            highest_m=settings.highest_m if z_bounds_m is None else z_bounds_m[1],
        )
        self._asked = IntegrityRequirement(settings.integrity_risk, settings.alert_limit)
        self._positions_m = {anchor: np.array(point) for anchor, point in anchors_m.items()}
        self._z_bounds_m = z_bounds_m
        self.estimator = Estimator(self._settings)
        """The filter with all its states."""
        self._window: deque[PairTdoa] = deque(maxlen=int(TUNING.window))
        self._begin_s = self._newest_s = 0.0
        self._received_s: dict[int, float] = {}
        self._in_use: tuple[tuple[int, ...], Array] = ((), np.empty((0, 3)))
        """The anchors of the newest fix, and their positions."""
        self._tried_s = -np.inf
        self._start: Start | None = None
        self._is_confirmed = False

    @property
    def has_started(self) -> bool:
        """Whether the filter has a state."""
        return self._start is not None

    def update_height(self, height_m: float, std_m: float, is_barometer: bool = False) -> None:
        """Process a reading of the tag's height sensor at the time of the newest difference."""
        if self.has_started and self.estimator.process_height(height_m, std_m, is_barometer) != ACCEPTED:
            self.counters["outlier-height"] += 1

    def hear_motion(self, sample: MotionSample) -> None:
        """Process what a motion sensor shows; its times are those of the differences. Raises ValueError."""
        sample.check()
        self.estimator.hear_motion(self.ticks(sample.time_s), sample)

    def update(self, pairs: Sequence[PairTdoa]) -> bool:
        """Process the differences of one reception; receptions must be in the order of time.

        Returns whether they gave a fix; if not, ``reason`` states why.
        """
        self.used = []
        for pair in pairs:
            is_known = self._update_positions(pair)
            self.used.append(is_known and self._add(pair))
            if not is_known:
                self.counters["unknown-anchor"] += 1
                self.reason = NoFixReason.NO_ALMANAC
        return any(self.used) and self._start is not None and self._is_plausible()

    def _update_positions(self, pair: PairTdoa) -> bool:
        """Take positions from a difference. Returns whether the positions of both anchors are known."""
        positions_m = self._positions_m
        for anchor, place_m in ((pair.anchor_a, pair.a_m), (pair.anchor_b, pair.b_m)):
            if place_m is not None:
                positions_m[anchor] = np.array(place_m)
                self._in_use = ((), self._in_use[1])
        return pair.anchor_a in positions_m and pair.anchor_b in positions_m

    def _add(self, pair: PairTdoa) -> bool:
        if self._start is not None and self._is_out_of_reach(pair.time_s - self._newest_s):
            self._stop()
        self._newest_s = pair.time_s
        begins = not self._is_confirmed and self._is_time_to_start(pair) and self._try_start()
        if self._start is None:
            return False
        used = begins or self._process(pair)
        if used:
            self._received_s[pair.anchor_a] = self._received_s[pair.anchor_b] = pair.time_s
        else:
            self.counters["outlier"] += 1
            self.reason = NoFixReason.RESIDUALS
        if self.estimator.rejects_most:
            self._stop()
        return used

    def _process(self, pair: PairTdoa) -> bool:
        """Pass a difference to the filter, less the calibrated or typical errors of its anchors."""
        position_m = self.position_m
        error_m = self._calibration.error_m(pair.anchor_b, dist(position_m, self._positions_m[pair.anchor_b]))
        error_m -= self._calibration.error_m(pair.anchor_a, dist(position_m, self._positions_m[pair.anchor_a]))
        for anchor in (pair.anchor_a, pair.anchor_b):
            self.estimator.know_anchor(anchor, self._positions_m[anchor])
        found = self.estimator.process_difference(
            pair.anchor_a, pair.anchor_b, self.ticks(pair.time_s), pair.tdoa_m - error_m
        )
        return found == ACCEPTED

    def ticks(self, time_s: float) -> int:
        """Convert a time to the filter's ticks."""
        return round((time_s - self._begin_s) * TICK_RATE_HZ)

    def _is_out_of_reach(self, silent_s: float) -> bool:
        """Whether the filter cannot predict over this silence: it is too long, or the clock went back."""
        if not 0.0 <= silent_s <= TUNING.longest_silence_s:
            return True
        is_short = silent_s <= TUNING.short_silence_s
        return not is_short and self.estimator.horizontal_variance_m2(silent_s) > TUNING.most_horizontal_std_m**2

    def _is_plausible(self) -> bool:
        """Whether the state is near the anchors, where differences have information, and accurate enough."""
        start, state, dim = self._start, self.estimator.state, self.estimator.dim
        if start is None or not is_within(start.corners_m, self.position_m[:dim]):
            self.reason = NoFixReason.NOT_CONVERGED
            self._stop()
            return False
        if state.P[_XX] + state.P[_YY] > TUNING.most_horizontal_std_m**2:
            self.reason = NoFixReason.ACQUIRING
            return False
        if dim == 3 and state.P[_ZZ] > TUNING.most_horizontal_std_m**2:
            self.reason = NoFixReason.BAD_GEOMETRY
            return False
        return True

    @property
    def position_m(self) -> tuple[float, float, float]:
        """The newest position."""
        x = self.estimator.state.x
        return x[0], x[1], x[2] if self.estimator.dim == 3 else self._settings.height_m

    def fix(self) -> Fix:
        """The newest fix; only after an ``update`` that gave one."""
        now_s, age_s = self._newest_s, TUNING.start_age_s
        used = tuple([anchor for anchor, when_s in self._received_s.items() if now_s - when_s <= age_s])
        if used != self._in_use[0]:
            self._in_use = used, np.array([self._positions_m[anchor] for anchor in used]).reshape(-1, 3)
        rows, known = self.estimator.rows, self._settings.known_height_m is not None
        return Fix(self._newest_s, rows, used, self._in_use[1], "joint", known, 1, self._asked)

    def _stop(self) -> None:
        """Forget the state, so that a new start is searched for."""
        self.counters["restart"] += 1
        self._start = None
        self._is_confirmed = False
        self._window.clear()

    def _is_time_to_start(self, pair: PairTdoa) -> bool:
        """Add a difference to the window. Returns whether to try a start now."""
        window = self._window
        while window and not 0.0 <= pair.time_s - window[0].time_s <= TUNING.longest_silence_s:
            window.popleft()
        window.append(pair)
        is_enough = len(window) == TUNING.window or pair.time_s - window[0].time_s >= TUNING.window_s
        every_s = TUNING.short_silence_s if self._start is None else TUNING.window_s
        return is_enough and not 0.0 <= pair.time_s - self._tried_s < every_s

    def _try_start(self) -> bool:
        """Search for a start, or for one that confirms or contradicts the current one. Returns True if it is used."""
        window, dim = self._window, self.estimator.dim
        self._tried_s = self._newest_s
        if TUNING.moving_window <= len(window) < TUNING.window:
            start = self._find_moving_start()
        else:
            height_m = self._settings.known_height_m
            start = find_start(window, self._positions_m, self._calibration, height_m, self._z_bounds_m)
        if isinstance(start, NoSolution):
            self.reason = start.reason
            return False
        if self._start is not None:
            position_m, covariance_m2 = (array[..., :dim] for array in self.estimator.motion())
            gap_m = position_m - start.position_m[:dim]
            both_m2 = covariance_m2[:dim] + start.covariance_m2[:dim, :dim]
            if start.is_ambiguous or gap_m @ np.linalg.solve(both_m2, gap_m) < TUNING.apart_chi2:
                has_moved = bool(np.linalg.norm(position_m - self._start.position_m[:dim]) > TUNING.rival_m)
                self._is_confirmed = has_moved or not start.is_ambiguous
                self.estimator.withhold_levels(SOUND if self._is_confirmed else CONTRADICTED)
                window.clear()
                return False
            self.counters["restart"] += 1
        newest = window[-1]
        self.estimator.shift_motion(-self.ticks(self._newest_s))
        self._begin_s = self._newest_s
        x, P = start.motion or (start.position_m[:dim], start.covariance_m2[:dim, :dim])
        self.estimator.start(0, x, P, self._settings.start_speed_std_mps**2)
        self.estimator.withhold_levels(CONTRADICTED)
        self._start = start
        for anchor, (late_m, variance_m2) in start.late.items():
            may_stay = anchor not in self._calibration.anchors  # a calibrated anchor has no constant lateness
            self.estimator.know_anchor(anchor, self._positions_m[anchor])
            self.estimator.expect_late(anchor, late_m, variance_m2, may_stay)
        self._received_s = {anchor: self._newest_s for kept in window for anchor in (kept.anchor_a, kept.anchor_b)}
        self.counters["start"] += 1
        window.clear()
        return self._process(newest)

    def _find_moving_start(self) -> "Start | NoSolution":
        """Find a start from differences during which the tag may have moved.

        The filter itself runs over the newest of them from several places. The run with the smallest innovations is
        right, unless one that ends elsewhere is nearly as good.
        """
        window, dim = list(self._window)[-int(TUNING.moving_window) :], self.estimator.dim
        anchors_m = np.array(
            [self._positions_m[anchor] for pair in window for anchor in (pair.anchor_a, pair.anchor_b)]
        )
        corners_m, low, high = neighbourhood_m(anchors_m), anchors_m.min(axis=0), anchors_m.max(axis=0)
        runs: list[tuple[float, Array, Array]] = []
        filtered = DifferenceTracking(self._settings, {}, None, self._calibration)
        filtered._positions_m, filtered._begin_s = self._positions_m, window[0].time_s
        for share in product(*PLACES[:dim]):
            estimator = filtered.estimator
            place_m = low[:dim] + np.array(share) * (high - low)[:dim]
            estimator.start(0, place_m, TUNING.moving_std_m**2 * np.eye(dim), self._settings.start_speed_std_mps**2)
            status, misfit = estimator.state.status, 0.0
            for pair in window:
                before = status.mean_nis
                is_used = filtered._process(pair)
                nis = (status.mean_nis - before) / TUNING.forgetting + before
                misfit += nis if is_used else self._settings.gate**2
            runs.append((misfit, *estimator.motion()))
        misfit, x, P = min(runs, key=lambda run: run[0])
        if misfit > TUNING.moving_nis * len(window):
            return NoSolution(NoFixReason.RESIDUALS, "no position fits these differences")
        rivals = [run[0] for run in runs if dist(run[1][:dim], x[:dim]) > TUNING.rival_m]
        position_m, covariance_m2 = np.zeros(3), np.zeros((3, 3))
        position_m[:dim], covariance_m2[:dim, :dim] = x[:dim], P[:dim, :dim]
        if not is_within(corners_m, position_m[:dim].tolist()) or np.trace(covariance_m2) > TUNING.late_std_m**2:
            return NoSolution(NoFixReason.NOT_CONVERGED, "the position is not determined")
        is_ambiguous = min(rivals, default=np.inf) < misfit + TUNING.moving_apart
        return Start(position_m, covariance_m2, {}, is_ambiguous, corners_m, (x, P))


# Start


PLACES: Final = ((0.2, 0.5, 0.8), (0.2, 0.5, 0.8), (0.25, 0.75))
"""Shares of the anchors' extent from which the filter searches for a moving tag."""

JOINING_STEPS: Final = 4  # iterations of reweighted least squares

Corners = tuple[tuple[float, ...], tuple[float, ...]]
"""Opposite corners of a space, x, y and z each."""


class Start(Struct, frozen=True):
    """Initial state of a filter."""

    position_m: Array
    """Shape (3,)."""
    covariance_m2: Array
    """Shape (3, 3), including the spread of all hypotheses."""
    late: dict[int, list[float]]
    """Expected lateness of each anchor, and its variance."""
    is_ambiguous: bool
    """Whether another position fits nearly as well, or some anchor is late."""
    corners_m: Corners
    """Of the neighbourhood of the anchors."""
    motion: tuple[Array, Array] | None = None
    """Position and velocity, shape (2·dim,), and their covariance, of a tag that may be moving."""


def neighbourhood_m(anchors_m: Array) -> Corners:
    """Corners of the space around the anchors in which time differences have information."""
    low, high = anchors_m.min(axis=0), anchors_m.max(axis=0)
    reach_m = TUNING.neighbourhood * np.linalg.norm((high - low)[:2])
    middle_m = (low + high) / 2.0
    return tuple((middle_m - reach_m).tolist()), tuple((middle_m + reach_m).tolist())


def is_within(corners_m: Corners, position_m: Sequence[float]) -> bool:
    """Whether a position, of two or three coordinates, is between two corners."""
    low_m, high_m = corners_m
    return all(low <= at_m <= high for low, at_m, high in zip(low_m, position_m, high_m, strict=False))


def find_start(
    window: Sequence[PairTdoa],
    positions_m: Mapping[int, Array],
    calibration: DifferenceCalibration,
    height_m: float | None,
    z_bounds_m: tuple[float, float] | None,
) -> Start | NoSolution:
    """Find a start: mean and covariance of the position over all hypotheses about late anchors, by probability.

    Anchors are never early. Late ones are considered only with a whole window, and two spare degrees of freedom.
    """
    grouped: dict[tuple[int, int], list[float]] = {}
    for pair in window:
        if np.isfinite(pair.tdoa_m) and pair.anchor_a != pair.anchor_b:
            without_bias_m = pair.tdoa_m - calibration.constant_m(pair)
            grouped.setdefault((pair.anchor_a, pair.anchor_b), []).append(without_bias_m)
    if not grouped:
        return NoSolution(NoFixReason.TOO_FEW_ANCHORS, "no pair of anchors was heard")
    anchors, tdoa_m, joined_m2 = joined_tdoas(list(grouped), [np.median(group) for group in grouped.values()])
    anchors, most_tdoas = anchors[:MAX_ANCHORS], slice(MAX_ANCHORS - 1)
    tdoa_m, joined_m2 = tdoa_m[most_tdoas], joined_m2[most_tdoas, most_tdoas]
    dim, anchors_m = 3 if height_m is None else 2, np.array([positions_m[anchor] for anchor in anchors])
    low, high, count = anchors_m.min(axis=0), anchors_m.max(axis=0), len(anchors_m)
    if z_bounds_m is None and high[2] - low[2] > TUNING.height_margin_m:
        z_bounds_m = (low[2] - TUNING.height_margin_m, high[2] + TUNING.height_margin_m)
    low_m, high_m = z_bounds_m if z_bounds_m and height_m is None else (-np.inf, np.inf)
    shares = np.vstack([-np.ones(count - 1), np.eye(count - 1)])  # of each anchor's error in the TDoAs
    usual_m2 = joined_m2 + TUNING.late_start_std_m**2 * shares.T @ shares
    most = min(int(TUNING.most_late), max(count - dim - 3, 0)) if len(window) == TUNING.window else 0
    hypotheses: list[tuple[float, Array, Array, Array]] = []
    reason = NoSolution(NoFixReason.RESIDUALS, "more anchors are late than the others can show")
    for some in (list(some) for size in range(most + 1) for some in combinations(range(count), size)):
        sigma_m2 = usual_m2 + TUNING.late_std_m**2 * shares[some].T @ shares[some]
        found = locate(
            anchors_m, tdoa_m, sigma_m2, height_m=height_m, z_bounds_m=z_bounds_m, residual_tail=TUNING.start_tail
        )
        if isinstance(found, NoSolution):
            reason = reason if some else found
            continue
        late_m = TUNING.late_std_m**2 * shares @ np.linalg.solve(sigma_m2, found.residuals_m)
        if all(late_m[some] > 0.0) and low_m <= found.position_m[2] <= high_m:
            score = found.chi2 + float(np.linalg.slogdet(sigma_m2)[1]) + TUNING.late_penalty * len(some)
            misfit = max(1.0, found.chi2 / max(found.dof, 1))
            expected = np.array([late_m, np.full(count, TUNING.late_std_m**2)]) * np.isin(np.arange(count), some)
            hypotheses.append((score, found.position_m, misfit * found.covariance_m2, expected))
    if not hypotheses:
        return reason
    scores, positions, covariances, lates = (np.array(column) for column in zip(*hypotheses, strict=True))
    weights = np.exp(0.5 * (scores.min() - scores))
    weights /= weights.sum()
    position_m = weights @ positions
    off_m = positions - position_m
    covariance_m2 = np.tensordot(weights, covariances + off_m[:, :, None] * off_m[:, None, :], 1)
    best_m = positions[int(np.argmin(scores))]
    has_rival = np.any((np.linalg.norm(positions - best_m, axis=1) > TUNING.rival_m) & (weights > TUNING.start_tail))
    late = dict(zip(anchors, np.tensordot(weights, lates, 1).T.tolist(), strict=True))
    is_ambiguous = bool(has_rival) or sum(variance for _, variance in late.values()) > 0.5 * TUNING.late_std_m**2
    start = Start(position_m, covariance_m2, late, is_ambiguous, neighbourhood_m(anchors_m))
    if not is_within(start.corners_m, position_m[:dim].tolist()):
        return NoSolution(NoFixReason.NOT_CONVERGED, "the position lies far from all anchors")
    return start


def joined_tdoas(pairs: Sequence[tuple[int, int]], differences_m: ArrayLike) -> tuple[tuple[int, ...], Array, Array]:
    """Best linear estimate of TDoAs to one reference anchor from measurements ``|p − b| − |p − a|`` of pairs (a, b).

    Returns the anchors, the reference first, the TDoAs, and their covariance. Least squares are reweighted so that
    outliers count by their absolute value. If the pairs are not all linked, the largest part is used.
    """
    anchors, index = np.unique(pairs, return_inverse=True)
    a, b = index.reshape(-1, 2).T
    H = np.eye(len(anchors))[b] - np.eye(len(anchors))[a]
    linked = np.linalg.matrix_power(H.T @ H != 0.0, len(anchors))
    part = np.flatnonzero(linked[np.argmax(linked.sum(axis=1))])
    used = H[:, part].any(axis=1)
    H, measured_m, weights = H[np.ix_(used, part[1:])], np.array(differences_m)[used], np.ones((used.sum(), 1))
    std_m = TUNING.median_difference_std_m
    for _ in range(JOINING_STEPS):
        covariance: Array = np.asarray(np.linalg.inv(H.T @ (weights * H)), np.float64)
        tdoa_m = covariance @ H.T @ (weights[:, 0] * measured_m)
        weights = (std_m / np.fmax(np.abs(measured_m - H @ tdoa_m), std_m))[:, None]
    return tuple(anchors[part].tolist()), tdoa_m, std_m**2 * covariance
