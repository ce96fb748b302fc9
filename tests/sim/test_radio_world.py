"""The world against physics: distances, noise, granularity, wraps, losses, obstacles, restarts."""

import hashlib
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from metronome import AT_REST, DELAY_TICKS, IDEAL, LAB, Metronome, faulty, lateness, sent, site_of, staggered
from scipy.stats import binom, chi2, expon, kstest

from skyless.core.protocol1.anchor import Anchor
from skyless.core.site import WallSite
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S, Unwrapper, difference
from skyless.sim.impairments import (
    AnchorBias,
    AnchorDisplacement,
    AnchorOutage,
    Body,
    DelayError,
    Impairments,
    Outage,
    RangeErrorModel,
    WarmUp,
    lab_impairments,
)
from skyless.sim.listening import TagSpec
from skyless.sim.oscillator import OscillatorModel
from skyless.sim.trajectory import Roaming, Static, Waypoints
from skyless.sim.world import World
from skyless.site.channel import ChannelModel, power_bias_m, received_power_dbm

pytestmark = pytest.mark.site


def unwrapped(counters):
    """Ticks of successive counter values, shape (n,)."""
    unwrapper = Unwrapper()
    return np.array([unwrapper.unwrap(int(counter)) for counter in counters])


def _channel(**changes):
    return faulty(channel=ChannelModel(**changes))


def _receptions(world, until_s, tag=0):
    """Per anchor: claimed TX ticks, RX ticks, true emission ticks and fraction, for one tag."""
    found = {}
    for broadcast in world.run(until_s):
        anchor, tx_ticks = sent(broadcast.frame)
        assert anchor == broadcast.anchor
        for heard_by, reception, _ in broadcast.receptions():
            if heard_by == tag:
                row = (tx_ticks, reception.rx_ticks, broadcast.emission_ticks, broadcast.emission_fraction)
                found.setdefault(anchor, []).append(row)
    return found


def _flights_m(world, until_s, tag=0):
    """Per anchor, metres from true emission to RX stamp, but for the tag's unknown counter start (mod a wrap)."""
    flights = {}
    for anchor, rows in _receptions(world, until_s, tag).items():
        first = rows[0][1] - rows[0][2]
        ticks = [difference(rx, (true + first) % 2**40) - fraction for _, rx, true, fraction in rows]
        flights[anchor] = (first, np.array(ticks))
    origin = flights[1][0]
    return {
        anchor: (ticks + difference(first % 2**40, origin % 2**40)) * TICK_M
        for anchor, (first, ticks) in flights.items()
    }


def test_stamps_reproduce_the_distances_to_the_rounding():
    """Ideal clocks and radios: differences of flight times are differences of distances, within a tick."""
    flights = _flights_m(World(LAB, staggered(), [AT_REST], IDEAL, 1), 0.5)
    assert sorted(flights) == [1, 2, 3, 4, 5, 6]
    distance_m = {a.id: math.hypot(a.x_m - 3.0, a.y_m - 4.0) for a in LAB.anchors}
    for anchor, metres in flights.items():
        expected = distance_m[anchor] - distance_m[1]
        assert np.abs(metres - metres[0]).max() <= TICK_M
        assert np.abs(metres - flights[1].mean() - expected).max() <= TICK_M


def test_claimed_and_received_stamps_differ_by_flight_and_both_noises():
    """With noise σ on each stamp, RX - claimed TX has variance 2σ² + tick²/12 (RX alone is rounded)."""
    world = World(LAB, staggered(), [AT_REST], faulty(tx_stamp_ps=150.0, rx_stamp_ps=150.0), 2)
    for rows in _receptions(world, 12.0).values():
        ticks = np.array([difference(rx, tx) for tx, rx, _, _ in rows], dtype=np.float64)
        theory = 2.0 * (150e-12 / TICK_S) ** 2 + 1.0 / 12.0
        low, high = chi2.ppf([1e-4, 1 - 1e-4], len(ticks) - 1) / (len(ticks) - 1)
        assert low < np.var(ticks, ddof=1) / theory < high


