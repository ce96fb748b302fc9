"""Where bridges get fixes from: a broker, and the tags of the same process."""

import asyncio
import contextlib
import json
import signal
from types import SimpleNamespace

import msgspec
import pytest
from msgspec import structs

from skyless.bridges import program
from skyless.bridges.program import BridgeNode, TagBridge, heard_site, run_route
from skyless.bridges.target import Hub, Route, Target
from skyless.core.air.almanac import GeoreferencePage
from skyless.core.air.frame import Reception
from skyless.core.any_receiver import AnyReceiver
from skyless.core.errors import SkylessError
from skyless.core.tag.receiver import HeardSite
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import SiteMessage, StatusMessage, Zone, ZonesMessage
from skyless.run.mqtt.topics import EVERY_NODE, fix_topic, health_topic, site_topic, status_topic, zones_topic
from support.bench import LAB, tape
from support.bridged_values import BERLIN, a_fix
from support.gpsd import connected
from support.mqtt_brokers import Embedded
from support.processes import SKYLESS, free_port, running_program
from support.site_messages import tag_health
from support.waiting import running, until

pytestmark = pytest.mark.site

ZONE = Zone("dock", "Dock", ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)))


class Recorded(Target):
    def __init__(self, refuses=False):
        super().__init__("test:")
        self.refuses = refuses
        self.sites, self.fixes, self.health, self.status, self.none = [], [], [], [], []

    def on_site(self, site):
        if self.refuses:
            raise SkylessError("test: needs more")
        self.sites.append(site)

    def on_fix(self, fix):
        self.fixes.append(fix)

    def on_no_fix(self, tag, unix_s, reason):
        self.none.append((tag, reason))

    def on_health(self, health):
        self.health.append(health)

    def on_status(self, status):
        self.status.append(status)

    async def run(self):
        await asyncio.Event().wait()


def bridge_to(target, said=print, rate_hz=50.0, *, simulated=False):
    """Tags of the same process, bridged to one target."""
    return TagBridge(Hub([Route(target, None, rate_hz)], said), lambda: simulated, said)


@contextlib.asynccontextmanager
async def brokered(folder):
    """A broker, and a link that plays the site's programs."""
    broker = Embedded(folder)
    await broker.start()
    programs = Link(broker.address, "tag1", site=LAB.id, kind="tag")
    try:
        async with running(programs.run()):
            await until(lambda: programs.connected)
            yield broker, programs
    finally:
        await broker.stop()


async def test_all_that_targets_need_comes_from_the_broker_and_nonsense_is_counted(tmp_path):
    target, said = Recorded(), []
    async with brokered(tmp_path) as (broker, programs):
        programs.publish(zones_topic(LAB.id), ZonesMessage((ZONE,)), retain=True)
        programs.publish(site_topic(LAB.id), SiteMessage(LAB, True, 0.0), retain=True)
        hub = Hub([Route(target, None, 50.0)], said.append)
        node = BridgeNode(hub, broker.address, LAB.id, said.append)
        async with running(node.run()):
            await until(lambda: target.sites and target.sites[-1].zones)
            programs.publish(fix_topic(LAB.id, "tag1"), b"{not json")
            programs.publish(fix_topic(LAB.id, "tag1"), b'{"tag":"tag1"}')
            programs.publish(site_topic(LAB.id), b"")
            programs.publish(status_topic(LAB.id, "tag", "tag9"), StatusMessage(True, "tag", "tag9"))
            programs.publish(health_topic(LAB.id, "tag", "tag1"), tag_health("tag1"))
            programs.publish(fix_topic(LAB.id, "tag1"), a_fix())
            await until(lambda: target.fixes and target.health and target.status)
            assert target.fixes == [a_fix()]
            assert target.sites[-1].name == LAB.name
            assert target.sites[-1].simulated
            assert "tag9" in {status.name for status in target.status}
            await until(lambda: target.none)
            state = node.state()
            assert (state.fixes, state.malformed, state.dropped) == (1, 2, {"test:": {}})


