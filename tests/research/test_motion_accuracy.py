"""What a motion sensor buys: on recorded flights with few differences, and on simulated hands and robots."""

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.core.motion_sample import MotionSample
from skyless.research.foreign import crazyflie
from skyless.research.foreign.formats import open_recording
from skyless.run.masterless.difference_tracking import DIFFERENCES, DifferenceTracking
from skyless.sim.evaluation.figures import antenna_truth, truth_at
from skyless.sim.evaluation.fleet import Fleet, FleetSettings
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.lab import lab_site
from skyless.sim.motion_sensor import MotionErrors
from skyless.sim.trajectory import Roaming, Waypoints
from skyless.site.tables import read_anchors

pytestmark = pytest.mark.statistical

ARM_M = (-0.01245, 0.00127, 0.0908)
FLIGHTS = {
    "0607-tdoa2-obs-log1": ("util_flights/anchors_const3.csv", 0.24),
    "0426-traj3": ("util_sdlogs/anchors/anchors_0426.csv", 0.24),
    "0426-traj11": ("util_sdlogs/anchors/anchors_0426.csv", 0.25),
}
"""Each flight's anchors, and the largest horizontal error at ten differences a second [m]."""


class Flight:
    def __init__(self, folder, name):
        path = folder / "util_imu" / f"{name}.gz"
        self.anchors_m = read_anchors(folder / FLIGHTS[name][0])
        with open_recording(path, "crazyflie-log") as recording:
            self.pairs = list(recording)
        rows = crazyflie.read_motion(path)[::4].tolist()
        self.motion = [MotionSample(t, (p, q, r), (x, y, z), arm_m=ARM_M) for t, p, q, r, x, y, z in rows]
        self.truth = antenna_truth(crazyflie.read_truth(path, None), ARM_M)
        self.flies_s = self.truth.t_s[np.argmax(self.truth.position_m[:, 2] > 0.3)]

    def flown(self, every, begin, *, has_motion):
        """Squared errors of fixes in the air, horizontal and in space, and how many exceed their level."""
        tracking, motion = DifferenceTracking(DIFFERENCES, self.anchors_m), iter(self.motion if has_motion else ())
        sample, found = next(motion, None), []
        for pair in self.pairs[begin::every]:
            while sample is not None and sample.time_s <= pair.time_s:
                tracking.hear_motion(sample)
                sample = next(motion, None)
            if tracking.update([pair]):
                fix = tracking.fix()
                found.append((fix.time_s, *fix.position_m, fix.hpl_m or np.inf))
        table = np.array(found)
        truth_m = truth_at(self.truth, table[:, 0])
        flying = (truth_m[:, 2] > 0.3) & (table[:, 0] > self.flies_s + 3.0)
        off_m = (table[:, 1:4] - truth_m)[flying]
        across_m = np.hypot(off_m[:, 0], off_m[:, 1])
        return np.mean(across_m**2), np.mean((off_m**2).sum(axis=1)), np.mean(across_m > table[flying, 4])


@pytest.fixture(scope="module", params=list(FLIGHTS))
def flight(request, recordings):
    return request.param, Flight(recordings, request.param)


def means(flight, every, *, has_motion):
    """Roots of the mean squares over flights that begin with other differences, and the share beyond the level."""
    runs = [
        flight.flown(every, begin, has_motion=has_motion) for begin in sorted({every * part // 3 for part in range(3)})
    ]
    across2, space2, beyond = np.mean(runs, axis=0)
    return np.sqrt(across2), np.sqrt(space2), beyond


def test_few_differences_and_a_motion_sensor_make_a_position(flight):
    name, flown = flight
    across_m, space_m, beyond = means(flown, 40, has_motion=True)
    assert across_m <= FLIGHTS[name][1]
    assert space_m <= 0.45
    assert beyond <= 1e-4


def test_at_twenty_a_second_errors_shrink_by_15_percent_and_above_50_none_grows(flight):
    _, flown = flight
    alone, better = means(flown, 20, has_motion=False), means(flown, 20, has_motion=True)
    assert better[0] <= 0.85 * alone[0]
    assert better[2] <= 1e-4
    for every in (1, 8):
        alone, better = means(flown, every, has_motion=False), means(flown, every, has_motion=True)
        assert better[0] <= 1.03 * alone[0]
        assert better[1] <= 1.03 * alone[1]


# Simulated tags: a hand, and a robot with wheels, at 20 beacons a second of each anchor

SEEDS = range(1, 5)


def errors(motion, path_of, change=None):
    """Root mean square of horizontal errors over the seeds, and what the tags said last."""
    site, squares, said = lab_site(330.0), [], []
    site = replace(site, schedule=replace(site.schedule, rate_hz=20.0))
    for seed in SEEDS:
        fleet = Fleet(site, [path_of(seed)], impairments_of(Request(site), site), seed, FleetSettings(motion=motion))
        receiver = fleet.receivers[0]
        hear = receiver.hear_motion
        if change is not None:
            receiver.hear_motion = lambda sample, hear=hear: hear(change(sample))
        squares += [np.sum(judged.error_m[:2] ** 2) for judged in fleet.run(30.0) if judged.time_s > 3.0]
        said.append(receiver.motion_note)
    return float(np.sqrt(np.mean(squares))), said


def hand(seed):
    return Roaming((3.0, 4.0, 0.0), (1.0, 1.3, 0.0), qa_m2ps3=2.0, damping_s=2.0, seed=seed)


def robot(seed):
    corners = np.array([(1.2, 1.6), (4.8, 1.6), (4.8, 6.4), (1.2, 6.4)])
    return Waypoints(np.roll(corners, seed, axis=0), 1.0, loop=True, corner_s=0.6)


def test_a_sensor_in_a_hand_and_wheels_of_a_robot_shrink_errors():
    assert errors(MotionErrors(), hand)[0] <= 0.65 * errors(None, hand)[0]
    assert errors(MotionErrors(has_wheels=True), robot)[0] <= 0.50 * errors(None, robot)[0]


def test_a_sensor_that_is_mounted_askew_or_turned_is_no_worse_than_none():
    def turned(sample, cos=0.0, sin=1.0, from_s=12.0):
        if sample.time_s < from_s:
            return sample
        (p, q, r), (x, y, z) = sample.rate_rps, sample.force_mps2
        return replace(
            sample,
            rate_rps=(cos * p - sin * q, sin * p + cos * q, r),
            force_mps2=(cos * x - sin * y, sin * x + cos * y, z),
        )

    def off_level(sample, slope=0.0875):
        x, y, z = sample.force_mps2
        return replace(sample, force_mps2=(x + slope * z, y, z))

    alone, _ = errors(None, hand)
    assert errors(MotionErrors(), hand, turned)[0] <= 1.1 * alone
    assert errors(MotionErrors(), hand, off_level)[0] <= alone
