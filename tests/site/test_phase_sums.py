"""The watch of the anchors by phases: at rest, displaced, reset, without phases, recorded; and the mean of phases."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.any_anchor import new_anchor
from skyless.core.ticks import CARRIER_CYCLES, TICK_RATE_HZ, wrap
from skyless.research.foreign import datasets as muloc
from skyless.sim.impairments import AnchorDisplacement, AnchorOutage, CarrierModel, Outage, lab_impairments
from skyless.sim.lab import lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World
from skyless.site.survey.explain import BLOCK_S, PhaseWatch, circular_mean
from skyless.site.survey.legs import AnchorLeg, LegCollector

SITE = replace(lab_site(), schedule=replace(lab_site().schedule, carrier_phase=True))
HALF_WAVE_M = 0.0231


def legs_of(seconds, seed, site=SITE, **changes):
    """The legs that a listener in the middle of the lab learns, crystals and stamps with the lab's noise."""
    impairments = replace(lab_impairments(100.0), **{"carrier": CarrierModel(), **changes})
    world = World(site, lambda anchor: new_anchor(site, anchor), (TagSpec(Static(3.0, 4.0)),), impairments, seed)
    collector = LegCollector(site.id)
    for broadcast in world.run(seconds):
        for _, reception, _ in broadcast.receptions():
            yield from collector.add(reception)


def found_in(legs, watch=None):
    """The watch, and all that it finds: the time and the finding, when an anchor is first named."""
    watch, found, looked_s = watch or PhaseWatch(), {}, 0.0
    for leg in legs:
        watch.add(leg)
        if leg.t_s - looked_s > 0.5:
            looked_s = leg.t_s
            for one in watch.findings:
                found.setdefault(one.anchors, (leg.t_s, one))
    return watch, found


def blocks_of(watch):
    return {pair: len(one.usual_cycles) for pair, one in watch._pairs.items()}


@pytest.mark.statistical
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_nothing_is_found_at_rest(seed):
    """The means of blocks agree within what is recorded: 0.6 mm one way."""
    watch, found = found_in(legs_of(60.0, seed))
    assert not found
    assert len(watch._pairs) == 15
    assert all(blocks >= 28 for blocks in blocks_of(watch).values())
    for one in watch._pairs.values():
        mean, scatter = circular_mean(np.array(one.usual_cycles))
        off = (np.array(one.usual_cycles) - mean + 0.5) % 1.0 - 0.5
        assert scatter * HALF_WAVE_M < 0.0002
        assert np.abs(off).max() * HALF_WAVE_M < 0.0006


@pytest.mark.site
@pytest.mark.parametrize(("anchor", "shift"), [(3, {"x_m": 0.005}), (6, {"y_m": -0.003, "x_m": 0.004})])
def test_an_anchor_that_moves_by_5_mm_is_named_within_seconds(anchor, shift):
    moved = AnchorDisplacement(anchor, **shift, from_s=16.0)
    watch, found = found_in(legs_of(30.0, 4, anchor_displacements=(moved,)))
    assert found.keys() == {(anchor,)}
    named_s, finding = found[anchor,]
    assert named_s < 16.0 + 3.5 * BLOCK_S
    assert 14.0 <= finding.since_s <= 18.0
    (finding,) = watch.findings
    assert finding.kind == "check"
    assert 0.004 < finding.size_m < 0.0053  # no pair need lie along the way
    assert finding.sentence.startswith(f"anchor {anchor} moved or turned by about 5 mm (or 18, 28, 41 …)")


@pytest.mark.statistical
def test_two_anchors_that_move_are_both_named_and_one_that_comes_back_is_not_any_more():
    moved = (
        AnchorDisplacement(2, x_m=0.004, y_m=0.005, from_s=14.0),
        AnchorDisplacement(5, x_m=0.004, y_m=-0.005, from_s=14.0),
        AnchorDisplacement(5, from_s=24.0),
    )
    watch, found = found_in(legs_of(32.0, 5, anchor_displacements=moved))
    assert found.keys() == {(2,), (5,)}
    assert [one.anchors for one in watch.findings] == [(2,)]


@pytest.mark.statistical
def test_an_anchor_that_restarts_is_none():
    """Its constants are others then; so are those of one that restarts within a block."""
    outages = (AnchorOutage(2, Outage(14.5, 15.0)), AnchorOutage(4, Outage(16.0, 22.0)))
    watch, found = found_in(legs_of(40.0, 6, anchor_outages=outages))
    assert not found
    blocks = blocks_of(watch)
    assert all(5 <= blocks[pair] <= (12 if 2 in pair else 9) for pair in blocks if {2, 4} & set(pair))
    assert blocks[1, 3] >= 18


