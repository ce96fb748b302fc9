"""Receptions among several cells by hand: capture, half duplex, early first paths."""

import math

import numpy as np
import pytest
from metronome import IDEAL, Metronome, site_of

from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_RATE_HZ, TICK_S, difference
from skyless.sim.cells.reception import (
    COLLISION,
    HALF_DUPLEX,
    PREAMBLE_TICKS,
    RECEIVED,
    Frames,
    delivery_chance,
    disturb,
    rules_of,
)
from skyless.sim.impairments import AnchorDisplacement, AnchorOutage, Impairments, Outage
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.site.channel import ChannelModel
from support.cell_medium import cell_world

pytestmark = pytest.mark.site

RULES = rules_of(ChannelModel(), 0.0, 0.0, 1)
AFTER_TICKS = 1.0e7
LENGTH_S = (PREAMBLE_TICKS + AFTER_TICKS) * TICK_S
WANTED_M = 10.0


def effect(other_m, later_s, *, listener=-1, before=(RECEIVED, 0.0)):
    """Outcome and shift in s at the origin of a frame from 10 m, with another that is emitted ``later_s`` later."""
    positions_m = np.array([(WANTED_M, 0.0, 0.0), (0.0, other_m, 0.0)])
    frames = Frames(
        np.array([0, 1]),
        np.array([0, round(later_s * TICK_RATE_HZ)]),
        np.zeros(2),
        np.array([AFTER_TICKS, AFTER_TICKS]),
    )
    wanted = (0, 0, 0.0, AFTER_TICKS, WANTED_M**2)
    outcome, early = disturb(RULES, frames, 0, 2, positions_m, listener, (0.0, 0.0, 0.0), wanted, before)
    return outcome, early * TICK_S


def flight_s(distance_m):
    return distance_m / SPEED_OF_LIGHT_MPS


@pytest.mark.parametrize("other_m", [2.0, 10.0, 31.0])
def test_a_frame_within_the_capture_margin_destroys_another_it_overlaps(other_m):
    """Overlap counts at the listener: from the end of one to the beginning of the other, flight times included."""
    longer_s = flight_s(other_m) - flight_s(WANTED_M)
    for sign in (1.0, -1.0):
        touching_s = sign * LENGTH_S - longer_s
        assert effect(other_m, touching_s - sign * 1e-9)[0] == COLLISION
        assert effect(other_m, touching_s + sign * 1e-9)[0] == RECEIVED


def test_a_frame_beyond_the_capture_margin_does_not():
    assert effect(32.0, 20e-6) == (RECEIVED, 0.0)


@pytest.mark.parametrize(
    ("other_m", "arrives_s", "shift_s"),
    [
        (40.0, -200e-9, 200e-9),
        (99.0, -900e-9, 900e-9),
        (101.0, -200e-9, 0.0),  # more than 20 dB weaker
        (40.0, -1001e-9, 0.0),  # outside the search window
        (40.0, 1e-9, 0.0),  # later
    ],
)
def test_an_earlier_frame_of_the_same_slot_is_taken_for_the_first_path(other_m, arrives_s, shift_s):
    outcome, early_s = effect(other_m, arrives_s + flight_s(WANTED_M) - flight_s(other_m))
    assert outcome == RECEIVED
    assert early_s == pytest.approx(shift_s, abs=TICK_S)


def test_the_earliest_of_several_counts_and_a_collision_stays_one():
    later_s = -300e-9 + flight_s(WANTED_M) - flight_s(40.0)
    assert effect(40.0, later_s, before=(RECEIVED, 5e-7 / TICK_S))[1] == pytest.approx(5e-7)
    assert effect(40.0, later_s, before=(RECEIVED, 1e-7 / TICK_S))[1] == pytest.approx(3e-7, abs=TICK_S)
    assert effect(40.0, later_s, before=(COLLISION, 0.0))[0] == COLLISION


