"""Late packets, paths that are blocked, clocks that jump or warm up, anchors' reports of their clocks."""

import numpy as np
import pytest
from estimator_builders import (
    LAB_M,
    MESH,
    PLAIN,
    SLOT_S,
    Case,
    begun,
    episode_of,
    jumped,
    kept,
    late,
    late_from,
    nees,
    one_by_one,
    rmse,
    seen,
    settings_of,
    tracked,
    where,
)
from msgspec.structs import replace
from scipy.stats import chi2

from skyless.core.clock_filter import ClockFilter, clock_noise
from skyless.core.estimator import monitor
from skyless.core.estimator.estimator import Report
from skyless.core.estimator.faults import is_lost
from skyless.core.estimator.process import ACCEPTED, REJECTED
from skyless.core.estimator.settings import TUNING
from skyless.core.estimator.state import find_anchor
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, SUBTICKS, TICK_M, TICK_MASK, TICK_S
from skyless.research.studies.efficiency import WHITE_FM

pytestmark = pytest.mark.site

ROOM_ERRORS = {"survey_std_m": 0.02, "range_std_m": 0.03, "slope_std_m": 0.05, "place_std_m": 0.005}
AGILE = Case(qa=0.3)
CASES = pytest.mark.parametrize("case", [replace(PLAIN, qa=0.3), AGILE], ids=["plain", "mesh"])
MODULO = SUBTICKS * (TICK_MASK + 1)


def run_of(episode, packets, case=AGILE, **others):
    return tracked(begun(episode, settings_of(case, **others), std_m=0.1), packets)


def walking(case=AGILE, superframes=200, seed=1, **others):
    """A tag that walks in a circle of 2 m in the middle of the room, at 0.8 m/s, from anywhere on it."""
    angle = np.random.default_rng(seed).uniform(0.0, 6.0) + 0.4 * SLOT_S * np.arange(superframes * len(LAB_M))
    path_m = np.column_stack([3.0 + 2.0 * np.cos(angle), 4.0 + 2.0 * np.sin(angle), np.zeros(len(angle))])
    return episode_of(case, superframes, seed, path_m=path_m, **others)


@pytest.mark.parametrize(("late_share", "added_m2"), [(0.0, 0.0), (0.1, TUNING.late_std_m**2)])
def test_what_is_known_of_a_clock_at_first_has_the_variance_of_the_packet(late_share, added_m2):
    """A path that looks blocked multiplies that of the reception; where packets are often late, so may this one be."""
    episode, variances_m2 = walking(superframes=2), []
    for share, factor in ((0.0, 1.0), (late_share, 5.0)):
        estimator = begun(episode, settings_of(AGILE), std_m=0.1)
        estimator.state.status.late_share = share
        estimator.process(*next(iter(one_by_one(episode.packets))), variance_factor=factor)
        offset = estimator.state.layout.offset
        variances_m2.append(seen(estimator.state).P[offset, offset])
    wider_m2 = 4.0 * estimator.settings.rx_variance_m2 + added_m2
    assert variances_m2[1] - variances_m2[0] == pytest.approx(wider_m2, rel=1e-6)


@CASES
@pytest.mark.parametrize("late_m", [0.5, 2.0, 30.0, -2.0])
def test_a_single_late_packet_is_left_out(case, late_m):
    episode, frame = walking(case), 600
    at = np.arange(len(episode.path_m)) == frame
    clean, hit = (run_of(episode, p, case) for p in (episode.packets, late(episode.packets, at * late_m)))
    assert hit.outcomes[frame] == REJECTED
    assert np.all(hit.outcomes[frame + 1 : frame + 30] == ACCEPTED)
    assert seen(hit.estimator.state).status["obstructions"] == 0
    assert np.linalg.norm(hit.motions[:, :2] - clean.motions[:, :2], axis=1).max() < 0.03


