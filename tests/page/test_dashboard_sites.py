"""Several sites on one broker: a page shows one that is alive, of one site only, and another where it is asked to."""

import msgspec
import pytest
from dashboard_builders import SITE, SQUARE, Times, Wire, browser_of, drained, of
from starlette.exceptions import HTTPException

from skyless.page import sites as sites_module
from skyless.page.live import LiveSite
from skyless.page.sites import LiveSites
from skyless.run.find_site import SiteOnBroker
from skyless.run.mqtt import topics
from skyless.run.web import PAGE as LIMITS
from skyless.run.web import PageLimits


class Stage:
    """Sites without a broker: what is attached gets its own site's message, as the broker would send it."""

    def __init__(self):
        self.times, self.wires = Times(), {}
        self.sites = LiveSites(self.make(), self.make)
        self.sites._connect = self.connect

    def make(self):
        return LiveSite("here", "mqtt://broker:1", None, lambda: self.times.now_s, lambda: self.times.unix_s)

    def connect(self, live, number):
        self.wires[number] = Wire()
        live.attach(self.wires[number], number)
        message = msgspec.structs.replace(SITE, site=msgspec.structs.replace(SITE.site, id=number, name=f"s{number}"))
        self.wires[number].deliver(topics.site_topic(number), message)

    def on_broker(self, **online):
        self.sites.on_sites([SiteOnBroker(int(name[1:]), name, count) for name, count in online.items()])

    def client(self):
        return browser_of(self.sites, base_url="http://localhost")


@pytest.fixture
def stage():
    return Stage()


def number_of(live):
    return live.site and live.site.site.id


def test_nothing_of_a_dead_site_is_shown_before_one_is_alive(stage):
    stage.on_broker(s1=0)
    waiting = stage.sites.of(None)
    page = waiting.open_page()
    first = drained(waiting)
    assert (of("hello", first)[0]["site"], stage.wires) == (None, {})
    assert of("sites", first) == [{"type": "sites", "shown": None, "sites": [[1, "s1", False]]}]
    stage.on_broker(s1=0, s5=2)
    assert number_of(waiting) == 5
    later = drained(waiting, page)
    assert [message["site"]["site"]["id"] for message in of("site", later)] == [5]
    assert {"type": "sites", "shown": 5, "sites": [[1, "s1", False], [5, "s5", True]]} in later
    assert list(stage.wires) == [5]


def test_a_site_that_is_asked_for_has_a_state_of_its_own_and_the_first_keeps_waiting(stage):
    stage.on_broker(s1=0, s5=0)
    asked = stage.sites.of("5")
    assert number_of(asked) == 5
    assert asked is stage.sites.of("5")
    assert number_of(stage.sites.of(None)) is None
    stage.on_broker(s1=1, s5=0)
    assert number_of(stage.sites.of(None)) == 1
    assert number_of(stage.sites.of("5")) == 5
    assert {live.name for live in stage.sites.all} == {"here"}
    assert len(stage.sites.all) == 2


def test_a_page_without_a_choice_stays_where_programs_are_online(stage):
    stage.on_broker(s5=3)
    stage.on_broker(s1=1, s5=3)
    assert number_of(stage.sites.of(None)) == 5, "a site that comes later changes nothing"
    stage.on_broker(s1=1, s5=0)
    assert number_of(stage.sites.of(None)) == 1
    stage.on_broker(s1=0, s5=0)
    assert number_of(stage.sites.of(None)) == 1, "none is better"


@pytest.mark.parametrize("asked", ["7", "-1", "x", "٥", "5 ", "99999999999"])
def test_a_site_that_is_not_there_is_named(stage, asked):
    stage.on_broker(s5=1)
    with pytest.raises(HTTPException, match="no such site"):
        stage.sites.of(asked)
    assert stage.client().get("/fixes.geojson", params={"site": asked}).status_code == 404


def test_requests_and_pages_are_of_the_site_that_they_name(stage):
    stage.on_broker(s1=1, s5=1)
    client = stage.client()
    plan = b"\x89PNG\r\n\x1a\n" + bytes(8)
    stage.sites.of("5").plans[None] = plan
    assert client.get("/api/floor_plan", params={"site": "5"}).content == plan
    assert client.get("/api/floor_plan", params={"site": "1"}).status_code == 404
    assert client.get("/api/floor_plan").status_code == 404
    for query, shown in (("", 1), ("?site=5", 5), ("?site=1", 1), ("?site=7", 1)):
        with client.websocket_connect(f"ws://localhost/live{query}") as page:
            assert page.receive_json()["site"]["site"]["id"] == shown
    drawn = {"zones": [{"id": "a", "name": "A", "polygon_m": [[0, 0], [1, 0], [1, 1]]}], "site": "s5"}
    stage.sites.of("5").connected = True
    assert client.put("/api/zones", params={"site": "1"}, json=drawn).status_code == 400
    assert client.put("/api/zones", params={"site": "5"}, json=drawn).status_code == 200
    assert stage.sites.of("1").monitor.zones == ()


def test_a_server_of_one_site_shows_that_and_offers_none(stage):
    sites = LiveSites(stage.make())
    live = sites.of(None)
    assert of("sites", drained(live)) == []
    with pytest.raises(HTTPException):
        sites.of("1")


def test_twenty_sites_are_shown_and_those_that_nobody_looks_at_are_let_go(stage, monkeypatch):
    stage.on_broker(s0=1, **{f"s{number}": 0 for number in range(1, 300)})
    waits = [stage.sites.of(str(number)) for number in range(1, LIMITS.sites)]
    for number in range(LIMITS.sites, 300):
        with pytest.raises(HTTPException, match="20 sites are shown") as refused:
            stage.sites.of(str(number))
        assert refused.value.status_code == 503
    page, first = waits[0].open_page(), stage.sites.of(None)
    waits[1].monitor.zones = (SQUARE,)
    monkeypatch.setattr(sites_module, "LIMITS", PageLimits(site_idle_s=-1.0))
    stage.sites.let_go()
    assert set(stage.sites.all) == {first, waits[0], waits[1]}
    waits[0].pages.discard(page)
    stage.sites.let_go()
    assert set(stage.sites.all) == {first, waits[1]}
    assert number_of(stage.sites.of("250")) == 250
