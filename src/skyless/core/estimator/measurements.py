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

import numpy as np

from skyless.core.constants import SPEED_OF_LIGHT_MPS, SUBTICKS, TICK_M, TICK_S
from skyless.core.estimator.faults import compute_fault_input, end_lasting_fault, gather_evidence, subtract_fault_input
from skyless.core.estimator.kalman import compute_ph, jump_share, relax_range_error, reset_state, update
from skyless.core.estimator.monitor import (
    adapt_change_noise,
    adapt_change_variance,
    adapt_clock_noise,
    adapt_process_noise,
    end_small_obstruction,
    has_jumped,
    is_common,
    is_warm,
    learn_place,
    open_range_error,
    variance_scale,
)
from skyless.core.estimator.state import (
    ALL_RANGE_ERRORS,
    NO_RANGE_ERRORS,
    EstimatorState,
    direction_terms,
    layout,
    uncertain_states,
)
from skyless.core.kernels.compiled import step
from skyless.core.ticks import TICK_MASK

CLOCK_JUMPED: Final = 2


@step
def _hold_direction(s: EstimatorState, anchor: int) -> None:
    """Move the point at which ranges to an anchor are linearised onto the estimate, once that is far enough away."""
    settings = s.settings[0]
    dim, a = s.settings[0]["dim"], s.anchors[anchor]
    moved_m, squared, variance = 0.0, 0.0, 0.0
    if dim == 2:
        squared += (s.settings[0]["height_m"] - a["position_m"][2]) ** 2
    for axis in range(dim):
        moved_m += (s.x[axis] - a["held_m"][axis]) ** 2
        squared += (s.x[axis] - a["position_m"][axis]) ** 2
        variance += s.P[axis, axis]
    noise = min(settings["suspect"] ** 2 * variance, settings["held_max_m"] ** 2)
    step = max(noise, settings["held_step_m"] ** 2)
    if s.status[0]["range_errors"] == NO_RANGE_ERRORS:
        step = 0.0  # ranges leave nothing open that noise could seem to measure
    moves = not moved_m <= step  # true at first, for NaN
    for axis in range(dim):
        if moves:
            a["held_m"][axis] = s.x[axis]
    s.anchors[anchor]["held_range_m"] = max(np.sqrt(squared), 1e-6) if moves else a["held_range_m"]


@step
def _add_direction(s: EstimatorState, term: int, anchor: int, sign: float) -> float:
    """Write the unit vector from an anchor to the tag into the measurement; returns their distance as estimated.

    The anchor's survey error follows with the opposite sign, and the height's: ``direction_terms`` in all. The vector
    is that of the held point, of the surveyed anchor and of the given height: were it that of the newest estimate, its
    noise would seem to give information on what the ranges leave open.
    """
    dim, count, x = s.settings[0]["dim"], len(s.anchors), s.x
    a, where = s.anchors[anchor], layout(dim, count)
    _hold_direction(s, anchor)
    survey = where.survey + dim * anchor
    squared = 0.0
    if dim == 2:
        up_m = s.settings[0]["height_m"] - a["position_m"][2]
        squared += (up_m + x[where.height]) ** 2
        s.h[term + 2 * dim], s.h_index[term + 2 * dim] = sign * up_m / a["held_range_m"], where.height
    for axis in range(dim):
        squared += (x[axis] - a["position_m"][axis] - x[survey + axis]) ** 2
        towards = sign * (a["held_m"][axis] - a["position_m"][axis]) / a["held_range_m"]
        s.h[term + axis], s.h_index[term + axis] = towards, axis
        s.h[term + dim + axis], s.h_index[term + dim + axis] = -towards, survey + axis
    return float(max(np.sqrt(squared), 1e-6))


@step
def _set_term(s: EstimatorState, term: int, state: int, weight: float) -> int:
    s.h[term], s.h_index[term] = weight, state
    return term + 1


