"""Faults that the state does not hold: what they do to it, what innovations show of them, and adding them to it.

Where all that the tag receives of anchor j is late by b metres, the estimate errs by V_j·b, and the
innovation of a measurement h holds s_j·b (Friedland 1969):

    s = [own reception of j] − h·V        V ← F·V  (time)        V ← V + K·s  (update)

With y = Σ s·ν/S and M = Σ s·sᵀ/S over the innovations ν of variance S, and σ_f²·I the faults' variance beforehand, all
anchors' faults are b̂ = (M + I/σ_f²)⁻¹·y with the covariance (M + I/σ_f²)⁻¹, and yᵀ·(M + I/σ_f²)⁻¹·y tests whether there
are any. Where V, y and M forget, b is the present size of a fault that has grown as fast as they forget: within packets
(recent) or seconds (creeping). A fault that is sure is added to the anchor's range error, which gives the state that
the filter would have, had that error been open from the beginning.
"""

from typing import Final

import numpy as np

from skyless.core.constants import TICK_S
from skyless.core.estimator.kalman import reset_state
from skyless.core.estimator.state import (
    ALL_RANGE_ERRORS,
    CHANGING_RANGE_ERRORS,
    CREEPING,
    FAULT_KINDS,
    LASTING,
    RECENT,
    EstimatorState,
    layout,
    uncertain_states,
)
from skyless.core.kernels.arrays import Matrix
from skyless.core.kernels.compiled import step

MAX_FAULTS: Final = 2  # largest number of anchors that are selected


@step
def compute_fault_input(s: EstimatorState, terms: int, own: int) -> None:
    """Compute s = [own reception] − h·V; ``own`` is the anchor that the tag has received, or −1."""
    V, fault_input, h, h_index = s.V, s.fault_input, s.h, s.h_index
    for fault in range(V.shape[0]):
        total = 0.0
        for term in range(terms):
            total -= h[term] * V[fault, h_index[term]]
        fault_input[fault] = total
    for kind in range(FAULT_KINDS if own >= 0 else 0):
        fault_input[kind * len(s.anchors) + own] += 1.0


@step
def subtract_fault_input(s: EstimatorState, anchor: int) -> None:
    """Subtract the reception of the first anchor of a difference: its faults count with the opposite sign."""
    for kind in range(FAULT_KINDS):
        s.fault_input[kind * len(s.anchors) + anchor] -= 1.0


@step
def gather_evidence(s: EstimatorState, innovation: float, innovation_variance: float) -> None:
    """What an innovation shows of the anchors' faults: y ← y + s·ν/S and M ← M + s·sᵀ/S."""
    evidence, information, fault_input = s.evidence, s.information, s.fault_input
    for one in range(len(evidence)):
        weight = fault_input[one] / innovation_variance
        evidence[one] += weight * innovation
        for other in range(len(evidence)):
            information[one, other] += weight * fault_input[other]


@step
def fade_faults(s: EstimatorState) -> None:
    """Forget, once in a round of packets, a share of what has not lasted has done, and of the evidence for it."""
    settings = s.settings[0]
    count, n, status = len(s.anchors), uncertain_states(s), s.status[0]
    is_round = status["packets"] % count == 0
    elapsed_s = (status["epoch_ticks"] - status["faded_ticks"]) * TICK_S
    status["faded_ticks"] = status["epoch_ticks"] if is_round else status["faded_ticks"]
    for fault in range(count, FAULT_KINDS * count if is_round else count):
        begin = fault - fault % count
        kept = (
            1.0 - 1.0 / settings["recent_packets"]
            if begin == RECENT * count
            else np.exp(-elapsed_s / settings["creeping_s"])
        )
        s.evidence[fault] *= kept
        for state in range(n):
            s.V[fault, state] *= kept
        for other in range(FAULT_KINDS * count):
            s.information[fault, other] *= kept
            s.information[other, fault] *= 1.0 if begin <= other < begin + count else kept


