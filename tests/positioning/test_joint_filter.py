"""The joint filter against the Cramér–Rao bound and a textbook's filter; bits, months, anchors that come and go."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_builders import LAB_M, ROOM_M, SLOT_S, begun, episode_of, ideal, kept, packets_of, settings_of

from skyless.air.beacon import HEARD
from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_M, TICK_RATE_HZ, TICK_S
from skyless.experiments.lab_bound import SPEED_STD_MPS, WHITE_FM
from skyless.experiments.studies.episodes import Case
from skyless.positioning.joint import JointFilter
from skyless.positioning.joint_hearing import JOINED
from skyless.positioning.joint_messages import Messages
from skyless.positioning.joint_report import clock_of, covariance_of, is_lost
from skyless.positioning.joint_settings import JointSettings
from skyless.positioning.joint_slots import add_noise_state, add_slot, drop_slot
from skyless.positioning.joint_state import (
    BASE,
    EPOCH,
    NEVER,
    NOISE,
    REJECTED,
    RELAYS_REJECTED,
    RELAYS_USED,
    RESTARTS,
    SITE,
    SLOTS,
    WHOLE,
    new_arrays,
    states,
    values,
)
from skyless.positioning.tracker import AGILITY
from skyless.uncertainty.bounds import bound_settings, tracking_bound

PLAIN = Case()
MESH = Case(mesh=True)
AT_ONCE = Case(mesh=True, at_once=True)


@pytest.mark.parametrize(
    "case",
    [PLAIN, MESH, AT_ONCE, Case(noise_ps=150.0, mesh=True), Case(random_walk_fm=1e-8, mesh=True), Case(qa=2.0)],
    ids=["plain", "mesh", "at once", "150 ps", "random walk", "agile"],
)
def test_the_covariance_is_the_bound_of_what_has_come_in(case):
    episode = episode_of(case, 100)
    joint = begun(episode, settings_of(case))
    variances = np.empty((len(episode.path_m), 4))
    joint.track(episode.messages, np.empty((len(variances), 4)), variances)
    bound = tracking_bound(
        LAB_M,
        episode.path_m,
        bound_settings(
            case.noise_ps * 1e-12,
            white_fm=WHITE_FM,
            random_walk_fm=case.random_walk_fm,
            qa=case.qa,
            slot_s=SLOT_S,
            speed_std_mps=SPEED_STD_MPS,
            mesh=case.mesh,
            at_once=case.at_once,
        ),
    )
    said = variances[5::6].reshape(-1, 2, 2)[-20:]
    ratio = np.trace(said, axis1=1, axis2=2) / np.trace(bound[-20:], axis1=1, axis2=2)
    assert joint.arrays.counts[RELAYS_REJECTED] < 10
    np.testing.assert_allclose(ratio, 1.0, atol=0.02)


def dense(episode, case, start, std_m):
    """A textbook's filter, nothing exploited: positions, velocities, and the covariances of the former."""
    m, n, assumed = episode.messages, len(LAB_M), settings_of(case)
    size = 4 + 3 * n
    b, f, w = (slice(4 + k * n, 4 + (k + 1) * n) for k in range(3))
    x, P = (
        np.zeros(size),
        np.diag([std_m**2] * 2 + [SPEED_STD_MPS**2] * 2 + [1e8] * n + [(5e-5 * 3e8) ** 2] * n + [0.0] * n),
    )
    x[:2] = start
    whole = {}
    positions, variances = [], []
    last = m.rx_ticks[0]
    for site, _, rx, tx, relays in packets_of(m):
        dt = (rx - last) * TICK_S
        last = rx
        F, Q = np.eye(size), np.zeros((size, size))
        F[0, 2] = F[1, 3] = dt
        F[b, f] = dt * np.eye(n)
        Q[:2, :2], Q[:2, 2:4] = np.eye(2) * case.qa * dt**3 / 3, np.eye(2) * case.qa * dt**2 / 2
        Q[2:4, :2], Q[2:4, 2:4] = Q[:2, 2:4], np.eye(2) * case.qa * dt
        both = np.eye(n) + np.ones((n, n))
        Q[b, b] = both * (assumed.white * dt + assumed.walk * dt**3 / 3)
        Q[b, f] = Q[f, b] = both * assumed.walk * dt**2 / 2
        Q[f, f] = both * assumed.walk * dt
        x, P = F @ x, F @ P @ F.T + Q
        noise = w.start + site
        P[noise, :] = P[:, noise] = 0.0
        P[noise, noise], x[noise] = assumed.tx_variance_m2, 0.0
        away = x[:2] - LAB_M[site, :2]
        h = np.zeros(size)
        h[:2] = away / np.linalg.norm(away)
        h[b.start + site] = h[noise] = 1.0
        whole.setdefault(site, rx - tx)
        z = (rx - tx - whole[site]) * TICK_M - (np.linalg.norm(away) - h[:2] @ x[:2])
        rows = [(h, z)]
        for listener, _, _, relayed in relays.tolist():
            if listener in whole and site in whole:
                g = np.zeros(size)
                g[b.start + site], g[b.start + listener], g[noise] = 1.0, -1.0, 1.0
                way = np.linalg.norm(LAB_M[listener] - LAB_M[site])
                z = (relayed - tx - whole[site] + whole[listener]) * TICK_M - way
                g[f] -= g[b] * (np.linalg.norm(away) - way) / SPEED_OF_LIGHT_MPS
                rows.append((g, z))
        for h, z in rows:
            gain = P @ h / (h @ P @ h + assumed.rx_variance_m2)
            x = x + gain * (z - h @ x)
            keep = np.eye(size) - np.outer(gain, h)
            P = keep @ P @ keep.T + assumed.rx_variance_m2 * np.outer(gain, gain)
        positions.append(x[:4].copy())
        variances.append(P[:2, :2].copy())
    return np.array(positions), np.array(variances)