def test_the_truth_knows_of_the_emission_noise():
    world = World(LAB, staggered(), [AT_REST], faulty(tx_stamp_ps=5000.0), 2)
    for metres in _flights_m(world, 2.0).values():
        assert np.ptp(metres) <= 2 * TICK_M


def test_crystals_run_at_their_own_rates():
    """RX against TX is a straight line; its slope differs from 1 by both offsets, and only noise is left over."""
    crystals = OscillatorModel(offset_ppm=10.0, white_fm=0.0, random_walk_fm=0.0)
    world = World(LAB, staggered(), [AT_REST], faulty(oscillator=crystals, rx_stamp_ps=100.0), 3)
    slopes = []
    for rows in _receptions(world, 20.0).values():
        tx, rx = (unwrapped([row[k] for row in rows]) for k in (0, 1))
        beyond = ((rx - rx[0]) - (tx - tx[0])).astype(np.float64)
        line = np.polyfit((tx - tx[0]).astype(np.float64), beyond, 1)
        left = beyond - np.polyval(line, (tx - tx[0]).astype(np.float64))
        theory = (100e-12 / TICK_S) ** 2 + 1.0 / 12.0
        low, high = chi2.ppf([1e-4, 1 - 1e-4], len(left) - 2)
        assert low < np.sum(left**2) / theory < high
        slopes.append(line[0])
    assert np.abs(slopes).max() < 20.1e-6
    assert np.ptp(slopes) > 1e-6


def test_the_radio_drops_the_low_nine_bits():
    """A machine that asks for a time between the 8 ns steps sends earlier than it says."""
    honest = _receptions(World(LAB, staggered(), [AT_REST], IDEAL, 1), 0.1)
    hasty = _receptions(World(LAB, staggered(off_grid_ticks=300), [AT_REST], IDEAL, 1), 0.1)
    for anchor, rows in hasty.items():
        assert all((tx - DELAY_TICKS) % 512 == 300 for tx, _, _, _ in rows)
        told = [difference(rx, tx) for tx, rx, _, _ in rows]
        true = [difference(rx, tx) for tx, rx, _, _ in honest[anchor]]
        assert np.mean(true) - np.mean(told) == pytest.approx(300.0, abs=1.0)


def test_counters_wrap_for_hours_without_a_jump():
    """One frame in 8 s over 10 h: 2000 wraps; the line of RX over true time is straight to a tick."""
    crystals = OscillatorModel(offset_ppm=10.0, white_fm=0.0, random_walk_fm=0.0)
    site = site_of((0, 0))
    world = World(site, lambda a: Metronome(a, period_s=8.0), [AT_REST], faulty(oscillator=crystals), 4)
    rows = _receptions(world, 36_000.0)[1]
    rx = unwrapped([row[1] for row in rows])
    tx = unwrapped([row[0] for row in rows])
    true = np.array([row[2] for row in rows])
    assert rx[-1] - rx[0] > 2000 * 2**40
    for counter in (rx, tx):
        gained = ((counter - counter[0]) - (true - true[0])).astype(np.float64)
        rate = gained[-1] / (true[-1] - true[0])
        assert 1e-9 < abs(rate) < 10e-6
        assert np.abs(gained - rate * (true - true[0])).max() < 3.0


def _fingerprint(world, until_s):
    digest = hashlib.sha256()
    for broadcast in world.run(until_s):
        digest.update(broadcast.frame + broadcast.rx_ticks.tobytes() + broadcast.positions_m.tobytes())
        digest.update(repr((broadcast.emission_ticks, broadcast.emission_fraction, broadcast.end_s)).encode())
    return digest.hexdigest()


