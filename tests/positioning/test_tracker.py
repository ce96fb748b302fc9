"""The tracker's kernels against a matrix Kalman filter, streaming against batch, compiled against plain Python."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_M, TICK_RATE_HZ, TICK_S
from skyless.positioning.tracker import PseudorangeTracker, TrackerSettings, track

ANCHORS = np.array([[0, 0, 0], [6, 0, 0], [6, 4, 0], [6, 8, 0], [0, 8, 0], [0, 4, 0]], dtype=float)


def messages(count, seed=1, epoch=0):
    """Beacons of a tag that lies at (3, 4), its clock 5 ppm fast."""
    generator = np.random.default_rng(seed)
    k = np.arange(count)
    tx = epoch + k * round(2.5e-3 * TICK_RATE_HZ)
    anchors = ANCHORS[k % 6]
    ranges = np.linalg.norm(anchors - np.array([3.0, 4.0, 0.0]), axis=1)
    offset_m = (tx - epoch) * TICK_S * 5e-6 * SPEED_OF_LIGHT_MPS
    rx = tx + 12345 + np.rint((ranges + offset_m + 0.042 * generator.standard_normal(count)) / TICK_M).astype(np.int64)
    fraction = generator.integers(0, 256, count) / 256.0
    variance = np.where(k % 6 == 0, 0.0, 3e-4)
    return anchors, rx, tx, fraction, variance


def started(epoch=0):
    tracker = PseudorangeTracker(TrackerSettings(height_m=0.0))
    rx = messages(1, epoch=epoch)[1]
    tracker.start(int(rx[0]), 12345, np.array([2.0, 3.0, 0.0]), np.diag([1.0, 1.0, 1.0]), 1500.0, 4.0, 1.0)
    return tracker


def stream(count, epoch=0):
    tracker = started(epoch)
    states = []
    for anchor, rx, tx, fraction, variance in zip(*messages(count, epoch=epoch), strict=True):
        tracker.hear(anchor, int(rx), int(tx), float(fraction), float(variance))
        states.append(tracker.x.copy())
    return np.array(states), tracker


def test_streaming_and_batch_give_identical_states():
    count = 600
    streamed, one = stream(count)
    two = started()
    states = np.empty((count, 6))
    arrays = messages(count)
    track(two.x, two.P, two.whole, two.statistics, two.settings, two.h, two.ph, *arrays, states)
    assert np.array_equal(states, streamed)
    assert np.array_equal(two.P, one.P)
    assert np.array_equal(two.whole, one.whole)


def test_without_the_compiler_the_states_are_the_same_to_rounding():
    script = (
        "import json, sys; sys.path.insert(0, sys.argv[1]); import test_tracker as t;"
        "print(json.dumps(t.stream(60)[0].tolist()))"
    )
    plain = subprocess.run(
        [sys.executable, "-c", script, str(Path(__file__).parent)],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    np.testing.assert_allclose(json.loads(plain.stdout), stream(60)[0], rtol=1e-9, atol=1e-9)


def test_the_kernels_are_a_kalman_filter():
    """Against the textbook's matrices, in the filter's own linearisation points."""
    settings = TrackerSettings(height_m=0.0)
    tracker = started()
    x, P, base = tracker.x.copy(), tracker.P.copy(), 12345
    last = int(tracker.whole[0])
    for anchor, rx, tx, fraction, variance in zip(*messages(200), strict=True):
        dt = (int(rx) - last) * TICK_S / (1.0 + x[5] / SPEED_OF_LIGHT_MPS)
        last = int(rx)
        F = np.eye(6)
        F[0, 2] = F[1, 3] = F[4, 5] = dt
        Q = np.zeros((6, 6))
        for p, r, white, walk in (
            (0, 2, 0, settings.qa),
            (1, 3, 0, settings.qa),
            (4, 5, settings.white, settings.walk),
        ):
            Q[p, p] = white * dt + walk * dt**3 / 3
            Q[p, r] = Q[r, p] = walk * dt**2 / 2
            Q[r, r] = walk * dt
        x, P = F @ x, F @ P @ F.T + Q
        difference = np.array([x[0], x[1], 0.0]) - anchor
        distance = np.linalg.norm(difference)
        H = np.array([*(difference[:2] / distance), 0.0, 0.0, 1.0, 0.0])
        innovation = (int(rx) - int(tx) - base - fraction) * TICK_M - distance - x[4]
        S = H @ P @ H + settings.stamp_variance_m2 + variance
        if innovation**2 <= settings.gate**2 * S:
            K = P @ H / S
            x = x + K * innovation
            keep = np.eye(6) - np.outer(K, H)
            P = keep @ P @ keep.T + np.outer(K, K) * (S - H @ P @ H)
        tracker.hear(anchor, int(rx), int(tx), float(fraction), float(variance))
    kept_m = (int(tracker.whole[1]) - base) * TICK_M
    np.testing.assert_allclose(tracker.x + np.array([0, 0, 0, 0, kept_m, 0]), x, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(tracker.P, P, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("epoch", [2**40 - 3, 2**56])
def test_the_epoch_does_not_matter(epoch):
    """Months of ticks behind the first message change no bit of the position."""
    near, _ = stream(300)
    far, _ = stream(300, epoch=epoch)
    assert np.array_equal(near[:, :4], far[:, :4])
