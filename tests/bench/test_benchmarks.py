"""The baselines of ``skyless bench`` process the kernels' measurements and reach the kernels' states."""

import numpy as np
import pytest

from skyless.research.bench._baselines import FilterpyJoint, PlainJoint, joint_filter
from skyless.research.bench._runs import (
    BENCH_ANCHORS_M,
    BENCH_NODES,
    BENCH_SLOT_S,
    START_VARIANCES,
    JointRuns,
    packets_of,
)

pytestmark = pytest.mark.statistical


@pytest.mark.parametrize("mesh", [False, True])
def test_plain_numpy_is_the_estimator_but_for_its_first_packets(mesh):
    """It begins with wide priors where the kernel begins with an anchor's first packet."""
    runs = JointRuns(60, mesh=mesh)
    p, estimator = runs.packets, runs.new_estimator()
    plain = PlainJoint(runs.settings, BENCH_ANCHORS_M, int(p.rx_ticks[0]), runs.tag_m[:2], START_VARIANCES)
    for packet in packets_of(p, runs.count):
        plain.process(*packet)
    estimator.track(p)
    motion, covariance = estimator.motion()
    np.testing.assert_allclose(plain.x[:2], motion[:2], atol=1e-4)
    np.testing.assert_allclose(plain.x[2:4], motion[2:], atol=1e-3)
    np.testing.assert_allclose(plain.P[:2, :2], covariance[:2, :2], rtol=2e-3, atol=1e-8)


def test_filterpy_says_the_same():
    pytest.importorskip("filterpy", reason="a baseline, not part of the program")
    runs = JointRuns(30, mesh=False)
    p, filters = runs.packets, []
    for kind in (PlainJoint, FilterpyJoint):
        filters.append(kind(runs.settings, BENCH_ANCHORS_M, int(p.rx_ticks[0]), runs.tag_m[:2], START_VARIANCES))
        for packet in packets_of(p, runs.count):
            filters[-1].process(*packet)
    plain, other = filters
    np.testing.assert_allclose(plain.x, other.x, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(plain.P, other.P, rtol=1e-6, atol=1e-8)


def test_the_plain_loop_finds_the_tag():
    draw = np.random.default_rng(1)
    tag_m = np.array([2.0, 5.0, 0.0])
    senders = np.arange(1400) % BENCH_NODES
    noise_m = draw.normal(0.0, 0.03, (2, len(senders)))
    steps, noise = np.full(len(senders), BENCH_SLOT_S), np.array([0.1, 7.2e-5, 0.18])
    x, P = np.zeros(18), np.eye(18)
    x[:2] = 2.5, 4.5
    ranges_m = np.linalg.norm(BENCH_ANCHORS_M[senders] - tag_m, axis=1)
    joint_filter(x, P, BENCH_ANCHORS_M, senders, steps, ranges_m + noise_m[0], noise_m[1], 9e-4, noise)
    assert np.linalg.norm(x[:2] - tag_m[:2]) < 5.0 * np.sqrt(np.trace(P[:2, :2])) < 0.5
