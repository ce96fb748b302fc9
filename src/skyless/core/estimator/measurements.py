"""The kinds of measurements. Each is linearised at the state, gated, and processed by one scalar update.

    own reception    R − T  =  |p − a| + b + w + range errors + noise                  (the tag receives an anchor)
    relay            S − T  =  |aᵢ − aⱼ| + bⱼ − bᵢ + wⱼ + pair's constant + noise      (anchor i received anchor j)
    report           bₘ − bᵢ as anchor i knows it                                       (its clock against the master's)
    difference       |p − b| − |p − a| + range errors + noise                           (ready-made, of a pair)
    height           z                                                                  (a sensor of the tag's)
    zero velocity    v                                                                  (the tag stands still)

with offsets b, TX noise w, all in metres. ``docs/maths.md`` section 6 derives them.
"""

from typing import Final

from skyless.core.estimator.faults import end_lasting_fault, is_late_often, subtract_fault_input
from skyless.core.estimator.kalman import (
    clear_variance,
    compute_fault_input,
    compute_ph,
    finish_updates,
    has_order,
    open_direction,
    relax_range_error,
    reset_state,
    update,
    update_later,
)
from skyless.core.estimator.monitor import (
    adapt_change_noise,
    adapt_change_variance,
    adapt_clock_noise,
    adapt_process_noise,
    has_jumped,
    is_common,
    is_of_clock,
    is_warm,
    judge_end,
    learn_place,
    note_innovation,
    note_outlier,
    open_range_error,
    variance_scale,
)
from skyless.core.estimator.state import (
    ALL_RANGE_ERRORS,
    AXES,
    NO_RANGE_ERRORS,
    Link,
    State,
    at,
    make_uncertain,
    set_covariance,
)
from skyless.core.native.arithmetic import floor, sqrt, square
from skyless.core.native.records import Reals, Ticks
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, SUBTICKS, TICK_M, TICK_MASK, TICK_S

SUBTICK_MASK: Final = SUBTICKS * (TICK_MASK + 1) - 1

SHORTEST_S: Final = 50e-6
"""Shortest time between two packets of an anchor: a frame takes longer."""

UNUSED, USED, CLOCK_JUMPED = range(3)
"""Outcomes of a reception. After a jump of its clock an anchor has to join again."""


# Terms of a measurement


def add_term(s: State, state: int, weight: float) -> None:
    """Add a term: weight × state."""
    s.h[s.terms] = weight
    s.h_index[s.terms] = state
    s.terms += 1


def h_dot_x(s: State, begin: int) -> float:
    """Sum of h·x over the terms from ``begin`` on."""
    total = 0.0
    for term in range(begin, s.terms):
        total += s.h[term] * s.x[s.h_index[term]]
    return total


def direction_terms(s: State) -> int:
    """Number of terms of a distance: position, survey error and, in 2-D, the height's error."""
    return s.dim + 3


def add_direction(s: State, anchor: int, sign: float) -> float:
    """Add the distance to an anchor, linearised with the unit vector away from it. Returns the distance.

    The anchor's survey error follows with the opposite sign, and in 2-D the height's error: ``direction_terms`` in all.
    The vector belongs to the held point, the surveyed anchor and the given height. If it followed the newest estimate,
    that estimate's noise would seem to carry information on what the ranges leave open.
    """
    a = s.anchors[anchor]
    _hold_direction(s, anchor)
    return add_direction_from(s, anchor, sign, a.held_m, a.held_range_m)


