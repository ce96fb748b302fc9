"""A site's anchors in planning: the messages of a superframe, their relays, and the reception of the master."""

import math
from collections.abc import Iterator
from statistics import median
from typing import Final, NamedTuple

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air import beacon
from skyless.core.air.frame import MAX_FRAME_BYTES, air_time_s
from skyless.core.any_anchor import beacon_period_s
from skyless.core.arrays import Integers, Mask, Matrix, Vector
from skyless.core.clock_filter import (
    ClockNoise,
    TwoState,
    clock_noise,
    predict,
    predicted_value_variance,
    stamp_variances_m2,
    update,
)
from skyless.core.geometry import anchor_positions, anchors_in_reach
from skyless.core.protocol1 import beacon as protocol1_codec
from skyless.core.protocol1.anchor import MAX_OFFSET_STD_M
from skyless.core.protocol1.beacon import first_slots, schedule_of
from skyless.core.site import Site
from skyless.core.ticks import TICK_S
from skyless.site.channel import Barriers, ChannelModel, barriers_of
from skyless.site.planning.links import MIN_SYNC, link_budget, links, master_links, masters_by_links

MIN_SHARE: Final = 0.01
"""Receptions that are relayed more rarely are ignored."""

_START_RATE_VARIANCE: Final = 144.0  # m²/s²; the steady state does not depend on it
_STEADY_CHANGE: Final = 1e-7
_MAX_TURNS: Final = 20_000  # frames of the master after which a clock filter counts as steady in any case


class Superframe(NamedTuple):
    """The messages of one superframe: senders and times."""

    sent: Vector
    """Share of each anchor's messages that is sent and not lost to collisions; shape (anchors,)."""
    sender: Integers
    """Row of the sending anchor; shape (messages,)."""
    gap_s: Vector
    """Time since the previous message."""


def superframe_of(site: Site, share: Vector) -> Superframe:
    """Superframe of anchors, in the order of the file, that receive these shares of the master's messages.

    Anchors without a master are assumed to send one after the other, the average of random instants; a message arrives
    if no other anchor in reach begins one within its length before or after.
    """
    if not site.schedule.needs_master:
        count, period_s = len(site.anchors), beacon_period_s(site)
        rivals = median(anchors_in_reach(site).tolist()) - 1.0
        kept = math.exp(-2.0 * air_time_s(MAX_FRAME_BYTES) * rivals / period_s)
        return Superframe(np.full(count, kept), np.arange(count), np.full(count, period_s / count))
    schedule, first = schedule_of(site), first_slots(site)
    sends = _send(site, share)
    order = sorted(
        (slot, row) for row, one in enumerate(site.anchors) if sends[row] for slot in schedule.slots_of(first[one.id])
    )
    slots, sender = np.array(order, np.int64).T
    gap_slots = np.diff(slots, prepend=slots[-1] - schedule.slots)
    return Superframe(sends.astype(np.float64), sender, gap_slots * schedule.slot_ticks * TICK_S)


def row_of_master(site: Site) -> int:
    """Index of the master among the anchors."""
    return [anchor.id for anchor in site.anchors].index(site.master)


def stamp_variances(site: Site) -> tuple[float, float]:
    """Variances, m², of a TX stamp and of an RX stamp with its rounding."""
    return stamp_variances_m2(site.noise.tx_stamp_ps * 1e-12, site.noise.rx_stamp_ps * 1e-12)


def _send(site: Site, share: Vector) -> Mask:
    """Whether each anchor knows its clock well enough to send, from the steady state of its clock filter."""
    schedule, first = schedule_of(site), first_slots(site)
    turn = schedule.slots // schedule.frames_per_node
    slot_s, master = schedule.slot_ticks * TICK_S, first[site.master]
    variance, noise = sum(stamp_variances(site)), clock_noise(site.noise.white_fm, site.noise.random_walk_fm)
    sends = share >= MIN_SYNC
    clocks = {part: steady_clock(part, turn * slot_s, variance, noise) for part in set(share[sends].tolist())}
    for row in np.flatnonzero(sends).tolist():
        anchor = site.anchors[row].id
        after_s = (first[anchor] - master) % turn * slot_s
        stated_m2 = predicted_value_variance(clocks[share[row]], after_s, noise.white, noise.walk)
        sends[row] = anchor == site.master or stated_m2 <= MAX_OFFSET_STD_M**2
    return sends


def steady_clock(share: float, turn_s: float, variance: float, noise: ClockNoise) -> TwoState:
    """Covariance of an anchor's clock filter after the master's frame, of which it receives this share."""
    P = variance, 0.0, _START_RATE_VARIANCE
    for _ in range(_MAX_TURNS):
        before = predict(P, turn_s, noise.white, noise.walk)
        _, _, after = update(before, variance)
        last = P[0]
        P = (
            before[0] + share * (after[0] - before[0]),
            before[1] + share * (after[1] - before[1]),
            before[2] + share * (after[2] - before[2]),
        )
        if abs(P[0] - last) <= _STEADY_CHANGE * share * P[0]:
            break
    return P


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
    anchors_m: Matrix, master: int | None, superframe: Superframe, budget: Vector, barriers: Barriers
) -> Relays:
    """The relays of a site's superframe; each frame carries as many of the latest receptions as fit.

    ``anchors_m``: shape (anchors, 3); ``master``: row of the master, whose packets have a separate field.
    """
    share, delay_m = links(anchors_m, anchors_m, budget, barriers)
    share *= superframe.sent
    ends, rows = [], []
    for k, listener in enumerate(superframe.sender.tolist()):
        if master is None:
            fits = beacon.heard_capacity(position=True)
        else:
            fits = protocol1_codec.heard_capacity(master_heard=listener != master, master_time=True, page=True)
        for sender, age_s, part in _relayed(superframe, k, share[listener], master, fits):
            rows.append((sender, age_s, part, delay_m[listener, sender]))
        ends.append(len(rows))
    columns = np.array(rows).reshape(-1, 4).T
    return Relays(np.array(ends, np.int64), columns[0].astype(np.int64), *(column.copy() for column in columns[1:]))


def _relayed(
    superframe: Superframe, k: int, share: Vector, master: int | None, capacity: int
) -> Iterator[tuple[int, float, float]]:
    """Relays in message k: sender, time since it sent, and share of the messages that relay it.

    Goes back to the same anchor's previous message: a packet is relayed if it was received and fewer later ones were
    received than fit. If an anchor sent several, only the last one counts.
    """
    fewer = np.zeros(capacity + 1)  # element i: probability that i − 1 later packets were received
    fewer[1] = 1.0
    seen, age_s = {int(superframe.sender[k])}, 0.0
    for back in range(1, len(superframe.sender)):
        age_s += float(superframe.gap_s[k - back + 1])
        sender = int(superframe.sender[k - back])
        if sender == superframe.sender[k]:
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
    share = master_links(anchors_m, master, link_budget(channel), barriers_of(site.walls, site.storeys))
    sent = superframe_of(site, share).sent
    return MasterReception(np.linalg.norm(anchors_m - anchors_m[master], axis=1), share, sent > 0.0)


def with_best_master(site: Site, channel: ChannelModel) -> Site:
    """The same site with the master that the others receive best; among equals the most central one."""
    return replace(site, master=site.anchors[_masters(site, channel)[0]].id)


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
    other = replace(site, master=site.anchors[int(_masters(site, channel)[0])].id)
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
