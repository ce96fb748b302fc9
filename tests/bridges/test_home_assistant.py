"""What Home Assistant is sent: each tag announced once, rooms by the polygons, nothing old, nothing too often."""

import json
import os
import random

import msgspec
import pytest
from msgspec.structs import replace

from skyless.bridges.home_assistant import MAX_ANNOUNCED, SETTLE_S, Announcer, document, make_target, platforms
from skyless.bridges.target import BridgeContext, TargetUrl
from skyless.core.earth import geodetic
from skyless.core.errors import SkylessError
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.messages import TagPosition, TagZones, Zone
from skyless.run.site_table import THRESHOLDS
from support.bridged_values import BARE_SITE, SITE, a_fix

WEST = Zone("z1", "West", ((0.0, 0.0), (3.0, 0.0), (3.0, 8.0), (0.0, 8.0)))
EAST = Zone("z2", "East", ((3.0, 0.0), (6.0, 0.0), (6.0, 8.0), (3.0, 8.0)))
DESK = Zone("desk", "", ((1.0, 1.0), (2.0, 1.0), (2.0, 2.0), (1.0, 2.0)))
HALL = replace(SITE, zones=(WEST, EAST))
CONFIG, ZONE, POSITION = (
    "homeassistant/device/skyless_7_tag1/config",
    "skyless/v1/7/tag/tag1/zone",
    "skyless/v1/7/tag/tag1/position",
)
CONTEXT = BridgeContext(lambda _line: None, MqttAddress("hall.example", 1883))
COVARIANCE = (0.0004, 0.0, 0.0, 0.0, 0.0004, 0.0, 0.0, 0.0, 0.0004)


class Broker:
    """In the place of a link: keeps what is retained, and echoes it as a broker does."""

    def __init__(self):
        self.sent, self.kept, self.handlers, self.forgotten, self.others = [], {}, {}, [], []

    def next_link(self):
        """Another link to the same broker."""
        other = Broker()
        other.sent, other.kept, other.others = self.sent, self.kept, self.others
        self.others.append(other)
        return other

    def publish(self, topic, message, *, qos=0, retain=False):
        assert (qos, retain) == (1, True)
        payload = message if isinstance(message, bytes) else msgspec.json.encode(message)
        self.sent.append(topic)
        self.kept[topic] = payload
        assert len(self.sent) < 1000, "without end"
        for link in self.others or [self]:
            link.deliver(topic, payload)

    def subscribe(self, topic_filter, handler, qos=0):
        self.handlers[topic_filter] = handler
        if topic_filter in self.kept:
            handler(topic_filter, self.kept[topic_filter])

    def deliver(self, topic, payload):
        for name, handler in tuple(self.handlers.items()):
            if name == topic or (name.endswith("tag/+/zone") and topic.endswith("/zone")):
                handler(topic, payload)

    def forget(self, topic):
        self.forgotten.append(topic)

    def value(self, topic, kind):
        return msgspec.json.decode(self.kept[topic], type=kind)

    def components(self, topic=CONFIG):
        return json.loads(self.kept[topic])["components"]


@pytest.fixture
def broker():
    return Broker()


def announcer_of(broker, site=HALL, name="pi-tag1"):
    return Announcer(broker, site, name, "homeassistant", 0.25)


def at(x, y=2.0, unix_s=100.0, **more):
    return a_fix(position_m=(x, y, 1.0), unix_s=unix_s, covariance_m2=COVARIANCE, **more)


def test_a_tag_is_announced_with_all_that_it_has(broker):
    announcer_of(broker).on_fix(at(1.0))
    whole = json.loads(broker.kept[CONFIG])
    components = whole["components"]
    assert {key: part["platform"] for key, part in components.items()} == {
        "room": "sensor",
        "accuracy": "sensor",
        "position": "device_tracker",
        "zone_z1": "binary_sensor",
        "zone_z2": "binary_sensor",
    }
    assert {part["unique_id"] for part in components.values()} == {f"skyless_7_tag1_{key}" for key in components}
    assert [part["topic"] for part in whole["availability"]] == ["skyless/v1/7/homeassistant/pi-tag1/status", ZONE]
    assert whole["availability_mode"] == "all"
    assert components["room"]["state_topic"] == ZONE
    assert broker.value(ZONE, TagZones).name == "West"
    position = broker.value(POSITION, TagPosition)
    earth = (position.latitude_deg, position.longitude_deg, position.height_m)
    assert earth == pytest.approx(geodetic((1.0, 2.0, 1.0), SITE.georeference), abs=1e-3)
    assert (position.std_m, position.horizontal_std_m) == (0.035, 0.028)


def test_a_site_that_is_nowhere_has_rooms_and_no_tracker(broker):
    announcer_of(broker, replace(BARE_SITE, zones=(WEST,))).on_fix(at(1.0))
    assert set(broker.components()) == {"room", "accuracy", "zone_z1"}
    assert broker.value(POSITION, TagPosition).latitude_deg is None