def add_direction_from(s: State, anchor: int, sign: float, point_m: Reals, point_range_m: float) -> float:
    """Like ``add_direction``, with the direction from the anchor to a given point at that range."""
    where, a = s.layout, s.anchors[anchor]
    survey, squared, up_m = where.survey + s.dim * anchor, 0.0, 0.0
    if s.dim == 2:
        up_m = s.settings.height_m - a.position_m[2]
        squared += square(up_m + s.x[where.height])
    for axis in range(s.dim):
        squared += square(s.x[axis] - a.position_m[axis] - s.x[survey + axis])
        add_term(s, axis, sign * (point_m[axis] - a.position_m[axis]) / point_range_m)
    for axis in range(s.dim):
        add_term(s, survey + axis, -(sign * (point_m[axis] - a.position_m[axis]) / point_range_m))
    if s.dim == 2:
        add_term(s, where.height, sign * up_m / point_range_m)
    return max(sqrt(squared), 1e-6)


def _hold_direction(s: State, anchor: int) -> None:
    """Move the point at which ranges to an anchor are linearised to the estimate, once that is far enough away."""
    tuning, a = s.tuning, s.anchors[anchor]
    moved_m2, squared, variance = 0.0, 0.0, 0.0
    if s.dim == 2:
        squared += square(s.settings.height_m - a.position_m[2])
    for axis in range(s.dim):
        moved_m2 += square(s.x[axis] - a.held_m[axis])
        squared += square(s.x[axis] - a.position_m[axis])
        variance += s.P[at(axis, axis)]
    step_m2 = max(min(square(tuning.suspect) * variance, square(tuning.held_max_m)), square(tuning.held_step_m))
    if s.status.range_errors == NO_RANGE_ERRORS:
        step_m2 = 0.0  # ranges leave nothing open that noise could seem to measure
    if a.held_range_m == 0.0 or moved_m2 > step_m2:
        for axis in range(s.dim):
            a.held_m[axis] = s.x[axis]
        a.held_range_m = max(sqrt(squared), 1e-6)


def _add_range_errors(s: State, anchor: int, sign: float) -> None:
    """Add an anchor's range errors: changing part, constant part and slope."""
    where, from_m = s.layout, s.tuning.slope_from_m
    add_term(s, where.change + anchor, sign)
    add_term(s, where.constant + anchor, sign)
    far = min(max((s.anchors[anchor].held_range_m - from_m) / from_m, -1.0), 1.0)
    add_term(s, where.slope, sign * far)


def _find_curvature_m(s: State, range_m: float, variance: float) -> float:
    """Mean excess of the range over its linearisation: half the variance across the direction, over the range.

    The second term of the Taylor series, with the variance 2·bend² (Jazwinski 1970, section 9.3); 0 if negligible
    against the variance of the stamps. The direction is in the first terms of ``h``.
    """
    across = 0.0
    for axis in range(s.dim):
        across += s.P[at(axis, axis)]
    least = s.tuning.curvature_share * variance * range_m * range_m
    if 0.5 * across * across >= least:
        for one in range(s.dim):
            for other in range(s.dim):
                across -= s.h[one] * s.P[at(one, other)] * s.h[other]
    return 0.5 * across / range_m if 0.5 * across * across >= least else 0.0


# The tag receives an anchor


def reception_terms(s: State, anchor: int, has_tx_noise: bool) -> float:
    """Write the tag's reception of an anchor into ``h``. Returns the distance."""
    s.terms = 0
    range_m = add_direction(s, anchor, 1.0)
    add_term(s, s.layout.offset + anchor, 1.0)
    if has_tx_noise:
        add_term(s, s.layout.tx_noise + anchor, 1.0)
    _add_range_errors(s, anchor, 1.0)
    return range_m


