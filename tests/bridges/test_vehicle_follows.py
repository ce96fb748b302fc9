"""What an autopilot makes of positions on recorded flights: a filter of its own stands for it, at the other end."""

from collections import Counter
from math import asin, atan2, pi, radians, sqrt

import numpy as np
import pytest

from skyless.bridges.mavlink import MavlinkEncoder
from skyless.bridges.vehicle import rotations
from skyless.core.air.masterless_packets import PairTdoa
from skyless.files import open_source
from skyless.research.foreign.crazyflie import _Log
from skyless.run.masterless.difference_tracking import DIFFERENCES, DifferenceTracking
from skyless.run.mqtt.messages import fix_message
from support.bridged_values import BARE_SITE

pymavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
pytestmark = pytest.mark.statistical

ANCHORS = "util_flights/anchors_const3.csv", "util_sdlogs/anchors/anchors_0426.csv"
FLIGHTS = {"0607-tdoa2-obs-log1": (ANCHORS[0], -1.3), "0426-traj3": (ANCHORS[1], 4.0), "0426-traj11": (ANCHORS[1], 5.0)}
"""Anchors, and degrees from Vicon's body frame to the gyroscope's about z, by their rates."""
NED, FRD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.diag([1.0, -1.0, -1.0])
UNIX_S = 1_795_000_000.0
flights = pytest.mark.parametrize("name", FLIGHTS)


class Flight:
    """True path and heading, north, east, down; inertial samples, forward, right, down, at 100 Hz; fixes at 30 Hz."""

    def __init__(self, recordings, name, outage_s=(0.0, 0.0)):
        (anchors, turn_deg), events = FLIGHTS[name], {}
        with open_source(recordings / "util_imu" / f"{name}.gz") as stream:
            for event in _Log(stream, Counter()).events():
                events.setdefault(event.name, []).append((event.time_s, *event.values.values()))
        pose = np.array(events["estPose"])
        self.t_s, *place, qx, qy, qz, qw = pose[np.isfinite(pose).all(axis=1)].T
        self.path_m = np.add(np.array(place).T, [0.0, 0.0, 0.0908]) @ NED.T  # the antenna's
        yaw = np.arctan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy**2 + qz**2))
        self.heading = pi / 2.0 - radians(turn_deg) - np.unwrap(yaw)
        count = len(events["estGyroscope"]) // 10 * 10
        rate, force = (np.array(events[kind])[:count] for kind in ("estGyroscope", "estAcceleration"))
        samples = np.hstack([rate[:, :1], np.radians(rate[:, 1:]) @ FRD, 9.81 * force[:, 1:] @ FRD])
        self.motion = samples.reshape(-1, 10, 7).mean(axis=1)
        places = {int(row[0]): tuple(row[1:4]) for row in np.loadtxt(recordings / anchors, delimiter=",", skiprows=1)}
        tracking, (begin_s, *_), self.fixes = DifferenceTracking(DIFFERENCES, places), events["estTDOA"][0], []
        for t_s, a, b, tdoa_m in events["estTDOA"]:
            is_out = outage_s[0] < t_s - begin_s < outage_s[1]
            is_fixed = not is_out and tracking.update([PairTdoa(t_s, int(a), int(b), tdoa_m)])
            if is_fixed and (not self.fixes or t_s - self.fixes[-1].time_s >= 1.0 / 30.0):
                self.fixes.append(fix_message("drone", len(self.fixes), tracking.fix(), UNIX_S + t_s, 0.0))

    def horizontal_m(self, path):
        """Root mean square of the horizontal error in flight, from 5 s on; rows of time, north, east."""
        true_m = np.array([np.interp(path[:, 0], self.t_s, axis) for axis in self.path_m.T]).T
        flies = (true_m[:, 2] < -0.3) & (path[:, 0] > self.fixes[0].time_s + 5.0)
        return sqrt(np.mean(np.sum((path[:, 1:3] - true_m[:, :2])[flies] ** 2, axis=1)))


def turned(*vector):
    return rotations(np.array([vector]))[0]


def angles(attitude):
    return atan2(attitude[2, 1], attitude[2, 2]), -asin(attitude[2, 0]), atan2(attitude[1, 0], attitude[0, 0])


class Autopilot:
    """A loosely coupled filter: position, velocity, error of attitude, biases of accelerometer and gyroscope.

    Noises are those of PX4's EKF2, but for the gyroscope's, which is 3 times as large.
    """

    def __init__(self, place, force, heading):
        tilt = turned(0.0, asin(force[0] / np.linalg.norm(force)), 0.0) @ turned(atan2(-force[1], -force[2]), 0.0, 0.0)
        self.x, self.attitude = np.concatenate([place, np.zeros(12)]), turned(0.0, 0.0, heading) @ tilt
        self.P = np.diag(np.repeat([0.25, 0.25, radians(3.0) ** 2, 0.04, radians(0.5) ** 2], 3))

    def predict(self, rate, force, dt):
        rate, force, F = rate - self.x[12:], force - self.x[9:12], np.eye(15)
        middle = self.attitude @ turned(*rate * dt / 2.0)
        acceleration = middle @ force + [0.0, 0.0, 9.81]
        self.x[:6] += np.concatenate([dt * self.x[3:6] + dt**2 / 2.0 * acceleration, dt * acceleration])
        self.attitude = self.attitude @ turned(*rate * dt)
        F[:3, 3:6], F[3:6, 6:9] = np.eye(3) * dt, np.cross(np.eye(3), middle @ force) * -dt
        F[3:6, 9:12] = F[6:9, 12:] = -dt * middle
        self.P = F @ self.P @ F.T
        self.P[range(3, 15), range(3, 15)] += np.repeat(np.square([0.35 * dt, 0.05 * dt, 0.003 * dt, 0.001 * dt]), 3)

    def fuse(self, h, innovation, variance):
        K = self.P @ h / (h @ self.P @ h + variance)
        self.x, self.P = self.x + K * innovation, self.P - np.outer(K, h @ self.P)
        self.attitude, self.x[6:9] = turned(*self.x[6:9]) @ self.attitude, 0.0


