"""What one listener learns of the anchors' receptions: right legs only, whatever it misses."""

import random

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.core.air.frame import Heard, Reception
from skyless.core.any_anchor import new_anchor
from skyless.core.ticks import from_seconds, wrap
from skyless.research.studies.surveyed_rooms import RecordedAnchor
from skyless.sim.impairments import AnchorOutage, Outage, lab_impairments
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World
from skyless.site.channel import ChannelModel
from skyless.site.survey.legs import LegCollector, RelayMatcher

pytestmark = pytest.mark.site

LAB = paper_lab_site()
FREE = lab_site()
PHASES = msgspec.structs.replace(FREE, schedule=msgspec.structs.replace(FREE.schedule, carrier_phase=True))


def _world(site, seconds, **changes):
    """The true legs, and what a tag in the middle receives."""
    truth = set()

    def on_leg(sender, receiver, tx_ticks, rx_ticks, _t_s):
        truth.add((sender, receiver, tx_ticks, rx_ticks))

    def factory(anchor):
        return RecordedAnchor(new_anchor(site, anchor), site.id, on_leg)

    impairments = msgspec.structs.replace(lab_impairments(100.0), **changes)
    world = World(site, factory, (TagSpec(Static(3.0, 4.0)),), impairments, 4)
    receptions = [one for broadcast in world.run(seconds) for _, one, _ in broadcast.receptions()]
    return truth, receptions


@pytest.mark.parametrize(
    ("site", "share"),
    [(LAB, 0.95), (FREE, 0.7), (PHASES, 0.7)],
    ids=["protocol 1", "protocol 2", "protocol 2 with phases"],
)
def test_a_listener_learns_the_legs_that_no_collision_hides(site, share):
    truth, receptions = _world(site, 1.5)
    collector = LegCollector(site.id)
    legs = [leg for one in receptions for leg in collector.add(one)]
    found = {(leg.sender, leg.receiver, leg.tx_ticks, leg.rx_ticks) for leg in legs}
    assert len(found) == len(legs)
    assert found <= truth
    assert len(found) > share * len(truth)
    assert all(0.0 < leg.t_s <= 1.5 for leg in legs)


def test_losses_and_restarts_give_no_false_leg():
    outages = tuple(AnchorOutage(anchor, Outage(0.8 + 0.1 * anchor, 1.0 + 0.1 * anchor)) for anchor in (2, 5))
    truth, receptions = _world(LAB, 3.0, channel=ChannelModel(loss_probability=0.3), anchor_outages=outages)
    collector = LegCollector(LAB.id)
    found = {(leg.sender, leg.receiver, leg.tx_ticks, leg.rx_ticks) for one in receptions for leg in collector.add(one)}
    assert found <= truth
    assert len(found) > 0.3 * len(truth)
    assert collector.counters["frame-not-received"] > 0


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 1 << 32), st.binary(max_size=40))
def test_any_order_repetition_and_garbage_give_no_false_leg(seed, garbage):
    (truth, receptions), rng = _RECORDED, random.Random(seed)
    mixed = list(receptions)
    for _ in range(rng.randrange(60)):
        one = rng.randrange(len(mixed))
        match rng.randrange(4):
            case 0:
                del mixed[one]
            case 1:
                mixed.insert(rng.randrange(len(mixed)), mixed[one])
            case 2:
                mixed.insert(one, Reception(garbage, rng.getrandbits(40), rng.random()))
            case 3 if mixed[one].frame:
                frame = bytearray(mixed[one].frame)
                frame[rng.randrange(len(frame))] ^= 1 << rng.randrange(8)
                mixed.insert(one, msgspec.structs.replace(mixed[one], frame=bytes(frame)))
    collector = LegCollector(LAB.id)
    for one in mixed:
        for leg in collector.add(one):
            assert (leg.sender, leg.receiver, leg.tx_ticks, leg.rx_ticks) in truth


_RECORDED = _world(LAB, 0.4)


def test_a_reused_sequence_number_is_counted_and_dropped():
    """The listener has frame 7 of anchor 1; anchor 2 relays a later frame of that number, which it missed."""
    matcher, step = RelayMatcher(), from_seconds(0.01)
    assert matcher.add(1, 7, 1000, (), 5000, 0.0) == []
    late = Heard(1, 7, wrap(777 + 90 * step))
    assert matcher.add(2, 1, 777 + 91 * step, (late,), 5000 + 91 * step, 0.91) == []
    assert matcher.counters == {"other-frame": 1}
    right = Heard(1, 7, 777)
    (leg,) = matcher.add(2, 2, 777 + 92 * step, (right,), 5000 + 92 * step, 0.92)
    assert (leg.sender, leg.receiver, leg.tx_ticks, leg.rx_ticks, leg.t_s) == (1, 2, 1000, 777, 0.0)
    assert matcher.add(2, 3, 777 + 93 * step, (right,), 5000 + 93 * step, 0.93) == [], "each leg once"


@pytest.mark.parametrize("bits", [32, 40])
def test_counters_wrap(bits):
    matcher, step, top = RelayMatcher(bits), from_seconds(0.005), 1 << bits
    found = 0
    for k in range(60):
        now = k * step
        matcher.add(1, k % 128, (top - 20 * step + now) % top, (), now, k * 0.005)
        relay = Heard(1, k % 128, (top - 30 * step + now) % top)
        found += len(matcher.add(2, k % 128, (top - 30 * step + now + 1000) % top, (relay,), now + 1000, k * 0.005))
    assert found == 60
    assert not set(matcher.counters) - {"legs"}


def test_memory_is_bounded():
    matcher, rng = RelayMatcher(), random.Random(1)
    for k in range(20_000):
        relays = (Heard(rng.randrange(1 << 16), rng.randrange(256), rng.getrandbits(40)),)
        matcher.add(rng.randrange(1 << 16), rng.randrange(256), rng.getrandbits(40), relays, k, k * 1e-6)
    assert len(matcher._frames) <= 1 << 14
    assert matcher.counters["legs"] == 0
