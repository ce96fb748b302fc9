"""Anchors that compose one timeline over many hops: the arithmetic of ``clocks/composed_time.py`` in one kernel.

For studies of hundreds of anchors over minutes. Collisions are left out; a reception is lost by chance alone. A test
compares it with ``ComposedTime``, beacon by beacon.
"""

import math
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.clocks.composition import (
    AVERAGING_S,
    GRID_VARIANCE_M2,
    MAX_SLOT_STD_M,
    MEAN_LATE_TICKS,
    SLOT_GAIN,
    by_parent,
)
from skyless.clocks.filter import MAX_RELATIVE_RATE, clock_noise, stamp_variance_m2
from skyless.constants import (
    DELAYED_TX_GRANULARITY_TICKS,
    SPEED_OF_LIGHT_MPS,
    SUBTICKS,
    TICK_M,
    TICK_RATE_HZ,
    TICK_S,
)
from skyless.kernels.arrays import Array, Integers, Mask, Matrix, Records
from skyless.kernels.compiled import jitted, kernel, part, step
from skyless.kernels.two_state import predict, update
from skyless.simulation.oscillator import OscillatorModel, advance, emit, make_clocks
from skyless.simulation.streams import ANCHOR_KEY, Streams, draw_normal, stream

MOST_PARENTS: Final = 3

jitted(predict)
jitted(update)

_START_RATE_VARIANCE: Final = (MAX_RELATIVE_RATE * SPEED_OF_LIGHT_MPS) ** 2

LINK: Final = np.dtype(
    [
        ("parent", np.int64),
        ("range_m", np.float64),
        ("updates", np.int64),
        ("tx_ticks", np.int64),
        ("rx_ticks", np.int64),
        ("whole_offset", np.int64),
        ("offset_m", np.float64),
        ("rate_mps", np.float64),
        ("variance", np.float64),
        ("covariance", np.float64),
        ("rate_variance", np.float64),
        ("subticks", np.int64),  # timeline at tx_ticks, in 1/256 tick
        ("statements", np.int64),
        ("parent_rate", np.float64),
        ("stated_variance", np.float64),
        ("weight", np.float64),
    ],
    align=True,
)
"""One parent of an anchor: the pair's filter, and the parent's line of the timeline."""

SITE_MAP: Final = np.dtype(
    [
        ("known", np.bool_),
        ("ticks_own", np.int64),
        ("subticks", np.int64),
        ("rate", np.float64),
        ("age_s", np.float64),  # of the parents' statements at ticks_own
        ("delay_s", np.float64),  # its mean over time
    ],
    align=True,
)
"""An anchor's own counter against the timeline."""


class Network(Struct, frozen=True):
    """Who listens to whom, and when each speaks; anchors are numbered, the root is 0."""

    hops: Integers
    """Links from the root to each anchor, shape (anchors,)."""
    parents: Integers
    """Up to three anchors one hop nearer to the root, the nearest first, -1 for none; shape (anchors, 3)."""
    ranges_m: Matrix
    """Distances to them, same shape."""
    slots: Integers
    """Slot of each anchor, shape (anchors,)."""
    neighbours: Integers
    """Pairs of anchors in range of each other, shape (pairs, 2)."""
    schedule_slots: int
    slot_ticks: int


class Errors(Struct, frozen=True):
    """What came out at the sampled instants; all anchors at the same true time."""

    error_m: Matrix
    """Own timeline less the root's, shape (samples, anchors)."""
    std_m: Matrix
    """Standard deviation that the anchor itself computes, same shape."""


def network(positions_m: Matrix, range_m: float, slots: int, slot_s: float, generator: np.random.Generator) -> Network:
    """Hops from anchor 0, parents by hop and distance, and random slots, different in range of each other.

    Raises:
        ValueError: an anchor cannot be reached, or the slots are too few.
    """
    count = len(positions_m)
    apart = np.linalg.norm(positions_m[:, None] - positions_m[None], axis=2)
    near = (apart <= range_m) & ~np.eye(count, dtype=bool)
    hops = np.full(count, -1)
    hops[0] = 0
    edge = [0]
    while edge:
        reached = np.flatnonzero(near[edge].any(axis=0) & (hops < 0))
        hops[reached] = hops[edge[0]] + 1
        edge = [int(anchor) for anchor in reached]
    if (hops < 0).any():
        raise ValueError(f"anchor {int(np.argmax(hops < 0))} cannot be reached from anchor 0 over {range_m} m")
    parents = np.full((count, MOST_PARENTS), -1)
    ranges_m = np.zeros((count, MOST_PARENTS))
    for anchor in range(count):
        nearer = np.flatnonzero(near[anchor] & (hops == hops[anchor] - 1))
        chosen = nearer[np.argsort(apart[anchor, nearer], kind="stable")][:MOST_PARENTS]
        parents[anchor, : len(chosen)] = chosen
        ranges_m[anchor, : len(chosen)] = apart[anchor, chosen]
    taken = np.full(count, -1)
    for anchor in generator.permutation(count):
        free = np.setdiff1d(np.arange(slots), taken[near[anchor]])
        if len(free) == 0:
            raise ValueError(f"{slots} slots are too few for {range_m} m")
        taken[anchor] = generator.choice(free)
    pairs = np.argwhere(np.triu(near))
    grid = DELAYED_TX_GRANULARITY_TICKS
    return Network(hops, parents, ranges_m, taken, pairs, slots, round(slot_s * TICK_RATE_HZ / grid) * grid)


