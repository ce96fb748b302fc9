"""The stream of the HTTP interface: what it sends, to whom, and that a slow reader gets the newest state."""

import json

import pytest
from dashboard_builders import SITE_ID, browser_of
from http_values import ALARM, NAMES, fill, show
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from starlette.websockets import WebSocketDisconnect

from skyless.page.api import routes
from skyless.page.api.routes import SiteStream
from skyless.page.connections import AccessRules
from skyless.page.events import MAX_KEPT
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import ZoneEvent
from skyless.run.web import PageLimits

STREAM = "ws://localhost:8080/api/v1/stream"


@pytest.fixture
def site(live, wire):
    fill(live, wire)
    return live


def messages(reader, kind=None):
    found = [json.loads(message) for message in reader.new()]
    return found if kind is None else [message for message in found if message["type"] == kind]


def fixed(reader):
    """Tags of the fixes that are new."""
    return [fix["tag"] for message in messages(reader, "fixes") for fix in message["fixes"]]


def enter(wire, tag, number=1.0):
    wire.deliver(topics.zone_event_topic(SITE_ID, "desk"), ZoneEvent("desk", "Desk", tag, "enter", number, (1, 2, 3)))


def test_hello_comes_first_and_then_all_that_is_there(site):
    with browser_of(site) as client, client.websocket_connect(STREAM) as socket:
        hello = socket.receive_json()
        assert hello.pop("version")
        assert hello == {"type": "hello", "site": SITE_ID, "name": site.site.site.name, "history": False}
        fixes = socket.receive_json()
        assert (fixes["type"], [fix["tag"] for fix in fixes["fixes"]]) == ("fixes", NAMES)
        assert socket.receive_json()["type"] == "alarm"
        socket.send_text("whatever")
        client.portal.call(_show_later, site)
        assert [fix["tag"] for fix in socket.receive_json()["fixes"]] == ["t5"]


async def _show_later(live):
    show(live, live._link, "t5")


@pytest.mark.site
@given(st.lists(st.lists(st.tuples(st.sampled_from(NAMES), st.floats(0.0, 9.0)), max_size=9), max_size=6))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
def test_a_reader_that_pauses_gets_the_newest_fix_of_each_tag_once(site, wire, pauses):
    reader = SiteStream(site, frozenset())
    reader.new()
    for pause in pauses:
        for tag, x in pause:
            show(site, wire, tag, x=x)
        newest = dict(pause)
        got = [fix for message in messages(reader, "fixes") for fix in message["fixes"]]
        assert {fix["tag"]: fix["position_m"][0] for fix in got} == newest
        assert len(got) == len(newest)


def test_only_chosen_tags(site, wire):
    some = SiteStream(site, frozenset({"t2", "t3"}))
    one = SiteStream(site, frozenset({"t3"}))
    assert fixed(some) == ["t2", "t3"]
    assert fixed(one) == ["t3"]
    for tag in ("t1", "t2", "t3"):
        enter(wire, tag)
    assert [event["tag"] for event in messages(some, "zone_event")] == ["t2", "t3"]
    (event,) = messages(one, "zone_event")
    assert event == {
        "type": "zone_event", "zone": "desk", "name": "Desk", "tag": "t3", "kind": "enter", "unix_s": 1.0,
        "position_m": [1.0, 2.0, 3.0],
    }  # fmt: skip
    assert messages(SiteStream(site, frozenset({"t2"})), "alarm") == []


def test_alarms_as_they_change_and_when_they_are_over(site):
    reader = SiteStream(site, frozenset())
    (alarm,) = messages(reader, "alarm")
    assert (alarm["id"], alarm["sentence"], alarm["over"]) == (ALARM.id, ALARM.sentence, False)
    assert messages(reader, "alarm") == []
    site.alarms.messages = (replace(ALARM, acknowledged_by="Ada", acknowledged_unix_s=3.0),)
    assert messages(reader, "alarm")[0]["acknowledged_by"] == "Ada"
    site.alarms.messages = ()
    assert messages(reader, "alarm")[0]["over"] is True
    assert messages(reader, "alarm") == []


def test_after_a_long_pause_the_oldest_events_are_missing(site, wire):
    reader = SiteStream(site, frozenset())
    for number in range(MAX_KEPT + 10):
        enter(wire, "t1", float(number))
    events = messages(reader, "zone_event")
    assert [event["unix_s"] for event in events] == [float(number) for number in range(10, MAX_KEPT + 10)]


@pytest.mark.parametrize("query", ["?site=x", "?sit=1", "?site=9", "?site=" + 40 * "€"])
def test_wrong_questions_are_closed_with_a_reason(site, query):
    with browser_of(site) as client, client.websocket_connect(STREAM + query) as socket:
        with pytest.raises(WebSocketDisconnect) as closed:
            socket.receive_json()
        assert closed.value.code == 1008
        assert "sit" in closed.value.reason
        assert len(closed.value.reason.encode()) <= 123


def test_there_are_only_so_many(site, monkeypatch):
    monkeypatch.setattr(routes, "LIMITS", PageLimits(streams=1))
    with browser_of(site) as client, client.websocket_connect(STREAM) as first:
        first.receive_json()
        with client.websocket_connect(STREAM) as second, pytest.raises(WebSocketDisconnect) as closed:
            second.receive_json()
        assert closed.value.code == 1013


def test_readers_may_listen_and_strangers_not(site):
    client = browser_of(site, rules=AccessRules("operators-token", "readers-token-1"))
    with client, client.websocket_connect(f"{STREAM}?token=readers-token-1") as socket:
        assert socket.receive_json()["type"] == "hello"
    stranger = browser_of(site, rules=AccessRules("operators-token", "readers-token-1"))
    with pytest.raises(WebSocketDisconnect), stranger.websocket_connect(STREAM):
        pass
