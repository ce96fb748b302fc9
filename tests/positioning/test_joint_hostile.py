"""``joint`` among late messages, lying anchors, jumping clocks and impossible stamps."""

import msgspec
import numpy as np
import pytest
from joint_builders import LAB_M, SLOT_S, Case, begun, episode_of, observations_of, packets_of, settings_of

from skyless.constants import TICK_M
from skyless.positioning.fix import Fix
from skyless.positioning.joint import JointFilter
from skyless.positioning.joint_hearing import ACCEPTED, REJECTED, STALE_PACKET
from skyless.positioning.joint_report import is_doubtful, places_excluded
from skyless.positioning.joint_state import EXCLUSIONS, IMPOSSIBLE, JUMPS, READMISSIONS, STALE
from skyless.positioning.joint_tracking import JointTracking

PLAIN, MESH = Case(qa=0.02), Case(qa=0.02, mesh=True)
CASES = pytest.mark.parametrize("case", [PLAIN, MESH], ids=["plain", "mesh"])
SUPERFRAMES, SETTLED = 400, 900
"""Six seconds, of which the first two and a bit are not judged."""

FOUND = 1500
"""Within three seconds and a half a start has found out who lies."""


def late(messages, late_m):
    """The messages with the tag's receptions late by so much, shape (n,)."""
    shift = np.rint(np.asarray(late_m) / TICK_M).astype(np.int64)
    return msgspec.structs.replace(messages, rx_ticks=messages.rx_ticks + shift)


def tracked(episode, messages, case, caution_m2=0.0):
    """Errors and covariances after every packet, of a filter with the agility of receivers, and it."""
    joint = JointFilter(settings_of(msgspec.structs.replace(case, qa=0.3)), LAB_M)
    joint.start(int(messages.rx_ticks[0]), episode.path_m[0, :2], 0.01 * np.eye(2), 0.25, caution_m2)
    count = len(messages.sites)
    motions, variances = np.empty((count, 4)), np.empty((count, 4))
    joint.track(messages, motions, variances)
    return motions[:, :2] - episode.path_m[:, :2], variances.reshape(-1, 2, 2), joint


def rmse_and_nees(runs):
    """Of what has settled; NEES over its degrees of freedom."""
    errors = np.concatenate([errors[SETTLED:] for errors, _, _ in runs])
    covariances = np.concatenate([said[SETTLED:] for _, said, _ in runs])
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors).mean() / 2.0
    return np.sqrt(np.square(errors).sum(axis=1).mean()), nees


def compared(case, late_of, caution_m2=0.0, seeds=4):
    """RMSE over that of clean messages, NEES, and the filters."""
    clean, hostile = [], []
    for seed in range(seeds):
        episode = episode_of(case, SUPERFRAMES, seed)
        clean.append(tracked(episode, episode.messages, case))
        hostile.append(tracked(episode, late(episode.messages, late_of(episode.messages, seed)), case, caution_m2))
    (clean_m, _), (hostile_m, nees) = rmse_and_nees(clean), rmse_and_nees(hostile)
    return hostile_m / clean_m, nees, [joint for _, _, joint in hostile]


@CASES
def test_clean_messages_are_believed(case):
    for seed in range(6):
        episode = episode_of(case, SUPERFRAMES, seed)
        _, _, joint = tracked(episode, episode.messages, case)
        assert joint.arrays.counts[EXCLUSIONS] == joint.arrays.counts[JUMPS] == joint.arrays.counts[IMPOSSIBLE] == 0
        assert not is_doubtful(joint.arrays)


@CASES
def test_late_messages_cost_little(case):
    def single(messages, seed):
        draw = np.random.default_rng(seed + 100)
        count = len(messages.sites)
        return np.where(draw.random(count) < 0.2, draw.exponential(1.0, count), 0.0)

    ratio, nees, _ = compared(case, single, caution_m2=1.0)
    assert ratio < 1.3
    assert 0.4 < nees < 1.3


@CASES
@pytest.mark.parametrize("bias_m", [0.3, 1.5, -0.3])
def test_an_anchor_that_is_always_off_is_left_out(case, bias_m):
    ratio, nees, filters = compared(case, lambda m, seed: np.where(m.sites == seed, bias_m, 0.0), caution_m2=1.0)
    assert ratio < 1.3
    assert 0.4 < nees < 1.3
    assert [places_excluded(joint.arrays) for joint in filters] == [[0], [1], [2], [3]]


@CASES
def test_an_anchor_is_left_out_while_it_is_off_and_taken_back(case):
    def burst(messages, seed):
        frames = np.arange(len(messages.sites))
        return np.where((messages.sites == seed) & (frames > 600) & (frames < 1500), 1.5, 0.0)

    ratio, _, filters = compared(case, burst)
    assert ratio < 1.3
    for joint in filters:
        assert places_excluded(joint.arrays) == []
        assert joint.arrays.counts[EXCLUSIONS] == joint.arrays.counts[READMISSIONS] == 1


