"""Faults that the state does not hold: what they do to it, what innovations show of them, and adding them to it.

Where all that the tag receives of anchor j is late by b metres, the estimate errs by V_j·b besides, and the
innovation of a measurement h holds s_j·b (Friedland 1969):

    s = [own reception of j] − h·V        V ← F·V  (time)        V ← V + K·s  (update)

With y = Σ s·ν/S and M = Σ s·sᵀ/S over the innovations ν of variance S, and σ_f²·I the faults' variance beforehand, all
anchors' faults are b̂ = (M + I/σ_f²)⁻¹·y with the covariance (M + I/σ_f²)⁻¹, and yᵀ·(M + I/σ_f²)⁻¹·y tests whether there
are any. A fault that is sure is added to the anchor's constant range error, which gives the state that the filter
would have, had that error been open from the beginning.
"""

from typing import Final

import numpy as np

from skyless.kernels.arrays import Matrix
from skyless.kernels.compiled import step
from skyless.positioning.estimator.kalman import reset_state
from skyless.positioning.estimator.state import (
    ALL_RANGE_ERRORS,
    CHANGING_RANGE_ERRORS,
    LASTING_STD_M,
    EstimatorState,
    layout,
    uncertain_states,
)

RECENT_PACKETS: Final = 16.0  # number of packets of each anchor over which a fault counts as recent
OPENED_STD_M: Final = 1.0  # standard deviation of a fault that is added to the state, before anything is known of it
# A test beyond this shows a lasting fault: χ² of eight degrees of freedom is larger with a probability of 4·10⁻⁸.
SURE_CHI2: Final = 50.0
EXPLAINED_CHI2: Final = 20.0  # largest part of the test that the faults of the right anchors may leave unexplained
RIVAL_FAULT_CHI2: Final = 20.0  # least difference to what the faults of any other anchors explain
MOST_FAULTS: Final = 2  # largest number of anchors that are selected
# Obstacles make packets late, not early; a fault that is early has to explain more by this.
EARLY_WEIGHT: Final = 0.8
JUMP_RISE: Final = 0.5  # by this part of its full size a jump raises the process noise of all range errors
# Factor on the process noise of a range error that has just jumped: it may still be changing.
FIRST_CHANGE_SCALE: Final = 25.0


@step
def compute_fault_input(s: EstimatorState, terms: int, own: int) -> None:
    """Compute s = [own reception] − h·V; ``own`` is the anchor that the tag has received, or −1."""
    V, fault_input, h, h_index = s.V, s.fault_input, s.h, s.h_index
    count = len(s.anchors)
    for fault in range(V.shape[0]):
        total = 0.0
        for term in range(terms):
            total -= h[term] * V[fault, h_index[term]]
        fault_input[fault] = total
    if own >= 0:
        fault_input[own] += 1.0
        fault_input[count + own] += 1.0


@step
def subtract_fault_input(s: EstimatorState, anchor: int) -> None:
    """Of an anchor with whose reception a difference begins: its faults count with the opposite sign."""
    s.fault_input[anchor] -= 1.0
    s.fault_input[len(s.anchors) + anchor] -= 1.0


@step
def gather_evidence(s: EstimatorState, innovation: float, innovation_variance: float) -> None:
    """What an innovation shows of the anchors' faults: y ← y + s·ν/S and M ← M + s·sᵀ/S."""
    evidence, information, fault_input, count = s.evidence, s.information, s.fault_input, len(s.anchors)
    for bank in range(2):
        begin = bank * count
        for one in range(count):
            weight = fault_input[begin + one] / innovation_variance
            evidence[bank, one] += weight * innovation
            for other in range(count):
                information[bank, one, other] += weight * fault_input[begin + other]
                if bank == 0:
                    information[2, one, other] += weight * fault_input[count + other]


