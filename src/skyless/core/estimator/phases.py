"""Carrier phase: 20 times as precise as a stamp, but known only modulo a wavelength.

    R − X  =  |p − a| + b + ambiguity + noise                 (mod λ)      (the tag receives an anchor)
    S − X  =  |aᵢ − aⱼ| + bⱼ − bᵢ + γᵢ − γⱼ + constant + noise (mod λ)     (anchor i receives anchor j)

X is the sender's counter when the frame leaves: the carrier starts at a phase given by the counter, so the noise of the
TX stamp is not in it. An ambiguity contains what is constant while both radios keep their supply, and the effect of
reflections, which changes as the tag walks. It is estimated as a real number: as the tag walks, directions to the
anchors turn, and ranges known to millimetres up to a constant determine the position. ``docs/maths.md`` section 6.7.

A wrong cycle in fast motion looks consistent and drags the position by metres. So a phase is used only together with a
stamp that was used. If it is not predicted to a tenth of a wavelength, it is taken at each possible cycle
(``hypotheses``); if these are too many, or phases often wrong, its ambiguity starts again, without any information.
"""

from typing import Final

from skyless.core.estimator.hypotheses import (
    CYCLE_TICKS,
    give_up_hypotheses,
    likelihood,
    settle_hypotheses,
    spread_of_h,
    take_cycles,
    wavelength_m,
)
from skyless.core.estimator.kalman import (
    are_phases_reliable,
    compute_fault_input,
    compute_ph,
    finish_updates,
    reset_state,
    update,
)
from skyless.core.estimator.measurements import (
    add_direction_from,
    add_term,
    find_distance_m,
    h_dot_x,
    open_state,
    relay_age_s,
    relay_terms,
    relay_variance,
)
from skyless.core.estimator.monitor import learn_least_walk
from skyless.core.estimator.state import Ambiguity, State, at, forget_pair_phase, set_covariance, use_phases
from skyless.core.native.arithmetic import floor, log, sqrt, square
from skyless.core.native.records import Reals, Ticks
from skyless.core.ticks import TICK_S

_TWO_PI: Final = 6.283185307179586


def own_phase(s: State, anchor: int, phase_cycles: float) -> None:
    """Process the phase, in [0, 1), of a reception of the tag's whose stamp was used. It falls as stamps grow."""
    status, tuning, a = s.status, s.tuning, s.anchors[anchor]
    finish_updates(s)
    use_phases(s)
    if not a.has_rate or not _may_count(s):
        a.own.is_known = False
        return
    ambiguity = s.layout.ambiguity + anchor
    _measure_way(s)
    learn_least_walk(s)
    if a.own.is_known:
        wander = max(tuning.phase_wander * status.phase_variance_m2, s.settings.phase_wander)
        s.P[at(ambiguity, ambiguity)] += wander * (status.way_m - a.phase_way_m)
    a.phase_way_m = status.way_m
    _follow_line(s)
    expected_m = _phase_terms(s, anchor)
    cycles = -phase_cycles - _whole_cycles(s, a.offset_ticks)
    innovation, variance = _innovation_m(s, cycles, expected_m), status.phase_variance_m2
    predicted = max(compute_ph(s), 0.0)  # rounding may make it negative
    compute_fault_input(s, -1)
    if a.own.is_known and square(s.settings.gate) * (predicted + variance) < square(wavelength_m(s)):
        _count_wild(s, innovation, predicted + variance)
    is_used = _use_phase(s, ambiguity, a.own, innovation, predicted, variance)
    if is_used and predicted <= _certain_m2(s) and s.hypotheses.count == 1:
        _learn_noise(s, square(innovation) - predicted)


