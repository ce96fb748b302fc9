"""omlox Hub 2.0: what a hub gets of a site, over real connections.

Fields and types are those of the public OpenAPI document, omlox_Hub_API_2.0.0.json.
"""

import json
from datetime import datetime
from math import dist
from uuid import UUID

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs
from msgspec.json import encode
from websockets.asyncio.server import serve

from skyless.bridges import omlox
from skyless.bridges.omlox import MAX_BATCH, OmloxPush, location
from skyless.bridges.target import BridgeContext, TargetUrl
from skyless.core.earth import east_north_up, east_north_up_of
from skyless.core.site import FloorSite
from skyless.run.mqtt.messages import Asset
from support.bridged_values import BARE_SITE, BERLIN, SITE, a_fix, fixes, georeferences
from support.waiting import running, until

FORK = {"tag1": Asset("tag1", "Fork 7"), "tag2": Asset("tag2")}
HALL = structs.replace(BARE_SITE, assets=FORK, simulated=False)
REQUIRED = {"position": dict, "source": str, "provider_type": str, "provider_id": str}
OPTIONAL = {
    "timestamp_generated": str, "crs": str, "elevation_ref": str, "accuracy": float, "floor": int, "speed": float,
    "course": float, "trackables": list, "properties": dict,
}  # fmt: skip


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


@pytest.mark.parametrize("site", [HALL, structs.replace(HALL, georeference=BERLIN)], ids=["local", "earth"])
def test_a_thousand_locations_are_where_the_fixes_are(site):
    for n in range(1000):
        point = (0.013 * n, 40.0 - 0.07 * n, 0.0021 * n)
        fix = a_fix(serial=n, unix_s=1_795_000_000.0 + n / 8, position_m=point)
        found = as_json(location(fix, site, "zone"))
        assert datetime.fromisoformat(found["timestamp_generated"]).timestamp() == fix.unix_s
        x, y, z = found["position"]["coordinates"]
        back, wanted = (x, y, z), point
        if site is not HALL:
            back, wanted = east_north_up_of(y, x, z, BERLIN), east_north_up(point, BERLIN.heading_deg)
        assert dist(back, wanted) < 1e-3


def test_a_trackable_is_the_same_for_ever_and_only_of_a_tag_with_a_name():
    (first,) = as_json(location(a_fix(), HALL, "zone"))["trackables"]
    assert as_json(location(a_fix(serial=9), structs.replace(HALL, name="renamed"), "zone"))["trackables"] == [first]
    assert UUID(first)
    assert "trackables" not in as_json(location(a_fix(tag="tag2"), HALL, "zone"))


@pytest.mark.site
async def test_a_hub_gets_batches_with_the_token_and_its_errors_are_told(tmp_path, monkeypatch):
    """The stand-in refuses the first message and closes; after that it only reads."""
    monkeypatch.setattr(omlox, "_PAUSE_S", 0.01)
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

    async with serve(hub, "127.0.0.1", 0) as server:
        port = next(iter(server.sockets)).getsockname()[1]
        zone = "A8C01D4C-333A-4406-B2E9-A174AD295CB1"
        url = TargetUrl(f"omlox+ws://127.0.0.1:{port}/v2/ws/socket?zone={zone}&token_file={token}")
        push = OmloxPush(url, BridgeContext(lines.append))
        push.on_site(HALL)
        for serial in range(1000):
            push.on_fix(a_fix(serial=serial, position_m=(serial / 100, 2.0, 1.5)))
        async with running(push.run()):
            await until(lambda: push.dropped["refused-by-hub"])
            push.on_fix(a_fix(position_m=(50.0, 2.0, 1.5)))
            await until(lambda: messages[-1]["payload"][-1]["position"]["coordinates"][0] == 50.0)
        assert push.dropped["refused-by-hub"] == 1
    assert any("error 10004: no" in line for line in lines)
    for message in messages:
        assert (message["event"], message["topic"]) == ("message", "location_updates")
        assert message["params"] == {"token": "abc"}
        assert 1 <= len(message["payload"]) <= MAX_BATCH
        assert {one["source"] for one in message["payload"]} == {"A8C01D4C-333A-4406-B2E9-A174AD295CB1"}


def test_what_waits_too_long_is_dropped_oldest_first_and_counted(monkeypatch):
    monkeypatch.setattr(omlox, "MAX_WAITING", 3)
    push = OmloxPush(TargetUrl("omlox+ws://127.0.0.1:1/v2/ws/socket"), BridgeContext(lambda _line: None))
    push.on_site(HALL)
    for x in range(5):
        push.on_fix(a_fix(position_m=(float(x), 0.0, 0.0)))
    assert [one["position"]["coordinates"][0] for one in push._waiting] == [2.0, 3.0, 4.0]
    assert push.dropped["not-sent"] == 2
    assert {one["source"] for one in push._waiting} == {"skyless-7"}
