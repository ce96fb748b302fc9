"""The HTTP interface: what each route answers, against its own OpenAPI document, and whom it lets in."""

import json
import threading
import time
from itertools import pairwise

import numpy as np
import pytest
from dashboard_builders import HERE, SITE_ID, browser_of
from http_values import ALARM, ASSETS, NAMES, RULE, FakeHistory, fake_history, fill, show
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from msgspec.structs import replace
from openapi_spec_validator import OpenAPIV31SpecValidator
from starlette.exceptions import HTTPException

from skyless.core.earth import geodetic
from skyless.page.api import questions
from skyless.page.api.routes import ROUTES
from skyless.page.connections import AccessRules
from skyless.run.assets import write_csv
from skyless.run.fix_batch import RECORD
from skyless.run.history.layout import site_folder
from skyless.run.history.writer import Writer
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import ZoneEvent
from skyless.run.web import PageLimits

pytestmark = pytest.mark.site

API = f"{HERE}/api/v1"
SPAN = {"from": "100", "to": "200"}
QUERIES = {
    "/tags/{tag}": {"tag": "t1"},
    "/history/tags": {},
    "/history/track": {"tag": "t1", **SPAN},
    "/history/contacts": {"tag": "t1", **SPAN},
    "/alarms/{rule}/{subject}/acknowledge": {"rule": "cold", "subject": "t1"},
}
BODIES = {
    "/assets": {"assets": [{"tag": "t1", "name": "Forklift 1"}], "site": "lab"},
    "/assets.csv": "tag,name\nt1,Forklift 1\n",
    "/alarm_rules": {"rules": [{"id": "cold", "kind": "inside", "zone": "desk"}]},
    "/alarms/{rule}/{subject}/acknowledge": {"id": ALARM.id, "by": "Ada"},
}


@pytest.fixture
def site(live, wire, monkeypatch, tmp_path):
    site_folder(tmp_path, SITE_ID).mkdir()
    fake_history(monkeypatch)
    fill(live, wire)
    return live


@pytest.fixture
def client(site, tmp_path):
    with browser_of(site, history=tmp_path) as client:
        client.base_url = API + "/"
        yield client


@pytest.fixture
def document(client):
    return client.get("openapi.json").json()


def asked(client, route, query=None, **settings):
    query = dict((QUERIES.get(route.path, SPAN if "history" in route.path else {})) if query is None else query)
    path = route.path
    for name in list(query):
        if f"{{{name}}}" in path:
            path = path.replace(f"{{{name}}}", query.pop(name))
    body = BODIES.get(route.path) if route.body is not None else None
    content = body if body is None or isinstance(body, str) else json.dumps(body)
    return client.request(route.method, path[1:], params=query, content=content, **settings)


def test_the_document_is_valid_openapi(document):
    OpenAPIV31SpecValidator(document).validate()
    listed = {(method.upper(), path) for path, methods in document["paths"].items() for method in methods}
    assert listed == {(route.method, f"/api/v1{route.path}") for route in ROUTES}
    for methods in document["paths"].values():
        for operation in methods.values():
            assert all(parameter["description"] for parameter in operation["parameters"])


@pytest.mark.parametrize("route", ROUTES, ids=lambda route: f"{route.method} {route.path}")
def test_answers_are_as_the_document_says(client, document, route):
    answer = asked(client, route)
    assert answer.status_code == 200, answer.text
    kinds = document["paths"]["/api/v1" + route.path][route.method.lower()]["responses"]["200"]["content"]
    kind = answer.headers["content-type"].partition(";")[0]
    schema = {**kinds[kind]["schema"], "components": document["components"]}
    value = answer.json() if kind == "application/json" else answer.text
    Draft202012Validator(schema).validate(value)
    assert value
    assert answer.content.endswith(b"\n")


@pytest.mark.parametrize("route", ROUTES, ids=lambda route: f"{route.method} {route.path}")
def test_errors_are_as_the_document_says(client, document, route):
    query = QUERIES.get(route.path, SPAN if "history" in route.path else {})
    for wrong, words in (({"site": "x"}, "site is 'x'; it should be a whole number"), ({"colour": "1"}, "`colour`")):
        answer = asked(client, route, {**query, **wrong})
        assert answer.status_code == 400
        Draft202012Validator({**document["components"]["schemas"]["ErrorAnswer"]}).validate(answer.json())
        assert words in answer.json()["error"]
        assert answer.content.endswith(b"}\n")
    assert asked(client, route, {**query, "site": "60000"}).status_code == 404


