"""A phone's records live, by TCP and as WebSocket messages, against what the same records in a file give."""

import asyncio
import io
import json
import random
from collections import Counter
from math import dist

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from skyless.core.air.masterless_packets import Packet
from skyless.core.errors import SkylessError
from skyless.files import MAX_LINE_BYTES
from skyless.radio.foreign import phone_radio, phones
from skyless.radio.foreign.fira import AnchorFrame
from skyless.radio.foreign.phone_radio import PhoneRadio
from skyless.radio.interface import Gone
from skyless.run.masterless.packet_tags import PacketTagNode, PacketTagSettings
from support import synthetic_recordings as synthetic

pytestmark = pytest.mark.site

LINES = list(synthetic.phone_records(900))
TRACK_M = [synthetic.place_m(number * synthetic.PERIOD_S, 0.5) for number in range(900)]


def in_a_file(lines):
    drops = Counter()
    return list(phones.read(io.BytesIO(b"".join(lines)), drops)), drops


class Stage:
    """A radio that runs, and a tag that receives from it."""

    def __init__(self):
        self.radio = PhoneRadio("127.0.0.1", 0, "walker", {}, AnchorFrame())
        self.events, self.fixes, self.said, self.faults = [], [], [], []
        settings = PacketTagSettings({}, publish_hz=1e9)
        self.node = PacketTagNode(settings, self.radio, self.fixes.append, self.said.append)
        self._came = asyncio.Event()

    def on_event(self, event):
        self.events.append(event)
        self.node.on_event(event)
        self._came.set()

    async def until(self, count, kind=Packet):
        while sum(isinstance(event, kind) for event in self.events) < count:
            self._came.clear()
            await self._came.wait()

    async def tcp(self, data=b""):
        reader, writer = await asyncio.open_connection("127.0.0.1", self.radio.port)
        writer.write(data)
        return reader, writer

    def websocket(self, **options):
        return connect(f"ws://127.0.0.1:{self.radio.port}/any", **options)

    @property
    def packets(self):
        return [event for event in self.events if isinstance(event, Packet)]

    async def __aenter__(self):
        asyncio.get_running_loop().set_exception_handler(lambda _, context: self.faults.append(context))
        self._running = asyncio.create_task(self.radio.run(self.on_event))
        await self.until(1, object)
        return self

    async def __aexit__(self, *_):
        self._running.cancel()
        await asyncio.gather(self._running, return_exceptions=True)
        await asyncio.sleep(0)
        assert not self.faults


def performed(act):
    """The stage after an act on it."""

    async def run():
        async with Stage() as stage:
            await act(stage)
            return stage

    return asyncio.run(run())


async def by_tcp(stage, lines, times=1):
    _, writer = await stage.tcp(b"".join(lines))
    writer.close()
    await stage.until(times, Gone)


async def by_websocket(stage, lines):
    """Rounds in random order: as lines, of which the last needs no end, as one array, and in two fragments."""
    draw = random.Random(3)
    async with stage.websocket(compression=None) as phone:
        for number, at in enumerate(range(0, len(lines), 9)):
            of_round = draw.sample(lines[at : at + 9], 9)
            text = b"".join(of_round).decode().strip()
            if number % 3 == 1:
                text = json.dumps([json.loads(line) for line in of_round])
            await phone.send([text[:100], text[100:]] if number % 3 == 2 else text)
    await stage.until(1, Gone)


@pytest.mark.parametrize("send", [by_tcp, by_websocket])
def test_live_records_give_the_packets_and_fixes_of_their_file(send, capfd, caplog):
    stage, of_file = performed(lambda stage: send(stage, LINES)), Stage()
    assert stage.packets == in_a_file(LINES)[0]
    assert not stage.node.drops
    for packet in stage.packets:
        of_file.on_event(packet)
    assert len(stage.fixes) > 800
    assert [fix.position_m for fix in stage.fixes] == [fix.position_m for fix in of_file.fixes]
    assert dist(stage.fixes[-1].position_m, TRACK_M[-1]) < 0.15
    assert stage.said == [
        f"tag walker: waits for a phone at 127.0.0.1:{stage.radio.port}",
        "tag walker: listening",
        "tag walker: the phone has ended its connection; still looking for it",
    ]
    assert (capfd.readouterr(), caplog.records) == (("", ""), [])


