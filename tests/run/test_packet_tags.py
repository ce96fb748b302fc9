"""Tags on sniffers: packets of a simulated TDoA3 system in, fixes and health out."""

import msgspec
import numpy as np
import pytest
from node_stage import FakeLink

from skyless.core.air.masterless_packets import Packet
from skyless.radio.foreign.bitcraze import decode_payload
from skyless.radio.interface import Gone, Restarted
from skyless.run.masterless import packet_tags
from skyless.run.masterless.packet_tags import PacketTagNode, PacketTags, PacketTagSettings
from skyless.run.mqtt.messages import FixMessage, SiteMessage, TagHealth
from skyless.run.open_radio import is_simulated, open_sniffers
from support import masterless_world as hall

pytestmark = pytest.mark.site

SETTINGS = PacketTagSettings(hall.ANCHORS_M, site=7, publish_hz=1e5)


@pytest.fixture(scope="module")
def packets():
    """Five seconds of a tag at rest; the host's clock begins at 100 s."""
    frames = hall.tdoa3_capture(hall.MasterlessWorld(3), 5.0)
    return [decode_payload(payload, 100.0 + t_s, sender, rx_ticks) for t_s, sender, rx_ticks, payload in frames]


def test_packets_become_fixes_and_a_sniffer_that_comes_back_begins_again(packets):
    published, said = [], []
    (radio,) = open_sniffers("sniffer:/dev/nothing", ("drone",))
    now_s = 100.0
    node = PacketTagNode(SETTINGS, radio, published.append, said.append, lambda: now_s)
    node.fix_log.unix_less_host_s = 0.0
    node.on_event(Restarted())
    first = node.tracking
    for packet in packets:
        now_s = packet.host_s
        node.on_event(packet)
    late = [fix for fix in published if fix.unix_s > 102.0]
    assert len(late) > 400
    errors_m = np.linalg.norm([np.subtract(fix.position_m, hall.path_m(0.0, 0.0)) for fix in late], axis=1)
    assert np.sqrt(np.mean(errors_m**2)) < 0.15  # some cm of noise, in three dimensions
    assert {fix.unix_s for fix in late} <= {packet.host_s for packet in packets}
    assert [fix.serial for fix in published] == list(range(1, len(published) + 1))
    assert late[-1].method == "joint"
    fixes, drops = node.fix_log.serial, node.drops
    node.on_event(Gone("pulled out"))
    node.on_event(Restarted())
    assert node.tracking is not first
    assert node.drops == drops
    for packet in packets:
        now_s = packet.host_s
        node.on_event(msgspec.structs.replace(packet, rx_ticks=(packet.rx_ticks + 2**39) % 2**40))
    assert node.fix_log.serial > fixes + 400
    assert said == ["tag drone: listening", "tag drone: pulled out; still looking for it", "tag drone: listening again"]


def test_fixes_and_health_go_out_under_the_site_that_was_given(packets, monkeypatch, links):
    monkeypatch.setattr(packet_tags, "link_of", FakeLink)
    tags = PacketTags(
        SETTINGS, open_sniffers("sniffer:/dev/a,/dev/b", ("one", "two")), None, print, simulated=lambda: False
    )
    one, _ = tags.nodes
    one.radio.counters["malformed-line"] += 3
    one.on_event(Packet(None, 77, 0, 0, 0, ()))
    for packet in packets:
        one.on_event(msgspec.structs.replace(packet, host_s=None))
    tags._publish_health()
    assert [(link.name, link.site, link.kind) for link in links] == [("one", 7, "tag"), ("two", 7, "tag")]
    (fix_topic, fix, _), *_, (site_topic, site_message, retained), (health_topic, health, _) = links[0].published
    assert retained["retain"]
    assert (site_topic, site_message.site.id, site_message.simulated) == ("skyless/v1/7/site", 7, False)
    assert site_message.system == "tdoa"
    assert {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site_message.site.anchors} == hall.ANCHORS_M
    assert (fix_topic, health_topic) == ("skyless/v1/7/tag/one/fix", "skyless/v1/7/tag/one/health")
    assert isinstance(fix, FixMessage)
    again = msgspec.json.decode(msgspec.json.encode(health), type=TagHealth)
    assert (again.receptions, again.fixes, again.updates_per_s) == (
        len(packets) + 1,
        one.fix_log.serial,
        one.fix_log.serial,
    )
    assert again.reason is None
    assert again.counters["malformed-line"] == 3
    assert again.counters["unknown-anchor"] == 1
    ((topic, silent, _),) = links[1].published  # the site is published once
    assert (topic, silent.reason, silent.fixes) == ("skyless/v1/7/tag/two/health", "no-beacons", 0)


def test_a_sniffer_that_turns_out_to_be_emulated_when_it_comes_is_reported_as_such(monkeypatch, tmp_path, links):
    path = tmp_path / "sniffer"
    monkeypatch.setattr(packet_tags, "link_of", FakeLink)
    spec = f"sniffer:{path}"
    tags = PacketTags(SETTINGS, open_sniffers(spec, ("one",)), None, print, simulated=lambda: is_simulated(spec))
    tags._publish_health()  # nothing is plugged in yet
    path.symlink_to("/dev/pts/7")
    tags.nodes[0].on_event(Restarted())
    for _ in range(3):
        tags._publish_health()
    path.unlink()
    path.symlink_to("/dev/ttyACM0")
    tags.nodes[0].on_event(Gone("pulled out"))
    tags.nodes[0].on_event(Restarted())
    tags._publish_health()
    sites = [message for _, message, _ in links[0].published if isinstance(message, SiteMessage)]
    assert [site.simulated for site in sites] == [False, True, False]


def test_a_phone_s_anchors_are_published_as_those_of_fira(monkeypatch, links):
    monkeypatch.setattr(packet_tags, "link_of", FakeLink)
    radios = open_sniffers("phone://127.0.0.1", ("one",), hall.ANCHORS_M)
    PacketTags(SETTINGS, radios, None, print, simulated=lambda: False)._publish_health()
    (site_message,) = [message for _, message, _ in links[0].published if isinstance(message, SiteMessage)]
    assert site_message.system == "dl-tdoa"


def test_a_table_that_no_site_can_have_is_not_reported():
    assert packet_tags.site_of(PacketTagSettings({1: (0.0, 0.0, 0.0), 99_999: (1.0, 2.0, 0.0)})) is None