@given(st.integers(1, 9))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=20)
def test_pages_have_each_tag_once(client, limit):
    found, after = [], ""
    while after is not None:
        answer = client.get("tags", params={"limit": limit, "after": after}).json()
        assert len(answer["tags"]) <= limit
        found += [tag["tag"] for tag in answer["tags"]]
        after = answer["next"]
    assert found == [*NAMES, "t9"]


def test_tags_by_group_zone_and_name(client, site, wire):
    show(site, wire, "t2", x=8.0)
    names = lambda **query: [tag["tag"] for tag in client.get("tags", params=query).json()["tags"]]  # noqa: E731
    assert names(group="forklifts") == ["t1"]
    assert names(zone="desk") == [name for name in NAMES if name != "t2"]
    assert names(find="ada") == ["t3"]
    assert names(find="T1") == ["t1"]
    assert names(group="none") == []
    tag = client.get("tags/t1").json()
    assert (tag["name"], tag["group"], tag["icon"], tag["zones"]) == ("Forklift 1", "forklifts", "🚜", ["desk"])
    assert tag["fix"]["position_m"] == [2.0, 2.0, 1.0]
    assert client.get("tags/t9").json()["fix"] is None
    assert client.get("tags/nobody").status_code == 404


def test_old_and_forbidden_fixes_are_none(client, site, wire, times):
    times.move(4.0)
    show(site, wire, "t1", alert="alert-limit-exceeded")
    show(site, wire, "t2")
    times.move(2.0)
    assert [fix["tag"] for fix in client.get("fixes").json()["fixes"]] == ["t2"]
    assert client.get("fixes").json()["fixes"][0]["unix_s"] == pytest.approx(site.wall_clock() - 2.0, abs=0.01)
    assert client.get("tags/t1").json()["fix"] is None