@step
def _range_error_terms(s: EstimatorState, term: int, anchor: int, sign: float) -> int:
    """Range errors of an anchor: the part that changes, the part that stays, and the slope."""
    settings = s.settings[0]
    where = layout(s.settings[0]["dim"], len(s.anchors))
    term = _set_term(s, term, where.change + anchor, sign)
    term = _set_term(s, term, where.constant + anchor, sign)
    far = min(max((s.anchors[anchor]["held_range_m"] - settings["slope_from_m"]) / settings["slope_from_m"], -1.0), 1.0)
    return int(_set_term(s, term, where.slope, sign * far))


@step
def _h_dot_x(s: EstimatorState, begin: int, end: int) -> float:
    """h·x of terms from ``begin`` to ``end``."""
    total = 0.0
    for term in range(begin, end):
        total += s.h[term] * s.x[s.h_index[term]]
    return total


@step
def _curvature_m(s: EstimatorState, range_m: float, variance: float) -> float:
    """Half the position's variance across the direction, over the range: what the range is longer by on average.

    The second term of its Taylor series, with the variance 2·bend² (Jazwinski 1970, section 9.3); 0 where that is
    small compared with that of the stamps. The direction stands in the first terms of the measurement.
    """
    settings = s.settings[0]
    dim, P, h = s.settings[0]["dim"], s.P, s.h
    across = 0.0
    for axis in range(dim):
        across += P[axis, axis]
    least = settings["curvature_share"] * variance * range_m * range_m
    if 0.5 * across * across >= least:
        for one in range(dim):
            for other in range(dim):
                across -= h[one] * P[one, other] * h[other]
    return float(0.5 * across / range_m) if 0.5 * across * across >= least else 0.0


# The tag receives an anchor


@step
def reception_terms(s: EstimatorState, anchor: int, has_tx_noise: int) -> tuple[int, float]:
    """Write the tag's reception of an anchor into ``h``; its terms, and the distance."""
    dim = s.settings[0]["dim"]
    where = layout(dim, len(s.anchors))
    range_m = _add_direction(s, 0, anchor, 1.0)
    term = _set_term(s, direction_terms(dim), where.offset + anchor, 1.0)
    if has_tx_noise:
        term = _set_term(s, term, where.tx_noise + anchor, 1.0)
    return _range_error_terms(s, term, anchor, 1.0), range_m


@step
def own_reception(s: EstimatorState, anchor: int, rx_ticks: int, tx_ticks: int, variance_factor: float) -> int:
    """Process the tag's reception of an anchor's packet: 1 if it was used, 0 if not, ``CLOCK_JUMPED`` to join again.

    R − T = |p − a − δa| + b + w + change + constant + slope·far + noise. A reception whose path looks blocked has
    its variance multiplied; it is gated as any other, as it is late rather than noisy.
    """
    settings, status, a = s.settings[0], s.status[0], s.anchors[anchor]
    dim = settings["dim"]
    where = layout(dim, len(s.anchors))
    offset = where.offset + anchor
    elapsed_s = (rx_ticks - a["rx_ticks"]) * TICK_S
    relax_range_error(s, anchor, elapsed_s, status["walked_m"] - a["walked_m"])
    rx_variance = settings["rx_variance_m2"]
    a["has_tx_noise"] = a["is_relayed"]
    if a["is_relayed"]:
        reset_state(s, where.tx_noise + anchor, settings["tx_variance_m2"])
    else:
        rx_variance += settings["tx_variance_m2"]
    terms, range_m = reception_terms(s, anchor, a["is_relayed"])
    curvature_m = _curvature_m(s, range_m, rx_variance)
    rx_variance += 2.0 * curvature_m * curvature_m
    expected_m = range_m + curvature_m + _h_dot_x(s, direction_terms(dim), terms)
    innovation = (rx_ticks - tx_ticks - a["offset_ticks"]) * TICK_M - expected_m
    innovation_variance = compute_ph(s, terms) + rx_variance
    a["range_m"] = range_m
    a["innovation"] = innovation / np.sqrt(innovation_variance)
    if status["late_share"] <= settings["late_often_share"]:  # late packets are no multipath
        learn_place(s, anchor, innovation + s.x[where.change + anchor])
    clock_jumped = False
    if is_warm(s) and abs(a["innovation"]) > settings["common"] and is_common(s, a["innovation"]):
        status["walk_scale"] = settings["max_walk_scale"]
        a["outliers_in_row"] = 0
    elif is_warm(s) and has_jumped(s, anchor, innovation, innovation_variance):
        clock_jumped = a["relay_outliers_in_row"] >= settings["relays_in_row"]
        if not clock_jumped:
            innovation, innovation_variance = _jump(s, anchor, innovation, terms, rx_variance)
    scale = 0.0 if clock_jumped else variance_scale(s, innovation, innovation_variance, False)
    used = scale > 0.0
    if used:
        end_small_obstruction(s, anchor)
        normalised = innovation / np.sqrt(innovation_variance)
        if a["is_obstructed"]:
            adapt_change_noise(s, anchor, normalised)
        if is_warm(s):
            adapt_process_noise(s, normalised / scale)
        used_variance = innovation_variance * scale + (variance_factor - 1.0) * settings["rx_variance_m2"]
        compute_fault_input(s, terms, anchor)
        gather_evidence(s, innovation, used_variance)
        update(s, innovation, used_variance)
        adapt_change_variance(s, anchor, elapsed_s)
    steps = int(np.floor(s.x[offset] / TICK_M))
    s.anchors[anchor]["offset_ticks"] += steps
    s.x[offset] -= steps * TICK_M
    return CLOCK_JUMPED if clock_jumped else int(used)


