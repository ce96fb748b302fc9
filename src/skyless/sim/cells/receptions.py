"""Receptions on demand: only the frames that a listener can receive are looked at, and nothing is remembered.

Whether a frame is received is a function of keys, so a sender's newest receptions are found by going back in time from
its own frame, and it does not matter how often they are computed, in which order, or where.
"""

import math
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from skyless.core.air.almanac import gap_ticks, mixed, period_ticks, ticks_ahead
from skyless.core.arrays import Array, Integers, Records
from skyless.core.ticks import DELAYED_TX_GRANULARITY_TICKS, TICK_M, TICK_MASK, TICK_RATE_HZ, TICK_S
from skyless.sim.cells.reception import (
    FIRST_PATH_TICKS,
    KNOT_BITS,
    KNOT_TICKS,
    PREAMBLE_TICKS,
    RECEIVED,
    Frames,
    Grid,
    Knots,
    Neighbours,
    Rules,
    cells_within,
    delivery_chance,
    disturb,
    emission,
    key_of,
    luck,
    normal,
    own_time,
    pair_key,
    rx_stamp,
    squared_m2,
    true_time,
    uniform,
)
from skyless.sim.impairments import slope_error_m
from skyless.sim.listening import coordinate_m
from skyless.sim.trajectory import Piece, Trajectory
from skyless.site.kernels import jitted, kernel, step

# Who sends when: the frames of all anchors in a span of true time, and the same frames by time and cell.
#
# Anchors send at the instants of ``skyless.core.air.almanac``, each with a mean period that stays the same.

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


RELAY_AGE_TICKS: Final = round(1.0 * TICK_RATE_HZ)
"""Older receptions are not relayed, as in ``skyless.core.anchor``."""

LOOK_BACK_TICKS: Final = RELAY_AGE_TICKS + RELAY_AGE_TICKS // 1000
"""So far back that all clocks agree that it is older."""

_STRIDE_TICKS: Final = 1 << 31
"""Relays are looked for in strides, the first of 34 ms, each twice as long as the one before."""

TAPS: Final = 50
"""Normals in the moving average of a changing range error."""
KNOTS_A_LENGTH: Final = 10
"""Its knots in a correlation length; the taps reach over five of those."""

PIECE: Final = np.dtype(
    [
        ("end_s", np.float64),
        ("origin_s", np.float64),
        ("position_m", np.float64, (3,)),
        ("velocity_mps", np.float64, (3,)),
        ("acceleration_mps2", np.float64, (3,)),
    ],
    align=True,
)
"""A piece of a trajectory; the names are those of ``STATION``, whose functions read it."""


class Scene(NamedTuple):
    """All that does not depend on the listener."""

    rules: Rules
    knots: Knots
    table: Table
    buckets: Buckets
    grid: Grid
    """The cells of the buckets."""
    neighbours: Neighbours
    positions_m: Array
    """True positions of the anchors, shape (anchors, 3)."""
    keys: Integers
    """Keys of all nodes, anchors first."""


class PairErrors(NamedTuple):
    """Range errors of tags, for the kernels (``RangeErrorModel``)."""

    constant_m: float
    slope_m: float
    changing_m: float
    step: float
    """Length of time (s) or path (m) from knot to knot."""
    constant_key: np.uint64
    changing_key: np.uint64


class Path(NamedTuple):
    """A tag's motion over a span."""

    pieces: Records
    """Shape (pieces,), ``PIECE``, in the order of time."""
    first_knot: int
    travelled: Array
    """Path length in m, or time in s, at true times of knots (``KNOT_TICKS`` apart), shape (knots,)."""


@step
def disturb_nearby(
    scene: Scene,
    listener: int,
    point_m: tuple[float, float, float],
    wanted: tuple[int, int, float, float, float],
    radius_m: float,
    margin_ticks: int,
) -> tuple[int, float]:
    """What the frames from within a radius, emitted less than a margin before or after a wanted one, do to it."""
    buckets, grid = scene.buckets, scene.grid
    low_bin = max((wanted[1] - margin_ticks - buckets.start_ticks) >> BIN_BITS, 0)
    high_bin = min((wanted[1] + margin_ticks - buckets.start_ticks) >> BIN_BITS, buckets.bins - 1)
    first, last, low, high = cells_within(grid, point_m[0], point_m[1], radius_m)
    outcome, early_ticks = RECEIVED, 0.0
    for when in range(low_bin, high_bin + 1):
        for row in range(low, high + 1):
            base = (when * grid.rows + row) * grid.columns
            if first <= last and outcome == RECEIVED:
                outcome, early_ticks = disturb(
                    scene.rules,
                    buckets.frames,
                    buckets.offsets[base + first],
                    buckets.offsets[base + last + 1],
                    scene.positions_m,
                    listener,
                    point_m,
                    wanted,
                    (outcome, early_ticks),
                )
    return outcome, early_ticks


