"""Covariance analysis: the filter's own steps without measurements, for planning and Cramér–Rao bounds.

Computes what the filter will claim for a tag at rest at some place of a site: a superframe of messages is processed
with innovations of zero until the position's variance repeats. That variance includes the accelerations that the
filter allows for and that such a tag does not have. Their part follows from sensitivities: rows of V start, at moments
of a superframe, as a velocity unknown to the filter; the squares of their effect on the position, integrated over the
time after, are what accelerations add to P. Another row of V is the effect of the walls' delays.

If only a share of an anchor's packets arrives, all its stamps carry correspondingly less information: their variances
are divided by the share, and those of relays by the share of all three packets involved.
"""

from typing import Annotated, Final

from skyless.core.estimator.hypotheses import scatter
from skyless.core.estimator.kalman import (
    compute_fault_input,
    compute_ph,
    finish_updates,
    predict,
    relax_range_error,
    reset_state,
    update,
    update_later,
)
from skyless.core.estimator.measurements import (
    add_pair_survey,
    find_rate,
    first_reception,
    reception_terms,
    relay_terms,
    relay_variance,
)
from skyless.core.estimator.phases import expected_phase, known_phase, own_phase
from skyless.core.estimator.state import ALL_RANGE_ERRORS, AXES, FAULT_KINDS, State, at
from skyless.core.native.arithmetic import floor, square
from skyless.core.native.records import PHASE_STATES, Array, Bytes, Reals, Record, Ticks, record
from skyless.core.ticks import TICK_S

IMPULSES: Final = 4  # moments of a superframe at which an acceleration is tried
AFTER_ALL_TICKS: Final = 1 << 62  # a time after all others
# The position's variance, or a sum, counts as complete when it changes by less than this share between two looks.
COMPLETE_CHANGE: Final = 1e-3


@record
class PlannedMessage(Record):
    """A message of a superframe."""

    anchor: int
    """Index of its anchor in the state; −1 if the tag does not receive it."""
    gap_ticks: Ticks
    """Time since the previous message."""
    share: float
    """Share of its anchor's messages that arrive."""
    late_m: float
    """Delay by walls."""
    end: int
    """End of its relays in their table; they begin at the end of the previous message's."""


@record
class PlannedRelay(Record):
    """A relay carried by a message."""

    sender: int
    """Index of the received anchor; −1 if the tag does not receive it itself."""
    age_s: float
    share: float
    """Share of these receptions that reach the tag."""
    late_m: float


@record
class SteadyState(Record):
    """Sums over the fixes of a superframe, each weighted by the share of its message that arrives."""

    fixes: float
    variance_m2: Annotated[Reals, AXES]
    """Variance of each axis as the filter claims it."""
    square_bias_m2: float
    """Squared error caused by walls."""
    motion_m2: Annotated[Reals, AXES]
    """Contribution of accelerations to the variance of each axis, for one fix."""


def find_steady_state(
    s: State,
    messages: Array[PlannedMessage],
    relays: Array[PlannedRelay],
    count: int,
    most: int,
    step: int,
    found: SteadyState,
) -> None:
    """Find the steady state of a tag at the state's position.

    Ends after ``most`` superframes in any case; the sums are compared every ``step`` superframes.
    """
    s.rows = _walls(s) + 1 + IMPULSES * s.dim
    superframe: Ticks = 0
    for one in range(count):
        superframe += messages[one].gap_ticks
    now: Ticks = 0
    before = 0.0
    for number in range(most):
        _process_superframe(s, messages, relays, count, now, AFTER_ALL_TICKS, superframe, found)
        now += superframe
        if number % step == step - 1:
            variance = found.variance_m2[0] + found.variance_m2[1] + found.variance_m2[2]
            if abs(variance - before) <= COMPLETE_CHANGE * variance:
                break
            before = variance
    impulses_ticks = now
    before = 0.0
    for axis in range(AXES):
        found.motion_m2[axis] = 0.0
    for number in range(most):
        _process_superframe(s, messages, relays, count, now, impulses_ticks, superframe, found)
        now += superframe
        if number % step == step - 1:
            moved = found.motion_m2[0] + found.motion_m2[1] + found.motion_m2[2]
            if number >= 1 and moved - before <= COMPLETE_CHANGE * moved:
                break
            before = moved
    for axis in range(AXES):
        found.motion_m2[axis] *= s.settings.qa * (superframe * TICK_S) / (IMPULSES * found.fixes)


def find_walked(
    s: State,
    messages: Array[PlannedMessage],
    relays: Array[PlannedRelay],
    count: int,
    at_rest: int,
    velocity_mps: Reals,
    walked: int,
    found: SteadyState,
) -> None:
    """Find what the filter claims for a tag that rests for some superframes and then walks for others.

    ``found`` holds the fixes and variances of the last superframe. A state with phases gets one for each message of
    which at least half arrive; the phases are as predicted, so cycles are ambiguous wherever they are for the filter.
    Messages must not be late.
    """
    superframe: Ticks = 0
    for one in range(count):
        superframe += messages[one].gap_ticks
    for number in range(at_rest + walked):
        if number == at_rest:
            for axis in range(s.dim):
                s.x[s.layout.velocity + axis] = velocity_mps[axis]
        _process_superframe(s, messages, relays, count, number * superframe, AFTER_ALL_TICKS, superframe, found)


def _walls(s: State) -> int:
    """The row of V for the walls' delays; the rows of the impulses follow."""
    return FAULT_KINDS * s.count


