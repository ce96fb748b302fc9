"""What becomes of one frame at one listener, and its stamp: one set of functions for both levels of simulation.

Powers follow free space, so they are compared as squared distances. Three rules cut off what has no effect: a frame
``AUDIBLE_WIDTHS`` below the sensitivity is never received (its chance would be 6e-6); a frame weaker than that by the
capture margin disturbs nobody; and interferers count one by one. A frame of the same slot whose preamble arrives up
to 1 µs before the wanted one's and that is too weak to destroy it, but not 20 dB weaker, is taken for its first path:
the frame is read, its stamp is too early by the difference.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyless.core.air.frame import preamble_s
from skyless.core.arrays import Array, Integers
from skyless.core.ticks import TICK_M, TICK_MASK, TICK_RATE_HZ, TICK_S, WRAP_TICKS, from_seconds
from skyless.sim.listening import OUTCOMES, Outcome
from skyless.sim.oscillator import OscillatorModel
from skyless.site.channel import (
    FREE_SPACE_LOSS_1_M_DB,
    ChannelModel,
    delivery_probability,
    received_power_dbm,
)
from skyless.site.kernels import kernel, step

# Random numbers that are functions of keys: no state, so no order of drawing, and the same on any number of workers.
#
# A number's key is the seed, a purpose, and up to three whole numbers (a node, another node, a frame or a knot). Each
# is mixed in by a round of SplitMix64, a bijection of 64 bits. In plain Python NumPy warns of the overflow that it
# needs.

START, CRYSTAL, TX_NOISE, RX_NOISE, CHANCE, LOSS, _, SURVEY, RANGE_CONSTANT, RANGE_CHANGING = range(1, 11)
"""Purposes."""

TAG_NODES: Final = 1 << 32
"""Tags are keyed by this and their number, anchors by their identifier."""

_STEP: Final = np.uint64(0x9E3779B97F4A7C15)
_FIRST: Final = np.uint64(0xBF58476D1CE4E5B9)
_SECOND: Final = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


@kernel
def mixed(key: np.uint64, value: int) -> np.uint64:
    """A key (64 bits) that depends on all bits of another and of a whole number, which may be negative."""
    x = (key ^ np.uint64(np.int64(value))) + _STEP
    x = (x ^ (x >> _S30)) * _FIRST
    x = (x ^ (x >> _S27)) * _SECOND
    return x ^ (x >> _S31)


@kernel
def purpose_key(seed: int, purpose: int) -> np.uint64:
    """Key of all numbers for one purpose."""
    return mixed(mixed(_STEP, seed), purpose)


@kernel
def key_of(base: np.uint64, one: int, other: int, number: int) -> np.uint64:
    """Key of one number: a purpose's key and three whole numbers."""
    return mixed(mixed(mixed(base, one), other), number)


@kernel
def uniform(key: np.uint64) -> float:
    """Uniform number in (0, 1) of a key, a multiple of 2⁻⁵³ and half of that."""
    return (np.float64(key >> _S11) + 0.5) * 2.0**-53


@kernel
def normal_pair(key: np.uint64) -> tuple[float, float]:
    """Two independent standard normals of a key (Box and Muller)."""
    length = math.sqrt(-2.0 * math.log(uniform(key)))
    turn = 2.0 * math.pi * uniform(mixed(key, 1))
    return length * math.cos(turn), length * math.sin(turn)


@kernel
def normal(key: np.uint64) -> float:
    """A standard normal of a key: the first of its pair."""
    return math.sqrt(-2.0 * math.log(uniform(key))) * math.cos(2.0 * math.pi * uniform(mixed(key, 1)))


# Clocks as functions of true time: counters at knots, straight lines in between.
#
# The knots' noise is the two-state model of ``sim/oscillator.py``, sampled exactly from knot to knot by keyed
# normals. All counters are summed up in one pass over all nodes, a few nanoseconds a knot and node; sums at
# checkpoints are kept, so that a time far back costs no more than one stretch. Straight lines leave out the white
# frequency noise within a knot's interval: 2 ps in its middle for a white FM of 2e-11.

KNOT_BITS: Final = 31
KNOT_TICKS: Final = 1 << KNOT_BITS
"""True time between knots, 33.6 ms."""
_MASK: Final = KNOT_TICKS - 1
_KNOT_S: Final = KNOT_TICKS / TICK_RATE_HZ

