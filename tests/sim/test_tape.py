"""A large site as a tape: against the published instants, exact geometry, and the world of anchor machines."""

from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.stats import kstest

from skyless.core.air.almanac import gap_ticks
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_MASK, TICK_S, WRAP_TICKS, difference
from skyless.sim.evaluation.fleet import Fleet, FleetSettings
from skyless.sim.impairments import Impairments, RangeErrorModel
from skyless.sim.oscillator import OscillatorModel
from skyless.sim.tape import MAX_RELAYS, Tape, normals, uniforms
from skyless.sim.trajectory import Static, Waypoints
from skyless.site.channel import ChannelModel
from skyless.site.file.template import grid_site

GRID = grid_site(150.0, 150.0, 15.0, 4.0, 1.0)
ANCHORS = {anchor.id: np.array((anchor.x_m, anchor.y_m, anchor.z_m)) for anchor in GRID.anchors}
EXACT = Impairments(tx_stamp_ps=0.0, rx_stamp_ps=0.0, oscillator=OscillatorModel(0.0, 0.0, 0.0))
WRAP_S = WRAP_TICKS * TICK_S
WALK = Waypoints([(40.0, 40.0, 1.0), (110.0, 90.0, 1.0)], 1.4)


def tape(impairments=Impairments(), seed=3, tags=(WALK,), **changes):  # noqa: B008
    return Tape(GRID, tags, impairments, seed, **changes)


def stamps(heard):
    return [(one.beacon.anchor, one.beacon.sequence, one.reception.rx_ticks, one.beacon.heard) for one in heard]


def relayed(heard):
    """Of each relay: the listener, the sender, its sequence number, and the stamp."""
    return [
        (one.beacon.anchor, relay.anchor, relay.sequence, relay.rx_ticks) for one in heard for relay in one.beacon.heard
    ]


def test_what_a_tag_hears_depends_neither_on_spans_nor_on_other_tags():
    whole = stamps(tape().hear(0, 2.0, 3.0))
    both = tape(tags=(WALK, Static(75.0, 75.0, 1.0)))
    both.hear(1, 2.0, 2.5)
    assert whole == stamps(both.hear(0, 2.0, 2.3) + both.hear(0, 2.3, 3.0))
    again = tape()
    again.hear(0, 5.0, 5.5)
    assert whole == stamps(again.hear(0, 2.0, 3.0)), "also after a later span"
    assert whole != stamps(tape(seed=4).hear(0, 2.0, 3.0))


def test_beacons_leave_at_the_published_instants():
    by_anchor = {}
    for one in tape().hear(0, 1.0, 4.0):
        by_anchor.setdefault(one.beacon.anchor, []).append(one.beacon)
    neighbours = 0
    for beacons in by_anchor.values():
        for before, after in pairwise(beacons):
            if after.sequence == (before.sequence + 1) % 256:
                gap = gap_ticks(before.anchor, before.sequence, before.period_code)
                assert difference(after.tx_ticks, before.tx_ticks) == gap
                neighbours += 1
    assert neighbours > 50


def test_without_noise_stamps_are_geometry():
    heard = tape(EXACT).hear(0, 1.0, 2.0)
    offsets = []
    for one in heard:
        flight = np.linalg.norm(one.truth_m - ANCHORS[one.beacon.anchor]) / SPEED_OF_LIGHT_MPS / TICK_S
        offsets.append(one.reception.rx_ticks - (one.reception.host_s / TICK_S + flight))
    spread = np.array(offsets) - offsets[0]
    assert np.abs(np.round(spread / (TICK_MASK + 1.0)) * (TICK_MASK + 1.0) - spread).max() <= 1.01