def own_reception(s: State, anchor: int, rx_ticks: Ticks, tx_ticks: Ticks, variance_factor: float) -> int:
    """Process the tag's reception of an anchor's packet: ``USED``, ``UNUSED`` or ``CLOCK_JUMPED``.

    R − T = |p − a − δa| + b + w + change + constant + slope·far + noise. ``variance_factor`` is above 1 for a reception
    whose path looks blocked; such a reception is late rather than noisy, so it is gated without the factor.
    """
    tuning, settings, status, where, a = s.tuning, s.settings, s.status, s.layout, s.anchors[anchor]
    elapsed_s = (rx_ticks - a.rx_ticks) * TICK_S
    relax_range_error(s, anchor, elapsed_s, status.walked_m - a.walked_m)
    rx_variance = settings.rx_variance_m2
    a.has_tx_noise = a.is_relayed
    if a.is_relayed:
        reset_state(s, where.tx_noise + anchor, settings.tx_variance_m2)
    else:
        rx_variance += settings.tx_variance_m2
    range_m = reception_terms(s, anchor, a.is_relayed)
    curvature_m = _find_curvature_m(s, range_m, rx_variance)
    rx_variance += 2.0 * curvature_m * curvature_m
    expected_m = range_m + curvature_m + h_dot_x(s, direction_terms(s))
    innovation = (rx_ticks - tx_ticks - a.offset_ticks) * TICK_M - expected_m
    innovation_variance = compute_ph(s) + rx_variance
    a.range_m = range_m
    if judge_end(s, anchor, 1.0, innovation, innovation_variance):
        innovation += end_obstruction(s, anchor)
        innovation_variance = compute_ph(s) + rx_variance
    if not a.has_rate:
        innovation_variance += (variance_factor - 1.0) * settings.rx_variance_m2
        compute_fault_input(s, anchor)
        find_rate(s, anchor, innovation, innovation_variance, elapsed_s)
        _carry_ticks(s, anchor)
        return USED
    a.innovation = innovation / sqrt(innovation_variance)
    if not is_late_often(s):  # late packets are no multipath
        learn_place(s, anchor, innovation + s.x[where.change + anchor])
    if is_warm(s) and is_common(s, a.innovation):
        status.walk_scale = tuning.max_walk_scale
        a.outliers_in_row = 0
    elif is_warm(s):
        note_outlier(s, anchor, innovation, innovation_variance)
        if has_jumped(s, anchor):
            if is_of_clock(s, anchor, innovation):
                return CLOCK_JUMPED
            # the outliers counted as late; a jump shows that none of them was
            status.late_share = max(status.late_share - tuning.slow_forgetting * (a.outliers_in_row - 1), 0.0)
            innovation = _jump(s, anchor, innovation, rx_variance)
            innovation_variance = compute_ph(s) + rx_variance
            if innovation < -settings.gate * sqrt(innovation_variance):
                return CLOCK_JUMPED
    is_used = _use_reception(s, anchor, innovation, innovation_variance, variance_factor)
    if is_used:
        adapt_change_variance(s, anchor, elapsed_s)
    _carry_ticks(s, anchor)
    return USED if is_used else UNUSED


def _use_reception(
    s: State, anchor: int, innovation: float, innovation_variance: float, variance_factor: float
) -> bool:
    """Queue the update by a reception, and adapt the process noise; False if it is beyond the gate."""
    note_innovation(s, innovation, innovation_variance, False)
    normalised = innovation / sqrt(innovation_variance)
    scale = variance_scale(s, normalised, False)
    if scale > 0.0:
        adapt_change_noise(s, anchor, normalised)
        if is_warm(s):
            adapt_process_noise(s, normalised / scale)
        used_variance = innovation_variance * scale + (variance_factor - 1.0) * s.settings.rx_variance_m2
        compute_fault_input(s, anchor)
        update_later(s, innovation, used_variance)
    return scale > 0.0


def _carry_ticks(s: State, anchor: int) -> None:
    """Move whole ticks of an offset state into ``offset_ticks``."""
    offset = s.layout.offset + anchor
    steps = floor(s.x[offset] / TICK_M)
    s.anchors[anchor].offset_ticks += steps
    s.x[offset] -= steps * TICK_M