def _busy_world(seed, tags=2):
    faults = Impairments(
        channel=ChannelModel(loss_probability=0.1, nlos_probability=0.1, power_bias=True),
        anchor_displacements=(AnchorDisplacement(2, 0.1, 0.1),),
        anchor_biases=(AnchorBias(5, 0.3, from_s=0.1, to_s=0.2),),
        anchor_outages=(AnchorOutage(3, Outage(0.1, 0.3)),),
        range_errors=RangeErrorModel(0.05, 0.05, 0.029, correlation_m=1.0),
        body=Body(),
        warm_ups=(WarmUp(1.0, 20.0), WarmUp(1.0, 20.0, anchor=2)),
        diagnostics=True,
    )
    specs = [TagSpec(Roaming((3, 4, 0), (1, 1.3, 0), seed=k)) for k in range(tags)]
    return World(LAB, staggered(), specs, faults, seed)


def test_a_seed_gives_the_same_world_again():
    assert _fingerprint(_busy_world(1), 0.5) == _fingerprint(_busy_world(1), 0.5)
    assert _fingerprint(_busy_world(1), 0.5) != _fingerprint(_busy_world(2), 0.5)


def test_running_in_pieces_changes_nothing():
    whole, pieces = _busy_world(1), _busy_world(1)
    told = [(b.anchor, b.rx_ticks.tolist()) for b in whole.run(0.4)]
    parts = [(b.anchor, b.rx_ticks.tolist()) for until in (0.05, 0.1234, 0.4) for b in pieces.run(until)]
    assert told == parts
    assert pieces.now_s == pytest.approx(0.4)


def test_another_tag_changes_nothing_for_the_others():
    few, many = _busy_world(1, tags=1), _busy_world(1, tags=5)
    assert _receptions(few, 0.5) == _receptions(many, 0.5)
    assert _receptions(_busy_world(1, tags=3), 0.3, tag=2) == _receptions(_busy_world(1, tags=4), 0.3, tag=2)


def test_anchors_hear_each_other_and_the_host_knows_the_time():
    machines = {}

    def factory(anchor):
        machines[anchor] = Metronome(anchor, first_s=5e-3 + 2e-3 * anchor)
        return machines[anchor]

    world = World(LAB, factory, [AT_REST], IDEAL, 1)
    ends = [broadcast.end_s for broadcast in world.run(0.1)]
    heard = [sent(reception.frame)[0] for reception in machines[2].heard]
    assert set(heard) == {1, 3, 4, 5, 6}
    assert [r.host_s for r in machines[2].heard] == sorted(r.host_s for r in machines[2].heard)
    assert {r.host_s for r in machines[2].heard} <= set(ends)


def test_a_silent_machine_is_asked_again():
    world = World(site_of((0, 0)), lambda a: Metronome(a, silent_asks=7), [AT_REST], IDEAL, 1)
    first = next(iter(world.run(1.0)))
    assert 0.035 <= first.emission_s < 0.045  # seven asks, 5 ms apart, then 5 ms to the first beat


def test_a_late_frame_is_skipped_and_counted():
    """The preamble flies 138.4 µs before the RMARKER, and the host needs 200 µs before that."""
    for first_s, late in ((0.335e-3, 1), (0.342e-3, 0)):
        world = World(site_of((0, 0)), lambda a, first_s=first_s: Metronome(a, first_s=first_s), [AT_REST], IDEAL, 1)
        sent_times = [broadcast.emission_s for broadcast in world.run(0.1)]
        assert world.tally.late_transmissions == late
        assert sent_times[0] == pytest.approx(late * 15e-3 + first_s, abs=1e-8)


