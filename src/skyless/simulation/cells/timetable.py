"""Who sends when: the frames of all anchors in a span of true time, and the same frames by cell and time.

The anchors of ``FreeSchedule`` speak at the instants of ``site/free_access.py``; those of ``SlotSchedule`` at the
starts of their slots, each off by a random error. Frames of other sources (machines) can be put into a table, too.
"""

from typing import Final, NamedTuple

import numpy as np
from msgspec import Struct

from skyless.constants import DELAYED_TX_GRANULARITY_TICKS, TICK_S
from skyless.kernels.arrays import Array, Integers
from skyless.kernels.compiled import kernel
from skyless.simulation.cells.clocks import Knots, own_time, true_time
from skyless.simulation.cells.grid import Grid
from skyless.simulation.cells.keyed import SLOT_ERROR, key_of, normal, purpose_key
from skyless.simulation.cells.reception import Frames, Rules, emission
from skyless.site.free_access import first_free_window, free_instant_ticks, free_window_ticks
from skyless.ticks import from_seconds

FIRST_SLOT_TICKS: Final = from_seconds(2e-3)
"""True time at which superframe 0 starts: later than the lead time of its first frame."""

BIN_BITS: Final = 24
"""Frames are sorted into bins of 2^24 ticks, 0.26 ms."""

_GRID_MASK: Final = DELAYED_TX_GRANULARITY_TICKS - 1
_NEVER: Final = np.int64(1) << 62


class FreeSchedule(Struct, frozen=True):
    """No schedule: every anchor speaks once in each window of its own counter."""

    rate_hz: float = 30.0

    @property
    def period_ticks(self) -> int:
        """Length of the windows."""
        return free_window_ticks(self.rate_hz)


class SlotSchedule(Struct, frozen=True):
    """Superframes of slots; anchors of one colour share a slot.

    Raises:
        ValueError: a colour is no slot, or there are no slots.
    """

    colours: Integers
    """Slot of each anchor in the superframe, shape (anchors,)."""
    slots: int
    slot_ticks: int
    error_s: float = 10e-9
    """Standard deviation of the start of a slot as an anchor knows it, drawn again for each superframe."""

    def __post_init__(self) -> None:
        if self.slots < 1 or self.slot_ticks < 1:
            raise ValueError(f"a superframe of {self.slots} slots of {self.slot_ticks} ticks; both should be above 0")
        if len(self.colours) and not (self.colours.min() >= 0 and self.colours.max() < self.slots):
            low, high = self.colours.min(), self.colours.max()
            raise ValueError(f"colours are from {low} to {high}; they should be slots from 0 to {self.slots - 1}")

    @property
    def period_ticks(self) -> int:
        """Length of the superframes."""
        return self.slots * self.slot_ticks


Schedule = FreeSchedule | SlotSchedule


class Table(NamedTuple):
    """Frames of each anchor in the order of time, one a column."""

    period_ticks: int
    """About how far apart they are."""
    after_ticks: int
    """Length after the RMARKER, the same for all."""
    first_number: Integers
    """Number of the frame in column 0, counted from each anchor's first frame, shape (anchors,)."""
    used: Integers
    """Columns in use, shape (anchors,)."""
    tx_ticks: Integers
    """TX stamps, own unwrapped counter, shape (anchors, columns)."""
    ticks: Integers
    """True emission, whole ticks, and its fraction."""
    fraction: Array


class Buckets(NamedTuple):
    """The frames of a table by cell and time."""

    start_ticks: int
    """True time of the first bin."""
    bins: int
    offsets: Integers
    """Shape (cells · bins + 1,): those of a cell and a bin are from ``offsets[cell · bins + bin]`` on."""
    frames: Frames


@kernel
def on_radio_grid(own_ticks: int, tx_delay_ticks: int) -> int:
    """The radio starts on multiples of 512 of its raw counter; the antenna's delay comes on top."""
    raw = own_ticks - tx_delay_ticks
    return raw - (raw & _GRID_MASK) + tx_delay_ticks