@step
def whiten(work: Matrix, count: int, vectors: int) -> None:
    """Compute L⁻¹·r of the vectors r in the rows behind a symmetric matrix M = L·Lᵀ, in place, by Cholesky's method.

    So r·M⁻¹·q is the product of what becomes of r and of q. Rows of vectors are treated as rows of the matrix.
    """
    for column in range(count):
        total = work[column, column]
        for k in range(column):
            total -= work[column, k] * work[column, k]
        inverse = 1.0 / np.sqrt(max(total, 1e-30))
        for row in range(column + 1, count + vectors):
            total = work[row, column]
            for k in range(column):
                total -= work[row, k] * work[column, k]
            work[row, column] = total * inverse


@step
def fault_chi2(s: EstimatorState, kind: int, axes: int) -> float:
    """The test of all faults of a kind; leaves L⁻¹·y, and L⁻¹·V of that number of axes, in the rows of ``work``.

    L·Lᵀ is M + I/σ_f².
    """
    count, begin, std_m = len(s.anchors), kind * len(s.anchors), s.status[0]["fault_std_m"][kind]
    for one in range(count):
        for other in range(count):
            s.work[one, other] = s.information[begin + one, begin + other]
        s.work[one, one] += 1.0 / (std_m * std_m)
        s.work[count, one] = s.evidence[begin + one]
        for axis in range(axes):
            s.work[count + 1 + axis, one] = s.V[begin + one, axis]
    whiten(s.work, count, 1 + axes)
    total = 0.0
    for one in range(count):
        total += s.work[count, one] ** 2
    return total


@step
def explained_chi2(s: EstimatorState, one: int, other: int) -> float:
    """How much of the test of all lasting faults one anchor or two explain; for one, both arguments are the same."""
    settings = s.settings[0]
    y, M, weight = s.evidence, s.information, 1.0 / settings["late_std_m"] ** 2
    a, b, both = M[one, one] + weight, M[other, other] + weight, M[one, other]
    if one == other:
        explained = y[one] * y[one] / a
    else:
        explained = (b * y[one] ** 2 - 2.0 * both * y[one] * y[other] + a * y[other] ** 2) / (a * b - both * both)
    return float(explained)


@step
def open_faults(s: EstimatorState) -> None:
    """Add faults to the state where the test of all of a kind is sure, of the kind that explains most.

    After a start that was contradicted, none are selected: any number of anchors may be late then, and those that
    explain the test are now and then the wrong ones.
    """
    settings = s.settings[0]
    lasting_chi2, creeping_chi2 = fault_chi2(s, LASTING, 0), fault_chi2(s, CREEPING, 0)
    lasting, recent, creeping = _largest(s, LASTING), _largest(s, RECENT), _largest(s, CREEPING)
    if s.status[0]["fault_std_m"][LASTING] <= settings["lasting_std_m"]:
        if creeping_chi2 > max(settings["sure_chi2"], lasting_chi2) and creeping > recent and creeping >= lasting:
            _open_new_faults(s, CREEPING)
        elif fault_chi2(s, RECENT, 0) > settings["sure_chi2"] and recent >= lasting:
            _open_new_faults(s, RECENT)
        elif lasting_chi2 > settings["sure_chi2"]:
            _open_lasting_faults(s, lasting_chi2)


@step
def _largest(s: EstimatorState, kind: int) -> float:
    """How much the fault of a single anchor explains at most."""
    most = 0.0
    for anchor in range(len(s.anchors)):
        most = max(most, _explained_alone(s, kind, anchor))
    return most


@step
def _explained_alone(s: EstimatorState, kind: int, anchor: int) -> float:
    """How much the fault of an anchor explains; that it is early is less likely, and counts less."""
    settings, fault = s.settings[0], kind * len(s.anchors) + anchor
    y, M = s.evidence[fault], s.information[fault, fault]
    return float((1.0 if y > 0.0 else settings["early_weight"]) * y * y / (M + 1.0 / settings["late_std_m"] ** 2))


@step
def _open_new_faults(s: EstimatorState, kind: int) -> None:
    """Open the range errors of the anchors whose faults explain the innovations about as well as any other's.

    A single one opens by itself; where it is open which of several it is, the position uses none of them,
    as long as enough anchors are left.
    """
    settings = s.settings[0]
    count, spare = len(s.anchors), len(s.anchors) - s.settings[0]["dim"] - 1
    for anchor in range(count):
        spare -= 1 if s.anchors[anchor]["is_obstructed"] else 0
        s.ph[anchor] = _explained_alone(s, kind, anchor)
    limit = _largest(s, kind) - settings["rival_chi2"]
    first = 0
    while spare > 0 and first >= 0:
        first = -1
        for anchor in range(count):
            if s.ph[anchor] > limit and (first < 0 or s.ph[anchor] > s.ph[first]):
                first = anchor
        if first >= 0:
            s.ph[first] = 0.0
            spare -= 1
            _open_fault(s, kind, first)
            begin_obstruction(s, first)


