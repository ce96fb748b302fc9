"""The demo's programs: what is on MQTT of them when the demo ends."""

import asyncio

import pytest

from skyless.cli import demo
from skyless.cli.demo import SiteRun, WholeSite
from skyless.core.errors import SkylessError
from skyless.core.integrity import IntegrityRequirement
from skyless.core.kernels.processes import Preparation
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.topics import preparation_topic
from skyless.sim.lab import lab_site

ADDRESS = MqttAddress("127.0.0.1", 1)


class Lasting:
    """A program, or a link that notes what is published while it runs."""

    def __init__(self, *_arguments, **_options):
        self.sent, self.running = [], False

    def subscribe(self, topic, handler, qos=0):
        pass

    def publish(self, topic, message, *, qos=0, retain=False):
        if self.running:
            self.sent.append((topic, message, retain))

    async def run(self):
        self.running = True
        try:
            await asyncio.Event().wait()
        finally:
            self.running = False


@pytest.fixture
def link(monkeypatch):
    link = Lasting()
    monkeypatch.setattr(demo, "Link", lambda *_arguments, **_options: link)
    monkeypatch.setattr(demo, "Child", Lasting)
    return link


def test_a_compilation_that_is_cut_off_is_no_longer_shown(link, tmp_path, monkeypatch):
    async def compile_for_ever(_parts, report):
        report(Preparation(37, 120, 25.0))
        await asyncio.Event().wait()

    async def run():
        asked = SiteRun(
            lab_site(), "lab", 1, 1.0, None, 1, "joint", IntegrityRequirement(), ADDRESS, None, 1.0, False, tmp_path
        )
        running = asyncio.ensure_future(WholeSite(asked, print).run())
        while not link.sent:
            await asyncio.sleep(0.01)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    monkeypatch.setattr(demo, "compile_parts", compile_for_ever)
    asyncio.run(run())
    topic = preparation_topic(lab_site().id)
    assert [(of, retain) for of, _, retain in link.sent] == [(topic, True), (topic, True)]
    assert link.sent[0][1].done == 37
    assert link.sent[1][1] == b""


def test_the_demo_s_own_broker_keeps_nothing_after_its_end(link, tmp_path, monkeypatch):
    settings = []

    async def start(asked):
        settings.append(asked)
        raise SkylessError("enough is known")

    monkeypatch.setattr(demo, "start_broker", start)
    asked = SiteRun(
        lab_site(), "lab", 1, 1.0, None, 1, "joint", IntegrityRequirement(), None, None, 1.0, False, tmp_path
    )
    with pytest.raises(SkylessError, match="enough"):
        asyncio.run(WholeSite(asked, print).run())
    assert [asked.temporary for asked in settings] == [True]