@step
def interference(
    scene: Scene,
    listener: int,
    point_m: tuple[float, float, float],
    wanted: tuple[int, int, float, float, float],
) -> tuple[int, float]:
    """What all frames on the air do to a wanted one at a listener; arguments and results as of ``disturb``.

    The near ones that may destroy it first; those that may shift its stamp are farther away, but closer in time.
    """
    rules = scene.rules
    radius_m = min(math.sqrt(rules.capture * wanted[4]), rules.reach_m)
    margin = int(PREAMBLE_TICKS + wanted[3] + rules.reach_m / TICK_M) + 2
    outcome, early_ticks = disturb_nearby(scene, listener, point_m, wanted, radius_m, margin)
    if outcome == RECEIVED:
        radius_m = min(math.sqrt(rules.first_path * wanted[4]), rules.reach_m)
        margin = int(FIRST_PATH_TICKS + rules.reach_m / TICK_M) + 2
        outcome, early_ticks = disturb_nearby(scene, listener, point_m, wanted, radius_m, margin)
    return outcome, early_ticks


@step
def stamp_at_anchor(scene: Scene, listener: int, sender: int, k: int) -> int:
    """RX stamp at an anchor of a frame that is strong enough there; -1 if another frame destroys it."""
    table = scene.table
    ticks, fraction = table.ticks[sender, k], table.fraction[sender, k]
    x_m, y_m, z_m = (
        scene.positions_m[listener, 0],
        scene.positions_m[listener, 1],
        scene.positions_m[listener, 2],
    )
    square_m2 = squared_m2(scene.positions_m, sender, x_m, y_m, z_m)
    wanted = (sender, ticks, fraction, float(table.after_ticks), square_m2)
    outcome, early_ticks = interference(scene, listener, (x_m, y_m, z_m), wanted)
    stamp = -1
    if outcome == RECEIVED:
        keys = (scene.keys[listener], scene.keys[sender], table.first_number[sender] + k)
        arrival_ticks = fraction + math.sqrt(square_m2) / TICK_M - early_ticks
        stamp = rx_stamp(scene.rules, scene.knots, listener, keys, ticks, arrival_ticks)
    return stamp


@step
def contains(values: Integers, wanted: int) -> bool:
    """Whether a value is among a few."""
    found = False
    for value in values:
        found = found or value == wanted
    return found


@step
def candidates(
    scene: Scene,
    listener: int,
    after_ticks: int,
    until_ticks: int,
    senders: Integers,
    columns: Integers,
    known: Integers,
) -> int:
    """Frames strong enough at an anchor, emitted after a time and until another, newest first; returns their number.

    Those of the anchors ``known``, shape (n,), are left out.
    """
    table, neighbours = scene.table, scene.neighbours
    count = 0
    for i in range(neighbours.offsets[listener], neighbours.offsets[listener + 1]):
        sender = neighbours.anchors[i]
        if contains(known, sender):
            continue
        k = latest(table, sender, until_ticks)
        while k >= 0 and table.ticks[sender, k] > after_ticks:
            number = table.first_number[sender] + k
            pair, chance = neighbours.pair[i], neighbours.chance[i]
            if luck(scene.rules, chance, pair, scene.keys[listener], scene.keys[sender], number) == RECEIVED:
                at = count
                while at > 0 and table.ticks[senders[at - 1], columns[at - 1]] < table.ticks[sender, k]:
                    senders[at], columns[at] = senders[at - 1], columns[at - 1]
                    at -= 1
                senders[at], columns[at] = sender, k
                count += 1
            k -= 1
    return count


