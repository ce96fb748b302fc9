"""The tag's program on receptions of the simulated lab, and its link, which tells fixes to the site where it is."""

import asyncio
import bisect
from collections import Counter

import msgspec
import numpy as np
import pytest
from node_stage import LAB, PLACE_M, FakeLink, FakeRadio, receptions, receptions_of, undated

from skyless.core.air.frame import Reception
from skyless.radio.interface import Gone, Restarted
from skyless.run import anchor, process
from skyless.run import tag as tag_module
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.messages import Counters, FixMessage, SiteMessage, TagHealth
from skyless.run.tag import Tag, TagNode, TagSettings
from support.waiting import running, until

pytestmark = pytest.mark.site

HEARD = receptions(6.0)


class Bench:
    def __init__(self, **settings):
        self.published, self.said = [], []
        self.now_s = 0.0
        self.node = TagNode(
            TagSettings(**settings), FakeRadio("t1"), self.published.append, self.said.append, clock=lambda: self.now_s
        )
        self.node.fix_log.unix_less_host_s = 1e9

    def hear(self, heard):
        """Receptions that are processed as soon as they have ended."""
        for reception in heard:
            self.now_s = self.now_s if reception.host_s is None else reception.host_s
            self.node.on_event(reception)


def test_fixes_are_right_and_say_when_they_held():
    bench = Bench(publish_hz=1000.0)
    bench.hear(HEARD)
    late = [fix for fix in bench.published if fix.unix_s > 1e9 + 3.0]
    assert len(late) > 1000
    for fix in late:
        error_m = np.linalg.norm(np.subtract(fix.position_m, PLACE_M))
        assert error_m < 6.0 * fix.std_m < 0.5
    ends = {reception.host_s + 1e9 for reception in HEARD}
    assert {fix.unix_s for fix in late} <= ends
    assert bench.node.receptions == len(HEARD)
    serials = [fix.serial for fix in bench.published]
    assert serials == list(range(1, len(serials) + 1))
    assert bench.node.fix_log.serial == serials[-1]
    again = msgspec.json.decode(msgspec.json.encode(late[-1]), type=FixMessage)
    assert again == late[-1]


@pytest.mark.parametrize("publish_hz", [1.0, 7.0, 50.0, 133.0, 399.0])
def test_no_more_fixes_are_published_than_asked_for_on_average_nor_in_any_second(publish_hz):
    bench = Bench(publish_hz=publish_hz)
    bench.hear(HEARD)
    times = [fix.unix_s for fix in bench.published]
    for first, begin_s in enumerate(times):
        assert bisect.bisect_left(times, begin_s + 1.0) - first <= publish_hz + 1
    made_s = times[-1] - times[0]
    assert len(times) - 1 <= publish_hz * made_s + 1.0
    assert len(times) >= min(publish_hz, 395.0) * made_s * 0.95  # and not many fewer
    assert bench.node.fix_log.serial > 1500  # all of them are made


def test_a_tag_s_state_names_the_anchors_whose_phases_it_uses():
    found = []
    for heard in (HEARD, receptions(6.0, carrier=True)):
        bench = Bench()
        bench.hear(heard)
        numbers = dict.fromkeys(("receptions", "cpu", "memory_bytes", "late_in_link"), 0)
        counted = bench.node.fix_log.health(
            method="joint", reason=None, counters=Counter(), mqtt=Counters(0, 0, 0), **numbers
        )
        state = bench.node.complete(counted)
        found.append((state.carrier_phase_anchors, state.carrier_phase_hypotheses > 0))
    assert found == [((), False), (tuple(sorted(anchor.id for anchor in LAB.anchors)), True)]


def test_pauses_are_not_made_up_for_by_a_burst():
    heard = [reception for reception in HEARD if not 3.0 < reception.host_s < 4.0]
    bench = Bench(publish_hz=50.0)
    bench.hear(heard)
    times = [fix.unix_s - 1e9 for fix in bench.published]
    assert not any(3.0 < time_s < 4.0 for time_s in times)
    assert sum(4.0 <= time_s < 4.1 for time_s in times) <= 6


def test_a_radio_that_starts_again_gets_a_new_receiver_and_the_numbers_go_on():
    bench = Bench(publish_hz=1000.0)
    first = bench.node.receiver
    bench.node.on_event(Restarted())
    assert bench.node.receiver is first
    bench.hear(HEARD[:1000])
    fixes = bench.node.fix_log.serial
    assert fixes > 0
    bench.node.on_event(Gone("pulled out"))
    bench.node.on_event(Restarted())
    assert bench.node.receiver is not first
    jump = 2**39  # another counter
    shifted = [Reception(r.frame, (r.rx_ticks + jump) % 2**40, r.host_s, r.diagnostics) for r in HEARD[1000:]]
    bench.hear(shifted)
    assert bench.node.fix_log.serial > fixes + 500
    assert bench.published[-1].serial == bench.node.fix_log.serial
    assert bench.said == ["tag t1: listening", "tag t1: pulled out; still looking for it", "tag t1: listening again"]
    assert bench.node.receiver.counters["counter-jump"] == 0


