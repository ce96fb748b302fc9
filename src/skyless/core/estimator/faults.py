"""Faults of anchors: their effect on the state, the evidence for them in innovations, and the tests.

If all that the tag receives of anchor j is late by b metres, the estimate errs by V_j·b, and the innovation of a
measurement h contains s_j·b (Friedland 1969):

    s = [own reception of j] − h·V        V ← F·V  (time)        V ← V + K·s  (update)

With y = Σ s·ν/S and M = Σ s·sᵀ/S over the innovations ν of variance S, and the prior variances σ_f²·I of the faults,
the estimate of all anchors' faults is b̂ = (M + I/σ_f²)⁻¹·y with the covariance (M + I/σ_f²)⁻¹, and
yᵀ·(M + I/σ_f²)⁻¹·y tests whether there are any. Where V, y and M are faded, b is the present size of a fault that
has grown as fast as they fade: within packets (recent) or seconds (creeping). A detected fault is added to the
anchor's range error, which gives the state that the filter would have if that error had been open from the beginning.
"""

from typing import Final

from skyless.core.estimator.kalman import motion_noise, open_direction, reset_state
from skyless.core.estimator.state import (
    ALL_RANGE_ERRORS,
    AXES,
    CHANGING_RANGE_ERRORS,
    CREEPING,
    FAULT_KINDS,
    LASTING,
    RECENT,
    State,
    at,
    forget_lasting,
    learn_lasting,
    make_uncertain,
    remove_anchor,
)
from skyless.core.native.arithmetic import exp, sqrt, square
from skyless.core.ticks import TICK_S

MAX_FAULTS: Final = 2  # largest number of anchors that are selected


# What innovations show (gathered by ``kalman.update_later``)


def subtract_fault_input(s: State, anchor: int) -> None:
    """Subtract the input of the first anchor of a difference, whose faults have the opposite sign."""
    for kind in range(FAULT_KINDS):
        s.G[s.waiting][kind * s.count + anchor] -= 1.0


def fade_faults(s: State) -> None:
    """Fade the effect of, and the evidence for, recent and creeping faults; once a round of packets."""
    status, tuning, count = s.status, s.tuning, s.count
    if status.packets % count != 0:
        return
    elapsed_s = (status.epoch_ticks - status.faded_ticks) * TICK_S
    status.faded_ticks = status.epoch_ticks
    for kind in range(RECENT, FAULT_KINDS):
        begin, end = kind * count, (kind + 1) * count
        kept = 1.0 - 1.0 / tuning.recent_packets if kind == RECENT else exp(-elapsed_s / tuning.creeping_s)
        for state in range(s.used):
            for fault in range(begin, end):
                s.V[state][fault] *= kept
        for fault in range(begin, end):
            s.evidence[fault] *= kept
            for other in range(fault + 1):
                s.information[fault][other] *= kept
            for other in range(end, FAULT_KINDS * count):
                s.information[other][fault] *= kept


# The test of all faults of a kind


def whiten(s: State, count: int, vectors: int) -> None:
    """Compute L⁻¹·r of the vectors r in the rows behind a symmetric matrix M = L·Lᵀ in ``work``, by Cholesky's method.

    The scalar product of two results is r·M⁻¹·q. Rows of vectors are treated like rows of the matrix.
    """
    for column in range(count):
        pivot, total = s.work[column], s.work[column][column]
        for k in range(column):
            total -= pivot[k] * pivot[k]
        inverse = 1.0 / sqrt(max(total, 1e-30))
        for place in range(column + 1, count + vectors):
            row = s.work[place]
            total = row[column]
            for k in range(column):
                total -= row[k] * pivot[k]
            row[column] = total * inverse


def fault_chi2(s: State, kind: int, axes: int) -> float:
    """Test all faults of a kind. Leaves their effect on the first ``axes`` states, as factors, in rows of ``work``.

    Row ``count`` is f, those behind it are A: the estimated faults move a position by A·f. With L·Lᵀ = M + I/σ_f² these
    are L⁻¹·y and L⁻¹·V, and A·Aᵀ is the covariance of that shift; for lasting faults it is A·Bᵀ, with B behind A.
    """
    count, begin, first, total = s.count, kind * s.count, s.count + 1, 0.0
    if kind == LASTING:  # whose covariance is kept explicitly
        for axis in range(axes):
            a, b = s.work[first + axis], s.work[first + AXES + axis]
            for one in range(count):
                total, row = 0.0, s.lasting_covariance[one]
                for other in range(count):
                    total += row[other] * s.V[axis][other]
                a[one] = s.V[axis][one]
                b[one] = total
        total = 0.0
        for one in range(count):
            s.work[count][one] = s.lasting_m[one]
            total += s.lasting_m[one] * s.evidence[one]
        return total
    for one in range(count):
        for other in range(one + 1):
            s.work[one][other] = s.information[begin + one][begin + other]
        s.work[one][one] += 1.0 / square(s.status.fault_std_m[kind])
        s.work[count][one] = s.evidence[begin + one]
        for axis in range(axes):
            s.work[first + axis][one] = s.V[axis][begin + one]
    whiten(s, count, 1 + axes)
    for one in range(count):
        total += square(s.work[count][one])
    return total