@step
def _jump(s: EstimatorState, anchor: int, innovation: float, terms: int, rx_variance: float) -> tuple[float, float]:
    """An anchor's range error has jumped: back to what it was before it was obstructed, or to something new.

    Obstacles make packets late: an early jump of an anchor that is not known to be obstructed ends an obstruction that
    has been there since it joined, and all its earlier receptions are considered again.

    Returns the innovation that is left, and its variance.
    """
    a, status, settings = s.anchors[anchor], s.status[0], s.settings[0]
    where = layout(settings["dim"], len(s.anchors))
    change = where.change + anchor
    has_ended = False
    if innovation < 0.0:
        before_m = _h_dot_x(s, 0, terms)
        if a["is_obstructed"]:
            share = jump_share(s)
            reset_state(s, change, a["change_variance_m2"] + share * settings["obstructed_std_m"] ** 2)
        else:
            end_lasting_fault(s, anchor)
        innovation += before_m - _h_dot_x(s, 0, terms)
        a["is_obstructed"] = a["outliers_in_row"] = 0
        status["ends_of_obstructions"] += 1
        left = compute_ph(s, terms) + rx_variance
        has_ended = innovation * innovation <= settings["gate"] ** 2 * left
    if not has_ended:
        open_range_error(s, anchor, innovation)
    return innovation, compute_ph(s, terms) + rx_variance


@step
def first_reception(s: EstimatorState, anchor: int, rx_ticks: int, tx_ticks: int) -> None:
    """Initialise an anchor's clock: the limit of an update of an offset of which nothing was known.

    All errors of the position and of the range are then in the offset.
    """
    settings, a, P = s.settings[0], s.anchors[anchor], s.P
    dim, n = settings["dim"], uncertain_states(s)
    where = layout(dim, len(s.anchors))
    offset, noise, rate = where.offset + anchor, where.tx_noise + anchor, where.rate + anchor
    reset_state(s, noise, settings["tx_variance_m2"])
    reset_state(s, rate, settings["clock_rate_variance"])
    reset_state(s, offset, 0.0)
    range_m = _add_direction(s, 0, anchor, 1.0)
    other = direction_terms(dim)
    terms = _range_error_terms(s, _set_term(s, other, noise, 1.0), anchor, 1.0)
    variance = settings["rx_variance_m2"]
    curvature_m = _curvature_m(s, range_m, variance)
    variance += 2.0 * curvature_m * curvature_m + compute_ph(s, terms)
    compute_fault_input(s, terms, anchor)
    for state in range(n):
        P[state, offset] = -s.ph[state]
        P[offset, state] = -s.ph[state]
    P[offset, offset] = variance
    for fault in range(s.V.shape[0]):
        s.V[fault, offset] = s.fault_input[fault]
    whole = rx_ticks - tx_ticks - int(np.floor(range_m / TICK_M))
    a["offset_ticks"], a["has_tx_noise"] = whole, 1
    s.x[offset] = (rx_ticks - tx_ticks - whole) * TICK_M - range_m - curvature_m - _h_dot_x(s, other, terms)
    a["range_m"] = range_m