@pytest.mark.site
def test_without_phases_nothing_is_looked_at():
    without = replace(SITE, schedule=replace(SITE.schedule, carrier_phase=False))
    for site, carrier in ((SITE, None), (without, CarrierModel())):
        watch, found = found_in(legs_of(3.0, 1, site, carrier=carrier))
        assert not found
        assert not watch._pairs


@pytest.mark.statistical
@pytest.mark.parametrize("share", [0.1, 0.2])
def test_wild_phases_and_gaps_raise_nothing_and_hide_nothing(share):
    rng = np.random.default_rng(1)

    def spoilt(legs):
        for leg in legs:
            if rng.random() > 0.2 and not 18.0 < leg.t_s < 25.0:
                is_wild = rng.random() < share
                yield replace(leg, carrier_phase_cycles=rng.random()) if is_wild else leg

    moved = AnchorDisplacement(3, x_m=0.005, from_s=20.0)
    _, found = found_in(spoilt(legs_of(34.0, 7, anchor_displacements=(moved,))))
    assert found.keys() == {(3,)}


def recorded_legs(folder, channel):
    """The legs of MULoc's recording, where those of anchor 0 are of one direction only."""
    sent, t_s, before = {}, 0.0, None
    with (folder / "muloc" / "location1_2.npz").open("rb") as stream:
        for packet in muloc.read_muloc(stream, Counter(), channel):
            t_s += 0.0 if before is None else wrap(packet.rx_ticks - before) / TICK_RATE_HZ
            before = packet.rx_ticks
            for relay in packet.relays:
                tx_ticks = sent.get((relay.anchor, relay.sequence))
                if tx_ticks is not None:
                    phase = relay.carrier_phase_cycles
                    yield AnchorLeg(relay.anchor, packet.anchor, tx_ticks, relay.rx_ticks, t_s, phase)
            sent[packet.anchor, packet.sequence] = packet.tx_ticks


@pytest.mark.site
@pytest.mark.parametrize("channel", [1, 3])
def test_recorded_anchors_stand_still(recordings, channel):
    """42 s of three real pairs; one of them that is shifted by 4 mm from 25 s on is named."""
    cycles = CARRIER_CYCLES[channel]
    legs = list(recorded_legs(recordings, channel))
    watch, found = found_in(legs, PhaseWatch(cycles))
    assert not found
    known = [one for pair, one in watch._pairs.items() if 0 not in pair]
    assert [len(one.usual_cycles) for one in known] == [21, 21, 21]
    for one in known:
        sums = np.array(one.usual_cycles)
        assert np.abs((sums - circular_mean(sums)[0] + 0.5) % 1.0 - 0.5).max() * watch._half_wave_m < 0.001
    shift_cycles = 0.004 / (2.0 * watch._half_wave_m)  # by which each of its phases falls as distances grow

    def shifted(leg):
        is_shifted = leg.t_s > 25.0 and 2 in {leg.sender, leg.receiver}
        return replace(leg, carrier_phase_cycles=leg.carrier_phase_cycles - is_shifted * shift_cycles)

    _, found = found_in(map(shifted, legs), PhaseWatch(cycles))
    assert found.keys() == {(2,)}
    assert found[2,][1].size_m == pytest.approx(0.004, abs=0.001)


wild_numbers = st.integers(-(1 << 70), 1 << 70)


@given(
    st.lists(
        st.builds(
            AnchorLeg, st.integers(1, 3), st.integers(1, 3), wild_numbers, wild_numbers,
            st.floats(), st.none() | st.floats(),
        ),
        max_size=60,
    )
)  # fmt: skip
@pytest.mark.site
def test_any_legs_raise_nothing(legs):
    watch = PhaseWatch()
    for leg in legs:
        watch.add(leg)
    assert watch.findings == ()


@given(st.integers(0, 1 << 32), st.floats(0.0, 1.0), st.floats(0.001, 0.05), st.floats(0.0, 0.25), st.integers(40, 300))
def test_the_circular_mean(seed, mean, std, wild, count):
    """It is near the true one beside any wild phases, knows no whole cycles, and turns with the phases."""
    rng = np.random.default_rng(seed)
    cycles = mean + std * rng.standard_normal(count)
    cycles[: int(wild * count)] = rng.random(int(wild * count))

    def apart(a, b):
        return abs((a - b + 0.5) % 1.0 - 0.5)

    found, scatter = circular_mean(cycles)
    assert 0.0 <= found < 1.0
    assert apart(found, mean) < 2.0 * std  # of 30 phases or more that are not wild
    assert scatter < 5.0 * std  # what is farther than 3 of their medians off is left out
    assert apart(found, circular_mean(cycles + rng.integers(-9, 9, count))[0]) < 1e-6
    assert apart(found + 0.3, circular_mean(cycles + 0.3)[0]) < 1e-6
