"""Fixes from ready-made time differences: a start from a window of them, then the estimator, and again when lost."""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from math import dist
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import ArrayLike

from skyless.air.masterless_packets import PairTdoa
from skyless.constants import TICK_RATE_HZ
from skyless.kernels.arrays import Array
from skyless.positioning.estimator.estimator import ACCEPTED, Estimator
from skyless.positioning.estimator.state import EstimatorSettings
from skyless.positioning.fix import Fix, NoFixReason
from skyless.positioning.integrity import IntegrityRequirement
from skyless.positioning.masterless.anchor_errors import KNOWN_STD_M, DifferenceCalibration
from skyless.positioning.methods.locate import NoSolution, Solution, locate

DIFFERENCES: Final = EstimatorSettings(
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
    stationary_s=3.0,
)
"""What recorded flights of DW1000s show (docs/recordings.md): reflections change within half a metre, and by how much
differs from anchor to anchor."""

WINDOW: Final = 60
"""Differences that a start uses, the newest ones ..."""

WINDOW_S: Final = 20.0
"""... and none older than this."""

MAX_DIFFERENCE_SILENCE_S: Final = 10.0
"""After a longer silence the state is worse than a new start."""

START_SPEED_STD_MPS: Final = 1.0
"""Of the velocity at the start."""

DIFFERENCE_IN_USE_S: Final = 0.5
"""An anchor counts as in use while its last accepted difference is younger."""

MAX_HORIZONTAL_STD_M: Final = 3.0
"""While the horizontal standard deviation is larger, there is no fix; a silence that makes it so means a new start."""

SHORT_SILENCE_S: Final = 0.1
"""Over shorter silences no state grows much wider."""

TRY_EVERY: Final = 6
"""Differences between two attempts at a start."""

DIFFERENCES_AFTER_LOSS: Final = 30
WAIT_AFTER_LOSS_S: Final = 1.0
"""After a state that was wrong, a new start waits for this number of differences, or for this time."""