def explained_chi2(s: State, one: int, other: int) -> float:
    """How much of the test of all lasting faults one anchor or two explain.

    ``other`` is not above ``one``; equal for one anchor.
    """
    weight, y_one, y_other = 1.0 / square(s.tuning.late_std_m), s.evidence[one], s.evidence[other]
    a, b, both = s.information[one][one] + weight, s.information[other][other] + weight, s.information[one][other]
    if one == other:
        return y_one * y_one / a
    return (b * square(y_one) - 2.0 * both * y_one * y_other + a * square(y_other)) / (a * b - both * both)


def _explained_alone(s: State, kind: int, anchor: int) -> float:
    """How much an anchor's fault explains. An early one is less likely, and weighted less."""
    fault = kind * s.count + anchor
    y, information = s.evidence[fault], s.information[fault][fault]
    return (1.0 if y > 0.0 else s.tuning.early_weight) * y * y / (information + 1.0 / square(s.tuning.late_std_m))


def _largest(s: State, kind: int) -> float:
    """The most that the fault of a single anchor explains."""
    most = 0.0
    for anchor in range(s.count):
        most = max(most, _explained_alone(s, kind, anchor))
    return most


# Adding faults to the state


def open_faults(s: State) -> None:
    """If the test of all faults of a kind exceeds its limit, add faults of the kind that explains most to the state.

    None are selected after a start that was contradicted: any number of anchors may be late then, and those that
    explain the test best are sometimes the wrong ones.
    """
    sure_chi2 = s.tuning.sure_chi2
    if s.status.fault_std_m[LASTING] > s.tuning.lasting_std_m:
        return
    lasting_chi2, creeping_chi2 = fault_chi2(s, LASTING, 0), fault_chi2(s, CREEPING, 0)
    lasting, recent, creeping = _largest(s, LASTING), _largest(s, RECENT), _largest(s, CREEPING)
    if creeping_chi2 > max(sure_chi2, lasting_chi2) and creeping > recent and creeping >= lasting:
        _open_new_faults(s, CREEPING)
    elif fault_chi2(s, RECENT, 0) > sure_chi2 and recent >= lasting:
        _open_new_faults(s, RECENT)
    elif lasting_chi2 > sure_chi2:
        _open_lasting_faults(s, lasting_chi2)


def _open_new_faults(s: State, kind: int) -> None:
    """Open the range errors of the anchors whose faults explain the innovations about as well as the best one.

    If several explain them, all of these are opened, as long as enough anchors are left; none if too few anchors remain
    to contradict the choice later.
    """
    spare, explained = s.count - s.dim - 1, s.work[0]
    for anchor in range(s.count):
        spare -= int(s.anchors[anchor].is_obstructed)
        explained[anchor] = _explained_alone(s, kind, anchor)
    if s.count < s.dim + 3:
        return
    limit, first = _largest(s, kind) - s.tuning.apart_chi2, 0
    while spare > 0 and first >= 0:
        first = -1
        for anchor in range(s.count):
            if explained[anchor] > limit and (first < 0 or explained[anchor] > explained[first]):
                first = anchor
        if first >= 0:
            explained[first] = 0.0
            spare -= 1
            _open_fault(s, kind, first)
            begin_obstruction(s, first)


def begin_obstruction(s: State, anchor: int) -> None:
    """Mark that an anchor's range error has jumped and may still be changing."""
    a = s.anchors[anchor]
    a.outliers_in_row = 0
    a.is_obstructed = True
    a.change_mean = a.ended_log_odds = 0.0
    a.change_scale = s.tuning.first_change_scale
    _note_jump(s)


def _note_jump(s: State) -> None:
    """Raise the estimated rate of jumps of range errors."""
    s.status.obstruction = min(s.status.obstruction + s.tuning.jump_rise, 2.0)


def _open_lasting_faults(s: State, chi2: float) -> None:
    """Add the lasting faults of one or two anchors to the state, if no others explain the test as well."""
    apart_chi2 = s.tuning.apart_chi2
    for faults in range(1, min(MAX_FAULTS, s.count - s.dim - 2) + 1):
        first, second, most, rival = -1, -1, 0.0, 0.0
        for one in range(s.count):
            for other in range(one + 1):
                if (one == other) == (faults == 1):
                    explained = explained_chi2(s, one, other)
                    if explained > most:
                        first, second, most, rival = one, other, explained, most
                    elif explained > rival:
                        rival = explained
        if chi2 - most < apart_chi2 and most - rival > apart_chi2:
            _open_lasting_fault(s, first)
            if faults == 2:
                _open_lasting_fault(s, second)
            return