def end_obstruction(s: State, anchor: int) -> float:
    """End an obstruction, or a fault that existed since the anchor joined. Returns what its innovation grows by."""
    a, before_m = s.anchors[anchor], h_dot_x(s, 0)
    if a.is_obstructed:
        reset_state(s, s.layout.change + anchor, clear_variance(s, anchor))
    else:
        end_lasting_fault(s, anchor)
    a.is_obstructed = False
    a.outliers_in_row = 0
    return before_m - h_dot_x(s, 0)


def _jump(s: State, anchor: int, innovation: float, rx_variance: float) -> float:
    """Handle a jump of an anchor's range error: back to the value before an obstruction, or to a new one.

    Obstacles make packets late. So an early jump of an anchor not known to be obstructed ends an obstruction that
    existed since it joined, and all its earlier receptions are reconsidered.

    Returns the remaining innovation. If that is earlier than antennas explain and packets are often late, the range
    error is not opened: the first packet, which initialised the anchor's clock, was late.
    """
    if innovation < 0.0:
        innovation += end_obstruction(s, anchor)
        if innovation * innovation <= square(s.settings.gate) * (compute_ph(s) + rx_variance):
            return innovation
    if innovation > -s.tuning.lasting_std_m or not is_late_often(s):
        open_range_error(s, anchor, innovation)
    return innovation


def first_reception(s: State, anchor: int, rx_ticks: Ticks, tx_ticks: Ticks, variance_factor: float) -> None:
    """Initialise an anchor's clock: the limit of an update of an unknown offset.

    The offset then contains all errors of position and range. Its rate follows (``find_rate``). If packets are often
    late, the variance covers that this one may be.
    """
    settings, where, a = s.settings, s.layout, s.anchors[anchor]
    offset, noise = where.offset + anchor, where.tx_noise + anchor
    reset_state(s, noise, settings.tx_variance_m2)
    reset_state(s, where.rate + anchor, 0.0)
    a.has_rate = a.own.is_known = a.mesh.is_known = False
    reset_state(s, offset, 0.0)
    s.terms = 0
    range_m = add_direction(s, anchor, 1.0)
    add_term(s, noise, 1.0)
    _add_range_errors(s, anchor, 1.0)
    variance = settings.rx_variance_m2
    curvature_m = _find_curvature_m(s, range_m, variance)
    variance = variance * variance_factor + 2.0 * curvature_m * curvature_m + compute_ph(s)
    if is_late_often(s):
        variance += square(s.tuning.late_std_m)
    open_state(s, offset, anchor, variance)
    a.offset_ticks = rx_ticks - tx_ticks - floor(range_m / TICK_M)
    rest_m = (rx_ticks - tx_ticks - a.offset_ticks) * TICK_M
    s.x[offset] = rest_m - range_m - curvature_m - h_dot_x(s, direction_terms(s))
    a.has_tx_noise = True
    a.range_m = range_m
    a.noise_ticks = s.status.epoch_ticks


def open_state(s: State, state: int, own: int, variance: float) -> None:
    """Initialise the covariance of a state from a measurement: the limit of an update of an unknown state.

    The state then contains all errors of the measurement, of this variance. ``h`` holds every term but this state,
    which has been reset; their P·h is the first of ``U``. ``own``: the anchor if the tag received it, or −1.
    """
    compute_fault_input(s, own)
    for other in range(s.n):
        set_covariance(s, state, other, 0.0 - s.U[0][other])
    s.P[at(state, state)] = variance
    for fault in range(s.rows):
        s.V[state][fault] = s.G[0][fault]


def find_rate(s: State, anchor: int, innovation: float, innovation_variance: float, elapsed_s: float) -> None:
    """Initialise the rate of an anchor's clock from the first measurement of its offset after its first packet.

    The limit of an update of an unknown rate, in which the offset takes the whole innovation. With a large variance of
    the rate in P instead, the result would be a difference of large numbers. The measurement's P·h and fault inputs are
    the first of ``U`` and ``G``.
    """
    offset, rate, opened = s.layout.offset + anchor, s.layout.rate + anchor, s.U[0]
    update(s, 0.0, innovation_variance)
    for state in range(s.n):
        opened[state] = -opened[state]
    opened[offset] += sqrt(innovation_variance)
    opened[rate] += sqrt(innovation_variance) / elapsed_s
    open_direction(s, 1.0, s.rows)
    s.x[offset] += innovation
    s.x[rate] += innovation / elapsed_s
    s.anchors[anchor].has_rate = True