@step
def newest_receptions(
    scene: Scene,
    sender: int,
    tx_ticks: int,
    lead_ticks: int,
    scratch: tuple[Integers, Integers],
    relays: tuple[Integers, Integers, Integers],
) -> int:
    """An anchor's newest receptions of others, most recent first, as its frame of ``tx_ticks`` carries them.

    Those whose frames ended before the lead time. Fills anchors (indices), sequences and RX stamps, shape (most,)
    each; returns how many there are.
    """
    table = scene.table
    fetch_ticks = true_time(scene.knots, sender, tx_ticks - lead_ticks)[0]
    until = fetch_ticks - table.after_ticks - 1
    oldest = fetch_ticks - LOOK_BACK_TICKS
    count = 0
    stride = _STRIDE_TICKS
    while until > oldest and count < relays[0].shape[0]:
        since = max(until - stride, oldest)
        found = candidates(scene, sender, since, until, scratch[0], scratch[1], relays[0][:count])
        for i in range(found):
            other, k = scratch[0][i], scratch[1][i]
            if count == relays[0].shape[0]:
                break
            if contains(relays[0][:count], other):
                continue
            rx_ticks = stamp_at_anchor(scene, sender, other, k)
            age = (tx_ticks - rx_ticks) & TICK_MASK
            if rx_ticks >= 0 and age < RELAY_AGE_TICKS:
                relays[0][count], relays[2][count] = other, rx_ticks
                relays[1][count] = (table.first_number[other] + k) & 0xFF
                count += 1
        until = since
        stride *= 2
    return count


@kernel
def fill_relays(
    scene: Scene,
    senders: Integers,
    tx_ticks: Integers,
    lead_ticks: int,
    most_candidates: int,
    counts: Integers,
    anchors: Integers,
    sequences: Integers,
    rx_ticks: Integers,
) -> None:
    """Relays of frames: ``counts`` has shape (frames,), the last three (frames, most), -1 where there are fewer."""
    scratch = (np.empty(most_candidates, dtype=np.int64), np.empty(most_candidates, dtype=np.int64))
    for i in range(senders.shape[0]):
        rows = (anchors[i], sequences[i], rx_ticks[i])
        counts[i] = newest_receptions(scene, senders[i], tx_ticks[i], lead_ticks, scratch, rows)


@kernel
def changing_error(errors: PairErrors, tag_key: int, anchor_key: int, knot: int) -> float:
    """A range error's changing part at a knot, standard normal: exponential weights over keyed normals."""
    kept = math.exp(-1.0 / KNOTS_A_LENGTH)
    total, weight, power = 0.0, 1.0, 0.0
    for tap in range(TAPS):
        total += weight * normal(key_of(errors.changing_key, tag_key, anchor_key, knot - tap))
        power += weight * weight
        weight *= kept
    return total / math.sqrt(power)


@kernel
def receive_at_tag(
    scene: Scene,
    node: int,
    near: Integers,
    path: Path,
    errors: PairErrors,
    from_ticks: int,
    to_ticks: int,
    senders: Integers,
    columns: Integers,
    rx_ticks: Integers,
    points_m: Array,
) -> int:
    """All receptions of a tag of frames emitted in [from, to), sender by sender; returns their number.

    ``near`` are the anchors that it may receive. Fills senders, columns of the table, RX stamps, shape (most,) each,
    and true positions at the emission, shape (most, 3).
    """
    table, rules = scene.table, scene.rules
    key = scene.keys[node]
    count = 0
    for i in range(near.shape[0]):
        sender = near[i]
        constant_m = 0.0
        if errors.constant_m > 0.0:
            drawn = uniform(key_of(errors.constant_key, key, scene.keys[sender], 0))
            constant_m = errors.constant_m * (2.0 * drawn - 1.0)
        pair = pair_key(rules, key, scene.keys[sender])
        knot, before, after = -(1 << 62), 0.0, 0.0
        piece = 0
        for k in range(latest(table, sender, from_ticks - 1) + 1, table.used[sender]):
            ticks, fraction = table.ticks[sender, k], table.fraction[sender, k]
            if ticks >= to_ticks:
                break
            t_s = (ticks + fraction) * TICK_S
            while path.pieces[piece]["end_s"] <= t_s:
                piece += 1
            x_m = coordinate_m(path.pieces, piece, 0, t_s)
            y_m = coordinate_m(path.pieces, piece, 1, t_s)
            z_m = coordinate_m(path.pieces, piece, 2, t_s)
            square_m2 = squared_m2(scene.positions_m, sender, x_m, y_m, z_m)
            number = table.first_number[sender] + k
            if luck(rules, delivery_chance(rules, square_m2), pair, key, scene.keys[sender], number) != RECEIVED:
                continue
            wanted = (sender, ticks, fraction, float(table.after_ticks), square_m2)
            outcome, early_ticks = interference(scene, -1, (x_m, y_m, z_m), wanted)
            if outcome != RECEIVED:
                continue
            error_m = constant_m
            if errors.slope_m != 0.0:
                error_m += slope_error_m(errors.slope_m, math.sqrt(square_m2))
            if errors.changing_m > 0.0:
                at = ticks // KNOT_TICKS - path.first_knot
                part = (ticks % KNOT_TICKS) / KNOT_TICKS
                travelled = path.travelled[at] + part * (path.travelled[at + 1] - path.travelled[at])
                now = math.floor(travelled / errors.step)
                if now != knot:
                    knot = now
                    before = changing_error(errors, key, scene.keys[sender], knot)
                    after = changing_error(errors, key, scene.keys[sender], knot + 1)
                error_m += errors.changing_m * (before + (travelled / errors.step - knot) * (after - before))
            arrival_ticks = fraction + math.sqrt(square_m2) / TICK_M - early_ticks
            if error_m != 0.0:
                arrival_ticks += error_m / TICK_M
            senders[count], columns[count] = sender, k
            rx_ticks[count] = rx_stamp(
                rules, scene.knots, node, (key, scene.keys[sender], number), ticks, arrival_ticks
            )
            points_m[count, 0], points_m[count, 1], points_m[count, 2] = x_m, y_m, z_m
            count += 1
    return count


