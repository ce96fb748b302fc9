"""A motion sensor as an input of the time update: its arithmetic, and what a tag does with good and late samples."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

from skyless.core.estimator.estimator import Estimator
from skyless.core.estimator.motion import GRAVITY_MPS2, add_motion, turn_states, turned
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import covariances, new_state, use_motion
from skyless.core.motion_sample import MotionSample, SampleClock
from skyless.core.native.views import view
from skyless.core.ticks import TICK_RATE_HZ, Unwrapper, wrap
from skyless.sim.evaluation.fleet import Fleet, FleetSettings
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.lab import lab_site
from skyless.sim.motion_sensor import MotionErrors
from skyless.sim.trajectory import Roaming

pytestmark = pytest.mark.site

UP, HIT, THROWN = (0.0, 0.0, GRAVITY_MPS2), (150.0, 0.0, 9.8), (35.0, 0.0, 0.0)
numbers = st.floats(-2.0, 2.0)
vectors = st.tuples(numbers, numbers, numbers)


def fed(samples, rate_hz=100.0, estimator=None):
    """An estimator that has heard samples of (rate, force), from time 0 on."""
    estimator = estimator or Estimator(EstimatorSettings())
    for number, (rate, force) in enumerate(samples):
        time_s = number / rate_hz
        estimator.hear_motion(round(time_s * TICK_RATE_HZ), MotionSample(time_s, tuple(rate), tuple(force)))
    return estimator


def attitude(estimator):
    w, x, y, z = estimator.state.motion.attitude
    return Rotation.from_quat([x, y, z, w])


@given(vectors.filter(lambda v: np.linalg.norm(v) > 0.1))
def test_the_level_is_found_from_gravity(force):
    """Also upside down; the direction of the force becomes z."""
    estimator = fed([((0.0, 0.0, 0.0), force)] * 60)
    assert estimator.state.motion.is_level
    np.testing.assert_allclose(attitude(estimator).apply(force) / np.linalg.norm(force), (0.0, 0.0, 1.0), atol=1e-6)


@given(vectors.filter(lambda v: np.linalg.norm(v) > 0.2), st.integers(20, 100))
def test_rates_turn_the_attitude_as_rotations_do(rate, samples):
    """Smaller rates may be at rest, where the level is corrected; the sensor turns where it is."""
    turns = Rotation.from_rotvec(np.outer(np.arange(0.5, samples) / 100.0, rate))  # rates change linearly in between
    forces = turns.inv().apply(UP)
    estimator = fed([((0.0, 0.0, 0.0), UP)] * 60 + [(rate, force) for force in forces])
    turn = turns[-1]
    assert (attitude(estimator).inv() * turn).magnitude() < 1e-5


@given(st.integers(0, 2**32 - 1), numbers, st.booleans())
def test_states_are_added_and_turned_as_matrices_say(seed, factor, turns):
    draw, s = np.random.default_rng(seed), new_state(EstimatorSettings())
    use_motion(s)
    n = s.layout.ambiguity
    root = draw.standard_normal((n, n))
    x, P, F = draw.standard_normal(n), root @ root.T, np.eye(n)
    view(s.x)[:n] = x
    view(s.P).reshape(-1, len(covariances(s)))[:n, :n] = P
    one, other = draw.choice(n, 2, replace=False).tolist()
    if turns:
        cos, sin = np.cos(factor), np.sin(factor)
        F[[one, other], [one, other]], F[one, other], F[other, one] = cos, sin, -sin
        turn_states(s, one, other, cos, sin)
    else:
        one, heading, error = int(draw.integers(s.layout.heading)), s.layout.heading, s.layout.acceleration
        F[one, [heading, heading + 1, error]] = factor, 0.5, -factor
        add_motion(s, one, factor, 0.5, error, -factor)
    np.testing.assert_allclose(view(s.x)[:n], F @ x, atol=1e-12)
    np.testing.assert_allclose(covariances(s)[:n, :n], F @ P @ F.T, atol=1e-10)


@given(vectors, vectors)
def test_vectors_turn_as_rotations_turn_them(axis, vector):
    x, y, z, w = Rotation.from_rotvec(axis).as_quat()
    to = np.zeros(3)
    turned(to, [w, x, y, z], vector)
    np.testing.assert_allclose(to, Rotation.from_rotvec(axis).apply(vector), atol=1e-12)


def test_late_samples_are_counted_and_a_gap_begins_again():
    estimator = fed([((0.0, 0.0, 0.0), UP)] * 100)
    m = estimator.state.motion
    late = MotionSample(0.5, (0.0, 0.0, 0.0), UP)
    assert not estimator.hear_motion(round(0.95 * TICK_RATE_HZ), late)
    assert (m.late, m.gaps, m.samples) == (1, 0, 100)
    assert estimator.hear_motion(round(2.0 * TICK_RATE_HZ), late)
    assert (m.gaps, m.is_level) == (1, False)


@given(st.lists(st.floats(0.0, 0.05), min_size=20, max_size=20), st.floats(-15e-6, 15e-6))
def test_the_shortest_latency_puts_samples_on_the_tags_counter(latencies, drift):
    """Whatever the others are; and a sample's time is never later than the host saw it."""
    own, clock = Unwrapper(), SampleClock()
    for number, latency_s in enumerate([0.0, *latencies]):
        time_s = 0.1 * number
        own.unwrap(wrap(round(time_s * (1.0 + drift) * TICK_RATE_HZ)), 100.0 + time_s + latency_s)
        ticks = clock.ticks(own, 100.0 + time_s)
    assert abs(ticks / TICK_RATE_HZ - time_s) < 3e-4 + 1e-4 * time_s


