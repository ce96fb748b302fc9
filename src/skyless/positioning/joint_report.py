"""What the arrays of a joint filter say: how sure it is, of which clocks, and whether it can be right at all."""

from typing import Final

from skyless.constants import TICK_S
from skyless.positioning.joint_state import (
    BASE,
    EPOCH,
    EXCLUDED,
    EXCLUSIONS,
    LATE_SHARE,
    REJECTED_IN_ROW,
    RELAYS_REFUSED,
    RELAYS_TAKEN,
    SITE,
    SLOTS,
    STALE_IN_ROW,
    WHOLE,
    JointArrays,
    Matrix,
    states,
    values,
)
from skyless.positioning.joint_time import move_base
from skyless.positioning.tracker import LOST_IN_ROW, LOST_SHARE, REJECTED_SHARE

DOUBTFUL_SHARE: Final = 0.12
"""Of messages beyond the gate; in the first second after a start."""

CONTRADICTIONS: Final = 4.0
"""Relayed receptions beyond the gate lately; fewer may be late ones."""


def covariance_of(s: JointArrays) -> Matrix:
    """Of all states in use, at the newest message."""
    s = JointArrays._make(array.copy() for array in s)
    move_base(s, int(s.counts[EPOCH]))
    n = states(s)
    return s.P[:n, :n]


def clock_of(s: JointArrays, dim: int, site: int) -> tuple[int, float, float] | None:
    """The tag's clock against that of an anchor in view: whole ticks, the rest in metres, rate in m/s."""
    slot = int(s.slot_of[site])
    if slot < 0:
        return None
    half, place = values(s), dim + slot
    tau_s = (int(s.counts[EPOCH]) - int(s.counts[BASE])) * TICK_S
    rate = float(s.x[half + place])
    return int(s.slots[slot, WHOLE]), float(s.x[place]) + tau_s * rate, rate


def places_excluded(s: JointArrays) -> list[int]:
    """Places in the table of the anchors that are heard but not used."""
    slots = s.slots[: s.counts[SLOTS]]
    places: list[int] = slots[slots[:, EXCLUDED] != 0, SITE].tolist()
    return places


def is_lost(s: JointArrays) -> bool:
    """Whether so many messages do not fit that the state must be wrong."""
    in_row = s.counts[REJECTED_IN_ROW] + s.counts[STALE_IN_ROW]
    late = min(s.statistics[LATE_SHARE], 0.45)
    return bool(s.statistics[REJECTED_SHARE] > LOST_SHARE or in_row * (1.0 - 2.0 * late) >= LOST_IN_ROW)


def is_contradicted(s: JointArrays) -> bool:
    """Whether most of what anchors heard of each other does not fit: a wrong place draws all clocks with it."""
    refused: float = s.recent.item(RELAYS_REFUSED)
    return refused > CONTRADICTIONS and refused > float(s.recent.item(RELAYS_TAKEN))


def relays_fit(s: JointArrays) -> bool:
    """Whether most of what anchors heard of each other fits, and that is more than a few receptions."""
    taken = s.recent.item(RELAYS_TAKEN)
    return bool(taken > max(CONTRADICTIONS, 4.0 * s.recent.item(RELAYS_REFUSED)))


def is_doubtful(s: JointArrays) -> bool:
    """Whether more messages do not fit than a sound start leaves."""
    return bool(s.statistics[REJECTED_SHARE] > DOUBTFUL_SHARE or s.counts[EXCLUSIONS] > 0)
