"""Anchors of ``joint`` come and go: room is made among the states, and in all that is kept for each anchor."""

from skyless.compiled import borrowing_kernel
from skyless.positioning.joint_state import (
    DIM,
    NEVER,
    NOISE,
    NOISES,
    RANGE,
    REFUSED,
    REMEMBERED,
    SITE,
    SLOTS,
    WEIGHT,
    JointArrays,
    states,
    values,
)


@borrowing_kernel
def _insert(s: JointArrays, n: int, place: int) -> None:
    """Make room for a state at ``place``, zero and without variance."""
    x, P = s.x, s.P
    for row in range(n, place, -1):
        x[row] = x[row - 1]
        for column in range(n):
            P[row, column] = P[row - 1, column]
    x[place] = 0.0
    for column in range(n + 1):
        P[place, column] = 0.0
    for row in range(n + 1):
        for column in range(n, place, -1):
            P[row, column] = P[row, column - 1]
        P[row, place] = 0.0
    V = s.sensitivities
    for slot in range(s.counts[SLOTS]):
        for row in range(n, place, -1):
            V[row, slot] = V[row - 1, slot]
        V[place, slot] = 0.0


@borrowing_kernel
def _remove(s: JointArrays, n: int, place: int) -> None:
    """Take a state out; what stood behind it moves up, zeros follow."""
    x, P = s.x, s.P
    for row in range(place, n - 1):
        x[row] = x[row + 1]
        for column in range(n):
            P[row, column] = P[row + 1, column]
    x[n - 1] = 0.0
    for column in range(n):
        P[n - 1, column] = 0.0
    for row in range(n):
        for column in range(place, n - 1):
            P[row, column] = P[row, column + 1]
        P[row, n - 1] = 0.0
    V = s.sensitivities
    for slot in range(s.counts[SLOTS]):
        for row in range(place, n - 1):
            V[row, slot] = V[row + 1, slot]
        V[n - 1, slot] = 0.0


@borrowing_kernel
def has_room(s: JointArrays) -> bool:
    """Whether one more anchor fits."""
    return bool(s.counts[SLOTS] < s.slots.shape[0])


@borrowing_kernel
def add_slot(s: JointArrays, site: int) -> int:
    """Give an anchor a slot, the last one, with two states of zero; the caller has seen that there is room."""
    slot: int = s.counts[SLOTS]
    n, one_more = states(s), values(s)
    _insert(s, n, 2 * one_more)
    _insert(s, n + 1, one_more)
    s.counts[SLOTS] = slot + 1
    s.slot_of[site] = slot
    s.slots[slot, :] = 0
    s.slots[slot, SITE] = site
    s.slots[slot, NOISE] = -1
    for axis in range(3):
        s.anchors[slot, axis] = s.site_m[site, axis]
    s.anchors[slot, RANGE:] = 0.0
    s.anchors[slot, WEIGHT] = 1.0
    _clear_faults(s, slot)
    s.packets[slot, :, :] = NEVER
    s.relayed[slot, :] = NEVER
    s.relayed[:, slot] = NEVER
    return slot


@borrowing_kernel
def add_noise_state(s: JointArrays, slot: int) -> None:
    """Give an anchor a state for the noise of its TX stamps (there is room for one of each slot)."""
    _insert(s, states(s), states(s))
    s.slots[slot, NOISE] = s.counts[NOISES]
    s.counts[NOISES] += 1


@borrowing_kernel
def drop_slot(s: JointArrays, slot: int) -> None:
    """Forget an anchor and its states."""
    noise = s.slots[slot, NOISE]
    if noise >= 0:
        _remove(s, states(s), 2 * values(s) + noise)
        s.counts[NOISES] -= 1
    dim, n, half = int(s.settings[DIM]), states(s), values(s)
    _remove(s, n, half + dim + slot)
    _remove(s, n - 1, dim + slot)
    last = s.counts[SLOTS] - 1
    s.slot_of[s.slots[slot, SITE]] = -1
    for k in range(slot, last):
        _move_up(s, k)
        s.slot_of[s.slots[k, SITE]] = k
    for k in range(last):
        for column in range(slot, last):
            s.relayed[k, column] = s.relayed[k, column + 1]
        if s.slots[k, NOISE] > noise >= 0:
            s.slots[k, NOISE] -= 1
    _clear_faults(s, last)
    s.counts[SLOTS] = last


@borrowing_kernel
def _move_up(s: JointArrays, k: int) -> None:
    """Give a slot what the next one has, but for its states and its column of ``relayed``."""
    for column in range(s.slots.shape[1]):
        s.slots[k, column] = s.slots[k + 1, column]
    for column in range(s.anchors.shape[1]):
        s.anchors[k, column] = s.anchors[k + 1, column]
    for packet in range(REMEMBERED):
        for column in range(3):
            s.packets[k, packet, column] = s.packets[k + 1, packet, column]
    for column in range(s.relayed.shape[1]):
        s.relayed[k, column] = s.relayed[k + 1, column]
    for row in range(s.sensitivities.shape[0]):
        s.sensitivities[row, k] = s.sensitivities[row, k + 1]
    for row in range(REFUSED + 1):
        s.evidence[row, k] = s.evidence[row, k + 1]
    for row in range(s.shared.shape[0]):
        s.shared[row, k] = s.shared[row, k + 1]
    for column in range(s.shared.shape[1]):
        s.shared[k, column] = s.shared[k + 1, column]


@borrowing_kernel
def _clear_faults(s: JointArrays, slot: int) -> None:
    s.sensitivities[:, slot] = 0.0
    s.evidence[:, slot] = 0.0
    s.shared[:, slot] = 0.0
    s.shared[slot, :] = 0.0