# A tag in the simulated world


def walked(motion, seed=1, seconds=25.0, qa=2.0, change=None, rate_hz=20.0, settle_s=3.0):
    """Errors of a tag in a hand at 20 beacons a second of each anchor, and its receiver."""
    site = lab_site(330.0)
    site = replace(site, schedule=replace(site.schedule, rate_hz=rate_hz))
    path = Roaming((3.0, 4.0, 0.0), (1.0, 1.3, 0.0), qa_m2ps3=qa, damping_s=2.0, seed=seed)
    fleet = Fleet(site, [path], impairments_of(Request(site), site), seed, FleetSettings(motion=motion))
    if change is not None:
        receiver = fleet.receivers[0]
        hear = receiver.hear_motion
        receiver.hear_motion = lambda sample: [hear(one) for one in change(sample)]
    judged = [one for one in fleet.run(seconds) if one.time_s > settle_s]
    return np.array([np.linalg.norm(one.error_m[:2]) for one in judged]), judged, fleet


def rms(errors):
    return float(np.sqrt(np.mean(np.square(errors))))


def test_the_orientation_is_that_of_the_sensor_once_it_is_stated():
    _, judged, fleet = walked(MotionErrors())
    stated = [one for one in judged if one.fix.orientation is not None]
    assert len(stated) > 0.7 * len(judged)
    w, x, y, z = stated[-1].fix.orientation
    off = Rotation.from_quat([x, y, z, w]).inv() * Rotation.from_matrix(fleet.sensors[0][0].attitude())
    assert np.degrees(off.magnitude()) < 8.0  # the sensor sways by 30 degrees a second
    assert fleet.receivers[0].motion_note is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda sample: [] if sample.time_s > 10.0 else [sample], "have ended"),
        (lambda sample: [replace(sample, time_s=sample.time_s - 1.0)], "1.0 s late"),
        (lambda sample: [replace(sample, time_s=sample.time_s + 2.0)], "2.0 s ahead"),
        (lambda sample: [] if 8.0 < sample.time_s < 10.0 else [sample], None),
        (lambda sample: [replace(sample, force_mps2=HIT)] if 10.0 < sample.time_s < 10.05 else [sample], None),
        (lambda sample: [replace(sample, rate_rps=THROWN)] if 10.0 < sample.time_s < 10.03 else [sample], None),
    ],
    ids=["it dies", "it is late", "it is ahead", "it pauses", "it is hit", "it is thrown"],
)
def test_a_tag_whose_sensor_fails_says_so_and_is_as_good_as_without(change, said):
    errors, judged, fleet = walked(MotionErrors(), change=change)
    alone, _, _ = walked(None)
    note = fleet.receivers[0].motion_note
    assert said in note if said else note is None
    assert rms(errors) <= 1.1 * rms(alone)
    assert all(error <= one.fix.hpl_m for error, one in zip(errors, judged, strict=True) if one.fix.hpl_m)


def test_a_silence_of_radio_and_sensor_is_not_taken_for_one_that_the_sensor_saw():
    site = lab_site(330.0)
    path = Roaming((3.0, 4.0, 0.0), (1.0, 1.3, 0.0), qa_m2ps3=2.0, damping_s=2.0, seed=3)
    fleet = Fleet(site, [path], impairments_of(Request(site), site), 3, FleetSettings(motion=MotionErrors()))
    receiver = fleet.receivers[0]
    for name in ("hear", "hear_motion"):
        call = getattr(receiver, name)
        setattr(receiver, name, lambda one, call=call: None if 8.0 < fleet.now_s < 10.0 else call(one))
    seen = [one for one in fleet.run(12.0) if one.time_s > 9.0]
    assert seen
    assert all(np.linalg.norm(one.error_m[:2]) <= 6.0 * one.fix.std_m for one in seen)
