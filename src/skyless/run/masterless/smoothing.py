"""Fixed-interval smoothing: the state at each moment given the whole recording, by the filter's own model.

The filter runs forward through the recording, and the recursion of Rauch, Tung and Striebel (1965) backward: with the
filter's state x and covariance P, the transition F to the next state and its process noise Q,

    C = P·Fᵀ·(F·P·Fᵀ + Q)⁻¹,    x̂ = x + C·(x̂⁺ − F·x),    P̂ = P + C·(P̂⁺ − F·P·Fᵀ − Q)·Cᵀ.

The state is that of the filter (motion, range errors, surveys) without clocks, which time differences do not have.
Nothing is carried back across a restart of the filter.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from traceback import extract_tb
from typing import Final, NamedTuple, Protocol

import numpy as np
from msgspec import structs
from msgspec.structs import replace

from skyless.core.air.frame import SHORT_BITS, Malformed, Reception
from skyless.core.air.masterless_packets import Packet, PairTdoa, Point, Relay
from skyless.core.any_receiver import SiteBeacon, decode_any
from skyless.core.arrays import Indices, Matrix, Vector
from skyless.core.errors import SkylessError
from skyless.core.estimator.compiled import find_anchor
from skyless.core.estimator.kalman import is_stationary, motion_noise, range_error_decay
from skyless.core.estimator.settings import TUNING
from skyless.core.estimator.state import covariances
from skyless.core.fix import POSITION, VELOCITY, Fix, NoFixReason
from skyless.core.motion_sample import MotionSample
from skyless.core.native.views import view
from skyless.core.site import Site
from skyless.core.ticks import TICK_BITS, TICK_S
from skyless.run.masterless.difference_tracking import DifferenceTracking
from skyless.run.masterless.pair_engine import PairEngine

CHUNK: Final = 2_000
"""Events between two copies of the filter, from which it is rerun; limits the covariances in memory."""


class Height(NamedTuple):
    """A reading of the tag's height sensor."""

    time_s: float
    height_m: float
    std_m: float
    is_barometer: bool


Event = PairTdoa | Height


class _Decay(NamedTuple):
    """Decay of a state towards zero: the share kept, and the variance added."""

    state: int
    kept: float
    variance: float


def _decay(state: int, kept: float, variance: float) -> _Decay:
    """Decay with this stationary ``variance``."""
    return _Decay(state, kept, variance * (1.0 - kept * kept))


class _Step(NamedTuple):
    """The filter after an event, and the transition from the event before."""

    start: int
    """Number of the filter's start."""
    x: Vector
    P: Matrix
    dt_s: float
    q: float
    """Density of the acceleration."""
    decays: tuple[_Decay, ...]


class _States:
    """Layout of the smoothed states, for all anchors of a recording, whether currently in the filter or not."""

    def __init__(self, tracking: DifferenceTracking) -> None:
        estimator = tracking.estimator
        self.dim, self._anchors = estimator.dim, list(estimator.known_anchors)
        self._column = {anchor: column for column, anchor in enumerate(self._anchors)}
        settings, count, dim = estimator.settings, len(self._anchors), self.dim
        self.change, self.constant = 2 * dim, 2 * dim + count
        self._common = self.constant + count
        self.zero, self._survey = self._common + 1, self._common + 2
        variances = {
            self.change: (count, settings.place_std_m**2),
            self.constant: (count, settings.range_std_m**2),
            self._survey: (dim * count, settings.survey_std_m**2),
        }
        self._prior = np.zeros(self._survey + dim * count)
        for first, (number, variance) in variances.items():
            self._prior[first : first + number] = variance

    def column(self, anchor: int) -> int:
        return self._column[anchor]

    def of_anchor(self, anchor: int) -> list[int]:
        """Indices of all states of an anchor."""
        column, survey = self._column[anchor], self._survey + self.dim * self._column[anchor]
        return [self.change + column, self.constant + column, *range(survey, survey + self.dim)]

    def prior(self, state: int) -> float:
        """Variance of a state of an anchor that is not in the filter."""
        return float(self._prior[state])

    def read(self, tracking: DifferenceTracking) -> tuple[Vector, Matrix]:
        """Current state and covariance of the filter."""
        s, anchors, dim = tracking.estimator.state, tracking.estimator.anchors, self.dim
        where, columns = s.layout, [self._column[anchor] for anchor in anchors]
        count = len(columns)
        there = [
            *range(dim), *range(where.velocity, where.velocity + dim), *range(where.change, where.change + count),
            *range(where.constant, where.constant + count), *range(where.slope, where.survey + dim * count),
        ]  # fmt: skip
        here: Indices = np.array([
            *range(2 * dim), *(self.change + column for column in columns),
            *(self.constant + column for column in columns), *range(self._common, self._survey),
            *(self._survey + dim * column + axis for column in columns for axis in range(dim)),
        ])  # fmt: skip
        x, P = np.zeros(len(self._prior)), np.diag(self._prior)
        x[here] = view(s.x)[there]
        P[np.ix_(here, here)] = covariances(s)[np.ix_(there, there)]
        return x, P


