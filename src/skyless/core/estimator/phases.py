"""The phase of the carrier: what the tag's receptions show besides their stamps, 20 times as fine but modulo a wavelength.

    R − X  =  |p − a| + b + ambiguity + noise      (mod λ)

X is when the anchor's counter says that the frame left: carriers start at a phase that the counter gives, so the noise of
its TX stamp is not in it. The ambiguity holds what is constant as long as both radios keep their supply, and what
reflections add, which changes as the tag walks. It stays a real number: as the tag walks, directions to the anchors turn,
and ranges that are known to millimetres but for a constant tell where it is. ``docs/maths.md`` section 6.7.

A wrong cycle in fast motion looks consistent and drags the position by metres. So a phase counts only with a stamp that was
used, where it is predicted to a tenth of a wavelength; else its ambiguity begins again, from which nothing is learnt. Where
stamps contradict, all begin again.
"""

from typing import Final

from skyless.core.constants import TICK_M, TICK_S
from skyless.core.estimator.kalman import compute_fault_input, compute_ph, finish_updates, reset_state, update
from skyless.core.estimator.measurements import add_direction, add_term, h_dot_x, open_state
from skyless.core.estimator.state import State, use_phases
from skyless.core.native.arithmetic import floor, log, sqrt, square

CYCLE_TICKS: Final = 128
"""In so many ticks there are whole cycles of each channel's carrier: ``EstimatorSettings.carrier_cycles``."""
_TWO_PI: Final = 6.283185307179586


def own_phase(s: State, anchor: int, phase_cycles: float) -> None:
    """Process the phase of a reception of the tag's whose stamp was used; it is in [0, 1) and falls as stamps grow."""
    status, tuning, a = s.status, s.tuning, s.anchors[anchor]
    use_phases(s)
    finish_updates(s)
    if not a.has_rate or not _may_count(s, anchor):
        a.has_phase = a.has_former = False
        return
    ambiguity, wavelength_m = s.layout.ambiguity + anchor, CYCLE_TICKS * TICK_M / s.settings.carrier_cycles
    if a.has_phase:
        walked_m = status.walked_m - a.phase_walked_m
        s.P[ambiguity][ambiguity] += tuning.phase_wander * status.phase_variance_m2 * walked_m
    a.phase_walked_m = status.walked_m
    expected_m = _phase_terms(s, anchor)
    cycles = -phase_cycles - _offset_cycles(s, anchor) - expected_m / wavelength_m
    innovation = (cycles - floor(cycles + 0.5)) * wavelength_m
    variance, predicted = status.phase_variance_m2, compute_ph(s)
    if not a.has_phase or predicted > square(tuning.phase_share * wavelength_m):
        if a.has_phase:
            _keep_former(s, anchor)
        _open(s, anchor, innovation, variance)
        return
    squared = square(innovation)
    is_beyond = squared > _limit_m2(s, predicted + variance, wavelength_m)
    status.wild_share += tuning.phase_forgetting * ((1.0 if is_beyond else 0.0) - status.wild_share)
    if is_beyond:
        status.phases_refused += 1
        a.phases_refused_in_row += 1
        if a.phases_refused_in_row >= int(tuning.phases_in_row):
            _open(s, anchor, innovation, variance)
        return
    _learn_noise(s, squared - predicted)
    a.phases_refused_in_row = 0
    status.phases_used += 1
    compute_fault_input(s, -1)
    update(s, innovation, predicted + variance)
    if a.has_former:
        _rejoin(s, anchor, wavelength_m)


def _limit_m2(s: State, variance: float, wavelength_m: float) -> float:
    """Square of the innovation beyond which a phase is more likely any than noise, or may be the other way round."""
    gate_squared = square(s.settings.gate)
    odds = min(s.status.wild_share, 0.5) * sqrt(_TWO_PI * variance) / wavelength_m
    if odds > 1e-6:
        gate_squared = min(gate_squared, -2.0 * log(odds))
    return min(gate_squared * variance, square(s.tuning.phase_gate * wavelength_m))


def _learn_noise(s: State, shown_m2: float) -> None:
    """Let the variance of phases follow what innovations show beyond their prediction: more where reflections do more."""
    tuning, status = s.tuning, s.status
    status.phase_variance_m2 += tuning.phase_forgetting * (shown_m2 - status.phase_variance_m2)
    status.phase_variance_m2 = min(
        max(status.phase_variance_m2, square(tuning.phase_min_std_m)), square(tuning.phase_max_std_m)
    )


