"""Table of the anchors that are received, or that others relay: one row each."""

from typing import Annotated, Final

from skyless.core.air.almanac import period_ticks
from skyless.core.native.records import MAX_NEIGHBOURS, Array, Integers, Record, Ticks, record
from skyless.core.ticks import NEVER, NOISE_TICKS, TICK_MASK, from_seconds, may_elapse, nearest

RELAYED_TICKS: Final = from_seconds(2.0)
"""How long a reception confirms its sender, if received by an anchor in use or by one that is confirmed itself."""
PRESENT_TICKS: Final = from_seconds(1.0)
"""Anchors received within this time are present."""
LASTING_PERIODS: Final = 3
"""Both last for at least this number of the anchor's mean times between beacons."""


@record
class StatedPlace(Record):
    """Position that an anchor states, as frames carry it."""

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
    """Receiver's reading when anything was last learnt about it."""
    frames: int
    """Frames whose stamps have fitted since its counter began: 0, 1, or 2 for more."""
    sequence: int
    """Sequence number of the newest frame."""
    rx_ticks: Ticks
    """Receiver's stamp of the newest frame."""
    tx_ticks: Ticks
    """Anchor's stamp of the newest frame, unwrapped."""
    impossible: int
    """Number of impossible stamps in a row."""
    has_rival: bool
    """Whether an impossible stamp may be the right one, as only one frame stands against it."""
    rival_rx_ticks: Ticks
    rival_tx_ticks: Ticks
    # What it states of itself
    almanac_issue: int
    period_code: int
    has_place: bool
    place: StatedPlace
    """Position in use."""
    has_other: bool
    other: StatedPlace
    """Another position, stated once; used when it is stated twice in a row."""
    has_moved: bool
    """Whether it has stated a different position, until all anchors are used together again."""
    # What others state of it
    was_relayed: bool
    """Whether others had received it by its newest frame."""
    relayed_ticks: Ticks
    """Receiver's reading when another anchor last relayed a reception of this one."""
    own_relays_ticks: Ticks
    """Receiver's reading when the anchor's own relays last fitted, if no other has relayed it since."""
    used_ticks: Ticks
    """Receiver's reading when the filter last got a packet of this anchor, if it has the anchor."""
    has_power: bool
    power_dbm: float
    """Running mean of the received power."""
    is_misfit: bool
    """Whether it contradicted the others at the start."""


@record
class Neighbours(Record):
    """All rows of the table."""

    count: int
    row: int
    """Row of the anchor whose frame is being processed, which is then not forgotten; −1 if not known yet."""
    has_newest: bool
    newest_rx_ticks: Ticks
    """RX stamp of the newest accepted frame, so that one impossible stamp does not make others late."""
    rows: Annotated[Array[Neighbour], MAX_NEIGHBOURS]


def find_neighbour(t: Neighbours, anchor: int) -> int:
    """Return the row of an anchor, −1 if there is none."""
    for row in range(t.count):
        if t.rows[row].anchor == anchor:
            return row
    return -1


def neighbour_of(t: Neighbours, anchor: int, rx_ticks: Ticks) -> int:
    """Return the row of an anchor about which something is learnt; a new one may replace the least important."""
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
    """Return the row to forget: the one of lowest rank and, among equals, the longest silent.

    Anchors in use rank highest, then confirmed ones, then strangers with several frames.
    """
    least = -1
    least_rank = 0
    for row in range(t.count):
        n = t.rows[row]
        rank = 0
        if n.frames > 0:
            is_used = rx_ticks - n.used_ticks < _lasting_ticks(n, RELAYED_TICKS)
            rank = 3 if is_used else 2 if is_confirmed(n, rx_ticks) else 1 if n.frames > 1 else 0
        is_less = least < 0 or rank < least_rank
        if not is_less and rank == least_rank:
            is_less = n.changed_ticks < t.rows[least].changed_ticks
        if row != t.row and is_less:
            least, least_rank = row, rank
    return least


def is_confirmed(n: Neighbour, rx_ticks: Ticks) -> bool:
    """Whether another anchor has recently received this one, or its own relays have fitted."""
    return rx_ticks - max(n.relayed_ticks, n.own_relays_ticks) < _lasting_ticks(n, RELAYED_TICKS)


def is_relayed(n: Neighbour, rx_ticks: Ticks) -> bool:
    """Whether another anchor has recently received this one."""
    return rx_ticks - n.relayed_ticks < _lasting_ticks(n, RELAYED_TICKS)


def is_present(n: Neighbour, rx_ticks: Ticks) -> bool:
    """Whether the anchor has recently been received."""
    return rx_ticks - n.rx_ticks < _lasting_ticks(n, PRESENT_TICKS)


def _lasting_ticks(n: Neighbour, least_ticks: Ticks) -> Ticks:
    return max(least_ticks, LASTING_PERIODS * period_ticks(n.period_code))


def forget_times(t: Neighbours) -> None:
    """Forget when each anchor was received, after a restart of the receiver's counter."""
    t.has_newest = False
    for row in range(t.count):
        _forget_row(t.rows[row])


def wake_times(t: Neighbours, rx_ticks: Ticks, rx_counter: Ticks) -> None:
    """Reset times after a sleep from ``rx_ticks`` on: anchors confirmed then count as confirmed at ``rx_counter``."""
    t.has_newest = False
    for row in range(t.count):
        was_confirmed = is_confirmed(t.rows[row], rx_ticks)
        _forget_row(t.rows[row])
        if was_confirmed:
            t.rows[row].relayed_ticks = rx_counter


def _forget_row(n: Neighbour) -> None:
    n.frames, n.impossible, n.has_rival, n.was_relayed = 0, 0, False, False
    n.relayed_ticks = n.own_relays_ticks = n.used_ticks = n.changed_ticks = NEVER


# Unwrapping of every anchor's counter along the receiver's own.

# A counter has restarted once this number of stamps in a row were impossible and none has fitted for both of these
# times: forged frames in between do not replace an anchor that still sends.
STAMPS_BEFORE_RESTART: Final = 3
RESTART_SILENCE_TICKS: Final = from_seconds(0.2)
RESTART_SILENCE_PERIODS: Final = 4

STAMP_FITS, DUPLICATE, OUT_OF_ORDER, IMPOSSIBLE_STAMP, ANCHOR_RESTART = range(5)
"""Kinds of stamps. ``ANCHOR_RESTART`` is impossible as well, and the anchor's next stamp restarts its counter."""
STAMP_COUNTERS: Final = (
    (),
    ("duplicate",),
    ("out-of-order",),
    ("impossible-stamp",),
    ("impossible-stamp", "anchor-restart"),
)
"""Counters of each kind."""


def unwrap_stamp(
    t: Neighbours, anchor: int, sequence: int, tx_counter: Ticks, rx_ticks: Ticks, period_ticks: Ticks
) -> int:
    """Unwrap the TX stamp of a frame along the anchor's own counter. Return the kind of the stamp.

    ``rx_ticks`` is the receiver's own reading, unwrapped; ``period_ticks`` the time between two frames of an anchor,
    if known. If the stamp fits, ``row`` is the anchor's and holds the result; a first stamp keeps its own value.
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
    """Count an impossible stamp. After a few of them the next stamp of a silent anchor is a beginning.

    If only the first stamp, which may be false, stands against it, two stamps that fit each other are one.
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
