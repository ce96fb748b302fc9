"""Cycles that phases may have, as hypotheses which share one covariance.

A phase whose cycle is not certain is processed at each cycle that is possible. These updates have the same row h and
the same variance. So the states that result have one P in common, and differ from their weighted mean, which is x, by a
vector each. These deviations are columns of V behind those of the faults, and every time update and measurement update
treats them as such: the innovation of a hypothesis is ν − h·deviation. Its weight is the likelihood of all stamps and
phases since. Unlikely hypotheses are dropped, alike ones are merged, and only the most likely ones are kept.
"""

from typing import Final

from skyless.core.estimator.kalman import compute_fault_input, compute_ph, finish_updates, update, update_later
from skyless.core.estimator.state import FAULT_KINDS, State, at, row_end, row_of
from skyless.core.native.arithmetic import exp, floor, log, sqrt, square
from skyless.core.native.records import HYPOTHESES
from skyless.core.ticks import TICK_M

CYCLE_TICKS: Final = 128
"""Number of ticks with a whole number of carrier cycles in every channel: ``EstimatorSettings.carrier_cycles``."""


def wavelength_m(s: State) -> float:
    """The carrier's wavelength in use."""
    return CYCLE_TICKS * TICK_M / s.settings.carrier_cycles


def take_cycles(s: State, innovation: float, variance: float, limit_m: float) -> bool:
    """Process the phase in ``h`` at each cycle within a limit, for each hypothesis. Returns False if there is none.

    P·h and the fault inputs are the next of ``U`` and ``G``; ``innovation`` is the mean's, at any cycle; ``variance``:
    of innovations. If each hypothesis has one cycle, the update is queued.
    """
    is_possible, is_certain, cycle_m = False, True, wavelength_m(s)
    for one in range(s.hypotheses.count):
        nearest_m = abs(_innovation_of(s, innovation, one))
        is_possible = is_possible or nearest_m <= limit_m
        is_certain = is_certain and cycle_m - nearest_m > limit_m
    if is_possible and is_certain:
        for one in range(s.hypotheses.count):
            s.G[s.waiting][FAULT_KINDS * s.count + one] = _innovation_of(s, innovation, one) - innovation
        update_later(s, innovation, variance, False)
    elif is_possible:
        _branch(s, innovation, variance, limit_m)
    return is_possible


def _innovation_of(s: State, innovation: float, one: int) -> float:
    """The innovation of a hypothesis at the nearest cycle."""
    off_m = innovation + s.G[s.waiting][FAULT_KINDS * s.count + one]
    return off_m - floor(off_m / wavelength_m(s) + 0.5) * wavelength_m(s)


def _branch(s: State, innovation: float, variance: float, limit_m: float) -> None:
    """Replace the hypotheses by those that follow from them by a phase at each cycle within a limit."""
    hypotheses, first, cycle_m = s.hypotheses, FAULT_KINDS * s.count, wavelength_m(s)
    finish_updates(s)
    compute_ph(s)
    compute_fault_input(s, -1)
    hypotheses.found = 0
    for parent in range(hypotheses.count):
        off_m = innovation + s.G[0][first + parent]
        for cycle in range(-floor((limit_m + off_m) / cycle_m), floor((limit_m - off_m) / cycle_m) + 1):
            shift_m = cycle * cycle_m
            _keep_likely(s, parent, shift_m, hypotheses.log_weight[parent] - 0.5 * square(off_m + shift_m) / variance)
    update(s, innovation, variance)
    _replace(s, 1.0 / sqrt(variance))
    settle_hypotheses(s)


def likelihood(s: State, innovation: float, variance: float) -> float:
    """Likelihood of the phase in ``h`` for all hypotheses together, of 1 for a certain cycle and an innovation of zero.

    The fault inputs are the next of ``G``.
    """
    total = 0.0
    for one in range(s.hypotheses.count):
        nearest_m = _innovation_of(s, innovation, one)
        for cycle in range(-1, 2):
            off_m = nearest_m + cycle * wavelength_m(s)
            total += s.hypotheses.weight[one] * exp(-0.5 * square(off_m) / variance)
    return total


def _keep_likely(s: State, parent: int, shift_m: float, log_weight: float) -> None:
    """Keep a hypothesis that follows from another one by a cycle, if it is among the most likely ones, in order."""
    hypotheses = s.hypotheses
    if hypotheses.found == HYPOTHESES and log_weight <= hypotheses.new_log_weight[HYPOTHESES - 1]:
        return
    place = min(hypotheses.found, HYPOTHESES - 1)
    hypotheses.found = place + 1
    while place > 0 and hypotheses.new_log_weight[place - 1] < log_weight:
        hypotheses.new_log_weight[place] = hypotheses.new_log_weight[place - 1]
        hypotheses.parent[place] = hypotheses.parent[place - 1]
        hypotheses.shift_m[place] = hypotheses.shift_m[place - 1]
        place -= 1
    hypotheses.new_log_weight[place] = log_weight
    hypotheses.parent[place] = parent
    hypotheses.shift_m[place] = shift_m


