"""Messages from MQTT reach the board, the zones and the pages; wrong ones are counted."""

import json

import msgspec
import pytest
from dashboard_builders import SITE, SITE_ID, SQUARE, drained, fix, of, status, truth
from msgspec.structs import replace

from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import SiteZones, ZoneEvent, ZonesMessage
from skyless.run.site_feed import KINDS
from support.site_messages import tag_health

FIX = topics.fix_topic(SITE_ID, "t1")
ZONES = topics.zones_topic(SITE_ID)
HELLO = ("type", "version", "site", "events", "mqtt", "history", "live2", "hub")
EVENT = topics.zone_event_topic(SITE_ID, "desk")


def enter_the_desk(live, wire):
    live.store_zones((SQUARE,))
    wire.deliver(FIX, fix())
    live.tick()


def test_a_page_first_gets_hello(live, wire):
    wire.deliver(FIX, fix())
    messages = drained(live)
    assert messages[0]["type"] == "hello"
    assert messages[0].keys() == {*HELLO, "thresholds", "zones", "other_zones", "zones_fault"}
    assert (messages[0]["site"], messages[0]["zones"], messages[0]["mqtt"]) == (None, [], False)
    assert of("mqtt", messages) == [{"type": "mqtt", "connected": False, "broker": "mqtt://broker:1"}]
    assert of("state", messages)[0]["tags"][0][0] == "t1"


def test_pages_are_sent_the_site_and_the_state_of_the_broker(live, wire):
    page = live.open_page()
    drained(live, page)
    wire.deliver(topics.site_topic(SITE_ID), SITE)
    live.on_connection(connected=True)
    messages = drained(live, page)
    assert of("site", messages)[0]["site"]["site"]["name"] == SITE.site.name
    assert of("site", messages)[0]["site"]["simulated"] is True
    assert of("mqtt", messages)[0]["connected"] is True
    assert drained(live)[0]["site"]["site"]["id"] == SITE_ID


def test_a_slow_page_gets_one_state_of_all_that_it_missed(live, wire, times):
    page = live.open_page()
    drained(live, page)
    for k in range(500):
        times.move(0.05)
        wire.deliver(FIX, fix(serial=k, position_m=(k * 0.01, 0.0, 1.0)))
        wire.deliver(topics.fix_topic(SITE_ID, f"other{k % 7}"), fix(f"other{k % 7}"))
        live.tick()
    messages = drained(live, page)
    (state,) = of("state", messages)
    assert len(state["tags"]) == 8
    assert next(row for row in state["tags"] if row[0] == "t1")[1] == 4.99
    assert len(of("health", messages)) == 1
    times.move(2.0)
    live.tick()
    messages = drained(live, page)
    assert of("health", messages)
    assert not of("state", messages), "there is nothing new"
    assert of("condition", messages)[0]["unix_s"] == times.unix_s


@pytest.mark.parametrize(
    ("topic", "payload"),
    [
        (FIX, b""),
        (topics.site_topic(SITE_ID), replace(SITE, site=replace(SITE.site, id=SITE_ID + 1))),
        (topics.site_topic(SITE_ID), replace(SITE, site=replace(SITE.site, anchors=()))),
        (topics.assets_topic(SITE_ID), b'{"assets": [{"tag": "a b"}]}'),
        (ZONES, b'{"zones":[{"id":"a","name":"A","polygon_m":[[0,0],[1,1]]}]}'),
    ],
)
def test_wrong_messages_are_counted_and_change_nothing(live, wire, topic, payload):
    wire.deliver(topic, payload)
    assert live.feed.drops.total() == 1
    assert live.table.fixes_serial == 0
    assert live.site is None
    assert live.monitor.zones == ()
    counted = of("health", drained(live))[0]["dropped"]
    assert counted == {topic.rsplit("/", 1)[-1]: 1}


def test_zones_are_retained_and_events_have_quality_of_service_1(live, wire):
    page = live.open_page()
    enter_the_desk(live, wire)
    assert [(topic, qos, retain) for topic, _, qos, retain in wire.published] == [(ZONES, 1, True), (EVENT, 1, False)]
    event = json.loads(wire.published[1][1])
    assert (event["kind"], event["zone"], event["tag"], event["unix_s"]) == ("enter", "desk", "t1", 1000.0)
    messages = drained(live, page)
    assert of("zones", messages)[0]["zones"][0]["id"] == "desk"
    assert of("zone_event", messages) == [{"type": "zone_event", **event}]
    assert drained(live)[0]["events"] == [event]


def test_the_echo_of_an_own_event_is_not_sent_again(live, wire):
    enter_the_desk(live, wire)
    page = live.open_page()
    drained(live, page)
    wire.deliver(EVENT, wire.published[-1][1])
    wire.deliver(EVENT, ZoneEvent("desk", "Desk", "t9", "enter", 1.0, (0.0, 0.0, 0.0)))
    live.tick()
    assert [event["tag"] for event in of("zone_event", drained(live, page))] == ["t9"]


