"""The anchors of a site as tags hear them: who sends when, whose clock is good enough to send, and what is relayed."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from skyless.air.codec import heard_capacity
from skyless.anchor import MAX_OFFSET_STD_M
from skyless.clocks.filter import clock_noise
from skyless.constants import TICK_S
from skyless.kernels.arrays import Integers, Mask, Matrix, Vector
from skyless.kernels.compiled import kernel
from skyless.planning.links import LEAST_SYNC, links
from skyless.site.model import Site
from skyless.site.slots import first_slots, schedule_of
from skyless.uncertainty.tdoa import stamp_variance_m2

_SETTLED: Final = 1e-7
_LONGEST: Final = 20_000
"""Superframes after which a filter counts as settled in any case."""


LEAST_TOLD: Final = 0.01
"""A reception that is relayed more rarely does not count."""

AGE_S, TOLD, LATE_M = range(3)
"""Places in a row of ``values``."""


class AnchorClocks(NamedTuple):
    """One superframe of a site, message by message: who sends, and when."""

    speaks: Mask
    """Anchors whose clock is known well enough to send; shape (anchors,)."""
    sender: Integers
    """Row of the sending anchor; shape (messages,)."""
    gap_s: Vector
    """Time since the message before."""


def anchor_clocks(site: Site, share: Vector) -> AnchorClocks:
    """For anchors, in the order of the file, that hear these shares of the master's messages."""
    sender, time_s, superframe_s = _messages(site)
    variances = offset_variances(site, share)
    speaks = share >= LEAST_SYNC
    speaks[sender[variances > MAX_OFFSET_STD_M**2]] = False
    spoken = speaks[sender]
    sender, time_s = sender[spoken], time_s[spoken]
    gap_s = np.diff(time_s, prepend=time_s[-1] - superframe_s) if len(time_s) else time_s
    return AnchorClocks(speaks, sender, gap_s)


def offset_variances(site: Site, share: Vector) -> Vector:
    """What each message of a superframe tells of its sender's clock in the steady state, m²; 0 of the master's."""
    noise = clock_noise(site.noise.white_fm, site.noise.random_walk_fm)
    master = [anchor.id for anchor in site.anchors].index(site.master)
    sender, time_s, superframe_s = _messages(site)
    variance, told = sum(stamp_variances(site)), {}
    for part in set(share[share >= LEAST_SYNC].tolist()):
        told[part] = np.zeros(len(sender))
        _settle(sender, time_s, superframe_s, master, part, variance, noise.white, noise.walk, told[part])
    own = [0.0 if row == master or share[row] not in told else told[share[row]][k] for k, row in enumerate(sender)]
    return np.array(own)


def stamp_variances(site: Site) -> tuple[float, float]:
    """Variances, m², of a TX stamp and of an RX stamp with its rounding."""
    noise = site.noise
    tx_var = stamp_variance_m2(noise.tx_stamp_ps * 1e-12, rounded=False)
    return tx_var, stamp_variance_m2(noise.rx_stamp_ps * 1e-12, rounded=True)


def _messages(site: Site) -> tuple[Integers, Vector, float]:
    """Rows of the anchors in the order in which they send in a superframe, their times, and its length."""
    schedule, first = schedule_of(site), first_slots(site)
    slot_s = schedule.slot_ticks * TICK_S
    order = sorted((slot, row) for row, a in enumerate(site.anchors) for slot in schedule.slots_of(first[a.id]))
    senders = np.array([row for _, row in order], dtype=np.int64)
    return senders, np.array([slot * slot_s for slot, _ in order]), schedule.superframe_ticks * TICK_S


@kernel
def _settle(
    sender: Integers,
    time_s: Vector,
    superframe_s: float,
    master: int,
    share: float,
    variance: float,
    white: float,
    walk: float,
    told: Vector,
) -> None:
    """Run one anchor's filter into its steady state: its offset's variance at every message."""
    p00, p01, p11 = variance, 0.0, 144.0
    last_s = 0.0
    for _ in range(_LONGEST):
        before = p00
        for k in range(len(sender)):
            dt = time_s[k] - last_s if time_s[k] >= last_s else time_s[k] - last_s + superframe_s
            last_s = time_s[k]
            p00 += dt * (2.0 * p01 + dt * p11) + dt * (white + walk * dt * dt / 3.0)
            p01 += dt * (p11 + walk * dt / 2.0)
            p11 += walk * dt
            told[k] = p00
            if sender[k] == master:
                spread = p00 + variance
                p11 -= share * p01 * p01 / spread
                p01 -= share * p01 * p00 / spread
                p00 -= share * p00 * p00 / spread
        if abs(p00 - before) <= _SETTLED * share * p00:
            break


class Relays(NamedTuple):
    """Receptions that the messages of a superframe relay, one after the other."""

    ends: Integers
    """Where those of each message end; shape (messages,)."""
    heard: Integers
    """Row of the anchor whose packet was heard; shape (relays,)."""
    values: Matrix
    """How long ago it was sent, of the sender's messages those that tell of it, its delay by walls; (relays, 3)."""


def relays_of(anchors_m: Matrix, master: int, clocks: AnchorClocks, budget: Vector, walls: Matrix) -> Relays:
    """The relays of a site's superframe, whose frames tell of the last receptions while there is room.

    ``anchors_m``: shape (anchors, 3); ``master``: row of the master, whose packets have a place of their own.
    """
    share, delay_m = links(anchors_m, anchors_m, budget, walls)
    share *= clocks.speaks & clocks.speaks[:, None]
    room = heard_capacity(master_heard=True, master_time=True, page=True)
    masters_room = heard_capacity(master_heard=False, master_time=True, page=True)
    ends, heard, values = [], [], []
    for k, listener in enumerate(clocks.sender.tolist()):
        for sender, age_s, part in _told(
            clocks, k, share[listener], master, masters_room if listener == master else room
        ):
            heard.append(sender)
            values.append((age_s, part, delay_m[listener, sender]))
        ends.append(len(heard))
    return Relays(np.array(ends, np.int64), np.array(heard, np.int64), np.array(values).reshape(-1, 3))


def _told(clocks: AnchorClocks, k: int, share: Vector, master: int, room: int) -> Iterator[tuple[int, float, float]]:
    """What message k relays: senders, how long ago they sent, and how often it tells.

    From an anchor's message back to its one before: a packet is told of if it was heard and there is room, as fewer
    that came later were heard than fit. Of an anchor that sent several only the last counts.
    """
    more = np.zeros(room + 1)  # probability that one less than so many later packets were heard
    more[1] = 1.0
    seen, age_s = {int(clocks.sender[k])}, 0.0
    for back in range(1, len(clocks.sender)):
        age_s += float(clocks.gap_s[k - back + 1])
        sender = int(clocks.sender[k - back])
        if sender == clocks.sender[k]:
            break
        if sender in seen or share[sender] == 0.0:
            continue
        seen.add(sender)
        part = float(share[sender])
        if sender != master:
            part *= float(more.sum())
            more[1:] += share[sender] * (more[:-1] - more[1:])
        if part >= LEAST_TOLD:
            yield sender, age_s, part
