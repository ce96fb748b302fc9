"""omlox Hub 2.0: what a hub gets of a site, and what clients of a hub get, over real connections.

Fields and types are those of the public OpenAPI document, omlox_Hub_API_2.0.0.json.
"""

import asyncio
import json
import urllib.error
import urllib.request
from contextlib import asynccontextmanager
from datetime import datetime
from math import dist
from uuid import UUID

import pytest
from bridged_values import BARE_SITE, BERLIN, SITE, a_fix, fixes, georeferences
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs
from msgspec.json import encode
from websockets.asyncio.client import connect
from websockets.asyncio.server import serve

from skyless.bridges import omlox_push
from skyless.bridges._omlox import location
from skyless.bridges.omlox_push import MAX_BATCH, OmloxPush
from skyless.bridges.omlox_serve import OmloxServer
from skyless.bridges.target import BridgeContext, TargetUrl
from skyless.bridges.targets import open_route
from skyless.core.earth import east_north_up, east_north_up_of
from skyless.core.errors import SkylessError
from skyless.core.site import FloorSite
from skyless.run.mqtt.messages import Asset, Zone
from support.waiting import until

DOCK = Zone("z1", "Dock", ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)))
FORK = {"tag1": Asset("tag1", "Fork 7"), "tag2": Asset("tag2")}
HALL = structs.replace(BARE_SITE, zones=(DOCK,), assets=FORK, simulated=False)
REQUIRED = {"position": dict, "source": str, "provider_type": str, "provider_id": str}
OPTIONAL = {
    "timestamp_generated": str, "crs": str, "elevation_ref": str, "accuracy": float, "floor": int, "speed": float,
    "course": float, "trackables": list, "properties": dict,
}  # fmt: skip
ANSWER_S = 20.0


def as_json(value):
    return json.loads(encode(value))


@given(fixes(), st.none() | georeferences)
def test_a_location_has_the_fields_and_types_of_the_standard(fix, earth):
    found = as_json(location(fix, structs.replace(HALL, georeference=earth), "zone"))
    assert REQUIRED.keys() <= found.keys() <= REQUIRED.keys() | OPTIONAL.keys()
    for key, value in found.items():
        assert type(value) is (REQUIRED | OPTIONAL)[key]
    assert found["position"]["type"] == "Point"
    assert len(found["position"]["coordinates"]) == 3
    assert datetime.fromisoformat(found["timestamp_generated"]).utcoffset().total_seconds() == 0.0
    assert found["provider_id"] == f"skyless-7-{fix.tag}"
    assert 0.0 <= found.get("course", 0.0) < 360.0
    assert (found["crs"], found["elevation_ref"]) == (("local", "floor") if earth is None else ("EPSG:4326", "wgs84"))


def test_course_floor_accuracy_and_what_is_simulated():
    """BERLIN's y axis points to 30 degrees: a tag that moves along it has this course."""
    moving = a_fix(velocity_mps=(0.0, 1.0, 0.0), covariance_m2=(0.04, 0, 0, 0, 0.01, 0, 0, 0, 0.01))
    found = location(moving, SITE, "zone")
    assert (found["course"], found["speed"], found["accuracy"]) == (30.0, pytest.approx(1.0), 0.2)
    assert found["properties"] == {"simulated": True}
    floors = (FloorSite(0, 0.0), FloorSite(1, 3.0))
    upstairs = location(a_fix(position_m=(1.0, 2.0, 4.5)), structs.replace(HALL, floors=floors), "zone")
    assert (upstairs["floor"], upstairs["position"]["coordinates"]) == (1, [1.0, 2.0, 1.5])
    assert "course" not in upstairs


@asynccontextmanager
async def running(target):
    task = asyncio.create_task(target.run())
    try:
        yield target
    finally:
        task.cancel()
        await asyncio.wait([task])


@asynccontextmanager
async def served(site=HALL):
    server = OmloxServer("omlox+serve://:0", "127.0.0.1", 0)
    server.on_site(site)
    async with running(server):
        await until(lambda: server.port)
        yield server


def get(server, path, method="GET", data=None):
    """Status and JSON."""
    request = urllib.request.Request(f"http://127.0.0.1:{server.port}/v2/{path}", data, method=method)
    try:
        with urllib.request.urlopen(request, timeout=ANSWER_S) as answer:
            return answer.status, json.load(answer)
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)


@asynccontextmanager
async def subscribed(server, topic="location_updates", **params):
    async with connect(f"ws://127.0.0.1:{server.port}/v2/ws/socket") as client:
        await client.send(json.dumps({"event": "subscribe", "topic": topic, "params": params}))
        answer = json.loads(await asyncio.wait_for(client.recv(), ANSWER_S))
        assert (answer["event"], answer["topic"]) == ("subscribed", topic)
        yield client, answer["subscription_id"]


