"""A site of processes that is surveyed while it runs: anchors adopt the result, tags get fixes, nothing is restarted.

What is judged is order and content, not speed: every wait is for something that has to come.
"""

import asyncio
import logging
import math

import msgspec
import numpy as np
import pytest
from site_programs import Program

from skyless.run.mqtt import messages, topics
from skyless.run.mqtt.link import Link
from skyless.site.file.load import load_site
from skyless.site.survey.facts import Facts, Gauge
from support.mqtt_brokers import MOSQUITTO, Mosquitto, stopped
from support.processes import free_port
from support.waiting import until

pytestmark = pytest.mark.live

_log = logging.getLogger(__name__)

SITE = 78
TRUE_M = {1: (0.0, 0.0), 2: (8.0, 0.0), 3: (9.0, 4.0), 4: (7.0, 8.0), 5: (-1.0, 7.0), 6: (-2.0, 3.0)}

PATIENCE_S = 120.0
"""For what has to come on a busy machine; processes start within seconds on an idle one."""


def site_text(positions, *, protocol, delays=None):
    """A site file; without a position an anchor has none."""
    lines = ['name = "fresh"', f"id = {SITE}", "[tags]", "height_m = 0.0", "[schedule]"]
    if protocol == 2:
        lines.append('mode = "free"')
    else:
        lines.append("slot_s = 0.0025")
        lines.insert(2, "master = 1")
    for anchor in TRUE_M:
        lines += ["[[anchors]]", f"id = {anchor}"]
        if positions is not None:
            lines += [f"x_m = {positions[anchor][0]!r}", f"y_m = {positions[anchor][1]!r}"]
        if delays is not None:
            lines.append(f"tx_antenna_delay_ticks = {delays[anchor]}")
    return "\n".join(lines) + "\n"


class Fresh:
    """Ether with the truth; anchors in two processes, a tag and the survey program with another file."""

    def __init__(self, folder, positions, protocol):
        self.file, truth = folder / "fresh.toml", folder / "truth.toml"
        self.file.write_text(site_text(positions, protocol=protocol), encoding="utf-8")
        truth.write_text(site_text(TRUE_M, protocol=protocol), encoding="utf-8")
        self.before = self.file.read_text(encoding="utf-8")
        self.broker = Mosquitto(folder)
        mqtt = ("--mqtt", str(self.broker.address))
        port = free_port()
        radio = ("--radio", f"ether:127.0.0.1:{port}")
        self.ether = Program("ether", "--site", truth, *mqtt, "--tags", 1, "--listen", f"127.0.0.1:{port}")
        self.anchors = [Program("anchor", *some, "--site", self.file, *radio, *mqtt) for some in ((1, 2, 3), (4, 5, 6))]
        self.tag = Program("tag", "tag1", *radio, *mqtt)
        self.survey = Program("survey", "--serve", *mqtt, "--site", self.file)
        self.link = Link(self.broker.address, "trial", site=SITE, kind="watch")
        self.newest, self.fixes, self.truths = {}, [], []
        for topic, kind in (
            (topics.survey_topic(SITE), messages.SurveyMessage),
            (topics.watch_topic(SITE), messages.WatchMessage),
            (topics.site_topic(SITE), messages.SiteMessage),
            (topics.status_topic(SITE, "survey", "survey"), messages.StatusMessage),
        ):
            self.link.subscribe(topic, self._keep(msgspec.json.Decoder(kind), kind))
        fixes, truths = msgspec.json.Decoder(messages.FixMessage), msgspec.json.Decoder(messages.TruthMessage)
        self.link.subscribe(topics.fix_topic(SITE, "+"), lambda _, payload: self.fixes.append(fixes.decode(payload)))
        self.link.subscribe(topics.truth_topic(SITE), lambda _, payload: self.truths.append(truths.decode(payload)))

    def _keep(self, decoder, kind):
        def keep(_topic, payload):
            self.newest[kind] = decoder.decode(payload) if payload else None

        return keep

    @property
    def programs(self):
        return [self.ether, *self.anchors, self.tag, self.survey]

    def survey_message(self):
        return self.newest.get(messages.SurveyMessage)

    async def errors_m(self, count):
        """Errors of that many fixes from now on, by the nearest truths."""
        begun = len(self.fixes)
        await until(lambda: len(self.fixes) >= begun + count + 20, PATIENCE_S)
        seen = [truth for truth in self.truths if "tag1" in truth.tags]
        at_s = np.array([truth.unix_s for truth in seen])
        way_m = np.array([truth.tags["tag1"].position_m for truth in seen])
        errors = []
        for fix in self.fixes[begun : begun + count]:
            true_m = [np.interp(fix.unix_s, at_s, way_m[:, axis]) for axis in range(2)]
            errors.append(math.dist(true_m, fix.position_m[:2]))
        return np.array(errors)


