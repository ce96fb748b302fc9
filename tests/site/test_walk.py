"""A tag that is carried around, in a survey: drawn walks against their truth, simulated air, and flights."""

import gzip
from functools import partial
from itertools import combinations

import numpy as np
import pytest
import random_sites
from msgspec.structs import replace

from skyless.core.protocol1.anchor import Anchor
from skyless.core.ticks import TICK_M
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.impairments import DelayError
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Waypoints
from skyless.sim.world import World
from skyless.site.survey.legs import RelayedDifferences
from skyless.site.survey.problem import solve_least_squares
from skyless.site.survey.walk import TAG_STD_M, EpochCollector, TagEpochs, WalkRows, fit_with_tag, tag_ranges
from support.alignment import aligned_errors_m
from support.bench import LAB, ROOM

RANGE_STD_M, DELAY_STD_M = 0.03, 0.15
LAB_M = np.array([(anchor.x_m, anchor.y_m, 0.0) for anchor in LAB.anchors])
ROOM_M = np.array(
    [(0, 0, 0.4), (8, 0, 2.6), (8, 6, 0.4), (0, 6, 2.6), (4, 0, 2.6), (8, 3, 0.4), (4, 6, 2.6), (0, 3, 0.4)]
) + np.random.default_rng(7).uniform(-0.3, 0.3, (8, 3))
HALL_M = np.array([(x, y, 6.0) for y in (0, 12, 24) for x in (0, 12, 24, 36)])
HALL_M[:, :2] += np.random.default_rng(8).uniform(-1.0, 1.0, (12, 2))
HALL_M[:, 2] += np.random.default_rng(9).uniform(-0.3, 0.3, 12)


def problem_of(rng, positions_m, planar, range_std_m=RANGE_STD_M, delay_std_m=DELAY_STD_M):
    """Ranges with a constant error of each pair, and the true delays."""
    n = len(positions_m)
    first, second = np.triu_indices(n, 1)
    delay_m = rng.normal(0.0, delay_std_m, n)
    distance_m = np.linalg.norm(positions_m[first] - positions_m[second], axis=1)
    range_m = distance_m + delay_m[first] + delay_m[second] + rng.normal(0.0, range_std_m, len(first))
    stds_m = {"delay_std_m": delay_std_m, "std_m": range_std_m}
    axes = {"dimensions": 2 if planar else 3, "heights": 0.0}
    return random_sites.problem_of(positions_m, first, second, range_m, **axes, **stds_m), delay_m


def path_of(rng, positions_m, epochs, height_m):
    """Half a metre in each epoch, from one random point to the next."""
    low_m, high_m = positions_m.min(axis=0)[:2], positions_m.max(axis=0)[:2]
    points_m = rng.uniform(low_m, high_m, (epochs, 2))
    walked_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points_m, axis=0), axis=1)))
    along_m = 0.5 * np.arange(epochs)
    return np.column_stack(
        [*(np.interp(along_m, walked_m, points_m[:, axis]) for axis in (0, 1)), along_m * 0 + height_m]
    )


NONE_BETWEEN = dict.fromkeys(combinations(range(12), 2), 0.0)
"""Pair ranges of differences that hold none."""


def epochs_of(rng, positions_m, delay_m, path_m, known_height=False, noise_m=0.046, reflection_m=0.05):
    """Differences to the first anchor; their noise is that of ranges, whose clock is another in every epoch."""
    k, n = len(path_m), len(positions_m)
    distance_m = np.linalg.norm(path_m[:, None] - positions_m[None], axis=2)
    ranges_m = distance_m + delay_m + rng.normal(0.0, np.hypot(noise_m, reflection_m), (k, n))
    epoch, second = np.divmod(np.arange(k * (n - 1)), n - 1)
    known_m = np.full((k, 3), np.nan)
    if known_height:
        known_m[:, 2] = path_m[:, 2]
    return TagEpochs(
        tuple(range(n)),
        0.5 * np.arange(k),
        epoch,
        np.zeros(k * (n - 1), dtype=np.int64),
        second + 1,
        (ranges_m[:, 1:] - ranges_m[:, :1]).ravel(),
        np.zeros(k * (n - 1)),
        np.full(k * (n - 1), 20),
        known_m=known_m,
    )


def errors_m(found_m, true_m):
    """Horizontal and vertical rms after the best rigid alignment."""
    error_m = aligned_errors_m(found_m, true_m)
    return np.sqrt((error_m[:, :2] ** 2).sum(axis=1).mean()), np.sqrt((error_m[:, 2] ** 2).mean())