def relay_phase(s: State, listener: int, sender: int, packet_rx_ticks: Ticks, phase_cycles: float) -> None:
    """Process the phase of an anchor's reception of another one, whose stamp was used.

    The clock that phases show of an anchor differs from that of its stamps by γ, which its first pair determines. All
    other pairs have constants, which are estimated outside the filter.
    """
    i, j, link, mesh = s.anchors[listener], s.anchors[sender], s.links[listener][sender], s.layout.mesh
    if not j.has_rate or not _agree(s) or not _has_mesh(s, sender):
        return
    age_s = relay_age_s(s, listener, sender, packet_rx_ticks)
    relay_terms(s, listener, sender, age_s, False)
    expected_m = find_distance_m(s, listener, sender) + h_dot_x(s, 0)
    add_term(s, mesh + sender, -1.0)
    add_term(s, mesh + listener, 1.0)
    expected_m += s.x[mesh + listener] - s.x[mesh + sender] + link.phase_m
    innovation = _innovation_m(s, -phase_cycles - _whole_cycles(s, j.offset_ticks - i.offset_ticks), expected_m)
    predicted = max(compute_ph(s), 0.0)
    compute_fault_input(s, -1)
    aged_m2 = relay_variance(s, listener, sender, age_s) - s.settings.rx_variance_m2
    variance = square(s.tuning.phase_mesh_std_m) + aged_m2
    if not i.mesh.is_known:
        if link.has_phase or not _has_pairs(s, listener):
            link.has_phase = True
            _open(s, mesh + listener, i.mesh, innovation, variance + link.phase_variance_m2)
        return
    likely_m, spread_m2 = spread_of_h(s)
    shown_m2, known_m2 = predicted + spread_m2 + variance, square(s.tuning.pair_share * wavelength_m(s))
    if not link.has_phase or link.phase_variance_m2 > known_m2:
        link.has_phase, link.phases_refused = True, 0
        link.phase_m, link.phase_variance_m2 = link.phase_m + innovation - likely_m, shown_m2
        return
    expected_m2 = predicted + variance + link.phase_variance_m2
    limit_m = sqrt(_limit_m2(s, predicted, expected_m2))
    if not take_cycles(s, innovation, expected_m2, limit_m):
        s.status.phases_refused += 1
        link.phases_refused += 1
        if link.phases_refused >= int(s.tuning.phases_in_row):
            forget_pair_phase(link)
        return
    s.status.phases_used += 1
    link.phases_refused = 0
    if shown_m2 < known_m2:
        share, shown_m = link.phase_variance_m2 / (shown_m2 + link.phase_variance_m2), innovation - likely_m
        link.phase_m += share * (shown_m - floor(shown_m / wavelength_m(s) + 0.5) * wavelength_m(s))
        link.phase_variance_m2 -= share * link.phase_variance_m2


def _has_mesh(s: State, anchor: int) -> bool:
    """Whether the clock that phases show of an anchor is known; of the first one it is by definition that of stamps."""
    is_first = True
    for one in range(s.count):
        is_first = is_first and not s.anchors[one].mesh.is_known
    if is_first:
        finish_updates(s)
        reset_state(s, s.layout.mesh + anchor, 0.0)
        s.anchors[anchor].mesh.is_known = True
    return s.anchors[anchor].mesh.is_known


def _has_pairs(s: State, anchor: int) -> bool:
    """Whether the constant of any pair of an anchor has been measured: its clock must then fit that."""
    has_pairs = False
    for other in range(s.count):
        has_pairs = has_pairs or s.links[anchor][other].has_phase or s.links[other][anchor].has_phase
    return has_pairs


def _whole_cycles(s: State, ticks: Ticks) -> float:
    """Fractional cycles, in [0, 1), of a number of ticks."""
    return ((ticks & (CYCLE_TICKS - 1)) * s.settings.carrier_cycles) % CYCLE_TICKS / CYCLE_TICKS


def _certain_m2(s: State) -> float:
    """Largest variance of a prediction that determines the cycle."""
    return square(s.tuning.phase_share * wavelength_m(s))


def _innovation_m(s: State, cycles: float, expected_m: float) -> float:
    """Difference between a phase and its prediction, to the nearest cycle."""
    off = cycles - expected_m / wavelength_m(s)
    return (off - floor(off + 0.5)) * wavelength_m(s)


def _use_phase(s: State, state: int, own: Ambiguity, innovation: float, predicted: float, variance: float) -> bool:
    """Process the phase in ``h``, whose last term is its ambiguity, the state of that index. Returns False if unused.

    ``predicted``: hᵀ·P·h, as ``compute_ph`` found it.
    """
    status = s.status
    own.ticks = status.epoch_ticks
    within_m2 = _limit_m2(s, predicted, predicted + variance)
    if not own.is_known or not (predicted <= _certain_m2(s) or _are_few(s, within_m2)):
        _open(s, state, own, innovation, variance)
        return False
    if not take_cycles(s, innovation, predicted + variance, sqrt(within_m2)):
        status.phases_refused += 1
        own.refused_in_row += 1
        if own.refused_in_row >= int(s.tuning.phases_in_row):
            _open(s, state, own, innovation, variance)
        return False
    own.refused_in_row = 0
    status.phases_used += 1
    return True


