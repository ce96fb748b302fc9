"""Tags and their links: a tag tells its fixes to the site where it is."""

import asyncio

import pytest
from node_stage import LAB, FakeRadio, receptions_of, undated

from skyless.mqtt.address import MqttAddress
from skyless.mqtt.messages import Counters, FixMessage, SiteMessage, TagHealth
from skyless.nodes import anchor, process
from skyless.nodes import tag as tag_module
from skyless.nodes.tag import Tag, TagSettings
from skyless.radios.interface import Restarted


class FakeLink:
    made = None
    counters = Counters(0, 0, 0)

    late = 0

    def __init__(self, address, name, *, site, kind, **_):
        self.name, self.site, self.kind = name, site, kind
        self.published, self.state = [], "made"
        FakeLink.made.append(self)

    def subscribe(self, topic, handler, qos=0):
        pass

    def publish(self, topic, message, **_):
        self.published.append((topic, message))

    async def run(self):
        self.state = "running"
        try:
            await asyncio.Event().wait()
        finally:
            self.state = "left"


def test_anchors_behind_a_port_that_leads_elsewhere_publish_again_whether_they_are_simulated(monkeypatch):
    told, answers = [], [False, True]

    class SiteLink(FakeLink):
        def publish(self, topic, message, **_):
            if isinstance(message, SiteMessage):
                told.append(message.simulated)

    FakeLink.made = []
    monkeypatch.setattr(anchor, "link_of", SiteLink)
    radio = FakeRadio(str(LAB.master))
    radio.ready = False
    anchors = anchor.Anchors(LAB, [radio], None, print, simulated=lambda: answers.pop(0))
    (node,) = anchors.nodes
    node._wait = lambda seconds, then: None  # it has no loop

    class Leading:
        is_master = True

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
    assert told == [False, True]
    assert answers == []  # asked once for each start


@pytest.fixture
def links(monkeypatch):
    monkeypatch.setattr(tag_module, "Link", FakeLink)
    FakeLink.made = []
    return FakeLink.made


async def settled():
    for _ in range(5):
        await asyncio.sleep(0)


def test_the_link_comes_with_the_site_and_goes_with_it(links):
    async def main():
        said = []
        tag = Tag(TagSettings(), FakeRadio("t1"), MqttAddress("127.0.0.1", 1883), said.append)
        running = asyncio.ensure_future(tag.run())
        await settled()
        tag.publish_health(0.1, 1)
        assert links == []  # nobody to tell it to
        for reception in undated(receptions_of(LAB.id, 2.0)):
            tag.node.on_event(reception)
        await settled()
        (first,) = links
        assert (first.name, first.site, first.kind, first.state) == ("t1", 1, "tag", "running")
        assert {topic for topic, _ in first.published} == {"skyless/v1/1/tag/t1/fix"}
        assert all(isinstance(message, FixMessage) for _, message in first.published)
        for reception in undated(receptions_of(9, 2.0, later_s=10.0)):
            tag.node.on_event(reception)
        await settled()
        first, second = links
        assert (first.state, second.state, second.site) == ("left", "running", 9)
        assert {topic for topic, _ in second.published} == {"skyless/v1/9/tag/t1/fix"}
        tag.node.on_event(Restarted())  # a new receiver knows no site yet, but the link stays
        tag.publish_health(0.1, 1)
        await settled()
        assert len(links) == 2
        topic, health = second.published[-1]
        assert topic == "skyless/v1/9/tag/t1/health"
        assert isinstance(health, TagHealth)
        running.cancel()
        await asyncio.wait([running])
        assert second.state == "left"

    asyncio.run(main())


def test_without_a_broker_it_works_and_publishes_nothing(links):
    async def main():
        tag = Tag(TagSettings(), FakeRadio("t1"), None, lambda line: None)
        for reception in undated(receptions_of(LAB.id, 2.0)):
            tag.node.on_event(reception)
        tag.publish_health(0.1, 1)
        tag.publish_receptions()
        assert tag.node.fix_log.serial > 100
        assert links == []

    asyncio.run(main())


def test_a_link_that_fails_is_reported_of_and_started_again(monkeypatch):
    monkeypatch.setattr(process, "HEALTH_S", 0.01)
    said = []

    class Faulty:
        address = "mqtt://nowhere"
        runs = 0

        async def run(self):
            self.runs += 1
            raise RuntimeError("a fault")

    async def main():
        link = Faulty()
        task = asyncio.ensure_future(process.keep(link, said.append))
        while link.runs < 3:
            await asyncio.sleep(0.005)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(main())
    assert "a fault" in said[0]