# An anchor received another


def relay_terms(s: State, listener: int, sender: int, age_s: float, has_tx_noise: bool) -> None:
    """Write an anchor's reception of another anchor, ``age_s`` ago, into ``h``."""
    where = s.layout
    s.terms = 0
    add_term(s, where.offset + sender, 1.0)
    add_term(s, where.offset + listener, -1.0)
    add_term(s, where.rate + sender, -age_s)
    add_term(s, where.rate + listener, age_s)
    if has_tx_noise:
        add_term(s, where.tx_noise + sender, 1.0)


def relay_variance(s: State, listener: int, sender: int, age_s: float) -> float:
    """Variance of a relay: its RX stamp and the noise of two oscillators since."""
    settings = s.settings
    walk = settings.walk * max(s.anchors[listener].walk_scale, s.anchors[sender].walk_scale)
    if has_order(s):
        return settings.rx_variance_m2 + _noise_since(s, listener, age_s) + _noise_since(s, sender, age_s)
    return settings.rx_variance_m2 + 2.0 * age_s * (settings.white + walk * age_s * age_s / 3.0)


def _noise_since(s: State, anchor: int, age_s: float) -> float:
    """Variance of an anchor's clock by its noise that P contains of this time."""
    since_s = max(age_s - (s.status.epoch_ticks - s.anchors[anchor].noise_ticks) * TICK_S, 0.0)
    walk = s.settings.walk * s.anchors[anchor].walk_scale
    return since_s * (s.settings.white + walk * since_s * since_s / 3.0)


def relay_age_s(s: State, listener: int, sender: int, packet_rx_ticks: Ticks) -> float:
    """Time since an anchor received a packet that the tag received too."""
    flown_m = s.anchors[sender].range_m - find_distance_m(s, listener, sender)
    return (s.status.epoch_ticks - packet_rx_ticks) * TICK_S + flown_m / SPEED_OF_LIGHT_MPS


def relay(s: State, listener: int, sender: int, tx_ticks: Ticks, packet_rx_ticks: Ticks, rx_ticks: Ticks) -> bool:
    """Process the reception, by ``listener``, of a packet of ``sender`` that the tag received too. True if used.

    S − T = |aᵢ − aⱼ| + bⱼ − bᵢ + wⱼ + constant of the pair + noise, when the packet reached anchor i. Both offsets are
    extrapolated back to that moment by their rates; the noise of their oscillators since then is added. The pair's
    constant, which contains the survey error, is estimated outside the filter: both directions of a pair contain it
    with the same sign and the offsets with opposite signs, so neither depends on the other.
    """
    tuning, settings, status = s.tuning, s.settings, s.status
    i, j, link = s.anchors[listener], s.anchors[sender], _pair(s, listener, sender)
    distance_m = find_distance_m(s, listener, sender)
    age_s = (status.epoch_ticks - packet_rx_ticks) * TICK_S + (j.range_m - distance_m) / SPEED_OF_LIGHT_MPS
    has_tx_noise = j.tx_ticks == tx_ticks and j.has_tx_noise
    relay_terms(s, listener, sender, age_s, has_tx_noise)
    variance = relay_variance(s, listener, sender, age_s)
    if not has_tx_noise:
        variance += settings.tx_variance_m2
    whole = j.offset_ticks - i.offset_ticks
    innovation = (rx_ticks - tx_ticks - whole) * TICK_M - distance_m - link.constant_m - h_dot_x(s, 0)
    innovation_variance = compute_ph(s) + variance + link.variance_m2
    normalised = innovation / sqrt(innovation_variance)
    if is_warm(s):
        clipped = min(max(normalised, -settings.gate), settings.gate)
        adapt_clock_noise(s, sender, clipped)
        adapt_clock_noise(s, listener, -clipped)
    j.is_relayed = True
    forth, back = s.links[listener][sender], s.links[sender][listener]
    if not -settings.gate <= normalised <= settings.gate:
        status.relays_rejected += 1
        status.relays_lately_rejected += 1.0
        link.outliers_in_row += 1
        if link.outliers_in_row >= tuning.relays_in_row:
            link.outliers_in_row = 0
            link.variance_m2 += square(tuning.max_change_std_m)
            forth.relays = back.relays = 0
        return False
    status.relays_used += 1
    status.relays_lately_accepted += 1.0
    link.outliers_in_row = 0
    share = link.variance_m2 / innovation_variance
    link.constant_m += share * innovation
    link.variance_m2 -= share * link.variance_m2
    _use(s, innovation, innovation_variance)
    forth.relays += 1
    if forth.relays == tuning.pair_relays and back.relays >= tuning.pair_relays:
        _survey_pair(s, listener, sender)
    return True


