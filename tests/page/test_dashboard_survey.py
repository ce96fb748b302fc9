"""The server forwards the survey and the watch, and publishes what pages give to the survey program."""

import json
import struct

import msgspec
import pytest
from dashboard_builders import SITE, SITE_ID, browser_of, drained, of
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.errors import SkylessError
from skyless.core.site import FloorPlanSite, UnplacedAnchor
from skyless.page.overlay_process import overlay
from skyless.page.state import SiteSurvey
from skyless.page.tasks import OverlayTask
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import MqttAddress, Role
from skyless.run.mqtt.messages import SurveyFactsMessage, SurveyMessage, WatchFinding, WatchMessage
from skyless.run.survey.checked_facts import BadFactsError
from skyless.run.web import PAGE as LIMITS
from skyless.site.survey.facts import Facts, Gauge, Survey, SurveyedAnchor, Tape, TapeAdvice

pytestmark = pytest.mark.site

SURVEY, WATCH = topics.survey_topic(SITE_ID), topics.watch_topic(SITE_ID)
FLOOR = topics.floor_plan_topic(SITE_ID)
IMAGE = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 40, 30) + bytes(9)


def survey_message(unix_s=1000.0, serial=3, result=True):
    anchors = (SurveyedAnchor(1, True, 0.0, 0.0, 0.0, 0.01), SurveyedAnchor(2, False, reason="it is linked to nobody"))
    advice = (TapeAdvice(1, 2, 0.05, 0.01),)
    found = Survey(anchors, (), 0.03, 1, None, ("anchor 2",), (), advice, "anchor 1 is the origin", Gauge(1, 2), ())
    return SurveyMessage(unix_s, serial, (1, 2), (3,), 12.0, (), Facts(), found if result else None, file="site.toml")


def watch_message(unix_s=1000.0):
    finding = WatchFinding("moved", (4,), 0.11, 0.01, 990.0, "anchor 4 has moved by about 11 cm")
    return WatchMessage(unix_s, "watching", (finding,), 28)


@pytest.fixture
def live(live):
    live.on_connection(True)
    return live


@pytest.fixture
def browser(live):
    return browser_of(live)


def test_the_survey_and_the_watch_reach_pages(live, wire):
    page = live.open_page()
    assert of("survey", drained(live, page)) == []
    wire.deliver(SURVEY, survey_message())
    wire.deliver(WATCH, watch_message())
    (survey,), watch = of("survey", drained(live, page)), json.loads(live.survey.messages()["watch"])
    assert survey["survey"] == json.loads(msgspec.json.encode(survey_message()))
    assert watch["watch"]["findings"][0]["sentence"] == "anchor 4 has moved by about 11 cm"
    later = live.open_page()
    assert of("survey", drained(live, later))[0]["survey"]["serial"] == 3
    wire.deliver(SURVEY, b"")  # the program has ended
    assert of("survey", drained(live, page))[-1]["survey"] is None


def test_a_message_that_the_broker_kept_is_as_old_as_it_says(live, wire, times):
    age_s = lambda: json.loads(live.survey.messages()["survey"])["age_s"]  # noqa: E731
    times.move(500.0)
    wire.deliver(SURVEY, survey_message(unix_s=1000.0))
    assert age_s() == pytest.approx(500.0)
    wire.deliver(SURVEY, survey_message(unix_s=1000.0))  # its sender's clock is slow
    assert age_s() == pytest.approx(0.0)
    times.move(7.0)
    assert age_s() == pytest.approx(7.0)
    live.on_connection(False)
    live.on_connection(True)
    wire.deliver(SURVEY, survey_message(unix_s=1400.0))
    assert age_s() == pytest.approx(107.0)
    wire.deliver(SURVEY, survey_message(unix_s=1e9))  # its sender's clock is fast
    assert age_s() == pytest.approx(0.0)


FACTS = SurveyFactsMessage(
    Facts(heights_m={1: 2.4}, tapes=(Tape(1, 4, 7.21),), points={3: (0.0, 1.0, None)}, gauge=Gauge(1, 2, 3)),
    FloorPlanSite("", 20.0, -1.0, -2.0),
)


def test_facts_are_published_with_the_dashboards_name(browser, wire):
    answer = browser.put("/api/survey/facts", content=msgspec.json.encode(FACTS))
    assert answer.status_code == 200
    topic, payload, qos, retain = wire.published[-1]
    assert (topic, qos, retain) == (topics.survey_facts_topic(SITE_ID), 1, False)
    assert msgspec.json.decode(payload, type=SurveyFactsMessage) == replace(FACTS, by="here")


