"""Cost of one beacon: its frame, the receiver with each method, and the tracker's kernel."""

from itertools import cycle

import numpy as np
import pytest

from skyless.air.codec import decode, encode
from skyless.anchor import Anchor
from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_RATE_HZ
from skyless.methods import METHODS
from skyless.positioning.tracker import PseudorangeTracker, TrackerSettings, track
from skyless.receiver import Receiver
from skyless.simulation.scenario import lab_impairments
from skyless.simulation.stations import TagSpec
from skyless.simulation.trajectory import Static
from skyless.simulation.world import World
from skyless.site.lab import lab_site

DURATION_S = 12.0


@pytest.fixture(scope="session")
def receptions():
    """What a tag in the lab hears within 12 s, 400 beacons a second."""
    site = lab_site()
    world = World(site, lambda anchor: Anchor(site, anchor), [TagSpec(Static(3.0, 4.0))], lab_impairments(100.0), 1)
    heard = []
    for broadcast in world.run(DURATION_S):
        heard.extend(reception for _, reception, _ in broadcast.receptions())
    return heard


def test_encode(benchmark, receptions):
    beacons = cycle([decode(reception.frame) for reception in receptions[-240:]])
    benchmark.pedantic(lambda: encode(next(beacons)), rounds=20, iterations=1000, warmup_rounds=1)


def test_decode(benchmark, receptions):
    frames = cycle([reception.frame for reception in receptions[-240:]])
    benchmark.pedantic(lambda: decode(next(frames)), rounds=20, iterations=1000, warmup_rounds=1)


@pytest.mark.parametrize("method", METHODS)
def test_receiver(benchmark, receptions, method):
    """Per message, frames decoded, in the steady state; the first two seconds are not measured."""
    warm, measured = receptions[:800], receptions[800:4400]

    def settled():
        receiver = Receiver(method)
        for reception in warm:
            receiver.hear(reception)
        return (receiver,), {}

    def hear(receiver):
        return sum(receiver.hear(reception) is not None for reception in measured)

    fixes = benchmark.pedantic(hear, setup=settled, rounds=5, warmup_rounds=1)
    assert fixes > 100
    benchmark.extra_info["us_per_message"] = round(1e6 * benchmark.stats.stats.min / len(measured), 2)


def test_tracker_kernel_in_batch(benchmark):
    count = 100_000
    anchors_m = np.array([(x, y, 1.0) for x in (0.0, 6.0) for y in (0.0, 4.0, 8.0)])[np.arange(count) % 6]
    random = np.random.default_rng(1)
    tx_ticks = (np.arange(1, count + 1) * 0.0025 * TICK_RATE_HZ).astype(np.int64)
    flight_m = np.linalg.norm(anchors_m - [3.0, 4.0, 1.0], axis=1)
    noise_ticks = random.normal(0.0, 100e-12 * TICK_RATE_HZ, count)
    rx_ticks = tx_ticks + np.round(flight_m / SPEED_OF_LIGHT_MPS * TICK_RATE_HZ + noise_ticks).astype(np.int64)
    fractions, variances, states = np.zeros(count), np.full(count, 1e-4), np.empty((count, 6))

    def batch():
        tracker = PseudorangeTracker(TrackerSettings(height_m=1.0))
        tracker.start(0, 0, np.array([3.0, 4.0, 0.0]), 0.01 * np.eye(3), 0.0, 1.0, 1.0)
        arrays = (tracker.x, tracker.P, tracker.whole, tracker.statistics, tracker.settings, tracker.h, tracker.ph)
        return track(*arrays, anchors_m, rx_ticks, tx_ticks, fractions, variances, states)

    assert benchmark.pedantic(batch, rounds=5, warmup_rounds=1) > 0.99 * count
    assert np.linalg.norm(states[-1, :2] - [3.0, 4.0]) < 0.1
    benchmark.extra_info["us_per_message"] = round(1e6 * benchmark.stats.stats.min / count, 3)