def _pair(s: State, one: int, other: int) -> Link:
    """The link of two anchors, kept in the row of the lower index."""
    return s.links[min(one, other)][max(one, other)]


def find_distance_m(s: State, one: int, other: int) -> float:
    """Distance between two anchors in the almanac."""
    squared = 0.0
    for axis in range(AXES):
        squared += square(s.anchors[one].position_m[axis] - s.anchors[other].position_m[axis])
    return sqrt(squared)


def _use(s: State, innovation: float, innovation_variance: float) -> None:
    """Queue an update, and its evidence of faults, by the measurement in ``h``, which is no reception of the tag's."""
    compute_fault_input(s, -1)
    update_later(s, innovation, innovation_variance)


def _survey_pair(s: State, one: int, other: int) -> None:
    """Use the measured range between two anchors for their survey; an anchor that contradicts most is misplaced."""
    _pair_range(s, one, other)
    contradicted, rival = 0, 0
    for anchor in range(s.count):
        contradicted += int(_pair(s, one, anchor).contradicts)
        rival += int(_pair(s, other, anchor).contradicts)
    most = max(contradicted, rival)
    if contradicted == rival or most < s.tuning.misplaced_pairs or not _pair(s, one, other).contradicts:
        return
    finish_updates(s)
    misplaced = one if contradicted > rival else other
    a, survey = s.anchors[misplaced], s.layout.survey + s.dim * misplaced
    make_uncertain(s, ALL_RANGE_ERRORS)
    if a.is_obstructed:  # what seemed to be an obstacle
        reset_state(s, s.layout.change + misplaced, clear_variance(s, misplaced))
        a.is_obstructed = False
    for axis in range(s.dim):
        s.P[at(survey + axis, survey + axis)] += square(s.tuning.lasting_std_m)
    for anchor in range(s.count):
        if _pair(s, misplaced, anchor).contradicts:
            _pair_range(s, misplaced, anchor)


def _pair_range(s: State, one: int, other: int) -> None:
    """Process |a + δa − a' − δa'| + constant as two anchors measured it, unless it contradicts the survey."""
    link = _pair(s, one, other)
    s.terms = 0
    add_pair_survey(s, one, other)
    innovation = link.constant_m - h_dot_x(s, 0)
    innovation_variance = compute_ph(s) + square(s.settings.pair_std_m) + link.variance_m2
    link.contradicts = innovation * innovation > square(s.tuning.suspect) * innovation_variance
    if not link.contradicts:
        _use(s, innovation, innovation_variance)


