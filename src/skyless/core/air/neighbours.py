"""What is kept of each anchor that is received, or that others relay: one table with a row for each."""

from typing import Annotated, Final

from skyless.core.native.records import MAX_NEIGHBOURS, Array, Integers, Record, Ticks, record
from skyless.core.ticks import NEVER, NOISE_TICKS, TICK_MASK, from_seconds, may_elapse, nearest

RELAYED_TICKS: Final = from_seconds(2.0)
"""A reception by an anchor in use, or by one that is confirmed itself, confirms its sender for this time."""


@record
class StatedPlace(Record):
    """Where an anchor says that it is, as frames carry it."""

    position_mm: Annotated[Integers, 3]
    std_mm: int
    floor: int
    zone: int


@record
class Neighbour(Record):
    """One anchor."""

    anchor: int
    """Its identifier."""
    changed_ticks: Ticks
    """The receiver's reading when anything was last learnt of it."""
    # Its stamps
    frames: int
    """Whose stamps have fitted since its counter began: 0, 1, or 2 for more."""
    sequence: int
    """Of the newest one."""
    rx_ticks: Ticks
    """The receiver's own stamp of it."""
    tx_ticks: Ticks
    """The anchor's, unwrapped."""
    impossible: int
    """Stamps in a row that do not fit."""
    has_rival: bool
    """Whether one of those may be right, as only one frame stands against it."""
    rival_rx_ticks: Ticks
    rival_tx_ticks: Ticks
    # What it states of itself
    almanac_issue: int
    period_code: int
    has_place: bool
    place: StatedPlace
    """The one that is used."""
    has_other: bool
    other: StatedPlace
    """Another one, stated once; used when it is stated twice in a row."""
    has_moved: bool
    """Whether it has stated another position than before, until all anchors are used together again."""
    # What others state of it
    was_relayed: bool
    """Whether others had received it at its newest frame."""
    relayed_ticks: Ticks
    """The receiver's reading when another anchor last relayed that it had received this one."""
    own_relays_ticks: Ticks
    """The receiver's reading when the anchor's own relays last fitted, where no other has relayed it since."""
    used_ticks: Ticks
    """The receiver's reading when the filter, where it has the anchor, last got a packet of it."""
    has_power: bool
    power_dbm: float
    """Running mean of the received power."""
    is_misfit: bool
    """Whether it contradicted the others at the start."""


@record
class Neighbours(Record):
    """All of them."""

    count: int
    row: int
    """Of the anchor whose frame is processed, which is not forgotten meanwhile; −1 while that is not known."""
    has_newest: bool
    newest_rx_ticks: Ticks
    """RX stamp of the newest accepted frame: one impossible stamp must not make others late."""
    rows: Annotated[Array[Neighbour], MAX_NEIGHBOURS]


def find_neighbour(t: Neighbours, anchor: int) -> int:
    """The row of an anchor, −1 where there is none."""
    for row in range(t.count):
        if t.rows[row].anchor == anchor:
            return row
    return -1


def neighbour_of(t: Neighbours, anchor: int, rx_ticks: Ticks) -> int:
    """The row of an anchor of which something is learnt; a new one may take that of the least important."""
    row = find_neighbour(t, anchor)
    if row < 0:
        row = t.count if t.count < MAX_NEIGHBOURS else _least_important(t, rx_ticks)
        t.count = max(t.count, row + 1)
        fresh = Neighbour()
        t.rows[row] = fresh
        t.rows[row].anchor = anchor
        t.rows[row].relayed_ticks = t.rows[row].own_relays_ticks = t.rows[row].used_ticks = NEVER
    t.rows[row].changed_ticks = rx_ticks
    return row


def _least_important(t: Neighbours, rx_ticks: Ticks) -> int:
    """The row to be forgotten: that of the lowest rank, and of several the longest silent.

    Anchors in use rank highest, then those that others confirm, then strangers of several frames.
    """
    least = -1
    least_rank = 0
    for row in range(t.count):
        n = t.rows[row]
        rank = 0
        if n.frames > 0:
            is_used = rx_ticks - n.used_ticks < RELAYED_TICKS
            rank = 3 if is_used else 2 if is_confirmed(n, rx_ticks) else 1 if n.frames > 1 else 0
        is_less = least < 0 or rank < least_rank
        if not is_less and rank == least_rank:
            is_less = n.changed_ticks < t.rows[least].changed_ticks
        if row != t.row and is_less:
            least, least_rank = row, rank
    return least


def is_confirmed(n: Neighbour, rx_ticks: Ticks) -> bool:
    """Whether another anchor has recently received this one, or its own relays have fitted."""
    return rx_ticks - max(n.relayed_ticks, n.own_relays_ticks) < RELAYED_TICKS


def is_relayed(n: Neighbour, rx_ticks: Ticks) -> bool:
    """Whether another anchor has recently received this one."""
    return rx_ticks - n.relayed_ticks < RELAYED_TICKS