def test_message_loss_is_as_frequent_as_asked():
    world = World(LAB, staggered(), [AT_REST], _channel(loss_probability=0.2), 5)
    for _ in world.run(8.0):
        pass
    tally = world.tally
    for counts in (tally.at_tags, tally.at_anchors):
        heard, lost = counts["heard"], counts["message-loss"]
        assert binom.ppf(1e-4, heard + lost, 0.2) <= lost <= binom.ppf(1 - 1e-4, heard + lost, 0.2)
        assert sum(counts.values()) == heard + lost
    assert tally.at_anchors["heard"] + tally.at_anchors["message-loss"] == 5 * tally.transmissions


def test_reception_fades_out_around_the_sensitivity():
    """The share received is the logistic function of the margin, one half at the sensitivity itself."""
    model = ChannelModel()
    reach_m = 10.0 ** ((received_power_dbm(model.tx_power_dbm, 1.0, 0.0) - model.sensitivity_dbm) / 20.0)
    margins_db = (0.0, 0.5, -1.0, 20.0, -20.0)
    tags = [TagSpec(Static(reach_m / 10 ** (margin / 20.0), 0.0)) for margin in margins_db]
    world = World(site_of((0, 0)), Metronome, tags, IDEAL, 6)
    counts = np.zeros(len(tags))
    frames = 0
    for broadcast in world.run(15.0):
        counts[broadcast.tags] += 1
        frames += 1
    for count, margin in zip(counts, margins_db, strict=True):
        share = 1.0 / (1.0 + math.exp(-margin / 0.5))
        assert binom.ppf(1e-4, frames, share) <= count <= binom.ppf(1 - 1e-4, frames, share)


def test_late_messages_are_as_frequent_and_as_late_as_asked():
    extra = lateness(_channel(nlos_probability=0.3, nlos_mean_m=2.0), 6.0)
    metres = np.concatenate([rows[:, 1] for rows in extra.values()])
    late = metres[metres > 0.5 * TICK_M]
    share = 0.3 * math.exp(-0.5 * TICK_M / 2.0)
    assert binom.ppf(1e-4, len(metres), share) <= len(late) <= binom.ppf(1 - 1e-4, len(metres), share)
    assert kstest(late, expon(scale=2.0).cdf).pvalue > 1e-4
    assert metres.min() == 0.0


def test_walls_delay_and_weaken():
    wall = WallSite(1.5, 1.0, 1.5, 3.0, loss_db=7.0, delay_m=0.25)
    plain, walled = site_of((0, 0), (6, 0)), site_of((0, 0), (6, 0), walls=[wall])
    seen = []
    model = faulty(diagnostics=True, channel=ChannelModel(power_noise_db=0.0))
    for site in (plain, walled):
        world = World(site, staggered(), [AT_REST], model, 1)
        seen.append({b.anchor: (int(b.rx_ticks[0]), b.diagnostics[0]) for b in world.run(0.03)})
    for anchor, metres, loss_db in ((1, 0.25, 7.0), (2, 0.0, 0.0)):
        (clear_ticks, clear), (late_ticks, late) = seen[0][anchor], seen[1][anchor]
        assert difference(late_ticks, clear_ticks) * TICK_M == pytest.approx(metres, abs=TICK_M)
        assert clear.rx_power_dbm - late.rx_power_dbm == pytest.approx(loss_db)
        assert (late.rx_power_dbm - late.first_path_power_dbm > 6.0) is (loss_db > 0.0)


def test_power_bias_follows_the_table():
    extra = lateness(_channel(power_bias=True), 0.2)
    for anchor in LAB.anchors:
        distance_m = math.hypot(anchor.x_m - 3.0, anchor.y_m - 4.0)
        bias_m = power_bias_m(received_power_dbm(-14.3, distance_m, 0.0))
        assert extra[anchor.id][:, 1] == pytest.approx(np.full(len(extra[anchor.id]), bias_m), abs=TICK_M)
    assert power_bias_m(received_power_dbm(-14.3, 5.0, 0.0)) == pytest.approx(0.0, abs=2e-3)


