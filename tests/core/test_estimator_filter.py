"""The estimator's filter against a textbook's, its time update in closed form, bits, and anchors that come and go."""

import numpy as np
import pytest
from estimator_builders import (
    BIASED,
    LAB_M,
    MESH,
    PLAIN,
    ROOM_M,
    SLOT_S,
    Case,
    begun,
    bits,
    episode_of,
    jumped,
    kept,
    late,
    nees,
    one_by_one,
    owners,
    same,
    seen,
    settings_of,
    ticks,
    tracked,
    where,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from textbook_filter import TextbookFilter

from skyless.core.air.frame import HEARD
from skyless.core.estimator.estimator import Estimator, Packets
from skyless.core.estimator.kalman import predict
from skyless.core.estimator.levels import FIRST_TEST
from skyless.core.estimator.process import JOINED, REJECTED, STALE
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import FAULT_KINDS, LASTING, State, add_anchor, new_state, remove_anchor
from skyless.core.ticks import TICK_RATE_HZ, TICK_S
from skyless.research.studies.efficiency import EPISODE_SPEED_STD_MPS, WHITE_FM
from skyless.research.uncertainty import BoundSettings, tracking_bound

pytestmark = pytest.mark.site


@pytest.mark.parametrize("errors", [{}, BIASED], ids=["exact", "range errors"])
@pytest.mark.parametrize(
    ("case", "anchors_m", "height_m", "height_std_m"),
    [
        (PLAIN, LAB_M, 0.0, 0.0),
        (MESH, LAB_M, 0.0, 0.0),
        (MESH, ROOM_M, 0.0, 0.0),
        (MESH, ROOM_M, 0.1, 0.3),
        (MESH, ROOM_M, None, 0.0),
    ],
    ids=["plain", "mesh", "height above", "height uncertain", "3-D"],
)
@pytest.mark.statistical
def test_a_textbook_filter_says_the_same(case, anchors_m, height_m, height_std_m, errors):
    episode = episode_of(case, 25, 3, anchors_m)
    assumed = settings_of(case, height_m, gate=1e3, height_std_m=height_std_m, **errors)
    estimator = begun(episode, assumed, anchors_m)
    s, dim = seen(estimator.state), estimator.dim
    start = (s.x[:dim].copy(), s.P[:dim, :dim].copy(), EPISODE_SPEED_STD_MPS**2)
    textbook = TextbookFilter(estimator.settings, anchors_m, int(episode.packets.rx_ticks[0]), *start)
    for packet in one_by_one(episode.packets):
        status, anchors = seen(estimator.state).status.copy(), seen(estimator.state).anchors
        scales = dict(zip(anchors["identifier"].tolist(), anchors["walk_scale"].tolist(), strict=True))
        estimator.process(*packet)
        textbook.update(packet, status["q_scale"], status["walk_scale"], scales)
        s, n = seen(estimator.state), estimator.state.count
        np.testing.assert_allclose(s.x[:dim], textbook.x[textbook.p], rtol=0.0, atol=1e-5)
        if n == len(anchors_m) and s.anchors["has_rate"].all():
            size = where(estimator).end
            assert not s.P[size:].any()
            assert not s.x[size:].any()
            zero = [where(estimator).zero] if dim == 3 else []  # of a barometer, which the textbook's tag has not
            assert not s.P[zero].any()
            kept = np.setdiff1d(np.arange(size), zero)
            used = np.setdiff1d(np.arange(len(kept)), textbook.w)  # TX noises that nobody relays are left as they are
            apart = np.setdiff1d(used, textbook.b)  # whole ticks of offsets stand elsewhere
            scale = np.sqrt(np.maximum(np.diag(textbook.P), 1e-9))
            off = ((s.P[np.ix_(kept, kept)] - textbook.P) / np.outer(scale, scale))[np.ix_(used, used)]
            np.testing.assert_allclose(off, 0.0, atol=1e-5)
            # Relays of a first packet are carried back by some 10 ns without the rate: some 10 µm.
            np.testing.assert_allclose((s.x[kept] - textbook.x)[apart] / scale[apart], 0.0, atol=1e-3)
        assert np.array_equal(s.P, s.P.T)
    status = s.status
    assert status["obstructions"] == status["rejected"] == status["faults_opened"] == 0
    assert status["relays_used"] > 50


@pytest.mark.parametrize(
    "case",
    [PLAIN, MESH, Case(noise_ps=150.0), Case(random_walk_fm=1e-8), Case(qa=2.0, mesh=False)],
    ids=["plain", "mesh", "150 ps", "random walk", "agile"],
)
@pytest.mark.statistical
def test_the_covariance_is_the_bound_of_what_has_come_in(case):
    """Process noise that follows what innovations show is that of the settings, with these seeds."""
    episode = episode_of(case, 100)
    run = tracked(begun(episode, settings_of(case)), episode.packets)
    noise = {"white_fm": WHITE_FM, "random_walk_fm": case.random_walk_fm, "qa": case.qa}
    start = {"speed_std_mps": EPISODE_SPEED_STD_MPS, "mesh": case.mesh, "at_once": False}
    stage = BoundSettings(case.noise_ps * 1e-12, **noise, slot_s=SLOT_S, **start)
    bound = tracking_bound(LAB_M, episode.path_m, stage)
    ratio = np.trace(run.covariances[5::6][-20:], axis1=1, axis2=2) / np.trace(bound[-20:], axis1=1, axis2=2)
    assert seen(run.estimator.state).status["relays_rejected"] < 10
    np.testing.assert_allclose(ratio, 1.0, atol=0.02)


@pytest.mark.parametrize("dim", [2, 3])
def test_prediction_is_its_closed_form(dim):
    """F·P·Fᵀ + Q with the tag's oscillator in all offsets."""
    given_settings = EstimatorSettings(height_m=0.0 if dim == 2 else None, qa=0.7, white=0.02, walk=0.3)
    state, draw, n = new_state(given_settings), np.random.default_rng(dim), 5
    for anchor in range(n):
        add_anchor(state, anchor, LAB_M[anchor], -1.0, False)
    s = seen(state)
    size = len(s.x)
    root = draw.normal(size=(size, size))
    s.P[:], s.x[:], s.V[:] = root @ root.T, draw.normal(size=size), draw.normal(size=s.V.shape)
    s.P[:] = (s.P + s.P.T) / 2.0
    s.anchors["walk_scale"] = [1.0, 2.0, 3.0, 4.0, 5.0]
    s.status["q_scale"], s.status["walk_scale"] = 6.0, 7.0
    before = [array.copy() for array in (s.x, s.P, s.V)]
    rx_ticks = round(0.3 * TICK_RATE_HZ)
    dt = rx_ticks * TICK_S
    predict(state, rx_ticks)
    values, G = dim + n, np.zeros((dim + n, dim + n + 1))  # oscillators and axes that the values hang on
    G[:, :-1] = np.eye(values)
    G[dim:, -1] = 1.0
    walk = np.diag([*[0.7 * 6.0] * dim, *(0.3 * s.anchors["walk_scale"]), 0.3 * 7.0])
    white = np.diag([*[0.0] * dim, *[0.02] * n, 0.02])
    F, Q = np.eye(size), np.zeros((size, size))
    F[:values, values : 2 * values] = dt * np.eye(values)
    moments = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    Q[: 2 * values, : 2 * values] = np.kron(moments, G @ walk @ G.T)
    Q[:values, :values] += dt * G @ white @ G.T
    x, P, V = before
    np.testing.assert_allclose(s.x, F @ x, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(s.P, F @ P @ F.T + Q, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(s.V, V @ F.T, rtol=1e-12, atol=1e-12)
    assert np.array_equal(s.P, s.P.T)


# Bits


def with_gaps(case, anchors_m, seed):
    """Losses; an anchor that falls silent and comes back, others that come late, one whose counter starts anew."""
    packets = episode_of(case, 150, seed, anchors_m).packets
    superframe = np.arange(len(packets.anchors)) // len(anchors_m)
    keep = np.random.default_rng(seed).random(len(superframe)) > 0.2
    keep &= ~((packets.anchors == 3) & (superframe > 20) & (superframe < 90))
    keep &= ~((packets.anchors >= 5) & (superframe < 40))
    draw = np.random.default_rng(seed + 1)
    wrong = np.where((superframe > 50) & (draw.random(len(keep)) < 0.1), draw.exponential(1.0, len(keep)), 0.0)
    wrong += np.where((packets.anchors == 2) & (superframe > 110), 0.5, 0.0)
    return kept(late(jumped(packets, 1, 100 * len(anchors_m), 4e7), wrong), keep)


@pytest.mark.parametrize(
    ("case", "anchors_m", "height_m", "errors"),
    [(PLAIN, LAB_M, 0.0, {}), (MESH, LAB_M, 0.0, BIASED), (MESH, ROOM_M, None, BIASED)],
)
def test_streaming_and_batch_give_identical_bits(case, anchors_m, height_m, errors):
    episode, packets = episode_of(case, 150, 3, anchors_m), with_gaps(case, anchors_m, 3)
    one, two = (
        begun(episode, settings_of(case, height_m, drop_s=0.5, **errors), anchors_m, std_m=0.01) for _ in range(2)
    )
    streamed, outcomes = [], []
    for packet in one_by_one(packets):
        outcomes.append(one.process(*packet))
        streamed.append(one.motion()[0].copy())
    run = tracked(two, packets)
    assert np.array_equal(streamed, run.motions)
    assert outcomes == run.outcomes.tolist()
    assert same(one.state, two.state)
    assert seen(one.state).status["clock_restarts"] >= 1
    assert seen(one.state).status["obstructions"] >= 1
    assert len(seen(one.state).anchors) == len(anchors_m)
    assert np.array_equal(seen(one.state).P, seen(one.state).P.T)
    assert np.linalg.norm(run.motions[-1, :2] - episode.path_m[-1, :2]) < 0.4


def test_packed_relays_are_those_listed():
    episode, names = episode_of(MESH, 20), 300 + np.arange(len(LAB_M))
    listed = begun(episode, settings_of(MESH))
    packed = begun(episode, settings_of(MESH), np.empty((0, 3)))
    for name, anchor_m in zip(names.tolist(), LAB_M, strict=True):
        packed.know_anchor(name, anchor_m)
    for anchor, sequence, rx_ticks, tx_ticks, relays in one_by_one(episode.packets):
        named = [(9, 1, 5), *((names[sender], number, stamp) for sender, number, stamp in relays)]
        frame_relays = b"".join(
            HEARD.pack(name, number & 0xFF, stamp & 0xFFFFFFFF, stamp >> 32 & 0xFF) for name, number, stamp in named
        )
        outcome = listed.process(anchor, sequence, rx_ticks, tx_ticks, relays)
        assert outcome == packed.process(int(names[anchor]), sequence, rx_ticks, tx_ticks, packed=frame_relays)
    assert seen(listed.state).status["relays_used"] > 100
    for part in ("x", "P", "V", "information", "evidence", "packets", "links", "status"):
        assert bits(getattr(seen(listed.state), part)) == bits(getattr(seen(packed.state), part))


@pytest.mark.parametrize("epoch", [2**40 - 3, 2**56, -(2**50)])
def test_the_epoch_does_not_matter(epoch):
    packets = (episode := episode_of(MESH, 50)).packets
    near, far = (begun(episode, settings_of(MESH)) for _ in range(2))
    seen(far.state).status["epoch_ticks"] += epoch
    relays = packets.relays.copy()
    relays[:, 3] += epoch
    moved = replace(packets, rx_ticks=packets.rx_ticks + epoch, tx_ticks=packets.tx_ticks + epoch, relays=relays)
    near.track(packets)
    far.track(moved)
    assert np.array_equal(seen(near.state).x, seen(far.state).x)
    assert np.array_equal(seen(near.state).P, seen(far.state).P)


def along(path_m, senders, anchors_m=LAB_M, seed=4):
    """Packets to a tag on a way, of clocks that all run alike; receptions are relayed by the next anchor's packet."""
    draw, frames = np.random.default_rng(seed), np.arange(len(senders))
    tx_ticks = np.rint((frames + 1) * SLOT_S * TICK_RATE_HZ).astype(np.int64)
    sent_m, noise_m, relay_m = draw.normal(0.0, 0.03, (3, len(frames)))
    rx_ticks = tx_ticks + ticks(np.linalg.norm(path_m - anchors_m[senders], axis=1) + sent_m + noise_m)
    of = np.flatnonzero(senders[:-1] != senders[1:])
    by = senders[of + 1]
    way_m = np.linalg.norm(anchors_m[by] - anchors_m[senders[of]], axis=1)
    relays = np.column_stack([by, senders[of], of % 256, tx_ticks[of] + ticks(way_m + sent_m[of] + relay_m[of])])
    return Packets(senders, frames % 256, rx_ticks, tx_ticks, relays, np.searchsorted(of + 1, frames, side="right"))


def standing(frames, seed=4):
    return along(np.array([3.0, 4.0, 0.0]), np.arange(frames) % len(LAB_M), seed=seed)


def test_at_rest_nothing_is_learnt_of_how_range_errors_grow():
    """The range at which the slope counts once followed the estimate's noise, and the slope was at −0.28 by now."""
    estimator = Estimator(settings_of(Case(qa=0.3), **BIASED), LAB_M)
    estimator.start(0, np.array([3.0, 4.0]), 1e-2 * np.eye(2), 0.01)
    run = tracked(estimator, standing(40_000, 12))
    slope = where(estimator).slope
    assert abs(seen(estimator.state).x[slope]) < seen(estimator.state).P[slope, slope] ** 0.5
    assert seen(estimator.state).status["faults_opened"] == 0
    assert run.levels[:, FIRST_TEST + LASTING].max() < 25.0  # with 6 degrees of freedom, over 100 s
    assert nees(run.motions[:, :2] - [3.0, 4.0], run.covariances) < 1.0


@pytest.mark.parametrize("errors", [{}, BIASED], ids=["exact", "range errors"])
@pytest.mark.statistical
def test_a_million_packets_leave_the_covariance_sound(errors):
    """Forty minutes at rest: the same 15 s again and again, on counters that go on."""
    packets, place_m = standing(1024 * 6), [3.0, 4.0]
    estimator = Estimator(settings_of(Case(qa=0.3), **errors), LAB_M)
    estimator.start(0, np.array(place_m), 1e-2 * np.eye(2), 0.01)
    step, early = round(1024 * 6 * SLOT_S * TICK_RATE_HZ), None
    for _ in range(1_000_000 // len(packets.anchors)):
        estimator.track(packets)
        early = np.diag(seen(estimator.state).P).copy() if early is None else early
        packets.rx_ticks[:] += step
        packets.tx_ticks[:] += step
        packets.relays[:, 3] += step
    P, place = seen(estimator.state).P, where(estimator)
    assert np.array_equal(P, P.T)
    assert np.isfinite(seen(estimator.state).x).all()
    used = np.diag(P) > 0.0
    scale = np.sqrt(np.diag(P)[used])
    assert np.linalg.eigvalsh(P[np.ix_(used, used)] / np.outer(scale, scale)).min() > 1e-9
    growth = np.diag(P)[: place.tx_noise] / early[: place.tx_noise]
    assert growth.max() < 1.05
    assert growth.min() > (0.5 if errors else 0.95)  # range errors are learnt on
    assert seen(estimator.state).status["rejected"] < 1e3
    # as noise repeats, its mean is learnt for a range error, 160 times as often as it is there
    assert np.linalg.norm(estimator.motion()[0][:2] - place_m) < (0.2 if errors else 0.1)


# Anchors come and go


def states_of(dim, anchors):
    """Name of each state."""
    names = [("p", k) for k in range(dim)] + [("b", a) for a in anchors]
    names += [("v", k) for k in range(dim)] + [("f", a) for a in anchors]
    names += [(block, a) for block in ("w", "change", "constant") for a in anchors]
    names += [("slope", 0), ("height" if dim == 2 else "zero", 0)]
    return names + [(f"survey {k}", a) for a in anchors for k in range(dim)]


def faults_of(dim, anchors):
    """Name of each fault."""
    return [(kind, a) for kind in range(FAULT_KINDS) for a in anchors]


def both(old, new):
    """Where that which is in both lists stands in each."""
    common = [name for name in new if name in old]
    return [old.index(name) for name in common], [new.index(name) for name in common]


def fill(s, random):
    """Other numbers everywhere."""
    for array in (s.x, s.V, s.evidence, s.information):
        array[:] = random.integers(1, 1000, array.shape)
    root = random.integers(1, 1000, s.P.shape)
    s.P[:] = root + root.T
    for record in (s.anchors, s.links, s.packets):
        for name in set(record.dtype.names) - {"identifier", "position_m"}:
            record[name] = random.integers(1, 1000, record[name].shape)


STEPS = st.lists(st.tuples(st.booleans(), st.integers(0, 7)), max_size=40)


@settings(max_examples=60, deadline=None)
@given(STEPS, st.sampled_from([2, 3]))
def test_states_come_and_go_as_rows_and_columns_of_a_matrix(steps, dim):
    """Against lists of the names of states and faults."""
    state = new_state(EstimatorSettings(height_m=0.0 if dim == 2 else None))
    random, anchors = np.random.default_rng(1), []
    variances = {"change": 0.005**2, "constant": 0.03**2, "survey": 0.02**2}
    for joins, anchor in steps:
        if joins == (anchor in anchors):
            continue
        old, before = seen(State.from_buffer_copy(state)), list(anchors)
        if joins:
            add_anchor(state, anchor, ROOM_M[anchor], -1.0, False)
            anchors.append(anchor)
        else:
            remove_anchor(state, anchors.index(anchor))
            anchors.remove(anchor)
        s, names = seen(state), states_of(dim, anchors)
        then, now = both(states_of(dim, before), names)
        np.testing.assert_array_equal(s.x[now], old.x[then])
        np.testing.assert_array_equal(s.P[np.ix_(now, now)], old.P[np.ix_(then, then)])
        new = [k for k in range(len(s.x)) if k not in now]
        known = [variances.get(name.split()[0], 0.0) for name, _ in names]
        expected = np.diag(known + [0.0] * (len(s.x) - len(names)))
        np.testing.assert_array_equal(s.P[:, new], expected[:, new])
        assert not s.x[new].any()
        was, faults = both(faults_of(dim, before), faults_of(dim, anchors))
        np.testing.assert_array_equal(s.V[np.ix_(faults, now)], old.V[np.ix_(was, then)])
        assert not np.delete(s.V, faults, 0).any()
        assert not s.V[:, new].any()
        was, at = both(faults_of(0, before), faults_of(0, anchors))
        np.testing.assert_array_equal(s.evidence[at], old.evidence[was])
        np.testing.assert_array_equal(s.information[np.ix_(at, at)], old.information[np.ix_(was, was)])
        was, at = both(before, anchors)
        np.testing.assert_array_equal(s.links[np.ix_(at, at)], old.links[np.ix_(was, was)])
        np.testing.assert_array_equal(s.anchors[at], old.anchors[was])
        np.testing.assert_array_equal(s.packets[at], old.packets[was])
        assert s.anchors["identifier"].tolist() == anchors
        fill(s, random)


def test_only_anchors_in_view_count():
    """A tag along a hundred anchors of which six are received at a time."""
    anchors_m = np.array([(3.0 * k, 4.0 * (k % 2), 0.0) for k in range(100)])
    frames = np.arange(94 * 60)
    path_m = np.column_stack([7.0 + 3.0 * frames / 60.0, np.full(len(frames), 1.0), np.zeros(len(frames))])
    packets = along(path_m, frames // 60 + frames % 6, anchors_m, 1)
    estimator = Estimator(settings_of(MESH, drop_s=0.1), anchors_m)
    estimator.start(int(packets.rx_ticks[0]), path_m[0, :2], 1e-4 * np.eye(2), 400.0)
    estimator.track(packets)
    assert len(seen(estimator.state).anchors) <= 8
    assert seen(estimator.state).status["rejected"] < 0.01 * len(frames)
    assert np.linalg.norm(estimator.motion()[0][:2] - path_m[-1, :2]) < 0.2


def test_an_anchor_whose_counter_starts_anew_is_taken_up_again():
    episode = episode_of(MESH, 60)
    run = tracked(begun(episode, settings_of(MESH)), jumped(episode.packets, 4, 180, 3e8))
    assert seen(run.estimator.state).status["clock_restarts"] == 1
    assert np.linalg.norm(run.errors(episode)[60:], axis=1).max() < 0.15


def test_a_new_anchor_is_told_of_first():
    estimator = Estimator(settings_of(PLAIN))
    estimator.start(0, np.array([3.0, 4.0]), np.eye(2), 1.0)
    for n, anchor_m in enumerate(LAB_M):
        estimator.know_anchor(7 + n, anchor_m)
    assert estimator.process(7, 0, 100, 50) == JOINED
    assert estimator.clock(7) is not None
    assert estimator.clock(8) is None


# Relays and strange packets


def without_relays(packets):
    return replace(packets, relays=np.empty((0, 4), np.int64), ends=np.zeros_like(packets.ends))


def test_relays_of_missed_packets_are_passed_over_and_others_count_once():
    packets, missed = (episode := episode_of(MESH, 30)).packets, episode.packets.relays.copy()
    missed[:, 2] = (missed[:, 2] + 100) % 256
    doubled = np.argsort(np.tile(owners(packets), 2), kind="stable")
    twice = replace(packets, relays=np.tile(packets.relays, (2, 1))[doubled], ends=2 * packets.ends)
    pairs = [(without_relays(packets), replace(packets, relays=missed)), (packets, twice)]
    used = []
    for one, other in pairs:
        once, again = (begun(episode, settings_of(MESH)) for _ in range(2))
        once.track(one)
        again.track(other)
        assert np.array_equal(seen(once.state).x, seen(again.state).x)
        assert np.array_equal(seen(once.state).P, seen(again.state).P)
        used.append((once, again))
    assert same(used[0][0].state, used[0][1].state)
    assert seen(used[0][1].state).status["relays_used"] == seen(used[0][1].state).status["relays_rejected"] == 0
    assert seen(used[1][0].state).status["relays_used"] > 800


def test_relays_of_oneself_and_of_nonsense_do_no_harm():
    episode = episode_of(MESH, 30)
    relays = episode.packets.relays.copy()
    relays[::3, 1] = relays[::3, 0]
    relays[1::3, 3] += 1 << 38
    run = tracked(begun(episode, settings_of(MESH)), replace(episode.packets, relays=relays))
    assert seen(run.estimator.state).status["relays_rejected"] > 100
    assert np.isfinite(seen(run.estimator.state).x).all()
    assert np.linalg.norm(run.errors(episode)[-1]) < 0.15


def test_relays_that_come_two_superframes_late_still_help_and_do_not_deceive():
    """Their packets' TX noise is forgotten by then and counts as independent."""
    ratios, squares = [], []
    for seed in range(60):
        packets = (episode := episode_of(MESH, 80, seed)).packets
        ends = np.concatenate([np.zeros(12, np.int64), packets.ends[:-12]])
        runs = [begun(episode, settings_of(MESH), seed=seed) for _ in range(2)]
        runs[0].track(replace(packets, relays=packets.relays[: ends[-1]], ends=ends))
        runs[1].track(without_relays(packets))
        (x, P), (_, alone) = (run.motion() for run in runs)
        error = x[:2] - episode.path_m[-1, :2]
        squares.append(error @ np.linalg.solve(P[:2, :2], error))
        ratios.append(np.trace(P[:2, :2]) / np.trace(alone[:2, :2]))
    assert np.mean(ratios) < 0.7
    assert 1.3 < np.mean(squares) < 2.8  # 2, 99.9 % interval of 60 episodes


def test_what_comes_twice_late_or_with_impossible_stamps_changes_nothing():
    episode = episode_of(MESH, 60)
    bare, other = (begun(episode, settings_of(MESH)) for _ in range(2))
    packets = list(one_by_one(episode.packets))
    for k, (anchor, sequence, rx_ticks, tx_ticks, relays) in enumerate(packets):
        outcome = bare.process(anchor, sequence, rx_ticks, tx_ticks, relays)
        assert other.process(anchor, sequence, rx_ticks, tx_ticks, relays) == outcome
        if k > 60 and k % 7 == 0:
            assert other.process(anchor, sequence, rx_ticks + 5, tx_ticks, relays) == REJECTED
            assert other.process(*packets[k - 3]) == STALE
            assert other.process(anchor, sequence + 1, rx_ticks + 1000, tx_ticks + (1 << 37)) == REJECTED
    assert np.array_equal(seen(bare.state).x, seen(other.state).x)
    assert np.array_equal(seen(bare.state).P, seen(other.state).P)
    assert seen(other.state).status["stale"] > 30
    assert seen(other.state).status["impossible"] > 60


def test_wide_states_stay_honest_near_anchors():
    """At 0.7 m ranges of a few metres are curved by more than the stamps' noise; taken as straight, NEES is 1.74."""
    found = []
    for seed in range(100):
        episode = episode_of(MESH, 40, seed)
        keep = np.random.default_rng(seed + 50).random(len(episode.path_m)) >= 0.8
        keep[:12] = True
        run = tracked(begun(episode, settings_of(MESH), std_m=0.7, seed=seed), kept(episode.packets, keep))
        found.append(nees((run.motions[:, :2] - episode.path_m[keep][:, :2])[12:], run.covariances[12:]))
    assert np.mean(found) < 1.4