def add_pair_survey(s: State, one: int, other: int) -> None:
    """Add the effect of survey errors on the distance of two anchors."""
    a, b, distance_m = s.anchors[one], s.anchors[other], find_distance_m(s, one, other)
    for axis in range(s.dim):
        towards = (a.position_m[axis] - b.position_m[axis]) / distance_m
        add_term(s, s.layout.survey + s.dim * one + axis, towards)
        add_term(s, s.layout.survey + s.dim * other + axis, -towards)


# An anchor's report of its clock against the master's


def report(s: State, anchor: int, master: int, subticks: Ticks, variance_m2: float) -> None:
    """Replace the filter's estimate of an anchor's clock against the master's by the anchor's own, if that is better.

    The anchor has received all packets of the master that were relayed to the tag, and more. Its error is therefore
    uncorrelated with the difference of the two estimates, which has the variance P − q (P: the filter's, q: the
    anchor's), and the other states change by P_xd/P times that difference. ``subticks``: the anchor's reading minus the
    master's at the packet's TX stamp, modulo 2⁴⁸.
    """
    a, status = s.anchors[anchor], s.status
    finish_updates(s)
    relay_terms(s, anchor, master, a.range_m / SPEED_OF_LIGHT_MPS, False)
    own_variance = 0.0
    for one in range(s.terms):
        for other in range(s.terms):
            own_variance += s.h[one] * s.h[other] * s.P[at(s.h_index[one], s.h_index[other])]
    whole = (s.anchors[master].offset_ticks - a.offset_ticks) & TICK_MASK
    off = (subticks - SUBTICKS * whole) & SUBTICK_MASK
    if off > SUBTICK_MASK // 2:
        off -= SUBTICK_MASK + 1
    innovation = off * (TICK_M / SUBTICKS) - h_dot_x(s, 0)
    if not s.anchors[master].has_rate:
        elapsed_s = (status.epoch_ticks - s.anchors[master].rx_ticks) * TICK_S
        innovation_variance = compute_ph(s) + variance_m2
        compute_fault_input(s, -1)
        if elapsed_s > SHORTEST_S:
            find_rate(s, master, innovation, innovation_variance, elapsed_s)
            status.reports_used += 1
        return
    wandering = max(a.walk_scale, s.anchors[master].walk_scale)
    if own_variance <= variance_m2 or wandering > s.tuning.steady_walk_scale:
        return  # the anchor's own filter has a fixed process noise: it lags behind clocks that wander more
    if innovation * innovation > square(s.settings.gate) * (own_variance + variance_m2):
        status.reports_rejected += 1
        return
    status.reports_used += 1
    compute_ph(s)
    compute_fault_input(s, -1)
    # K = P_xd/P for x and V; for the covariance the factor is (P − q)/P², that of an S of P²/(P − q)
    whole_s = own_variance * own_variance / (own_variance - variance_m2)
    update(s, innovation, whole_s, whole_s / own_variance)


# A ready-made time difference


def difference_terms(s: State, a: int, b: int) -> float:
    """Write a difference of ranges, to anchor b minus to anchor a, into ``h``. Returns the difference.

    Its gradient is in the first terms, like the direction of the other kinds.
    """
    s.terms = 0
    far_m = add_direction(s, b, 1.0)
    near = s.terms
    near_m = add_direction(s, a, -1.0)
    s.anchors[b].range_m = far_m
    s.anchors[a].range_m = near_m
    for axis in range(s.dim):
        s.h[axis] += s.h[near + axis]
        s.h[near + axis] = 0.0
    _add_range_errors(s, b, 1.0)
    _add_range_errors(s, a, -1.0)
    return far_m - near_m