def test_a_textbook_filter_says_the_same():
    """But for the first packets, which it takes with a wide prior and in another order of states that come in."""
    episode = episode_of(AT_ONCE, 60)
    joint = begun(episode, settings_of(AT_ONCE, gate=1e3))
    start = joint.arrays.x[:2].copy()
    motions, variances = np.empty((360, 4)), np.empty((360, 4))
    joint.track(episode.messages, motions, variances)
    expected, spread = dense(episode, AT_ONCE, start, 0.3)
    np.testing.assert_allclose(motions[-60:, :2], expected[-60:, :2], atol=1e-4)
    np.testing.assert_allclose(motions[-60:, 2:], expected[-60:, 2:], atol=1e-3)
    np.testing.assert_allclose(variances[-60:].reshape(-1, 2, 2), spread[-60:], rtol=2e-3, atol=1e-8)


def with_gaps(case, anchors_m, seed):
    """Losses; an anchor that falls silent, comes back, and one whose counter starts anew."""
    messages = episode_of(case, 150, seed, anchors_m).messages
    superframe = np.arange(len(messages.sites)) // len(anchors_m)
    keep = np.random.default_rng(seed).random(len(superframe)) > 0.2
    keep &= ~((messages.sites == 3) & (superframe > 20) & (superframe < 90))
    keep &= ~((messages.sites >= 5) & (superframe < 40))
    tx_ticks = messages.tx_ticks.copy()
    tx_ticks[(messages.sites == 1) & (superframe > 100)] += 1 << 33
    return kept(
        Messages(messages.sites, messages.sequences, messages.rx_ticks, tx_ticks, messages.relays, messages.ends), keep
    )