class DifferenceTracking:
    """One tag that is given differences of its ranges to pairs of anchors."""

    def __init__(
        self,
        settings: EstimatorSettings,
        anchors_m: dict[int, tuple[float, float, float]],
        z_bounds_m: tuple[float, float] | None = None,
        calibration: DifferenceCalibration | None = None,
    ) -> None:
        """``anchors_m``: the anchors' positions; a difference that carries positions needs none.

        ``calibration`` is subtracted from every difference; anchors that are not in it are typical ones.
        """
        self._calibration = DifferenceCalibration({}) if calibration is None else calibration
        self.counters: Counter[str] = Counter()
        self.reason: NoFixReason = NoFixReason.NO_BEACONS
        is_calibrated = bool(self._calibration.anchors)
        self._settings = replace(
            settings,
            difference_std_m=self._calibration.difference_std_m(settings.difference_std_m),
            range_std_m=min(settings.range_std_m, KNOWN_STD_M) if is_calibrated else settings.range_std_m,
            lowest_m=settings.lowest_m if z_bounds_m is None else z_bounds_m[0],
            highest_m=settings.highest_m if z_bounds_m is None else z_bounds_m[1],
        )
        self._asked = IntegrityRequirement(settings.integrity_risk, settings.alert_limit_m)
        self._positions_m = {anchor: np.array(point) for anchor, point in anchors_m.items()}
        self._z_bounds_m = z_bounds_m
        self._estimator = Estimator(self._settings)
        self._window: deque[PairTdoa] = deque(maxlen=WINDOW)
        self._begin_s = self._newest_s = 0.0
        self._received_s: dict[int, float] = {}
        self._since_try = 0
        self._start: Start | None = None
        self._was_wrong = False

    @property
    def estimator(self) -> Estimator:
        """The filter with all its states."""
        return self._estimator

    def update(self, pairs: Sequence[PairTdoa]) -> bool:
        """Process the differences of one reception, receptions in the order of time.

        True if they made a fix, else ``reason`` states why not.
        """
        used = False
        for pair in pairs:
            if self._update_positions(pair):
                used = self._add(pair) or used
            else:
                self.counters["unknown-anchor"] += 1
                self.reason = NoFixReason.NO_ALMANAC
        return used and self._start is not None and self._is_plausible()

    def _update_positions(self, pair: PairTdoa) -> bool:
        """Whether it is known where both anchors stand."""
        positions_m = self._positions_m
        if pair.a_m is not None:
            positions_m[pair.anchor_a] = np.array(pair.a_m)
        if pair.b_m is not None:
            positions_m[pair.anchor_b] = np.array(pair.b_m)
        return pair.anchor_a in positions_m and pair.anchor_b in positions_m

    def _add(self, pair: PairTdoa) -> bool:
        if self._start is not None and self._is_out_of_reach(pair.time_s - self._newest_s):
            self._stop()
        self._newest_s = pair.time_s
        if self._start is None:
            return self._try_start(pair)
        used = self._process(pair)
        if used:
            self._received_s[pair.anchor_a] = self._received_s[pair.anchor_b] = pair.time_s
        else:
            self.counters["outlier"] += 1
            self.reason = NoFixReason.RESIDUALS
        if self._estimator.rejects_most:
            self._stop()
            self._was_wrong = True
        return used

    def _process(self, pair: PairTdoa) -> bool:
        """Process a difference by the filter, less the calibrated or typical errors of its anchors."""
        position_m = self.position_m
        error_m = self._calibration.error_m(pair.anchor_b, dist(position_m, self._positions_m[pair.anchor_b]))
        error_m -= self._calibration.error_m(pair.anchor_a, dist(position_m, self._positions_m[pair.anchor_a]))
        a, b = self._index(pair.anchor_a), self._index(pair.anchor_b)
        ticks = round((pair.time_s - self._begin_s) * TICK_RATE_HZ)
        return self._estimator.process_difference(a, b, ticks, pair.tdoa_m - error_m) == ACCEPTED

    def _index(self, anchor: int) -> int:
        """Index of an anchor in the estimator's table."""
        return self._estimator.anchor_index(anchor, self._positions_m[anchor])

    def _is_out_of_reach(self, silent_s: float) -> bool:
        """Whether the filter cannot predict that far: too long a silence for it, or a clock that went back."""
        if not 0.0 <= silent_s <= MAX_DIFFERENCE_SILENCE_S:
            return True
        return silent_s > SHORT_SILENCE_S and self._estimator.horizontal_variance_m2(silent_s) > MAX_HORIZONTAL_STD_M**2

    def _is_plausible(self) -> bool:
        """Whether the state is near the anchors, where differences have information, and known well enough."""
        start, state, dim = self._start, self._estimator.state, self._estimator.dim
        if start is None or not start.holds(state.x[:dim]):
            self.reason = NoFixReason.NOT_CONVERGED
            self._stop()
            return False
        if state.P[0, 0] + state.P[1, 1] > MAX_HORIZONTAL_STD_M**2:
            self.reason = NoFixReason.ACQUIRING
            return False
        if dim == 3 and state.P[2, 2] > start.extent_m**2:
            self.reason = NoFixReason.BAD_GEOMETRY
            return False
        return True

    @property
    def position_m(self) -> tuple[float, float, float]:
        """The newest position."""
        x, y, *z = self._estimator.state.x[: self._estimator.dim].tolist()
        return x, y, z[0] if z else self._settings.height_m or 0.0

    def fix(self) -> Fix:
        """The newest position with all that is known of it; only after an ``update`` that made one."""
        used = [anchor for anchor, when_s in self._received_s.items() if self._newest_s - when_s <= DIFFERENCE_IN_USE_S]
        anchors_m = np.array([self._positions_m[anchor] for anchor in used]).reshape(-1, 3)
        rows, known = self._estimator.rows.tobytes(), self._settings.height_m is not None
        return Fix(self._newest_s, rows, tuple(used), anchors_m, "joint", known, 1, self._asked)

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
        start = find_start(
            self._window, self._positions_m, self._calibration, self._settings.height_m, self._z_bounds_m
        )
        if isinstance(start, NoSolution):
            self.reason = start.reason
            return False
        dim, solution = self._estimator.dim, start.solution
        self._begin_s = pair.time_s
        covariance = solution.covariance_m2[:dim, :dim]
        self._estimator.start(0, solution.position_m[:dim], covariance, START_SPEED_STD_MPS**2)
        self._start = start
        if start.without is not None:
            self._estimator.inflate_range_error(self._index(start.without))
        self._received_s = {anchor: pair.time_s for kept in self._window for anchor in (kept.anchor_a, kept.anchor_b)}
        self.counters["start"] += 1
        self._window.clear()
        return self._process(pair)

    def _is_enough_after_loss(self) -> bool:
        return (
            len(self._window) >= DIFFERENCES_AFTER_LOSS or self._newest_s - self._window[0].time_s >= WAIT_AFTER_LOSS_S
        )