def test_no_fix_is_said_of_tags_that_should_have_one_and_not_of_tags_that_send_rarely(monkeypatch):
    said, clock = [], SimpleNamespace(now_s=100.0)
    monkeypatch.setattr(program, "time", SimpleNamespace(monotonic=lambda: clock.now_s, time=lambda: clock.now_s))
    node = BridgeNode(Hub([Route(Recorded(), None, 50.0)], said.append), MqttAddress("nowhere", 1), LAB.id, said.append)
    node.link.connected = True
    node.hub.table.set_connected(connected=True, now_s=clock.now_s)
    node.feed.receive(site_topic(LAB.id), msgspec.json.encode(SiteMessage(LAB, True, 0.0)))
    for second in range(600):
        clock.now_s += 1.0
        if second == 8:
            assert said == ["no fix for 5 s: no tag publishes fixes; skyless dashboard shows why"]
            said.clear()
        if second >= 8 and second % 10 == 8 and second < 500:
            node.feed.receive(fix_topic(LAB.id, "tag1"), msgspec.json.encode(a_fix(unix_s=clock.now_s)))
        node._on_tick()
        if second == 60:
            said.clear()  # its interval is known now
    assert said == ["no fix for 25 s: no tag publishes fixes; skyless dashboard shows why"]


async def test_a_site_that_lacks_what_the_only_target_needs_ends_the_bridge_with_the_reason(tmp_path):
    async with brokered(tmp_path) as (broker, programs):
        programs.publish(site_topic(LAB.id), SiteMessage(LAB, True, 0.0), retain=True)
        node = BridgeNode(Hub([Route(Recorded(refuses=True), None, 50.0)], print), broker.address, LAB.id, print)
        with pytest.raises(SkylessError, match="test: needs more"):
            await asyncio.wait_for(node.run(), 30)


@pytest.mark.statistical
async def test_the_command_serves_readers_until_ctrl_c_and_then_says_what_it_did(tmp_path):
    async with asyncio.timeout(120):
        port = free_port()
        async with contextlib.AsyncExitStack() as stack, brokered(tmp_path) as (broker, programs):
            programs.publish(site_topic(LAB.id), SiteMessage(LAB, True, 0.0), retain=True)
            command = ("bridge", f"jsonl+tcp://:{port}?tag=tag1", "--mqtt", str(broker.address), "--json")
            pipes = {"stdout": asyncio.subprocess.PIPE, "stderr": asyncio.subprocess.PIPE}
            process = await stack.enter_async_context(running_program(*SKYLESS, *command, **pipes))
            while b"bridging site" not in await asyncio.wait_for(process.stderr.readline(), 60):
                pass
            lines, connection = await connected(port)
            site = json.loads(await lines.readline())
            assert (site["type"], site["id"], site["name"]) == ("site", LAB.id, LAB.name)
            programs.publish(fix_topic(LAB.id, "tag2"), a_fix(tag="tag2"))
            programs.publish(fix_topic(LAB.id, "tag1"), a_fix())
            fix = json.loads(await lines.readline())
            assert (fix["type"], fix["tag"], fix["position_m"]) == ("fix", "tag1", [1.0, 2.0, 1.5])
            while True:
                line = json.loads(await lines.readline())
                if line["type"] == "no_fix" and line["tag"] == "tag1":
                    break
            connection.close()
            process.send_signal(signal.SIGINT)
            out, _ = await asyncio.wait_for(process.communicate(), 30)
            assert process.returncode == 0
            assert json.loads(out)["fixes"] == 2


@pytest.mark.parametrize("georeference", [None, BERLIN])
def test_a_tag_learns_its_site_from_the_air_with_the_georeference_where_one_is_sent(georeference):
    site = structs.replace(LAB, georeference=georeference)
    target = Recorded()
    bridge = bridge_to(target, simulated=True)
    receiver = AnyReceiver()
    for heard in tape(site, 2.0, 1, (3.0, 4.0, 0.0)):
        receiver.hear(Reception(heard.frame, heard.rx_ticks, heard.host_s))
    bridge.on_health(tag_health("tag1"), receiver)
    if georeference is None:
        assert target.sites == [], "the page may still come"
        bridge._sites["tag1"]._complete_s -= 10.0
        bridge.on_health(tag_health("tag1"), receiver)
    (learned,) = target.sites
    assert (learned.id, learned.simulated) == (site.id, True)
    assert learned.anchors_m == {one.id: (one.x_m, one.y_m, one.z_m) for one in site.anchors}
    if georeference is None:
        assert learned.georeference is None
    else:
        assert learned.georeference.latitude_deg == pytest.approx(BERLIN.latitude_deg, abs=6e-8)
        assert learned.georeference.heading_deg == pytest.approx(BERLIN.heading_deg, abs=1e-2)
    bridge.on_fix(a_fix())
    assert target.fixes == [a_fix()]