def test_rows_have_the_cost_and_its_slope():
    """The reduced rows give the cost of the whole problem and its derivative, which finite differences show."""
    rng = np.random.default_rng(1)
    epochs = epochs_of(rng, ROOM_M, np.zeros(8), path_of(rng, ROOM_M, 20, 1.2))
    at_m, delay_m = ROOM_M + rng.normal(0.0, 0.05, ROOM_M.shape), rng.normal(0.0, 0.05, 8)
    rows = WalkRows(epochs, tag_ranges(epochs, NONE_BETWEEN), ROOM_M)
    jacobian, residual = rows.rows(at_m, delay_m)
    assert residual @ residual == pytest.approx(rows.cost, rel=1e-9)
    unknown = np.concatenate([at_m.ravel(), delay_m])
    for column in (0, 5, 14, 23, 24, 30):
        step = np.zeros(32)
        step[column] = 1e-4
        costs = []
        for moved in (unknown + step, unknown - step):
            _, other = rows.rows(moved[:24].reshape(8, 3), moved[24:])
            costs.append(other @ other)
        assert (costs[0] - costs[1]) / 2e-4 == pytest.approx(-2.0 * (jacobian.T @ residual)[column], rel=2e-3, abs=0.1)


def test_rows_say_nothing_about_rigid_motion():
    rng = np.random.default_rng(2)
    epochs = epochs_of(rng, ROOM_M, np.zeros(8), path_of(rng, ROOM_M, 40, 1.2))
    jacobian, _ = WalkRows(epochs, tag_ranges(epochs, NONE_BETWEEN), ROOM_M).rows(ROOM_M, np.zeros(8))
    shift = np.concatenate([np.tile([1.0, 2.0, -1.0], 8), np.zeros(8)])
    turned = np.concatenate([np.cross([0.3, -0.2, 1.0], ROOM_M).ravel(), np.zeros(8)])
    common = np.concatenate([np.zeros(24), np.ones(8)])
    for motion in (shift, turned, common):
        assert np.linalg.norm(jacobian @ motion) < 1e-3 * np.linalg.norm(jacobian, 2) * np.linalg.norm(motion)


@pytest.mark.parametrize(
    ("positions_m", "planar", "height_m", "xy", "z"),
    [(LAB_M, True, 0.0, 0.80, None), (ROOM_M, False, 1.2, 0.80, 0.85), (HALL_M, False, 1.2, 0.85, 0.3)],
    ids=["lab", "room", "hall"],
)
@pytest.mark.statistical
def test_a_minute_of_walking(positions_m, planar, height_m, xy, z):
    """A fourth or more off the errors of the ranges alone, and heights of a ceiling where they had none (SURVEY 6)."""
    alone_m, joint_m = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        problem, delay_m = problem_of(rng, positions_m, planar)
        start_m = positions_m + rng.normal(0.0, 0.1, positions_m.shape) * [1.0, 1.0, 0.0 if planar else 1.0]
        alone = solve_least_squares(problem, start_m)
        epochs = epochs_of(rng, positions_m, delay_m, path_of(rng, positions_m, 120, height_m), known_height=planar)
        joint = fit_with_tag(problem, range(len(positions_m)), [alone], epochs, NONE_BETWEEN)
        assert joint.solution is not None, joint.sentence
        alone_m.append(errors_m(alone.position_m, positions_m))
        joint_m.append(errors_m(joint.solution.position_m, positions_m))
    before, after = (np.sqrt(np.mean(np.square(one), axis=0)) for one in (alone_m, joint_m))
    assert after[0] < xy * before[0]
    if z is not None:
        assert after[1] < z * before[1]


@pytest.mark.statistical
def test_the_stated_errors_are_true():
    """Of delays and distances, whose errors are normal: the mean square over the stated variance is 1."""
    squares = []
    for seed in range(40):
        rng = np.random.default_rng(100 + seed)
        problem, delay_m = problem_of(rng, ROOM_M, planar=False, range_std_m=0.01, delay_std_m=0.05)
        offset_m = rng.normal(0.0, 0.07, 8)
        path_m = path_of(rng, ROOM_M, 60, 1.2)
        epochs = epochs_of(rng, ROOM_M, delay_m + offset_m, path_m, noise_m=TAG_STD_M, reflection_m=0.0)
        alone = solve_least_squares(problem, ROOM_M)
        joint = fit_with_tag(problem, range(8), [alone], epochs, NONE_BETWEEN).solution
        covariance = np.linalg.pinv(joint.information, rcond=1e-10, hermitian=True)
        direction = np.append(np.zeros(24), np.eye(8)[seed % 8] - np.eye(8)[(seed + 3) % 8])
        error = direction[24:] @ (joint.delay_m - delay_m)
        squares.append(error**2 / (direction @ covariance @ direction))
    assert 0.5 < np.mean(squares) < 1.65  # χ² of 40 degrees of freedom: 0.1 % and 99.6 %