async def payload(client):
    message = json.loads(await asyncio.wait_for(client.recv(), ANSWER_S))
    assert message.keys() == {"event", "topic", "payload"}
    return message["payload"]


@pytest.mark.parametrize("site", [HALL, structs.replace(HALL, georeference=BERLIN)], ids=["local", "earth"])
def test_a_thousand_locations_come_out_as_they_went_in(site):
    points = [(0.013 * n, 40.0 - 0.07 * n, 0.0021 * n) for n in range(1000)]
    sent = [a_fix(serial=n, unix_s=1_795_000_000.0 + n / 8, position_m=point) for n, point in enumerate(points)]

    async def run():
        async with served(site) as server, subscribed(server, crs="local" if site is HALL else "EPSG:4326") as (one, _):
            for fix in sent:
                server.on_fix(fix)
                (found,) = await payload(one)
                assert datetime.fromisoformat(found["timestamp_generated"]).timestamp() == fix.unix_s
                received.append(found["position"]["coordinates"])

    received = []
    asyncio.run(run())
    assert len(received) == 1000
    for point, (x, y, z) in zip(points, received, strict=True):
        back, wanted = (x, y, z), point
        if site is not HALL:
            back, wanted = east_north_up_of(y, x, z, BERLIN), east_north_up(point, BERLIN.heading_deg)
        assert dist(back, wanted) < 1e-3


def test_the_reading_paths():
    async def run():
        async with served() as server:
            server.on_fix(a_fix())
            server.on_fix(a_fix(tag="tag2"))

            async def read(*args):
                return await asyncio.to_thread(get, server, *args)

            for kind, number in (("zones", 1), ("fences", 1), ("providers", 2), ("trackables", 1)):
                (_, ids), (_, whole) = await read(kind), await read(f"{kind}/summary")
                assert [one["id"] for one in whole] == ids
                assert len(ids) == number
                assert await read(f"{kind}/{ids[0]}") == (200, whole[0])
                assert kind == "providers" or all(map(UUID, ids))
            (_, (owner,)), (_, (zone,)) = await read("trackables/summary"), await read("zones/summary")
            assert (owner["name"], owner["location_providers"]) == ("Fork 7", ["skyless-7-tag1"])
            _, locations = await read("providers/locations")
            assert [one["provider_id"] for one in locations] == ["skyless-7-tag1", "skyless-7-tag2"]
            assert locations[0]["source"] == zone["id"]
            assert await read("providers/skyless-7-tag2/location") == (200, locations[1])
            assert await read(f"trackables/{owner['id']}/location") == (200, locations[0])
            assert await read(f"trackables/{owner['id']}/locations") == (200, [locations[0]])
            for path, status in {
                "fences/x": 404,
                "cars": 404,
                "trackables/x/location": 404,
                "fences?crs=x": 400,
            }.items():
                code, error = await read(path)
                assert (code, error["code"]) == (status, status)
            for method in ("PUT", "POST", "DELETE"):
                assert (await read("providers/locations", method, b"[]"))[0] == 405

    asyncio.run(run())


def test_a_zone_on_the_earth_has_its_control_points_and_ids_stay():
    server = OmloxServer("omlox+serve://:0", "127.0.0.1", 0)
    server.on_site(SITE)
    _, (first,) = server.read("/v2/zones/summary", {})
    points = first["ground_control_points"]
    assert len(points) == 8
    assert points[0] == pytest.approx([BERLIN.longitude_deg, BERLIN.latitude_deg], abs=1e-9)
    server.on_site(structs.replace(SITE, name="renamed"))
    assert server.read("/v2/zones", {}) == (200, [first["id"]])


def test_fences_and_motions():
    """The tag enters, and leaves by falling silent."""

    async def run():
        async with (
            served() as server,
            subscribed(server, "fence_events") as (fences, _),
            subscribed(server, "trackable_motions") as (motions, _),
        ):
            for serial in range(3):
                server.on_fix(a_fix(serial=serial, unix_s=1000.0 + serial, position_m=(2.0, 2.0, 1.0)))
            (entry,) = await payload(fences)
            (motion,) = await payload(motions)
            _, (fence,) = server.read("/v2/fences/summary", {})
            _, (owner,) = server.read("/v2/trackables", {})
            assert (entry["event_type"], entry["fence_id"]) == ("region_entry", str(fence["id"]))
            assert (entry["provider_id"], entry["trackable_id"]) == ("skyless-7-tag1", str(owner))
            assert (motion["id"], motion["location"]["provider_id"]) == (str(owner), "skyless-7-tag1")
            server.on_site(structs.replace(HALL, zones=()))
            (leaving,) = await payload(fences)
            assert leaving["event_type"] == "region_exit"
            assert "exit_time" in leaving
            assert "entry_time" not in leaving

    asyncio.run(run())


