"""The Cramér–Rao bound with biases: against the textbook's matrices, closed forms, and the bound without them."""

import math
from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.research.studies.episodes import random_path
from skyless.research.uncertainty.bounds import (
    OFFSET_STD_M,
    POSITION_STD_M,
    RATE_STD_MPS,
    Biases,
    BoundSettings,
    tracking_bound,
)

pytestmark = pytest.mark.site

LAB = np.array([(0, 0, 0), (6, 0, 0), (6, 4, 0), (6, 8, 0), (0, 8, 0), (0, 4, 0)], float)
RAISED = LAB + np.column_stack([np.zeros((6, 2)), [0.5, 2.5] * 3])
SLOT_S = 2.5e-3
ROOM = Biases(survey_std_m=0.02, constant_std_m=0.029, slope_std_m=0.05)
ALL = replace(ROOM, changing_std_m=0.03, correlation_s=0.5, correlation_m=0.3)


def settings_of(stamp_s=100e-12, **changes):
    base = {
        "white_fm": 2e-11,
        "random_walk_fm": 1e-9,
        "qa": 0.5,
        "slot_s": SLOT_S,
        "speed_std_mps": 0.4,
        "mesh": True,
        "at_once": False,
    }
    return BoundSettings(stamp_s, **(base | changes))


def still(place, stamp_s, superframes):
    """A tag that is known to rest, among crystals that keep their rates."""
    settings = settings_of(stamp_s, white_fm=0.0, random_walk_fm=0.0, qa=0.0, speed_std_mps=0.0, at_once=True)
    return np.tile([*place, 0.0], (6 * superframes, 1)), settings


def walk(superframes=40, height_m=0.0):
    path = random_path(
        np.random.default_rng(5), np.array([3.0, 4.0]), np.array([1.0, 1.0]), SLOT_S, superframes * 6, 0.5
    )
    return np.add(path, [0.0, 0.0, height_m])


class Textbook:
    """The same model from what stamps hold, differentiated numerically, with clocks against true time.

    States: [p, v, (offset, rate) of tag and anchors, surveys, constants, changes, slope].
    """

    def __init__(self, anchors, dims, biases):
        self.anchors, self.dims, self.biases, self.n = anchors, dims, biases, len(anchors)
        self.clocks = 2 * dims
        self.surveys = self.clocks + 2 * (self.n + 1)
        self.constants = self.surveys + dims * self.n
        self.changes = self.constants + self.n
        self.slope = self.changes + self.n
        self.size = self.slope + 1

    def stamp_less_senders(self, x, place, sender, listener):
        """What a reception reads beyond what the TX stamp and the told distance of anchors say; None is the tag."""
        dims = self.dims
        surveys = x[self.surveys : self.constants].reshape(self.n, dims)
        true = self.anchors.copy()
        true[:, :dims] += surveys
        clocks = x[self.clocks : self.surveys : 2]
        if listener is None:
            here = place.copy()
            here[:dims] += x[:dims]
            length = np.linalg.norm(here - true[sender])
            shape = np.clip((np.linalg.norm(place - self.anchors[sender]) - 4.0) / 4.0, -1.0, 1.0)
            late = x[self.constants + sender] + x[self.changes + sender] + x[self.slope] * shape
            return length + late + clocks[0] - clocks[1 + sender]
        length = np.linalg.norm(true[listener] - true[sender])
        return length + clocks[1 + listener] - clocks[1 + sender]

    def row(self, *reception):
        steps = 1e-4 * np.eye(self.size)
        return np.array(
            [(self.stamp_less_senders(s, *reception) - self.stamp_less_senders(-s, *reception)) / 2e-4 for s in steps]
        )

    def bound(self, path, settings):
        dims, n, b = self.dims, self.n, self.biases
        stds = [POSITION_STD_M] * dims + [settings.speed_std_mps] * dims
        stds += [OFFSET_STD_M, RATE_STD_MPS] + [0.0, 0.0] + [OFFSET_STD_M, RATE_STD_MPS] * (n - 1)
        stds += [b.survey_std_m] * dims * n + [b.constant_std_m] * n + [b.changing_std_m] * n
        P = np.diag(np.square([*stds, b.slope_std_m]))
        dt, found = settings.slot_s, []
        for frame, place in enumerate(path):
            if frame:
                P = self.predicted(P, dt, float(np.linalg.norm(place - path[frame - 1])), settings)
            sender = frame % n
            listeners = [None, *(i for i in range(n) if i != sender)]
            H = np.array([self.row(place, sender, listener) for listener in listeners])
            R = settings.model().rx_variance_m2 * (np.eye(len(H)) + 1.0)
            P = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
            if sender == n - 1:
                found.append(P[:dims, :dims].copy())
        return np.array(found)

    def predicted(self, P, dt, way_m, settings):
        dims, b, model = self.dims, self.biases, settings.model()
        F, Q = np.eye(self.size), np.zeros((self.size, self.size))
        pairs = [(axis, dims + axis, 0.0, settings.qa) for axis in range(dims)]
        pairs += [(i, i + 1, model.white, model.walk) for i in range(self.clocks, self.surveys, 2)]
        for value, rate, w, q in pairs:
            F[value, rate] = dt
            Q[np.ix_([value, rate], [value, rate])] = [[w * dt + q * dt**3 / 3, q * dt**2 / 2], [q * dt**2 / 2, q * dt]]
        kept = math.exp(-dt / b.correlation_s - way_m / b.correlation_m)
        for change in range(self.changes, self.slope):
            F[change, change] = kept
            Q[change, change] = (1 - kept**2) * b.changing_std_m**2
        return F @ P @ F.T + Q


