"""What the estimator's counters say of its state: whether a new start is needed, and what that has to expect."""

from typing import Final

from skyless.core.estimator.faults import whiten
from skyless.core.estimator.state import State, at
from skyless.core.native.arithmetic import square

_MOST_LATE: Final = 0.45
"""A larger share of late packets counts as this."""


def is_late_often(s: State) -> bool:
    """Whether single packets are late often."""
    return s.status.late_share > s.tuning.late_often_share


def rejects_most(s: State) -> bool:
    """Whether most measurements lie beyond the gate."""
    return s.status.rejected_share > s.tuning.lost_share


def is_lost(s: State) -> bool:
    """Whether more packets are rejected than a right state would reject."""
    in_row = s.status.rejected_in_row + s.status.stale_in_row
    late = min(s.status.late_share, _MOST_LATE)
    return rejects_most(s) or in_row * (1.0 - 2.0 * late) >= s.tuning.lost_in_row


def relays_contradict(s: State) -> bool:
    """Whether most of what anchors received of each other does not fit: a wrong position shifts all clocks."""
    status = s.status
    return status.relays_lately_rejected > max(s.tuning.max_relays_rejected, status.relays_lately_accepted)


def relays_fit(s: State) -> bool:
    """Whether most of what anchors received of each other fits, and that is more than a few receptions."""
    status = s.status
    return status.relays_lately_accepted > max(s.tuning.max_relays_rejected, 4.0 * status.relays_lately_rejected)


def has_phase(s: State, anchor: int) -> bool:
    """Whether phases of an anchor are in use: one has confirmed its ambiguity, and they are not refused."""
    own = s.anchors[anchor].own
    return own.is_known and own.refused_in_row < int(s.tuning.phases_in_row) - 1


def horizontal_variance_m2(s: State, ahead_s: float) -> float:
    """Sum of the variances of x and y ``ahead_s`` later, if nothing is received until then."""
    total = 2.0 * s.settings.qa * s.status.q_scale * ahead_s * ahead_s * ahead_s / 3.0
    for axis in range(2):
        speed = s.layout.velocity + axis
        total += s.P[at(axis, axis)] + ahead_s * (2.0 * s.P[at(axis, speed)] + ahead_s * s.P[at(speed, speed)])
    return total


def fits_settings(s: State) -> bool:
    """Whether the constants of the ranges are as small as the settings state, as far as they are known."""
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
