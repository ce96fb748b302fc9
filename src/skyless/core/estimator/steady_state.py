"""Covariance analysis: the filter's own steps without measurements, for planning and for Cramér–Rao bounds.

What the filter will claim of a tag at rest at some place of a site: a superframe of messages is processed with
innovations of zero until the position's variance repeats. That holds what the filter allows for accelerations, which
such a tag does not have. Their part follows from sensitivities: rows of V begin, at moments of a superframe, as a
velocity that the filter does not know of, and the squares of what they do to the position, integrated over the time
after that, are what accelerations add to P. Another row of V holds the walls' delays.

Where only a share of an anchor's packets arrives, the stamps of all count for as much less: their variances are divided
by the share, and those of relayed receptions by the share of all three that they take.
"""

from typing import Annotated, Final

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
from skyless.core.native.records import Array, Bytes, Reals, Record, Ticks, record
from skyless.core.ticks import TICK_S

IMPULSES: Final = 4  # moments of a superframe at which an acceleration is tried
AFTER_ALL_TICKS: Final = 1 << 62  # a time after all others
# The position's variance, or a sum, counts as complete when it changes by less than this share between two looks.
COMPLETE_CHANGE: Final = 1e-3


@record
class PlannedMessage(Record):
    """A message of a superframe."""

    anchor: int
    """Index of its anchor in the state; −1 where the tag does not receive it."""
    gap_ticks: Ticks
    """Time since the message before."""
    share: float
    """Share of its anchor's messages that arrive."""
    late_m: float
    """By how much walls delay them."""
    end: int
    """Where its relays end in their table; they begin where those of the message before end."""


@record
class PlannedRelay(Record):
    """A reception that is relayed with a message."""

    sender: int
    """Index of the anchor that was received; −1 where the tag does not receive it itself."""
    age_s: float
    share: float
    """Share of its receptions of which the tag gets to know."""
    late_m: float


@record
class SteadyState(Record):
    """What a superframe's fixes sum up to, each by how often its message arrives."""

    fixes: float
    variance_m2: Annotated[Reals, AXES]
    """Of each axis as the filter claims it."""
    square_bias_m2: float
    """Of the error that walls leave."""
    motion_m2: Annotated[Reals, AXES]
    """What accelerations have of each axis' variance, for one fix."""


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

    After ``most`` of the superframes it counts as steady in any case; sums are compared every ``step`` of them.
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
    """Find what the filter claims of a tag that has rested for superframes and then walked for others.

    ``found`` has the fixes and variances of the last of them. A state with phases has them of each message of which at
    least half arrive; what they show is as expected, so that cycles are in doubt where they are for the filter.
    """
    s.rows = _walls(s) + 1
    superframe: Ticks = 0
    for one in range(count):
        superframe += messages[one].gap_ticks
    for number in range(at_rest + walked):
        if number == at_rest:
            for axis in range(s.dim):
                s.x[s.layout.velocity + axis] = velocity_mps[axis]
        _process_superframe(s, messages, relays, count, number * superframe, AFTER_ALL_TICKS, superframe, found)


def _walls(s: State) -> int:
    """The row of V for the walls' delays; those of the impulses follow."""
    return FAULT_KINDS * s.count + s.dim


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
    """Process the messages of a superframe from now on; impulses act in the one that begins at ``impulses_ticks``."""
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
        found.variance_m2[axis] += share * s.P[at(axis, axis)]
        found.square_bias_m2 += share * square(s.V[axis][_walls(s)])
        for row in range(_walls(s) + 1, s.rows):
            found.motion_m2[axis] += share * square(s.V[axis][row])


def _predict_with_impulses(s: State, now: Ticks, impulses_ticks: Ticks, superframe: Ticks) -> None:
    """Time update, with a velocity of 1 m/s that the filter does not know of from each impulse on."""
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
    """The tag's reception of a message."""
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
        if s.status.has_phases and message.share >= 0.5:
            own_phase(s, message.anchor, expected_phase(s, message.anchor))
    a.rx_ticks, a.walked_m = rx_ticks, s.status.walked_m
    a.packets += 1


def _receive_relay(s: State, message: PlannedMessage, relayed: PlannedRelay) -> None:
    """A relayed reception."""
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

    ``known``: which receptions of it are known, of each anchor and then of the tag; those of anchors before ``first``
    are left out. ``elapsed_s``, ``walked_m``: since the frame before of this anchor that the tag received.
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