def test_relays_are_the_geometry_between_anchors():
    """Two anchors that hear a third: the difference of their stamps is that of their clocks and of the flights."""
    heard = tape(EXACT).hear(0, 1.0, 3.0)
    by_frame = {}
    for listener, sender, sequence, rx_ticks in relayed(heard):
        by_frame.setdefault((sender, sequence), {})[listener] = rx_ticks
    clocks, compared = {}, 0
    for (sender, _), found in by_frame.items():
        for one, other in pairwise(sorted(found)):
            flights = [np.linalg.norm(ANCHORS[node] - ANCHORS[sender]) for node in (one, other)]
            flight = (flights[0] - flights[1]) / SPEED_OF_LIGHT_MPS / TICK_S
            offset = difference(found[one], found[other]) - flight
            compared += (one, other) in clocks
            assert abs(offset - clocks.setdefault((one, other), offset)) <= 2.0
    assert compared > 30


def test_a_reception_has_one_stamp_and_an_anchor_is_relayed_once():
    heard = tape().hear(0, 1.0, 3.0)
    known = {}
    for listener, sender, sequence, rx_ticks in relayed(heard):
        assert known.setdefault((listener, sender, sequence), rx_ticks) == rx_ticks
    assert len(known) < len(relayed(heard)), "some are relayed twice"
    for one in heard:
        senders = [relay.anchor for relay in one.beacon.heard]
        ages = [difference(one.beacon.tx_ticks, relay.rx_ticks) * TICK_S for relay in one.beacon.heard]
        assert len(set(senders) - {one.beacon.anchor}) == len(senders) <= MAX_RELAYS
        assert ages == sorted(ages)
        assert not ages or 1e-3 < ages[0] <= ages[-1] < 1.001


def test_dead_anchors_neither_send_nor_receive():
    dead = np.arange(len(GRID.anchors)) % 3 == 0
    heard = tape(dead=dead).hear(0, 1.0, 3.0)
    ids = {anchor.id for anchor, is_dead in zip(GRID.anchors, dead, strict=True) if is_dead}
    assert heard
    assert not ids & {one.beacon.anchor for one in heard}
    assert not ids & {sender for _, sender, _, _ in relayed(heard)}


def test_an_anchor_that_sends_receives_nothing_meanwhile():
    """Of frames that overlap another at the same antenna at most one arrives; a sender's own is always the stronger."""
    sent = {}
    for one in tape(tags=(Static(75.0, 75.0, 1.0),)).hear(0, 1.0, 6.0):
        sent[one.beacon.anchor, one.beacon.sequence] = one
    for (listener, _), own in sent.items():
        for relay in own.beacon.heard:
            between = difference(own.beacon.tx_ticks, relay.rx_ticks) * TICK_S
            assert between > 1e-3, f"{listener} relays what came after its relays were fixed"


@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_the_share_of_lost_frames(loss):
    tags = [Static(x, 75.0, 1.0) for x in (60.0, 75.0, 90.0)]
    kept = tape(Impairments(channel=ChannelModel(loss_probability=loss)), tags=tags)
    whole = tape(tags=tags)
    share = sum(len(kept.hear(tag, 1.0, 5.0)) for tag in range(3)) / sum(
        len(whole.hear(tag, 1.0, 5.0)) for tag in range(3)
    )
    assert share == pytest.approx(1.0 - loss, abs=0.05)  # about 1,800 frames: four standard deviations


@pytest.mark.statistical
def test_as_many_beacons_and_relays_as_among_anchor_machines():
    """100 anchors as machines, whose periods settle in the first seconds."""
    points = np.random.default_rng(2).uniform(50.0, 100.0, (6, 2))
    tags = [Static(x, y, 1.0) for x, y in points.tolist()]
    fleet = Fleet(GRID, tags, Impairments(), 1, FleetSettings())
    for _ in fleet.run(12.0):
        pass
    at_12_s = [record.messages for record in fleet.records]
    for _ in fleet.run(16.0):
        pass
    machines = np.array([record.messages for record in fleet.records]) - at_12_s
    own = tape(tags=tags)
    beacons = [own.hear(tag, 12.0, 16.0) for tag in range(len(tags))]
    assert np.mean([len(one) for one in beacons]) == pytest.approx(np.mean(machines), rel=0.06)
    fixes = [fleet.receivers[0].hear_beacon(one.beacon, one.reception) for one in beacons[0]]
    assert fixes.count(None) < len(fixes), "a receiver takes them"