def test_a_new_connection_takes_the_place_of_the_old_one_and_positions_go_on(capfd, caplog):
    async def act(stage):
        _, idle = await stage.tcp()  # one that sends nothing replaces nobody
        _, first = await stage.tcp(b"".join(LINES[:450]))
        await stage.until(450)
        async with stage.websocket() as second:
            await second.send(b"".join(LINES[450:459]))
            await stage.until(459)
            first.write(b"".join(LINES[:9]))
            _, third = await stage.tcp(b"".join(LINES[459:]))
            await stage.until(900)
            with pytest.raises(ConnectionClosed):
                await second.recv()
        third.transport.abort()
        await stage.until(1, Gone)
        assert not idle.transport.is_closing()

    stage = performed(act)
    assert stage.packets == in_a_file(LINES)[0]
    assert not stage.node.drops
    assert len(stage.fixes) > 800
    assert (capfd.readouterr(), caplog.records) == (("", ""), [])


def test_late_double_and_malformed_records_are_counted_drops_and_no_fix_is_wrong():
    draw, lines = random.Random(7), []
    for number, at in enumerate(range(0, 900, 9)):
        lines += LINES[at : at + 9]
        if number % 4 == 3:
            lines += [draw.choice(LINES[max(0, at - 90) : at]), b'{"address": ]\n', b"\xff\x00 no JSON\r\n"]
        if number % 10 == 7:
            lines[-9], lines[-3] = lines[-3], lines[-9]
    packets, drops = in_a_file(lines)
    stage = performed(lambda stage: by_tcp(stage, [*lines, b"[" * (2 * MAX_LINE_BYTES) + b"\n", b'{"address": 1']))
    assert stage.packets == packets
    assert stage.radio.counters == drops + Counter({"overlong-line": 1, "unfinished-line": 1})
    assert drops["malformed-record"] == 50
    assert drops["late-or-double-record"] >= 25
    assert len(stage.fixes) > 500
    assert all(min(dist(fix.position_m, place_m) for place_m in TRACK_M) < 0.2 for fix in stage.fixes)


@pytest.mark.parametrize("jump_ticks", [-(2**38), 2**38])
def test_a_phone_whose_time_begins_again_is_found_again_as_in_a_file(jump_ticks):
    def later(line):
        record = json.loads(line)
        ticks = int.from_bytes(bytes.fromhex(record["rxTimestamp"]), "little") + jump_ticks
        return json.dumps(record | {"rxTimestamp": ticks % 2**40}).encode() + b"\n"

    lines = LINES[:450] + [later(line) for line in LINES[450:]]

    async def act(stage):
        await by_tcp(stage, lines[:450])
        await by_tcp(stage, lines[450:], 2)

    stage = performed(act)
    assert stage.packets == in_a_file(lines)[0]
    for fix, place_m in zip(stage.fixes[-100:], TRACK_M[-100:], strict=True):
        assert dist(fix.position_m, place_m) < 0.2


def test_pages_other_requests_and_too_long_messages_are_refused_and_the_phone_goes_on(monkeypatch):
    monkeypatch.setattr(phone_radio, "MAX_CONNECTIONS", 3)

    async def act(stage):
        _, phone = await stage.tcp(b"".join(LINES[:450]))
        await stage.until(450)
        for origin in ("https://page.example", "http://127.0.0.1:1", "http://[", "null"):
            with pytest.raises(InvalidStatus, match="403"):
                await stage.websocket(origin=origin).__aenter__()
        async with stage.websocket(origin=f"http://127.0.0.1:{stage.radio.port}"):
            pass  # as some libraries for apps state it
        reader, _ = await stage.tcp(b"POST / HTTP/1.1\r\nHost: here\r\n\r\n" + LINES[450])
        assert not (await reader.read()).startswith(b"HTTP/1.1 101")
        idle = [await stage.tcp() for _ in range(3)]
        with pytest.raises((EOFError, OSError)):
            await idle[0][0].readexactly(1)
        phone.write(b"".join(LINES[450:]))
        await stage.until(900)
        async with stage.websocket() as other:
            await other.send("x" * (MAX_LINE_BYTES + 1))
            with pytest.raises(ConnectionClosed, match="1009"):
                await other.recv()

    counted = performed(act).radio.counters
    assert counted == {"page-refused": 4, "malformed-connection": 2, "too-many-connections": 2}


def test_a_port_in_use_is_said_clearly():
    async def act(stage):
        await PhoneRadio("127.0.0.1", stage.radio.port, "other", {}, AnchorFrame()).run(print)

    with pytest.raises(SkylessError, match=r"--radio cannot listen on 127.0.0.1:\d+: Address already in use"):
        performed(act)
