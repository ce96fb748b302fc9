"""The Cramér–Rao bound with phases of the carrier: against a textbook's matrices, and against that without them."""

import math

import numpy as np
import pytest

from skyless.core.constants import SPEED_OF_LIGHT_MPS, TICK_S
from skyless.core.estimator.compiled import process_known
from skyless.core.native.views import view
from skyless.research.studies.episodes import random_path
from skyless.research.uncertainty.bounds import (
    OFFSET_STD_M,
    POSITION_STD_M,
    RATE_STD_MPS,
    Biases,
    BoundSettings,
    Sendings,
    _prior,
    received_bound,
    tracking_bound,
)

LAB = np.array([(0, 0, 0), (6, 0, 0), (6, 4, 0), (6, 8, 0), (0, 8, 0), (0, 4, 0)], float)
SLOT_S = 2.5e-3
STAMP_S = 100e-12
QA, SPEED_STD_MPS = 0.5, 0.4
PHASE_STD_M, WANDER = 0.002, 1e-4
ROOM = Biases(survey_std_m=0.02, constant_std_m=0.029, slope_std_m=0.05)
LIGHT2 = SPEED_OF_LIGHT_MPS**2
WHITE, WALK = LIGHT2 * 4e-22, LIGHT2 * 1e-18


def settings_of(phase_std_m=math.inf, wander=0.0, **changes):
    base = {
        "white_fm": 2e-11,
        "random_walk_fm": 1e-9,
        "qa": QA,
        "slot_s": SLOT_S,
        "speed_std_mps": SPEED_STD_MPS,
        "mesh": True,
    }
    return BoundSettings(STAMP_S, phase_std_m=phase_std_m, phase_wander=wander, **(base | changes))


def walk(superframes=40, height_m=0.0):
    path = random_path(
        np.random.default_rng(5), np.array([3.0, 4.0]), np.array([1.0, 1.0]), SLOT_S, superframes * 6, QA
    )
    return np.add(path, [0.0, 0.0, height_m])


def textbook(anchors, path, dims, phase_std_m, wander):
    """The covariance of position and velocity after each frame, with dense matrices and clocks against true time.

    States: [p, v, (offset, rate) of tag and anchors, ambiguities, of which (1 km)² stands for nothing known]. A stamp
    of the tag has the noise of the frame's TX stamp, a phase has not.
    """
    n = len(anchors)
    tag, first, ambiguity = 2 * dims, 2 * dims + 2, 2 * dims + 2 * (n + 1)
    clock = [OFFSET_STD_M**2, RATE_STD_MPS**2]
    variances = [POSITION_STD_M**2] * dims + [SPEED_STD_MPS**2] * dims + clock * (n + 1) + [1e6] * n
    P = np.diag(variances)
    P[first, first] = P[first + 1, first + 1] = 0.0
    F, Q, dt = np.eye(len(P)), np.zeros_like(P), SLOT_S
    motion, clocks = [(a, dims + a, 0.0, QA) for a in range(dims)], range(tag, ambiguity, 2)
    for value, rate, white, q in motion + [(i, i + 1, WHITE, WALK) for i in clocks]:
        F[value, rate] = dt
        Q[np.ix_([value, rate], [value, rate])] = [[white * dt + q * dt**3 / 3, q * dt**2 / 2], [q * dt**2 / 2, q * dt]]
    way_m, found = np.zeros(n), []
    for frame, place in enumerate(path):
        sender = frame % n
        if frame:
            P = F @ P @ F.T + Q
            way_m += np.linalg.norm(place - path[frame - 1])
        P[ambiguity + sender, ambiguity + sender] += wander * way_m[sender]
        way_m[sender] = 0.0
        listeners = [i for i in range(n) if i != sender]
        H = np.zeros((2 + len(listeners), len(P)))
        H[:2, :dims] = ((place - anchors[sender]) / np.linalg.norm(place - anchors[sender]))[:dims]
        H[:2, tag] = 1.0
        H[1, ambiguity + sender] = 1.0
        for row, listener in enumerate(listeners, start=2):
            H[row, first + 2 * listener] = 1.0
        H[:, first + 2 * sender] -= 1.0
        tx = np.ones(len(H))
        tx[1] = 0.0
        R = LIGHT2 * STAMP_S**2 * (np.eye(len(H)) + np.outer(tx, tx))
        R[1, 1] = phase_std_m**2
        P = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
        P = 0.5 * (P + P.T)
        found.append(P[: 2 * dims, : 2 * dims].copy())
    return np.array(found)