def _process_superframe(
    s: State,
    messages: Array[PlannedMessage],
    relays: Array[PlannedRelay],
    count: int,
    now: Ticks,
    impulses_ticks: Ticks,
    superframe: Ticks,
    found: SteadyState,
) -> None:
    """Process a superframe from ``now`` on; impulses act in the one that begins at ``impulses_ticks``."""
    begin = 0
    found.fixes = found.square_bias_m2 = 0.0
    for axis in range(AXES):
        found.variance_m2[axis] = 0.0
    for one in range(count):
        message = messages[one]
        now += message.gap_ticks
        if message.anchor >= 0:
            _predict_with_impulses(s, now, impulses_ticks, superframe)
            _receive(s, message, now)
            for other in range(begin, message.end):
                if relays[other].sender >= 0 and s.anchors[relays[other].sender].packets > 0:
                    _receive_relay(s, message, relays[other])
            finish_updates(s)
            _add_fix(s, message.share, found)
        begin = message.end


def _add_fix(s: State, share: float, found: SteadyState) -> None:
    """Add a fix to the sums."""
    found.fixes += share
    for axis in range(s.dim):
        found.variance_m2[axis] += share * (s.P[at(axis, axis)] + scatter(s, axis, axis))
        if not s.status.has_phases:  # with phases these columns are hypotheses
            found.square_bias_m2 += share * square(s.V[axis][_walls(s)])
            for row in range(_walls(s) + 1, s.rows):
                found.motion_m2[axis] += share * square(s.V[axis][row])


def _predict_with_impulses(s: State, now: Ticks, impulses_ticks: Ticks, superframe: Ticks) -> None:
    """Time update; from each impulse on the tag has a velocity of 1 m/s that the filter does not know of."""
    before = s.status.epoch_ticks
    predict(s, now)
    for impulse in range(IMPULSES):
        moment = impulses_ticks + floor((impulse + 0.5) / IMPULSES * superframe + 0.5)
        if before < moment <= now:
            for axis in range(s.dim):
                row = _walls(s) + 1 + s.dim * impulse + axis
                s.V[axis][row] = (now - moment) * TICK_S
                s.V[s.layout.velocity + axis][row] = 1.0


def _receive(s: State, message: PlannedMessage, rx_ticks: Ticks) -> None:
    """Process the tag's reception of a message."""
    a, where = s.anchors[message.anchor], s.layout
    if a.packets == 0:
        first_reception(s, message.anchor, rx_ticks, rx_ticks, 1.0)
        s.V[where.offset + message.anchor][_walls(s)] += message.late_m
    else:
        elapsed_s = (rx_ticks - a.rx_ticks) * TICK_S
        relax_range_error(s, message.anchor, elapsed_s, s.status.walked_m - a.walked_m)
        reset_state(s, where.tx_noise + message.anchor, s.settings.tx_variance_m2 / message.share)
        reception_terms(s, message.anchor, True)
        variance = compute_ph(s) + s.settings.rx_variance_m2 / message.share
        compute_fault_input(s, message.anchor)
        s.G[s.waiting][_walls(s)] += message.late_m
        if a.has_rate:
            update(s, 0.0, variance)
        else:
            find_rate(s, message.anchor, 0.0, variance, elapsed_s)
        if PHASE_STATES > 0 and s.status.has_phases and message.share >= 0.5:
            own_phase(s, message.anchor, expected_phase(s, message.anchor))
    a.rx_ticks, a.walked_m = rx_ticks, s.status.walked_m
    a.packets += 1


def _receive_relay(s: State, message: PlannedMessage, relayed: PlannedRelay) -> None:
    """Process a relay."""
    relay_terms(s, message.anchor, relayed.sender, relayed.age_s, True)
    variance = relay_variance(s, message.anchor, relayed.sender, relayed.age_s) / relayed.share
    variance += compute_ph(s)
    compute_fault_input(s, -1)
    if s.links[message.anchor][relayed.sender].variance_m2 == 0.0:  # else the pair's constant takes the delay
        s.G[s.waiting][_walls(s)] += relayed.late_m
    update_later(s, 0.0, variance)


# Cramér–Rao bounds


def process_known(
    s: State,
    sender: int,
    rx_ticks: Ticks,
    position_m: Reals,
    known: Bytes,
    first: int,
    elapsed_s: float,
    walked_m: float,
) -> None:
    """Process a frame at the tag's true position, with innovations of zero.

    ``known``: whether each anchor's reception of it, and then the tag's, is known; anchors before ``first`` are left
    out. ``elapsed_s``, ``walked_m``: since this anchor's previous frame that the tag received.
    """
    predict(s, rx_ticks)
    for axis in range(s.dim):
        s.x[axis] = position_m[axis]
    if s.dim == 2:
        s.settings.height_m = position_m[2]
    reset_state(s, s.layout.tx_noise + sender, s.settings.tx_variance_m2)
    if known[s.count] != 0:
        relax_range_error(s, sender, elapsed_s, walked_m)
        s.anchors[sender].held_range_m = 0.0  # linearise here, not at a held point
        reception_terms(s, sender, True)
        update(s, 0.0, compute_ph(s) + s.settings.rx_variance_m2)
        if s.status.has_phases:
            known_phase(s, sender, walked_m)
    for listener in range(first, s.count):
        if known[listener] != 0:
            relay_terms(s, listener, sender, 0.0, True)
            if s.status.range_errors == ALL_RANGE_ERRORS:
                add_pair_survey(s, listener, sender)
            update(s, 0.0, compute_ph(s) + s.settings.rx_variance_m2)
