"""Anchors that use a survey's positions and delays while they run: no time is lost, tags never mix old and new ones."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.core.any_anchor import new_anchor
from skyless.core.any_receiver import AnyReceiver
from skyless.core.site import AccuracySite, ScheduleSite, UnplacedAnchor
from skyless.sim.impairments import DelayError, lab_impairments
from skyless.sim.lab import paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World

pytestmark = pytest.mark.site

TAG_M = np.array((2.0, 3.0))
DELAY_TICKS = {1: 40, 2: -30, 3: 20, 4: 60, 5: -60, 6: 10}
PLACED_S = 2.0
TURN = np.array(((math.cos(0.5), -math.sin(0.5)), (math.sin(0.5), math.cos(0.5))))
SHIFT_M = np.array((1.0, -2.0))


def site_of(mode):
    lab = paper_lab_site(accuracy=AccuracySite())
    return lab if mode == "master" else replace(lab, schedule=ScheduleSite(mode="free", rate_hz=50.0))


def turned(anchor):
    """The anchor in another frame."""
    x_m, y_m = TURN @ (anchor.x_m, anchor.y_m) + SHIFT_M
    return replace(anchor, x_m=float(x_m), y_m=float(y_m))


def surveyed(site):
    """The site with the delays that the simulated antennas have."""
    corrected = (
        replace(anchor, tx_antenna_delay_ticks=anchor.tx_antenna_delay_ticks + DELAY_TICKS[anchor.id])
        for anchor in site.anchors
    )
    return replace(site, anchors=tuple(corrected))


def run(site, before, seed, stagger_s, seconds=4.0, after=None, delays_ticks=DELAY_TICKS):
    """Times and positions of a tag's fixes, times of each anchor's frames, and the tag."""
    machines, receiver, fixes, sent = {}, AnyReceiver(), [], {anchor.id: [] for anchor in site.anchors}

    def make(anchor_id):
        machines[anchor_id] = new_anchor(before, anchor_id)
        return machines[anchor_id]

    errors = tuple(DelayError(anchor, ticks) for anchor, ticks in delays_ticks.items())
    world = World(site, make, [TagSpec(Static(*TAG_M))], replace(lab_impairments(100.0), delay_errors=errors), seed)
    waiting = (np.random.default_rng(seed).permutation(len(site.anchors)) + 1).tolist()
    for broadcast in world.run(seconds):
        sent[broadcast.anchor].append(world.now_s)
        while waiting and world.now_s >= PLACED_S + (len(site.anchors) - len(waiting)) * stagger_s:
            machines[waiting.pop(0)].place(after or surveyed(site))
        for _, reception, _ in broadcast.receptions():
            fix = receiver.hear(reception)
            if fix is not None:
                fixes.append((world.now_s, *fix.position_m[:2]))
    return np.array(fixes), sent, receiver


def longest_gap_s(times_s, since_s):
    return max(np.diff([since_s, *(one for one in times_s if one > since_s)]))


@pytest.mark.parametrize("stagger_s", [0.0, 0.1])
@pytest.mark.parametrize(("mode", "without_fixes_s"), [("master", 0.5), ("free", 0.7)])
def test_tags_go_over_to_the_new_positions_and_never_mix_them_with_the_old(mode, without_fixes_s, stagger_s):
    site = site_of(mode)
    fixes, sent, receiver = run(site, replace(site, anchors=tuple(map(turned, site.anchors))), 1, stagger_s)
    by_new_m = np.linalg.norm(fixes[:, 1:] - TAG_M, axis=1)
    by_old_m = np.linalg.norm(fixes[:, 1:] - (TURN @ TAG_M + SHIFT_M), axis=1)
    assert np.minimum(by_new_m, by_old_m).max() < 0.6  # the old delays are off by 15 cm, 0.4 m after the worst start
    last_placed_s = PLACED_S + 5 * stagger_s
    later = fixes[:, 0] > last_placed_s + without_fixes_s + 0.3
    assert np.sqrt(np.mean(by_new_m[later] ** 2)) < 0.04  # one packet gives 4.6 cm, and many count
    assert longest_gap_s(fixes[:, 0], PLACED_S) < without_fixes_s
    assert max(longest_gap_s(times_s, 1.8) for times_s in sent.values()) < 0.05  # nobody loses its time
    assert receiver.counters["site-change"] == receiver.counters["anchor-restart"] == 0


@pytest.mark.parametrize("mode", ["master", "free"])
def test_no_fix_mixes_positions_where_anchors_take_seconds_to_adopt_them(mode):
    site = site_of(mode)
    before = replace(site, anchors=tuple(map(turned, site.anchors)))
    fixes, *_ = run(site, before, 4, 0.6, 8.0, after=site, delays_ticks={})
    by_new_m = np.linalg.norm(fixes[:, 1:] - TAG_M, axis=1)
    by_old_m = np.linalg.norm(fixes[:, 1:] - (TURN @ TAG_M + SHIFT_M), axis=1)
    assert np.minimum(by_new_m, by_old_m).max() < 0.3  # 2.5 m apart; one packet has 4.6 cm
    assert by_new_m[fixes[:, 0] > PLACED_S + 5 * 0.6 + 1.0].max() < 0.3
    if mode != "master":  # of six anchors four have to have moved; its almanac is whole or it is not used
        assert longest_gap_s(fixes[:, 0], PLACED_S) < 2.5


def test_a_tag_without_fixes_gets_them_when_anchors_get_positions():
    site = site_of("free")
    unplaced = tuple(UnplacedAnchor(anchor.id) for anchor in site.anchors)
    fixes, _, receiver = run(site, replace(site, anchors=(), unplaced=unplaced), 2, 0.0, 3.0)
    assert fixes[0, 0] > PLACED_S
    assert fixes[0, 0] < PLACED_S + 0.2
    assert np.sqrt(np.mean(np.sum((fixes[-100:, 1:] - TAG_M) ** 2, axis=1))) < 0.04
    assert receiver.counters["no-position"] > 100


def test_others_go_on_while_one_anchor_has_moved_and_it_joins_again():
    site = site_of("free")
    before = replace(site, anchors=(*site.anchors[:5], replace(site.anchors[5], x_m=0.5)))
    fixes, _, receiver = run(site, before, 3, 0.0, after=site, delays_ticks={})
    assert receiver.counters["moved-anchor"] > 10
    assert 6 not in receiver.method.estimator.anchors  # for ten seconds, in which the others might follow
    assert longest_gap_s(fixes[:, 0], PLACED_S) < 0.05
    assert np.sqrt(np.mean(np.sum((fixes[fixes[:, 0] > 3.0, 1:] - TAG_M) ** 2, axis=1))) < 0.04
    fixes, _, receiver = run(site, before, 3, 0.0, PLACED_S + 10.5, after=site, delays_ticks={})
    assert 6 in receiver.method.estimator.anchors
    assert longest_gap_s(fixes[:, 0], PLACED_S) < 0.05
