"""The server as browsers and others meet it, good and bad."""

import asyncio
import json

import pytest
from dashboard_builders import HERE, SITE, SITE_ID, SQUARE, browser_of, fix
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from starlette.websockets import WebSocketDisconnect

from skyless.core.earth import geodetic
from skyless.core.site import GeoreferenceSite
from skyless.page.connections import AccessRules, Guard
from skyless.page.live import GONE_S, IDLE_S, TooManyPagesError
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import site_message
from skyless.run.web import PAGE as LIMITS
from skyless.sim.lab import lab_site

pytestmark = pytest.mark.site

TOKEN = "correct-horse-battery"
SOCKET = "ws://localhost:8080/live"
STRANGE_SOCKET = "ws://192.168.1.5:8080/live"


@pytest.fixture
def page(tmp_path):
    folder = tmp_path / "page"
    folder.mkdir()
    (folder / "index.html").write_text("<!doctype html><title>Skyless</title>")
    (folder / "main.js").write_text("export {};")
    (tmp_path / "secret.txt").write_text("secret")
    (folder / "link.txt").symlink_to(tmp_path / "secret.txt")
    return folder


@pytest.fixture
def browser(live, page):
    return browser_of(live, page=page)


@pytest.fixture
def stranger(live, page):
    """Somebody on another machine."""
    rules = AccessRules(TOKEN, names=frozenset({"hall.example"}), remote=True, cookie="skyless-8080")
    return browser_of(live, page=page, rules=rules, base_url="http://192.168.1.5:8080")


def test_the_page_and_its_modules(browser):
    assert "Skyless" in browser.get("/").text
    module = browser.get("/page/main.js")
    assert module.headers["content-type"].startswith("text/javascript")
    assert module.headers["cache-control"] == "no-cache"
    assert browser.get("/page/none.js").status_code == 404


@pytest.mark.parametrize(
    "path", ["/page/../secret.txt", "/page/%2e%2e/secret.txt", "/page/link.txt", "/page//etc/passwd"]
)
def test_files_outside_the_page_stay_there(browser, path):
    assert browser.get(path).status_code == 404


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_another_sites_image_or_link_gets_the_page_at_most(browser, site):
    headers = {"sec-fetch-site": site}
    assert browser.get("/", headers=headers).status_code == 200
    assert browser.get("/api/v1/site", headers=headers).status_code == 403
    assert browser.get("/api/v1/site", headers={"sec-fetch-site": "same-origin"}).status_code == 404  # none is here


@pytest.mark.parametrize("path", ["/", "/page/main.js", "/api/recordings", "/nowhere"])
def test_every_answer_carries_the_security_headers(browser, path):
    headers = browser.get(path).headers
    assert headers["content-security-policy"].startswith("default-src 'self'")
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    assert "set-cookie" not in headers


@pytest.mark.parametrize("host", ["localhost:8080", "127.0.0.1", "127.5.5.5:1", "[::1]:8080", "LOCALHOST."])
def test_the_own_machine_may_call_it_by_any_of_its_names(browser, host):
    assert browser.get("/", headers={"host": host}).status_code == 200


