"""The page of the sites at a hub: their table, what is shown after a cut, and that it only reads."""

import asyncio
import contextlib
import json
import time

import httpx2 as httpx
import msgspec
import pytest
from dashboard_builders import SITE, SQUARE, fix
from msgspec.structs import replace
from starlette.exceptions import HTTPException
from websockets.asyncio.client import connect as websocket

from skyless.page import hub
from skyless.page.live import LiveSite
from skyless.run.gather.subjects import NatsAddress
from skyless.run.hub import LISTEN_S, HubLink, HubSites, make_hub_streams
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import StatusMessage, ZonesMessage
from skyless.run.site_table import THRESHOLDS
from support.processes import SKYLESS, running_program
from support.small_hub import client_of, running_hub, site
from support.waiting import running, until

NUMBER = 7
HALL = msgspec.structs.replace(SITE, site=replace(SITE.site, id=NUMBER))


def said(**fields):
    counts = dict.fromkeys(("unix_s", "names", "fixes", "batches", "waiting", "cuts"), 1)
    counts |= {"host": "h", "version": "0.2", "site": "", "simulated": True, "drops": {}, "online": {"anchor": 4}}
    return json.dumps(counts | {"tags_heard": 9, "versions": {"0.2": 5}} | fields)


def test_the_table_has_trouble_first_and_nothing_is_good_that_is_not_heard():
    table = HubSites(None, now_s=0.0)
    for number in (1, 2, 3, 4, 5):
        table.known.add(topics.site_topic(number), msgspec.json.encode({"site": {"name": f"Hall {number}"}}))
    assert {site.condition for site in table.sites(1.0)} == {"unknown"}
    table.add_summary(1, said(condition="good"), 100.0, 5.0)
    table.add_summary(2, said(condition="degraded", reasons=["anchor 3 is silent", "another"]), 100.0, 5.0)
    table.add_summary(3, said(condition="good"), 100.0 + THRESHOLDS.site_s - 180.0, 5.0)
    table.add_summary(4, said(), 100.0, 5.0)  # of an older version
    table.add_summary(5, b"no JSON", 100.0, 5.0)
    table.add_summary(6, said(condition="bad", site="not in the stream yet"), 100.0, 5.0)
    found = table.sites(100.0 + THRESHOLDS.site_s)
    assert [(one.number, one.condition) for one in found] == [
        (6, "bad"), (3, "cut"), (5, "cut"), (2, "degraded"), (4, "unknown"), (1, "good"),
    ]  # fmt: skip
    assert found[1].reason == "not heard for 3 min"
    assert (found[1].tags_heard, found[1].versions) == (None, None)
    assert found[3].reason == "anchor 3 is silent"
    assert (found[5].name, found[5].tags_heard, found[5].anchors_online, found[5].versions) == (
        "Hall 1",
        9,
        4,
        {"0.2": 5},
    )
    assert {site.condition for site in table.sites(1e3 + LISTEN_S)} == {"cut"}


async def test_a_site_is_let_go_when_nobody_looks_and_the_next_look_connects_it_again(monkeypatch):
    monkeypatch.setattr(hub, "LET_GO_S", 0.0)
    monkeypatch.setattr(hub, "_CHECK_S", 0.01)
    for one in (HubLink, HubSites):
        monkeypatch.setattr(one, "run", lambda *_: asyncio.sleep(60))
    shown = hub.ShownSites(NatsAddress("nats://none"), "here", lambda: LiveSite("here", "nats://none", at_hub=True))
    shown.known.known.add(topics.site_topic(NUMBER), msgspec.json.encode({"site": {"name": "Hall"}}))
    async with running(shown.run()):
        live = shown.of(str(NUMBER))
        page = live.open_page()
        await asyncio.sleep(0.1)
        assert shown.all == [live]
        live.pages.discard(page)
        await until(lambda: not shown.all)
        assert shown.of(str(NUMBER)) is not live
        with pytest.raises(HTTPException, match="number of a site at this hub"):
            shown.of("8")


@pytest.mark.site
async def test_a_page_that_is_started_after_a_cut_shows_the_site_and_changes_nothing(tmp_path):
    with running_hub(tmp_path) as (servers, _):
        address = servers.address("plant")
        async with site(tmp_path, servers.leaf("plant", NUMBER)) as broker:
            hub_client, client = await client_of(address), await client_of(broker.nats)
            async with asyncio.timeout(60), running(_walk(client)):
                await make_hub_streams(hub_client, servers, "plant")
                async with httpx.AsyncClient() as http, _dashboard(address, http):
                    await _until(http, "sites", lambda found: found and found[0]["name"] == HALL.site.name)
                    await _until(http, "sites", lambda found: found[0]["condition"] not in {"unknown", "cut"})
                    await _until(http, f"v1/tags?site={NUMBER}", lambda found: found and found[0]["fix"])
                while (await hub_client.jetstream().stream_info("STATE_7")).state.messages < 3:
                    await asyncio.sleep(0.1)
            for one in (hub_client, client):
                await one.close()
        async with httpx.AsyncClient() as http, _dashboard(address, http) as page, asyncio.timeout(60):
            await _until(http, "sites", lambda found: found and found[0]["condition"] == "cut")
            assert (await http.get("/api/v1/site")).status_code == 404
            async with websocket(f"{page.replace('http', 'ws')}live?site={NUMBER}") as socket:
                lacking = {'"level":"bad","text":"site 7 is not heard', '"name":"t1"', '"name":"Desk"'}
                while lacking:
                    text = await socket.recv()
                    assert '"level":"good"' not in text
                    lacking = {words for words in lacking if words not in text}
                assert (await http.get(f"/api/v1/site?site={NUMBER}")).json()["site"]["id"] == NUMBER
                await _until(http, f"v1/zones?site={NUMBER}", lambda found: [one["id"] for one in found] == [SQUARE.id])
            for method, path in (
                ("PUT", "zones"),
                ("PUT", "floor_plan"),
                ("POST", "survey/save"),
                ("PUT", "v1/assets"),
            ):
                answer = await http.request(method, f"/api/{path}?site={NUMBER}", content=b"{}")
                assert answer.status_code == 403
                assert "only reads" in answer.json()["error"]


async def _walk(site):
    """A site with a zone and a tag."""
    zones, status = ZonesMessage((SQUARE,), HALL.site.name), StatusMessage(True, "tag", "t1", unix_s=1.0)
    while True:
        for subject, message in {
            "site": HALL,
            "zones": zones,
            "tag.t1.status": status,
            "tag.t1.fix": fix("t1", time.time()),
        }.items():
            await site.publish(f"skyless.v1.{NUMBER}.{subject}", msgspec.json.encode(message))
        await asyncio.sleep(0.1)


@contextlib.asynccontextmanager
async def _dashboard(address, http):
    command = (*SKYLESS, "dashboard", "--json", "--hub", str(address).replace("@", f":{address.password}@"))
    async with running_program(*command, stdout=asyncio.subprocess.PIPE) as process:
        page = json.loads(await process.stdout.readline())["page"]
        http.base_url = page
        yield page


async def _until(http, path, is_so):
    while not is_so((await http.get(f"/api/{path}")).json().get(path.split("?")[0].removeprefix("v1/"), [])):
        await asyncio.sleep(0.1)
