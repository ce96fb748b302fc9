"""What tests of the estimator share: anchors, episodes of stamps, settings that fit them, an estimator that has begun.

An episode is one walking tag, one packet of each anchor in a superframe. Oscillators have white and random-walk
frequency noise, every TX stamp an error that all who receive the packet share, every RX stamp its own; stamps are
whole ticks. Anchors relay in their next packet whom they received since the one before.
"""

from types import SimpleNamespace

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.lib.recfunctions import repack_fields

from skyless.core.estimator.estimator import Estimator, Packets
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import FAULT_KINDS, covariances
from skyless.core.native.views import view
from skyless.core.tag.joint import Observation
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M
from skyless.research.studies.efficiency import EPISODE_SPEED_STD_MPS, WHITE_FM, random_path
from skyless.sim.lab import paper_lab_site

SLOT_S = paper_lab_site().schedule.slot_s
LAB_M = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in paper_lab_site().anchors])
CORNERS_M = [(0, 0), (4, 0), (8, 0), (8, 3), (8, 6), (4, 6), (0, 6), (0, 3)]
ROOM_M = np.array([(x, y, 2.5 if k % 2 else 0.5) for k, (x, y) in enumerate(CORNERS_M)], float)
"""Eight anchors at alternating heights."""

EXACT = {"survey_std_m": 0.0, "range_std_m": 0.0, "slope_std_m": 0.0, "place_std_m": 0.0}
BIASED = {"survey_std_m": 0.02, "range_std_m": 0.03, "slope_std_m": 0.05, "place_std_m": 0.005}
"""Errors of survey and ranges that a real room has."""


class Case(Struct, frozen=True):
    noise_ps: float = 100.0
    """Of a stamp, TX and RX alike."""
    random_walk_fm: float = 1e-9
    qa: float = 0.5
    mesh: bool = True
    """Whether all anchors relay whom they receive, not only the first one's packets."""


PLAIN, MESH = Case(mesh=False), Case()


class Episode(Struct, frozen=True):
    packets: Packets
    path_m: np.ndarray
    """The tag's place at each packet, shape (n, 3)."""