def _are_few(s: State, within_m2: float) -> bool:
    """Whether the cycles within a distance are few enough, and phases so reliable, that hypotheses are of use."""
    has_settled = s.status.walk_scale < s.tuning.phases_walk_scale
    return has_settled and 4.0 * within_m2 < square(s.tuning.most_cycles * wavelength_m(s)) and are_phases_reliable(s)


def _limit_m2(s: State, predicted: float, variance: float) -> float:
    """Squared innovation beyond which a phase is not used: if its cycle is certain, where it is more likely random."""
    gate_squared = square(s.settings.gate)
    if predicted > _certain_m2(s):
        return gate_squared * variance
    odds = min(s.status.wild_share, 0.5) * sqrt(_TWO_PI * variance) / wavelength_m(s)
    if odds > 1e-6:
        gate_squared = min(gate_squared, -2.0 * log(odds))
    return min(gate_squared * variance, square(s.tuning.phase_gate * wavelength_m(s)))


def _count_wild(s: State, innovation: float, variance: float) -> None:
    """Update the share of wild phases by how likely the newest is one: all phases are then equally likely."""
    status, share = s.status, max(s.status.wild_share, s.tuning.least_wild)
    wild = share * sqrt(_TWO_PI * variance) / wavelength_m(s)
    is_wild = wild / (wild + (1.0 - share) * likelihood(s, innovation, variance))
    status.wild_share += s.tuning.slow_forgetting * (is_wild - status.wild_share)


def _learn_noise(s: State, shown_m2: float) -> None:
    """Adapt the variance of phases to innovations beyond their prediction: reflections differ in size."""
    tuning, status = s.tuning, s.status
    status.phase_variance_m2 += tuning.slow_forgetting * (shown_m2 - status.phase_variance_m2)
    status.phase_variance_m2 = min(
        max(status.phase_variance_m2, square(s.settings.phase_std_m)),
        square(max(tuning.phase_max_std_m, s.settings.phase_std_m)),
    )


def _may_count(s: State) -> bool:
    """Whether the tag's phases may be used: neither soon after the start nor while stamps contradict the state.

    If they contradict hypotheses, all of these may be wrong, and P is smaller than the position's error.
    """
    status, tuning = s.status, s.tuning
    settle_hypotheses(s)
    if not are_phases_reliable(s):
        give_up_hypotheses(s)
    are_wrong = s.hypotheses.count > 1 and status.mean_nis > tuning.phases_nis
    if are_wrong:
        for axis in range(s.dim):
            s.P[at(axis, axis)] += square(tuning.slip_std_m)
    if are_wrong or not _agree(s):
        close_phases(s)
    return _agree(s) and (status.epoch_ticks - status.start_ticks) * TICK_S >= tuning.phases_start_s


def _agree(s: State) -> bool:
    """Whether stamps do not contradict the state."""
    return s.status.mean_nis <= s.tuning.wrong_nis


def close_phases(s: State) -> None:
    """Restart all ambiguities of the tag's receptions, which may be wrong by cycles."""
    give_up_hypotheses(s)
    for anchor in range(s.count):
        s.anchors[anchor].own.is_known = False


def _measure_way(s: State) -> None:
    """Add a step to the tag's way once it has moved by its length."""
    squared = 0.0
    for axis in range(s.dim):
        squared += square(s.x[axis] - s.status.step_m[axis])
    if squared > square(s.tuning.phase_step_m):
        s.status.way_m += sqrt(squared)
        for axis in range(s.dim):
            s.status.step_m[axis] = s.x[axis]


def _follow_line(s: State) -> None:
    """Keep the point at which phases are linearised near the tag.

    The point moves as the tag does, but not with corrections of the estimate. At the newest estimate, corrections would
    turn the directions to the anchors, and phases would seem to measure the position.
    """
    away_m2, is_in_use = 0.0, False
    for axis in range(s.dim):
        away_m2 += square(s.x[axis] - s.status.line_m[axis])
    for anchor in range(s.count):
        is_in_use = is_in_use or s.anchors[anchor].own.is_known
    if is_in_use and away_m2 <= square(s.tuning.held_step_m):
        return
    if away_m2 > square(s.tuning.held_max_m):
        close_phases(s)
    for anchor in range(s.count):
        if s.anchors[anchor].own.is_known:
            _turn(s, anchor, s.layout.ambiguity + anchor)
    for axis in range(s.dim):
        s.status.line_m[axis] = s.x[axis]