CHECKPOINT_KNOTS: Final = 256
"""Between two sums that are kept, 8.6 s: 28 kB for each second of 10,000 nodes."""

_AHEAD_KNOTS: Final = 8
"""Summed up beyond the demand, so that small steps of it seldom cost one."""


class Knots(NamedTuple):
    """Counters of all nodes at knots of true time."""

    first: int
    """Number of the first knot; knot k is ``k · KNOT_TICKS`` after the start."""
    ticks: Integers
    """Own unwrapped counters, whole, shape (nodes, knots)."""
    fraction: Array
    """Their fractions, in [0, 1)."""


@kernel
def own_time(knots: Knots, node: int, true_ticks: int, true_fraction: float) -> tuple[int, float]:
    """A node's unwrapped counter at a true time, whole and fraction, both times within the knots."""
    k = (true_ticks >> KNOT_BITS) - knots.first
    within = true_ticks & _MASK
    ticks, fraction = knots.ticks[node, k], knots.fraction[node, k]
    gain = (knots.ticks[node, k + 1] - ticks - KNOT_TICKS) + (knots.fraction[node, k + 1] - fraction)
    total = fraction + true_fraction + gain * ((within + true_fraction) / KNOT_TICKS)
    carry = math.floor(total)
    return ticks + within + int(carry), total - carry


@kernel
def true_time(knots: Knots, node: int, own_ticks: int) -> tuple[int, float]:
    """True time, whole and fraction, at which a node's unwrapped counter shows a whole value."""
    last = knots.ticks.shape[1] - 2
    k = min(max((own_ticks - knots.ticks[node, 0]) >> KNOT_BITS, 0), last)
    while k > 0 and knots.ticks[node, k] > own_ticks:
        k -= 1
    while k < last and knots.ticks[node, k + 1] <= own_ticks:
        k += 1
    ticks, fraction = knots.ticks[node, k], knots.fraction[node, k]
    gain = (knots.ticks[node, k + 1] - ticks - KNOT_TICKS) + (knots.fraction[node, k + 1] - fraction)
    since = (own_ticks - ticks) - fraction
    rest = -fraction - gain * (since / (KNOT_TICKS + gain))
    carry = math.floor(rest)
    return ((knots.first + k) << KNOT_BITS) + (own_ticks - ticks) + int(carry), rest - carry


@kernel
def start_clocks(seed: int, nodes: Integers, offset_ppm: float, ticks: Integers, fraction: Array, rate: Array) -> None:
    """Random counters and rates at knot 0 of the nodes with those keys, shape (n,) each."""
    base = purpose_key(seed, START)
    for node in range(nodes.shape[0]):
        key = mixed(base, nodes[node])
        ticks[node] = int(uniform(mixed(key, 0)) * WRAP_TICKS)
        fraction[node] = uniform(mixed(key, 1))
        rate[node] = offset_ppm * 1e-6 * (2.0 * uniform(mixed(key, 2)) - 1.0)


@kernel
def extend_clocks(
    seed: int,
    nodes: Integers,
    white_fm: float,
    random_walk_fm: float,
    first: int,
    ticks: Integers,
    fraction: Array,
    rate: Array,
) -> None:
    """Sum up counters from knot to knot: column 0 is given, the others are filled in, ``rate`` is brought along.

    ``ticks`` and ``fraction`` have shape (nodes, knots), ``first`` is the number of column 0.
    """
    base = purpose_key(seed, CRYSTAL)
    walk = random_walk_fm * math.sqrt(_KNOT_S)
    own_std_s = math.sqrt(_KNOT_S * (white_fm * white_fm + random_walk_fm * random_walk_fm * _KNOT_S * _KNOT_S / 12.0))
    for node in range(nodes.shape[0]):
        for k in range(ticks.shape[1] - 1):
            one, other = normal_pair(key_of(base, nodes[node], first + k, 0))
            rate_gain = walk * one
            gain = rate[node] * KNOT_TICKS + (0.5 * rate_gain * _KNOT_S + own_std_s * other) * TICK_RATE_HZ
            total = fraction[node, k] + gain
            carry = math.floor(total)
            ticks[node, k + 1] = ticks[node, k] + KNOT_TICKS + int(carry)
            fraction[node, k + 1] = total - carry
            rate[node] += rate_gain


