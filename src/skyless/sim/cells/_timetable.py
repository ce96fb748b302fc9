"""Who sends when: the frames of all anchors in a span of true time, and the same frames by time and cell.

Anchors send at the instants of ``skyless.core.air.almanac``, each with a mean period that stays the same.
"""

from typing import Final, NamedTuple

import numpy as np

from skyless.core.air.almanac import gap_ticks, mixed, period_ticks, ticks_ahead
from skyless.core.arrays import Array, Integers
from skyless.core.ticks import DELAYED_TX_GRANULARITY_TICKS
from skyless.sim.cells._clocks import Knots, own_time, true_time
from skyless.sim.cells._grid import Grid
from skyless.sim.cells._reception import Frames, Rules, emission
from skyless.site.kernels import jitted, kernel, step

BIN_BITS: Final = 25
"""Frames are sorted into bins of 2^24 ticks, 0.26 ms."""

_GRID_MASK: Final = DELAYED_TX_GRANULARITY_TICKS - 1
_NEVER: Final = np.int64(1) << 62
SEQUENCES: Final = 256

jitted(mixed)
jitted(gap_ticks)
jitted(ticks_ahead)


class Table(NamedTuple):
    """Frames of each anchor in the order of time, one a column."""

    period_ticks: Integers
    """Mean time between two of each anchor, shape (anchors,)."""
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
    """The frames of a table by time and cell."""

    start_ticks: int
    """True time of the first bin."""
    bins: int
    offsets: Integers
    """Shape (bins · cells + 1,): those of a bin and a cell are from ``offsets[bin · cells + cell]`` on.

    So those of neighbouring columns follow one another, and what is on the air at a time lies close together.
    """
    frames: Frames


@kernel
def on_radio_grid(own_ticks: int, tx_delay_ticks: int) -> int:
    """The radio starts on multiples of 512 of its raw counter; the antenna's delay comes on top."""
    raw = own_ticks - tx_delay_ticks
    return raw - (raw & _GRID_MASK) + tx_delay_ticks


@step
def latest(table: Table, anchor: int, true_ticks: int) -> int:
    """Column of an anchor's last frame at or before a true time; -1 for none."""
    used = table.used[anchor]
    k = min(max((true_ticks - table.ticks[anchor, 0]) // table.period_ticks[anchor], 0), used - 1)
    while k >= 0 and table.ticks[anchor, k] > true_ticks:
        k -= 1
    while k + 1 < used and table.ticks[anchor, k + 1] <= true_ticks:
        k += 1
    return int(k)


@kernel
def _fill(
    rules: Rules,
    knots: Knots,
    table: Table,
    nodes: tuple[Integers, Integers, Integers, Integers, Integers],
    lead_ticks: int,
    from_ticks: int,
    to_ticks: int,
) -> None:
    """Fill in the frames; ``nodes``: keys, identifiers, codes of periods, antenna delays, counters at time 0."""
    keys, ids, codes, delays, starts = nodes
    for anchor in range(keys.shape[0]):
        if table.used[anchor] < 0:
            table.used[anchor] = 0
            continue
        first = starts[anchor] + lead_ticks + _GRID_MASK + 1 + gap_ticks(ids[anchor], 0xFF, codes[anchor])
        tx_ticks = on_radio_grid(first, delays[anchor])
        cycle_ticks = ticks_ahead(ids[anchor], 0, codes[anchor], SEQUENCES)
        own_ticks = own_time(knots, anchor, from_ticks, 0.0)[0]
        cycles = max((own_ticks - tx_ticks) // cycle_ticks, 0)
        number = cycles * SEQUENCES
        tx_ticks += cycles * cycle_ticks
        while tx_ticks < own_ticks:
            tx_ticks += gap_ticks(ids[anchor], number, codes[anchor])
            number += 1
        table.first_number[anchor] = number
        count = 0
        while count < table.ticks.shape[1]:
            ticks, fraction = true_time(knots, anchor, tx_ticks)
            ticks, fraction = emission(rules, keys[anchor], number, ticks, fraction)
            if ticks > to_ticks:
                break
            table.tx_ticks[anchor, count] = tx_ticks
            table.ticks[anchor, count] = ticks
            table.fraction[anchor, count] = fraction
            tx_ticks += gap_ticks(ids[anchor], number, codes[anchor])
            number += 1
            count += 1
        table.used[anchor] = count


def _empty(period_ticks: Integers, columns: int, after_ticks: int) -> Table:
    anchors = len(period_ticks)
    ticks = np.full((anchors, columns), _NEVER, dtype=np.int64)
    number, count = np.zeros(anchors, dtype=np.int64), np.zeros(anchors, dtype=np.int64)
    return Table(period_ticks, after_ticks, number, count, np.zeros_like(ticks), ticks, np.zeros(ticks.shape))


class Senders(NamedTuple):
    """The anchors as senders, shape (anchors,) each."""

    keys: Integers
    ids: Integers
    period_codes: Integers
    """Codes of the mean periods (``skyless.core.air.almanac``)."""
    tx_delays_ticks: Integers
    start_ticks: Integers
    """Own counters at time 0."""
    dead: Integers
    """1 for those that neither send nor receive."""


def scheduled_table(
    rules: Rules,
    knots: Knots,
    senders: Senders,
    *,
    lead_ticks: int,
    after_ticks: int,
    from_ticks: int,
    to_ticks: int,
) -> Table:
    """Frames of all anchors from one true time to another; ``knots`` cover two periods more."""
    periods = np.array([period_ticks(code) for code in senders.period_codes.tolist()], dtype=np.int64)
    table = _empty(periods, int(2 * (to_ticks - from_ticks) // periods.min()) + 3, after_ticks)
    table.used[:] = -senders.dead
    nodes = (senders.keys, senders.ids, senders.period_codes, senders.tx_delays_ticks, senders.start_ticks)
    _fill(rules, knots, table, nodes, lead_ticks, max(from_ticks, 0), to_ticks)
    return table


@kernel
def _fill_buckets(table: Table, grid: Grid, start_ticks: int, bins: int, offsets: Integers, frames: Frames) -> None:
    """Sort the frames of a table by bin and cell (counting sort)."""
    cells = grid.columns * grid.rows
    for anchor in range(table.used.shape[0]):
        for k in range(table.used[anchor]):
            when = (table.ticks[anchor, k] - start_ticks) >> BIN_BITS
            if 0 <= when < bins:
                offsets[when * cells + grid.cell_of[anchor] + 1] += 1
    for i in range(1, offsets.shape[0]):
        offsets[i] += offsets[i - 1]
    for anchor in range(table.used.shape[0] - 1, -1, -1):
        for k in range(table.used[anchor]):
            when = (table.ticks[anchor, k] - start_ticks) >> BIN_BITS
            if 0 <= when < bins:
                i = offsets[when * cells + grid.cell_of[anchor] + 1] - 1
                offsets[when * cells + grid.cell_of[anchor] + 1] = i
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