@step
def fade_recent_faults(s: EstimatorState) -> None:
    """Forget a share of what recent faults have done, and of the evidence for them, once in a round of packets."""
    count, n = len(s.anchors), uncertain_states(s)
    if s.status[0]["packets"] % count == 0:
        kept = 1.0 - 1.0 / RECENT_PACKETS
        for fault in range(count, 2 * count):
            for state in range(n):
                s.V[fault, state] *= kept
        for one in range(count):
            s.evidence[1, one] *= kept
            for other in range(count):
                s.information[1, one, other] *= kept
                s.information[2, one, other] *= kept


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
def fault_chi2(s: EstimatorState, bank: int, std_m: float) -> float:
    """The test of all faults of a kind, of that standard deviation beforehand."""
    count, y, M = len(s.anchors), s.evidence[bank], s.information[bank]
    for one in range(count):
        for other in range(count):
            s.work[one, other] = M[one, other]
        s.work[one, one] += 1.0 / (std_m * std_m)
        s.work[count, one] = y[one]
    whiten(s.work, count, 1)
    total = 0.0
    for one in range(count):
        total += s.work[count, one] ** 2
    return total


@step
def explained_chi2(s: EstimatorState, one: int, other: int) -> float:
    """How much of the test of all lasting faults those of two anchors explain, or of one where both are the same."""
    y, M, weight = s.evidence[0], s.information[0], 1.0 / OPENED_STD_M**2
    a, b, both = M[one, one] + weight, M[other, other] + weight, M[one, other]
    if one == other:
        explained = y[one] * y[one] / a
    else:
        explained = (b * y[one] ** 2 - 2.0 * both * y[one] * y[other] + a * y[other] ** 2) / (a * b - both * both)
    return float(explained)


@step
def open_faults(s: EstimatorState, lasting_chi2: float, recent_chi2: float) -> None:
    """Add faults to the state where a test of all of a kind is sure.

    After a start that was contradicted, none are selected: any number of anchors may be late then, and those that
    explain the test are now and then the wrong ones.
    """
    selects_faults = s.status[0]["fault_std_m"] <= LASTING_STD_M
    if selects_faults and recent_chi2 > SURE_CHI2 and _largest(s, 1) >= _largest(s, 0):
        _open_recent_faults(s)
    elif selects_faults and lasting_chi2 > SURE_CHI2:
        _open_lasting_faults(s, lasting_chi2)


@step
def _largest(s: EstimatorState, bank: int) -> float:
    """How much the fault of a single anchor explains at most."""
    most = 0.0
    for anchor in range(len(s.anchors)):
        most = max(most, _explained_alone(s, bank, anchor))
    return most


@step
def _explained_alone(s: EstimatorState, bank: int, anchor: int) -> float:
    """How much the fault of an anchor explains; that it is early is less likely, and counts less."""
    y, M = s.evidence[bank, anchor], s.information[bank, anchor, anchor]
    return float((1.0 if y > 0.0 else EARLY_WEIGHT) * y * y / (M + 1.0 / OPENED_STD_M**2))


@step
def _open_recent_faults(s: EstimatorState) -> None:
    """Open the range errors of the anchors whose recent faults explain the innovations about as well as any other's.

    A single one opens by itself; where it is open which of several it is, the position uses none of them,
    as long as enough anchors are left.
    """
    count, spare = len(s.anchors), len(s.anchors) - s.settings[0]["dim"] - 1
    for anchor in range(count):
        spare -= 1 if s.anchors[anchor]["is_obstructed"] else 0
        s.ph[anchor] = _explained_alone(s, 1, anchor)
    limit = _largest(s, 1) - RIVAL_FAULT_CHI2
    first = 0
    while spare > 0 and first >= 0:
        first = -1
        for anchor in range(count):
            if s.ph[anchor] > limit and (first < 0 or s.ph[anchor] > s.ph[first]):
                first = anchor
        if first >= 0:
            s.ph[first] = 0.0
            spare -= 1
            _open_fault(s, 1, first)
            begin_obstruction(s, first)