def difference(s: State, a: int, b: int, rx_ticks: Ticks, difference_m: float) -> int:
    """Process a ready-made difference of ranges, to anchor b minus to anchor a: ``USED`` or ``UNUSED``.

    d = |p − b| − |p − a| + range errors of b − those of a + noise. No clocks are estimated, as the
    difference contains none.
    """
    settings, walked_m = s.settings, s.status.walked_m
    a_elapsed_s = (rx_ticks - s.anchors[a].rx_ticks) * TICK_S if s.anchors[a].packets > 0 else 0.0
    b_elapsed_s = (rx_ticks - s.anchors[b].rx_ticks) * TICK_S if s.anchors[b].packets > 0 else 0.0
    relax_range_error(s, a, a_elapsed_s, walked_m - s.anchors[a].walked_m)
    relax_range_error(s, b, b_elapsed_s, walked_m - s.anchors[b].walked_m)
    expected_m = difference_terms(s, a, b)
    innovation = difference_m - expected_m - h_dot_x(s, 2 * direction_terms(s))
    innovation_variance = compute_ph(s) + square(settings.difference_std_m)
    for far in range(2):
        anchor = b if far == 1 else a
        if judge_end(s, anchor, 2.0 * far - 1.0, innovation, innovation_variance):
            innovation += end_obstruction(s, anchor)
            innovation_variance = compute_ph(s) + square(settings.difference_std_m)
    note_innovation(s, innovation, innovation_variance, True)
    normalised = innovation / sqrt(innovation_variance)
    scale = variance_scale(s, normalised, True)
    if scale == 0.0:
        return UNUSED
    if is_warm(s):
        adapt_process_noise(s, normalised / scale)
    compute_fault_input(s, b)
    subtract_fault_input(s, a)
    update_later(s, innovation, innovation_variance * scale)
    finish_updates(s)
    _bound_changes(s)
    adapt_change_noise(s, a, -normalised)
    adapt_change_noise(s, b, normalised)
    adapt_change_variance(s, a, a_elapsed_s)
    adapt_change_variance(s, b, b_elapsed_s)
    return USED


def _bound_changes(s: State) -> None:
    """Raise changing parts below their bound to it: the likeliest state if nothing can be earlier."""
    for change in range(s.layout.change, s.layout.constant):
        missing_m = s.settings.earliest_m - s.x[change]
        if missing_m > 0.0:
            for state in range(s.n):
                s.x[state] += s.P[at(change, state)] / s.P[at(change, change)] * missing_m


# The tag has a sensor of its height


def height(s: State, height_m: float, std_m: float, is_barometer: bool) -> int:
    """Process the reading of a height sensor: ``USED`` or ``UNUSED``.

    A given height is corrected by it. A barometer's zero is estimated too, from its first reading on.
    """
    settings, status, where = s.settings, s.status, s.layout
    innovation = height_m - s.x[where.height]
    if s.dim == 2:
        innovation -= settings.height_m
    s.terms = 0
    add_term(s, where.height, 1.0)
    if is_barometer:
        zero = where.zero
        if s.P[at(zero, zero)] == 0.0:
            s.x[zero] = innovation
            make_uncertain(s, ALL_RANGE_ERRORS)
            s.P[at(zero, zero)] = s.tuning.zero_variance_m2
        else:
            s.P[at(zero, zero)] += settings.barometer_walk * ((status.epoch_ticks - status.height_ticks) * TICK_S)
        innovation -= s.x[zero]
        add_term(s, zero, 1.0)
    innovation_variance = compute_ph(s) + square(std_m)
    if innovation * innovation > square(settings.gate) * innovation_variance:
        return UNUSED
    _use(s, innovation, innovation_variance)
    finish_updates(s)
    status.height_ticks = status.epoch_ticks
    return USED


# The tag stands still


def zero_velocity(s: State) -> None:
    """Process a velocity of zero for a stationary tag, axis by axis."""
    for axis in range(s.dim):
        speed = s.layout.velocity + axis
        s.terms = 0
        add_term(s, speed, 1.0)
        variance = compute_ph(s) + square(s.tuning.stationary_std_mps)
        compute_fault_input(s, -1)
        update(s, -s.x[speed], variance)