def test_antenna_delay_errors_shift_their_stamps():
    errors = (DelayError(2, tx_ticks=70.0), DelayError(3, rx_ticks=900.0))
    extra = lateness(faulty(delay_errors=errors), 0.2)
    assert extra[2][:, 1] == pytest.approx(np.full(len(extra[2]), 70.0 * TICK_M), abs=TICK_M)
    assert np.abs(extra[3][:, 1]).max() == 0.0


def test_diagnostics_tell_power_offset_and_doppler():
    crystals = OscillatorModel(offset_ppm=10.0, white_fm=0.0, random_walk_fm=0.0)
    model = ChannelModel(power_noise_db=0.0, carrier_noise_ppm=0.0)
    still, fleeing = TagSpec(Static(3, 4)), TagSpec(Waypoints([(0, 1), (0, 5000)], 30.0))
    impairments = faulty(oscillator=crystals, channel=model, diagnostics=True)
    world = World(site_of((0, 0)), staggered(), [still, fleeing], impairments, 8)
    tx, rx, seen, offsets = [], [[], []], [], [[], []]
    for broadcast in world.run(1.0):
        tx.append(sent(broadcast.frame)[1])
        for tag, reception, _ in broadcast.receptions():
            rx[tag].append(reception.rx_ticks)
            offsets[tag].append(reception.diagnostics.carrier_offset_ppm)
        seen.append(broadcast.diagnostics[0].rx_power_dbm)
    assert seen == pytest.approx([received_power_dbm(-14.3, 5.0, 0.0)] * len(seen))
    tx_ticks = unwrapped(tx)
    for tag in (0, 1):  # sender's rate against the listener's, as the stamps themselves tell it, Doppler included
        rx_ticks = unwrapped(rx[tag])
        from_stamps = ((tx_ticks[-1] - tx_ticks[0]) / (rx_ticks[-1] - rx_ticks[0]) - 1.0) * 1e6
        assert np.mean(offsets[tag]) == pytest.approx(from_stamps, abs=2e-3)
    assert 30.0 / SPEED_OF_LIGHT_MPS * 1e6 > 0.1  # the Doppler that the second tag must have seen


def test_without_diagnostics_none_are_told():
    broadcast = next(iter(World(LAB, staggered(), [AT_REST], IDEAL, 1).run(1.0)))
    assert broadcast.diagnostics is None
    assert next(broadcast.receptions())[1].diagnostics is None


def test_moving_tags_are_where_their_path_says():
    path = Waypoints([(0, 1), (6, 1), (6, 7)], 2.0, corner_s=0.5)
    world = World(LAB, staggered(), [AT_REST, TagSpec(path)], IDEAL, 1)
    for broadcast in world.run(8.0):
        at = broadcast.tags.tolist().index(1)
        assert broadcast.positions_m[at] == pytest.approx(path.position(broadcast.emission_s), abs=1e-9)


def test_a_restarted_anchor_is_a_new_machine_with_a_new_counter():
    made = []

    def factory(anchor):
        made.append(anchor)
        return Metronome(anchor, first_s=5e-3 + 2e-3 * anchor)

    outage = AnchorOutage(2, Outage(0.2, 0.5))
    world = World(LAB, factory, [AT_REST], faulty(anchor_outages=(outage,)), 9)
    rows = _receptions(world, 1.0)
    assert made.count(2) == 2
    assert made.count(1) == 1
    times = np.array([true for _, _, true, _ in rows[2]]) * TICK_S
    assert not ((times > 0.2) & (times < 0.5)).any()
    assert (times < 0.2).any()
    assert (times > 0.5).any()
    phase = [(tx - true) % 2**40 for tx, _, true, _ in rows[2]]
    before, after = (np.array(phase)[times < 0.2], np.array(phase)[times > 0.5])
    assert np.ptp(before) <= 1
    assert np.ptp(after) <= 1
    assert abs(difference(int(before[0]), int(after[0]))) > 10**6
    undisturbed = World(LAB, staggered(), [AT_REST], IDEAL, 9)
    assert rows[1] == _receptions(undisturbed, 1.0)[1]