def fly(flight, *, as_before=False, north_deg=0.0):
    """Rows of time, position, velocity of the autopilot, and what the target says, by seconds after the take-off.

    ``as_before``: given fixes with their velocity, as they were handed over before. ``north_deg``: of the compass.
    """
    said, now_s = [], flight.fixes[0].time_s
    takeoff_s = max(flight.t_s[np.argmax(flight.path_m[:, 2] < -0.3)], now_s)
    target = MavlinkEncoder("px4", heading_deg=0.0, log=lambda line: said.append((now_s - takeoff_s, line)))
    target.on_site(BARE_SITE)
    reader, vehicle = pymavlink.MAVLink(None), pymavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    begin, row = int(np.searchsorted(flight.motion[:, 0], now_s)), np.eye(15)
    headings = np.interp(flight.motion[:, 0], flight.t_s, flight.heading) + radians(north_deg)
    rest = flight.motion[max(begin - 50, 0) : begin + 1, 4:].mean(axis=0)
    autopilot = Autopilot(NED @ flight.fixes[0].position_m, rest, headings[begin])
    waiting, path, noise = list(reversed(flight.fixes)), [], np.random.default_rng(0)
    for step, (t_s, *sample) in enumerate(flight.motion[begin + 1 :], begin + 1):
        autopilot.predict(np.array(sample[:3]), np.array(sample[3:]), t_s - now_s)
        now_s = t_s
        while waiting and waiting[-1].time_s + 0.01 <= now_s:  # 10 ms late
            fix = waiting.pop()
            (message,) = reader.parse_buffer(b"".join(target.on_fix(fix)))
            place, variances = (message.x, message.y, message.z), np.array(message.pose_covariance)[[0, 6, 11]]
            if as_before:
                place, variances = NED @ fix.position_m, np.array(fix.covariance_m2)[[4, 0, 8]]
            for axis, variance in enumerate(variances):
                h = row[axis] - (now_s - fix.time_s) * row[3 + axis]
                autopilot.fuse(h, place[axis] - h @ autopilot.x, max(variance, 0.05**2))
            for axis, speed in enumerate(NED @ fix.velocity_mps if as_before else (), 3):
                autopilot.fuse(row[axis], speed - autopilot.x[axis], 0.05**2)
        if step % 10 == 0:  # the compass
            error = headings[step] + noise.normal(0.0, 0.05) - angles(autopilot.attitude)[2]
            autopilot.fuse(row[8], (error + pi) % (2.0 * pi) - pi, 0.1**2)
        if step % 2 == 0:
            heard = vehicle.attitude_encode(0, *angles(autopilot.attitude), 0, 0, 0).pack(vehicle)
            heard += vehicle.highres_imu_encode(int(t_s * 1e6), *sample[3:], *sample[:3], *[0] * 8).pack(vehicle)
            heard += vehicle.local_position_ned_encode(0, *autopilot.x[:6]).pack(vehicle)
            target.on_bytes(heard, int((UNIX_S + t_s) * 1e9))
        if step % 100 == 0:
            target.on_second(UNIX_S + t_s)
        path.append((t_s, *autopilot.x[:6]))
    return np.array(path), said


@flights
def test_the_autopilot_is_as_good_as_the_fixes(recordings, name):
    """Given the fixes themselves, with their velocity, it is 1.2 to 1.5 times worse, as PX4's EKF2 was."""
    flight = Flight(recordings, name)
    fixes_m = flight.horizontal_m(np.array([(fix.time_s, *NED @ fix.position_m) for fix in flight.fixes]))
    (before, _), (path, said) = fly(flight, as_before=True), fly(flight)
    assert 1.2 < flight.horizontal_m(before) / fixes_m < 1.5
    assert flight.horizontal_m(path) < 1.1 * fixes_m
    assert ["agrees within 5°" in line for _, line in said] == [False, True]


@flights
@pytest.mark.parametrize("north_deg", [10.0, -10.0])
def test_a_wrong_north_is_named_within_20_s_of_flight(recordings, name, north_deg):
    _, said = fly(Flight(recordings, name), north_deg=north_deg)
    after_s, line = next(one for one in said if "° off" in one[1])
    assert after_s <= 20.0
    assert abs((float(line.split()[-1]) - north_deg + 180.0) % 360.0 - 180.0) < 5.0


@flights
def test_after_an_outage_of_8_s_it_returns_without_a_jump(recordings, name):
    flight = Flight(recordings, name, (15.0, 23.0))
    path, _ = fly(flight)
    t_s = np.array([fix.time_s for fix in flight.fixes])
    after = path[path[:, 0] > t_s[np.argmax(np.diff(t_s)) + 1]]
    assert np.linalg.norm(np.diff(after[:, 1:3], axis=0) - 0.01 * after[1:, 4:6], axis=1).max() < 0.5
    assert flight.horizontal_m(after[300:]) < 0.3
