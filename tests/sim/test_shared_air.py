"""Frames that meet: collisions, capture, half duplex; against closed forms."""

import numpy as np
import pytest
from metronome import IDEAL, Metronome, site_of
from scipy.stats import binom

from skyless.core.air.frame import air_time_s
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World

pytestmark = pytest.mark.site

PERIODS_S = {1: 3.1e-3, 2: 2.3e-3 * 2**0.5}
FRAME_BYTES = {1: 40, 2: 100}


def _rivals(anchor):
    return Metronome(anchor, period_s=PERIODS_S[anchor], frame_bytes=FRAME_BYTES[anchor])


def _rival_world(tag_x_m, until_s=20.0):
    """Two unsynchronised anchors 10 m apart and a tag on the line between them; frames heard and sent, each."""
    world = World(site_of((0, 0), (10, 0)), _rivals, [TagSpec(Static(tag_x_m, 0.0))], IDEAL, 1)
    heard, sent = np.zeros(3, dtype=int), np.zeros(3, dtype=int)
    for broadcast in world.run(until_s):
        sent[broadcast.anchor] += 1
        heard[broadcast.anchor] += len(broadcast.tags)
    return heard, sent, world.tally


def _within(count, of, share):
    return binom.ppf(1e-4, of, share) <= count <= binom.ppf(1 - 1e-4, of, share)


def test_unsynchronised_anchors_collide_as_often_as_air_times_say():
    """A frame is hit when the other's begins within both air times of its own end: (T1 + T2)/P2 of the time."""
    heard, sent, tally = _rival_world(5.0)
    both_s = air_time_s(FRAME_BYTES[1]) + air_time_s(FRAME_BYTES[2])
    for anchor, other in ((1, 2), (2, 1)):
        assert _within(sent[anchor] - heard[anchor], sent[anchor], both_s / PERIODS_S[other])
    assert tally.at_tags["collision"] + tally.at_tags["heard"] == tally.transmissions


def test_an_anchor_that_sends_hears_nothing():
    _, sent, tally = _rival_world(5.0)
    both_s = air_time_s(FRAME_BYTES[1]) + air_time_s(FRAME_BYTES[2])
    expected = sent[1] * both_s / PERIODS_S[2] + sent[2] * both_s / PERIODS_S[1]
    assert tally.at_anchors["half-duplex"] == pytest.approx(expected, abs=4 * expected**0.5)
    assert tally.at_anchors["collision"] == 0
    assert tally.at_anchors["heard"] + tally.at_anchors["half-duplex"] == tally.transmissions


def test_the_stronger_frame_survives():
    """At 1 m against 9 m the powers differ by 19 dB, past the capture margin: only the far anchor loses."""
    heard, sent, _ = _rival_world(1.0)
    assert heard[1] == sent[1]
    assert heard[2] < 0.95 * sent[2]


def test_a_little_stronger_is_not_enough():
    """At 4 m against 6 m the powers differ by 3.5 dB: both are lost."""
    near, sent, _ = _rival_world(4.0, 5.0)
    assert near[1] < sent[1]
    assert near[2] < sent[2]


def test_frames_one_after_another_do_not_touch():
    """The gap between two frames counts from end to preamble, not from RMARKER to RMARKER."""
    for gap_s, expected in ((2e-6, 0), (-2e-6, 2)):
        apart_s = air_time_s(40) + gap_s
        # counters of ideal crystals start at random, but the machines are switched on together
        world = World(
            site_of((0, 0), (0, 3)),
            lambda anchor, apart_s=apart_s: Metronome(anchor, first_s=5e-3 + (anchor - 1) * apart_s, period_s=1.0),
            [TagSpec(Static(4.0, 1.5))],
            IDEAL,
            1,
        )
        for _ in world.run(0.1):
            pass
        assert world.tally.at_tags["collision"] == expected