def test_as_many_anchors_stay_as_a_fix_needs():
    episode = episode_of(MESH, SUPERFRAMES)
    few = np.isin(episode.messages.sites, [0, 2, 4])
    tracking = JointTracking(settings_of(MESH))
    for keep, observation in zip(few, observations_of(episode, LAB_M), strict=True):
        if keep:
            wrong = 64 if observation.anchor == 2 else 0
            tracking.hear(msgspec.structs.replace(observation, rx_ticks_tag=observation.rx_ticks_tag + wrong))
    assert tracking.excluded == ()


@pytest.mark.parametrize("bias_m", [0.3, 1.5])
def test_a_start_with_a_liar_comes_to_the_truth_and_names_it(bias_m):
    shift = round(bias_m / TICK_M)
    for seed in range(3):
        episode = episode_of(MESH, SUPERFRAMES, seed)
        tracking, errors = JointTracking(settings_of(MESH)), []
        for k, observation in enumerate(observations_of(episode, LAB_M)):
            moved = observation.rx_ticks_tag + (shift if observation.anchor == seed else 0)
            result = tracking.hear(msgspec.structs.replace(observation, rx_ticks_tag=moved))
            if isinstance(result, Fix) and k > FOUND:
                errors.append(np.linalg.norm(result.position_m - episode.path_m[k]))
                assert seed not in result.anchors
        assert len(errors) > 0.7 * (len(episode.path_m) - FOUND)
        assert max(errors) < 0.15
        assert tracking.excluded == (seed,)


@pytest.mark.parametrize("jump_m", [2.0, -30.0, 250.0])
def test_a_clock_that_jumps_is_taken_up_again(jump_m):
    episode = episode_of(MESH, 120)
    m = episode.messages
    ticks, jumped = round(jump_m / TICK_M), np.arange(len(m.sites)) > 300
    owner = np.repeat(np.arange(len(m.sites)), np.diff(m.ends, prepend=0))
    tx_ticks, relays = m.tx_ticks.copy(), m.relays.copy()
    tx_ticks[jumped & (m.sites == 4)] += ticks
    relays[(relays[:, 0] == 4) & jumped[owner], 3] += ticks
    errors, _, joint = tracked(episode, msgspec.structs.replace(m, tx_ticks=tx_ticks, relays=relays), MESH)
    assert joint.arrays.counts[JUMPS] == 1
    assert places_excluded(joint.arrays) == []
    assert np.linalg.norm(errors[300:], axis=1).max() < 0.15


def test_what_comes_twice_late_or_with_impossible_stamps_changes_nothing():
    episode = episode_of(MESH, 60)
    settings = settings_of(MESH)
    bare, other = begun(episode, settings), begun(episode, settings)
    packets = list(packets_of(episode.messages))
    for k, (site, sequence, rx_ticks, tx_ticks, relays) in enumerate(packets):
        status = bare.hear(site, sequence, rx_ticks, tx_ticks, relays)
        assert other.hear(site, sequence, rx_ticks, tx_ticks, relays) == status
        if k > 60 and k % 7 == 0:
            assert other.hear(site, sequence, rx_ticks + 5, tx_ticks, relays) == REJECTED
            assert other.hear(*packets[k - 3]) == STALE_PACKET
            assert other.hear(site, sequence + 1, rx_ticks + (1 << 37), tx_ticks + 1000, relays) == REJECTED
    assert status == ACCEPTED
    assert np.array_equal(bare.arrays.x, other.arrays.x)
    assert np.array_equal(bare.arrays.P, other.arrays.P)
    assert other.arrays.counts[STALE] > 30
    assert other.arrays.counts[IMPOSSIBLE] > 60


def test_packets_out_of_order_stop_no_fixes():
    episode = episode_of(MESH, 80)
    observations = list(observations_of(episode, LAB_M))
    for k in range(100, len(observations) - 1, 20):
        observations[k], observations[k + 1] = observations[k + 1], observations[k]
    tracking = JointTracking(settings_of(MESH))
    fixes = [isinstance(tracking.hear(observation), Fix) for observation in observations]
    assert np.mean(fixes[50:]) > 0.93


def test_bursts_of_loss_are_bridged():
    episode = episode_of(MESH, SUPERFRAMES)
    time_s = np.arange(len(episode.path_m)) * SLOT_S
    tracking, errors = JointTracking(settings_of(MESH)), []
    for k, observation in enumerate(observations_of(episode, LAB_M)):
        if time_s[k] % 1.0 < 0.4 and k > 200:
            continue
        result = tracking.hear(observation)
        if isinstance(result, Fix) and k > 200:
            error, P = (result.position_m - episode.path_m[k])[:2], result.covariance_m2[:2, :2]
            errors.append(error @ np.linalg.solve(P, error) / 2.0)
    assert len(errors) > 500
    assert np.mean(errors) < 2.5


@CASES
def test_streaming_is_batch_among_late_messages_too(case):
    episode = episode_of(case, 100)
    draw = np.random.default_rng(3)
    count = len(episode.path_m)
    wrong = np.where(draw.random(count) < 0.2, draw.exponential(1.0, count), 0.0)
    messages = late(episode.messages, wrong + np.where(episode.messages.sites == 2, 0.5, 0.0))
    batch, stream = (begun(episode, settings_of(case)) for _ in range(2))
    batch.track(messages)
    for packet in packets_of(messages):
        stream.hear(*packet)
    for one, other in zip(batch.arrays, stream.arrays, strict=True):
        assert np.array_equal(one, other)