# An anchor received another


@step
def relay_terms(s: EstimatorState, listener: int, sender: int, age_s: float, has_tx_noise: bool) -> int:
    """Write an anchor's reception of another, ``age_s`` ago, into ``h``; its terms."""
    where = layout(s.settings[0]["dim"], len(s.anchors))
    term = _set_term(s, 0, where.offset + sender, 1.0)
    term = _set_term(s, term, where.offset + listener, -1.0)
    term = _set_term(s, term, where.rate + sender, -age_s)
    term = _set_term(s, term, where.rate + listener, age_s)
    return int(_set_term(s, term, where.tx_noise + sender, 1.0)) if has_tx_noise else int(term)


@step
def relay_variance(s: EstimatorState, listener: int, sender: int, age_s: float) -> float:
    """Variance of such a reception: of its RX stamp, and of what two oscillators have done since."""
    settings, i, j = s.settings[0], s.anchors[listener], s.anchors[sender]
    walk = settings["walk"] * max(i["walk_scale"], j["walk_scale"])
    return float(settings["rx_variance_m2"] + 2.0 * age_s * (settings["white"] + walk * age_s * age_s / 3.0))


@step
def relay(s: EstimatorState, listener: int, sender: int, tx_ticks: int, packet_rx_ticks: int, rx_ticks: int) -> None:
    """Process the reception, by the anchor ``listener``, of a packet of ``sender`` that the tag has received as well.

    S − T = |aᵢ − aⱼ| + bⱼ − bᵢ + wⱼ + constant of the pair + noise, when the packet reached anchor i. Both offsets go
    back to that moment by their rates; what their oscillators have done since counts as noise. The pair's constant,
    in which the survey is, is estimated outside the filter: as both directions of a pair hold it with the same sign
    and the offsets with opposite ones, neither depends on the other.
    """
    settings, status = s.settings[0], s.status[0]
    i, j = s.anchors[listener], s.anchors[sender]
    squared = 0.0
    for axis in range(3):
        squared += (i["position_m"][axis] - j["position_m"][axis]) ** 2
    distance_m = np.sqrt(squared)
    age_s = (status["epoch_ticks"] - packet_rx_ticks) * TICK_S + (j["range_m"] - distance_m) / SPEED_OF_LIGHT_MPS
    has_tx_noise = j["tx_ticks"] == tx_ticks and j["has_tx_noise"] != 0
    term = relay_terms(s, listener, sender, age_s, has_tx_noise)
    variance = relay_variance(s, listener, sender, age_s)
    if not has_tx_noise:
        variance += settings["tx_variance_m2"]
    link = s.links[min(listener, sender), max(listener, sender)]
    whole = j["offset_ticks"] - i["offset_ticks"]
    innovation = (rx_ticks - tx_ticks - whole) * TICK_M - distance_m - link["constant_m"] - _h_dot_x(s, 0, term)
    pair_variance = link["variance_m2"]
    innovation_variance = compute_ph(s, term) + variance + pair_variance
    normalised = innovation / np.sqrt(innovation_variance)
    if is_warm(s):
        clipped = min(max(normalised, -settings["gate"]), settings["gate"])
        adapt_clock_noise(s, sender, clipped)
        adapt_clock_noise(s, listener, -clipped)
    if not -settings["gate"] <= normalised <= settings["gate"]:
        status["relays_rejected"] += 1
        status["relays_lately_rejected"] += 1.0
        i["relay_outliers_in_row"] += 1
        j["relay_outliers_in_row"] += 1
        link["outliers_in_row"] += 1
        if link["outliers_in_row"] >= settings["relays_in_row"]:
            link["outliers_in_row"] = 0
            link["variance_m2"] += settings["pair_jump_m2"]
            s.links[listener, sender]["relays"] = s.links[sender, listener]["relays"] = 0
    else:
        status["relays_used"] += 1
        status["relays_lately_accepted"] += 1.0
        i["relay_outliers_in_row"] = j["relay_outliers_in_row"] = link["outliers_in_row"] = 0
        share = pair_variance / innovation_variance
        link["constant_m"] += share * innovation
        link["variance_m2"] -= share * pair_variance
        compute_fault_input(s, term, -1)
        gather_evidence(s, innovation, innovation_variance)
        update(s, innovation, innovation_variance)
        forth, back = s.links[listener, sender], s.links[sender, listener]
        forth["relays"] += 1
        if forth["relays"] == settings["pair_relays"] and back["relays"] >= settings["pair_relays"]:
            _survey_pair(s, listener, sender)
    s.anchors[sender]["is_relayed"] = 1


