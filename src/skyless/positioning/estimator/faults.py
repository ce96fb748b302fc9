"""Faults that the state does not hold: what they do to it, what innovations say of them, and taking them into it.

Where all that the tag receives of anchor j is late by b metres, the estimate errs by V_j·b besides, and the
innovation of a measurement h holds s_j·b (Friedland 1969):

    s = [own reception of j] − h·V        V ← F·V  (time)        V ← V + K·s  (update)

With y = Σ s·ν/S and M = Σ s·sᵀ/S over the innovations ν of variance S, and σ_f²·I the faults' variance beforehand, all
anchors' faults are b̂ = (M + I/σ_f²)⁻¹·y with the covariance (M + I/σ_f²)⁻¹, and yᵀ·(M + I/σ_f²)⁻¹·y tests whether there
are any. A fault that is sure is taken into the anchor's constant range error, which gives the state that the filter
would have, had that error been open from the beginning.
"""

from typing import Final

import numpy as np

from skyless.compiled import step
from skyless.positioning.estimator.state import LASTING, EstimatorState, Matrix, layout, uncertain_states

RECENT_PACKETS: Final = 24.0
"""Number of packets of each anchor over which a fault counts as recent."""

OPENED_STD_M: Final = 1.0
"""Standard deviation of a fault that is taken into the state, before anything is known of it."""

SURE_CHI2: Final = 50.0
"""A test beyond this shows a lasting fault: χ² of eight degrees of freedom is larger with a probability of 4·10⁻⁸."""

EXPLAINED_CHI2: Final = 20.0
"""Largest part of the test that the faults of the right anchors may leave unexplained."""

RIVAL_CHI2: Final = 20.0
"""Least difference to what the faults of any other anchors explain."""

MOST_FAULTS: Final = 2
"""Largest number of anchors that are singled out."""


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
    """What an innovation says of the anchors' faults: y ← y + s·ν/S and M ← M + s·sᵀ/S."""
    evidence, information, fault_input, count = s.evidence, s.information, s.fault_input, len(s.anchors)
    for bank in range(2):
        begin = bank * count
        for one in range(count):
            weight = fault_input[begin + one] / innovation_variance
            evidence[bank, one] += weight * innovation
            for other in range(count):
                information[bank, one, other] += weight * fault_input[begin + other]


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


@step
def whiten(work: Matrix, count: int, vectors: int) -> None:
    """Make L⁻¹·r of the vectors r in the rows behind a symmetric matrix M = L·Lᵀ, in place, by Cholesky's method.

    So r·M⁻¹·q is the product of what becomes of r and of q. Rows of vectors go the way of rows of the matrix.
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
def lasting_chi2(s: EstimatorState, std_m: float) -> float:
    """The test of all lasting faults, of that standard deviation beforehand."""
    count, y, M = len(s.anchors), s.evidence[0], s.information[0]
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
def open_lasting_faults(s: EstimatorState, chi2: float) -> int:
    """Take lasting faults into the state where the test ``chi2`` of all of them is sure; how many anchors have one.

    They are the one or two anchors whose faults explain the test while no others do as well, or none.
    """
    count, dim = len(s.anchors), s.settings[0]["dim"]
    most_faults = min(MOST_FAULTS, count - dim - 2) if chi2 > SURE_CHI2 else 0
    opened = 0
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
        if opened == 0 and chi2 - most < EXPLAINED_CHI2 and most - rival > RIVAL_CHI2:
            _open_lasting_fault(s, first)
            if second != first:
                _open_lasting_fault(s, second)
            forget_recent_faults(s)
            opened = faults
    return opened


@step
def forget_recent_faults(s: EstimatorState) -> None:
    """Judge recent faults from here on."""
    V, evidence, information, count = s.V, s.evidence, s.information, len(s.anchors)
    for fault in range(count):
        evidence[1, fault] = 0.0
        for other in range(count):
            information[1, fault, other] = 0.0
        for state in range(V.shape[1]):
            V[count + fault, state] = 0.0


@step
def _open_lasting_fault(s: EstimatorState, anchor: int) -> None:
    """Take one anchor's fault into its constant range error; the other hypotheses are conditioned on it."""
    x, P, V, y, M = s.x, s.P, s.V, s.evidence[0], s.information[0]
    count, n = len(s.anchors), len(x)
    gain = 1.0 / (M[anchor, anchor] + 1.0 / OPENED_STD_M**2)
    fault_m = gain * y[anchor]
    opened = V[anchor]  # what it adds to each state: 1 − V for the range error, −V for all others
    for state in range(n):
        opened[state] = -opened[state]
    opened[layout(s.settings[0]["dim"], count).constant + anchor] += 1.0
    for row in range(n):
        x[row] += opened[row] * fault_m
        for column in range(n):
            P[row, column] += opened[row] * opened[column] * gain
    for other in range(count):
        if other != anchor:
            share = M[other, anchor] * gain
            y[other] -= share * y[anchor]
            for third in range(count):
                if third != anchor:
                    M[other, third] -= share * M[third, anchor]
            for state in range(n):
                V[other, state] += share * opened[state]
    y[anchor] = 0.0
    for other in range(count):
        M[anchor, other] = M[other, anchor] = 0.0
    for state in range(n):
        opened[state] = 0.0
    s.anchors[anchor]["has_fault"] = 1
    s.status[0]["range_errors"] = LASTING
    s.status[0]["faults_opened"] += 1