@pytest.mark.parametrize("dims", [2, 3])
def test_the_recursion_is_the_textbooks(dims):
    anchors, path = (LAB, walk()) if dims == 2 else (RAISED, walk(height_m=1.2))
    settings = settings_of(height_known=dims == 2, at_once=True)
    expected = Textbook(anchors, dims, ALL).bound(path, settings)
    np.testing.assert_allclose(tracking_bound(anchors, path, settings, ALL)[2:], expected[2:], rtol=1e-3, atol=1e-8)


@pytest.mark.parametrize("place", [(3.0, 4.0), (1.2, 1.6), (5.0, 7.0)])
def test_constants_and_the_slope_leave_what_weighted_least_squares_of_one_snapshot_leave(place):
    """Once all noise has averaged away and nothing moves."""
    path, settings = still(place, 1e-12, 100)
    to_tag = path[0] - LAB
    ranges = np.linalg.norm(to_tag, axis=1)
    G = np.column_stack([to_tag[:, :2] / ranges[:, None], np.ones(6)])
    g = np.clip((ranges - 4.0) / 4.0, -1.0, 1.0)
    R = 0.029**2 * np.eye(6) + 0.05**2 * np.outer(g, g)
    expected = np.linalg.inv(G.T @ np.linalg.solve(R, G))[:2, :2]
    found = tracking_bound(LAB, path, settings, Biases(constant_std_m=0.029, slope_std_m=0.05))[-1]
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-8)


@pytest.mark.parametrize("place", [(3.0, 4.0), (1.2, 1.6), (5.0, 7.0)])
def test_displaced_anchors_that_measure_their_distances_leave_the_whole_site_displaced_and_turned(place):
    """σ²/n on each axis, and a rotation of variance σ²/Σr² about the anchors' middle."""
    path, settings = still(place, 1e-12, 100)
    away = LAB[:, :2] - LAB[:, :2].mean(axis=0)
    x, y = np.array(place) - LAB[:, :2].mean(axis=0)
    across = np.array([-y, x])
    expected = 0.02**2 * (np.eye(2) / 6.0 + np.outer(across, across) / np.square(away).sum())
    found = tracking_bound(LAB, path, settings, Biases(survey_std_m=0.02))[-1]
    np.testing.assert_allclose(found, expected, rtol=5e-3, atol=1e-7)


def test_a_part_that_never_changes_is_a_constant_and_one_that_changes_at_once_is_noise():
    path, settings = walk(), settings_of()
    constant = tracking_bound(LAB, path, settings, Biases(constant_std_m=0.03))
    np.testing.assert_allclose(tracking_bound(LAB, path, settings, Biases(changing_std_m=0.03)), constant, rtol=1e-6)
    noisy = tracking_bound(LAB, path, settings, Biases(changing_std_m=0.03, correlation_s=1e-5))
    clean = tracking_bound(LAB, path, settings, Biases())
    assert np.trace(clean[-1]) < np.trace(noisy[-1]) < np.trace(constant[-1])


@pytest.mark.parametrize("name", ["survey_std_m", "constant_std_m", "changing_std_m", "slope_std_m"])
def test_larger_biases_never_make_the_bound_smaller(name):
    path, settings = walk(), settings_of()
    bounds = [
        tracking_bound(LAB, path, settings, replace(ALL, **{name: std_m}))[-1] for std_m in (0.0, 0.02, 0.05, 0.2)
    ]
    for smaller, larger in pairwise(bounds):
        assert np.linalg.eigvalsh(larger - smaller).min() > -1e-12
        assert np.trace(larger) > np.trace(smaller)


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="7 positions, no multiple of 6 anchors"):
        tracking_bound(LAB, np.zeros((7, 3)), settings_of(), Biases())