def test_a_walk_chooses_between_results_that_the_ranges_cannot_tell_apart():
    """An anchor that only three others in one line receive is on either side of them."""
    rng = np.random.default_rng(3)
    positions_m = np.array([(0, 0, 0), (4, 0, 0), (8, 0, 0), (0, 6, 0), (8, 6, 0), (4, 3, 0)], dtype=np.float64)
    whole, delay_m = problem_of(rng, positions_m, planar=True, range_std_m=0.01, delay_std_m=0.0)
    kept = (whole.second != 5) | (whole.first < 3)
    problem = replace(
        whole,
        first=whole.first[kept],
        second=whole.second[kept],
        range_m=whole.range_m[kept],
        variance_m2=whole.variance_m2[kept],
    )
    mirrored_m = positions_m.copy()
    mirrored_m[5, 1] = -3.0
    both = [solve_least_squares(problem, one) for one in (mirrored_m, positions_m)]
    assert abs(both[0].cost - both[1].cost) < 4.0
    path_m = path_of(rng, positions_m, 60, 0.0)
    joint = fit_with_tag(
        problem, range(6), both, epochs_of(rng, positions_m, delay_m, path_m, known_height=True), NONE_BETWEEN
    )
    assert (joint.chosen, joint.possible) == (1, (1,))


@pytest.mark.parametrize(
    ("fault", "words"),
    [("noise", "not used"), ("moved", "not used"), ("short", "10 are needed"), ("no pairs", "10 are needed")],
)
@pytest.mark.statistical
def test_a_walk_that_does_not_fit_is_not_used(fault, words):
    rng = np.random.default_rng(4)
    problem, delay_m = problem_of(rng, ROOM_M, planar=False)
    path_m = path_of(rng, ROOM_M, 5 if fault == "short" else 100, 1.2)
    at_m = ROOM_M + (np.eye(8, 3) * 1.5 if fault == "moved" else 0.0)
    epochs = epochs_of(rng, at_m, delay_m, path_m, noise_m=0.5 if fault == "noise" else 0.05)
    alone = solve_least_squares(problem, ROOM_M)
    joint = fit_with_tag(problem, range(8), [alone], epochs, {} if fault == "no pairs" else NONE_BETWEEN)
    assert joint.solution is None
    assert words in joint.sentence