def simulate(
    net: Network,
    oscillators: OscillatorModel,
    stamp_s: float,
    *,
    lost: float,
    seconds: float,
    settling_s: float,
    sample_s: float,
    site_time: bool,
    seed: int,
) -> Errors:
    """Errors of every anchor's timeline, sampled every ``sample_s`` after ``settling_s``."""
    count = len(net.hops)
    generators = [stream(seed, ANCHOR_KEY, anchor) for anchor in range(count)]
    clocks = make_clocks(oscillators, generators)
    streams = Streams(generators)
    luck = stream(seed, ANCHOR_KEY, count)
    links = np.zeros((count, MOST_PARENTS), dtype=LINK)
    links["parent"], links["range_m"] = net.parents, net.ranges_m
    maps = np.zeros(count, dtype=SITE_MAP)
    maps["known"][0] = True
    maps["ticks_own"][0] = clocks["local_ticks"][0]
    children, entries = _children(net.parents)
    order = np.argsort(net.slots, kind="stable")
    noise = clock_noise(oscillators.white_fm, oscillators.random_walk_fm)
    variance_m2 = 2.0 * stamp_variance_m2(stamp_s, rounded=False) + stamp_variance_m2(0.0, rounded=True)
    superframe_ticks = net.schedule_slots * net.slot_ticks
    superframe_s = superframe_ticks * TICK_S
    every = max(1, round(sample_s / superframe_s))
    settling = round(settling_s / superframe_s)
    samples: list[tuple[Array, Array]] = []
    for superframe in range(1, settling + round(seconds / superframe_s)):
        run_superframe(
            clocks,
            streams.normals,
            streams.cursors,
            links,
            maps,
            net.hops,
            order,
            net.slots,
            children,
            entries,
            luck.random(links.shape) >= lost,
            superframe * superframe_ticks,
            net.slot_ticks,
            superframe_s,
            stamp_s / TICK_S,
            variance_m2,
            noise.white,
            noise.walk,
            site_time,
        )
        if superframe >= settling and superframe % every == 0:
            samples.append(_sample(clocks, streams, links, maps, net, noise.white, noise.walk))
        streams.refill(int(streams.cursors.max()))
    return Errors(np.array([error for error, _ in samples]), np.array([std for _, std in samples]))


def _children(parents: Integers) -> tuple[Integers, Integers]:
    """Links by sender: where each anchor's begin, shape (anchors + 1,), and (child, number), shape (links, 2)."""
    found = np.argwhere(parents >= 0)
    senders = parents[parents >= 0]
    sorted_by = np.argsort(senders, kind="stable")
    return np.searchsorted(senders[sorted_by], np.arange(len(parents) + 1)), found[sorted_by]


def _sample(
    clocks: Records,
    streams: Streams,
    links: Records,
    maps: Records,
    net: Network,
    white: float,
    walk: float,
) -> tuple[Array, Array]:
    error_m, std_m = np.empty(len(maps)), np.empty(len(maps))
    true_ticks = int(clocks["true_ticks"].max()) + round(net.slot_ticks / 2)
    sample(
        clocks, streams.normals, streams.cursors, links, maps, net.hops, true_ticks, white, walk,
        error_m, std_m,
    )  # fmt: skip
    return error_m, std_m