@step
def _survey_pair(s: EstimatorState, one: int, other: int) -> None:
    """Use the range between two anchors for their survey; anchors that contradict most of theirs are misplaced."""
    settings = s.settings[0]
    count, dim, status = len(s.anchors), s.settings[0]["dim"], s.status[0]
    _pair_range(s, one, other)
    contradicted, rival = 0, 0
    for anchor in range(count):
        contradicted += s.links[min(one, anchor), max(one, anchor)]["contradicts"]
        rival += s.links[min(other, anchor), max(other, anchor)]["contradicts"]
    misplaced, where = one if contradicted > rival else other, layout(dim, count)
    is_misplaced = contradicted != rival and max(contradicted, rival) >= settings["misplaced_pairs"]
    is_misplaced = is_misplaced and s.links[min(one, other), max(one, other)]["contradicts"] != 0
    status["range_errors"] = ALL_RANGE_ERRORS if is_misplaced else status["range_errors"]
    if is_misplaced and s.anchors[misplaced]["is_obstructed"]:  # what seemed to be an obstacle
        reset_state(s, where.change + misplaced, s.anchors[misplaced]["change_variance_m2"])
        s.anchors[misplaced]["is_obstructed"] = 0
    for axis in range(dim if is_misplaced else 0):
        survey = where.survey + dim * misplaced + axis
        s.P[survey, survey] += settings["lasting_std_m"] ** 2
    for anchor in range(count if is_misplaced else 0):
        if s.links[min(misplaced, anchor), max(misplaced, anchor)]["contradicts"]:
            _pair_range(s, misplaced, anchor)


@step
def _pair_range(s: EstimatorState, one: int, other: int) -> None:
    """Process |a + δa − a' − δa'| + constant as two anchors measured it, unless it contradicts the survey."""
    settings = s.settings[0]
    dim, term, squared = s.settings[0]["dim"], 0, 0.0
    a, b = s.anchors[one], s.anchors[other]
    survey = layout(dim, len(s.anchors)).survey
    for axis in range(3):
        squared += (a["position_m"][axis] - b["position_m"][axis]) ** 2
    for axis in range(dim):
        towards = (a["position_m"][axis] - b["position_m"][axis]) / np.sqrt(squared)
        term = _set_term(s, term, survey + dim * one + axis, towards)
        term = _set_term(s, term, survey + dim * other + axis, -towards)
    link = s.links[min(one, other), max(one, other)]
    innovation = link["constant_m"] - _h_dot_x(s, 0, term)
    innovation_variance = compute_ph(s, term) + s.settings[0]["pair_std_m"] ** 2 + link["variance_m2"]
    fits = innovation * innovation <= settings["suspect"] ** 2 * innovation_variance
    if fits:
        compute_fault_input(s, term, -1)
        gather_evidence(s, innovation, innovation_variance)
        update(s, innovation, innovation_variance)
    s.links[min(one, other), max(one, other)]["contradicts"] = 0 if fits else 1