@CASES
@pytest.mark.parametrize("late_m", [0.3, 2.0])
@pytest.mark.parametrize("errors", [{}, ROOM_ERRORS], ids=["exact", "range errors"])
def test_a_path_that_is_blocked_is_opened_and_closed_again(case, late_m, errors):
    """From 1.5 s to 2.25 s; the second or third packet shows it, and the one or two after it has gone."""
    costs = []
    for seed in range(4):
        episode, anchor = walking(case, 250, seed), seed + 1
        packets = late_from(episode.packets, anchor, late_m, 600, 900)
        estimator, obstructed = begun(episode, settings_of(case, **errors), std_m=0.1), []
        for packet in one_by_one(packets):
            estimator.process(*packet)
            obstructed.append(estimator.obstructed)
        own = packets.anchors == anchor
        blocked = own & (np.arange(len(own)) >= 600) & (np.arange(len(own)) < 900)
        found = next(k for k in range(600, len(obstructed)) if anchor in obstructed[k])
        assert np.count_nonzero(blocked[600 : found + 1]) in (2, 3)
        assert set(obstructed[found:899]) == {(anchor,)}
        over = next(k for k in range(900, len(obstructed)) if anchor not in obstructed[k])
        assert np.count_nonzero(own[900 : over + 1]) in (1, 2, 3)
        assert set(obstructed[over:]) == {()}
        clean, hit = (run_of(episode, p, case, **errors) for p in (episode.packets, packets))
        costs.append((rmse(hit.errors(episode)[600:]), rmse(clean.errors(episode)[600:])))
    hit_m, clean_m = np.sqrt(np.mean(np.square(costs), axis=0))
    assert hit_m < 1.6 * clean_m


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_an_obstruction_outlasts_late_packets_and_ends_as_it_returns(share):
    """0.3 m from 1.5 s to 3.75 s, which then vanish within a second."""
    errors_m = []
    for seed in range(4):
        episode, draw, anchor = walking(superframes=700, seed=seed), np.random.default_rng(seed + 100), seed + 1
        number = np.arange(len(episode.path_m))
        late_m = np.where(number < 600, 0.0, np.clip(0.3 * (1900 - number) / 400, 0.0, 0.3))
        single_m = np.where((draw.random(len(number)) < share) & (number > 200), draw.exponential(1.0, len(number)), 0)
        packets = late(episode.packets, late_m * (episode.packets.anchors == anchor) + single_m)
        estimator, marked = begun(episode, settings_of(AGILE, **ROOM_ERRORS), std_m=0.1), []
        for k, packet in enumerate(one_by_one(packets)):
            estimator.process(*packet)
            marked.append(anchor in estimator.obstructed)
            errors_m.append(estimator.position_m() - episode.path_m[k, :2])
        assert all(marked[700:1500])
        assert not any(marked[2900:])
    assert rmse(np.array(errors_m)) < 0.035


@CASES
@pytest.mark.parametrize("share", [0.05, 0.2])
def test_where_packets_are_often_late_few_are_believed_and_errors_stay_small(case, share):
    clean, hostile = [], []
    for seed in range(6):
        episode = walking(case, 400, seed)
        draw = np.random.default_rng(seed + 100)
        count = len(episode.path_m)
        wrong = np.where(draw.random(count) < share, draw.exponential(1.0, count), 0.0)
        wrong[:60] = 0.0  # a late packet while an anchor joins makes its clock wrong for long
        clean.append((run_of(episode, episode.packets, case), episode))
        hostile.append((run_of(episode, late(episode.packets, wrong), case), episode))
        s = hostile[-1][0].estimator.state
        assert 0.3 * share < s.status.late_share < 1.5 * share
    errors = [np.concatenate([run.errors(episode)[900:] for run, episode in runs]) for runs in (clean, hostile)]
    assert rmse(errors[1]) < 1.6 * rmse(errors[0])
    assert 0.4 < nees(errors[1], np.concatenate([run.covariances[900:] for run, _ in hostile])) < 1.5


@pytest.mark.parametrize("jump_m", [2.0, -30.0, 250.0, 3e6])
def test_a_clock_that_jumps_is_taken_up_again(jump_m):
    for seed in range(4):
        episode = walking(seed=seed)
        run = run_of(episode, jumped(episode.packets, 4, 600, jump_m))
        status = seen(run.estimator.state).status
        assert status["clock_restarts"] == 1
        assert run.estimator.obstructed == ()
        assert np.linalg.norm(run.errors(episode)[300:], axis=1).max() < 0.2


