"""The anchors of a site as tags receive them: who sends when, whose clock is good enough, and what is relayed."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from skyless.air.codec import heard_capacity
from skyless.anchor import MAX_OFFSET_STD_M
from skyless.clocks.filter import clock_noise, stamp_variance_m2
from skyless.constants import TICK_S
from skyless.kernels.arrays import Integers, Mask, Matrix, Vector
from skyless.kernels.compiled import jitted, kernel
from skyless.kernels.two_state import predict, update
from skyless.planning.links import LEAST_SYNC, links
from skyless.site.model import Site
from skyless.site.slots import first_slots, schedule_of

_STEADY_CHANGE: Final = 1e-7
_MOST_SUPERFRAMES: Final = 20_000
"""Superframes after which a filter counts as steady in any case."""


LEAST_SHARE: Final = 0.01
"""A reception that is relayed more rarely does not count."""

jitted(predict)
jitted(update)


class AnchorClocks(NamedTuple):
    """One superframe of a site, message by message: who sends, and when."""

    sends: Mask
    """Anchors whose clock is known well enough to send; shape (anchors,)."""
    sender: Integers
    """Row of the sending anchor; shape (messages,)."""
    gap_s: Vector
    """Time since the message before."""


def anchor_clocks(site: Site, share: Vector) -> AnchorClocks:
    """For anchors, in the order of the file, that receive these shares of the master's messages."""
    sender, time_s, superframe_s = _messages(site)
    variances = offset_variances(site, share)
    sends = share >= LEAST_SYNC
    sends[sender[variances > MAX_OFFSET_STD_M**2]] = False
    sent = sends[sender]
    sender, time_s = sender[sent], time_s[sent]
    gap_s = np.diff(time_s, prepend=time_s[-1] - superframe_s) if len(time_s) else time_s
    return AnchorClocks(sends, sender, gap_s)


def offset_variances(site: Site, share: Vector) -> Vector:
    """Variance of its sender's clock that each message states in the steady state, m²; 0 of the master's."""
    noise = clock_noise(site.noise.white_fm, site.noise.random_walk_fm)
    master = [anchor.id for anchor in site.anchors].index(site.master)
    sender, time_s, superframe_s = _messages(site)
    variance, reported = sum(stamp_variances(site)), {}
    for part in set(share[share >= LEAST_SYNC].tolist()):
        reported[part] = np.zeros(len(sender))
        _run_filter(sender, time_s, superframe_s, master, part, variance, noise.white, noise.walk, reported[part])
    own = [
        0.0 if row == master or share[row] not in reported else reported[share[row]][k] for k, row in enumerate(sender)
    ]
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
def _run_filter(
    sender: Integers,
    time_s: Vector,
    superframe_s: float,
    master: int,
    share: float,
    variance: float,
    white: float,
    walk: float,
    reported: Vector,
) -> None:
    """Run one anchor's filter into its steady state: its offset's variance at every message."""
    covariance = (variance, 0.0, 144.0)
    last_s = 0.0
    for _ in range(_MOST_SUPERFRAMES):
        before = covariance[0]
        for k in range(len(sender)):
            dt = time_s[k] - last_s if time_s[k] >= last_s else time_s[k] - last_s + superframe_s
            last_s = time_s[k]
            covariance = predict(covariance, dt, white, walk)
            reported[k] = covariance[0]
            if sender[k] == master:
                _, _, updated = update(covariance, variance)
                covariance = (
                    covariance[0] + share * (updated[0] - covariance[0]),
                    covariance[1] + share * (updated[1] - covariance[1]),
                    covariance[2] + share * (updated[2] - covariance[2]),
                )
        if abs(covariance[0] - before) <= _STEADY_CHANGE * share * covariance[0]:
            break


class Relays(NamedTuple):
    """Receptions that the messages of a superframe relay, one after the other."""

    ends: Integers
    """Where those of each message end; shape (messages,)."""
    sender: Integers
    """Row of the anchor whose packet was received; this and the following have shape (relays,)."""
    age_s: Vector
    """How long ago it was sent."""
    share: Vector
    """Of the listener's messages, those that relay it."""
    delay_m: Vector
    """By walls."""


def relays_of(anchors_m: Matrix, master: int, clocks: AnchorClocks, budget: Vector, walls: Matrix) -> Relays:
    """The relays of a site's superframe, whose frames carry the last receptions that fit.

    ``anchors_m``: shape (anchors, 3); ``master``: row of the master, whose packets have a field of their own.
    """
    share, delay_m = links(anchors_m, anchors_m, budget, walls)
    share *= clocks.sends & clocks.sends[:, None]
    capacity = heard_capacity(master_heard=True, master_time=True, page=True)
    master_capacity = heard_capacity(master_heard=False, master_time=True, page=True)
    ends, rows = [], []
    for k, listener in enumerate(clocks.sender.tolist()):
        fits = master_capacity if listener == master else capacity
        for sender, age_s, part in _relayed(clocks, k, share[listener], master, fits):
            rows.append((sender, age_s, part, delay_m[listener, sender]))
        ends.append(len(rows))
    columns = np.array(rows).reshape(-1, 4).T
    return Relays(np.array(ends, np.int64), columns[0].astype(np.int64), *(column.copy() for column in columns[1:]))


def _relayed(
    clocks: AnchorClocks, k: int, share: Vector, master: int, capacity: int
) -> Iterator[tuple[int, float, float]]:
    """What message k relays: senders, how long ago they sent, and how often it relays them.

    From an anchor's message back to its one before: a packet is relayed if it was received and fits, as fewer that
    came later were received than fit. Of an anchor that sent several only the last counts.
    """
    fewer = np.zeros(capacity + 1)  # element i: probability that i − 1 later packets were received
    fewer[1] = 1.0
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
            part *= float(fewer.sum())
            fewer[1:] += share[sender] * (fewer[:-1] - fewer[1:])
        if part >= LEAST_SHARE:
            yield sender, age_s, part