def _may_count(s: State, anchor: int) -> bool:
    """Whether phases of an anchor may count: not just after the start, nor where stamps contradict or come late."""
    status, tuning, a = s.status, s.tuning, s.anchors[anchor]
    if status.mean_nis > tuning.phase_nis:
        close_phases(s)
    is_settled = (status.epoch_ticks - status.start_ticks) * TICK_S >= tuning.phase_after_s
    return is_settled and status.mean_nis <= tuning.phase_nis and not (a.is_obstructed or a.has_fault)


def close_phases(s: State) -> None:
    """Let all ambiguities begin again: what they were taken for may be wrong by cycles."""
    for anchor in range(s.count):
        s.anchors[anchor].has_phase = s.anchors[anchor].has_former = False


def _phase_terms(s: State, anchor: int) -> float:
    """Write a phase of the tag's into ``h``; returns what is expected of it but for whole ticks of the offset."""
    s.terms = 0
    range_m = add_direction(s, anchor, 1.0)
    first = s.terms
    add_term(s, s.layout.offset + anchor, 1.0)
    add_term(s, s.layout.ambiguity + anchor, 1.0)
    return range_m + h_dot_x(s, first)


def _offset_cycles(s: State, anchor: int) -> float:
    """Cycles in the whole ticks of an offset, in [0, 1)."""
    return (
        ((s.anchors[anchor].offset_ticks & (CYCLE_TICKS - 1)) * s.settings.carrier_cycles) % CYCLE_TICKS / CYCLE_TICKS
    )


def _open(s: State, anchor: int, innovation: float, variance: float) -> None:
    """Let an anchor's ambiguity begin, so that this phase is as expected."""
    a = s.anchors[anchor]
    s.status.phases_opened += 1
    a.has_phase = True
    a.phases_refused_in_row = int(s.tuning.phases_in_row) - 1  # one that the next does not confirm was wrong
    state = s.layout.ambiguity + anchor
    ambiguity_m = s.x[state] + innovation
    reset_state(s, state, 0.0)
    s.terms -= 1  # all but the ambiguity, which is the last
    open_state(s, state, -1, variance + compute_ph(s))
    s.x[state] = ambiguity_m


# By how many cycles an ambiguity has changed over a gap


def _keep_former(s: State, anchor: int) -> None:
    """Keep an ambiguity that ends, unless there is one already that has not been kept for long."""
    a, former, ambiguity = s.anchors[anchor], s.layout.former + anchor, s.layout.ambiguity + anchor
    if a.has_former and _former_age_s(s, anchor) < s.tuning.phase_former_s:
        return
    a.has_former, a.former_ticks = True, s.status.epoch_ticks
    s.x[former] = s.x[ambiguity]
    for state in range(s.n):
        s.P[former][state] = s.P[ambiguity][state]
    for state in range(s.n):
        s.P[state][former] = s.P[state][ambiguity]
    for fault in range(s.rows):
        s.V[former][fault] = s.V[ambiguity][fault]


def _former_age_s(s: State, anchor: int) -> float:
    return (s.status.epoch_ticks - s.anchors[anchor].former_ticks) * TICK_S


def _rejoin(s: State, anchor: int, wavelength_m: float) -> None:
    """Let an ambiguity and its former one be the same but for whole cycles, once their number is beyond doubt.

    What was received after a gap shows how clocks and tag have moved within it.
    """
    tuning, a = s.tuning, s.anchors[anchor]
    if _former_age_s(s, anchor) > tuning.phase_former_s:
        a.has_former = False
        return
    s.terms = 0
    add_term(s, s.layout.ambiguity + anchor, 1.0)
    add_term(s, s.layout.former + anchor, -1.0)
    predicted, variance = compute_ph(s), s.status.phase_variance_m2
    if predicted > square(tuning.phase_share * wavelength_m):
        return
    cycles = -h_dot_x(s, 0) / wavelength_m
    innovation = (cycles - floor(cycles + 0.5)) * wavelength_m
    a.has_former = False
    if square(innovation) <= _limit_m2(s, predicted + variance, wavelength_m):
        s.status.phases_rejoined += 1
        compute_fault_input(s, -1)
        update(s, innovation, predicted + variance)