@pytest.mark.parametrize(
    ("case", "anchors_m", "height_m"), [(PLAIN, LAB_M, 0.0), (MESH, LAB_M, 0.0), (MESH, ROOM_M, None)]
)
def test_streaming_and_batch_give_identical_bits(case, anchors_m, height_m):
    episode, messages = episode_of(case, 150, 3, anchors_m), with_gaps(case, anchors_m, 3)
    assumed = settings_of(case, height_m, drop_s=0.5)
    one, two = (begun(episode, assumed, anchors_m, std_m=0.01, capacity=4) for _ in range(2))
    streamed = []
    for packet in packets_of(messages):
        one.hear(*packet)
        streamed.append(one.motion()[0].copy())
    motions = np.empty((len(streamed), 2 * two.dim))
    two.track(messages, motions, np.empty((len(streamed), two.dim**2)))
    assert np.array_equal(streamed, motions)
    for ours, theirs in zip(one.arrays, two.arrays, strict=True):
        assert np.array_equal(ours, theirs)
    assert len(one.arrays.slots) == 8
    assert one.arrays.counts[RESTARTS] == 1
    assert one.arrays.counts[SLOTS] == len(anchors_m)
    assert np.array_equal(covariance_of(one.arrays), covariance_of(one.arrays).T)
    assert np.linalg.norm(motions[-1, :2] - episode.path_m[-1, :2]) < 0.2


def test_packed_relays_are_those_listed():
    episode, names = episode_of(MESH, 20), 300 + np.arange(len(LAB_M))
    listed = begun(episode, settings_of(MESH))
    packed = begun(episode, settings_of(MESH), np.empty((0, 3)))
    for name, anchor_m in zip(names.tolist(), LAB_M, strict=True):
        packed.add_anchor(anchor_m, name)
    for site, sequence, rx_ticks, tx_ticks, relays in packets_of(episode.messages):
        told = b"".join(
            HEARD.pack(name, number & 0xFF, stamp & 0xFFFFFFFF, stamp >> 32 & 0xFF)
            for name, number, stamp in [(9, 1, 5), *zip(names[relays[:, 1]], *relays[:, 2:].T, strict=True)]
        )
        assert listed.hear(site, sequence, rx_ticks, tx_ticks, relays) == packed.hear_listed(
            site, sequence, rx_ticks, tx_ticks, [], told
        )
    assert listed.arrays.counts[RELAYS_USED] > 100
    for one, other in zip(listed.arrays, packed.arrays, strict=True):
        if one is not listed.arrays.slot_of and one is not listed.arrays.site_m:
            assert np.array_equal(one, other)


def streamed_positions():
    episode = episode_of(MESH, 10)
    joint = begun(episode, settings_of(MESH))
    positions = []
    for packet in packets_of(episode.messages):
        joint.hear(*packet)
        positions.append(joint.motion()[0].tolist())
    return positions


