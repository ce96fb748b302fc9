"""Times of flight of many pairs at once by bracketing, as ``bracketed_flight_ticks`` in ``clocks/two_way.py``.

Each leg between anchors a < b is a row with its stamp on a's counter and on b's. A leg from b to a is bracketed on a's
counter by the legs from a to b before and after it; one from a to b likewise on b's counter.
"""

import numpy as np
from msgspec import Struct
from msgspec.structs import astuple, replace

from skyless.clocks.two_way import MAX_BRACKET_RATE, MAX_FLIGHT_TICKS
from skyless.kernels.arrays import Array, Integers, Mask


class Legs(Struct, frozen=True, eq=False):
    """Legs of many pairs, each array of shape (n,)."""

    pair: Integers
    """Number of the pair."""
    a_ticks: Integers
    b_ticks: Integers
    """Stamps on the counters of its two anchors, unwrapped."""
    is_back: Mask
    """Whether it went from b to a."""
    is_used: Mask
    """Whether its time of flight has been computed before."""
    t_s: Array

    def part(self, index: Integers | Mask) -> "Legs":
        """Some of the rows."""
        return Legs(*(column[index] for column in astuple(self)))


class Flights(Struct, frozen=True, eq=False):
    """Times of flight, each array of shape (k,)."""

    leg: Integers
    """Index of the bracketed leg."""
    ticks: Array
    part: Array
    """Where it lies between the two legs that bracket it, 0 to 1."""


def flights_of(legs: Legs, longest_ticks: int) -> tuple[Flights, Legs, int]:
    """Times of flight of all legs that were not used before and are bracketed within ``longest_ticks``.

    Returns them (they index ``legs``), the legs that later ones need, and the number of brackets that cannot be of one
    pair of counters.
    """
    legs_a = _bracketed(legs, legs.a_ticks, legs.b_ticks, legs.is_back, longest_ticks)
    legs_b = _bracketed(legs, legs.b_ticks, legs.a_ticks, ~legs.is_back, longest_ticks)
    used = legs.is_used.copy()
    used[legs_a.seen] = True
    used[legs_b.seen] = True
    flights = Flights(*map(np.concatenate, zip(astuple(legs_a.flights), astuple(legs_b.flights), strict=True)))
    needed = legs_a.is_needed | legs_b.is_needed
    kept = replace(legs, is_used=used).part(needed)
    return flights, kept, legs_a.impossible + legs_b.impossible


class _OneWay(Struct, frozen=True, eq=False):
    flights: Flights
    seen: Integers
    """Legs that were bracketed, whatever came of it."""
    is_needed: Mask
    impossible: int


def _bracketed(legs: Legs, x_ticks: Integers, y_ticks: Integers, is_reply: Mask, longest_ticks: int) -> _OneWay:
    """Replies y → x between two legs x → y, in the order of x's counter."""
    order = np.lexsort((x_ticks, legs.pair))
    order = order[_first_of_equals(legs.pair[order], x_ticks[order], is_reply[order])]
    pair, reply = legs.pair[order], is_reply[order]
    row, n = np.arange(len(order)), len(order)
    before = np.maximum.accumulate(np.where(reply, -1, row)) if n else row
    after = np.minimum.accumulate(np.where(reply, n, row)[::-1])[::-1] if n else row
    has_before = (before >= 0) & (pair[np.maximum(before, 0)] == pair)
    has_after = (after < n) & (pair[np.minimum(after, n - 1)] == pair) if n else row > 0
    new = np.flatnonzero(reply & has_before & has_after & ~legs.is_used[order])
    middle, first, last = order[new], order[before[new]], order[after[new]]
    span = (x_ticks[last] - x_ticks[first]).astype(np.float64)
    until = (x_ticks[middle] - x_ticks[first]).astype(np.float64)
    gained = (y_ticks[last] - y_ticks[first]).astype(np.float64) - span
    reply_ticks = until - (y_ticks[middle] - y_ticks[first]).astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = gained / span
        ticks, part = (reply_ticks + rate * until) / 2.0, until / span
    in_time = (span > 0.0) & (span <= longest_ticks)
    good = in_time & (until > 0.0) & (until < span) & (np.abs(rate) <= MAX_BRACKET_RATE)
    good &= np.abs(ticks) < MAX_FLIGHT_TICKS
    # A later reply comes after the pair's last reply, so all before the leg that precedes that one has served.
    needed = np.ones(len(legs.pair), dtype=bool)
    replies = np.flatnonzero(reply)
    if len(replies):
        last_of_pair = replies[np.append(pair[replies][1:] != pair[replies][:-1], True)]
        cut = np.zeros(int(pair.max()) + 1, dtype=np.int64)
        cut[pair[last_of_pair]] = np.where(has_before[last_of_pair], before[last_of_pair], last_of_pair)
        needed[:] = False
        needed[order[row >= cut[pair]]] = True
    return _OneWay(Flights(middle[good], ticks[good], part[good]), middle, needed, int(np.sum(in_time & ~good)))


def _first_of_equals(pair: Integers, ticks: Integers, reply: Mask) -> Mask:
    """Rows that do not repeat the one before."""
    first = np.ones(len(pair), dtype=bool)
    first[1:] = (pair[1:] != pair[:-1]) | (ticks[1:] != ticks[:-1]) | (reply[1:] != reply[:-1])
    return first