@pytest.mark.site
def test_late_receptions_are_left_out():
    """One anchor in ten is 0.6 m late in a while of the walk."""
    rng = np.random.default_rng(5)
    problem, delay_m = problem_of(rng, ROOM_M, planar=False)
    epochs = epochs_of(rng, ROOM_M, delay_m, path_of(rng, ROOM_M, 120, 1.2))
    late = (epochs.epoch % 10 == 0) & (epochs.second == 1 + epochs.epoch // 10 % 7)
    spoilt = replace(epochs, difference_m=epochs.difference_m + 0.6 * late)
    alone = solve_least_squares(problem, ROOM_M)
    clean, joint = (fit_with_tag(problem, range(8), [alone], one, NONE_BETWEEN) for one in (epochs, spoilt))
    assert joint.rows.excluded_share > 0.5 * late.sum() / (8 * 120)
    assert np.abs(clean.solution.position_m - joint.solution.position_m).max() < 0.03


def test_epochs_are_means_without_outliers_and_ranges_follow():
    rng = np.random.default_rng(6)
    collector = EpochCollector()
    ranges_m, mutual_m = np.array([3.0, 5.0, 4.0]), {(2, 7): 6.0, (2, 9): 7.0, (7, 9): 8.0}
    ids, speed = (2, 7, 9), np.array([0.5, -0.3, 0.0])
    for k in range(400):
        t_s = 100.0 + 0.005 * k
        a, b = rng.choice(3, 2, replace=False).tolist()
        value_m = (ranges_m + speed * (t_s - 100.0)) @ (np.eye(3)[b] - np.eye(3)[a])
        value_m += mutual_m[min(ids[a], ids[b]), max(ids[a], ids[b])] + (3.0 if k % 23 == 0 else rng.normal(0.0, 0.02))
        collector.add(t_s, ids[a], ids[b], value_m)
    epochs = collector.epochs()
    assert epochs.anchors == ids
    assert len(epochs.t_s) == 4
    found_m = tag_ranges(epochs, mutual_m)
    expected_m = ranges_m + speed * (epochs.t_s - 100.0)[:, None]
    error_m = found_m - expected_m
    assert np.abs(error_m - error_m.mean(axis=1, keepdims=True)).max() < 0.025
    assert np.isnan(tag_ranges(epochs, {(2, 7): 6.0})[:, 2]).all()


def test_nothing_received_is_no_epoch():
    epochs = EpochCollector().epochs()
    assert len(epochs.t_s) == 0
    assert tag_ranges(epochs, {}).shape == (0, 0)


@pytest.mark.parametrize("site", [LAB, ROOM], ids=["lab", "room"])
@pytest.mark.site
def test_differences_of_simulated_air_are_free_of_delays_and_clocks(site):
    """Raw stamps of a moving tag with anchors whose delays are 0.2 m off, against geometry; no position is used."""
    rng = np.random.default_rng(7)
    errors = tuple(DelayError(anchor.id, *(rng.normal(0.0, 0.2, 2) / TICK_M)) for anchor in site.anchors)
    track = Waypoints([(1, 1, 1.2), (4, 5, 1.2), (5, 2, 1.2)], 1.0, loop=True, corner_s=0.5)
    faults = replace(impairments_of(Request(site), site), delay_errors=errors)
    world = World(site, partial(Anchor, site), [TagSpec(track)], faults, 1)
    collector, differences = EpochCollector(), RelayedDifferences(site.id)
    times_s, truth_m = [], []
    for broadcast in world.run(5.0):
        for _, reception, at_m in broadcast.receptions():
            times_s.append(reception.host_s)
            truth_m.append(at_m)
            for one in differences.add(reception):
                collector.add(reception.host_s - one.age_s, one.first, one.second, one.difference_m)
    epochs = collector.epochs()
    positions_m = {anchor.id: np.array((anchor.x_m, anchor.y_m, anchor.z_m)) for anchor in site.anchors}
    delays_m = {one.anchor: (one.tx_ticks + one.rx_ticks) / 2.0 * TICK_M for one in errors}
    mutual_m = {
        (a, b): np.linalg.norm(positions_m[a] - positions_m[b]) + delays_m[a] + delays_m[b]
        for a in positions_m
        for b in positions_m
        if a < b
    }
    found_m = tag_ranges(epochs, mutual_m)[1:-1]
    path_m = np.array(truth_m)
    at_m = np.column_stack([np.interp(epochs.t_s[1:-1], times_s, path_m[:, axis]) for axis in range(3)])
    expected_m = np.column_stack([np.linalg.norm(at_m - positions_m[a], axis=1) + delays_m[a] for a in epochs.anchors])
    error_m = found_m - expected_m
    error_m -= error_m.mean(axis=1, keepdims=True)
    assert np.sqrt((error_m**2).mean()) < 0.02  # a single difference has 0.1 m


def flight_of(folder, trial):
    """A drone's flight as epochs, without take-off and landing."""
    with gzip.open(folder / f"const1-trial{trial}-tdoa2_tdoa.csv.gz") as table:
        rows = np.loadtxt(table, delimiter=",", skiprows=1)
    with gzip.open(folder / f"const1-trial{trial}-tdoa2_pose.csv.gz") as table:
        pose = np.loadtxt(table, delimiter=",", skiprows=1)
    collector = EpochCollector()
    for row in rows[np.interp(rows[:, 0], pose[:, 0], pose[:, 3]) > 0.3]:
        collector.add(row[0], int(row[1]), int(row[2]), row[3])
    return collector.epochs()


@pytest.mark.statistical
def test_flights_mend_the_heights_of_a_room(recordings):
    """Ranges of the surveyed positions with errors of 5.5 cm, as pairs of these radios have, and 0.3 m of start error.

    With 12 seeds and three flights heights come from 4.8 to 4.0 cm and horizontal positions from 3.7 to 3.9 (SURVEY.md
    section 6: from 4.9 to 2.5–5.6, from 3.4 to 3.4–3.9).
    """
    folder = recordings / "util_flights"
    positions_m = np.loadtxt(folder / "anchors_const1.csv", delimiter=",", skiprows=1)[:, 1:]
    flights = [flight_of(folder / "const1", trial) for trial in (1, 2, 3)]
    alone_m, joint_m = [], []
    for seed in range(1, 5):
        rng = np.random.default_rng(seed)
        problem, _ = problem_of(rng, positions_m, planar=False, range_std_m=0.055, delay_std_m=0.0)
        alone = solve_least_squares(problem, positions_m + rng.normal(0.0, 0.3, positions_m.shape))
        for epochs in flights:
            joint = fit_with_tag(problem, range(8), [alone], epochs, NONE_BETWEEN)
            assert joint.solution is not None, joint.sentence
            alone_m.append(errors_m(alone.position_m, positions_m))
            joint_m.append(errors_m(joint.solution.position_m, positions_m))
    before, after = (np.sqrt(np.mean(np.square(one), axis=0)) for one in (alone_m, joint_m))
    assert after[1] < 0.95 * before[1]
    assert after[0] < 1.15 * before[0]