def test_geojson_has_the_assets_and_true_places(client, site):
    fixes = client.get("fixes", params={"format": "geojson"})
    assert fixes.headers["content-type"] == "application/geo+json"
    forklift = next(feature for feature in fixes.json()["features"] if feature["id"] == "t1")
    assert forklift["properties"].items() >= {"name": "Forklift 1", "group": "forklifts", "colour": "#c2410c"}.items()
    assert fixes.json()["features"][1]["properties"]["name"] is None
    anchor = site.site.site.anchors[0]
    latitude, longitude, height = geodetic((anchor.x_m, anchor.y_m, anchor.z_m), site.site.site.georeference)
    shown = client.get("anchors", params={"format": "geojson"}).json()["features"][0]
    assert shown["geometry"]["coordinates"] == pytest.approx([longitude, latitude, height])
    (zone,) = client.get("zones", params={"format": "geojson"}).json()["features"]
    (ring,) = zone["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    assert len(ring) == 5
    turns = sum(x1 * y2 - x2 * y1 for (x1, y1), (x2, y2) in pairwise(ring))
    assert turns > 0.0  # counter-clockwise, as RFC 7946 asks


def test_without_a_georeference_there_is_no_geojson(client, site, wire):
    wire.deliver(topics.site_topic(SITE_ID), replace(site.site, site=replace(site.site.site, georeference=None)))
    for path in ("fixes", "anchors", "zones"):
        answer = client.get(path, params={"format": "geojson"})
        assert answer.status_code == 409
        assert "[georeference]" in answer.json()["error"]
        assert client.get(path).status_code == 200


def test_before_a_site_is_known(live, wire):
    with browser_of(live) as client:
        for path in ("site", "anchors", "fixes?format=geojson"):
            answer = client.get(f"{API}/{path}")
            assert (answer.status_code, answer.json()["error"]) == (404, "no site is known yet")
        assert client.put(f"{API}/assets", json={"assets": []}).status_code == 404
        assert client.get(f"{API}/tags").json() == {"tags": [], "next": None}


def test_events_come_in_pages_while_more_happen(client, site, wire):
    def enter(number):
        wire.deliver(
            topics.zone_event_topic(SITE_ID, "desk"),
            ZoneEvent("desk", "Desk", f"x{number}", "enter", number, (1.0, 2.0, 3.0)),
        )

    for number in range(10):
        enter(number)
    found, before, further = [], {}, 10
    while before is not None:
        answer = client.get("events", params={"limit": 4, **before}).json()
        found += answer["events"]
        before = None if answer["before"] is None else {"before": answer["before"]}
        enter(further)
        further += 1
    ids = [event["id"] for event in found]
    assert ids == list(range(ids[0], 0, -1))
    crossings = [event for event in found if event["subject"].startswith("tag/x")]
    assert [event["zone_event"]["tag"] for event in crossings] == [f"x{number}" for number in range(9, -1, -1)]
    crossing = {"zone": "desk", "name": "Desk", "tag": "x9", "kind": "enter", "unix_s": 9.0}
    assert crossings[0] == {
        "id": ids[0], "unix_s": 9.0, "kind": "zone", "level": "note", "subject": "tag/x9",
        "text": "tag x9 entered Desk", "zone_event": {**crossing, "position_m": [1.0, 2.0, 3.0]},
    }  # fmt: skip


def test_assets_go_in_and_out(client, site):
    table = client.get("assets.csv")
    assert table.content == write_csv(ASSETS)
    assert (
        client.put("assets.csv", content="\ufefftag;name\r\nt2;Tür\r\n".encode()).json()["assets"][0]["name"] == "Tür"
    )
    assert client.get("assets").json() == {
        "assets": [{"tag": "t2", "name": "Tür", "group": "", "icon": "", "colour": "", "owner": "", "notes": ""}],
        "site": site.site.site.name,
    }
    for path, content, words in (
        ("assets.csv", b"tag,colour\nt1,red\n", "line 2: colour is 'red'"),
        ("assets", b'{"assets": [{"tag": "t1", "colour": "red"}]}', "asset 't1': colour is 'red'"),
        ("assets", b'{"assets": [], "site": "another"}', "site is 'another'"),
        ("assets", b'{"assets": [{"name": 3}]}', "AssetsMessage"),
        ("assets", b"[" * 100_000, "AssetsMessage"),
        ("assets", b"\xff", "AssetsMessage"),
    ):
        answer = client.put(path, content=content)
        assert answer.status_code == 400
        assert words in answer.json()["error"]
    assert client.put("assets", content=b" " * 8_000_001).status_code == 413
    assert list(site.assets.by_tag) == ["t2"]


def test_alarms(client, site):
    assert client.get("alarms").json()["alarms"][0]["id"] == ALARM.id
    assert client.get("alarm_rules").json()["rules"][0]["id"] == RULE.id
    answer = client.post("alarms/cold/t1+t2/acknowledge", json={"id": ALARM.id, "by": "Ada"})
    assert answer.json() == {"id": ALARM.id, "by": "Ada"}
    assert site.acknowledged == [("cold", "t1+t2", ALARM.id, "Ada")]

    def refuse(*_what):
        raise HTTPException(503, "the broker is away")

    site.acknowledge = refuse
    assert client.post("alarms/cold/t1/acknowledge", json={"id": "x", "by": "y"}).status_code == 503


def test_the_history_gets_what_was_asked(client, tmp_path):
    client.get("history/track", params={"tag": "t1", "from": "yesterday", "points": "9"})
    client.get("history/heatmap", params={**SPAN, "tag": "t1, t2", "cell_m": "0.5"})
    client.get("history/dwell", params={**SPAN, "zone": "desk"})
    track, heatmap, dwell = FakeHistory.asked
    assert track[:4] == (tmp_path, SITE_ID, "track", "t1")
    assert (track[4].from_unix_s, track[5]) == (1.0, 9)
    assert heatmap[4:] == (0.5, ("t1", "t2"))
    assert dwell[4:] == ((), "desk")


@pytest.mark.parametrize(
    ("path", "query", "words"),
    [
        ("track", {"tag": "t1"}, "missing required field `from`; the parameters here are site, tag, from, to, points"),
        ("track", SPAN, "missing required field `tag`"),
        ("track", {"tag": "none", **SPAN}, "the history has t1"),
        ("track", {"tag": "t1", "from": "soon"}, "from is 'soon'"),
        ("track", {"tag": "t1", "points": "0", **SPAN}, "points is '0'; it should be a whole number from 2 to 20000"),
        ("heatmap", {"cell_m": "nan", **SPAN}, "cell_m is 'nan'; it should be a number from 0.05 to 50"),
    ],
)
def test_wrong_questions_to_the_history(client, path, query, words):
    answer = client.get(f"history/{path}", params=query)
    assert answer.status_code == 400
    assert words in answer.json()["error"]


def test_a_slow_question_ends_and_holds_up_nothing_else(client, monkeypatch):
    monkeypatch.setattr(questions, "LIMITS", PageLimits(question_s=0.2, questions=2))
    answers = []
    asking = [
        threading.Thread(target=lambda: answers.append(client.get("history/track", params={"tag": "slow", **SPAN})))
        for _ in range(3)
    ]
    for thread in asking:
        thread.start()
    assert client.get("tags").status_code == 200
    for thread in asking:
        thread.join()
    FakeHistory.release.set()
    assert [answer.status_code for answer in answers] == [503] * 3
    assert sum("are waiting" in answer.json()["error"] for answer in answers) == 1
    for _ in range(100):  # until the thread has ended the question that nobody waits for any more
        if client.get("history/tags").status_code == 200:
            break
        time.sleep(0.02)
    assert client.get("history/tags").json() == {"tags": ["t1", "t2"]}


def test_a_real_history_answers_and_a_question_that_takes_too_long_is_ended(live, wire, tmp_path, monkeypatch):
    writer = Writer(tmp_path, SITE_ID)
    records = np.zeros(3, RECORD)
    records["tag"], records["unix_us"] = writer.tag_number("t1", 1.7e9), (1.7e9 + np.arange(3)) * 1e6
    writer.fixes.add(records, 1.7e9)
    writer.close()
    fill(live, wire)
    with browser_of(live, history=tmp_path, base_url=f"{API}/") as client:
        monkeypatch.setattr(questions, "LIMITS", PageLimits(question_s=0.01))
        assert client.get("history/tags").status_code == 503
        monkeypatch.setattr(questions, "LIMITS", PageLimits())
        assert client.get("history/tags").json() == {"tags": ["t1"]}
        asked = {"from": "1699999999", "to": "1700000001"}
        assert client.get("history/track", params={"tag": "t1", **asked}).json()["fixes"] == 1
        assert "no tag 't9'" in client.get("history/track", params={"tag": "t9", **asked}).json()["error"]
        client.app.state.services.past.stop()


def test_without_a_history_of_this_site(site, tmp_path):
    for folder, words in ((None, "start the page's server with --history FOLDER"), (tmp_path / "empty", "")):
        with browser_of(site, history=folder) as client:
            for question in ("tags", "dwell?from=soon"):
                answer = client.get(f"{API}/history/{question}")
                assert (answer.status_code, words in answer.json()["error"]) == (404, True)


# Tokens

OPERATOR, READER = "operators-token", "readers-token-1"


@pytest.mark.parametrize("remote", [False, True])
@pytest.mark.parametrize("route", ROUTES, ids=lambda route: f"{route.method} {route.path}")
def test_the_readers_token_reads_and_the_operators_does_all(site, tmp_path, route, remote):
    rules = AccessRules(OPERATOR, READER, remote=remote)
    client = browser_of(site, history=tmp_path, rules=rules, base_url=API + "/")
    assert asked(client, route).status_code == 401
    for wrong in (f"Bearer {READER}x", f"Basic {OPERATOR}"):
        assert asked(client, route, headers={"authorization": wrong}).status_code == 401
    assert asked(client, route, headers={"authorization": f"Bearer {OPERATOR}"}).status_code == 200
    expected = 200 if route.role == "reader" else 403
    assert asked(client, route, headers={"authorization": f"Bearer {READER}"}).status_code == expected


def test_a_token_in_the_query_becomes_the_cookie_of_its_own_role(site):
    client = browser_of(site, rules=AccessRules(OPERATOR, READER), base_url=API + "/")
    assert client.get("site", params={"token": READER}).status_code == 200
    assert client.get("site").status_code == 200
    assert "set-cookie" not in client.get("site", params={"token": "guessed-token"}).headers
    assert client.put("assets", json={"assets": []}).status_code == 403
    assert client.put("/api/zones", json={"zones": []}).status_code == 403
    assert client.get("site", params={"token": OPERATOR}).status_code == 200
    assert client.put("assets", json={"assets": []}).status_code == 200


# Fuzz

PARAMETERS = "site limit after before find group zone format tag from to points cell_m step_s distance_m token x"
KEYS = st.sampled_from(PARAMETERS.split())
VALUES = st.text(max_size=20) | st.sampled_from(["1", "-1", "0", "1e308", "nan", "null", "geojson", "t1", "9" * 40])


@given(st.sampled_from(ROUTES), st.dictionaries(KEYS, VALUES, max_size=4), st.binary(max_size=60) | st.none())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=100)
def test_nothing_makes_it_fail(client, route, query, body):
    path = route.path.replace("{tag}", "t1").replace("{rule}", "cold").replace("{subject}", "t1")
    answer = client.request(route.method, path[1:], params=query, content=body or b"")
    assert answer.status_code < 500
    if answer.status_code >= 400:
        assert answer.json()["error"]


BODY = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["assets", "tag", "name", "colour", "site", "rules", "id", "by", "kind"]), inner
        )
    ),
    max_leaves=8,
)


@given(st.sampled_from([route for route in ROUTES if route.body is not None]), BODY)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=100)
def test_no_body_makes_it_fail(client, route, body):
    path = route.path.replace("{rule}", "cold").replace("{subject}", "t1")
    answer = client.request(route.method, path[1:], content=json.dumps(body))
    assert answer.status_code < 500
