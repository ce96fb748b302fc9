"""Foxglove's WebSocket protocol: what clients get, and what they may send."""

import asyncio
import json
import os
import struct
from contextlib import asynccontextmanager

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_nmea import FIX, HALL
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from skyless.bridges import foxglove
from skyless.bridges.foxglove import SUBPROTOCOLS, FoxgloveTarget, Subscribe, Subscription, Unsubscribe, decode_request
from skyless.bridges.target import BridgedSite
from skyless.core.earth import geodetic
from skyless.core.errors import SkylessError
from skyless.core.site import WallSite
from skyless.run.mqtt.messages import Zone
from skyless.run.web import BridgeLimits
from support.unread import unread_websocket
from support.waiting import running, until

SITE = BridgedSite(
    1, "hall", simulated=False, anchors_m={1: (0.0, 0.0, 2.0), 2: (6.0, 0.0, 2.0)}, georeference=HALL, master=1,
    zones=(Zone("z1", "Dock", ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0))),), walls=(WallSite(0.0, 0.0, 6.0, 0.0),),
)  # fmt: skip
ANSWER_S = 20.0


@asynccontextmanager
async def served(site=SITE, origins=()):
    """A target that serves on a free port."""
    server = FoxgloveTarget("foxglove://:0", "127.0.0.1", 0, origins, unix_time=lambda: FIX.unix_s)
    if site is not None:
        server.on_site(site)
    async with running(server.run()):
        await until(lambda: server.port)
        yield server


class Client:
    """Speaks the protocol by itself: it shares no code with the server."""

    def __init__(self, connection):
        self._connection = connection
        self.channels = {}
        self.texts = []

    async def ask(self, **request):
        await self._connection.send(json.dumps(request))

    async def _next(self):
        """The next message if it is of a channel; texts are kept."""
        data = await asyncio.wait_for(self._connection.recv(), ANSWER_S)
        if isinstance(data, bytes):
            return data
        self.texts.append(json.loads(data))
        self.channels |= {channel["topic"]: channel for channel in self.texts[-1].get("channels", ())}
        return None

    async def receive(self):
        """The next message of a channel, as its subscription, its time and its JSON."""
        while (data := await self._next()) is None:
            pass
        operation, subscription, time_ns = struct.unpack_from("<BIQ", data)
        assert operation == 1
        return subscription, time_ns, json.loads(data[13:])

    async def text(self, wanted):
        """The next text that is wanted."""
        while not any(map(wanted, self.texts)):
            assert await self._next() is None
        return next(filter(wanted, self.texts))


@asynccontextmanager
async def client_of(server, subprotocols=SUBPROTOCOLS):
    async with connect(f"ws://127.0.0.1:{server.port}", subprotocols=list(subprotocols)) as connection:
        yield Client(connection)


@pytest.mark.site
@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        (None, None, 101),
        (None, "https://app.foxglove.dev", 101),
        (None, "http://localhost:8080", 101),
        (None, "https://lichtblick.example", 101),
        (None, "http://evil.example", 403),
        (None, "null", 403),
        ("evil.example", None, 421),
        ("evil.example", "http://evil.example", 421),
    ],
)
async def test_pages_of_other_sites_are_refused(host, origin, status):
    async with served(origins=["https://lichtblick.example"]) as server:
        address, found = f"ws://{host or '127.0.0.1'}:{server.port}", 101
        try:
            where = {"host": "127.0.0.1", "port": server.port}
            async with connect(address, origin=origin, subprotocols=list(SUBPROTOCOLS), **where):
                pass
        except InvalidStatus as error:
            found = error.response.status_code
    assert found == status


def advertised(topic):
    return lambda text: any(channel["topic"] == topic for channel in text.get("channels", ()))


def is_status(text):
    return text["op"] == "status"