# An anchor reports what its clock reads against the master's


@step
def report(s: EstimatorState, anchor: int, master: int, subticks: int, variance_m2: float) -> None:
    """Let what an anchor knows of its clock against the master's replace what the filter knows, where that is worse.

    The anchor has received all packets of the master that were relayed to the tag, and more, so its error is
    uncorrelated with the difference of both estimates, of variance P − q (P: the filter's, q: the anchor's), and the
    other states change by P_xd/P times that difference. ``subticks``: the anchor's reading less the master's at the
    packet's TX stamp, modulo 2⁴⁸.
    """
    settings, a = s.settings[0], s.anchors[anchor]
    dim = settings["dim"]
    back_s = a["range_m"] / SPEED_OF_LIGHT_MPS
    where = layout(dim, len(s.anchors))
    term = _set_term(s, 0, where.offset + master, 1.0)
    term = _set_term(s, term, where.offset + anchor, -1.0)
    term = _set_term(s, term, where.rate + master, -back_s)
    term = _set_term(s, term, where.rate + anchor, back_s)
    own_variance = 0.0
    for one in range(term):
        for other in range(term):
            own_variance += s.h[one] * s.h[other] * s.P[s.h_index[one], s.h_index[other]]
    whole = (s.anchors[master]["offset_ticks"] - a["offset_ticks"]) & TICK_MASK
    wrap = SUBTICKS * (TICK_MASK + 1)
    off = (subticks - SUBTICKS * whole) & (wrap - 1)
    if off >= wrap // 2:
        off -= wrap
    innovation = off * (TICK_M / SUBTICKS) - _h_dot_x(s, 0, term)
    is_news = own_variance > variance_m2
    fits = innovation * innovation <= settings["gate"] ** 2 * (own_variance + variance_m2)
    if is_news and fits:
        compute_ph(s, term)
        compute_fault_input(s, term, -1)
        # K = P_xd/P for x and V; for the covariance the factor is (P − q)/P², that of an S of P²/(P − q)
        whole_s = own_variance * own_variance / (own_variance - variance_m2)
        update(s, innovation, whole_s, whole_s / own_variance)
    s.status[0]["reports_used"] += int(is_news and fits)
    s.status[0]["reports_rejected"] += int(is_news and not fits)


# A ready-made time difference


@step
def difference_terms(s: EstimatorState, a: int, b: int) -> tuple[int, float]:
    """Write a difference of ranges, to anchor b less to anchor a, into ``h``; its terms, and the difference.

    Its gradient stands in the first terms, as the other kinds' directions do.
    """
    dim = s.settings[0]["dim"]
    near = direction_terms(dim)
    far_m = _add_direction(s, 0, b, 1.0)
    near_m = _add_direction(s, near, a, -1.0)
    s.anchors[b]["range_m"], s.anchors[a]["range_m"] = far_m, near_m
    for axis in range(dim):
        s.h[axis] += s.h[near + axis]
        s.h[near + axis] = 0.0
    term = _range_error_terms(s, 2 * near, b, 1.0)
    return _range_error_terms(s, term, a, -1.0), far_m - near_m