def smoothed(tracking: DifferenceTracking, events: Sequence[Event]) -> Iterator[tuple[int, Fix]]:
    """Smoothed fixes with the numbers of their events, from the last one back.

    ``tracking`` must be new. There is a fix wherever the filter gives one; it has no protection level, as levels
    apply to what is known at the time.
    """
    copies = []
    for number, event in enumerate(events):
        if number % CHUNK == 0:
            copies.append(deepcopy(tracking))
        _process(tracking, event)
    states = _States(tracking)
    later: tuple[_Step, Vector, Matrix] | None = None
    for chunk in reversed(range(len(copies))):
        begin = chunk * CHUNK
        steps = _forward(copies.pop(), events[begin : begin + CHUNK], states)
        for number, (step, fix) in reversed(list(enumerate(steps, begin))):
            if step is None:
                later = None
                continue
            x, P = step.x, step.P
            if later is not None and later[0].start == step.start:
                x, P = _back(step, *later, states.dim)
            later = step, x, P
            if fix is not None:
                yield number, _as_fix(fix, x, P, states.dim)


def _process(tracking: DifferenceTracking, event: Event) -> bool:
    """Process one event. Returns whether it gave a fix."""
    if isinstance(event, PairTdoa):
        return tracking.update((event,))
    tracking.update_height(event.height_m, event.std_m, event.is_barometer)
    return False


def _forward(
    tracking: DifferenceTracking, events: Sequence[Event], states: _States
) -> list[tuple[_Step | None, Fix | None]]:
    found: list[tuple[_Step | None, Fix | None]] = []
    for event in events:
        before = tracking.estimator.anchors
        dt_s, q, decays = _transition(tracking, event, states)
        made = _process(tracking, event)
        if not tracking.has_started:
            found.append((None, None))
            continue
        gone = set(before) - set(tracking.estimator.anchors)
        forgotten = (_Decay(one, 0.0, states.prior(one)) for anchor in gone for one in states.of_anchor(anchor))
        x, P = states.read(tracking)
        step = _Step(tracking.counters["start"], x, P, dt_s, q, (*decays, *forgotten))
        found.append((step, tracking.fix() if made else None))
    return found


def _transition(tracking: DifferenceTracking, event: Event, states: _States) -> tuple[float, float, list[_Decay]]:
    """Time, density of the acceleration, and decays, from the newest event to this one."""
    if not tracking.has_started:
        return 0.0, 0.0, []
    estimator = tracking.estimator
    s, settings = estimator.state, estimator.settings
    status = s.status
    if isinstance(event, Height):
        since_s = (status.epoch_ticks - status.height_ticks) * TICK_S
        walked_m2 = min(settings.barometer_walk * since_s, TUNING.zero_variance_m2)
        return 0.0, 0.0, [_Decay(states.zero, 1.0, walked_m2)] if event.is_barometer else []
    rx_ticks = tracking.ticks(event.time_s)
    dt_s = max((rx_ticks - status.epoch_ticks) * TICK_S, 0.0)
    motion, _ = estimator.motion()
    walked_m = status.walked_m + float(np.linalg.norm(motion[states.dim :])) * dt_s
    decays = []
    for anchor in (event.anchor_a, event.anchor_b):
        if not estimator.has_anchor(anchor):
            continue
        index = find_anchor(s, anchor)
        a, column = s.anchors[index], states.column(anchor)
        elapsed_s = (rx_ticks - a.rx_ticks) * TICK_S if a.packets > 0 else 0.0
        kept, variance, kept_constant = range_error_decay(s, index, elapsed_s, walked_m - a.walked_m)
        decays.append(_decay(states.change + column, kept, variance))
        if kept_constant < 1.0:
            decays.append(_decay(states.constant + column, kept_constant, settings.range_std_m**2))
    q = motion_noise(s) * (TUNING.stationary_noise_share if is_stationary(s) else 1.0)
    return dt_s, q, decays


