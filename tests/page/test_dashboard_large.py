"""Large sites: nothing is called good, offline or shown that was not counted."""

import json

import msgspec
import pytest
from dashboard_builders import SITE, SITE_ID, drained, fix, of, status
from msgspec.structs import replace
from test_dashboard_condition import anchor_health

from skyless.page.gathered import View
from skyless.page.state import MAX_ROWS, PageRequest, read_request
from skyless.run import site_table
from skyless.run.mqtt import topics

SPACING_M = 4.0
FREE = replace(SITE.site.schedule, mode="free")


def large(live, wire, times, tags, anchors):
    """Run a healthy site for three seconds, in which each program reports once a second."""
    first = SITE.site.anchors[0]
    placed = tuple(
        replace(first, id=n, x_m=SPACING_M * (n % 100), y_m=SPACING_M * (n // 100)) for n in range(1, anchors + 1)
    )
    wire.deliver(
        topics.site_topic(SITE_ID), replace(SITE, site=replace(SITE.site, anchors=placed, master=1, schedule=FREE))
    )
    live.on_connection(connected=True)
    names = [f"t{n}" for n in range(tags)]
    for second in range(7):
        for n in range(1, anchors + 1):
            if not second:
                live.feed.receive(topics.status_topic(SITE_ID, "anchor", str(n)), encoded(status("anchor", str(n))))
            live.feed.receive(topics.health_topic(SITE_ID, "anchor", str(n)), encoded(anchor_health(n, times.unix_s)))
        for n, name in enumerate(names):
            if second in {5, 6}:
                made = fix(name, times.unix_s, (n % 400, n // 400, 1.0), latency_s=0.0)
                live.feed.receive(topics.fix_topic(SITE_ID, name), encoded(made))
        times.move(1.0)
        live.tick()
    return live.condition


encoded = msgspec.json.encode


@pytest.mark.site
@pytest.mark.parametrize(("tags", "anchors"), [(3, 3000), (3000, 8)])
def test_a_healthy_large_site_is_good_and_says_how_many_are_shown(live, wire, times, tags, anchors):
    condition = large(live, wire, times, tags, anchors)
    assert (condition.level, condition.text) == ("good", "")
    assert (condition.tags, condition.tags_with_fix, condition.anchors) == (tags, tags, anchors)
    page = live.open_page()
    messages = drained(live, page)
    assert set(of("health", messages)[0]["conditions"].values()) == {"good"}
    assert len(of("health", messages)[0]["conditions"]) == anchors
    (state,) = of("state", messages)
    assert (len(state["tags"]), state.get("of")) == (min(tags, MAX_ROWS), tags if tags > MAX_ROWS else None)
    page.ask(PageRequest((0.0, -9.0, 9.5, -8.0), tags=("t2",)))
    times.move(1.0)
    live.tick()
    (state,) = of("state", drained(live, page)) if tags > MAX_ROWS else [{"inside": 0, "left": state["tags"][1:]}]
    assert (state["inside"], len(state["left"])) == (0, min(tags, MAX_ROWS) - 1)


def test_what_is_not_taken_in_is_counted_and_not_judged(live, wire, times, monkeypatch):
    monkeypatch.setattr(site_table, "MAX_NAMES", {"tag": 5, "anchor": 6})
    condition = large(live, wire, times, 8, 9)
    assert condition.level == "warning"
    assert [(reason.kind, reason.text) for reason in condition.reasons] == [
        ("not-shown", "3 tags and 3 anchors are not shown")
    ]
    assert (condition.tags, condition.anchors) == (5, 6)
    messages = drained(live)
    assert len(of("state", messages)[0]["tags"]) == 5
    assert len(of("health", messages)[0]["conditions"]) == 6
    assert [event.text for event in live.log.events if event.name in {"anchor/7", "anchor/8", "anchor/9"}] == []


def test_a_server_that_does_not_keep_up_says_so_and_calls_no_anchor_offline(live, wire, times):
    silent = lambda: [event for event in live.log.events if "report any more" in event.text]  # noqa: E731
    large(live, wire, times, 2, 8)
    page = live.open_page()
    drained(live, page)
    wire.unread_s = 1.0
    times.move(3.0)
    for _ in range(10):  # nothing of the anchors can be read, and positions are old when they are
        times.move(1.0)
        wire.deliver(topics.fix_topic(SITE_ID, "t1"), fix("t1", times.unix_s - 3.0, latency_s=0.0))
        wire.deliver(topics.fix_topic(SITE_ID, "t0"), fix("t0", times.unix_s - 3.0, latency_s=0.0))
        live.tick()
    assert [reason.text for reason in live.condition.reasons] == ["the page's server is behind by 3.0 s"]
    assert live.condition.level == "bad"
    assert of("health", drained(live, page))[0]["conditions"] == {}
    assert silent() == []
    wire.unread_s = 0.0
    times.unix_s += 3600.0  # the clock is set meanwhile
    for _ in range(6):
        times.move(1.0)
        wire.deliver(topics.fix_topic(SITE_ID, "t1"), fix("t1", times.unix_s, latency_s=0.0))
        live.tick()
    assert "anchors" in [reason.kind for reason in live.condition.reasons]
    assert (len(silent()), min(event.unix_s for event in silent()) > 4600.0) == (8, True)


VIEWS = ("0,0,1", "1,1"), ("1,0,0,1", "9,9"), ("0,0,1e9,1", "9,9"), ("0,0,1,1", "0,9"), ("0,0,1,1", "9,99999")
WRONG = ["", "pong", "[]", "{}", '{"view": 3}', '{"rows": 0}', '{"tags": "t1"}', "[" * 5000]


def test_a_request_that_is_none_changes_nothing():
    assert [read_request(text, PageRequest) for text in WRONG if text != "{}"] == [None] * 7
    assert [read_request(text, View) for text in WRONG] == [None] * 8
    assert [read_request(f'{{"view":[{view}],"px":[{px}]}}', View) for view, px in VIEWS] == [None] * 5
    assert read_request(json.dumps({"rows": 5, "view": [0, 1, 2, 3]}), PageRequest) == PageRequest(
        (0.0, 1.0, 2.0, 3.0), rows=5
    )
