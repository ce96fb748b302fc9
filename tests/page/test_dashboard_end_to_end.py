"""The dashboard as a program, over the embedded broker, with pages that read and pages that do not."""

import asyncio
import contextlib
import json
import signal
import time

import httpx2 as httpx
import msgspec
import pytest
import websockets
from dashboard_builders import SITE, SITE_ID, SQUARE, fix, truth

from skyless.run.broker import BrokerSettings, start_broker
from skyless.run.mqtt import topics
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import ZonesMessage
from support.processes import SKYLESS, free_port, running_program
from support.unread import unread_websocket
from support.waiting import running, until

pytestmark = pytest.mark.site

PATIENCE_S = 20.0


@contextlib.asynccontextmanager
async def dashboard(*arguments):
    """A running dashboard, and what it has printed."""
    command = (*SKYLESS, "dashboard", "--json", *arguments)
    async with running_program(*command, stdout=asyncio.subprocess.PIPE) as process:
        yield json.loads(await asyncio.wait_for(process.stdout.readline(), PATIENCE_S)), process


@contextlib.asynccontextmanager
async def site(address):
    """A node of the site, which has published the site."""
    link = Link(address, "air", site=SITE_ID, kind="ether")
    link.publish(topics.site_topic(SITE_ID), SITE, qos=1, retain=True)
    async with running(link.run()):
        yield link


async def walk(link, tags=1, step_s=0.05):
    """Fixes and truths for ever; every tag walks through the square and back."""
    for k in range(1_000_000):
        x = 2.0 if k // 40 % 2 else 8.0
        now_s = time.time()
        for n in range(tags):
            tag = f"t{n}"
            link.publish(topics.truth_topic(SITE_ID), truth(now_s, tag, (x, 2.0, 1.0)))
            link.publish(topics.fix_topic(SITE_ID, tag), fix(tag, now_s, (x, 2.02, 1.0), serial=k))
        await asyncio.sleep(step_s)


def live_page(output):
    return connect(output["page"].replace("http", "ws") + "live")


def connect(address):
    return websockets.connect(address, max_size=None)


async def next_of(page, kind_of_message, /, **fields):
    """The next message of a kind, with these fields."""
    async with asyncio.timeout(PATIENCE_S):
        async for text in page:
            message = json.loads(text)
            if message["type"] == kind_of_message and fields.items() <= message.items():
                return message
    raise AssertionError(f"the connection ended before a {kind_of_message}")


@pytest.mark.statistical
async def test_a_site_is_found_shown_and_watched(tmp_path):
    where = BrokerSettings(port=free_port(), data=tmp_path / "broker")
    broker = await start_broker(where)
    events, zones = [], []
    async with site(broker.address) as link:
        link.subscribe(topics.zone_event_topic(SITE_ID, "+"), lambda _, payload: events.append(json.loads(payload)), 1)
        link.subscribe(topics.zones_topic(SITE_ID), lambda _, payload: zones.append(payload), 1)
        async with dashboard("--mqtt", str(broker.address)) as (output, process), live_page(output) as page:
            hello = await next_of(page, "hello")
            shown = hello["site"] or (await next_of(page, "site"))["site"]
            assert shown["site"]["id"] == SITE_ID
            walking = asyncio.create_task(walk(link))
            row = (await next_of(page, "state"))["tags"][0]
            assert row[0] == "t0"
            assert row[10] == pytest.approx(0.02, abs=1e-3)
            async with httpx.AsyncClient(base_url=output["page"]) as http:
                answer = await http.put("/api/zones", content=msgspec.json.encode(ZonesMessage((SQUARE,))))
                assert answer.status_code == 200
                overlay = asyncio.create_task(http.get("/api/overlay?kind=sigma&step_m=1", timeout=300.0))
                event = await next_of(page, "zone_event", kind="enter")
                while (
                    not overlay.done()
                ):  # kernels may have to be compiled first, and a page that does not read is closed
                    await next_of(page, "state")
                assert len(overlay.result().json()["values"]) == 48
            assert (event["zone"], event["tag"]) == ("desk", "t0")
            await until(lambda: event | {"type": "zone_event"} in [seen | {"type": "zone_event"} for seen in events])
            assert json.loads(zones[-1])["zones"][0]["id"] == "desk"
            await broker.stop()
            assert (await next_of(page, "mqtt"))["connected"] is False
            broker = await start_broker(where)
            assert (await next_of(page, "mqtt"))["connected"] is True
            await next_of(page, "state")
            process.send_signal(signal.SIGTERM)
            assert await asyncio.wait_for(process.wait(), PATIENCE_S) == 0
        async with (
            dashboard("--mqtt", str(broker.address), "--site-id", str(SITE_ID)) as (output, _),
            live_page(output) as page,
        ):
            greeted = (await next_of(page, "hello"))["zones"]
            assert (greeted or (await next_of(page, "zones"))["zones"])[0]["id"] == "desk", "zones survive a restart"
        walking.cancel()
    await broker.stop()


@pytest.mark.statistical
async def test_a_page_that_does_not_read_delays_no_other(tmp_path):
    settings = BrokerSettings(port=free_port(), data=tmp_path / "broker")
    async with (
        await start_broker(settings) as broker,
        site(broker.address) as link,
        dashboard("--mqtt", str(broker.address)) as (output, process),
    ):
        walking = asyncio.create_task(walk(link, tags=100))
        port = int(output["page"].rstrip("/").rsplit(":", 1)[1])
        unread = [await unread_websocket(port, "/live") for _ in range(3)]
        async with live_page(output) as page:
            await next_of(page, "state")
            for _ in range(80):
                assert len((await next_of(page, "state"))["tags"]) <= 100
            process.send_signal(signal.SIGINT)
            assert await asyncio.wait_for(process.wait(), PATIENCE_S) == 0
        walking.cancel()
        for sock in unread:
            sock.close()


async def test_other_machines_need_the_token_that_is_printed():
    async with dashboard("--listen", f"0.0.0.0:{free_port()}") as (output, _):
        address = httpx.URL(output["page"])
        assert output["page"].endswith(f"?token={output['token']}")
        assert len(output["token"]) >= 20
        async with httpx.AsyncClient(base_url=f"http://127.0.0.1:{address.port}") as http:
            assert (await http.get("/api/recordings")).status_code == 401
            assert (await http.get("/api/recordings", params={"token": output["token"]})).status_code == 200
            assert (await http.get("/api/recordings")).status_code == 200, "by the cookie"
            assert (await http.get("/", headers={"host": "evil.example"})).status_code == 421