@kernel
def latest(table: Table, anchor: int, true_ticks: int) -> int:
    """Column of an anchor's last frame at or before a true time; -1 for none."""
    count = table.used[anchor]
    if count == 0:
        return -1
    k = (true_ticks - table.ticks[anchor, 0]) // table.period_ticks
    k = min(max(k, 0), count - 1)
    while k >= 0 and table.ticks[anchor, k] > true_ticks:
        k -= 1
    while k + 1 < count and table.ticks[anchor, k + 1] <= true_ticks:
        k += 1
    return int(k)


@kernel
def _fill_free(
    rules: Rules,
    knots: Knots,
    table: Table,
    nodes: tuple[Integers, Integers, Integers, Integers],
    lead_ticks: int,
    from_ticks: int,
    to_ticks: int,
) -> None:
    """Fill in the frames of free access; ``nodes``: keys, identifiers, antenna delays, counters at time 0."""
    keys, ids, delays, starts = nodes
    window_ticks = table.period_ticks
    for anchor in range(keys.shape[0]):
        if table.used[anchor] < 0:
            table.used[anchor] = 0
            continue
        opening = first_free_window(ids[anchor], starts[anchor] + lead_ticks + _GRID_MASK + 1, window_ticks)
        window = max(own_time(knots, anchor, from_ticks, 0.0)[0] // window_ticks, opening)
        table.first_number[anchor] = window - opening
        count = 0
        while count < table.ticks.shape[1]:
            tx_ticks = on_radio_grid(free_instant_ticks(ids[anchor], window, window_ticks), delays[anchor])
            ticks, fraction = true_time(knots, anchor, tx_ticks)
            ticks, fraction = emission(rules, keys[anchor], window - opening, ticks, fraction)
            if ticks > to_ticks:
                break
            table.tx_ticks[anchor, count] = tx_ticks
            table.ticks[anchor, count] = ticks
            table.fraction[anchor, count] = fraction
            count += 1
            window += 1
        table.used[anchor] = count


@kernel
def _fill_slots(
    rules: Rules,
    knots: Knots,
    table: Table,
    nodes: tuple[Integers, Integers, Integers],
    slot_ticks: int,
    error_ticks: float,
    error_key: np.uint64,
    from_ticks: int,
    to_ticks: int,
) -> None:
    """Fill in the frames of slots; ``nodes``: keys, colours, antenna delays."""
    keys, colours, delays = nodes
    opening = max((from_ticks - FIRST_SLOT_TICKS) // table.period_ticks, 0)
    for anchor in range(keys.shape[0]):
        if table.used[anchor] < 0:
            table.used[anchor] = 0
            continue
        table.first_number[anchor] = opening
        count = 0
        while count < table.ticks.shape[1]:
            superframe = opening + count
            error = error_ticks * normal(key_of(error_key, keys[anchor], superframe, 0))
            carry = int(np.floor(error))
            start = FIRST_SLOT_TICKS + superframe * table.period_ticks + colours[anchor] * slot_ticks
            tx_ticks = on_radio_grid(own_time(knots, anchor, start + carry, error - carry)[0], delays[anchor])
            ticks, fraction = true_time(knots, anchor, tx_ticks)
            ticks, fraction = emission(rules, keys[anchor], superframe, ticks, fraction)
            if ticks > to_ticks:
                break
            table.tx_ticks[anchor, count] = tx_ticks
            table.ticks[anchor, count] = ticks
            table.fraction[anchor, count] = fraction
            count += 1
        table.used[anchor] = count


@kernel
def _fill_given(
    rules: Rules, knots: Knots, table: Table, keys: Integers, senders: Integers, tx_ticks: Integers
) -> None:
    """Fill in given frames, in the order of each sender's; all counts are 0 at first."""
    for i in range(senders.shape[0]):
        anchor = senders[i]
        k = table.used[anchor]
        ticks, fraction = true_time(knots, anchor, tx_ticks[i])
        ticks, fraction = emission(rules, keys[anchor], k, ticks, fraction)
        table.tx_ticks[anchor, k], table.ticks[anchor, k], table.fraction[anchor, k] = tx_ticks[i], ticks, fraction
        table.used[anchor] = k + 1


def _empty(anchors: int, columns: int, period_ticks: int, after_ticks: int) -> Table:
    ticks = np.full((anchors, columns), _NEVER, dtype=np.int64)
    number, count = np.zeros(anchors, dtype=np.int64), np.zeros(anchors, dtype=np.int64)
    return Table(period_ticks, after_ticks, number, count, np.zeros_like(ticks), ticks, np.zeros(ticks.shape))


class Senders(NamedTuple):
    """The anchors as senders, shape (anchors,) each."""

    keys: Integers
    ids: Integers
    tx_delays_ticks: Integers
    start_ticks: Integers
    """Own counters at time 0."""
    dead: Integers
    """1 for those that neither send nor receive."""


def scheduled_table(
    rules: Rules,
    knots: Knots,
    schedule: Schedule,
    senders: Senders,
    seed: int,
    *,
    lead_ticks: int,
    after_ticks: int,
    from_ticks: int,
    to_ticks: int,
) -> Table:
    """Frames of all anchors from one true time to another, and perhaps one before; ``knots`` cover a period more."""
    period = schedule.period_ticks
    table = _empty(len(senders.ids), (to_ticks - from_ticks) // period + 3, period, after_ticks)
    table.used[:] = -senders.dead
    from_ticks = max(from_ticks, 0)
    if isinstance(schedule, FreeSchedule):
        nodes = (senders.keys, senders.ids, senders.tx_delays_ticks, senders.start_ticks)
        _fill_free(rules, knots, table, nodes, lead_ticks, from_ticks, to_ticks)
    else:
        _fill_slots(
            rules,
            knots,
            table,
            (senders.keys, schedule.colours, senders.tx_delays_ticks),
            schedule.slot_ticks,
            schedule.error_s / TICK_S,
            np.uint64(purpose_key(seed, SLOT_ERROR)),
            from_ticks,
            to_ticks,
        )
    return table


def given_table(
    rules: Rules, knots: Knots, keys: Integers, senders: Integers, tx_ticks: Integers, after_ticks: int
) -> Table:
    """Table of frames that others sent: all of each sender's from its first on, in the order of time.

    ``senders`` are indices of anchors and ``tx_ticks`` own unwrapped counters, shape (frames,).
    """
    most = int(np.bincount(senders, minlength=1).max())
    span = int(tx_ticks.max() - tx_ticks.min()) if len(tx_ticks) else 0
    table = _empty(len(keys), most, max(span // max(most, 1), 1), after_ticks)
    _fill_given(rules, knots, table, keys, senders, tx_ticks)
    return table


@kernel
def _fill_buckets(table: Table, grid: Grid, start_ticks: int, bins: int, offsets: Integers, frames: Frames) -> None:
    """Sort the frames of a table by cell and bin (counting sort)."""
    for anchor in range(table.used.shape[0]):
        for k in range(table.used[anchor]):
            when = (table.ticks[anchor, k] - start_ticks) >> BIN_BITS
            if 0 <= when < bins:
                offsets[grid.cell_of[anchor] * bins + when + 1] += 1
    for i in range(1, offsets.shape[0]):
        offsets[i] += offsets[i - 1]
    for anchor in range(table.used.shape[0] - 1, -1, -1):
        for k in range(table.used[anchor]):
            when = (table.ticks[anchor, k] - start_ticks) >> BIN_BITS
            if 0 <= when < bins:
                i = offsets[grid.cell_of[anchor] * bins + when + 1] - 1
                offsets[grid.cell_of[anchor] * bins + when + 1] = i
                frames.sender[i] = anchor
                frames.ticks[i], frames.fraction[i] = table.ticks[anchor, k], table.fraction[anchor, k]
                frames.after_ticks[i] = table.after_ticks


def make_buckets(table: Table, grid: Grid, from_ticks: int, to_ticks: int) -> Buckets:
    """Sort the frames between two true times by cell and time."""
    bins = ((to_ticks - from_ticks) >> BIN_BITS) + 1
    offsets = np.zeros(grid.columns * grid.rows * bins + 2, dtype=np.int64)
    most = int(table.used.sum())
    frames = Frames(np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64), np.empty(most), np.empty(most))
    _fill_buckets(table, grid, from_ticks, bins, offsets, frames)
    return Buckets(from_ticks, bins, offsets[1:], frames)