def test_a_tags_clock_that_jumps_is_followed():
    """All packets are late at once: no anchor is blamed for long, and the position comes back."""
    episode = walking(superframes=400)
    run = run_of(episode, late(episode.packets, np.where(np.arange(len(episode.path_m)) >= 600, 1.0, 0.0)))
    assert np.linalg.norm(run.errors(episode)[1800:], axis=1).max() < 0.3 or is_lost(run.estimator.state)


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_a_crystal_that_warms_up_costs_little(share):
    """The tag's, by 1 ppm with a time constant of 20 s; with a random start of the rate."""
    pairs, lost = [], share
    for seed in range(6):
        errors = []
        for ppm in (0.0, 1.0):
            warmed = ppm * 300.0
            episode = walking(AGILE, 600, seed, rate_of=lambda t, by=warmed: by * (1.0 - np.exp(-t / 20.0)))
            keep = np.random.default_rng(seed + 70).random(len(episode.path_m)) >= lost
            run = run_of(episode, kept(episode.packets, keep))
            errors.append((run.motions[:, :2] - episode.path_m[keep][:, :2])[900:])
        pairs.append([rmse(error) for error in errors])
    without, warming = np.sqrt(np.mean(np.square(pairs), axis=0))
    assert warming < 1.3 * without


@CASES
def test_oscillators_as_assumed_are_left_alone(case):
    """What the process noise of the tag's clock and motion is multiplied by, after it has come down from the start."""
    shares = []
    for seed in range(10):
        run, assumed = walking(case, 300, seed), settings_of(case)
        estimator, scales = begun(run, assumed, std_m=0.1), []
        for packet in one_by_one(run.packets):
            estimator.process(*packet)
            scales.append((estimator.state.status.q_scale, estimator.state.status.walk_scale))
        shares.append(np.mean(np.array(scales)[900:] > 1.5, axis=0))
    assert np.all(np.mean(shares, axis=0) < 0.1)


def test_hard_turns_are_followed():
    """Still for 5 s, then away with 3 m/s² up to 5 m/s, on a circle that takes 3 m/s² across as well."""
    time_s = np.arange(4000) * SLOT_S
    speed = np.clip(3.0 * (time_s - 5.0), 0.0, 5.0)
    angle = np.cumsum(speed) * SLOT_S / 8.0
    path_m = np.column_stack([12.0 + 8.0 * np.sin(angle), 8.0 + 8.0 * (1.0 - np.cos(angle)), np.zeros(4000)])
    hall_m = 4.0 * LAB_M
    episode = episode_of(AGILE, 667, 1, hall_m, path_m=np.vstack([path_m, path_m[-2:]]))
    run = tracked(begun(episode, settings_of(AGILE), hall_m, std_m=0.1), episode.packets)
    errors = np.linalg.norm(run.errors(episode), axis=1)
    assert rmse(run.errors(episode)[200:1900]) < 0.03
    assert errors.max() < 0.3
    assert rmse(run.errors(episode)[2200:]) < 0.06
    assert not is_lost(run.estimator.state)


def test_what_the_tag_has_lost_says_nothing():
    """Relays of packets that it did not receive, and silence: the covariance grows, the state stays."""
    episode = walking()
    keep = (np.arange(len(episode.path_m)) < 600) | (np.arange(len(episode.path_m)) >= 800)
    run = run_of(episode, kept(episode.packets, keep))
    errors = (run.motions[:, :2] - episode.path_m[keep][:, :2])[600:]
    assert np.trace(run.covariances[600]) > 2.0 * np.trace(run.covariances[599])
    assert np.linalg.norm(errors, axis=1).max() < 0.3


# Reports of anchors' clocks