def test_a_restarted_tag_has_a_new_counter():
    tag = TagSpec(Static(3, 4), outages=(Outage(0.2, 0.4), Outage(0.6)))
    world = World(LAB, staggered(), [AT_REST, tag], IDEAL, 9)
    rows = _receptions(world, 1.0, tag=1)[1]
    times = np.array([true for _, _, true, _ in rows]) * TICK_S
    assert not ((times > 0.2) & (times < 0.4)).any()
    assert times.max() < 0.6
    phases = {(rx - true) % 2**40 // 4096 for _, rx, true, _ in rows}
    assert 2 <= len(phases) <= 4


def test_overlapping_outages_end_with_the_last():
    made = []

    def factory(anchor):
        made.append(anchor)
        return Metronome(anchor)

    outages = (AnchorOutage(1, Outage(0.0, 0.3)), AnchorOutage(1, Outage(0.1, 0.5)))
    world = World(site_of((0, 0)), factory, [AT_REST], faulty(anchor_outages=outages), 1)
    times = [broadcast.emission_s for broadcast in world.run(1.0)]
    assert made == [1]
    assert times[0] == pytest.approx(0.505, abs=1e-7)
    assert np.diff(times) == pytest.approx(np.full(len(times) - 1, 15e-3), abs=1e-7)


def test_impairments_of_unknown_anchors_are_refused():
    with pytest.raises(ValueError, match=r"anchor_biases names anchor 9; .*1, 2, 3, 4, 5, 6"):
        World(LAB, staggered(), [], faulty(anchor_biases=(AnchorBias(9, 1.0),)), 1)


def test_the_lab_is_as_the_mathematics_says():
    lab = lab_impairments(150.0)
    assert (lab.tx_stamp_ps, lab.rx_stamp_ps) == (150.0, 150.0)
    world = World(LAB, staggered(), [AT_REST], lab, 1)
    for _ in world.run(1.0):
        pass
    assert set(world.tally.at_tags.values()) == {0, world.tally.transmissions}


PRINT_STAMPS = """
from metronome import faulty, staggered
from test_radio_world import _busy_world
for b in _busy_world(3).run(0.12):
    print(b.anchor, b.emission_ticks, *b.tags, *b.rx_ticks)
"""


@pytest.mark.statistical
def test_without_the_compiler_the_world_is_the_same():
    """Python gives the same frames at the same listeners, with the same stamps."""
    here = Path(__file__).parent
    stamps = []
    for uncompiled in ("0", "1"):
        environment = {**os.environ, "SKYLESS_UNCOMPILED": uncompiled}
        printed = subprocess.run(
            [sys.executable, "-c", PRINT_STAMPS], cwd=here, env=environment, capture_output=True, text=True, check=True
        ).stdout
        stamps.append([[int(word) for word in line.split()] for line in printed.splitlines()])
    compiled, interpreted = stamps
    assert len(compiled) > 30
    assert compiled == interpreted


def test_the_real_anchors_keep_their_slots_in_the_world():
    """In true time the six anchors of the lab speak one slot of 2.5 ms after the other, and nothing is lost."""
    world = World(LAB, lambda anchor: Anchor(LAB, anchor), [AT_REST], lab_impairments(100.0), 11)
    told = [(b.emission_s, b.anchor) for b in world.run(1.5) if b.emission_s > 0.5]
    times, anchors = np.array(told).T
    assert np.diff(times) == pytest.approx(np.full(len(times) - 1, 2.5e-3), rel=1e-5, abs=20e-9)
    assert (np.diff(anchors) % 6 == 1).all()
    losses = world.tally.at_tags["half-duplex"] + world.tally.at_tags["collision"]
    assert (losses, world.tally.late_transmissions) == (0, 0)