def test_without_zones_there_is_no_room(broker):
    announcer = announcer_of(broker, SITE)
    announcer.on_fix(at(1.0))
    assert set(broker.components()) == {"accuracy", "position"}
    announcer.on_site(HALL)
    assert set(broker.components()) == {"accuracy", "position", "room", "zone_z1", "zone_z2"}


def test_tags_are_announced_only_when_the_zones_had_time_to_come():
    target = make_target(TargetUrl("homeassistant:"), CONTEXT)
    target.on_site(HALL)
    for second in range(SETTLE_S):
        target.on_fix(at(1.0))
        assert not target._begun.is_set()
        target.on_second(float(second))
    target.on_fix(at(1.0))
    assert target._begun.is_set()


def test_the_room_follows_the_polygons_and_noise_at_an_edge_changes_nothing(broker):
    announcer = announcer_of(broker)
    for k, x in enumerate((1.0, 2.0, 2.98, 3.02, 2.98, 3.02, 4.0)):
        announcer.on_fix(at(x, unix_s=100.0 + 0.1 * k))
    assert broker.sent.count(ZONE) == 2
    zones = broker.value(ZONE, TagZones)
    assert (zones.zone, zones.name, zones.zones, zones.unix_s) == ("z2", "East", ("z2",), 100.6)
    announcer.on_fix(at(9.0, unix_s=101.0))
    assert (broker.value(ZONE, TagZones).zone, broker.value(ZONE, TagZones).usable) == (None, True)


def test_of_zones_within_each_other_the_smallest_is_the_room(broker):
    announcer_of(broker, replace(HALL, zones=(WEST, DESK))).on_fix(at(1.5, 1.5))
    zones = broker.value(ZONE, TagZones)
    assert (zones.zone, zones.name, zones.zones) == ("desk", "desk", ("desk", "z1"))


def test_without_a_fix_a_tag_is_unavailable_until_the_next(broker):
    announcer = announcer_of(broker)
    announcer.on_fix(at(1.0))
    for second in range(3):
        announcer.on_gone("tag1", 101.0 + second)
        announcer.on_second(101.0 + second)
    assert broker.value(ZONE, TagZones) == TagZones("tag1", 101.0, usable=False, by="pi-tag1")
    assert (broker.sent.count(ZONE), broker.sent.count(POSITION)) == (2, 1)
    announcer.on_fix(at(4.0, unix_s=110.0))
    assert broker.value(ZONE, TagZones).name == "East"
    assert broker.value(POSITION, TagPosition).unix_s == 110.0


def test_a_recorder_gets_little_of_a_tag_that_stands(broker):
    announcer = announcer_of(broker)
    for k in range(100):
        announcer.on_fix(at(1.0 + 0.02 * (k % 3), unix_s=100.0 + 0.1 * k))
        if k % 10 == 9:
            announcer.on_second(100.0 + 0.1 * k)
    assert broker.sent.count(POSITION) == broker.sent.count(ZONE) == broker.sent.count(CONFIG) == 1
    announcer.on_fix(at(1.5, unix_s=111.0))
    announcer.on_second(111.0)
    announcer.on_second(112.0)
    assert broker.sent.count(POSITION) == 2
    announcer.on_fix(replace(at(1.5, unix_s=113.0), covariance_m2=tuple(2 * value for value in COVARIANCE)))
    announcer.on_second(113.0)
    assert broker.value(POSITION, TagPosition).std_m == 0.049


def test_ids_do_not_change_with_names_and_removed_zones_are_removed(broker):
    announcer = announcer_of(broker)
    announcer.on_fix(at(1.0))
    before = broker.components()
    announcer.on_site(replace(HALL, zones=(replace(WEST, name="Library"),)))
    now = broker.components()
    assert now["zone_z1"] == before["zone_z1"] | {"name": "In Library"}
    assert now["zone_z2"] == {"platform": "binary_sensor"}, "this is how a component is removed"
    announcer.on_site(HALL)
    assert broker.components() == before


def test_a_bridge_that_is_started_again_removes_what_was_deleted_meanwhile(broker):
    announcer_of(broker).on_fix(at(1.0))
    later = Broker()
    later.kept = dict(broker.kept)
    announcer = announcer_of(later, replace(HALL, zones=(WEST,)))
    announcer.on_fix(at(1.0))
    assert later.components()["zone_z2"] == {"platform": "binary_sensor"}
    count = later.sent.count(CONFIG)
    later.deliver(CONFIG, later.kept[CONFIG])
    assert later.sent.count(CONFIG) == count


def test_two_bridges_that_know_different_zones_do_not_answer_each_other_without_end(broker):
    for name, zone in (("pi-tag1", WEST), ("nas-tag1", EAST)):
        announcer_of(broker.next_link(), replace(HALL, zones=(zone,)), name).on_fix(at(1.0))
    assert broker.sent.count(CONFIG) < 6


