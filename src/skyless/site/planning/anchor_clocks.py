"""A site's anchors in planning: their reception of the master, their clocks, the schedule of messages, and relays."""

import math
from collections.abc import Iterator
from statistics import median
from typing import Final, NamedTuple

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air import beacon
from skyless.core.air.frame import MAX_FRAME_BYTES, air_time_s
from skyless.core.any_receiver import beacon_period_s
from skyless.core.arrays import Integers, Mask, Matrix, Vector
from skyless.core.clock_filter import clock_noise, predict, stamp_variance_m2, update
from skyless.core.geometry import anchor_positions, anchors_in_reach
from skyless.core.protocol1 import beacon as protocol1_codec
from skyless.core.protocol1.anchor import MAX_OFFSET_STD_M
from skyless.core.protocol1.beacon import first_slots, schedule_of
from skyless.core.site import Site
from skyless.core.ticks import TICK_S
from skyless.site.channel import Barriers, ChannelModel, barriers_of
from skyless.site.planning.links import MIN_SYNC, anchor_links, link_budget, links, masters_by_links

_STEADY_CHANGE: Final = 1e-7
_MAX_SUPERFRAMES: Final = 20_000  # superframes after which a filter counts as steady in any case


MIN_SHARE: Final = 0.01
"""Receptions that are relayed more rarely are ignored."""


class AnchorClocks(NamedTuple):
    """The messages of one superframe: senders and times."""

    sends: Mask
    """Anchors whose clock is known well enough to send; shape (anchors,)."""
    sender: Integers
    """Row of the sending anchor; shape (messages,)."""
    gap_s: Vector
    """Time since the previous message."""
    kept: float
    """Share of the messages that are not lost to collisions."""


def anchor_clocks(site: Site, share: Vector) -> AnchorClocks:
    """Superframe of anchors, in the order of the file, that receive these shares of the master's messages.

    Anchors without a master are assumed to send one after the other, the average of random instants; a message arrives
    if no other anchor in reach begins one within its length before or after.
    """
    if not site.schedule.needs_master:
        count, period_s = len(site.anchors), beacon_period_s(site)
        rivals = median(anchors_in_reach(site).tolist()) - 1.0
        kept = math.exp(-2.0 * air_time_s(MAX_FRAME_BYTES) * rivals / period_s)
        return AnchorClocks(np.ones(count, np.bool_), np.arange(count), np.full(count, period_s / count), kept)
    sender, time_s, superframe_s = _messages(site)
    variances = offset_variances(site, share)
    sends = share >= MIN_SYNC
    sends[sender[variances > MAX_OFFSET_STD_M**2]] = False
    sent = sends[sender]
    sender, time_s = sender[sent], time_s[sent]
    gap_s = np.diff(time_s, prepend=time_s[-1] - superframe_s) if len(time_s) else time_s
    return AnchorClocks(sends, sender, gap_s, 1.0)


def row_of_master(site: Site) -> int:
    """Index of the master among the anchors."""
    return [anchor.id for anchor in site.anchors].index(site.master)


def offset_variances(site: Site, share: Vector) -> Vector:
    """Variance of the sender's clock offset that each message states in the steady state, m²; 0 for the master."""
    noise = clock_noise(site.noise.white_fm, site.noise.random_walk_fm)
    master = row_of_master(site)
    sender, time_s, superframe_s = _messages(site)
    variance, reported = sum(stamp_variances(site)), {}
    for part in set(share[share >= MIN_SYNC].tolist()):
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
    """Rows of the sending anchors and times of the messages in a superframe, in order, and its length in seconds."""
    schedule, first = schedule_of(site), first_slots(site)
    slot_s = schedule.slot_ticks * TICK_S
    order = sorted((slot, row) for row, a in enumerate(site.anchors) for slot in schedule.slots_of(first[a.id]))
    senders = np.array([row for _, row in order], dtype=np.int64)
    return senders, np.array([slot * slot_s for slot, _ in order]), schedule.superframe_ticks * TICK_S


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
    """Run one anchor's clock filter to its steady state, and store its offset's variance at every message."""
    covariance = (variance, 0.0, 144.0)
    last_s = 0.0
    for _ in range(_MAX_SUPERFRAMES):
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
    """Receptions relayed in the messages of a superframe, concatenated."""

    ends: Integers
    """End index of each message's relays; shape (messages,)."""
    sender: Integers
    """Row of the anchor whose packet was received; this and the following have shape (relays,)."""
    age_s: Vector
    """Time since that packet was sent."""
    share: Vector
    """Share of the listener's messages that relay the reception."""
    delay_m: Vector
    """Delay by walls."""