# Start


NEIGHBOURHOOD: Final = 1.5
"""A tag farther from the anchors' centre than this part of their figure's diagonal, in x or y, is lost; ..."""

VERTICAL_NEIGHBOURHOOD: Final = 0.5
"""... and so is one farther above or below than this part."""

LEAST_DIAGONAL_M: Final = 5.0

START_DIFFERENCE_STD_M: Final = 0.22
"""Of a difference with all its errors, before any are estimated."""

MISFIT: Final = 4.0
"""A start whose chi² per degree of freedom is larger is tried without each anchor."""

REMAINING_MISFIT: Final = 0.1
"""Without the wrong anchor no more than this part of the misfit is left."""


class Start(Struct, frozen=True):
    """Where a filter begins."""

    solution: Solution
    without: int | None
    """The anchor that does not fit; None where all do."""
    low_m: Array
    """Corner of the neighbourhood of the anchors, shape (3,); ..."""
    high_m: Array
    """... and the opposite one."""
    extent_m: float
    """Longest edge of the anchors' bounding box."""

    def holds(self, position_m: Array) -> bool:
        """Whether a position, of two or three coordinates, lies in the neighbourhood of the anchors."""
        return all(self.low_m[axis] <= value <= self.high_m[axis] for axis, value in enumerate(position_m.tolist()))


def find_start(
    window: Sequence[PairTdoa],
    positions_m: Mapping[int, Array],
    calibration: DifferenceCalibration,
    height_m: float | None,
    z_bounds_m: tuple[float, float] | None,
) -> Start | NoSolution:
    """Solve for the position; medians of each pair keep single outliers out of it.

    Where the residuals are too large, each anchor is left out once: on the floor or behind metal one is often wrong.
    """
    grouped: dict[tuple[int, int], list[float]] = {}
    for pair in window:
        without_bias_m = pair.tdoa_m - calibration.constant_m(pair)
        grouped.setdefault((pair.anchor_a, pair.anchor_b), []).append(without_bias_m)
    medians = {pair: float(np.median(group)) for pair, group in grouped.items()}
    anchors = sorted({anchor for pair in medians for anchor in pair})
    found = _solve(medians, positions_m, height_m, z_bounds_m)
    best, without = found, None
    least = np.inf if isinstance(found, NoSolution) else REMAINING_MISFIT * found.chi2
    dim = 3 if height_m is None else 2
    if _is_suspect(found) and len(anchors) > dim + 2:
        for anchor in anchors:
            rest = {pair: median for pair, median in medians.items() if anchor not in pair}
            other = _solve(rest, positions_m, height_m, z_bounds_m)
            if isinstance(other, Solution) and other.dof > 0 and other.chi2 < least:
                best, without, least = other, anchor, other.chi2
    if isinstance(best, NoSolution):
        return best
    anchors_m = np.array([positions_m[anchor] for anchor in anchors])
    low, high = anchors_m.min(axis=0), anchors_m.max(axis=0)
    diagonal_m = max(float(np.linalg.norm((high - low)[:2])), LEAST_DIAGONAL_M)
    reach_m = diagonal_m * np.array([NEIGHBOURHOOD, NEIGHBOURHOOD, VERTICAL_NEIGHBOURHOOD])
    centre_m = (low + high) / 2.0
    start = Start(best, without, centre_m - reach_m, centre_m + reach_m, float((high - low).max()))
    if not start.holds(best.position_m[:dim]):
        return NoSolution(NoFixReason.NOT_CONVERGED, "the position lies far from all anchors")
    return start


