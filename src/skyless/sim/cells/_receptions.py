"""Receptions on demand: only the frames that a listener can receive are looked at, and nothing is remembered.

Whether a frame is received is a function of keys, so a sender's newest receptions are found by going back in time from
its own frame, and it does not matter how often they are computed, in which order, or where.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from skyless.core.arrays import Array, Integers, Records
from skyless.core.ticks import TICK_M, TICK_MASK, TICK_RATE_HZ, TICK_S
from skyless.sim.cells._clocks import KNOT_TICKS, Knots, true_time
from skyless.sim.cells._grid import Grid, Neighbours, cells_within
from skyless.sim.cells._keyed import key_of, normal, uniform
from skyless.sim.cells._reception import (
    FIRST_PATH_TICKS,
    PREAMBLE_TICKS,
    RECEIVED,
    Rules,
    delivery_chance,
    disturb,
    luck,
    pair_key,
    rx_stamp,
    squared_m2,
)
from skyless.sim.cells._timetable import BIN_BITS, Buckets, Table, latest
from skyless.sim.impairments import slope_error_m
from skyless.sim.listening import coordinate_m
from skyless.site.kernels import kernel, step

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
