"""Every anchor's counter, unwrapped along the receiver's own."""

from typing import Final

from skyless.core.air.neighbours import Neighbour, Neighbours, find_neighbour, neighbour_of
from skyless.core.native.records import Ticks
from skyless.core.ticks import NOISE_TICKS, TICK_MASK, from_seconds, may_elapse, nearest

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
