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

from skyless.core.air.frame import preamble_s
from skyless.core.arrays import Array, Integers
from skyless.core.ticks import TICK_M, TICK_MASK, TICK_RATE_HZ, TICK_S, from_seconds
from skyless.sim.cells._clocks import Knots, own_time
from skyless.sim.cells._keyed import CHANCE, LOSS, RX_NOISE, TX_NOISE, key_of, mixed, normal, purpose_key, uniform
from skyless.sim.listening import OUTCOMES, Outcome
from skyless.site.channel import (
    FREE_SPACE_LOSS_1_M_DB,
    ChannelModel,
    delivery_probability,
    received_power_dbm,
)
from skyless.site.kernels import kernel, step

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