def _open_lasting_fault(s: State, anchor: int) -> None:
    """Add a lasting fault to the state and to the anchor's record.

    Nothing makes ranges much shorter. If single packets are often late, the first packet was, which initialised the
    anchor's clock: the anchor leaves the state instead, and joins again with its next packet.
    """
    if s.status.late_share > s.tuning.late_often_share and s.lasting_m[anchor] < -s.tuning.lasting_std_m:
        remove_anchor(s, anchor)
        return
    _open_fault(s, LASTING, anchor)
    s.anchors[anchor].has_fault = True


def end_lasting_fault(s: State, anchor: int) -> None:
    """End a fault: the anchor's packets had been late since it joined, and no longer are."""
    _open_fault(s, LASTING, anchor)
    reset_state(s, s.layout.constant + anchor, square(s.settings.range_std_m))
    _note_jump(s)


def _open_fault(s: State, kind: int, anchor: int) -> None:
    """Add a fault to its anchor's range error, and condition all other hypotheses on it (Schur's complement)."""
    is_lasting, chosen, faults = kind == LASTING, kind * s.count + anchor, FAULT_KINDS * s.count
    make_uncertain(s, ALL_RANGE_ERRORS if is_lasting else CHANGING_RANGE_ERRORS)
    gain = 1.0 / (s.information[chosen][chosen] + 1.0 / square(s.tuning.late_std_m))
    fault_m = gain * s.evidence[chosen]
    variance = gain if is_lasting else gain + fault_m * fault_m
    opened, shared = s.U[0], s.G[0]  # change of each state per metre: 1 − V for the range error, −V for the others
    for state in range(s.n):
        opened[state] = -s.V[state][chosen]
    opened[(s.layout.constant if is_lasting else s.layout.change) + anchor] += 1.0
    for one in range(faults):
        shared[one] = gain * s.information[max(one, chosen)][min(one, chosen)]
    shared[chosen] = 0.0
    if is_lasting:
        forget_lasting(s, anchor)
    else:
        learn_lasting(s, shared, -1.0 / gain, fault_m)
    open_direction(s, variance, faults)
    for state in range(s.used):
        s.x[state] += opened[state] * fault_m
        s.V[state][chosen] = 0.0
    for one in range(faults):
        s.evidence[one] -= shared[one] * s.evidence[chosen]
        for other in range(one + 1):
            s.information[one][other] -= shared[one] * shared[other] / gain
    s.evidence[chosen] = 0.0
    for one in range(faults):
        s.information[max(one, chosen)][min(one, chosen)] = 0.0
    s.status.faults_opened += 1


# Verdicts on the state: whether a new start is needed, and what it has to expect

_MOST_LATE: Final = 0.45
"""Upper limit of the share of late packets in ``is_lost``."""


def is_late_often(s: State) -> bool:
    """Whether single packets are often late."""
    return s.status.late_share > s.tuning.late_often_share


def rejects_most(s: State) -> bool:
    """Whether most measurements are beyond the gate."""
    return s.status.rejected_share > s.tuning.lost_share


def is_lost(s: State) -> bool:
    """Whether more packets are rejected than a correct state would reject."""
    in_row = s.status.rejected_in_row + s.status.stale_in_row
    late = min(s.status.late_share, _MOST_LATE)
    return rejects_most(s) or in_row * (1.0 - 2.0 * late) >= s.tuning.lost_in_row


def relays_contradict(s: State) -> bool:
    """Whether most relays do not fit: a wrong position shifts all clocks."""
    status = s.status
    return status.relays_lately_rejected > max(s.tuning.max_relays_rejected, status.relays_lately_accepted)


def relays_fit(s: State) -> bool:
    """Whether most relays fit, and enough of them for a judgement."""
    status = s.status
    return status.relays_lately_accepted > max(s.tuning.max_relays_rejected, 4.0 * status.relays_lately_rejected)


def horizontal_variance_m2(s: State, ahead_s: float) -> float:
    """Sum of the variances of x and y after ``ahead_s`` without receptions."""
    total = 2.0 * motion_noise(s) * ahead_s * ahead_s * ahead_s / 3.0
    for axis in range(2):
        speed = s.layout.velocity + axis
        total += s.P[at(axis, axis)] + ahead_s * (2.0 * s.P[at(axis, speed)] + ahead_s * s.P[at(speed, speed)])
    return total


def fits_settings(s: State) -> bool:
    """Whether the range constants are as small as the settings state, as far as they are known."""
    first, count = s.layout.constant, s.count
    for one in range(count):
        for other in range(one + 1):
            s.work[one][other] = s.P[at(first + one, first + other)]
        s.work[one][one] += square(s.settings.range_std_m)
        s.work[count][one] = s.x[first + one]
    whiten(s, count, 1)
    chi2 = 0.0
    for one in range(count):
        chi2 += square(s.work[count][one])
    return chi2 < s.tuning.fitting_chi2 * count
