"""``map → odom`` of the ROS 2 package: simulated robots that start anywhere, with the antenna anywhere on them."""

import cmath
import math
from types import SimpleNamespace

import numpy as np
import pytest
from skyless_ros2.map_odom import MapOdom

STEP_S = 0.02
LATE_S = 0.05
"""Fixes come later than odometry."""


def drive(seed, seconds=60.0, slip=(0.0, 0.0)):
    """From place to place in a hall of 14 × 10 m, after 2 s of rest; between the times ``slip`` wheels slip by 20 %."""
    random = np.random.default_rng(seed)
    count, speed_mps = int(seconds / STEP_S), random.uniform(0.4, 1.0)
    std_m = random.uniform(0.05, 0.08) / math.sqrt(2.0)  # of each axis: 5 to 8 cm in the plane
    antenna_m = cmath.rect(random.uniform(0.0, 0.4), random.uniform(-math.pi, math.pi))
    scale, bias_radps = 1.0 + 0.02 * random.standard_normal(), math.radians(0.6) * random.standard_normal()
    pose, odom = [complex(*random.uniform(-5, 5, 2)), random.uniform(-3, 3)], [0j, 0.0]
    goal_m, way_m, rows = pose[0], 0.0, []
    for t_s in STEP_S * np.arange(count):
        rows.append((t_s, *pose, *odom, way_m))
        while abs(goal_m - pose[0]) < 0.5:
            goal_m = complex(random.uniform(-7, 7), random.uniform(-5, 5))
        off_rad = cmath.phase((goal_m - pose[0]) * cmath.rect(1.0, -pose[1]))
        moving = t_s >= 2.0
        speed = moving * speed_mps * (1.0 - 0.7 * min(1.0, abs(off_rad) / 1.5))
        rate = moving * min(max(1.5 * off_rad, -0.8), 0.8)
        measured = (
            scale * speed * (1.2 if slip[0] <= t_s < slip[1] else 1.0) + 0.045 * moving * random.standard_normal()
        )
        for at, forward, turning in ((pose, speed, rate), (odom, measured, rate + bias_radps)):
            at[0] += forward * STEP_S * cmath.rect(1.0, at[1] + turning * STEP_S / 2.0)
            at[1] += turning * STEP_S
        way_m += speed * STEP_S
    times_s, base_m, yaw_rad, odom_m, odom_rad, ways_m = (np.array(column) for column in zip(*rows, strict=True))
    at = np.arange(0.3, seconds - 1.0, 1.0 / random.uniform(10.0, 20.0))
    kept = math.exp(-(at[1] - at[0]) / 1.0)
    lasting, errors = complex(*random.standard_normal(2)), []
    for _ in at:  # nine tenths of the variance last for a second
        lasting = kept * lasting + math.sqrt(1.0 - kept**2) * complex(*random.standard_normal(2))
        errors.append(std_m * (0.95 * lasting + 0.3 * complex(*random.standard_normal(2))))
    outlier = (
        (random.random(len(at)) < 0.02) * random.uniform(0.3, 2.0, len(at)) * np.exp(6.28j * random.random(len(at)))
    )
    true_m = np.interp(at, times_s, base_m) + antenna_m * np.exp(1j * np.interp(at, times_s, yaw_rad))
    picked = np.unique(np.searchsorted(times_s, np.arange(0.0, seconds - 0.5, 1.0 / random.uniform(20.0, 50.0))))
    return SimpleNamespace(
        base_m=base_m[picked], yaw_rad=yaw_rad[picked], way_m=ways_m[picked], variance_m2=std_m**2,
        odometry=list(zip(times_s[picked], odom_m[picked], odom_rad[picked], strict=True)),
        fixes=list(zip(at, true_m + errors + outlier, strict=True)), fix_error_m=rms(np.abs(errors)),
    )  # fmt: skip


def follow(robot, found=None):
    """For each message of odometry: error of the heading and its standard deviation [°], and of the base [m]; NaN where
    that is not given. Also the largest jump of map → odom, at the base."""
    found, waiting, rows, before, jump_m = found or MapOdom(), list(robot.fixes), [], None, 0.0
    variance = robot.variance_m2, 0.0, robot.variance_m2
    for number, (t_s, odom_m, odom_rad) in enumerate(robot.odometry):
        while waiting and waiting[0][0] + LATE_S < t_s:
            found.add_fix(*waiting.pop(0), variance)
        found.add_odometry(t_s, odom_m, math.remainder(odom_rad, math.tau))
        heading_rad, std_rad = found.heading()
        pose, off_m = found.pose, math.nan
        if pose is not None:
            heading_rad, off_m = pose.odom_yaw_rad, abs(pose.base_m - robot.base_m[number])
            given_m = [one.odom_m + cmath.rect(1.0, one.odom_yaw_rad) * odom_m for one in (before or pose, pose)]
            assert given_m[1] == pytest.approx(pose.base_m, abs=1e-9)
            jump_m = max(jump_m, abs(given_m[1] - given_m[0]))
        before = pose
        off_rad = math.remainder(heading_rad + odom_rad - robot.yaw_rad[number], math.tau)
        rows.append((math.degrees(off_rad), math.degrees(std_rad), off_m))
    return *np.array(rows).T, jump_m


def rms(values):
    return float(np.sqrt(np.nanmean(np.square(values))))