class CellClocks:
    """The counters of nodes over a window of true time that moves with the demand."""

    def __init__(self, model: OscillatorModel, nodes: Integers, seed: int) -> None:
        """``nodes`` are the nodes' keys, shape (n,).

        Raises ValueError for crystals that follow a temperature, which these clocks do not.
        """
        if model.temperature is not None:
            raise ValueError("oscillator.temperature should be None: the clocks of several cells follow none")
        self._model, self._nodes, self._seed = model, nodes, seed
        count = len(nodes)
        ticks, fraction, self._rate = np.zeros((count, 1), dtype=np.int64), np.zeros((count, 1)), np.zeros(count)
        start_clocks(seed, nodes, model.offset_ppm, ticks[:, 0], fraction[:, 0], self._rate)
        self._knots = Knots(0, ticks, fraction)
        self._checkpoints = [(ticks[:, 0].copy(), fraction[:, 0].copy(), self._rate.copy())]

    def cover(self, first_ticks: int, last_ticks: int) -> Knots:
        """Counters from one true time to another, at the least; before the start there are none."""
        first, last = max(first_ticks >> KNOT_BITS, 0), (last_ticks >> KNOT_BITS) + 1
        if first < self._knots.first or first > self._knots.first + self._knots.ticks.shape[1] + CHECKPOINT_KNOTS:
            self._go_back(min(first // CHECKPOINT_KNOTS, len(self._checkpoints) - 1))
        if last >= self._knots.first + self._knots.ticks.shape[1]:
            self._extend(first, last + _AHEAD_KNOTS)
        return self._knots

    def shift(self, node: int, ticks: int) -> None:
        """Add whole ticks to a node's counter, now and for ever (a restart)."""
        self._knots.ticks[node] += ticks
        for counters, _, _ in self._checkpoints:
            counters[node] += ticks

    def _go_back(self, checkpoint: int) -> None:
        ticks, fraction, rate = self._checkpoints[checkpoint]
        self._knots = Knots(checkpoint * CHECKPOINT_KNOTS, ticks[:, None].copy(), fraction[:, None].copy())
        self._rate = rate.copy()

    def _extend(self, first: int, last: int) -> None:
        """Sum up to knot ``last`` and forget those before ``first``; checkpoints on the way are kept."""
        while (end := self._knots.first + self._knots.ticks.shape[1] - 1) < last:
            until = min(last, (end // CHECKPOINT_KNOTS + 1) * CHECKPOINT_KNOTS)
            ticks = np.empty((len(self._nodes), until - end + 1), dtype=np.int64)
            fraction = np.empty(ticks.shape)
            ticks[:, 0], fraction[:, 0] = self._knots.ticks[:, -1], self._knots.fraction[:, -1]
            white_fm, random_walk_fm = self._model.white_fm, self._model.random_walk_fm
            extend_clocks(self._seed, self._nodes, white_fm, random_walk_fm, end, ticks, fraction, self._rate)
            if until == len(self._checkpoints) * CHECKPOINT_KNOTS:
                self._checkpoints.append((ticks[:, -1].copy(), fraction[:, -1].copy(), self._rate.copy()))
            kept = min(max(first - self._knots.first, 0), end - self._knots.first)
            self._knots = Knots(
                self._knots.first + kept,
                np.concatenate((self._knots.ticks[:, kept:-1], ticks), axis=1),
                np.concatenate((self._knots.fraction[:, kept:-1], fraction), axis=1),
            )


AUDIBLE_WIDTHS: Final = 12.0
"""Widths of the loss's logistic function below the sensitivity, from which on nothing is received."""

FIRST_PATH_DB: Final = 20.0
"""A frame of the same slot that is weaker by less than this may be taken for the first path (assumed)."""

FIRST_PATH_TICKS: Final = 1e-6 * TICK_RATE_HZ
"""By how much such a frame may arrive before the wanted one: the radio's search window, 1 µs."""

PREAMBLE_TICKS: Final = from_seconds(preamble_s())

RECEIVED: Final = OUTCOMES.index(Outcome.HEARD)
WEAK: Final = OUTCOMES.index(Outcome.WEAK)
HALF_DUPLEX: Final = OUTCOMES.index(Outcome.HALF_DUPLEX)
COLLISION: Final = OUTCOMES.index(Outcome.COLLISION)
LOST: Final = OUTCOMES.index(Outcome.LOST)

_NEAREST_M2: Final = 1e-4
"""Nearer than 1 cm counts as 1 cm, as in ``received_power_dbm``."""


class Rules(NamedTuple):
    """Channel and noise of a world, for the kernels."""

    audible_m: float
    """Beyond this nothing is received."""
    reach_m: float
    """Beyond this a frame has no effect at all."""
    capture: float
    """Ratio of powers by which a frame survives another."""
    first_path: float
    """Ratio of powers up to which another may be taken for the first path."""
    tx_power_dbm: float
    sensitivity_dbm: float
    sensitivity_width_db: float
    loss_probability: float
    tx_noise_ticks: float
    rx_noise_ticks: float
    tx_key: np.uint64
    rx_key: np.uint64
    chance_key: np.uint64
    loss_key: np.uint64


class Frames(NamedTuple):
    """Frames on the air, shape (n,) each."""

    sender: Integers
    """Index of the sending anchor."""
    ticks: Integers
    """True time at which the RMARKER leaves, whole ticks."""
    fraction: Array
    after_ticks: Array
    """Length of the frame after its RMARKER."""


def rules_of(channel: ChannelModel, tx_stamp_ps: float, rx_stamp_ps: float, seed: int) -> Rules:
    """Rules of a world.

    Raises:
        ValueError: the channel asks for errors of single messages, which are not modelled here; the message names the
            key.
    """
    for name, value in (("nlos_probability", channel.nlos_probability), ("power_bias", channel.power_bias)):
        if value:
            raise ValueError(f"channel.{name} is {value}; it should be 0: several cells do not model it")
    weakest_dbm = channel.sensitivity_dbm - AUDIBLE_WIDTHS * channel.sensitivity_width_db
    audible_m = 10.0 ** ((channel.tx_power_dbm - FREE_SPACE_LOSS_1_M_DB - weakest_dbm) / 20.0)
    return Rules(
        audible_m,
        audible_m * 10.0 ** (channel.capture_db / 20.0),
        10.0 ** (channel.capture_db / 10.0),
        10.0 ** (FIRST_PATH_DB / 10.0),
        channel.tx_power_dbm,
        channel.sensitivity_dbm,
        channel.sensitivity_width_db,
        channel.loss_probability,
        tx_stamp_ps * 1e-12 / TICK_S,
        rx_stamp_ps * 1e-12 / TICK_S,
        np.uint64(purpose_key(seed, TX_NOISE)),
        np.uint64(purpose_key(seed, RX_NOISE)),
        np.uint64(purpose_key(seed, CHANCE)),
        np.uint64(purpose_key(seed, LOSS)),
    )


@step
def squared_m2(positions_m: Array, anchor: int, x_m: float, y_m: float, z_m: float) -> float:
    """Squared distance of an anchor from a point; nearer than 1 cm counts as 1 cm."""
    dx_m, dy_m, dz_m = x_m - positions_m[anchor, 0], y_m - positions_m[anchor, 1], z_m - positions_m[anchor, 2]
    square: float = dx_m * dx_m + dy_m * dy_m + dz_m * dz_m
    return max(square, _NEAREST_M2)


@kernel
def delivery_chance(rules: Rules, square_m2: float) -> float:
    """Chance that a frame from that squared distance is strong enough, 0 beyond the audible distance."""
    if square_m2 > rules.audible_m * rules.audible_m:
        return 0.0
    power_dbm = received_power_dbm(rules.tx_power_dbm, math.sqrt(square_m2), 0.0)
    return delivery_probability(power_dbm, rules.sensitivity_dbm, rules.sensitivity_width_db)


@kernel
def pair_key(rules: Rules, listener_key: int, sender_key: int) -> np.uint64:
    """Key of the chances of all frames from one node to another."""
    return mixed(mixed(rules.chance_key, listener_key), sender_key)


@kernel
def luck(rules: Rules, chance: float, pair: np.uint64, listener_key: int, sender_key: int, number: int) -> int:
    """Outcome of power and chance for a frame without interferers: heard, weak or lost; ``pair`` of ``pair_key``."""
    if chance == 0.0 or uniform(mixed(pair, number)) > chance:
        return WEAK
    loss = rules.loss_probability
    if loss > 0.0 and uniform(key_of(rules.loss_key, listener_key, sender_key, number)) < loss:
        return LOST
    return RECEIVED


@step
def disturb(
    rules: Rules,
    frames: Frames,
    start: int,
    stop: int,
    positions_m: Array,
    listener: int,
    point_m: tuple[float, float, float],
    wanted: tuple[int, int, float, float, float],
    before: tuple[int, float],
) -> tuple[int, float]:
    """What the frames start to stop do to a wanted one at a listener, in any order.

    ``listener`` is its index if it is an anchor, else -1, ``point_m`` its position, ``wanted`` the frame's sender,
    emission (whole and fraction), length after its RMARKER and squared distance. ``before`` is the result of other
    frames, at first (RECEIVED, 0). Returns the outcome and by how many ticks the stamp is too early.
    """
    outcome, early_ticks = before
    sender, ticks, fraction, after_ticks, square_m2 = wanted
    distance_m = math.sqrt(square_m2)
    longest = PREAMBLE_TICKS + after_ticks + rules.reach_m / TICK_M
    for i in range(start, stop):
        ahead = float(frames.ticks[i] - ticks)
        if frames.sender[i] == sender or ahead > longest or ahead < -longest - frames.after_ticks[i]:
            continue
        other = frames.sender[i]
        if other == listener:
            late = ahead + (frames.fraction[i] - fraction) - distance_m / TICK_M
            if late < PREAMBLE_TICKS + after_ticks and late + frames.after_ticks[i] > -PREAMBLE_TICKS:
                outcome = HALF_DUPLEX
            continue
        square = squared_m2(positions_m, other, point_m[0], point_m[1], point_m[2])
        if square >= rules.first_path * square_m2 or square > rules.reach_m * rules.reach_m:
            continue
        late = ahead + (frames.fraction[i] - fraction) + (math.sqrt(square) - distance_m) / TICK_M
        if square < rules.capture * square_m2:
            if late < PREAMBLE_TICKS + after_ticks and late + frames.after_ticks[i] > -PREAMBLE_TICKS:
                outcome = HALF_DUPLEX if outcome == HALF_DUPLEX else COLLISION
        elif -FIRST_PATH_TICKS < late < 0.0:
            early_ticks = max(early_ticks, -late)
    return outcome, early_ticks


@step
def rx_stamp(
    rules: Rules,
    knots: Knots,
    node: int,
    keys: tuple[int, int, int],
    emission_ticks: int,
    arrival_ticks: float,
) -> int:
    """RX stamp, 40 bits, of a frame that arrives ``arrival_ticks`` after ``emission_ticks``.

    ``keys`` are those of the listener and the sender, and the frame's number.
    """
    carry = math.floor(arrival_ticks)
    ticks, fraction = own_time(knots, node, emission_ticks + int(carry), arrival_ticks - carry)
    fraction += rules.rx_noise_ticks * normal(key_of(rules.rx_key, keys[0], keys[1], keys[2]))
    return (ticks + math.floor(fraction + 0.5)) & TICK_MASK


@kernel
def emission(rules: Rules, sender_key: int, number: int, ticks: int, fraction: float) -> tuple[int, float]:
    """When a frame's RMARKER really leaves: the instant at which the clock shows its stamp, and the TX noise."""
    total = fraction + rules.tx_noise_ticks * normal(key_of(rules.tx_key, sender_key, number, 0))
    carry = math.floor(total)
    return ticks + int(carry), total - carry


# Anchors sorted into square cells of the floor plan, so that those near a point are found without looking at all.

_MAX_CELLS: Final = 1_000_000
"""Anchors far apart get larger cells instead of more."""


class Grid(NamedTuple):
    """Cells counted from the south-west corner, row by row."""

    west_m: float
    south_m: float
    cell_m: float
    columns: int
    rows: int
    offsets: Integers
    """Shape (cells + 1,): the anchors of a cell are ``anchors[offsets[cell] : offsets[cell + 1]]``."""
    anchors: Integers
    """Indices of the anchors, shape (n,)."""
    cell_of: Integers
    """Cell of each anchor, shape (n,)."""


class Neighbours(NamedTuple):
    """For each anchor, the other anchors that it may receive."""

    offsets: Integers
    """Shape (anchors + 1,)."""
    anchors: Integers
    chance: Array
    """That a frame is strong enough."""
    pair: NDArray[np.uint64]
    """Keys of the pairs' chances."""


def make_grid(positions_m: Array, cell_m: float) -> Grid:
    """Sort anchors, shape (n, 3), n of 1 or more, into cells of about that width, the height left aside."""
    west_m, south_m = positions_m[:, 0].min(), positions_m[:, 1].min()
    width_m, depth_m = positions_m[:, 0].max() - west_m, positions_m[:, 1].max() - south_m
    cell_m = max(cell_m, math.sqrt(width_m * depth_m / _MAX_CELLS), max(width_m, depth_m) / _MAX_CELLS)
    columns, rows = int(width_m / cell_m) + 1, int(depth_m / cell_m) + 1
    column = np.minimum(((positions_m[:, 0] - west_m) / cell_m).astype(np.int64), columns - 1)
    row = np.minimum(((positions_m[:, 1] - south_m) / cell_m).astype(np.int64), rows - 1)
    cell_of = row * columns + column
    offsets = np.concatenate(([0], np.cumsum(np.bincount(cell_of, minlength=columns * rows)))).astype(np.int64)
    anchors = np.argsort(cell_of, kind="stable")
    return Grid(float(west_m), float(south_m), float(cell_m), columns, rows, offsets, anchors, cell_of)


@kernel
def cells_within(grid: Grid, x_m: float, y_m: float, radius_m: float) -> tuple[int, int, int, int]:
    """First and last column and row of the cells that a circle may touch; the last are before the first for none."""
    first = max(math.floor((x_m - radius_m - grid.west_m) / grid.cell_m), 0)
    last = min(math.floor((x_m + radius_m - grid.west_m) / grid.cell_m), grid.columns - 1)
    low = max(math.floor((y_m - radius_m - grid.south_m) / grid.cell_m), 0)
    high = min(math.floor((y_m + radius_m - grid.south_m) / grid.cell_m), grid.rows - 1)
    return first, last, low, high


@kernel
def anchors_within(
    grid: Grid, positions_m: Array, point_m: tuple[float, float, float], radius_m: float, found: Integers
) -> int:
    """Fill ``found``, shape (anchors,), with the anchors at most ``radius_m`` from a point; returns their number."""
    count = 0
    first, last, low, high = cells_within(grid, point_m[0], point_m[1], radius_m)
    for row in range(low, high + 1):
        for column in range(first, last + 1):
            cell = row * grid.columns + column
            for i in range(grid.offsets[cell], grid.offsets[cell + 1]):
                anchor = grid.anchors[i]
                if squared_m2(positions_m, anchor, point_m[0], point_m[1], point_m[2]) <= radius_m * radius_m:
                    found[count] = anchor
                    count += 1
    return count


@kernel
def _list_neighbours(rules: Rules, grid: Grid, positions_m: Array, keys: Integers, lists: Neighbours) -> None:
    """Fill the lists; where they are empty only their offsets."""
    offsets, anchors, chance, pair = lists
    found = np.empty(positions_m.shape[0], dtype=np.int64)
    total = 0
    for one in range(positions_m.shape[0]):
        point_m = (positions_m[one, 0], positions_m[one, 1], positions_m[one, 2])
        for i in range(anchors_within(grid, positions_m, point_m, rules.audible_m, found)):
            if found[i] == one:
                continue
            if anchors.shape[0] > 0:
                anchors[total] = found[i]
                chance[total] = delivery_chance(
                    rules, squared_m2(positions_m, found[i], point_m[0], point_m[1], point_m[2])
                )
                pair[total] = pair_key(rules, keys[one], keys[found[i]])
            total += 1
        offsets[one + 1] = total


def list_neighbours(rules: Rules, grid: Grid, positions_m: Array, keys: Integers) -> Neighbours:
    """For each anchor the others that it may receive; ``positions_m`` has shape (n, 3), ``keys`` (n,)."""
    lists = _empty_lists(np.zeros(len(positions_m) + 1, dtype=np.int64), 0)
    _list_neighbours(rules, grid, positions_m, keys, lists)
    lists = _empty_lists(lists.offsets, int(lists.offsets[-1]))
    _list_neighbours(rules, grid, positions_m, keys, lists)
    return lists


def _empty_lists(offsets: Integers, total: int) -> Neighbours:
    return Neighbours(offsets, np.empty(total, dtype=np.int64), np.empty(total), np.empty(total, dtype=np.uint64))