def episode_of(case=MESH, superframes=40, seed=1, anchors_m=LAB_M, rate_of=None, path_m=None, slot_s=SLOT_S):
    """``rate_of``: what the tag's clock does besides, m/s at times; ``path_m``: the way, at random if None."""
    draw, n = np.random.default_rng(seed), len(anchors_m)
    frames = superframes * n
    low, high = anchors_m[:, :2].min(axis=0), anchors_m[:, :2].max(axis=0)
    drawn_m = random_path(draw, (low + high) / 2.0, (high - low) / 4.0, slot_s, frames, case.qa)
    path_m = drawn_m if path_m is None else path_m
    senders, time_s = np.arange(frames) % n, np.arange(frames) * slot_s
    offsets, rates = clocks(draw, frames, n + 1, case.random_walk_fm, slot_s)
    if rate_of is not None:
        extra = rate_of(time_s)
        rates[:, n] += extra
        offsets[:, n] += np.concatenate([[0.0], np.cumsum(0.5 * (extra[1:] + extra[:-1]) * slot_s)])
    noise_m = case.noise_ps * 1e-12 * SPEED_OF_LIGHT_MPS
    ideal = time_s * SPEED_OF_LIGHT_MPS + offsets[np.arange(frames), senders]
    tx_ticks = ticks(ideal)
    left = tx_ticks * TICK_M - ideal + noise_m * draw.normal(size=frames)
    between = np.linalg.norm(anchors_m[:, None] - anchors_m[None], axis=2)
    way = np.column_stack([between[senders], np.linalg.norm(path_m - anchors_m[senders], axis=1)])
    arrived = (left[:, None] + way) * (1.0 + rates / SPEED_OF_LIGHT_MPS)
    noise = noise_m * draw.normal(size=(frames, n + 1))
    rx_ticks = ticks((time_s * SPEED_OF_LIGHT_MPS)[:, None] + offsets + arrived + noise)
    relays, ends = relays_of(rx_ticks, senders, n, case)
    packets = Packets(senders, np.arange(frames) // n % 256, rx_ticks[:, n].copy(), tx_ticks, relays, ends)
    return Episode(packets, path_m)


def ticks(metres):
    return np.rint(metres / TICK_M).astype(np.int64)


def clocks(draw, frames, count, random_walk_fm, slot_s=SLOT_S):
    """Offsets in metres and rates in m/s at every frame, shape (frames, count)."""
    light = SPEED_OF_LIGHT_MPS
    kicks = draw.normal(size=(2, frames - 1, count))
    walks = kicks[0] * (random_walk_fm * light * np.sqrt(slot_s))
    own = kicks[1] * (light * np.sqrt(slot_s * (WHITE_FM**2 + random_walk_fm**2 * slot_s**2 / 12.0)))
    rates = np.empty((frames, count))
    rates[0] = draw.uniform(-10.0, 10.0, count) * (1e-6 * light)
    rates[1:] = rates[0] + np.cumsum(walks, axis=0)
    offsets = np.empty((frames, count))
    offsets[0] = draw.uniform(0.0, 1e6, count)
    offsets[1:] = offsets[0] + np.cumsum(rates[:-1] * slot_s + walks * (slot_s / 2.0) + own, axis=0)
    return offsets, rates


def relays_of(rx_ticks, senders, n, case):
    """Each anchor's receptions since its packet before, and where those of each packet end."""
    frames, rows = np.arange(len(senders)), []
    for back in range(1, n):
        known = (frames >= back) & (case.mesh | (senders[frames - back] == 0))
        at, of = frames[known], frames[known] - back
        rows.append(np.column_stack([at, senders[at], senders[of], of // n % 256, rx_ticks[of, senders[at]]]))
    table = np.concatenate(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return np.ascontiguousarray(table[:, 1:]), np.searchsorted(table[:, 0], frames, side="right")


def settings_of(case=MESH, height_m=0.0, **others):
    """Settings of the very noise that a case's episodes have, and of an exact site."""
    light2 = SPEED_OF_LIGHT_MPS**2
    stamp = light2 * (case.noise_ps * 1e-12) ** 2
    noise = {"qa": case.qa, "white": light2 * WHITE_FM**2, "walk": light2 * case.random_walk_fm**2}
    stamps = {"tx_variance_m2": stamp, "rx_variance_m2": stamp + TICK_M**2 / 12.0}
    return EstimatorSettings(**{**noise, **stamps, "height_m": height_m, **EXACT, **others})


def begun(episode, settings, anchors_m=LAB_M, std_m=0.3, seed=2, off=1.0):
    """An estimator that begins ``off·std_m`` off, and takes it for ``std_m``."""
    estimator, dim = Estimator(settings, anchors_m), settings.dim
    start_m = episode.path_m[0, :dim] + np.random.default_rng(seed).normal(0.0, off * std_m, dim)
    estimator.start(int(episode.packets.rx_ticks[0]), start_m, std_m**2 * np.eye(dim), EPISODE_SPEED_STD_MPS**2)
    return estimator


class Run(Struct, frozen=True):
    """What an estimator said after every packet."""

    estimator: Estimator
    motions: np.ndarray
    covariances: np.ndarray
    """Of the position, shape (n, dim, dim)."""
    levels: np.ndarray
    outcomes: np.ndarray
    integrity: np.ndarray

    def errors(self, episode):
        dim = self.estimator.dim
        return self.motions[:, :dim] - episode.path_m[: len(self.motions), :dim]


def tracked(estimator, packets):
    rows, dim = estimator.track(packets, has_levels=True), estimator.dim
    motions = np.concatenate([rows["position_m"][:, :dim], rows["velocity_mps"][:, :dim]], axis=1)
    return Run(
        estimator, motions, rows["covariance_m2"][:, :dim, :dim], rows["levels"], rows["outcome"], rows["integrity"]
    )


def rmse(errors):
    return float(np.sqrt(np.square(errors).sum(axis=1).mean()))


def nees(errors, covariances):
    """Over its degrees of freedom."""
    return float(np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors).mean() / errors.shape[1])


def one_by_one(packets):
    """What ``Estimator.process`` takes, packet by packet."""
    begins = [0, *packets.ends[:-1].tolist()]
    for k, (begin, end) in enumerate(zip(begins, packets.ends.tolist(), strict=True)):
        columns = (packets.anchors, packets.sequences, packets.rx_ticks, packets.tx_ticks)
        yield (*(int(column[k]) for column in columns), packets.relays[begin:end, 1:].tolist())


def owners(packets):
    """Of each relay the packet that it came with."""
    return np.repeat(np.arange(len(packets.anchors)), np.diff(packets.ends, prepend=0))


def kept(packets, keep):
    """The packets for which ``keep``, shape (n,), is true, with their relays."""
    columns = (packets.anchors, packets.sequences, packets.rx_ticks, packets.tx_ticks)
    ends = np.cumsum(np.diff(packets.ends, prepend=0)[keep])
    return Packets(*(column[keep] for column in columns), packets.relays[keep[owners(packets)]], ends)


def late(packets, late_m):
    """The tag's receptions late by so much, shape (n,)."""
    return replace(packets, rx_ticks=packets.rx_ticks + ticks(np.asarray(late_m)))


def late_from(packets, anchor, metres, begin=0, end=1 << 60):
    """One anchor's packets late for the tag from one packet to another."""
    frames = np.arange(len(packets.anchors))
    return late(packets, np.where((packets.anchors == anchor) & (frames >= begin) & (frames < end), metres, 0.0))


def jumped(packets, anchor, begin, metres):
    """An anchor's clock jumps: its TX stamps, and the RX stamps that it relays from then on."""
    at, relays = np.arange(len(packets.anchors)) >= begin, packets.relays.copy()
    relays[(relays[:, 0] == anchor) & at[owners(packets)], 3] += round(metres / TICK_M)
    tx_ticks = packets.tx_ticks + np.where(at & (packets.anchors == anchor), round(metres / TICK_M), 0)
    return replace(packets, tx_ticks=tx_ticks, relays=relays)


def observations_of(packets, anchors_m=LAB_M):
    """What a receiver without any master would give its method."""
    for anchor, sequence, rx_ticks, tx_ticks, relays in one_by_one(packets):
        heard = tuple(map(tuple, relays))
        yield Observation(anchor, anchors_m[anchor], sequence, rx_ticks, tx_ticks, heard)


def seen(state):
    """What is in use of a state's arrays, in the same memory."""
    where, count, faults = state.layout, state.count, FAULT_KINDS * state.count
    n = where.end
    return SimpleNamespace(
        x=view(state.x)[:n],
        P=covariances(state)[:n, :n],
        V=view(state.V)[:n, :faults].T,
        information=view(state.information)[:faults, :faults],
        evidence=view(state.evidence)[:faults],
        lasting_covariance=view(state.lasting_covariance)[:count, :count],
        lasting_m=view(state.lasting_m)[:count],
        anchors=view(state.anchors)[:count],
        packets=view(state.packets)[:count],
        links=view(state.links)[:count, :count],
        status=view(state.status),
        record=state,
    )


def bytes_in_use(state):
    """The bytes of all that is in use of a state."""
    parts = vars(seen(state)) | {"record": np.array((state.dim, state.count))}
    return b"".join(map(bits, parts.values()))


def same(one, other):
    """Whether two states are the same to the bit."""
    return bytes_in_use(one) == bytes_in_use(other)


def bits(array):
    """The bytes of numbers, or of records without what lies between their fields."""
    return (repack_fields(array, recurse=True) if array.dtype.names else array).tobytes()


def where(estimator):
    return estimator.state.layout