@step
def difference(s: EstimatorState, a: int, b: int, rx_ticks: int, difference_m: float) -> int:
    """Process a ready-made difference of ranges, to anchor b less to anchor a: 1 if it was used, 0 if not.

    d = |p − b| − |p − a| + range errors of b − those of a + noise. Nothing is estimated of clocks, which whoever made
    the difference has removed.
    """
    settings, status = s.settings[0], s.status[0]
    dim, walked_m = settings["dim"], status["walked_m"]
    a_elapsed_s = (rx_ticks - s.anchors[a]["rx_ticks"]) * TICK_S if s.anchors[a]["packets"] > 0 else 0.0
    b_elapsed_s = (rx_ticks - s.anchors[b]["rx_ticks"]) * TICK_S if s.anchors[b]["packets"] > 0 else 0.0
    relax_range_error(s, a, a_elapsed_s, walked_m - s.anchors[a]["walked_m"])
    relax_range_error(s, b, b_elapsed_s, walked_m - s.anchors[b]["walked_m"])
    terms, expected_m = difference_terms(s, a, b)
    innovation = difference_m - expected_m - _h_dot_x(s, 2 * direction_terms(dim), terms)
    innovation_variance = compute_ph(s, terms) + settings["difference_std_m"] ** 2
    scale = variance_scale(s, innovation, innovation_variance, True)
    if scale > 0.0:
        if is_warm(s):
            adapt_process_noise(s, innovation / np.sqrt(innovation_variance) / scale)
        compute_fault_input(s, terms, b)
        subtract_fault_input(s, a)
        gather_evidence(s, innovation, innovation_variance * scale)
        update(s, innovation, innovation_variance * scale)
        _bound_changes(s)
        end_small_obstruction(s, a)
        end_small_obstruction(s, b)
        adapt_change_variance(s, a, a_elapsed_s)
        adapt_change_variance(s, b, b_elapsed_s)
    return int(scale > 0.0)


@step
def _bound_changes(s: EstimatorState) -> None:
    """Move changing parts that are below their bound onto it: the likeliest state of all where nothing is earlier."""
    x, P, change = s.x, s.P, layout(s.settings[0]["dim"], len(s.anchors)).change
    for anchor in range(len(s.anchors)):
        missing_m, m = s.settings[0]["earliest_m"] - x[change + anchor], change + anchor
        if missing_m > 0.0:
            for state in range(uncertain_states(s)):
                x[state] += P[m, state] / P[m, m] * missing_m


# The tag has a sensor of its height


@step
def height(s: EstimatorState, height_m: float, std_m: float, is_barometer: bool) -> int:
    """Process the tag's height as a sensor measures it: 1 if it was used, 0 if not.

    Where a height is given, it corrects that. A barometer's zero is estimated as well, from its first reading on.
    """
    settings, dim, status = s.settings[0], s.settings[0]["dim"], s.status[0]
    where = layout(dim, len(s.anchors))
    given_m = settings["height_m"] if dim == 2 else 0.0
    term = _set_term(s, 0, where.height, 1.0)
    innovation = height_m - given_m - s.x[where.height]
    if is_barometer:
        is_first = s.P[where.zero, where.zero] == 0.0
        since_s = (status["epoch_ticks"] - status["height_ticks"]) * TICK_S
        if is_first:
            s.x[where.zero] = innovation
            s.status[0]["range_errors"] = ALL_RANGE_ERRORS
        s.P[where.zero, where.zero] += (
            settings["zero_variance_m2"] if is_first else settings["barometer_walk"] * since_s
        )
        innovation -= s.x[where.zero]
        term = _set_term(s, term, where.zero, 1.0)
    innovation_variance = compute_ph(s, term) + std_m * std_m
    used = innovation * innovation <= settings["gate"] ** 2 * innovation_variance
    if used:
        compute_fault_input(s, term, -1)
        gather_evidence(s, innovation, innovation_variance)
        update(s, innovation, innovation_variance)
        s.status[0]["height_ticks"] = s.status[0]["epoch_ticks"]
    return int(used)


# The tag stands still


@step
def zero_velocity(s: EstimatorState) -> None:
    """Process the knowledge that a stationary tag has no velocity, one axis after the other."""
    settings = s.settings[0]
    dim = s.settings[0]["dim"]
    velocity = layout(dim, len(s.anchors)).velocity
    for axis in range(dim):
        term = _set_term(s, 0, velocity + axis, 1.0)
        variance = compute_ph(s, term) + settings["stationary_std_mps"] ** 2
        innovation = -s.x[velocity + axis]
        compute_fault_input(s, term, -1)
        update(s, innovation, variance)