def test_without_the_compiler_the_states_are_the_same_to_rounding():
    script = "import json, test_joint_filter as t; print(json.dumps(t.streamed_positions()))"
    plain = subprocess.run(
        [sys.executable, "-c", script],
        env={
            **os.environ,
            "NUMBA_DISABLE_JIT": "1",
            "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path]),
        },
        capture_output=True,
        text=True,
        check=True,
    )
    np.testing.assert_allclose(json.loads(plain.stdout), streamed_positions(), rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("epoch", [2**40 - 3, 2**56, -(2**50)])
def test_the_epoch_does_not_matter(epoch):
    episode = episode_of(MESH, 50)
    m = episode.messages
    near, far = (begun(episode, settings_of(MESH)) for _ in range(2))
    far.arrays.counts[[EPOCH, BASE]] += epoch
    relays = m.relays.copy()
    relays[:, 3] += epoch
    moved = Messages(m.sites, m.sequences, m.rx_ticks + epoch, m.tx_ticks + epoch, relays, m.ends)
    near.track(m)
    far.track(moved)
    assert np.array_equal(near.arrays.x, far.arrays.x)
    assert np.array_equal(near.arrays.P, far.arrays.P)


@pytest.mark.parametrize(("case", "millions"), [(PLAIN, 10), (MESH, 1)])
def test_millions_of_messages_leave_the_covariance_sound(case, millions):
    """Seven hours, and one hour with mesh: the same 15 s again and again, on counters that go on."""
    m = ideal(np.tile([3.0, 4.0, 0.0], (1024 * 6, 1)), case.mesh)
    joint = JointFilter(settings_of(Case(mesh=case.mesh, qa=0.3)), LAB_M)
    joint.start(0, np.array([3.0, 4.0]), 1e-2 * np.eye(2), 0.01)
    step = round(1024 * 6 * SLOT_S * TICK_RATE_HZ)
    early = np.empty(0)
    for _ in range(round(millions * 1e6 / len(m.sites))):
        joint.track(m)
        early = early if len(early) else np.diag(covariance_of(joint.arrays)).copy()
        m.rx_ticks[:] += step
        m.tx_ticks[:] += step
        m.relays[:, 3] += step
    P = covariance_of(joint.arrays)
    assert np.array_equal(P, P.T)
    assert np.isfinite(joint.arrays.x).all()
    scale = np.sqrt(np.diag(P))
    assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > 1e-7
    np.testing.assert_allclose(np.diag(P), early, rtol=0.05)
    assert joint.arrays.counts[REJECTED] < 1e-3 * millions * 1e6
    assert np.linalg.norm(joint.motion()[0][:2] - [3.0, 4.0]) < 0.1


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(["add", "noise", "drop"]), st.integers(0, 7)), max_size=40))
def test_states_come_and_go_as_rows_and_columns_of_a_matrix(steps):
    """Against a dictionary of covariances between states that have names."""
    s = new_arrays(JointSettings(height_m=0.0).array(), 8, 8)
    random = np.random.default_rng(1)
    slots, noises = [], []
    KNOWN.clear()
    for step, site in steps:
        if step == "add" and site not in slots:
            assert add_slot(s, site) == len(slots)
            slots.append(site)
        elif step == "noise" and site in slots and site not in noises:
            add_noise_state(s, slots.index(site))
            noises.append(site)
        elif step == "drop" and site in slots:
            drop_slot(s, slots.index(site))
            slots.remove(site)
            if site in noises:
                noises.remove(site)
        else:
            continue
        names = [("p", 0), ("p", 1), *(("b", k) for k in slots)]
        names += [("v", 0), ("v", 1), *(("f", k) for k in slots), *(("w", k) for k in noises)]
        n = states(s)
        assert n == len(names)
        assert values(s) == 2 + len(slots)
        check_names(s, names, random)
        assert s.slots[: len(slots), SITE].tolist() == slots
        assert [s.slot_of[k] for k in range(8)] == [slots.index(k) if k in slots else -1 for k in range(8)]
        places = {site: place for place, site in enumerate(noises)}
        assert s.slots[: len(slots), NOISE].tolist() == [places.get(site, -1) for site in slots]


KNOWN: dict[tuple[str, int], float] = {}


def check_names(s, names, random):
    """Each state that was there before has kept its number, new ones are zero; then all get numbers anew."""
    n = len(names)
    for name, value in zip(names, s.x[:n].tolist(), strict=True):
        assert value == KNOWN.get(name, 0.0) or value == 0.0
    table = np.array([[KNOWN.get(a, 0.0) * KNOWN.get(b, 0.0) for b in names] for a in names])
    kept_rows = s.x[:n] != 0.0
    np.testing.assert_array_equal(s.P[:n, :n][np.ix_(kept_rows, kept_rows)], table[np.ix_(kept_rows, kept_rows)])
    assert not s.P[:n, n:].any()
    KNOWN.clear()
    for name in names:
        KNOWN[name] = float(random.integers(1, 1000))
    s.x[:n] = [KNOWN[name] for name in names]
    s.P[:n, :n] = np.outer(s.x[:n], s.x[:n])