def changed(**values):
    return replace(FACTS, facts=replace(FACTS.facts, **values))


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (changed(tapes=(Tape(1, 4, 0.0),)), "tapes[0].distance_m is 0; it should be a number of metres above 0"),
        (changed(tapes=(Tape(4, 4, 1.0),)), "from anchor 4 to itself"),
        (changed(heights_m={7: 1e9}), "heights_m of anchor 7 is 1e+09; it should be a number of metres from"),
        (changed(points={7: (0.0, -1e9, None)}), "points of anchor 7, y is -1e+09"),
        (changed(gauge=Gauge(1, 2, 1)), "gauge names anchors 1, 2, 1"),
        (changed(delay_std_m=-1.0), "delay_std_m is -1"),
        (replace(FACTS, floor_plan=FloorPlanSite("", 0.0)), "floor_plan.width_m is 0"),
        (changed(heights_m=dict.fromkeys(range(10_001), 1.0)), "at most 10000"),
    ],
)
def test_wrong_facts_are_refused_with_what_would_be_right(browser, wire, message, words):
    answer = browser.put("/api/survey/facts", content=msgspec.json.encode(message))
    assert answer.status_code == 400
    assert words in answer.json()["error"]
    assert wire.published == []


@given(st.binary(max_size=60) | st.recursive(st.none() | st.floats() | st.text(), st.lists).map(msgspec.json.encode))
def test_no_body_raises_anything_else(body):
    relay = SiteSurvey("here", lambda *_: None, lambda: 0.0, lambda: 0.0)
    for read in (relay.facts_message, relay.save_message):
        with pytest.raises(BadFactsError):
            read(body)


def test_a_result_is_saved_by_its_number(browser, wire):
    save = lambda body: browser.post("/api/survey/save", content=body)  # noqa: E731
    assert save(b'{"serial": 3}').status_code == 409
    wire.deliver(SURVEY, survey_message(result=False))
    assert "no result yet" in save(b'{"serial": 3}').json()["error"]
    wire.deliver(SURVEY, survey_message())
    assert save(b'{"serial": 4}').json()["error"] == "there is no result 4; the newest is 3"
    assert save(b"{}").status_code == 400
    assert wire.published == []
    assert save(b'{"serial": 2}').status_code == 200  # the one that the page showed a moment ago
    topic, payload, qos, retain = wire.published[-1]
    assert (topic, json.loads(payload), qos, retain) == (
        topics.survey_save_topic(SITE_ID), {"by": "here", "serial": 2}, 1, False,
    )  # fmt: skip


def test_a_page_whose_role_may_not_set_up_a_site_says_so(browser, wire):
    """The broker would acknowledge what it drops."""
    wire.address = MqttAddress("broker", 1, user=str(Role.PAGE))
    wire.deliver(SURVEY, survey_message())
    for answer in (
        browser.post("/api/survey/save", content=b'{"serial": 3}'),
        browser.put("/api/survey/facts", content=msgspec.json.encode(FACTS)),
    ):
        assert answer.status_code == 403
        assert "start this page with the user survey" in answer.json()["error"]
    assert wire.published == []


def test_a_floor_plan_is_retained_and_shown(browser, wire, live):
    page = live.open_page()
    assert browser.put("/api/floor_plan", content=IMAGE).json() == {"bytes": len(IMAGE)}
    assert wire.published == [(FLOOR, IMAGE, 1, True)]
    assert browser.get("/api/floor_plan").content == IMAGE
    digest = of("floor_plan", drained(live, page))[0]["digest"]
    wire.deliver(FLOOR, IMAGE)  # as the broker returns it
    assert wire.forgotten == []
    wire.deliver(FLOOR, IMAGE + b"0")  # another program's
    assert wire.forgotten == [FLOOR]
    assert of("floor_plan", drained(live, page))[0]["digest"] != digest


@pytest.mark.parametrize(
    ("body", "status"), [(b"GIF89a", 400), (b"", 400), (IMAGE[:12], 400), (bytes(LIMITS.floor_plan_bytes + 1), 413)]
)
def test_other_images_are_refused(browser, wire, body, status):
    answer = browser.put("/api/floor_plan", content=body)
    assert answer.status_code == status
    assert answer.json()["error"]
    assert wire.published == []


def test_nothing_is_accepted_without_a_broker(browser, wire, live):
    wire.deliver(SURVEY, survey_message())
    live.on_connection(False)
    for method, path, body in (
        ("PUT", "/api/survey/facts", msgspec.json.encode(FACTS)),
        ("POST", "/api/survey/save", b'{"serial": 3}'),
        ("PUT", "/api/floor_plan", IMAGE),
        ("POST", "/api/v1/alarms/r/t1/acknowledge", b'{"id": "x", "by": "y"}'),
    ):
        answer = browser.request(method, path, content=body)
        assert answer.status_code == 503
        assert "mqtt://broker:1" in answer.json()["error"]
    assert wire.published == []


def test_a_site_without_positions_has_no_overlay_yet(live, wire):
    unplaced = tuple(UnplacedAnchor(anchor.id, slot) for slot, anchor in enumerate(SITE.site.anchors))
    schedule = replace(SITE.site.schedule, mode="free")
    site = replace(SITE.site, anchors=(), unplaced=unplaced, schedule=schedule)
    wire.deliver(topics.site_topic(SITE_ID), replace(SITE, site=site))
    assert live.feed.drops == {}
    with pytest.raises(SkylessError, match="no anchor of this site has a position yet"):
        overlay(OverlayTask(site, "pdop", 0.25, None))