def _turn(s: State, anchor: int, ambiguity: int) -> None:
    """Change the direction to which an ambiguity's error refers, from that of the line to that of the estimate.

    a ← a − (h' − h)·(p − δa): the information on the position itself does not change.
    """
    a, survey = s.anchors[anchor], s.layout.survey + s.dim * anchor
    old_m, new_m = _line_range_m(s, anchor, s.status.line_m), _line_range_m(s, anchor, s.x)
    for axis in range(s.dim):
        turned = (s.x[axis] - a.position_m[axis]) / new_m - (s.status.line_m[axis] - a.position_m[axis]) / old_m
        _subtract(s, ambiguity, axis, turned)
        _subtract(s, ambiguity, survey + axis, -turned)


def _subtract(s: State, state: int, other: int, weight: float) -> None:
    """Subtract ``weight`` times another state's error from a state's error."""
    s.P[at(state, state)] -= weight * s.P[at(other, state)]
    for one in range(s.n):
        if one != state:
            set_covariance(s, state, one, s.P[at(state, one)] - weight * s.P[at(other, one)])
    s.P[at(state, state)] -= weight * s.P[at(state, other)]
    for fault in range(s.rows):
        s.V[state][fault] -= weight * s.V[other][fault]


def _line_range_m(s: State, anchor: int, point_m: Reals) -> float:
    """Distance of a point, at the given height in 2-D, from an anchor."""
    a, squared = s.anchors[anchor], 0.0
    if s.dim == 2:
        squared += square(s.settings.height_m - a.position_m[2])
    for axis in range(s.dim):
        squared += square(point_m[axis] - a.position_m[axis])
    return max(sqrt(squared), 1e-6)


def _phase_terms(s: State, anchor: int) -> float:
    """Write a phase of the tag's into ``h``. Returns its prediction without whole ticks of the offset."""
    s.terms = 0
    line_m = s.status.line_m
    range_m = add_direction_from(s, anchor, 1.0, line_m, _line_range_m(s, anchor, line_m))
    first = s.terms
    add_term(s, s.layout.offset + anchor, 1.0)
    add_term(s, s.layout.ambiguity + anchor, 1.0)
    return range_m + h_dot_x(s, first)


def _open(s: State, state: int, one: Ambiguity, innovation: float, variance: float) -> None:
    """Start an ambiguity, the last term of ``h``, so that this phase agrees with it."""
    finish_updates(s)
    s.status.phases_opened += 1
    one.is_known = True
    one.refused_in_row = int(s.tuning.phases_in_row) - 1  # if the next phase does not confirm this one, it was wrong
    ambiguity_m = s.x[state] + innovation
    reset_state(s, state, 0.0)
    s.terms -= 1
    open_state(s, state, -1, variance + compute_ph(s))
    s.x[state] = ambiguity_m


# Covariance analysis


def known_phase(s: State, anchor: int, walked_m: float) -> None:
    """Process a phase at the tag's true position with an innovation of zero, for a bound without cycles.

    ``walked_m``: since this anchor's last phase. Noise and wander are as stated.
    """
    ambiguity = s.layout.ambiguity + anchor
    for axis in range(s.dim):
        s.status.line_m[axis] = s.x[axis]
    s.P[at(ambiguity, ambiguity)] += s.settings.phase_wander * walked_m
    _phase_terms(s, anchor)
    own, variance = s.anchors[anchor].own, s.status.phase_variance_m2
    predicted = compute_ph(s)
    if own.is_known:
        compute_fault_input(s, -1)
        update(s, 0.0, predicted + variance)
    else:
        _open(s, ambiguity, own, 0.0, variance)


def expected_phase(s: State, anchor: int) -> float:
    """The predicted phase of a reception in cycles, for which ``own_phase`` has an innovation of zero."""
    expected_m = _phase_terms(s, anchor)
    return -(expected_m / wavelength_m(s) + _whole_cycles(s, s.anchors[anchor].offset_ticks))