def test_a_second_dashboard_leaves_publishing_to_the_first(live, wire, times):
    wire.deliver(topics.status_topic(SITE_ID, "dashboard", "here"), status("dashboard", "here", unix_s=5.0))
    wire.deliver(topics.status_topic(SITE_ID, "dashboard", "older"), status("dashboard", "older", unix_s=1.0))
    enter_the_desk(live, wire)
    assert EVENT not in wire.topics()
    times.move(1.1)
    live.tick()
    assert EVENT in wire.topics()


def named(name):
    return replace(SITE, site=replace(SITE.site, name=name))


def kept(wire):
    """The zones that the broker has now."""
    return msgspec.json.decode(
        [payload for topic, payload, *_ in wire.published if topic == ZONES][-1], type=ZonesMessage
    )


def test_a_site_does_not_show_the_zones_of_another_with_its_number(live, wire):
    wire.deliver(topics.site_topic(SITE_ID), named("Hall"))
    wire.deliver(ZONES, ZonesMessage((SQUARE,), "Lab"))
    assert live.monitor.zones == ()
    assert wire.topics() == [], "nothing is written before somebody draws"
    page = live.open_page()
    hello = drained(live, page)[0]
    assert (hello["zones"], [other["site"] for other in hello["other_zones"]]) == ([], ["Lab"])
    sofa = replace(SQUARE, id="sofa")
    live.store_zones((sofa,), "Hall")
    assert kept(wire) == ZonesMessage((sofa,), "Hall", (SiteZones("Lab", (SQUARE,)),))
    wire.deliver(topics.site_topic(SITE_ID), named("Lab"))
    assert live.monitor.zones == (SQUARE,)
    assert of("zones", drained(live, page))[-1]["zones"][0]["id"] == "desk"
    live.store_zones(())
    assert kept(wire) == ZonesMessage((), "Lab", (SiteZones("Hall", (sofa,)),))
    wire.deliver(topics.site_topic(SITE_ID), named("Hall"))
    assert live.monitor.zones == (sofa,)


@pytest.mark.parametrize("site_first", [True, False])
def test_zones_of_before_become_those_of_the_site_that_is_shown(live, wire, site_first):
    messages = [(topics.site_topic(SITE_ID), named("Hall")), (ZONES, b'{"zones":[%s]}' % msgspec.json.encode(SQUARE))]
    for topic, message in messages if site_first else messages[::-1]:
        wire.deliver(topic, message)
    assert live.monitor.zones == (SQUARE,)
    assert kept(wire) == ZonesMessage((SQUARE,), "Hall")
    wire.deliver(ZONES, kept(wire))
    wire.deliver(topics.site_topic(SITE_ID), named("Lab"))
    assert live.monitor.zones == ()
    assert wire.topics() == [ZONES]


def test_an_older_dashboard_does_not_lose_the_zones_of_other_sites(live, wire):
    wire.deliver(topics.site_topic(SITE_ID), named("Hall"))
    wire.deliver(ZONES, ZonesMessage((), "Hall", (SiteZones("Lab", (SQUARE,)),)))
    wire.deliver(ZONES, b'{"zones":[%s]}' % msgspec.json.encode(SQUARE))
    assert kept(wire) == ZonesMessage((SQUARE,), "Hall", (SiteZones("Lab", (SQUARE,)),))


def test_named_zones_wait_for_the_site(live, wire):
    wire.deliver(ZONES, ZonesMessage((SQUARE,), "Hall"))
    assert live.monitor.zones == ()
    wire.deliver(topics.site_topic(SITE_ID), named("Hall"))
    assert live.monitor.zones == (SQUARE,)
    assert wire.topics() == []


def test_damaged_zones_at_the_broker_are_shown_as_a_fault(live, wire):
    wire.deliver(ZONES, b'{"zones": [{"id": ')
    fault = drained(live)[0]["zones_fault"]
    assert ZONES in fault
    assert "\n" not in fault


def test_what_the_broker_has_cleared_is_no_fault(live, wire):
    for kind in KINDS:
        if kind.retained:
            wire.deliver(f"{topics.ROOT}/{SITE_ID}/{kind.levels.replace('+', '1')}", b"")
    assert not live.feed.drops


def test_the_truth_reaches_the_rows_and_health_the_alarms(live, wire, monkeypatch):
    heard = []
    monkeypatch.setattr(live.alarms.engine, "on_health", heard.append)
    wire.deliver(topics.health_topic(SITE_ID, "tag", "t1"), tag_health())
    assert heard == [tag_health()]
    wire.deliver(topics.truth_topic(SITE_ID), truth(position_m=(2.0, 2.03, 1.0)))
    wire.deliver(FIX, fix(position_m=(2.0, 2.0, 1.0)))
    assert live.state.rows_since(0)[0][10] == pytest.approx(0.03)
