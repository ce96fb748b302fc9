"""The demo's programs: what is on MQTT of them when the demo ends."""

import asyncio

import pytest

from skyless.cli.nodes import demo
from skyless.cli.nodes.demo import DemoOptions, WholeSite
from skyless.core.errors import SkylessError
from skyless.run.mqtt.address import MqttAddress

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


@pytest.mark.site
def test_the_demo_s_own_broker_keeps_nothing_after_its_end(link, monkeypatch):
    settings = []

    async def start(asked):
        settings.append(asked)
        raise SkylessError("enough is known")

    monkeypatch.setattr(demo, "start_broker", start)
    with pytest.raises(SkylessError, match="enough"):
        asyncio.run(WholeSite(DemoOptions(record="none"), print).run())
    assert [asked.temporary for asked in settings] == [True]


@pytest.mark.site
@pytest.mark.parametrize("carrier", [False, True])
def test_the_ether_simulates_carriers_where_the_demo_is_asked_to(carrier):
    ether = WholeSite(DemoOptions(record="none", carrier=carrier), print)._programs(ADDRESS)[0]
    assert ("--carrier" in ether.arguments) == carrier


@pytest.mark.site
def test_tags_that_are_boards_have_an_emulated_board_and_a_program_that_publishes():
    whole = WholeSite(DemoOptions(record="none", tags=3, boards=2), print)
    programs = {program.name: program.arguments for program in whole._programs(ADDRESS)}
    assert list(whole.boards) == ["tag2", "tag3"]
    assert programs["tag tag1"][:3] == ("tag", "tag1", "--radio")
    for name, port in whole.boards.items():
        assert programs[f"board {name}"][-2:] == ("--link", str(port))
        assert programs[f"tag {name}"][:5] == ("tag", name, "--radio", f"serial:{port}", "--from-board")


@pytest.mark.parametrize("asked", [DemoOptions(tags=2, boards=3), DemoOptions(paper=True, boards=1)])
def test_boards_that_cannot_be_are_refused(asked):
    with pytest.raises(SkylessError, match=r"--boards is \d; it should be"):
        WholeSite(asked, print)