@step
def begin_obstruction(s: EstimatorState, anchor: int) -> None:
    """Note that an anchor's range error has jumped; it may still be changing."""
    a, status = s.anchors[anchor], s.status[0]
    a["outliers_in_row"] = 0
    a["is_obstructed"] = 1
    a["change_mean"], a["change_scale"] = 0.0, FIRST_CHANGE_SCALE
    status["obstruction"] = min(status["obstruction"] + JUMP_RISE, 2.0)


@step
def _open_lasting_faults(s: EstimatorState, chi2: float) -> None:
    """Add the lasting faults of one or two anchors to the state, where no others explain the test as well."""
    count, dim = len(s.anchors), s.settings[0]["dim"]
    most_faults, opened = min(MOST_FAULTS, count - dim - 2), False
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
        if not opened and chi2 - most < EXPLAINED_CHI2 and most - rival > RIVAL_FAULT_CHI2:
            opened = True
            for one in range(faults):
                anchor = second if one else first
                _open_fault(s, 0, anchor)
                s.anchors[anchor]["has_fault"] = 1


@step
def end_lasting_fault(s: EstimatorState, anchor: int) -> None:
    """End a fault: an anchor's packets have been late since it joined, and are not any more."""
    settings = s.settings[0]
    _open_fault(s, 0, anchor)
    reset_state(s, layout(settings["dim"], len(s.anchors)).constant + anchor, settings["range_std_m"] ** 2)
    s.status[0]["obstruction"] = min(s.status[0]["obstruction"] + JUMP_RISE, 2.0)


@step
def _open_fault(s: EstimatorState, bank: int, anchor: int) -> None:
    """Add a fault to its anchor's range error; all other hypotheses are conditioned on it (Schur's complement)."""
    status = s.status[0]
    status["range_errors"] = max(status["range_errors"], ALL_RANGE_ERRORS if bank == 0 else CHANGING_RANGE_ERRORS)
    x, P, V, evidence, information, column = s.x, s.P, s.V, s.evidence, s.information, s.fault_input
    count, n = len(s.anchors), uncertain_states(s)
    where, chosen = layout(s.settings[0]["dim"], count), bank * count + anchor
    gain = 1.0 / (information[bank, anchor, anchor] + 1.0 / OPENED_STD_M**2)
    fault_m = gain * evidence[bank, anchor]
    variance = gain if bank == 0 else gain + fault_m * fault_m
    opened = V[chosen]  # what it adds to each state: 1 − V for the range error, −V for all others
    for state in range(n):
        opened[state] = -opened[state]
    opened[(where.constant if bank == 0 else where.change) + anchor] += 1.0
    for row in range(n):
        x[row] += opened[row] * fault_m
        for other in range(n):
            P[row, other] += opened[row] * opened[other] * variance
    for other in range(count):
        lasting, recent = (anchor, other) if bank == 0 else (other, anchor)
        column[bank * count + other] = information[bank, other, anchor]
        column[count - bank * count + other] = information[2, lasting, recent]
    column[chosen] = 0.0
    for one in range(2 * count):
        if one == chosen:
            continue
        share = gain * column[one]
        kind = one // count
        evidence[kind, one - kind * count] -= share * evidence[bank, anchor]
        for other in range(count):
            information[kind, one - kind * count, other] -= share * column[kind * count + other]
            if kind == 0:
                information[2, one, other] -= share * column[count + other]
        for state in range(n):
            V[one, state] += share * opened[state]
    evidence[bank, anchor] = 0.0
    for other in range(count):
        lasting, recent = (anchor, other) if bank == 0 else (other, anchor)
        information[bank, anchor, other] = information[bank, other, anchor] = information[2, lasting, recent] = 0.0
    for state in range(n):
        opened[state] = 0.0
    s.status[0]["faults_opened"] += 1