@pytest.mark.parametrize(
    "host", ["evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "192.168.1.5", "[::2]", "", "a b", "@"]
)
def test_a_rebound_name_is_refused(browser, host):
    assert browser.get("/", headers={"host": host}).status_code == 421
    with pytest.raises(WebSocketDisconnect), browser.websocket_connect(SOCKET, headers={"host": host}):
        pass


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://localhost:9999", "file://", "http://[bad"])
def test_other_sites_pages_are_refused(browser, origin):
    assert browser.get("/api/recordings", headers={"origin": origin}).status_code == 403
    assert browser.put("/api/zones", json={"zones": []}, headers={"origin": origin}).status_code == 403
    with pytest.raises(WebSocketDisconnect), browser.websocket_connect(SOCKET, headers={"origin": origin}):
        pass
    assert browser.get("/api/recordings", headers={"origin": HERE}).status_code == 200


def test_strangers_need_the_token(stranger):
    for path in ("/", "/page/main.js", "/api/recordings", "/api/floor_plan"):
        assert stranger.get(path).status_code == 401
        assert stranger.get(path, params={"token": TOKEN + "x"}).status_code == 401
        assert stranger.get(path, params={"token": ""}).status_code == 401
    with pytest.raises(WebSocketDisconnect), stranger.websocket_connect(STRANGE_SOCKET):
        pass
    with pytest.raises(WebSocketDisconnect), stranger.websocket_connect(f"{STRANGE_SOCKET}?token=wrong"):
        pass


def test_the_token_in_the_address_becomes_a_cookie_that_scripts_cannot_read(stranger):
    answer = stranger.get("/", params={"token": TOKEN})
    cookie = answer.headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Strict" in cookie
    assert TOKEN not in cookie
    assert stranger.get("/api/recordings").status_code == 200
    with stranger.websocket_connect(STRANGE_SOCKET, headers={"origin": "http://192.168.1.5:8080"}) as socket:
        assert socket.receive_json()["type"] == "hello"


def test_a_wrong_cookie_does_not_help(stranger):
    stranger.cookies.set("skyless-8080", "0" * 64)
    assert stranger.get("/").status_code == 401
    stranger.cookies.set("skyless-8080", TOKEN)
    assert stranger.get("/").status_code == 401


@pytest.mark.parametrize(("host", "status"), [("hall.example:8080", 200), ("10.0.0.1", 200), ("evil.example", 421)])
def test_strangers_may_call_it_by_its_names_only(stranger, host, status):
    assert stranger.get("/", params={"token": TOKEN}, headers={"host": host}).status_code == status


def test_zones_are_stored(browser, live):
    zone = {"id": "desk", "name": "Desk", "polygon_m": [[0, 0], [1, 0], [1, 1]], "colour": None, "floor": 2}
    answer = browser.put("/api/zones", json={"zones": [zone]})
    assert answer.status_code == 200
    assert answer.json() == {"zones": [zone]}
    assert live.monitor.zones[0].id == "desk"


def test_wrong_zones_are_refused_and_nothing_changes(browser, live):
    live.store_zones((SQUARE,))
    for body in (b"", b"{}", b'{"zones":[{"id":"a","name":"A","polygon_m":[[0,0],[1,1]]}]}', b"\xff"):
        answer = browser.put("/api/zones", content=body)
        assert answer.status_code == 400
        assert answer.json()["error"]
    assert browser.put("/api/zones", content=b" " * 1_000_001).status_code == 413
    assert browser.post("/api/zones", json={"zones": []}).status_code == 405
    assert live.monitor.zones == (SQUARE,)


@pytest.mark.parametrize(
    ("image", "kind"), [(b"\x89PNG\r\n\x1a\nrest", "image/png"), (b"\xff\xd8\xff\xe0rest", "image/jpeg")]
)
def test_the_floor_plan(browser, live, image, kind):
    assert browser.get("/api/floor_plan").status_code == 404
    live.plans[None] = image
    answer = browser.get("/api/floor_plan")
    assert (answer.content, answer.headers["content-type"]) == (image, kind)
    live.plans[None] = b"<svg onload='alert(1)'>"
    assert browser.get("/api/floor_plan").status_code == 404


def test_overlays_before_the_site_is_known_and_wrong_ones(browser, live):
    assert browser.get("/api/overlay?kind=pdop").status_code == 404
    assert browser.get("/api/overlay?kind=magic").status_code == 400
    for step in ("0", "-1", "nan", "inf", "x", ""):
        answer = browser.get("/api/overlay", params={"kind": "pdop", "step_m": step})
        assert answer.status_code == 400
        assert "step_m" in answer.json()["error"]


@pytest.mark.site
def test_a_site_with_anchors_elsewhere(browser, live, wire):
    """Its overlay is another one, it has a sheet, and what cannot be is refused."""
    assert browser.post("/api/sheet").status_code == 404
    live.site = site_message(lab_site(), simulated=True, unix_s=1.0)
    anchor = live.site.site.anchors[0]
    moved = {"anchors": [{"id": anchor.id, "x_m": 3.0, "y_m": 4.0, "z_m": 2.5}]}
    services = browser.app.state.services
    try:
        here, there = (
            browser.request(verb, "/api/overlay?kind=sigma&step_m=2", json=body)
            for verb, body in (("GET", None), ("POST", moved))
        )
        assert here.status_code == there.status_code == 200
        assert here.json()["values"] != there.json()["values"]
        sheet = browser.post("/api/sheet", json=moved)
        assert (sheet.status_code, sheet.headers["content-type"]) == (200, "application/pdf")
        assert sheet.content.startswith(b"%PDF-")
    finally:
        services.overlays.stop()
        services.sheets.stop()
    second = live.site.site.anchors[1]
    on_another = {"anchors": [{"id": anchor.id, "x_m": second.x_m, "y_m": second.y_m, "z_m": second.z_m}]}
    for body in (b"{", b'{"anchors": [{"id": 1}]}', json.dumps(on_another).encode()):
        answer = browser.post("/api/overlay?kind=sigma", content=body)
        assert answer.status_code == 400
        assert answer.json()["error"]
    assert not wire.published


def test_without_a_folder_there_are_no_recordings(browser):
    assert browser.get("/api/recordings").json() == []
    for path in ("/api/recordings/x.mcap", "/api/recordings/x.mcap/states?from_s=0&to_s=1"):
        assert browser.get(path).status_code == 404
        assert browser.get(path).json()["error"]


def test_the_live_stream(browser, live):
    with browser, browser.websocket_connect(SOCKET) as socket:
        assert socket.receive_json()["type"] == "hello"
        assert socket.receive_json()["type"] == "mqtt"
        kinds = []
        while "health" not in kinds:  # the last one
            kinds.append(socket.receive_json()["type"])
        assert {"condition", "log", "assets"} <= set(kinds)
        socket.send_text("ping")
        assert socket.receive_json() == {"type": "pong"}
        assert len(live.pages) == 1
        browser.portal.call(_fix_and_tick, live)
        messages = [socket.receive_json() for _ in range(3)]  # health, condition, state
        assert [message["tags"][0][0] for message in messages if message["type"] == "state"] == ["t1"]
        (page,) = live.pages
        browser.portal.call(page.close, "this page was idle")
        with pytest.raises(WebSocketDisconnect) as closed:
            while True:
                socket.receive_json()
        assert (closed.value.code, closed.value.reason) == (1001, "this page was idle")


async def _fix_and_tick(live):
    live._link.deliver(topics.fix_topic(SITE_ID, "t1"), fix())
    live.tick()


def test_a_page_that_went_away_is_forgotten(browser, live):
    with browser:
        for _ in range(3):
            with browser.websocket_connect(SOCKET) as socket:
                socket.receive_json()
        for _ in range(200):
            if not live.pages:
                break
            browser.portal.call(asyncio.sleep, 0.01)
    assert not live.pages


def test_one_page_too_many_is_closed_with_the_reason(browser, live, times):
    pages = [live.open_page("testclient") for _ in range(LIMITS.pages_per_address)]
    with browser.websocket_connect(SOCKET) as socket, pytest.raises(WebSocketDisconnect) as closed:
        socket.receive_json()
    assert (closed.value.code, closed.value.reason[:28]) == (1013, "too many pages are open: 100")
    assert live.pages == set(pages)
    live.open_page("10.0.0.7")  # another computer is not shut out


def test_an_idle_page_makes_room(browser, live, times):
    pages = [live.open_page("testclient") for _ in range(LIMITS.pages_per_address)]
    times.move(IDLE_S - 1.0)
    for page in pages[1:]:
        live.keep_page(page)
    times.move(2.0)
    with browser.websocket_connect(SOCKET) as socket:
        assert socket.receive_json()["type"] == "hello"
        assert pages[0].closed
        assert pages[0] not in live.pages
        assert not any(page.closed for page in pages[1:])


def test_all_computers_together_open_a_limited_number_of_pages(live, times):
    for k in range(LIMITS.pages):
        live.open_page(f"10.0.0.{k}")
    with pytest.raises(TooManyPagesError, match=f"0 of this computer, {LIMITS.pages} in all"):
        live.open_page("10.0.1.1")
    times.move(IDLE_S)
    live.open_page("10.0.1.1")
    assert len(live.pages) == LIMITS.pages


def test_a_page_that_sends_nothing_for_minutes_is_closed(live, times):
    silent, active = live.open_page(), live.open_page()
    times.move(GONE_S - 1.0)
    live.keep_page(active)
    times.move(2.0)
    live.tick()
    assert (silent.closed, silent.reason, active.closed) == (True, "this page was idle", False)
    assert live.pages == {active}


HEADER = st.sampled_from(["host", "origin", "cookie", "authorization", "x-forwarded-host"])
VALUE = st.binary(max_size=60) | st.sampled_from(
    [b"192.168.1.5", b"localhost:8080", b"skyless=1", b"Bearer x", b"http://["]
)


@given(st.lists(st.tuples(HEADER, VALUE), max_size=6), st.binary(max_size=40), st.sampled_from(["http", "websocket"]))
def test_without_the_token_every_request_of_a_stranger_is_refused(headers, query, kind):
    """No header or query raises, or passes without the token."""
    sent = []

    async def inside(scope, receive, send):
        raise AssertionError("the request was let through")

    async def send(message):
        sent.append(message)

    scope = {
        "type": kind,
        "path": "/",
        "query_string": query,
        "headers": [(b"host", b"192.168.1.5")] + [(name.encode(), value) for name, value in headers],
    }
    asyncio.run(Guard(inside, AccessRules(TOKEN, remote=True))(scope, None, send))
    assert sent[0].get("status", 403) in {401, 403, 421}
    assert sent[0]["type"] in {"http.response.start", "websocket.close"}


EARTH = GeoreferenceSite(latitude_deg=48.137, longitude_deg=11.576, height_m=520.0, heading_deg=30.0)
EARTHLY = replace(SITE, site=replace(SITE.site, georeference=EARTH))


def test_maps_get_the_tags_as_geojson(browser, live, wire, times):
    wire.deliver(topics.site_topic(SITE_ID), EARTHLY)
    wire.deliver(topics.fix_topic(SITE_ID, "t1"), fix(std_m=0.02, position_m=(2.0, 3.0, 1.5)))
    wire.deliver(topics.fix_topic(SITE_ID, "t2"), fix("t2", alert="alert-limit-exceeded"))
    times.move(2.0)
    wire.deliver(topics.fix_topic(SITE_ID, "t3"), fix("t3", velocity_mps=None, unix_s=times.unix_s))
    answer = browser.get("/fixes.geojson")
    assert answer.headers["content-type"] == "application/geo+json"
    whole = answer.json()
    first, second = whole["features"]
    assert (whole["type"], first["type"], first["id"], second["id"]) == ("FeatureCollection", "Feature", "t1", "t3")
    longitude_deg, latitude_deg, height_m = first["geometry"]["coordinates"]
    assert geodetic((2.0, 3.0, 1.5), EARTH) == pytest.approx((latitude_deg, longitude_deg, height_m), abs=1e-8)
    assert first["properties"]["age_s"] == pytest.approx(2.0, abs=0.01)
    assert first["properties"]["horizontal_std_m"] == pytest.approx(0.02)
    assert second["properties"]["speed_mps"] is None
    times.move(1.0)
    assert [feature["id"] for feature in browser.get("/fixes.geojson").json()["features"]] == ["t3"]


def test_a_tag_whose_covariance_is_none_takes_no_other_off_the_map(browser, live, wire):
    wire.deliver(topics.site_topic(SITE_ID), EARTHLY)
    wire.deliver(topics.fix_topic(SITE_ID, "t1"), fix(covariance_m2=(-1.0,) * 9))
    wire.deliver(topics.fix_topic(SITE_ID, "t2"), fix("t2"))
    first, second = browser.get("/fixes.geojson").json()["features"]
    assert first["properties"]["horizontal_std_m"] == 0.0
    assert second["properties"]["horizontal_std_m"] > 0.0