@step
def begin_obstruction(s: EstimatorState, anchor: int) -> None:
    """Note that an anchor's range error has jumped; it may still be changing."""
    settings = s.settings[0]
    a, status = s.anchors[anchor], s.status[0]
    a["outliers_in_row"] = 0
    a["is_obstructed"] = 1
    a["change_mean"], a["change_scale"] = 0.0, settings["first_change_scale"]
    status["obstruction"] = min(status["obstruction"] + settings["jump_rise"], 2.0)


@step
def _open_lasting_faults(s: EstimatorState, chi2: float) -> None:
    """Add the lasting faults of one or two anchors to the state, where no others explain the test as well."""
    settings = s.settings[0]
    count, dim = len(s.anchors), s.settings[0]["dim"]
    most_faults, opened = min(MAX_FAULTS, count - dim - 2), False
    for faults in range(1, most_faults + 1):
        first, second, most, rival = -1, -1, 0.0, 0.0
        for one in range(count):
            for other in range(one + 1):
                if (one == other) == (faults == 1):
                    explained = explained_chi2(s, one, other)
                    if explained > most:
                        first, second, most, rival = one, other, explained, most
                    elif explained > rival:
                        rival = explained
        if not opened and chi2 - most < settings["rival_chi2"] and most - rival > settings["rival_chi2"]:
            opened = True
            for one in range(faults):
                anchor = second if one else first
                _open_fault(s, LASTING, anchor)
                s.anchors[anchor]["has_fault"] = 1


@step
def end_lasting_fault(s: EstimatorState, anchor: int) -> None:
    """End a fault: an anchor's packets have been late since it joined, and are not any more."""
    settings = s.settings[0]
    _open_fault(s, LASTING, anchor)
    reset_state(s, layout(settings["dim"], len(s.anchors)).constant + anchor, settings["range_std_m"] ** 2)
    s.status[0]["obstruction"] = min(s.status[0]["obstruction"] + settings["jump_rise"], 2.0)


@step
def _open_fault(s: EstimatorState, kind: int, anchor: int) -> None:
    """Add a fault to its anchor's range error; all other hypotheses are conditioned on it (Schur's complement)."""
    settings = s.settings[0]
    status, is_lasting = s.status[0], kind == LASTING
    status["range_errors"] = max(status["range_errors"], ALL_RANGE_ERRORS if is_lasting else CHANGING_RANGE_ERRORS)
    x, P, V, evidence, information, column = s.x, s.P, s.V, s.evidence, s.information, s.fault_input
    count, n = len(s.anchors), uncertain_states(s)
    where, chosen = layout(s.settings[0]["dim"], count), kind * count + anchor
    gain = 1.0 / (information[chosen, chosen] + 1.0 / settings["late_std_m"] ** 2)
    fault_m = gain * evidence[chosen]
    variance = gain if is_lasting else gain + fault_m * fault_m
    opened = V[chosen]  # what it adds to each state: 1 − V for the range error, −V for all others
    for state in range(n):
        opened[state] = -opened[state]
    opened[(where.constant if is_lasting else where.change) + anchor] += 1.0
    for row in range(n):
        x[row] += opened[row] * fault_m
        for other in range(n):
            P[row, other] += opened[row] * opened[other] * variance
    for one in range(FAULT_KINDS * count):
        column[one] = information[one, chosen]
    column[chosen] = 0.0
    for one in range(FAULT_KINDS * count):
        share = gain * column[one]
        evidence[one] -= share * evidence[chosen]
        for other in range(FAULT_KINDS * count):
            information[one, other] -= share * column[other]
        for state in range(n):
            V[one, state] += share * opened[state]
    evidence[chosen] = 0.0
    for one in range(FAULT_KINDS * count):
        information[one, chosen] = 0.0
        information[chosen, one] = 0.0
    for state in range(n):
        opened[state] = 0.0
    s.status[0]["faults_opened"] += 1