def forget_times(t: Neighbours) -> None:
    """The receiver's counter has restarted: who was received when is not known any more."""
    t.has_newest = False
    for row in range(t.count):
        _forget_row(t.rows[row])


def wake_times(t: Neighbours, rx_ticks: Ticks, rx_counter: Ticks) -> None:
    """The same after a sleep from ``rx_ticks`` on: who was confirmed then counts as confirmed at ``rx_counter``."""
    t.has_newest = False
    for row in range(t.count):
        was_confirmed = is_confirmed(t.rows[row], rx_ticks)
        _forget_row(t.rows[row])
        if was_confirmed:
            t.rows[row].relayed_ticks = rx_counter


def _forget_row(n: Neighbour) -> None:
    n.frames, n.impossible, n.has_rival, n.was_relayed = 0, 0, False, False
    n.relayed_ticks = n.own_relays_ticks = n.used_ticks = n.changed_ticks = NEVER


# Every anchor's counter, unwrapped along the receiver's own.

# A counter has restarted once this number of stamps in a row were impossible and none has fitted for both of these
# times: forged frames in between do not replace an anchor that still sends.
STAMPS_BEFORE_RESTART: Final = 3
RESTART_SILENCE_TICKS: Final = from_seconds(0.2)
RESTART_SILENCE_PERIODS: Final = 4

STAMP_FITS, DUPLICATE, OUT_OF_ORDER, IMPOSSIBLE_STAMP, ANCHOR_RESTART = range(5)
"""What a stamp is. After the last, which is impossible as well, the anchor's next one is a beginning."""
STAMP_COUNTERS: Final = (
    (),
    ("duplicate",),
    ("out-of-order",),
    ("impossible-stamp",),
    ("impossible-stamp", "anchor-restart"),
)
"""By what each is counted."""


def unwrap_stamp(
    t: Neighbours, anchor: int, sequence: int, tx_counter: Ticks, rx_ticks: Ticks, period_ticks: Ticks
) -> int:
    """Unwrap the TX stamp of a frame along the anchor's own counter; what the stamp is.

    ``rx_ticks`` is the receiver's own reading, unwrapped; ``period_ticks`` the time between two frames of an anchor,
    as far as it is known. Where the stamp fits, ``row`` is the anchor's, and holds it; a first one keeps its own value.
    """
    t.row = -1
    known = find_neighbour(t, anchor)
    is_repeated = known >= 0 and _is_newest(t.rows[known], sequence, tx_counter)
    if t.has_newest and rx_ticks <= t.newest_rx_ticks:
        return DUPLICATE if is_repeated else OUT_OF_ORDER
    t.row = neighbour_of(t, anchor, rx_ticks)
    n = t.rows[t.row]
    if n.frames > 0:
        elapsed = rx_ticks - n.rx_ticks
        tx_ticks = nearest(tx_counter, n.tx_ticks + elapsed)
        if not may_elapse(tx_ticks - n.tx_ticks, elapsed, NOISE_TICKS):
            silence_ticks = max(RESTART_SILENCE_TICKS, RESTART_SILENCE_PERIODS * period_ticks)
            return DUPLICATE if is_repeated else _reject(n, sequence, tx_counter, rx_ticks, elapsed > silence_ticks)
        _keep(n, sequence, tx_ticks, rx_ticks, 2)
    else:
        _keep(n, sequence, tx_counter, rx_ticks, 1)
    t.has_newest, t.newest_rx_ticks = True, rx_ticks
    return STAMP_FITS


def _is_newest(n: Neighbour, sequence: int, tx_counter: Ticks) -> bool:
    return n.frames > 0 and n.tx_ticks & TICK_MASK == tx_counter and n.sequence == sequence


def _keep(n: Neighbour, sequence: int, tx_ticks: Ticks, rx_ticks: Ticks, frames: int) -> None:
    n.frames, n.impossible, n.has_rival = frames, 0, False
    n.sequence, n.tx_ticks, n.rx_ticks = sequence, tx_ticks, rx_ticks


def _reject(n: Neighbour, sequence: int, tx_counter: Ticks, rx_ticks: Ticks, is_silent: bool) -> int:
    """After a few stamps that are impossible the next one of a silent anchor is a beginning.

    Where only the first stamp stands against it, which may have been a false one, two that fit each other are.
    """
    n.impossible += 1
    if n.frames == 1 and n.has_rival:
        elapsed = rx_ticks - n.rival_rx_ticks
        tx_ticks = nearest(tx_counter, n.rival_tx_ticks + elapsed)
        if may_elapse(tx_ticks - n.rival_tx_ticks, elapsed, NOISE_TICKS):
            _keep(n, sequence, tx_counter, rx_ticks, 2)
            return IMPOSSIBLE_STAMP
    n.has_rival, n.rival_rx_ticks, n.rival_tx_ticks = True, rx_ticks, tx_counter
    if n.impossible >= STAMPS_BEFORE_RESTART and is_silent:
        n.frames = 0
        return ANCHOR_RESTART
    return IMPOSSIBLE_STAMP
