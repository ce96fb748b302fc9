"""The kernel of the study ``sitetime``: the same arithmetic as ``ComposedTime``, and figures by hop."""

import math
from collections import Counter

import numpy as np
import pytest

from skyless.air.beacon2 import SlotTime, StatedSiteTime
from skyless.clocks.composed_time import ComposedTime
from skyless.clocks.filter import clock_noise, stamp_variance_m2
from skyless.constants import SUBTICKS, TICK_S
from skyless.simulation import site_time
from skyless.simulation.oscillator import OscillatorModel
from skyless.site.slots import Schedule
from skyless.studies.sitetime import CORRIDORS, Site, World, by_hop, net_of
from skyless.ticks import wrap

NOISE = clock_noise(2e-11, 1e-9)
VARIANCE_M2 = 2.0 * stamp_variance_m2(100e-12, rounded=False) + stamp_variance_m2(0.0, rounded=True)
SCHEDULE = Schedule(124_800 * 512, 17)
SUPERFRAME_S = SCHEDULE.superframe_ticks * TICK_S


@pytest.mark.parametrize("with_site_time", [True, False])
def test_the_kernel_and_the_class_give_the_same_timeline(with_site_time):
    """The same raw stamps of three parents with constant rates and noise, some of them lost."""
    generator = np.random.default_rng(5)
    time = ComposedTime(NOISE, VARIANCE_M2, SCHEDULE, Counter())
    time.set_parents([1, 2, 3])
    links = np.zeros((4, 3), dtype=site_time.LINK)
    links["parent"], links["range_m"] = [1, 2, 3], 15.0
    maps = np.zeros(4, dtype=site_time.SITE_MAP)
    hops = np.array([3, 2, 2, 2])
    rates = np.array([-4e-6, 3e-6, 8e-6, -6e-6])
    std_ticks = 5.0
    for superframe in range(400):
        for number in range(3):
            start = SCHEDULE.slot_start_ticks(superframe, 5 * number)
            tx_ticks = start + round(start * rates[1 + number])
            rx_ticks = (1 << 44) + start + round(start * rates[0] + generator.normal(0.0, 9.0)) + 3195
            if generator.random() < 0.2:
                continue
            stated = StatedSiteTime(0.0, std_ticks) if with_site_time else None
            claim = SlotTime(superframe, 5 * number, 9, 0, 2, 0, float(rates[1 + number]))
            assert time.on_beacon(1 + number, wrap(tx_ticks), rx_ticks, 15.0, claim, stated)
            link = links[0, number]
            span = tx_ticks - link["tx_ticks"]
            if link["updates"] == 0 and maps[0]["known"]:
                _begin_with_the_same_rate(links, maps, number, tx_ticks, rx_ticks, float(rates[1 + number]))
            else:
                site_time.compare(links, 0, number, tx_ticks, rx_ticks, VARIANCE_M2, NOISE.white, NOISE.walk)
            nominal = start * SUBTICKS
            variance_m2 = (std_ticks * TICK_S * 299_792_458.0) ** 2
            stated_by = (nominal, nominal, variance_m2, float(rates[1 + number]), 2, with_site_time)
            site_time.read(links, 0, number, span, *stated_by)
            site_time.renew(links, maps, hops, 0, rx_ticks, SUPERFRAME_S, NOISE.white, NOISE.walk)
            ahead = rx_ticks + SCHEDULE.slot_ticks
            if superframe > 3:
                assert abs(site_time.timeline(maps, 0, ahead) - time.subticks(ahead)) <= 8
                variance = site_time.variance_of(links, maps, hops, 0, ahead, NOISE.white, NOISE.walk)
                assert variance == pytest.approx(time.variance_m2(ahead), rel=1e-3)


def _begin_with_the_same_rate(links, maps, number, tx_ticks, rx_ticks, parent_rate):
    """The kernel begins pairs without the rates; what differs is the start alone."""
    link = links[0, number]
    site_time.compare(links, 0, number, tx_ticks, rx_ticks, VARIANCE_M2, NOISE.white, NOISE.walk)
    rate = (1.0 + maps[0]["rate"]) / (1.0 + parent_rate) - 1.0
    link["rate_mps"] = rate * 299_792_458.0
    link["rate_variance"] = 40e-6**2 * 299_792_458.0**2


def test_hops_parents_and_slots_of_a_network():
    world = World(CORRIDORS[0], 0.0, True, 1.0, 100.0, 3)
    net = net_of(world)
    assert net.hops.max() == 66
    for anchor in range(1, len(net.hops)):
        parents = net.parents[anchor][net.parents[anchor] >= 0]
        assert len(parents) in ((1, 2, 3) if net.hops[anchor] <= 4 else (2, 3))
        assert (net.hops[parents] == net.hops[anchor] - 1).all()
    a, b = net.neighbours.T
    assert (net.slots[a] != net.slots[b]).all()
    with pytest.raises(ValueError, match="cannot be reached"):
        site_time.network(np.array([[0.0, 0.0], [100.0, 0.0]]), 22.0, 17, 1e-3, np.random.default_rng(1))
    with pytest.raises(ValueError, match="too few"):
        site_time.network(world.site.positions_m(), 22.0, 3, 1e-3, np.random.default_rng(1))


def corridor(site_time_parts, lost, seed):
    site = Site("short corridor", 450.0, 60.0, 15.0, 22.0, 17)
    world = World(site, lost, site_time_parts, 40.0, 100.0, seed)
    net = net_of(world)
    errors = site_time.simulate(
        net,
        OscillatorModel(),
        100e-12,
        lost=lost,
        seconds=world.seconds,
        settling_s=8.0,
        sample_s=0.1,
        site_time=site_time_parts,
        seed=seed,
    )
    return by_hop(net, errors)


@pytest.mark.parametrize("lost", [0.0, 0.5])
def test_what_anchors_state_is_what_they_err(lost):
    """Errors last for some 0.5 s, so 40 s and two seeds hold 160 independent ones: 6 % for one anchor alone."""
    runs = [corridor(True, lost, seed) for seed in (1, 2)]
    error, stated = (np.sqrt(np.mean([getattr(run, name) for run in runs], axis=0)) for name in ("error", "stated"))
    ratio = stated[1:] / error[1:]
    assert len(ratio) == 30
    assert ratio.min() > 0.7
    assert ratio.max() < 1.5


def test_slots_alone_keep_neighbours_within_50_ns():
    run = corridor(False, 0.2, 1)
    assert run.largest_m < 50e-9 * 299_792_458.0


def test_the_same_seed_gives_the_same_bits():
    assert corridor(True, 0.2, 4) == corridor(True, 0.2, 4)
    assert not math.isclose(corridor(True, 0.2, 5).error[5], corridor(True, 0.2, 4).error[5])