@pytest.mark.statistical
def test_heading_and_base_of_twenty_robots_that_begin_anywhere_and_no_jump():
    early, late, normal, bases_m, fixes_m = [], [], [], [], []
    for seed in range(20):
        robot = drive(seed)
        off_deg, std_deg, off_m, jump_m = follow(robot)
        at_3_m, at_20_m = np.searchsorted(robot.way_m, (3.0, 20.0))
        given = np.flatnonzero(np.isfinite(off_m))
        assert robot.way_m[given[0]] > 2.8, "given before it can be known"
        assert jump_m < 0.05
        bases_m.append(rms(off_m[at_20_m:]))
        fixes_m.append(robot.fix_error_m)
        early += [off_deg[at_3_m], off_deg[given[0]]]
        late.append(off_deg[at_20_m])
        normal.append(off_deg[at_20_m] / std_deg[at_20_m])
    assert np.max(np.abs(early)) <= 5.0
    assert rms(bases_m) <= 0.9 * rms(fixes_m)
    assert np.max(np.divide(bases_m, fixes_m)) <= 1.1  # 35 s hold 35 independent errors of fixes
    assert np.sort(np.abs(late))[-2] <= 1.5  # a standard deviation of 0.7° at these errors: one of 30 is above 1.5°
    assert rms(late) <= 1.0
    assert rms(normal) < 1.5, "the stated standard deviation is true"


@pytest.mark.statistical
def test_wheels_that_slip_for_two_seconds_move_it_by_what_they_slipped_and_not_10_cm_beyond():
    for seed in range(10):
        without, slipping = (follow(drive(seed, slip=slip)) for slip in ((0.0, 0.0), (40.0, 42.0)))
        assert np.nanmax(slipping[2]) - np.nanmax(without[2]) <= 0.1
        assert np.nanmax(np.abs(slipping[0][-600:])) <= np.nanmax(np.abs(without[0][-600:])) + 0.5


def test_at_rest_nothing_is_known_and_the_reason_is_said():
    found = MapOdom()
    assert found.reason() == "no odometry yet"
    found.add_odometry(0.0, 0j, 0.0)
    assert "two clocks differ" in found.reason()
    for number in range(1, 60):
        found.add_fix(0.05 * number - 0.01, 3 + 4j, (0.0025, 0.0, 0.0025))
        found.add_odometry(0.05 * number, 0j, 0.0)
    assert (found.pose, found.reason()) == (None, "the robot has moved 0.0 of 3 m")


def on_its_way(seed=0):
    """An estimator that knows, and the time."""
    robot, found = drive(seed, seconds=25.0), MapOdom()
    follow(robot, found)
    assert found.pose is not None
    return found, robot.odometry[-1]


def test_odometry_that_begins_again_starts_it_again():
    found, (t_s, *_) = on_its_way()
    found.add_odometry(t_s + 0.05, 0j, 0.0)
    assert found.pose is None
    assert "odometry has jumped" in found.reason()
    found, (t_s, *pose) = on_its_way()
    found.add_odometry(t_s - 5.0, *pose)
    assert found.pose is None
    assert "time went back" in found.reason()


def test_what_is_not_finite_late_or_out_of_order_is_counted_and_changes_nothing():
    found, (t_s, odom_m, _) = on_its_way()
    before = found.pose
    for value in (math.nan, math.inf, -math.inf, 1e300):
        found.add_odometry(t_s + 0.05, complex(value, 0.0), 0.0)
        found.add_odometry(t_s + 0.05, odom_m, value)
        found.add_fix(t_s + 0.05, complex(0.0, value), (0.01, 0.0, 0.01))
        found.add_fix(t_s + 0.05, 0j, (value, 0.0, 0.01))
    found.add_fix(t_s, 0j, (-1.0, 0.0, 1.0))
    found.add_odometry(t_s, 0j, 0.0)
    found.add_odometry(t_s - 0.1, 0j, 0.0)
    for late_s in (-5.0, -math.inf, 5.0, math.nan):
        found.add_fix(t_s + late_s, 0j, (0.01, 0.0, 0.01))
    assert found.pose is before
    assert (found.counts["unusable odometry"], found.counts["unusable fixes"]) == (10, 11)
    assert found.counts["fixes of another time"] == 2


def test_without_fixes_it_goes_on_by_odometry_until_that_is_too_uncertain():
    found, (t_s, odom_m, odom_rad) = on_its_way()
    first = found.pose
    for number in range(1, 40_000):
        found.add_odometry(t_s + 0.05 * number, odom_m + 0.05 * number * cmath.rect(1.0, odom_rad), odom_rad)
        if found.pose is None:
            break
        assert np.linalg.eigvalsh(found.pose.covariance)[0] > 0.0
        last = found.pose
    assert 10.0 < number * 0.05 < 300.0
    assert np.trace(last.covariance[:2, :2]) > 4.0 * np.trace(first.covariance[:2, :2])
    assert "too few fixes" in found.reason()


def test_a_gap_of_odometry_and_fixes_of_another_place():
    found, (t_s, odom_m, odom_rad) = on_its_way()
    found.add_odometry(t_s + 4.0, odom_m, odom_rad)
    found.add_fix(t_s + 3.0, 0j, (0.01, 0.0, 0.01))
    assert found.counts["fixes of another time"] == 1
    for number in range(1, 200):
        found.add_fix(t_s + 4.0 + 0.05 * number, 90 + 90j, (0.01, 0.0, 0.01))
        found.add_odometry(t_s + 4.0 + 0.05 * number, odom_m, odom_rad)
    assert "did not fit together" in found.reason()