def test_an_anchor_that_leaves_takes_nothing_with_it():
    episode = episode_of(MESH, 60)
    joint = begun(episode, settings_of(MESH))
    joint.track(episode.messages)
    before, motion = covariance_of(joint.arrays).copy(), joint.motion()[0].copy()
    slot = int(joint.arrays.slot_of[2])
    half, noise = values(joint.arrays), int(joint.arrays.slots[slot, NOISE])
    drop_slot(joint.arrays, slot)
    gone = [2 + slot, half + 2 + slot, 2 * half + noise]
    np.testing.assert_array_equal(covariance_of(joint.arrays), np.delete(np.delete(before, gone, 0), gone, 1))
    np.testing.assert_array_equal(joint.motion()[0], motion)


def test_only_anchors_in_view_count():
    """A hundred anchors of which six are heard at a time."""
    anchors_m = np.array([(3.0 * k, 4.0 * (k % 2), 0.0) for k in range(100)])
    frames = np.arange(94 * 60)
    path_m = np.column_stack([7.0 + 3.0 * frames / 60.0, np.full(len(frames), 1.0), np.zeros(len(frames))])
    messages = ideal(path_m, True, anchors_m=anchors_m, senders=frames // 60 + frames % 6)
    joint = JointFilter(settings_of(MESH, drop_s=0.1), anchors_m)
    joint.start(0, path_m[0, :2], 1e-4 * np.eye(2), 400.0)
    joint.track(messages)
    assert joint.arrays.counts[SLOTS] <= 8
    assert len(joint.arrays.slots) == 8
    assert joint.arrays.counts[REJECTED] < 0.01 * len(frames)
    assert np.linalg.norm(joint.motion()[0][:2] - path_m[-1, :2]) < 0.2


# Relays


def after(messages, joint):
    joint.track(messages)
    return joint.arrays


def changed(messages, relays, ends=None):
    return Messages(
        messages.sites,
        messages.sequences,
        messages.rx_ticks,
        messages.tx_ticks,
        relays,
        messages.ends if ends is None else ends,
    )


def test_relays_of_packets_that_nobody_heard_are_passed_over():
    episode = episode_of(MESH, 30)
    m = episode.messages
    other = m.relays.copy()
    other[:, 2] = (other[:, 2] + 100) % 256
    bare = changed(m, np.empty((0, 4), np.int64), np.zeros_like(m.ends))
    heard, alone = (after(x, begun(episode, settings_of(MESH))) for x in (changed(m, other), bare))
    assert heard.counts[RELAYS_USED] == heard.counts[RELAYS_REJECTED] == 0
    assert np.array_equal(heard.x, alone.x)
    assert np.array_equal(heard.P, alone.P)


def test_a_relay_counts_once():
    episode = episode_of(MESH, 30)
    m = episode.messages
    lengths = np.diff(m.ends, prepend=0)
    owner = np.repeat(np.arange(len(lengths)), lengths)
    both = np.argsort(np.concatenate([owner, owner]), kind="stable")
    twice = changed(m, np.concatenate([m.relays, m.relays])[both], 2 * m.ends)
    once, again = (after(x, begun(episode, settings_of(MESH))) for x in (m, twice))
    assert once.counts[RELAYS_USED] > 800
    assert np.array_equal(once.P, again.P)
    assert np.array_equal(once.x, again.x)


def test_relays_of_oneself_of_strangers_and_of_nonsense_do_no_harm():
    episode = episode_of(MESH, 30)
    m = episode.messages
    relays = m.relays.copy()
    relays[::3, 1] = relays[::3, 0]
    relays[1::3, 3] += 1 << 38
    s = after(changed(m, relays), begun(episode, settings_of(MESH)))
    assert s.counts[RELAYS_REJECTED] > 100
    assert np.isfinite(s.x).all()
    joint = begun(episode, settings_of(MESH))
    joint.track(changed(m, relays))
    assert np.linalg.norm(joint.motion()[0][:2] - episode.path_m[-1, :2]) < 0.15


def test_relays_that_come_two_superframes_late_still_help_and_do_not_deceive():
    """Their packets' TX noise is forgotten by then and counts as independent."""
    ratios, nees = [], []
    for seed in range(60):
        episode = episode_of(AT_ONCE, 80, seed)
        m = episode.messages
        late = 12
        ends = np.concatenate([np.zeros(late, np.int64), m.ends[:-late]])
        runs = [begun(episode, settings_of(AT_ONCE), seed=seed) for _ in range(2)]
        runs[0].track(changed(m, m.relays[: ends[-1]], ends))
        runs[1].track(changed(m, np.empty((0, 4), np.int64), np.zeros_like(ends)))
        (x, P), (_, alone) = (run.motion() for run in runs)
        error = x[:2] - episode.path_m[-1, :2]
        nees.append(error @ np.linalg.solve(P[:2, :2], error))
        ratios.append(np.trace(P[:2, :2]) / np.trace(alone[:2, :2]))
    assert np.mean(ratios) < 0.7
    assert 1.3 < np.mean(nees) < 2.8  # 2, 99.9 % interval of 60 episodes


def test_an_anchor_whose_counter_starts_anew_is_taken_up_again():
    episode = episode_of(MESH, 60)
    m = episode.messages
    tx_ticks, relays = m.tx_ticks.copy(), m.relays.copy()
    anew = np.arange(len(tx_ticks)) > 180
    tx_ticks[anew & (m.sites == 4)] += 1 << 36
    owner = np.repeat(np.arange(len(tx_ticks)), np.diff(m.ends, prepend=0))
    relays[(relays[:, 0] == 4) & (owner > 180), 3] += 1 << 36
    joint = begun(episode, settings_of(MESH))
    joint.track(Messages(m.sites, m.sequences, m.rx_ticks, tx_ticks, relays, m.ends))
    assert joint.arrays.counts[RESTARTS] == 1
    assert joint.arrays.slots[joint.arrays.slot_of[4], WHOLE] < -(1 << 35)
    assert np.linalg.norm(joint.motion()[0][:2] - episode.path_m[-1, :2]) < 0.1


# Motion


def test_standing_still_costs_nothing_and_hard_turns_are_followed():
    """Still for 5 s, then away with 3 m/s² up to 5 m/s, on a circle that takes 3 m/s² across as well."""
    t = np.arange(4000) * SLOT_S
    speed = np.clip(3.0 * (t - 5.0), 0.0, 5.0)
    angle = np.cumsum(speed) * SLOT_S / 8.0
    path_m = np.column_stack([12.0 + 8.0 * np.sin(angle), 8.0 + 8.0 * (1.0 - np.cos(angle)), np.zeros(len(t))])
    hall_m = 4.0 * LAB_M
    joint = JointFilter(settings_of(Case(qa=0.3)), hall_m)
    joint.start(0, path_m[0, :2], 0.01 * np.eye(2), 0.01)
    errors, agility = [], []
    for place, packet in zip(path_m, packets_of(ideal(path_m, True, anchors_m=hall_m)), strict=True):
        joint.hear(*packet)
        errors.append(np.linalg.norm(joint.motion()[0][:2] - place[:2]))
        agility.append(joint.arrays.statistics[AGILITY])
    assert max(agility[200:1900]) == 1.0
    assert np.sqrt(np.mean(np.square(errors[200:1900]))) < 0.02
    assert max(errors) < 0.2
    assert np.sqrt(np.mean(np.square(errors[2200:]))) < 0.06
    assert not is_lost(joint.arrays)


def test_a_new_anchor_is_heard_of_first():
    joint = JointFilter(settings_of(PLAIN), np.empty((0, 3)))
    joint.start(0, np.array([3.0, 4.0]), np.eye(2), 1.0)
    places = [joint.add_anchor(place) for place in LAB_M]
    assert places == list(range(6))
    assert joint.hear(0, 0, 100, 50) == JOINED
    assert clock_of(joint.arrays, joint.dim, 0) is not None
    assert clock_of(joint.arrays, joint.dim, 1) is None
    assert joint.arrays.packets.max() == 100
    assert joint.arrays.relayed.max() == NEVER