@pytest.mark.site
@pytest.mark.parametrize("subprotocol", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
async def test_a_client_gets_each_form_of_a_fix(subprotocol):
    async with served() as server, client_of(server, [subprotocol]) as client:
        server.on_fix(FIX)  # with it the channels of its tag are there
        await client.text(advertised("/tag/tag1/location"))
        assert client.texts[0]["op"] == "serverInfo"
        topics = {name: channel["id"] for name, channel in client.channels.items()}
        wanted = [{"id": 100 + number, "channelId": number} for number in topics.values()]
        await client.ask(op="subscribe", subscriptions=wanted)
        found = {}
        number, time_ns, found["/site/scene"] = await client.receive()  # at once, as it does not change
        assert (number, time_ns) == (100 + topics["/site/scene"], round(FIX.unix_s * 1e9))
        fix = msgspec.structs.replace(FIX, unix_s=FIX.unix_s + 0.02)
        server.on_fix(fix)
        while len(found) < len(topics):
            number, time_ns, payload = await client.receive()
            assert time_ns == round(fix.unix_s * 1e9)
            found[next(name for name, channel in topics.items() if channel == number - 100)] = payload
    assert msgspec.json.decode(json.dumps(found["/tag/tag1/fix"]), type=type(fix)) == fix
    x, y, z = fix.position_m
    assert found["/tf"]["translation"] == {"x": x, "y": y, "z": z}
    assert (found["/tf"]["parent_frame_id"], found["/tf"]["child_frame_id"]) == ("site", "tag1")
    pose = found["/tag/tag1/pose"]["pose"]
    assert pose["position"] == {"x": x, "y": y, "z": z}
    assert pose["orientation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}, "a tag has no heading"
    location = found["/tag/tag1/location"]
    assert (location["latitude"], location["longitude"], location["altitude"]) == geodetic(fix.position_m, HALL)
    names = {entity["id"] for entity in found["/site/scene"]["entities"]}
    assert names == {"anchor 1", "anchor 2", "wall 0", "zone z1"}
    for name, channel in client.channels.items():
        schema = json.loads(channel["schema"])
        assert (channel["encoding"], channel["schemaEncoding"]) == ("json", "jsonschema")
        assert schema["title"] == channel["schemaName"]
        assert found[name].keys() == schema["properties"].keys()


@pytest.mark.site
async def test_a_client_of_another_protocol_is_refused():
    async with served() as server:
        for subprotocols in (["x-something-else"], []):
            with pytest.raises(InvalidHandshake):
                async with client_of(server, subprotocols):
                    pass


@pytest.mark.site
async def test_without_a_georeference_there_is_no_location():
    async with served(msgspec.structs.replace(SITE, georeference=None)) as server, client_of(server) as client:
        server.on_fix(FIX)
        await client.text(advertised("/tag/tag1/ellipse"))
        assert set(client.channels) == {"/site/scene", "/tf", "/tag/tag1/fix", "/tag/tag1/pose", "/tag/tag1/ellipse"}


@pytest.mark.site
async def test_what_cannot_be_done_is_answered_with_a_status_and_costs_nothing():
    async with served() as server, client_of(server) as client:
        for request in (
            {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 77}]},
            {"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1}]},
            {"op": "advertise", "channels": []},
            {"op": "getParameters", "parameterNames": []},
        ):
            client.texts.clear()
            await client.ask(**request)
            assert (await client.text(is_status))["level"] == 1
        await client.ask(op="subscribe", subscriptions=[{"id": 5, "channelId": 1}])
        assert (await client.receive())[0] == 5
        client.texts.clear()
        await client.ask(op="subscribe", subscriptions=[{"id": 6, "channelId": 1}])
        await client.text(is_status)
        await client.ask(op="unsubscribe", subscriptionIds=[5])
        await client.ask(op="subscribe", subscriptions=[{"id": 6, "channelId": 1}])
        assert (await client.receive())[0] == 6
        assert server.dropped == {"request-not-understood": 5}


@pytest.mark.site
async def test_figures_that_no_tag_publishes_are_dropped():
    async with served() as server, client_of(server) as client:
        server.on_fix(FIX)
        await client.text(advertised("/tag/tag1/location"))
        wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in client.channels.values()]
        await client.ask(op="subscribe", subscriptions=wanted)
        await client.receive()
        await until(lambda: all(one.wants(number["id"]) for one in server._sessions for number in wanted))
        for unix_s in (float("nan"), float("inf"), -1.0, 1e30):
            server.on_fix(msgspec.structs.replace(FIX, unix_s=unix_s))
        server.on_fix(msgspec.structs.replace(FIX, position_m=(1e300, 1e300, 1e300), covariance_m2=(1e308,) * 9))
        server.on_fix(FIX)
        while (await client.receive())[1] != round(FIX.unix_s * 1e9):
            pass
        assert server.dropped["out-of-range"] >= 4 * 5