@pytest.mark.parametrize("dims", [2, 3])
def test_the_recursion_is_the_textbooks(dims):
    raised = LAB + np.column_stack([np.zeros((6, 2)), [0.5, 2.5] * 3])
    anchors, path = (LAB, walk(8)) if dims == 2 else (raised, walk(8, 1.2))
    settings = settings_of(PHASE_STD_M, WANDER, height_known=dims == 2)
    expected = textbook(anchors, path, dims, PHASE_STD_M, WANDER)[5::6, :dims, :dims]
    found = tracking_bound(anchors, path, settings)
    np.testing.assert_allclose(found[2:], expected[2:], rtol=2e-3, atol=1e-8)
    without = tracking_bound(anchors, path, settings_of(height_known=dims == 2))
    assert np.trace(found[-1]) < 0.9 * np.trace(without[-1])


@pytest.mark.parametrize("biases", [Biases(), ROOM])
def test_phases_never_raise_the_bound_and_ones_of_endless_noise_leave_it(biases):
    path = walk()
    without = tracking_bound(LAB, path, settings_of(), biases)
    found = tracking_bound(LAB, path, settings_of(PHASE_STD_M, WANDER), biases)
    for one, other in zip(without, found, strict=True):
        assert np.linalg.eigvalsh(one - other).min() > -1e-9
    noisy = tracking_bound(LAB, path, settings_of(1e6), biases)
    np.testing.assert_allclose(noisy, without, rtol=1e-6, atol=1e-12)


def last_of(path, phase_std_m):
    """Covariance of position and velocity after the last frame, by the estimator's own steps."""
    s = _prior(LAB, settings_of(phase_std_m, WANDER), Biases())
    for frame, place in enumerate(path):
        known = np.ones(7, np.uint8)
        known[frame % 6] = 0
        process_known(s, frame % 6, round(frame * SLOT_S / TICK_S), place, known, 0, 6 * SLOT_S, 0.0)
    tag = [0, 1, s.layout.velocity, s.layout.velocity + 1]
    return view(s.P)[np.ix_(tag, tag)].copy()


def test_a_tag_at_rest_learns_its_velocity_from_phases():
    path = np.tile([2.0, 3.0, 0.0], (6 * 30, 1))
    without, found = last_of(path, math.inf), last_of(path, PHASE_STD_M)
    np.testing.assert_allclose(found, textbook(LAB, path, 2, PHASE_STD_M, WANDER)[-1], rtol=2e-3, atol=1e-7)
    assert np.sqrt(np.trace(found[2:, 2:]) / np.trace(without[2:, 2:])) < 0.6


def test_at_rest_phases_hardly_tell_where_a_tag_is_and_after_a_metre_of_walking_they_do():
    """What is constant at rest, errors of ranges and ambiguities, changes with the directions as the tag walks."""
    steps = np.linspace(0.0, 1.0, 6 * 70)[:, None] * [1.0, 0.0, 0.0]
    walked = np.add([2.0, 3.0, 0.0], steps)
    rest = np.tile(walked[-1], (len(walked), 1))

    def std_m(path, **phases):
        settings = settings_of(qa=0.05, **phases)
        return np.sqrt(np.trace(tracking_bound(LAB, path, settings, ROOM)[-1]))

    phases = {"phase_std_m": 0.0005}
    assert std_m(rest) > std_m(rest, **phases) > 0.92 * std_m(rest)
    assert std_m(walked) > 0.9 * std_m(rest)
    assert std_m(walked, **phases) < 0.85 * std_m(rest)


def test_only_what_the_tag_receives_has_a_phase():
    known = np.ones((60, 7), np.bool_)
    known[:, -1] = np.arange(60) % 6 != 2
    senders = np.arange(60) % 6
    known[np.arange(60), senders] = False
    rest = np.tile([2.0, 3.0, 0.0], (60, 1))
    sendings = Sendings(senders, SLOT_S * np.arange(60))
    bounds = [received_bound(LAB, rest, settings_of(std_m), known, sendings)[-1] for std_m in (math.inf, PHASE_STD_M)]
    assert np.linalg.eigvalsh(bounds[0] - bounds[1]).min() > 0.0
