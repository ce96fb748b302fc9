"""The yardsticks of ``skyless bench`` take the kernels' measurements and come to the kernels' states."""

import numpy as np
import pytest

from skyless.constants import TICK_M
from skyless.experiments.benchmark_filters import FilterpyTracker, PlainJoint, PlainTracker
from skyless.experiments.benchmark_loops import joint_filter, scalar_filter
from skyless.experiments.benchmark_runs import (
    ANCHORS_M,
    NODES,
    SLOT_S,
    START_VARIANCES,
    JointRuns,
    TrackerRuns,
    packets_of,
)
from skyless.positioning.tracker import WHOLE_OFFSET


def tracked(kind, superframes=80):
    """A yardstick after all messages, and the kernel's tracker."""
    runs = TrackerRuns(superframes)
    plain, tracker = kind(runs.settings, runs.begun()), runs.begun()
    for row in zip(runs.anchors_m, runs.rx_ticks.tolist(), runs.tx_ticks.tolist(), strict=True):
        assert plain.hear(*row, 1e-4)
    runs.batch(tracker, slice(None), np.empty((runs.count, 6)))
    tracker.x[4] += (tracker.whole[WHOLE_OFFSET] - runs.begun().whole[WHOLE_OFFSET]) * TICK_M
    return plain, tracker


def test_plain_numpy_is_the_tracker_to_rounding():
    plain, tracker = tracked(PlainTracker)
    np.testing.assert_allclose(plain.x, tracker.x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(plain.P, tracker.P, rtol=1e-9, atol=1e-13)


def test_filterpy_says_the_same():
    pytest.importorskip("filterpy", reason="a yardstick, not part of the program")
    plain, tracker = tracked(FilterpyTracker)
    np.testing.assert_allclose(plain.x, tracker.x, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(plain.P, tracker.P, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("mesh", [False, True])
def test_plain_numpy_is_the_estimator_but_for_its_first_packets(mesh):
    """It begins with wide priors where the kernel begins with an anchor's first packet."""
    runs = JointRuns(60, mesh=mesh)
    p, estimator = runs.packets, runs.begun()
    plain = PlainJoint(runs.settings, ANCHORS_M, int(p.rx_ticks[0]), runs.tag_m[:2], START_VARIANCES)
    for packet in packets_of(p, runs.count):
        plain.hear(*packet)
    estimator.track(p)
    motion, covariance = estimator.motion()
    np.testing.assert_allclose(plain.x[:2], motion[:2], atol=1e-4)
    np.testing.assert_allclose(plain.x[2:4], motion[2:], atol=1e-3)
    np.testing.assert_allclose(plain.P[:2, :2], covariance[:2, :2], rtol=2e-3, atol=1e-8)


def test_the_plain_loops_find_the_tag():
    draw = np.random.default_rng(1)
    tag_m = np.array([2.0, 5.0, 1.0])
    senders = np.arange(1400) % NODES
    anchors_m = ANCHORS_M + np.outer(np.arange(NODES) % 3, [0.0, 0.0, 1.5])
    noise_m = draw.normal(0.0, 0.03, (2, len(senders)))
    steps, noise = np.full(len(senders), SLOT_S), np.array([0.1, 7.2e-5, 0.18])
    x, P = np.array([2.5, 4.5, 0.5] + [0.0] * 5), np.eye(8)
    ranges_m = np.linalg.norm(anchors_m[senders] - tag_m, axis=1)
    scalar_filter(x, P, anchors_m[senders], steps, ranges_m + 4.0 + noise_m[0], 9e-4, noise)
    assert np.linalg.norm(x[:3] - tag_m) < 5.0 * np.sqrt(np.trace(P[:3, :3]))
    assert np.trace(P[:3, :3]) < 0.1
    x, P = np.zeros(18), np.eye(18)
    x[:2] = 2.5, 4.5
    ranges_m = np.linalg.norm(ANCHORS_M[senders] - [2.0, 5.0, 0.0], axis=1)
    joint_filter(x, P, ANCHORS_M, senders, steps, ranges_m + noise_m[0], noise_m[1], 9e-4, noise)
    assert np.linalg.norm(x[:2] - tag_m[:2]) < 5.0 * np.sqrt(np.trace(P[:2, :2])) < 0.5