def test_nothing_comes_after_unsubscribing_and_errors_have_their_codes():
    async def run():
        async with served() as server, subscribed(server) as (client, number):
            server.on_fix(a_fix())
            (found,) = await payload(client)
            assert found["provider_id"] == "skyless-7-tag1"
            await client.send(json.dumps({"event": "unsubscribe", "subscription_id": number}))
            answer = json.loads(await asyncio.wait_for(client.recv(), ANSWER_S))
            assert answer == {"event": "unsubscribed", "topic": "location_updates", "subscription_id": number}
            server.on_fix(a_fix())
            for text, code in ERRORS.items():
                await client.send(text)
                error = json.loads(await asyncio.wait_for(client.recv(), ANSWER_S))
                assert (error["event"], error["code"]) == ("error", code)
                assert error["description"]

    asyncio.run(run())


ERRORS = {
    '{"event": "hello"}': 10000,
    '{"event": "subscribe", "topic": "cars"}': 10001,
    '{"event": "subscribe", "topic": "location_updates", "params": {"crs": "EPSG:25832"}}': 10002,
    '{"event": "subscribe", "topic": "fence_events", "params": {"colour": "red"}}': 10002,
    '{"event": "unsubscribe", "subscription_id": 77}': 10003,
    '{"event": "message", "topic": "location_updates", "payload": []}': 10004,
    "{": 10005,
    "[]": 10005,
}


def test_a_hub_gets_batches_with_the_token_and_its_errors_are_told(tmp_path, monkeypatch):
    """The stand-in refuses the first message and closes; after that it only reads."""
    monkeypatch.setattr(omlox_push, "_PAUSE_S", 0.01)
    token, messages, lines = tmp_path / "token", [], []
    token.write_text("abc\n")
    token.chmod(0o600)

    async def hub(connection):
        assert connection.request.path == "/v2/ws/socket"
        async for text in connection:
            messages.append(json.loads(text))
            if len(messages) == 1:
                await connection.send('{"event": "error", "code": 10004, "description": "no"}')
                return

    async def run():
        async with serve(hub, "127.0.0.1", 0) as server:
            port = next(iter(server.sockets)).getsockname()[1]
            zone = "A8C01D4C-333A-4406-B2E9-A174AD295CB1"
            url = TargetUrl(f"omlox+ws://127.0.0.1:{port}/v2/ws/socket?zone={zone}&token_file={token}")
            push = OmloxPush(url, lines.append)
            push.on_site(HALL)
            for serial in range(1000):
                push.on_fix(a_fix(serial=serial, position_m=(serial / 100, 2.0, 1.5)))
            async with running(push):
                await until(lambda: push.dropped["refused-by-hub"])
                push.on_fix(a_fix(position_m=(50.0, 2.0, 1.5)))
                await until(lambda: messages[-1]["payload"][-1]["position"]["coordinates"][0] == 50.0)
            assert push.dropped["refused-by-hub"] == 1

    asyncio.run(run())
    assert any("error 10004: no" in line for line in lines)
    for message in messages:
        assert (message["event"], message["topic"]) == ("message", "location_updates")
        assert message["params"] == {"token": "abc"}
        assert 1 <= len(message["payload"]) <= MAX_BATCH
        assert {one["source"] for one in message["payload"]} == {"A8C01D4C-333A-4406-B2E9-A174AD295CB1"}


def test_what_waits_too_long_is_dropped_oldest_first_and_counted(monkeypatch):
    monkeypatch.setattr(omlox_push, "MAX_WAITING", 3)
    push = OmloxPush(TargetUrl("omlox+ws://127.0.0.1:1/v2/ws/socket"), lambda _line: None)
    push.on_site(HALL)
    for x in range(5):
        push.on_fix(a_fix(position_m=(float(x), 0.0, 0.0)))
    assert [one["position"]["coordinates"][0] for one in push._waiting] == [2.0, 3.0, 4.0]
    assert push.dropped["not-sent"] == 2
    assert {one["source"] for one in push._waiting} == {"skyless-7"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("omlox+ws://hub", "it should be omlox+ws://HOST/v2/ws/socket"),
        ("omlox+wss:/v2/ws/socket", "it should be omlox+wss://HOST/v2/ws/socket"),
        ("omlox+ws://hub/v2/ws/socket?zone=7", "with a UUID as zone="),
        ("omlox+ws://hub/v2/ws/socket?token=7", "has 'token'; its keys are hz, tag, token_file, zone"),
        ("omlox+ws://hub/v2/ws/socket?hz=20", "a number from 0.1 to 10"),
        ("omlox+ws://hub/v2/ws/socket?token_file=/nowhere/t", "cannot be read"),
        ("omlox+serve://:8081/v2", "it should be omlox+serve://HOST:PORT"),
    ],
)
def test_a_wrong_address_is_named(text, words):
    with pytest.raises(SkylessError) as raised:
        open_route(text, BridgeContext(log=lambda _line: None))
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)