@pytest.mark.parametrize(("other", "anchors"), [({2: (9.0, 0.0, 2.0)}, [[1], [1, 2]]), ({1: (0.0, 0.0, 2.0)}, [[1]])])
def test_what_tags_know_of_a_site_is_joined_whether_they_know_other_anchors_or_missed_its_page(other, anchors):
    target, page = Recorded(), GeoreferencePage(50.0, 8.0, 100.0, 0.0)
    bridge = bridge_to(target)
    for _ in range(3):
        bridge.on_site(heard_site(5, {1: (0.0, 0.0, 2.0)}, page, simulated=False))
        bridge.on_site(heard_site(5, other, None, simulated=False))
    assert [sorted(site.anchors_m) for site in target.sites] == anchors
    assert {site.georeference.latitude_deg for site in target.sites} == {50.0}


def heard_by(site, latitude_deg=50.0):
    """What a tag's receiver knows of a site, which may be changed."""
    page = None if latitude_deg is None else GeoreferencePage(latitude_deg, 8.0, 100.0, 0.0)
    return SimpleNamespace(site=site, heard_site=HeardSite({1: (0.0, 0.0, 2.0)}, page, is_complete=page is not None))


def test_no_fix_of_another_site_than_the_one_that_targets_know_is_given():
    target = Recorded()
    bridge = bridge_to(target, rate_hz=1e3)
    walking, staying = heard_by(5), heard_by(5)
    bridge.on_health(tag_health("tag1"), walking)
    bridge.on_health(tag_health("tag2"), staying)
    walking.site = 6  # its positions are in another frame from now on
    bridge.on_fix(a_fix(tag="tag1"))
    assert target.fixes == []
    for _ in range(3):
        bridge.on_health(tag_health("tag1"), walking)
        bridge.on_health(tag_health("tag2"), staying)
    bridge.on_fix(a_fix(tag="tag1"))
    bridge.on_fix(a_fix(tag="tag2"))
    assert [fix.tag for fix in target.fixes] == ["tag2"]
    assert [site.id for site in target.sites] == [5], "there is a tag in it"
    staying.site = 6
    bridge.on_health(tag_health("tag2"), staying)
    bridge.on_fix(a_fix(tag="tag1", serial=2))
    assert [site.id for site in target.sites] == [5, 6]
    assert [fix.tag for fix in target.fixes] == ["tag2", "tag1"]


def test_after_a_change_of_site_the_page_about_the_earth_is_awaited_again():
    target = Recorded()
    bridge = bridge_to(target)
    receiver = heard_by(5)
    bridge.on_health(tag_health("tag1"), receiver)
    bridge._sites["tag1"]._complete_s -= 10.0
    receiver.site, receiver.heard_site = 6, heard_by(6, None).heard_site
    bridge.on_health(tag_health("tag1"), receiver)
    assert [site.id for site in target.sites] == [5]


def test_that_no_target_can_serve_a_growing_site_is_logged_once():
    said = []
    bridge = bridge_to(Recorded(refuses=True), said.append)
    for anchor in range(5):
        bridge.on_site(heard_site(5, {anchor: (1.0 * anchor, 0.0, 2.0)}, simulated=False))
    assert said == ["test: needs more"]


async def test_a_target_that_has_ended_gets_nothing_more():
    target, said = Recorded(), []
    route = Route(target, None, 1e3)
    hub = Hub([route], said.append)
    hub.on_site(heard_site(5, {1: (0.0, 0.0, 2.0)}, simulated=False))
    async with running(run_route(route, said.append)):
        await asyncio.sleep(0)
        hub.on_fix(a_fix(), 1.0)
    hub.on_fix(a_fix(serial=2), 2.0)
    hub.on_tick(9.0, 9.0)
    assert (len(target.fixes), target.none, said) == (1, [], [])


async def test_a_bridge_that_is_started_again_leaves_no_second_status_on_the_broker(tmp_path):
    async with brokered(tmp_path) as (broker, programs):
        statuses = {}
        programs.subscribe(status_topic(LAB.id, "bridge", EVERY_NODE), statuses.__setitem__)
        for _ in range(2):
            node = BridgeNode(Hub([Route(Recorded(), None, 1.0)], print), broker.address, LAB.id, print)
            async with running(node.run()):
                await until(lambda: any(b'"online":true' in status for status in statuses.values()))
            await until(lambda: all(b'"online":false' in status for status in statuses.values()))
        assert len(statuses) == 1
