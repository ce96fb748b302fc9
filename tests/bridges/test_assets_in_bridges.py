"""Tags have their assets' names in other programs."""

import json

import msgspec

from skyless.bridges.home_assistant import document
from skyless.bridges.jsonl import JsonLines
from skyless.bridges.program import BridgeNode
from skyless.bridges.target import Hub, bridged_site
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.messages import Asset, AssetsMessage, site_message
from skyless.sim.lab import lab_site
from support.bridged_values import SITE, a_fix

FORKLIFT = Asset("tag1", "Forklift 1", "forklifts")
NAMED = msgspec.structs.replace(SITE, assets={"tag1": FORKLIFT})


def test_lines_have_name_and_group_where_they_are_known():
    lines = JsonLines()
    lines.on_site(NAMED)
    line = json.loads(lines.on_fix(a_fix(tag="tag1"))[0])
    assert list(line)[:3] == ["type", "name", "group"]
    assert (line["type"], line["name"], line["group"], line["tag"]) == ("fix", "Forklift 1", "forklifts", "tag1")
    assert json.loads(lines.on_no_fix("tag1", 1.0, "none")[0])["group"] == "forklifts"
    for other in (lines.on_fix(a_fix(tag="tag2")), lines.on_no_fix("tag2", 1.0, "none")):
        assert not {"name", "group"} & json.loads(other[0]).keys()
    lines.on_site(msgspec.structs.replace(SITE, assets={"tag1": Asset("tag1")}))
    assert not {"name", "group"} & json.loads(lines.on_fix(a_fix(tag="tag1"))[0]).keys()


def test_home_assistant_names_the_device_and_keeps_its_identity():
    plain, named = (json.loads(document(site, "tag1", "status", {})) for site in (SITE, NAMED))
    assert plain["device"]["name"] == "tag1"
    assert "serial_number" not in plain["device"]
    device = named["device"]
    assert (device["name"], device["serial_number"], device["model_id"]) == ("Forklift 1", "tag1", "forklifts")
    assert device["identifiers"] == plain["device"]["identifiers"]
    assert named["components"] == plain["components"]


def test_a_bridge_has_the_assets_of_its_own_site_only():
    lab = lab_site(100.0)
    node = BridgeNode(Hub([], print), MqttAddress("broker", 1), lab.id, print)
    receive = node.link._subscriptions.receive
    receive(topics.site_topic(lab.id), msgspec.json.encode(site_message(lab, simulated=True, unix_s=1.0)))
    receive(topics.assets_topic(lab.id), msgspec.json.encode(AssetsMessage((FORKLIFT,), "another")))
    assert node.hub.site == bridged_site(lab, simulated=True)
    receive(topics.assets_topic(lab.id), msgspec.json.encode(AssetsMessage((FORKLIFT,), lab.name)))
    assert node.hub.site.assets == {"tag1": FORKLIFT}
    receive(topics.assets_topic(lab.id), b'{"assets": [{"tag": ""}]}')
    assert node.state().malformed == 1
    assert node.hub.site.assets == {"tag1": FORKLIFT}
    receive(topics.assets_topic(lab.id), b"")
    assert node.hub.site.assets == {}
