"""Cost of one beacon: its frame, and the receiver with each method."""

from itertools import cycle

import pytest

from skyless.core.any_receiver import AnyReceiver
from skyless.core.method_names import METHODS
from skyless.core.protocol1.anchor import Anchor
from skyless.core.protocol1.beacon import decode, encode
from skyless.sim.impairments import lab_impairments
from skyless.sim.lab import lab_site
from skyless.sim.stations import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World

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
        receiver = AnyReceiver(method)
        for reception in warm:
            receiver.hear(reception)
        return (receiver,), {}

    def hear(receiver):
        return sum(receiver.hear(reception) is not None for reception in measured)

    fixes = benchmark.pedantic(hear, setup=settled, rounds=5, warmup_rounds=1)
    assert fixes > 100
    benchmark.extra_info["us_per_message"] = round(1e6 * benchmark.stats.stats.min / len(measured), 2)