def test_what_is_done_before_a_reception_sees_the_receiver_before_it():
    seen = []

    def before(receiver, reception):
        seen.append((receiver.counters["heard"], reception))

    node = TagNode(TagSettings(), FakeRadio("t1"), lambda fix: None, lambda line: None, before, lambda: 0.0)
    for reception in HEARD[:300]:
        node.on_event(reception)
    assert seen == list(enumerate(HEARD[:300]))


def test_latencies_and_phases_are_kept():
    bench = Bench()
    bench.hear(HEARD[:600])
    median_s, late_s, number = bench.node.fix_log.latencies.drain()
    assert number == bench.node.fix_log.serial
    assert median_s <= late_s
    assert 1 <= len(bench.node.phases.last) <= 6
    assert [phase.slot for phase in bench.node.phases.last] == sorted(phase.slot for phase in bench.node.phases.last)


def test_without_the_host_s_time_a_frame_counts_from_when_it_came():
    bench = Bench(publish_hz=1000.0)
    bench.hear(Reception(r.frame, r.rx_ticks) for r in HEARD[:600])
    assert bench.published
    assert all(fix.latency_s == 0.0 for fix in bench.published)


async def test_it_listens_until_it_is_cancelled():
    bench = Bench()
    async with running(bench.node.run()):
        for reception in HEARD[:50]:
            bench.now_s = reception.host_s
            bench.node.radio.listener(reception)
    assert bench.node.receptions == 50


# Links


def test_anchors_behind_a_port_that_leads_elsewhere_publish_again_whether_they_are_simulated(monkeypatch, links):
    answers = [False, True]
    monkeypatch.setattr(anchor, "link_of", FakeLink)
    radio = FakeRadio(str(LAB.master))
    radio.ready = False
    anchors = anchor.Anchors(LAB, [radio], None, print, simulated=lambda: answers.pop(0))
    (node,) = anchors.nodes
    node._wait = lambda seconds, then: None  # it has no loop

    class Leading:
        def clock(self, now_ticks):
            return None

    monkeypatch.setattr(anchor, "health_of", lambda *_: None)
    node._new_machine = Leading
    node._schedule = lambda: None
    node.check_reception = lambda now_s: None
    node.machine = Leading()
    anchors._publish_health()
    anchors._publish_health()
    node.on_event(Restarted())
    anchors._publish_health()
    anchors._publish_health()
    told = [message.simulated for _, message, _ in links[0].published if isinstance(message, SiteMessage)]
    assert told == [False, True]
    assert answers == []  # asked once for each start


async def settled():
    for _ in range(5):
        await asyncio.sleep(0)


async def test_the_link_comes_with_the_site_and_goes_with_it(monkeypatch, links):
    monkeypatch.setattr(tag_module, "Link", FakeLink)

    said = []
    tag = Tag(TagSettings(), FakeRadio("t1"), MqttAddress("127.0.0.1", 1883), said.append)
    async with running(tag.run()):
        await settled()
        tag.publish_health(0.1, 1)
        assert links == []  # nobody to tell it to
        for reception in undated(receptions_of(LAB.id, 2.0)):
            tag.node.on_event(reception)
        await settled()
        (first,) = links
        assert (first.name, first.site, first.kind, first.state) == ("t1", 1, "tag", "running")
        assert {topic for topic, _, _ in first.published} == {"skyless/v1/1/tag/t1/fix"}
        assert all(isinstance(message, FixMessage) for _, message, _ in first.published)
        for reception in undated(receptions_of(9, 2.0, later_s=10.0)):
            tag.node.on_event(reception)
        await settled()
        first, second = links
        assert (first.state, second.state, second.site) == ("left", "running", 9)
        assert {topic for topic, _, _ in second.published} == {"skyless/v1/9/tag/t1/fix"}
        tag.node.on_event(Restarted())  # a new receiver knows no site yet, but the link stays
        tag.publish_health(0.1, 1)
        await settled()
        assert len(links) == 2
        topic, health, _ = second.published[-1]
        assert topic == "skyless/v1/9/tag/t1/health"
        assert isinstance(health, TagHealth)
    assert second.state == "left"


async def test_without_a_broker_it_works_and_publishes_nothing(monkeypatch, links):
    monkeypatch.setattr(tag_module, "Link", FakeLink)

    tag = Tag(TagSettings(), FakeRadio("t1"), None, lambda line: None)
    for reception in undated(receptions_of(LAB.id, 2.0)):
        tag.node.on_event(reception)
    tag.publish_health(0.1, 1)
    tag.publish_receptions()
    assert tag.node.fix_log.serial > 100
    assert links == []


async def test_a_link_that_fails_is_reported_of_and_started_again(monkeypatch):
    monkeypatch.setattr(process, "HEALTH_S", 0.01)
    said = []

    class Faulty:
        address = "mqtt://nowhere"
        runs = 0

        async def run(self):
            self.runs += 1
            raise RuntimeError("a fault")

    link = Faulty()
    async with running(process.keep(link, said.append)):
        await until(lambda: link.runs >= 3)
    assert "a fault" in said[0]