def _replace(s: State, inverse: float) -> None:
    """Replace all hypotheses by those found: a parent's deviation, and the gain times the shift by cycles.

    The first of ``U`` is P·h/√S of the phase, and ``inverse`` 1/√S.
    """
    hypotheses, first = s.hypotheses, FAULT_KINDS * s.count
    for state in range(s.used):
        effects, gain = s.V[state], s.U[0][state] * inverse
        for one in range(hypotheses.count):
            hypotheses.old[one] = effects[first + one]
        for one in range(hypotheses.found):
            effects[first + one] = hypotheses.old[hypotheses.parent[one]] + gain * hypotheses.shift_m[one]
    for one in range(hypotheses.found):
        hypotheses.log_weight[one] = hypotheses.new_log_weight[one]
    _set_count(s, hypotheses.found)


def settle_hypotheses(s: State) -> None:
    """Drop unlikely hypotheses, merge those that have become alike, and make x the mean. No updates may be queued."""
    hypotheses, first, total = s.hypotheses, FAULT_KINDS * s.count, 0.0
    if hypotheses.count == 0:
        return
    largest = hypotheses.log_weight[0]
    for one in range(1, hypotheses.count):
        largest = max(largest, hypotheses.log_weight[one])
    for one in range(hypotheses.count):
        hypotheses.log_weight[one] -= largest
        hypotheses.weight[one] = exp(hypotheses.log_weight[one])
    for one in range(hypotheses.count - 1, -1, -1):
        if hypotheses.log_weight[one] < -s.tuning.unlikely_log_odds:
            _drop(s, one)
        else:
            _merge(s, one)
    for one in range(hypotheses.count):
        total += hypotheses.weight[one]
    for one in range(hypotheses.count):
        hypotheses.weight[one] /= total
    for state in range(s.used):
        effects, mean = s.V[state], 0.0
        for one in range(hypotheses.count):
            mean += hypotheses.weight[one] * effects[first + one]
        s.x[state] += mean
        for one in range(hypotheses.count):
            effects[first + one] -= mean


def _merge(s: State, one: int) -> None:
    """Add a hypothesis to an earlier one from which it does not differ any more."""
    hypotheses = s.hypotheses
    for other in range(one):
        if _are_alike(s, one, other):
            hypotheses.weight[other] += hypotheses.weight[one]
            hypotheses.log_weight[other] = log(hypotheses.weight[other])
            _drop(s, one)
            return


def _are_alike(s: State, one: int, other: int) -> bool:
    """Whether two hypotheses differ by far less than their covariance in all states, of phases modulo a wavelength."""
    first, cycle_m = FAULT_KINDS * s.count, wavelength_m(s)
    for state in range(s.n):
        off = s.V[state][first + one] - s.V[state][first + other]
        if s.layout.ambiguity <= state < s.layout.change:
            off -= floor(off / cycle_m + 0.5) * cycle_m
        if square(off) > s.tuning.alike * s.P[at(state, state)]:
            return False
    return True


def _drop(s: State, one: int) -> None:
    """Drop a hypothesis; the last one takes its place."""
    hypotheses, first, last = s.hypotheses, FAULT_KINDS * s.count, s.hypotheses.count - 1
    hypotheses.log_weight[one], hypotheses.weight[one] = hypotheses.log_weight[last], hypotheses.weight[last]
    for state in range(s.used):
        s.V[state][first + one] = s.V[state][first + last]
    _set_count(s, last)


def _set_count(s: State, count: int) -> None:
    """Set the number of hypotheses; unused columns of V are zero."""
    first = FAULT_KINDS * s.count
    for state in range(s.used):
        for one in range(count, s.hypotheses.count):
            s.V[state][first + one] = 0.0
    s.hypotheses.count = count
    s.rows = first + count


def scatter(s: State, state: int, other: int) -> float:
    """Covariance of two states over the hypotheses."""
    total, first = 0.0, FAULT_KINDS * s.count
    if HYPOTHESES > 0:
        for one in range(s.hypotheses.count):
            total += s.hypotheses.weight[one] * s.V[state][first + one] * s.V[other][first + one]
    return total


def spread_of_h(s: State) -> tuple[float, float]:
    """Deviation of the measurement in ``h`` by the most likely hypothesis, and the others' variance modulo a cycle.

    The fault inputs, which contain the deviations, are the next of ``G``.
    """
    hypotheses, likely, first, cycle_m, total = s.hypotheses, 0, FAULT_KINDS * s.count, wavelength_m(s), 0.0
    for one in range(hypotheses.count):
        if hypotheses.weight[one] > hypotheses.weight[likely]:
            likely = one
    likely_m = -s.G[s.waiting][first + likely]
    for one in range(hypotheses.count):
        off_m = -s.G[s.waiting][first + one] - likely_m
        total += hypotheses.weight[one] * square(off_m - floor(off_m / cycle_m + 0.5) * cycle_m)
    return likely_m, total


def give_up_hypotheses(s: State) -> None:
    """Replace all hypotheses by their mean. P gains their scatter."""
    hypotheses, first = s.hypotheses, FAULT_KINDS * s.count
    for state in range(s.used):
        row, effects = row_of(state), s.V[state]
        for other in range(row_end(state, s.n)):
            for one in range(hypotheses.count):
                s.P[row + other] += hypotheses.weight[one] * effects[first + one] * s.V[other][first + one]
    _set_count(s, 0)
    _set_count(s, 1)
    hypotheses.log_weight[0], hypotheses.weight[0] = 0.0, 1.0