def relays_of(
    anchors_m: Matrix, master: int | None, clocks: AnchorClocks, budget: Vector, barriers: Barriers
) -> Relays:
    """The relays of a site's superframe; each frame carries as many of the latest receptions as fit.

    ``anchors_m``: shape (anchors, 3); ``master``: row of the master, whose packets have a separate field.
    """
    share, delay_m = links(anchors_m, anchors_m, budget, barriers)
    share *= clocks.kept * (clocks.sends & clocks.sends[:, None])
    if master is None:
        capacity = master_capacity = beacon.heard_capacity(position=True)
    else:
        capacity = protocol1_codec.heard_capacity(master_heard=True, master_time=True, page=True)
        master_capacity = protocol1_codec.heard_capacity(master_heard=False, master_time=True, page=True)
    ends, rows = [], []
    for k, listener in enumerate(clocks.sender.tolist()):
        fits = master_capacity if listener == master else capacity
        for sender, age_s, part in _relayed(clocks, k, share[listener], master, fits):
            rows.append((sender, age_s, part, delay_m[listener, sender]))
        ends.append(len(rows))
    columns = np.array(rows).reshape(-1, 4).T
    return Relays(np.array(ends, np.int64), columns[0].astype(np.int64), *(column.copy() for column in columns[1:]))


def _relayed(
    clocks: AnchorClocks, k: int, share: Vector, master: int | None, capacity: int
) -> Iterator[tuple[int, float, float]]:
    """Relays in message k: sender, time since it sent, and share of the messages that relay it.

    Goes back to the same anchor's previous message: a packet is relayed if it was received and fewer later ones were
    received than fit. If an anchor sent several, only the last one counts.
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
        if part >= MIN_SHARE:
            yield sender, age_s, part


# Reception of the master, and choice of the best master


_RELIABLE: Final = 0.9
"""An anchor should receive at least this share of the master's frames; losing a tenth hardly matters to its clock."""

_MAX_NAMED: Final = 8  # anchors named in one warning


class MasterReception(Struct, frozen=True):
    """Reception of the master by the anchors of a site, in the order of its file; shape (anchors,) each."""

    distance_m: Vector
    """Distance from the master."""
    share: Vector
    """Share of the master's frames that arrives; 1 for the master itself."""
    sends: Mask
    """Whether the anchor's clock is known well enough to send."""


def reception_of(site: Site, channel: ChannelModel) -> MasterReception:
    """Predict the anchors' reception of their master, with the losses of the site's walls."""
    anchors_m, master = anchor_positions(site), row_of_master(site)
    share = anchor_links(anchors_m, master, link_budget(channel), barriers_of(site.walls, site.storeys)).share
    return MasterReception(
        np.linalg.norm(anchors_m - anchors_m[master], axis=1), share, anchor_clocks(site, share).sends
    )


def with_best_master(site: Site, channel: ChannelModel) -> Site:
    """The same site with the master that the others receive best; among equals the most central one."""
    best = _masters(site, channel)[0]
    return replace(site, master=site.anchors[best].id)


def master_warnings(site: Site, channel: ChannelModel) -> list[str]:
    """Warn of anchors that receive the master badly, so that their clock is poor or they stay silent.

    Names a better master, if there is one.
    """
    if not site.schedule.needs_master:
        return []
    found = reception_of(site, channel)
    poor = found.share < _RELIABLE
    silent, late = np.flatnonzero(~found.sends), np.flatnonzero(found.sends & poor)
    both = (
        _named(site, found, silent, "stay silent", "stays silent"),
        _named(site, found, late, "follow its clock badly", "follows its clock badly"),
    )
    warnings = [text for text in both if text]
    if not warnings:
        return []
    best = int(_masters(site, channel)[0])
    other = replace(site, master=site.anchors[best].id)
    left = int((reception_of(other, channel).share < _RELIABLE).sum())
    if left < int(poor.sum()):
        receive = f"all would receive {_RELIABLE:.0%} or more" if left == 0 else f"{left} would receive it that badly"
        warnings[0] += f"; with anchor {other.master} as the master {receive}"
    return warnings


def _named(site: Site, found: MasterReception, rows: Integers, do: str, does: str) -> str:
    """One sentence for all these anchors, each with its share, the worst first; empty without any."""
    if len(rows) == 0:
        return ""
    rows = rows[np.argsort(found.share[rows].round(2), kind="stable")]
    first = rows[0]
    if len(rows) == 1:
        where = f"{found.distance_m[first]:.0f} m from the master"
        return f"anchor {site.anchors[first].id}, {where}, receives {found.share[first]:.0%} of its frames and {does}"
    each = [f"{site.anchors[row].id} ({found.share[row]:.0%})" for row in rows[:_MAX_NAMED]]
    more = f" and {len(rows) - _MAX_NAMED} more" if len(rows) > _MAX_NAMED else ""
    nearest_m = float(found.distance_m[rows].min())
    listed = ", ".join(each) + more
    return f"anchors {listed}, {nearest_m:.0f} m or more from the master, receive this share of its frames and {do}"


def _masters(site: Site, channel: ChannelModel) -> Integers:
    anchors_m: Matrix = anchor_positions(site)
    return masters_by_links(anchors_m, link_budget(channel), barriers_of(site.walls, site.storeys))