@kernel
def run_superframe(
    clocks: Records,
    normals: Array,
    cursors: Integers,
    links: Records,
    maps: Records,
    hops: Integers,
    order: Integers,
    slots: Integers,
    children: Integers,
    entries: Integers,
    received: Mask,
    start_ticks: int,
    slot_ticks: int,
    superframe_s: float,
    noise_ticks: float,
    variance_m2: float,
    white: float,
    walk: float,
    site_time: bool,
) -> None:
    """Let every anchor that knows the timeline speak in its slot, and its children receive it."""
    for sender in order:
        if not maps[sender]["known"]:
            continue
        nominal = (start_ticks + slots[sender] * slot_ticks) * SUBTICKS
        tx_ticks = ticks_own(maps, sender, nominal)
        tx_ticks -= tx_ticks % DELAYED_TX_GRANULARITY_TICKS
        stated_variance = 0.0
        if hops[sender] > 0:
            stated_variance = variance_of(links, maps, hops, sender, tx_ticks, white, walk)
            if stated_variance > MAX_SLOT_STD_M**2:
                continue
        true_ticks, true_fraction = emit(clocks, normals, cursors, sender, tx_ticks, noise_ticks, 0.0)
        stated = timeline(maps, sender, tx_ticks)
        for entry in range(children[sender], children[sender + 1]):
            child, number = entries[entry]
            if not received[child, number]:
                continue
            link = links[child, number]
            arrival = true_fraction + link["range_m"] / TICK_M
            steps = math.floor(arrival)
            advance(clocks, normals, cursors, child, true_ticks + int(steps), arrival - steps)
            noise = noise_ticks * draw_normal(normals, cursors, child)
            rx_ticks = clocks[child]["local_ticks"] + math.floor(clocks[child]["local_fraction"] + noise + 0.5)
            span = tx_ticks - link["tx_ticks"]
            compare(links, child, number, tx_ticks, rx_ticks, variance_m2, white, walk)
            read(
                links,
                child,
                number,
                span,
                nominal,
                stated,
                stated_variance,
                maps[sender]["rate"],
                hops[sender],
                site_time,
            )
            renew(links, maps, hops, child, rx_ticks, superframe_s, white, walk)


@kernel
def sample(
    clocks: Records,
    normals: Array,
    cursors: Integers,
    links: Records,
    maps: Records,
    hops: Integers,
    true_ticks: int,
    white: float,
    walk: float,
    error_m: Array,
    std_m: Array,
) -> None:
    """Timeline of all anchors at one true time, less the root's; NaN where it is not known."""
    advance(clocks, normals, cursors, 0, true_ticks, 0.0)
    root = timeline(maps, 0, clocks[0]["local_ticks"])
    root_fraction = clocks[0]["local_fraction"]
    error_m[0] = std_m[0] = 0.0
    for anchor in range(1, len(maps)):
        advance(clocks, normals, cursors, anchor, true_ticks, 0.0)
        ticks = clocks[anchor]["local_ticks"]
        if not maps[anchor]["known"]:
            error_m[anchor] = std_m[anchor] = math.nan
            continue
        whole = timeline(maps, anchor, ticks) - root
        error_m[anchor] = (whole / SUBTICKS + clocks[anchor]["local_fraction"] - root_fraction) * TICK_M
        std_m[anchor] = math.sqrt(variance_of(links, maps, hops, anchor, ticks, white, walk))


@part
def timeline(maps: Records, anchor: int, ticks: int) -> int:
    """Timeline of an own reading in 1/256 tick."""
    elapsed = (ticks - maps[anchor]["ticks_own"]) * SUBTICKS
    rate = maps[anchor]["rate"]
    gained: int = maps[anchor]["subticks"] + elapsed - round(elapsed * (rate / (1.0 + rate)))
    return gained


@part
def ticks_own(maps: Records, anchor: int, subticks: int) -> int:
    """Nearest own reading of a time of the timeline."""
    elapsed = subticks - maps[anchor]["subticks"]
    ticks: int = maps[anchor]["ticks_own"] + round((elapsed + elapsed * maps[anchor]["rate"]) / SUBTICKS)
    return ticks


@step
def compare(
    links: Records, child: int, number: int, tx_ticks: int, rx_ticks: int, variance_m2: float, white: float, walk: float
) -> None:
    """The pair's filter, as ``ClockFilter.update`` without its gate."""
    link = links[child, number]
    if link["updates"] == 0:
        link["whole_offset"] = rx_ticks - tx_ticks
        link["offset_m"], link["rate_mps"] = -link["range_m"], 0.0
        link["variance"], link["covariance"], link["rate_variance"] = variance_m2, 0.0, _START_RATE_VARIANCE
    else:
        dt_s = (tx_ticks - link["tx_ticks"]) * TICK_S
        offset_m = link["offset_m"] + link["rate_mps"] * dt_s
        predicted = predict((link["variance"], link["covariance"], link["rate_variance"]), dt_s, white, walk)
        innovation = (rx_ticks - tx_ticks - link["whole_offset"]) * TICK_M - link["range_m"] - offset_m
        gain, rate_gain, updated = update(predicted, variance_m2)
        offset_m += gain * innovation
        link["rate_mps"] += rate_gain * innovation
        link["variance"], link["covariance"], link["rate_variance"] = updated
        steps = math.floor(offset_m / TICK_M)
        link["offset_m"] = offset_m - steps * TICK_M
        link["whole_offset"] += int(steps)
    link["updates"] += 1
    link["tx_ticks"], link["rx_ticks"] = tx_ticks, rx_ticks


