"""An anchor that was moved while ranges were gathered is named, and only ranges since then count; rest stays rest."""

import asyncio
import json
import math

import numpy as np
import pytest

from skyless.cli.main import main
from skyless.core.ticks import TICK_M, TICK_RATE_HZ
from skyless.research.calibration.biases import Gathered
from skyless.run.mqtt.address import MqttAddress
from skyless.run.survey.program import LiveSurvey, SurveyNode, SurveySettings
from skyless.sim.lab import lab_site
from skyless.site.survey.facts import Facts, Gauge, PairBlock
from skyless.site.survey.legs import AnchorLeg
from skyless.site.survey.pair_ranger import PairRanger, RangeSteps
from skyless.site.survey.solve import run_survey
from skyless.site.survey.watch import change_of, drop_moved

pytestmark = pytest.mark.site

LAB = {anchor.id: (anchor.x_m, anchor.y_m) for anchor in lab_site().anchors}
SMALL = {1: (0.0, 0.0), 2: (7.0, 0.0), 3: (6.0, 5.0), 4: (-1.0, 6.0)}
HALL = {1 + k: (12.0 * (k % 4) + 0.7 * (k % 3), 12.0 * (k // 4) - 0.5 * (k % 2)) for k in range(12)}
FACTS = Facts(heights_m={}, gauge=Gauge(1, 2))


def gathered(places, seconds, seed, *, drift_m=0.02, at=None, late_m=None):
    """Blocks of a second: noise of 4 mm and drift that each pair has for itself.

    ``at(anchor, t_s)``: where an anchor is; ``late_m(a, b, t_s)``: extra path.
    """
    draw = np.random.default_rng(seed)
    pairs = [(a, b) for a in places for b in places if a < b]
    kept = math.exp(-1.0 / 20.0)
    drift = drift_m * draw.standard_normal(len(pairs))
    delay_m = {anchor: draw.normal(0.0, 0.05) for anchor in places}
    steps = RangeSteps()
    for t_s in range(seconds):
        drift = kept * drift + math.sqrt(1.0 - kept**2) * drift_m * draw.standard_normal(len(pairs))
        for (a, b), wandered_m in zip(pairs, drift, strict=True):
            where = {one: places[one] if at is None else at(one, t_s) for one in (a, b)}
            range_m = math.dist(where[a], where[b]) + delay_m[a] + delay_m[b] + wandered_m + draw.normal(0.0, 0.004)
            range_m += 0.0 if late_m is None else late_m(a, b, t_s)
            steps.add(PairBlock(a, b, t_s + 0.5, range_m, 0.004, 60))
    steps.finish()
    return steps.table()


@pytest.mark.parametrize("places", [LAB, SMALL, HALL])
def test_surveys_at_rest_raise_no_alarm(places):
    for seed in range(5):
        for seconds in (10, 30, 60):
            for drift_m in (0.0, 0.02):
                table = gathered(places, seconds, seed, drift_m=drift_m)
                assert change_of(table, FACTS) is None, (seed, seconds, drift_m)


def test_people_who_walk_through_links_and_late_links_are_no_motion():
    def crossing(a, b, t_s):
        """Two links for some seconds each, another one that comes late from the middle on."""
        return (
            0.4 * ((a, b) == (1, 4) and 20 < t_s < 26)
            + 0.3 * ((a, b) == (2, 5) and 23 < t_s < 31)
            + 0.5 * ((a, b) == (3, 6) and t_s > 30)
        )

    for seed in range(6):
        assert change_of(gathered(LAB, 60, seed, late_m=crossing), FACTS) is None


@pytest.mark.parametrize("places", [LAB, HALL])
@pytest.mark.parametrize(("seconds", "moved_s"), [(30, 15), (30, 24), (60, 8), (250, 232)])
@pytest.mark.statistical
def test_a_moved_anchor_is_named_with_its_distance(places, seconds, moved_s):
    for seed in range(2):
        direction = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi)
        step_m = 0.4 * np.array([math.cos(direction), math.sin(direction)])

        def at(anchor, t_s, step_m=step_m):
            """Anchor 5 is carried for two seconds."""
            share = min(max((t_s - moved_s) / 2.0, 0.0), 1.0) if anchor == 5 else 0.0
            return tuple(np.array(places[anchor]) + share * step_m)

        change = change_of(gathered(places, seconds, seed, at=at), FACTS)
        assert change is not None
        assert "anchor 5" in change.sentence
        assert moved_s + 1.0 <= change.since_s <= moved_s + 9.0
        if "moved by about" in change.sentence:
            size_m = float(change.sentence.split("about ")[1].split(" cm")[0]) / 100.0
            assert size_m == pytest.approx(0.4, abs=0.15)


def legs(places, seconds, at):
    """Receptions between anchors with crystals of constant rates: sender, receiver, TX and RX ticks, time."""
    draw = np.random.default_rng(7)
    rate = {anchor: 1.0 + draw.uniform(-10e-6, 10e-6) for anchor in places}
    noise = 100e-12 * TICK_RATE_HZ
    order = list(places)
    for k in range(int(seconds / 5e-3)):
        sender, t_s = order[k % len(order)], 5e-3 * k
        tx_ticks = round(t_s * TICK_RATE_HZ * rate[sender])
        for receiver in order:
            if receiver != sender:
                path_ticks = math.dist(at(sender, t_s), at(receiver, t_s)) / TICK_M + draw.normal(0.0, 1.4 * noise)
                yield sender, receiver, tx_ticks, round((t_s * TICK_RATE_HZ + path_ticks) * rate[receiver]), t_s


def hung_elsewhere(anchor, t_s):
    """Anchor 4 of the lab hangs 0.29 m farther from 12 s on."""
    x_m, y_m = LAB[anchor]
    return (x_m + 0.2, y_m - 0.21) if anchor == 4 and t_s > 12.0 else (x_m, y_m)


def test_a_survey_is_that_of_the_time_since_the_motion():
    ranger = PairRanger()
    for leg in legs(LAB, 30.0, hung_elsewhere):
        ranger.add(*leg)
    ranger.finish()
    facts = Facts(heights_m=dict.fromkeys(LAB, 0.0), delay_std_m=0.0, gauge=Gauge(1, 2, 4))
    averaged = run_survey(ranger.ranges(), facts)
    (change,) = drop_moved(ranger, facts)
    assert "anchor 4 has moved by about" in change.sentence
    ranges = ranger.ranges()
    assert 9.0 < ranges.duration_s < 18.0
    now = {anchor: hung_elsewhere(anchor, 30.0) for anchor in LAB}
    assert _worst_m(averaged, now) > 0.05
    assert _worst_m(run_survey(ranges, facts), now) < 0.02


def test_a_live_survey_goes_on_with_the_time_since_the_motion():
    site = lab_site()
    live = LiveSurvey(site, Facts(heights_m=dict.fromkeys(LAB, 0.0)))
    for sender, receiver, tx_ticks, rx_ticks, t_s in legs(LAB, 30.0, hung_elsewhere):
        live._add(AnchorLeg(sender, receiver, tx_ticks, rx_ticks, t_s), t_s)
    live.ranger.finish()
    live.add_result(run_survey(live.ranges(), live.facts), live.ranges())
    change = change_of(live.ranger.steps.table(), live.facts)
    live.use_since(change)
    assert live.result(1) is None  # an average of before and since
    assert change_of(live.ranger.steps.table(), live.facts) is None
    live.add_result(run_survey(live.ranges(), live.facts), live.ranges())
    note = live.result(2)[0].notes[0]
    assert note.startswith("during the survey anchor 4 has moved by about")
    assert "s of ranges since then are used" in note


def test_the_program_and_the_command_use_the_time_since_the_motion(monkeypatch, capsys):
    ranger, site, lines = PairRanger(), lab_site(), []
    address = MqttAddress("127.0.0.1", 1)
    node = SurveyNode(SurveySettings(site.id, site), lambda _: Facts(), address, lines.append)
    live = node.live = LiveSurvey(site, Facts(heights_m=dict.fromkeys(LAB, 0.0)))
    for sender, receiver, tx_ticks, rx_ticks, t_s in legs(LAB, 30.0, hung_elsewhere):
        live._add(AnchorLeg(sender, receiver, tx_ticks, rx_ticks, t_s), t_s)
        ranger.add(sender, receiver, tx_ticks, rx_ticks, t_s)
    live.ranger.finish()
    asyncio.run(node._make_result(live))
    assert live.result(live.serial)[0].notes[0].startswith("during the survey anchor 4 has moved by about")
    assert any("anchor 4 has moved by about" in line for line in lines)

    ranger.finish()
    monkeypatch.setattr("skyless.cli.survey._gather_live", lambda *_: Gathered(ranger, site))
    assert main(["survey", "--mqtt", "mqtt://127.0.0.1", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["notes"][0].startswith("during the survey anchor 4 has moved by about")


def _worst_m(survey, places):
    """The largest distance error between two anchors."""
    at = {one.id: (one.x_m, one.y_m) for one in survey.anchors}
    return max(abs(math.dist(at[a], at[b]) - math.dist(places[a], places[b])) for a in places for b in places if a < b)
