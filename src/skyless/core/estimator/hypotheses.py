"""Cycles that phases may have, as hypotheses which share one covariance.

A phase whose cycle is not certain is processed at each cycle that is possible. These updates have the same row h and
the same variance. So the states that result have one P in common, and differ from their weighted mean, which is x, by a
vector each. These deviations are columns of V behind those of the faults, and every time update and measurement update
treats them as such: the innovation of a hypothesis is ν − h·deviation. Its weight is the likelihood of all stamps and
phases since. An unlikely hypothesis is dropped, and only the most likely ones are kept.
"""

from skyless.core.estimator.kalman import compute_fault_input, update
from skyless.core.estimator.state import FAULT_KINDS, State, row_end, row_of
from skyless.core.native.arithmetic import exp, floor, sqrt, square
from skyless.core.native.records import HYPOTHESES


def take_cycles(s: State, innovation: float, variance: float, limit_m: float, cycle_m: float) -> bool:
    """Process the phase in ``h`` at each cycle within a limit, for each hypothesis. Returns False if there is none.

    P·h is the next of ``U``; ``innovation`` is the mean's, at any cycle; ``variance``: of innovations; ``cycle_m``: the
    wavelength. No updates may be queued.
    """
    hypotheses, first = s.hypotheses, FAULT_KINDS * s.count
    if hypotheses.count == 0:
        hypotheses.log_weight[0], hypotheses.weight[0] = 0.0, 1.0
        _set_count(s, 1)
    compute_fault_input(s, -1)
    hypotheses.found, hypotheses.fit = 0, 0.0
    for parent in range(hypotheses.count):
        off_m = innovation + s.G[0][first + parent]
        for cycle in range(-floor((limit_m + off_m) / cycle_m), floor((limit_m - off_m) / cycle_m) + 1):
            shift_m = cycle * cycle_m
            likelihood = -0.5 * square(off_m + shift_m) / variance
            hypotheses.fit += hypotheses.weight[parent] * exp(likelihood)
            _keep_likely(s, parent, shift_m, hypotheses.log_weight[parent] + likelihood)
    if hypotheses.found > 0:
        update(s, innovation, variance)
        _replace(s, 1.0 / sqrt(variance))
    settle_hypotheses(s)
    return hypotheses.found > 0


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
    """Drop unlikely hypotheses, and make x the mean of the others. No updates may be queued."""
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
            last = hypotheses.count - 1
            hypotheses.log_weight[one], hypotheses.weight[one] = hypotheses.log_weight[last], hypotheses.weight[last]
            for state in range(s.used):
                s.V[state][first + one] = s.V[state][first + last]
            _set_count(s, last)
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
    if hypotheses.count == 1:
        _set_count(s, 0)


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


def spread_of_h(s: State, cycle_m: float) -> tuple[float, float]:
    """Deviation of the measurement in ``h`` by the most likely hypothesis, and the others' variance modulo a cycle."""
    hypotheses, likely, first, total = s.hypotheses, 0, FAULT_KINDS * s.count, 0.0
    if hypotheses.count == 0:
        return 0.0, 0.0
    for one in range(hypotheses.count):
        if hypotheses.weight[one] > hypotheses.weight[likely]:
            likely = one
        hypotheses.old[one] = 0.0
        for term in range(s.terms):
            hypotheses.old[one] += s.h[term] * s.V[s.h_index[term]][first + one]
    for one in range(hypotheses.count):
        off_m = hypotheses.old[one] - hypotheses.old[likely]
        total += hypotheses.weight[one] * square(off_m - floor(off_m / cycle_m + 0.5) * cycle_m)
    return hypotheses.old[likely], total


def give_up_hypotheses(s: State) -> None:
    """Replace all hypotheses by their mean. P gains their scatter."""
    hypotheses, first = s.hypotheses, FAULT_KINDS * s.count
    for state in range(s.used):
        row, effects = row_of(state), s.V[state]
        for other in range(row_end(state, s.n)):
            for one in range(hypotheses.count):
                s.P[row + other] += hypotheses.weight[one] * effects[first + one] * s.V[other][first + one]
    _set_count(s, 0)