@step
def read(
    links: Records,
    child: int,
    number: int,
    span_ticks: int,
    nominal: int,
    stated: int,
    stated_variance: float,
    parent_rate: float,
    parent_hop: int,
    site_time: bool,
) -> None:
    """The parent's line, as ``ComposedTime`` follows it."""
    link = links[child, number]
    gain = 1.0
    if not site_time:
        stated = nominal - MEAN_LATE_TICKS * SUBTICKS
        gain = max(1.0 / (link["statements"] + 1), SLOT_GAIN)
        stated_variance = (parent_hop + 1) * GRID_VARIANCE_M2 * gain / (2.0 - gain)
    if link["statements"] == 0:
        link["subticks"] = stated
    else:
        span = span_ticks * SUBTICKS
        before = link["parent_rate"]
        predicted = link["subticks"] + span - round(span * (before / (1.0 + before)))
        link["subticks"] = predicted + round(gain * (stated - predicted))
    link["statements"] += 1
    link["parent_rate"], link["stated_variance"] = parent_rate, stated_variance


@step
def variance_of(
    links: Records,
    maps: Records,
    hops: Integers,
    anchor: int,
    ticks: int,
    white: float,
    walk: float,
) -> float:
    """Variance of the timeline at an own reading, as ``ComposedTime.variance_m2``."""
    total = 0.0
    own = maps[anchor]
    for number in range(MOST_PARENTS):
        link = links[anchor, number]
        weight = link["weight"]
        if weight > 0.0:
            common, alone = by_parent(
                link["stated_variance"],
                hops[link["parent"]],
                (ticks - link["rx_ticks"]) * TICK_S,
                own["delay_s"],
                (link["variance"], link["covariance"], link["rate_variance"]),
                white,
                walk,
            )
            total += weight * (common + weight * alone)
    return total


@step
def renew(
    links: Records,
    maps: Records,
    hops: Integers,
    anchor: int,
    ticks: int,
    superframe_s: float,
    white: float,
    walk: float,
) -> None:
    """The own map from the mean over all parents, as ``ComposedTime`` renews it after a beacon of one of them."""
    own = maps[anchor]
    if own["known"]:
        elapsed_s = (ticks - own["ticks_own"]) * TICK_S
        own["delay_s"] += min(elapsed_s / AVERAGING_S, 1.0) * (own["age_s"] + 0.5 * elapsed_s - own["delay_s"])
    else:
        own["delay_s"] = 0.5 * superframe_s
    base, count = -1, 0
    total = mean = mean_rate = age_s = 0.0
    for number in range(MOST_PARENTS):
        link = links[anchor, number]
        link["weight"] = 0.0
        if link["statements"] == 0:
            continue
        common, alone = by_parent(
            link["stated_variance"],
            hops[link["parent"]],
            (ticks - link["rx_ticks"]) * TICK_S,
            own["delay_s"],
            (link["variance"], link["covariance"], link["rate_variance"]),
            white,
            walk,
        )
        weight = 1.0 / (common + alone)
        link["weight"] = weight
        pair_rate, parent_rate = link["rate_mps"] / SPEED_OF_LIGHT_MPS, link["parent_rate"]
        elapsed = ((ticks - link["whole_offset"] - link["tx_ticks"]) - link["offset_m"] / TICK_M) / (1.0 + pair_rate)
        whole = math.floor(elapsed)
        elapsed_subticks = int(whole) * SUBTICKS - round(whole * SUBTICKS * (parent_rate / (1.0 + parent_rate)))
        line = link["subticks"] + elapsed_subticks
        if base < 0:
            base = line
        subticks = (line - base) + (elapsed - whole) * SUBTICKS
        total += weight
        mean += weight * subticks
        mean_rate += weight * ((1.0 + pair_rate) * (1.0 + parent_rate) - 1.0)
        age_s += (ticks - link["rx_ticks"]) * TICK_S
        count += 1
    for number in range(MOST_PARENTS):
        links[anchor, number]["weight"] /= total
    mean /= total
    own["age_s"] = age_s / count
    own["known"], own["ticks_own"], own["rate"] = True, ticks, mean_rate / total
    own["subticks"] = base + math.floor(mean + 0.5)
