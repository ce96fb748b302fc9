"""From recordings to surveys with a tag: a walk past anchors on two lines, and what the recording lacks."""

import json
from functools import partial

import numpy as np
import pytest
from msgspec.structs import replace

import skyless
from skyless.cli.main import main
from skyless.core.errors import SkylessError
from skyless.core.protocol1.anchor import Anchor
from skyless.core.ticks import TICK_M
from skyless.research.calibration.biases import ranges_of, walk_of
from skyless.run.recordings.recording import McapRecording
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.impairments import DelayError
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Waypoints
from skyless.sim.world import World
from skyless.site.survey.facts import Facts
from skyless.site.survey.solve import run_survey
from support import live_site
from support.alignment import aligned_rms_m
from support.bench import LAB, Heard

pytestmark = pytest.mark.site

HEIGHT_M = 0.0
WAY = [(1.0, 1.0, HEIGHT_M), (5.0, 7.0, HEIGHT_M), (5.0, 1.0, HEIGHT_M), (1.0, 7.0, HEIGHT_M), (3.0, 4.0, HEIGHT_M)]
RNG = np.random.default_rng(1)
ERRORS = tuple(DelayError(anchor.id, *(RNG.normal(0.0, 0.07, 2) / TICK_M)) for anchor in LAB.anchors)
DELAYS_M = {one.anchor: (one.tx_ticks + one.rx_ticks) / 2.0 * TICK_M for one in ERRORS}


def walked(site, seconds, seed, _):
    """All that a tag receives that is carried around; delays are off."""
    faults = replace(impairments_of(Request(site), site), delay_errors=ERRORS)
    world = World(site, partial(Anchor, site), [TagSpec(Waypoints(WAY, 1.0, loop=True, corner_s=0.5))], faults, seed)
    return tuple(
        Heard(broadcast.anchor, reception.frame, reception.rx_ticks, reception.host_s, truth_m)
        for broadcast in world.run(seconds)
        for _, reception, truth_m in broadcast.receptions()
    )


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    file = tmp_path_factory.mktemp("walk") / "walk.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live_site, "tape", walked)
        live_site.record(file, live_site.messages(25.0, ("a",), join_s=0.0))
    return file


def rms_m(survey):
    """Of the positions, after the best rigid alignment."""
    true_m = np.array([(anchor.x_m, anchor.y_m) for anchor in LAB.anchors])
    return aligned_rms_m([(anchor.x_m, anchor.y_m) for anchor in survey.anchors], true_m)


@pytest.mark.statistical
def test_a_walk_separates_delays_from_positions_where_the_anchors_are_on_two_lines(walk):
    """The lab's ranges alone cannot (SURVEY.md 2): its left side is as well wider, with other delays."""
    ranges = ranges_of(walk).ranger.ranges()
    with McapRecording(walk) as recording:
        epochs = walk_of(recording, LAB.id, "a", height_m=HEIGHT_M)
    facts = Facts(delay_std_m=0.15, pair_std_m=0.01)
    alone, joint = run_survey(ranges, facts), run_survey(ranges, replace(facts, tags=(epochs,)))
    assert any("the walk" in note for note in joint.notes)
    stds = [np.sqrt(np.mean([one.std_m**2 for one in survey.anchors])) for survey in (alone, joint)]
    assert stds[1] < 0.93 * stds[0]
    assert rms_m(joint) < rms_m(alone)
    assert rms_m(joint) < 3.0 * np.sqrt(2.0) * stds[1]


@pytest.mark.statistical
def test_a_part_of_the_walk(walk):
    with McapRecording(walk) as recording:
        epochs = walk_of(recording, LAB.id, "a", (5.0, 12.0))
    assert 6.0 <= epochs.t_s[-1] - epochs.t_s[0] <= 7.5
    assert np.isnan(epochs.known_m).all()


@pytest.mark.parametrize(("tag", "span", "words"), [("b", (0.0, 9.0), "tag"), ("a", (90.0, 99.0), "90:99")])
def test_what_the_recording_lacks(walk, tag, span, words):
    with McapRecording(walk) as recording, pytest.raises(SkylessError, match=words):
        walk_of(recording, LAB.id, tag, span)


def test_a_walk_whose_truth_is_known_shows_the_delays(walk):
    survey = skyless.calibrate(walk, recorded_truth=True).survey
    assert any("a at known positions" in note for note in survey.notes)
    for one in survey.anchors:
        assert abs(one.delay_m - DELAYS_M[one.id]) < 3.0 * one.delay_std_m
        assert one.delay_std_m < 0.04


def test_the_command_uses_the_walk(walk, capsys):
    assert main(["survey", "--recording", str(walk), "--walk", "a=0@2:20", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert any("of the walk of a were used" in note for note in report["notes"] + report.get("warnings", []))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--walk", "b"), "tag"),
        (("--walk", "a@9:4"), "later one last"),
        (("--walk", "a=x"), "--walk is 'a=x'"),
        (("--walk", "a@90:99"), "90:99"),
    ],
)
def test_what_the_command_does_not_take(walk, complaint, arguments, words):
    assert words in complaint("survey", "--recording", walk, *arguments)
