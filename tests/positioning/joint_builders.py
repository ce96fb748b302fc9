"""What tests of the joint filter share: anchors, episodes and settings that fit them, a filter that has begun."""

import numpy as np
from msgspec.structs import replace

from skyless.clocks.filter import ClockFilter, clock_noise
from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_M, TICK_RATE_HZ
from skyless.experiments.lab_bound import SPEED_STD_MPS, WHITE_FM
from skyless.experiments.studies import episodes
from skyless.experiments.studies.episodes import Case, draw_episode
from skyless.positioning.joint import JointFilter
from skyless.positioning.joint_messages import Messages
from skyless.positioning.joint_sync import SUBTICKS
from skyless.positioning.observation import Observation
from skyless.site.lab import lab_site

SLOT_S = lab_site().schedule.slot_s
LAB_M = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in lab_site().anchors])
CORNERS_M = [(0, 0), (4, 0), (8, 0), (8, 3), (8, 6), (4, 6), (0, 6), (0, 3)]
ROOM_M = np.array([(x, y, 2.5 if k % 2 else 0.5) for k, (x, y) in enumerate(CORNERS_M)], float)
"""Eight anchors at alternating heights."""


def settings_of(case, height_m=0.0, **others):
    """Settings of the very noise that a case's episodes have."""
    return replace(episodes.settings_of(case, height_m), **others)


def episode_of(case, superframes=40, seed=1, anchors_m=LAB_M):
    return draw_episode(np.random.default_rng(seed), anchors_m, SLOT_S, case, superframes)


def begun(episode, settings, anchors_m=LAB_M, std_m=0.3, seed=2, **others):
    """A filter that begins ``std_m`` off, and knows it."""
    joint = JointFilter(settings, anchors_m, **others)
    dim = joint.dim
    start = episode.path_m[0, :dim] + np.random.default_rng(seed).normal(0.0, std_m, dim)
    joint.start(int(episode.messages.rx_ticks[0]), start, std_m**2 * np.eye(dim), SPEED_STD_MPS**2)
    return joint


def packets_of(messages):
    """What ``JointFilter.hear`` takes, packet by packet."""
    begins = [0, *messages.ends[:-1].tolist()]
    for k, (begin, end) in enumerate(zip(begins, messages.ends.tolist(), strict=True)):
        stamps = (
            int(column[k]) for column in (messages.sites, messages.sequences, messages.rx_ticks, messages.tx_ticks)
        )
        yield (*stamps, messages.relays[begin:end])


def kept(messages, keep):
    """The messages for which ``keep``, shape (n,), is true, with their relays."""
    lengths = np.diff(messages.ends, prepend=0)
    owner = np.repeat(np.arange(len(lengths)), lengths)
    return Messages(
        messages.sites[keep],
        messages.sequences[keep],
        messages.rx_ticks[keep],
        messages.tx_ticks[keep],
        messages.relays[keep[owner]],
        np.cumsum(lengths[keep]),
        messages.syncs[keep] if len(messages.syncs) else messages.syncs,
    )


def observations_of(episode, anchors_m):
    """What a receiver without any master would give its method."""
    for k, (site, sequence, rx_ticks, tx_ticks, relays) in enumerate(packets_of(episode.messages)):
        heard = tuple((of, number, stamp) for _, of, number, stamp in relays.tolist())
        round_ = k // len(anchors_m)
        stamps = (round_, sequence, rx_ticks, tx_ticks, None, None, None, 0.0, 0.0)
        yield Observation(site, anchors_m[site], *stamps, heard)


def with_syncs(messages, case, anchors_m=LAB_M):
    """The messages with what the anchors' own clock filters say; the first anchor is the master, in at least its case.

    ``messages`` have all that anchors heard of the master, as they have where nothing is lost.
    """
    noise = clock_noise(WHITE_FM, case.random_walk_fm)
    variance = 2.0 * (SPEED_OF_LIGHT_MPS * case.noise_ps * 1e-12) ** 2
    filters = [ClockFilter(noise, variance) for _ in anchors_m]
    sent, syncs = {}, np.zeros((len(messages.sites), 3))
    for k, (site, sequence, _, tx_ticks, relays) in enumerate(packets_of(messages)):
        if site == 0:
            sent[sequence] = tx_ticks
        for listener, sender, number, rx_ticks in relays.tolist():
            if sender == 0:
                filters[listener].hear(
                    sent[number], rx_ticks, float(np.linalg.norm(anchors_m[listener] - anchors_m[0]))
                )
        if filters[site].updates > 1:
            ticks, fraction, said = filters[site].to_master(tx_ticks)
            syncs[k, 1:] = (tx_ticks - ticks) * SUBTICKS - round(fraction * SUBTICKS) & (1 << 48) - 1, said
    return replace(messages, syncs=syncs)


def ideal(path_m, mesh, seed=1, anchors_m=LAB_M, senders=None):
    """Messages to a tag on a path, one place each, of clocks that all run alike; receptions are relayed at once.

    Without ``mesh`` the anchors tell of the first one's packets only.
    """
    draw, frames = np.random.default_rng(seed), len(path_m)
    senders = np.arange(frames) % len(anchors_m) if senders is None else senders
    tx_ticks = np.rint((np.arange(frames) + 1) * SLOT_S * TICK_RATE_HZ).astype(np.int64)
    flight_m = np.linalg.norm(path_m - anchors_m[senders], axis=1)
    sent_m, noise_m = draw.normal(0.0, 0.03, (2, frames))
    rx_ticks = tx_ticks + np.rint((flight_m + sent_m + noise_m) / TICK_M).astype(np.int64)
    sequences = np.zeros(frames, np.int64)
    for site in set(senders.tolist()):
        sequences[senders == site] = np.arange(np.sum(senders == site)) % 256
    of = np.arange(frames) if mesh else np.flatnonzero(senders == senders[0])
    near = [sorted(set(senders[max(0, k - 20) : k + 20].tolist()) - {senders[k]}) for k in of]
    owner, by = np.repeat(of, [len(sites) for sites in near]), np.concatenate(near)
    way_m = np.linalg.norm(anchors_m[by] - anchors_m[senders[owner]], axis=1) + draw.normal(0.0, 0.03, len(by))
    heard = tx_ticks[owner] + np.rint((way_m + sent_m[owner]) / TICK_M).astype(np.int64)
    relays = np.column_stack([by, senders[owner], sequences[owner], heard])
    ends = np.searchsorted(owner, np.arange(frames), side="right")
    return Messages(senders, sequences, rx_ticks, tx_ticks, relays, ends)


__all__ = ["Case"]