@pytest.mark.site
async def test_a_client_that_never_reads_is_disconnected_and_others_get_every_fix(monkeypatch):
    monkeypatch.setattr(foxglove, "STUCK_S", 0.2)
    fixes = 6000
    async with served() as server, client_of(server) as client:
        server.on_fix(FIX)
        await client.text(advertised("/tag/tag1/location"))
        _, writer = await asyncio.open_connection(
            sock=await stuck_socket(server.port, [channel["id"] for channel in client.channels.values()])
        )
        number = client.channels["/tag/tag1/pose"]["id"]
        await client.ask(op="subscribe", subscriptions=[{"id": 1, "channelId": number}])
        await until(lambda: sum(one.wants(number) for one in server._sessions) == 2)
        got = 0
        for serial in range(fixes):
            server.on_fix(msgspec.structs.replace(FIX, serial=serial, unix_s=FIX.unix_s + 0.001 * serial))
            _, time_ns, _ = await client.receive()
            got += time_ns == round((FIX.unix_s + 0.001 * serial) * 1e9)
            if len(server._sessions) == 1 and serial > fixes // 2:
                break
        else:
            await asyncio.sleep(0.3)
            server.on_fix(FIX)
        await until(lambda: len(server._sessions) == 1)
        writer.close()
        assert got == serial + 1
        assert server.dropped["slow-client"] > 0


async def stuck_socket(port, channels):
    """A client that subscribes everything and then never reads."""
    sock = await unread_websocket(port, "/", "Sec-WebSocket-Protocol: foxglove.sdk.v1")
    subscriptions = [{"id": number, "channelId": number} for number in channels]
    text = json.dumps({"op": "subscribe", "subscriptions": subscriptions}).encode()
    masked = bytes([0x81, 0x80 | 126]) + struct.pack(">H", len(text)) + bytes(4) + text  # a mask of zeros
    await asyncio.get_running_loop().sock_sendall(sock, masked)
    return sock


@pytest.mark.site
async def test_more_clients_than_it_serves_are_closed(monkeypatch):
    monkeypatch.setattr(foxglove, "LIMITS", BridgeLimits(clients=1))
    async with served() as server, client_of(server) as first:
        await first.text(lambda text: text["op"] == "serverInfo")
        async with client_of(server) as second:
            with pytest.raises(ConnectionClosed):
                await second.receive()
        assert server.dropped == {"too-many-clients": 1}


@pytest.mark.site
async def test_a_port_in_use_is_named(taken):
    with pytest.raises(SkylessError, match=f"cannot listen on 127.0.0.1:{taken}"):
        await FoxgloveTarget(f"foxglove://:{taken}", "127.0.0.1", taken).run()


numbers = st.integers(0, 2**32 - 1)


@given(subscriptions=st.lists(st.tuples(numbers, numbers), max_size=20), gone=st.lists(numbers, max_size=20))
def test_requests_are_read_as_they_were_written(subscriptions, gone):
    asked = {"op": "subscribe", "subscriptions": [{"id": a, "channelId": b} for a, b in subscriptions]}
    assert decode_request(json.dumps(asked)) == Subscribe(tuple(Subscription(a, b) for a, b in subscriptions))
    assert decode_request(json.dumps({"op": "unsubscribe", "subscriptionIds": gone})) == Unsubscribe(tuple(gone))


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from(["op", "subscriptions", "id", "channelId"]), inner),
    max_leaves=10,
)


@settings(max_examples=int(os.environ.get("SKYLESS_FUZZ_FRAMES", "300")))
@given(data=st.text() | st.binary() | json_values.map(json.dumps))
@pytest.mark.site
@pytest.mark.statistical
def test_no_request_raises(data):
    request = decode_request(data)
    assert request is None or isinstance(request, Subscribe | Unsubscribe)