# A tag's motion as the kernels need it: the pieces of its trajectory in a span, and how far it has travelled.


class TagPath:
    """The path of one tag; cheapest when asked in the order of time.

    Path lengths are summed along straight lines between the knots of the clocks, always from the start, so that they
    do not depend on the spans that are asked for.
    """

    def __init__(self, trajectory: Trajectory, *, length: bool) -> None:
        """``length``: whether to sum up path lengths instead of time."""
        self._trajectory, self._length = trajectory, length
        self._pieces: list[Piece] = []
        self._knot, self._travelled = 0, 0.0

    def cover(self, from_ticks: int, to_ticks: int) -> Path:
        """The path from one true time to another, 0 or later."""
        first, last = from_ticks >> KNOT_BITS, (to_ticks >> KNOT_BITS) + 1
        if self._length and first < self._knot:
            self._knot, self._travelled = 0, 0.0
        begin = min(self._knot, first) if self._length else first
        self._extend(_knot_s(begin), _knot_s(last))
        travelled = self._lengths(first, last) if self._length else [_knot_s(k) for k in range(first, last + 1)]
        pieces = np.zeros(len(self._pieces), dtype=PIECE)
        for row, piece in zip(pieces, self._pieces, strict=True):
            row["end_s"], row["origin_s"], row["position_m"] = piece.end_s, piece.origin_s, piece.position_m
            row["velocity_mps"], row["acceleration_mps2"] = piece.velocity_mps, piece.acceleration_mps2
        left = pieces["end_s"] > from_ticks * TICK_S
        return Path(pieces[left], first, np.array(travelled))

    def _extend(self, from_s: float, to_s: float) -> None:
        """Keep the pieces from one time to another."""
        if self._pieces and from_s < self._pieces[0].start_s:
            self._pieces = []
        self._pieces = [piece for piece in self._pieces if piece.end_s > from_s]
        if not self._pieces:
            self._pieces = [self._trajectory.piece(from_s)]
        while self._pieces[-1].end_s <= to_s:
            self._pieces.append(self._trajectory.piece(self._pieces[-1].end_s))

    def _lengths(self, first: int, last: int) -> list[float]:
        """Path lengths at knots; the sum at the first is kept."""
        positions = self._positions(self._knot, last)
        lengths = [self._travelled]
        for position, following in pairwise(positions):
            lengths.append(lengths[-1] + math.dist(position, following))
        lengths = lengths[first - self._knot :]
        self._knot, self._travelled = first, lengths[0]
        return lengths

    def _positions(self, first: int, last: int) -> list[tuple[float, float, float]]:
        index, positions = 0, []
        for knot in range(first, last + 1):
            t_s = _knot_s(knot)
            while self._pieces[index].end_s <= t_s:
                index += 1
            piece = self._pieces[index]
            dt_s = t_s - piece.origin_s
            at = piece.position_m + dt_s * (piece.velocity_mps + 0.5 * dt_s * piece.acceleration_mps2)
            positions.append((float(at[0]), float(at[1]), float(at[2])))
        return positions


def _knot_s(knot: int) -> float:
    return knot * KNOT_TICKS * TICK_S