def reports_of(packets, case, anchors_m=LAB_M):
    """What each anchor's own clock filter says, of the first anchor's clock, where nothing is lost among anchors."""
    noise = clock_noise(WHITE_FM, case.random_walk_fm)
    variance = 2.0 * (SPEED_OF_LIGHT_MPS * case.noise_ps * 1e-12) ** 2
    filters, sent, found = [ClockFilter(noise, variance) for _ in anchors_m], {}, []
    for anchor, sequence, _, tx_ticks, relays in one_by_one(packets):
        if anchor == 0:
            sent[sequence] = tx_ticks
        for sender, number, rx_ticks in relays:
            if sender == 0:
                way_m = float(np.linalg.norm(anchors_m[anchor] - anchors_m[0]))
                filters[anchor].update(sent[number], rx_ticks, way_m)
        said = Report(-1, 0, 0.0)
        if filters[anchor].updates > 1:
            ticks, fraction, variance_m2 = filters[anchor].to_master(tx_ticks)
            said = Report(0, ((tx_ticks - ticks) * SUBTICKS - round(fraction * SUBTICKS)) % MODULO, variance_m2)
        found.append(said)
    return found


def with_losses(case, share, seed, superframes=200):
    """Packets, reports and places, of which a share is lost; the first two superframes are received."""
    episode = walking(case, superframes, seed)
    keep = np.random.default_rng(seed + 50).random(len(episode.path_m)) >= share
    keep[:12] = True
    reports = [said for said, there in zip(reports_of(episode.packets, case), keep, strict=True) if there]
    return episode, kept(episode.packets, keep), reports, episode.path_m[keep]


def processed(estimator, packets, reports):
    motions, covariances = [], []
    for packet, said in zip(one_by_one(packets), reports, strict=True):
        estimator.process(*packet, report=said)
        x, P = estimator.motion()
        motions.append(x[:2].copy())
        covariances.append(P[:2, :2].copy())
    return np.array(motions), np.array(covariances)


NOTHING = Report(-1, 0, 0.0)


@pytest.mark.parametrize(("case", "most"), [(PLAIN, 0.85), (MESH, 0.92)], ids=["plain", "mesh"])
def test_reports_help_where_most_is_lost_and_errors_are_as_said(case, most):
    squares, said = np.zeros(2), []
    for seed in range(30):
        episode, packets, reports, path_m = with_losses(case, 0.9, seed)
        for k, told in enumerate(([NOTHING] * len(reports), reports)):
            estimator = begun(episode, settings_of(replace(case, qa=0.3)), std_m=0.05)
            motions, covariances = processed(estimator, packets, told)
            errors = (motions - path_m[:, :2])[40:]
            squares[k] += np.square(errors).sum()
        said.append(nees(errors, covariances[40:]))
        assert seen(estimator.state).status["reports_used"] > 10
        assert seen(estimator.state).status["reports_rejected"] < 4
    assert np.sqrt(squares[1] / squares[0]) < most
    assert np.mean(said) == pytest.approx(1.0, abs=0.35)


@CASES
def test_where_nothing_is_lost_reports_change_little(case):
    episode = walking(case, 100)
    runs = []
    for told in ([NOTHING] * len(episode.path_m), reports_of(episode.packets, case)):
        estimator = begun(episode, settings_of(case), std_m=0.1)
        runs.append(processed(estimator, episode.packets, told))
    assert seen(estimator.state).status["reports_used"] < 0.1 * len(episode.path_m)
    assert np.linalg.norm(runs[0][0] - runs[1][0], axis=1)[200:].max() < 0.01