def _back(step: _Step, later: _Step, x_later: Vector, P_later: Matrix, dim: int) -> tuple[Vector, Matrix]:
    """One step of the backward recursion: state and covariance given everything later."""
    x, P, dt_s, q = step.x, step.P, later.dt_s, later.q
    kept, positions, speeds = np.ones(len(x)), range(dim), range(dim, 2 * dim)
    for decay in later.decays:
        kept[decay.state] = decay.kept
    Fx, FP = kept * x, kept[:, None] * P
    Fx[positions] += dt_s * x[speeds]
    FP[positions] += dt_s * P[speeds]
    predicted = FP * kept
    predicted[:, positions] += dt_s * FP[:, speeds]
    predicted[positions, positions] += q * dt_s**3 / 3.0
    predicted[positions, speeds] += q * dt_s**2 / 2.0
    predicted[speeds, positions] += q * dt_s**2 / 2.0
    predicted[speeds, speeds] += q * dt_s
    for decay in later.decays:
        predicted[decay.state, decay.state] += decay.variance
    sure = np.diagonal(predicted) <= 0.0  # states that are exact stay so
    predicted[sure, sure] = 1.0
    C = np.linalg.solve(predicted, FP).T
    P_back = P + C @ (P_later - predicted) @ C.T
    return x + C @ (x_later - Fx), 0.5 * (P_back + P_back.T)


def _as_fix(fix: Fix, x: Vector, P: Matrix, dim: int) -> Fix:
    """The filter's fix with smoothed position and velocity."""
    rows = np.frombuffer(fix.rows).reshape(-1, 3)[: VELOCITY + 4].copy()
    for first, states in ((POSITION, slice(0, dim)), (VELOCITY, slice(dim, 2 * dim))):
        rows[first, :dim] = x[states]
        rows[first + 1 : first + 1 + dim, :dim] = P[states, states]
    return replace(fix, rows=rows.tobytes(), method="joint-smoothed", requirement=None)


# A user's own estimator at a site: beacons become time differences by the anchors' stamps and relays.


class OwnEstimator(Protocol):
    """Interface of a user's own estimator."""

    def hear(self, observation: PairTdoa) -> Fix | None:
        """Process one time difference, which contains both anchors' positions. Returns a fix (``Fix.of``) or None."""


def heard(estimator: OwnEstimator, pair: PairTdoa, anchors_m: Mapping[int, Point], drops: Counter[str]) -> Fix | None:
    """Pass one difference to an estimator, with missing positions added; unknown anchors are counted.

    Raises SkylessError if the estimator fails or returns anything but a fix or None.
    """
    a_m, b_m = pair.a_m or anchors_m.get(pair.anchor_a), pair.b_m or anchors_m.get(pair.anchor_b)
    if a_m is None or b_m is None:
        drops["unknown-anchor"] += 1
        return None
    name = f"{type(estimator).__name__}.hear"
    try:
        fix = estimator.hear(structs.replace(pair, a_m=a_m, b_m=b_m))
    except Exception as error:
        *_, place = extract_tb(error.__traceback__)
        failed = f"{type(error).__name__}: {error} ({place.filename}, line {place.lineno})"
        raise SkylessError(f"{name} has failed: {failed}") from error
    if not isinstance(fix, Fix | None):
        raise SkylessError(
            f"{name} has returned {type(fix).__name__}; it should be None or a fix, as of skyless.Fix.of"
        )
    return fix


class OwnReceiver:
    """Receives like a tag of the site, and passes time differences to an estimator."""

    def __init__(self, estimator: OwnEstimator, site: Site) -> None:
        """``site``: gives the anchors' positions."""
        self._estimator = estimator
        self._anchors_m = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}
        bits = SHORT_BITS if site.schedule.sends_phases else TICK_BITS
        self._engine = PairEngine(bits, anchors_m=dict(self._anchors_m))
        self.counters: Counter[str] = Counter()
        """Frames by result."""
        self.reason = NoFixReason.NO_BEACONS
        """Why the last frame gave no fix."""

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air. Returns the newest fix of its differences."""
        beacon = decode_any(reception.frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
            return None
        return self.hear_beacon(beacon, reception)

    def hear_motion(self, _sample: MotionSample) -> bool:
        """Drop what a motion sensor shows: an estimator gets time differences only."""
        return False

    def hear_beacon(self, beacon: SiteBeacon, reception: Reception) -> Fix | None:
        """Process a decoded beacon like ``hear``."""
        relays = tuple(Relay(heard.anchor, heard.sequence, heard.rx_ticks, None) for heard in beacon.heard)
        sent = (beacon.anchor, beacon.sequence, beacon.tx_ticks)
        fix = None
        for pair in self._engine.on_packet(Packet(reception.host_s, *sent, reception.rx_ticks, relays)):
            fix = heard(self._estimator, pair, self._anchors_m, self.counters) or fix
        self.reason = NoFixReason.ACQUIRING
        return fix