@pytest.mark.site
def test_the_link_keeps_all_that_is_sent_of_as_many_tags_as_there_may_be():
    zones = tuple(replace(WEST, id=f"z{k:063d}", name=f"{k:0100d}") for k in range(100))
    target = make_target(TargetUrl("homeassistant:"), CONTEXT)
    target.on_site(replace(HALL, zones=zones))
    for second in range(SETTLE_S):
        target.on_second(float(second))
    for number in range(MAX_ANNOUNCED + 1):
        target.on_fix(at(1e5, tag=f"tag{number}"))
    assert target._link.counters.dropped == 0
    assert target._link.unacknowledged == 3 * MAX_ANNOUNCED
    assert target.dropped == {"too-many-tags": 1}


def test_a_bridge_that_comes_to_another_site_leaves_nothing_available(broker):
    target = make_target(TargetUrl("homeassistant:"), CONTEXT)
    target.on_site(HALL)
    target._announcer = announcer_of(broker)
    target.on_fix(at(1.0))
    with pytest.raises(SkylessError, match="serves site 7, not site 8"):
        target.on_site(replace(HALL, id=8))
    assert not broker.value(ZONE, TagZones).usable
    target.on_site(HALL)
    target.on_fix(at(4.0))
    assert broker.value(ZONE, TagZones).name == "East"


def test_what_was_so_before_a_restart_does_not_stay_where_the_tag_has_gone(broker):
    announcer_of(broker).on_fix(at(1.0))
    later = announcer_of(broker)
    broker.deliver(ZONE, broker.kept[ZONE])
    broker.deliver("skyless/v1/7/tag/tag9/zone", msgspec.json.encode(TagZones("tag9", 1.0, usable=True, by="another")))
    for second in range(round(THRESHOLDS.longest_s) + 1):
        assert broker.value(ZONE, TagZones).usable
        later.on_second(200.0 + second)
    assert not broker.value(ZONE, TagZones).usable
    assert "skyless/v1/7/tag/tag9/zone" not in broker.sent


def test_when_home_assistant_starts_it_gets_everything_again_without_a_new_fix(broker):
    announcer_of(broker).on_fix(at(1.0))
    before = dict(broker.kept)
    broker.sent.clear()
    broker.deliver("homeassistant/status", b"offline")
    assert broker.sent == []
    broker.deliver("homeassistant/status", b"online")
    assert sorted(broker.sent) == sorted([CONFIG, ZONE, POSITION])
    assert broker.kept == before


def test_a_tag_whose_document_is_emptied_is_forgotten(broker):
    announcer_of(broker).on_fix(at(1.0))
    broker.deliver(CONFIG, b"")
    assert {CONFIG, ZONE, POSITION} == set(broker.forgotten)
    broker.sent.clear()
    broker.deliver("homeassistant/status", b"online")
    assert broker.sent == []


@pytest.mark.parametrize("name", ["a/b", "+", "", "x" * 40, 'a"b'])
def test_a_name_that_no_tag_may_have_is_dropped(broker, name):
    announcer = announcer_of(broker)
    announcer.on_fix(at(1.0, tag=name))
    assert broker.sent == []
    assert announcer.dropped == {"tag-name": 1}


def test_random_documents_raise_and_change_nothing(broker):
    """Half of them are a real document with a few bytes changed; ``SKYLESS_FUZZ_FRAMES=1000000`` for a full run."""
    draws = random.Random(5)
    real = document(HALL, "tag1", "status", {"zone_z9": "binary_sensor"})
    announcer = announcer_of(broker)
    announcer.on_fix(at(1.0))
    before = dict(broker.kept)
    for number in range(int(os.environ.get("SKYLESS_FUZZ_FRAMES", "3000"))):
        noise = bytearray(real if number % 2 else draws.randbytes(draws.randrange(1, 80)))
        for _ in range(draws.randrange(4)):
            noise[draws.randrange(len(noise))] = draws.randrange(256)
        found = platforms(bytes(noise))
        assert all(isinstance(name, str) for name in found.values()) if number % 2 else found == {}
        for topic in (ZONE,) if number % 2 else (ZONE, CONFIG, "homeassistant/status"):
            broker.deliver(topic, bytes(noise))
    announcer.on_second(101.0)
    assert broker.kept == before


def test_templates_hold_nothing_of_what_users_name(broker):
    """Home Assistant runs templates: a name in one would be a program of whoever draws zones."""
    evil = replace(WEST, name="{{ 1 + 1 }}'")
    components = json.loads(document(replace(HALL, name="{{ 2 }}", zones=(evil,)), "tag1", "s", {}))["components"]
    assert components["zone_z1"]["name"] == "In {{ 1 + 1 }}'"
    assert all("1 + 1" not in part.get("value_template", "") for part in components.values())


def test_the_broker_is_the_sites_or_the_one_of_the_address(broker):
    def address(text, context=CONTEXT):
        return make_target(TargetUrl(text), context)._address

    assert address("homeassistant:") == CONTEXT.mqtt
    assert address("homeassistant://ha.local") == MqttAddress("ha.local", 1883)
    assert address("homeassistant://ann:pw@ha.local?tls=yes") == MqttAddress("ha.local", 8883, True, "ann", "pw")
    assert address("homeassistant://ha.local:99", BridgeContext(print)).port == 99
    with pytest.raises(SkylessError, match=r"homeassistant://\[USER"):
        address("homeassistant:", BridgeContext(print))