def test_a_report_replaces_what_is_known_worse():
    """K = P_xd/P for the states, (P − q)/P² for the covariance, sensitivities along; no evidence of faults."""
    episode, packets, reports, _ = with_losses(MESH, 0.9, 3)
    k = next(k for k in range(30, len(reports)) if packets.anchors[k] == 4)
    without, within = (begun(episode, settings_of(MESH)) for _ in range(2))
    arriving = list(one_by_one(packets))
    for packet in arriving[:k]:
        without.process(*packet)
        within.process(*packet)
    q = 5e-4
    without.process(*arriving[k])
    within.process(*arriving[k], report=Report(0, reports[k].subticks, q))
    s, t, place = seen(without.state), seen(within.state), where(without)
    assert t.status["reports_used"] == s.status["reports_used"] + 1
    h, (m, i) = np.zeros(len(s.x)), (find_anchor(without.state, one) for one in (0, 4))
    back_s = s.anchors["range_m"][i] / SPEED_OF_LIGHT_MPS
    h[[place.offset + m, place.offset + i]] = 1.0, -1.0
    h[[place.rate + m, place.rate + i]] = -back_s, back_s
    spread = h @ s.P @ h
    assert spread > q
    gain = s.P @ h / spread
    gain[place.slope :] = 0.0
    whole = int(s.anchors["offset_ticks"][m] - s.anchors["offset_ticks"][i]) * SUBTICKS
    off = (reports[k].subticks - whole + MODULO // 2) % MODULO - MODULO // 2
    np.testing.assert_allclose(t.x, s.x + gain * (off * TICK_M / SUBTICKS - h @ s.x), atol=1e-9)
    np.testing.assert_allclose(t.P, s.P - np.outer(gain, gain) * (spread - q), atol=1e-9 * np.abs(s.P).max())
    assert h @ t.P @ h == pytest.approx(q, rel=1e-3)
    moved = s.V - np.outer(s.V @ h, gain)
    np.testing.assert_allclose(t.V, moved, atol=1e-9 * np.abs(s.V).max())
    assert np.array_equal(t.evidence, s.evidence)


def test_wrong_reports_are_counted_and_do_nothing():
    episode, packets, reports, _ = with_losses(MESH, 0.9, 7)
    wrong = [replace(said, subticks=(said.subticks + 10_000 * SUBTICKS) % MODULO) for said in reports]
    bare, reported = (begun(episode, settings_of(MESH)) for _ in range(2))
    processed(bare, packets, [NOTHING] * len(reports))
    processed(reported, packets, wrong)
    assert seen(reported.state).status["reports_rejected"] > 10
    assert seen(reported.state).status["reports_used"] == 0
    assert np.array_equal(seen(bare.state).x, seen(reported.state).x)
    assert np.array_equal(seen(bare.state).P, seen(reported.state).P)


def test_where_the_offset_is_for_now_agrees_with_the_stamps():
    """The tag's clock less each anchor's, to the noise of the stamps."""
    episode = walking()
    estimator = run_of(episode, episode.packets).estimator
    now = int(episode.packets.rx_ticks[-1])
    for k in range(len(episode.path_m) - 6, len(episode.path_m)):
        anchor = int(episode.packets.anchors[k])
        whole, stationary_m, rate_mps = estimator.clock(anchor)
        measured = int(episode.packets.rx_ticks[k] - episode.packets.tx_ticks[k]) - whole
        flight_m = np.linalg.norm(episode.path_m[k] - LAB_M[anchor])
        later_s = (now - int(episode.packets.rx_ticks[k])) * TICK_S
        assert measured * TICK_M - flight_m + later_s * rate_mps == pytest.approx(stationary_m, abs=0.2)


def test_multipath_that_was_learnt_is_estimated_also_where_the_settings_call_ranges_exact():
    """Its variance counts in all arithmetic; else variances would fall below zero, and errors reach metres."""
    episode = walking(superframes=120)
    estimator, packets = begun(episode, settings_of(AGILE), std_m=0.1), list(one_by_one(episode.packets))
    for packet in packets[:360]:
        estimator.process(*packet)
    status = seen(estimator.state).status
    status["place_samples"], status["place_square_m2"] = TUNING.place_memory, (0.004, 0.005)
    for packet in packets[360:]:
        estimator.process(*packet)
        P = seen(estimator.state).P
        assert not P[estimator.state.n :].any()
        used = np.flatnonzero(P.diagonal())
        std = np.sqrt(P.diagonal()[used])
        assert np.linalg.eigvalsh(P[np.ix_(used, used)] / np.outer(std, std)).min() > -1e-9
    assert estimator.multipath_m is not None


def test_the_mean_of_limited_comparisons_is_that_of_chi_squared():
    limited = chi2(1).expect(lambda value: min(value, monitor._PLACE_LIMIT), lb=0.0, ub=np.inf)
    assert pytest.approx(limited, abs=1e-6) == monitor._PLACE_LIMITED_MEAN