def _is_suspect(found: Solution | NoSolution) -> bool:
    if isinstance(found, NoSolution):
        return found.reason is NoFixReason.RESIDUALS
    return found.dof > 0 and found.chi2 > MISFIT * found.dof


def _solve(
    medians: Mapping[tuple[int, int], float],
    positions_m: Mapping[int, Array],
    height_m: float | None,
    z_bounds_m: tuple[float, float] | None,
) -> Solution | NoSolution:
    joined = against_reference(list(medians), list(medians.values()), [START_DIFFERENCE_STD_M**2] * len(medians))
    if not joined.anchors:
        return NoSolution(NoFixReason.TOO_FEW_ANCHORS, "no pair of anchors was heard")
    anchors_m = np.array([positions_m[anchor] for anchor in joined.anchors])
    return locate(anchors_m, joined.tdoa_m, joined.covariance_m2, height_m=height_m, z_bounds_m=z_bounds_m)


class ReferencedTdoas(Struct, frozen=True, gc=False):
    """What ``locate`` needs, from measurements of pairs; empty where there are none."""

    anchors: tuple[int, ...]
    """Identifiers of the anchors that are connected, the reference first: n + 1, or none."""
    tdoa_m: Array
    """|p − anchor i + 1| − |p − reference|, shape (n,)."""
    covariance_m2: Array
    """Shape (n, n)."""


def against_reference(pairs: Sequence[tuple[int, int]], tdoa_m: ArrayLike, variances_m2: ArrayLike) -> ReferencedTdoas:
    """Best linear estimate of all TDoAs against one anchor from measurements ``|p − b| − |p − a|`` of pairs (a, b).

    ``tdoa_m`` and ``variances_m2``: shape (m,), errors independent. A pair may be measured more than once, in
    either direction. Of a graph in several parts the largest is used, of equally large ones that with the most
    information. The anchor of most information serves as the reference (with the full covariance the choice does not
    change a position). Pairs of one anchor with itself, values that are not finite and variances that are not positive
    are omitted.
    """
    measured, variances = np.array(tdoa_m, np.float64), np.array(variances_m2, np.float64)
    if not (len(pairs),) == measured.shape == variances.shape:
        raise ValueError(f"{len(pairs)} pairs, TDoAs {measured.shape}, variances {variances.shape}: expected one each")
    usable = np.isfinite(measured) & np.isfinite(variances) & (variances > 0.0)
    kept = [i for i, (a, b) in enumerate(pairs) if a != b and usable[i]]
    information: dict[int, float] = {}
    for i in kept:
        for anchor in pairs[i]:
            information[anchor] = information.get(anchor, 0.0) + float(1.0 / variances[i])
    part = _largest_part([pairs[i] for i in kept], information)
    if not part:
        return ReferencedTdoas((), np.empty(0), np.empty((0, 0)))
    reference = max(sorted(part), key=information.__getitem__)
    anchors = (reference, *sorted(part - {reference}))
    row = {anchor: i for i, anchor in enumerate(anchors)}
    edges = [i for i in kept if pairs[i][0] in part]
    sigma = np.sqrt(variances[edges])
    H = np.zeros((len(edges), len(anchors)))
    for k, i in enumerate(edges):
        H[k, row[pairs[i][0]]], H[k, row[pairs[i][1]]] = -1.0 / sigma[k], 1.0 / sigma[k]
    H = H[:, 1:]
    covariance = np.linalg.inv(H.T @ H)
    tdoa = covariance @ (H.T @ (measured[edges] / sigma))
    return ReferencedTdoas(anchors, tdoa, 0.5 * (covariance + covariance.T))


def _largest_part(pairs: Sequence[tuple[int, int]], information: dict[int, float]) -> set[int]:
    """The connected part with most anchors, then with most information, then with the smallest identifier."""
    part_of = {anchor: {anchor} for anchor in information}
    for a, b in pairs:
        joined, other = part_of[a], part_of[b]
        if joined is not other:
            joined |= other
            for anchor in other:
                part_of[anchor] = joined
    return max(
        part_of.values(),
        key=lambda part: (len(part), sum(sorted(information[anchor] for anchor in part)), -min(part)),
        default=set(),
    )