async def surveyed_live(fresh, facts):
    """Start everything, give facts, wait for a result of all anchors, and save it."""
    await fresh.broker.start()
    link = asyncio.ensure_future(fresh.link.run())
    await asyncio.gather(*(program.start() for program in fresh.programs))
    await asyncio.gather(*(program.heard("on the air") for program in fresh.anchors))
    await fresh.tag.heard("listening")
    await fresh.survey.heard("stamps come")
    fresh.link.publish(topics.survey_facts_topic(SITE), messages.SurveyFactsMessage(facts, by="trial"), qos=1)

    def is_ready():
        message = fresh.survey_message()
        found = None if message is None or message.facts != facts else message.survey
        whole = found is not None and all(anchor.determined for anchor in found.anchors)
        return whole and len(message.anchors) == len(TRUE_M) and message.duration_s > 4.0

    await until(is_ready, PATIENCE_S)
    message = fresh.survey_message()
    assert message.state == "surveyed"
    assert message.missing == ()
    assert len(message.pairs) == 15
    fresh.link.publish(topics.survey_save_topic(SITE), messages.SurveySaveMessage("trial", message.serial), qos=1)
    await until(lambda: fresh.survey_message().saved_serial == message.serial, PATIENCE_S)
    assert fresh.survey_message().error is None
    for program in fresh.anchors:
        await program.heard("of the survey adopted")
    return link, message.survey


async def ended(fresh, link):
    """End all programs as a person would; their exit codes."""
    pids = [program.process.returncode for program in fresh.programs]
    assert pids == [None] * len(pids), "a program ended by itself"
    codes = [await program.stop() for program in reversed(fresh.programs)]
    await asyncio.sleep(0.2)
    await stopped(link)
    return codes


async def run(folder, positions, protocol, facts, judge):
    fresh = Fresh(folder, positions, protocol)
    try:
        link, survey = await surveyed_live(fresh, facts)
        await judge(fresh, survey)
        assert await ended(fresh, link) == [0] * len(fresh.programs)
        assert fresh.newest[messages.SurveyMessage] is None  # what is retained was withdrawn
        assert fresh.newest[messages.StatusMessage].online is False
    except BaseException:
        for program in fresh.programs:
            _log.warning("%s: %s", program.arguments, program.said[-20:])
        raise
    finally:
        for program in fresh.programs:
            if program.process is not None and program.process.returncode is None:
                await program.kill()
        await fresh.broker.stop()


async def judge_saved(fresh, survey):
    """The file has the result, the anchors run with it, and the file before is kept."""
    site = load_site(fresh.file)
    assert not site.unplaced
    found = {anchor.id: anchor for anchor in survey.anchors}
    for anchor in site.anchors:
        assert math.dist((anchor.x_m, anchor.y_m), (found[anchor.id].x_m, found[anchor.id].y_m)) < 2e-4
    assert fresh.file.with_name("fresh.before-survey-1.toml").read_text(encoding="utf-8") == fresh.before
    assert fresh.file.with_name("fresh.survey.json").exists()
    await until(lambda: fresh.newest[messages.SiteMessage].site == site, PATIENCE_S)
    await until(lambda: fresh.newest.get(messages.WatchMessage) is not None, PATIENCE_S)
    assert fresh.newest[messages.WatchMessage].findings == ()


async def judge_fresh(fresh, survey):
    """Where the tag had no fix before it has right ones now."""
    await judge_saved(fresh, survey)
    for anchor in survey.anchors:
        assert math.dist((anchor.x_m, anchor.y_m), TRUE_M[anchor.id]) < 0.05
    errors_m = await fresh.errors_m(200)
    assert np.sqrt(np.mean(errors_m[50:] ** 2)) < 0.1


async def judge_sketched(fresh, survey):
    """Fixes come with the sketch, and are right with the survey."""
    await judge_saved(fresh, survey)
    errors_m = await fresh.errors_m(300)
    assert np.sqrt(np.mean(errors_m[100:] ** 2)) < 0.1


@pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")
def test_a_site_without_positions_is_surveyed_and_serves_tags(tmp_path):
    facts = Facts(heights_m=dict.fromkeys(TRUE_M, 0.0), delay_std_m=0.0, gauge=Gauge(1, 2, 4))
    asyncio.run(run(tmp_path, None, 2, facts, judge_fresh))


@pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")
def test_a_sketch_of_protocol_1_becomes_a_surveyed_site(tmp_path):
    off_m = np.random.default_rng(5).uniform(-0.3, 0.3, (len(TRUE_M), 2))
    sketch = {
        anchor: tuple((np.array(TRUE_M[anchor]) + one).tolist()) for anchor, one in zip(TRUE_M, off_m, strict=True)
    }
    known = {1: (*TRUE_M[1], None), 2: (*TRUE_M[2], None), 4: (*TRUE_M[4], None)}
    facts = Facts(
        heights_m=dict.fromkeys(TRUE_M, 0.0),
        points=known,
        sketch_m={anchor: (*point, 0.0) for anchor, point in sketch.items()},
        delay_std_m=0.0,
    )
    asyncio.run(run(tmp_path, sketch, 1, facts, judge_sketched))