@pytest.mark.site
def test_crystals_have_the_variance_of_their_model():
    """A random walk of the rate gains about 1e-9 · t^1.5 / sqrt(3); bounds of four standard deviations."""
    model = OscillatorModel(offset_ppm=0.0, white_fm=2e-11, random_walk_fm=1e-9)
    gained = []
    for seed in range(4):
        times = {}
        for one in tape(replace(EXACT, oscillator=model), seed, [Static(75.0, 75.0, 1.0)]).hear(0, 0.0, 21.0):
            times.setdefault(one.beacon.anchor, []).append((one.reception.host_s, one.beacon.tx_ticks * TICK_S))
        for pairs in times.values():
            true_s, own_s = np.array(pairs).T
            ahead_s = own_s - true_s
            ahead_s -= np.round((ahead_s - ahead_s[0]) / WRAP_S) * WRAP_S
            if true_s[-1] - true_s[0] > 19.0:
                gained.append((ahead_s[-1] - ahead_s[0]) / (true_s[-1] - true_s[0]) ** 1.5)
    assert len(gained) > 50
    assert 0.4e-9 < np.std(gained) < 0.8e-9


@pytest.mark.site
@pytest.mark.parametrize("correlation", [{"correlation_m": 0.5}, {"correlation_s": 0.5}])
def test_changing_range_errors_have_their_size(correlation):
    tags = [Waypoints([(40.0 + x, 40.0, 1.0), (110.0 + x, 90.0, 1.0)], 1.0) for x in range(4)]
    model = RangeErrorModel(changing_m=0.3, **correlation)
    with_errors, without = (tape(replace(EXACT, range_errors=one), tags=tags) for one in (model, RangeErrorModel()))
    errors_m = []
    for tag in range(len(tags)):
        pairs = zip(with_errors.hear(tag, 0.0, 8.0), without.hear(tag, 0.0, 8.0), strict=True)
        ticks = [difference(one.reception.rx_ticks, other.reception.rx_ticks) for one, other in pairs]
        errors_m += [one * TICK_S * SPEED_OF_LIGHT_MPS for one in ticks]
    assert np.std(errors_m) == pytest.approx(0.3, rel=0.1)
    assert abs(np.mean(errors_m)) < 0.05


def test_changing_range_errors_are_not_drawn_backwards():
    own = tape(Impairments(range_errors=RangeErrorModel(changing_m=0.3, correlation_s=0.5)))
    own.hear(0, 2.0, 2.5)
    with pytest.raises(ValueError, match="in the order of time"):
        own.hear(0, 1.0, 1.5)


def test_random_numbers_are_uniform_and_independent_of_their_neighbours():
    numbers = np.arange(20_000)
    drawn = uniforms(7, 1, 3, numbers)
    assert kstest(drawn, "uniform").pvalue > 1e-4
    assert kstest(normals(7, 1, 3, numbers), "norm").pvalue > 1e-4
    assert abs(np.corrcoef(drawn[1:], drawn[:-1])[0, 1]) < 4.0 / np.sqrt(len(drawn))
    assert abs(np.corrcoef(drawn, uniforms(7, 1, 4, numbers))[0, 1]) < 4.0 / np.sqrt(len(drawn))


@pytest.mark.parametrize(
    ("fault", "name"),
    [
        ({"diagnostics": True}, "impairments.diagnostics is True"),
        ({"channel": ChannelModel(nlos_probability=0.1)}, "channel.nlos_probability is 0.1"),
        ({"channel": ChannelModel(power_bias=True)}, "channel.power_bias is True"),
    ],
)
def test_what_is_not_modelled_is_named(fault, name):
    with pytest.raises(ValueError, match=name):
        tape(Impairments(**fault))