def test_a_listener_that_sends_receives_nothing():
    """Its own frame does not fly: the wanted one must have ended before its preamble begins."""
    ends_s = LENGTH_S + flight_s(WANTED_M)
    assert effect(0.0, ends_s - 1e-9, listener=1)[0] == HALF_DUPLEX
    assert effect(0.0, ends_s + 1e-9, listener=1)[0] == RECEIVED
    assert effect(0.0, 0.0, listener=1, before=(COLLISION, 0.0))[0] == HALF_DUPLEX


def test_power_follows_free_space():
    """-14.3 dBm less 48.7 dB at 1 m leaves -93 dBm at 31 m; twelve widths of 0.5 dB are another factor of two."""
    half_m = 10.0 ** ((-14.3 + 93.0 - 48.69) / 20.0)
    assert delivery_chance(RULES, half_m**2) == pytest.approx(0.5, abs=0.01)
    assert RULES.audible_m == pytest.approx(half_m * 10.0**0.3, rel=1e-3)
    assert delivery_chance(RULES, (0.999 * RULES.audible_m) ** 2) < 1e-5
    assert delivery_chance(RULES, (1.001 * RULES.audible_m) ** 2) == 0.0
    assert RULES.reach_m == pytest.approx(RULES.audible_m * math.sqrt(10.0))


def world_of(other_m, first_s, impairments=IDEAL):
    """Anchor 1 sends every 15 ms and anchor 2 once, near the second frame of anchor 1; one tag."""

    def make(anchor):
        return Metronome(anchor) if anchor == 1 else Metronome(anchor, first_s=first_s, period_s=1.0)

    site = site_of((WANTED_M, 0), (0, other_m))
    return cell_world(site, make, [TagSpec(Static(0.0, 0.0))], impairments, 1)


def stamps(world, until_s):
    """RX stamps less whole true emissions of anchor 1's frames at the tag, and all emissions in s."""
    emitted, received = {1: [], 2: []}, []
    for broadcast in world.run(until_s):
        emitted[broadcast.anchor].append(broadcast.emission_s)
        if broadcast.anchor == 1:
            rows = [(rx - broadcast.emission_ticks, broadcast.emission_fraction) for rx in broadcast.rx_ticks.tolist()]
            received.append(rows[0] if rows else None)
    return received, emitted


def test_a_shifted_stamp_is_the_arrival_of_the_other_frame():
    received, emitted = stamps(world_of(40.0, 20e-3 - 300e-9), 0.06)
    assert len(received) == 4
    shift_ticks = difference(received[0][0], received[1][0])
    late_s = (emitted[1][1] + flight_s(WANTED_M)) - (emitted[2][0] + flight_s(40.0))
    assert late_s == pytest.approx(200e-9, abs=17e-9), "each starts on a grid of 8 ns"
    assert shift_ticks * TICK_S == pytest.approx(late_s, abs=2 * TICK_S)
    assert abs(difference(received[0][0], received[2][0])) <= 2


def test_two_frames_at_once_at_a_tag_and_at_each_other():
    world = world_of(12.0, 20e-3)
    received, _ = stamps(world, 0.06)
    assert [one is None for one in received] == [False, True, False, False]
    assert world.tally.at_tags["collision"] == 2
    assert world.tally.at_anchors["half-duplex"] == 2


def test_the_range_of_a_stamp_is_the_true_distance():
    """With a displaced anchor, from its true position."""
    faults = Impairments(0.0, 0.0, IDEAL.oscillator, anchor_displacements=(AnchorDisplacement(1, 5.0),))
    plain, moved = (stamps(world_of(40.0, 0.5, faults), 0.02)[0][0] for faults in (IDEAL, faults))
    assert difference(moved[0], plain[0]) * TICK_M == pytest.approx(5.0, abs=2 * TICK_M)


def test_a_restarted_node_has_a_new_counter_and_sends_no_old_frame():
    outages = (AnchorOutage(1, Outage(17e-3, 26e-3)),)
    received, emitted = stamps(world_of(40.0, 0.5, Impairments(anchor_outages=outages)), 0.06)
    assert [round(1e3 * t_s) for t_s in emitted[1]] == [5, 31, 46]
    assert None not in received
