"""A phone's records live, by TCP and as WebSocket messages, against what the same records in a file give."""

import asyncio
import io
import json
import math
import random
from collections import Counter

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from skyless.core.errors import SkylessError
from skyless.files import MAX_LINE_BYTES
from skyless.radio.foreign import phone_radio, phones
from skyless.radio.foreign.fira import AnchorFrame
from skyless.radio.foreign.phone_radio import PhoneRadio
from skyless.radio.interface import Gone, Hint, Restarted
from skyless.run.masterless.packet_tags import PacketTagNode, PacketTagSettings
from skyless.run.open_radio import open_sniffers
from support import synthetic_recordings as synthetic

pytestmark = pytest.mark.site

LINES = list(synthetic.phone_records(900))
ROUNDS = [LINES[at : at + 9] for at in range(0, 900, 9)]


def in_a_file(lines):
    drops = Counter()
    return list(phones.read(io.BytesIO(b"".join(lines)), drops)), drops


class Stage:
    """A radio that runs, and a tag that receives from it."""

    def __init__(self):
        self.radio = PhoneRadio("127.0.0.1", 0, "walker", {}, AnchorFrame())
        self.events, self.fixes, self.said, self.faults = [], [], [], []
        self.node = PacketTagNode(
            PacketTagSettings({}, publish_hz=1e9), self.radio, self.fixes.append, self.said.append
        )
        self._came = asyncio.Event()

    def _on_event(self, event):
        self.events.append(event)
        self.node.on_event(event)
        self._came.set()

    async def until(self, condition):
        while not condition():
            self._came.clear()
            await self._came.wait()

    async def until_gone(self, times=1):
        await self.until(lambda: sum(isinstance(event, Gone) for event in self.events) >= times)

    async def tcp(self):
        _, writer = await asyncio.open_connection("127.0.0.1", self.radio.port)
        return writer

    def websocket(self, **options):
        return connect(f"ws://127.0.0.1:{self.radio.port}/any", **options)

    @property
    def packets(self):
        return [event for event in self.events if not isinstance(event, Restarted | Gone | Hint)]

    async def __aenter__(self):
        asyncio.get_running_loop().set_exception_handler(lambda _, context: self.faults.append(context))
        self._running = asyncio.create_task(self.radio.run(self._on_event))
        await self.until(lambda: self.events)
        return self

    async def __aexit__(self, *_):
        self._running.cancel()
        await asyncio.gather(self._running, return_exceptions=True)
        await asyncio.sleep(0)
        assert not self.faults


async def by_tcp(stage, lines):
    writer = await stage.tcp()
    for line in lines:
        writer.write(line)
        await writer.drain()
    writer.close()
    await stage.until_gone()


async def by_websocket(stage, lines):
    """Rounds of several lines, of which the last needs no end, or as one array, in random order, in fragments too."""
    draw = random.Random(3)
    async with stage.websocket(compression=None) as phone:
        for number, at in enumerate(range(0, len(lines), 9)):
            of_round = draw.sample(lines[at : at + 9], len(lines[at : at + 9]))
            text = b"".join(of_round).decode().strip()
            if number % 3 == 1:
                text = json.dumps([json.loads(line) for line in of_round])
            await phone.send([text[:100], text[100:]] if number % 3 == 2 else text)
    await stage.until_gone()


@pytest.mark.parametrize("send", [by_tcp, by_websocket])
def test_live_records_give_the_packets_and_fixes_of_their_file(send, capfd, caplog):
    expected, _ = in_a_file(LINES)
    assert len(expected) == 900
    file_fixes = []
    node = PacketTagNode(
        PacketTagSettings({}, publish_hz=1e9), PhoneRadio("", 0, "walker", {}, AnchorFrame()), file_fixes.append, print
    )
    for packet in expected:
        node.on_event(packet)

    async def run():
        async with Stage() as stage:
            await send(stage, LINES)
            return stage

    stage = asyncio.run(run())
    assert stage.packets == expected
    assert not stage.node.drops
    assert len(stage.fixes) > 800
    assert [fix.position_m for fix in stage.fixes] == [fix.position_m for fix in file_fixes]
    assert math.dist(stage.fixes[-1].position_m, synthetic.place_m(900 * synthetic.PERIOD_S, 0.5)) < 0.15
    port = stage.radio.port
    assert stage.said == [
        f"tag walker: waits for a phone at 127.0.0.1:{port}",
        "tag walker: listening",
        "tag walker: the phone has ended its connection; still looking for it",
    ]
    assert capfd.readouterr() == ("", "")
    assert not caplog.records


def test_a_new_connection_takes_the_place_of_the_old_one_and_positions_go_on(capfd, caplog):
    async def run():
        async with Stage() as stage:
            first, idle = await stage.tcp(), await stage.tcp()  # one that sends nothing replaces nobody
            first.write(b"".join(LINES[:450]))
            await stage.until(lambda: len(stage.packets) == 450)
            async with stage.websocket() as second:
                await second.send(b"".join(LINES[450:459]))
                await stage.until(lambda: len(stage.packets) == 459)
                first.write(b"".join(LINES[:9]))
                third = await stage.tcp()
                third.write(b"".join(LINES[459:]))
                await stage.until(lambda: len(stage.packets) == 900)
                with pytest.raises(ConnectionClosed):
                    await second.recv()
            third.transport.abort()
            await stage.until_gone()
            assert not idle.transport.is_closing()
            return stage

    stage = asyncio.run(run())
    assert stage.packets == in_a_file(LINES)[0]
    assert len(stage.fixes) > 800
    assert not stage.node.drops
    assert capfd.readouterr() == ("", "")
    assert not caplog.records


def test_late_double_and_malformed_records_are_counted_drops_and_no_fix_is_wrong():
    draw = random.Random(7)
    lines = []
    for number, of_round in enumerate(ROUNDS):
        lines += of_round
        if number % 4 == 3:
            lines += [
                draw.choice(LINES[max(0, 9 * number - 90) : 9 * number]),
                b'{"address": ]\n',
                b"\xff\x00 no JSON\r\n",
            ]
        if number % 10 == 7:  # a record changes places with one of the next round
            lines[-9], lines[-3] = lines[-3], lines[-9]

    async def run():
        async with Stage() as stage:
            writer = await stage.tcp()
            writer.write(b"".join(lines) + b"[" * (2 * MAX_LINE_BYTES) + b"\n" + LINES[0] + b'{"address": 1')
            writer.close()
            await stage.until_gone()
            return stage

    stage = asyncio.run(run())
    packets, drops = in_a_file(lines)
    assert stage.packets[: len(packets)] == packets
    assert drops["malformed-record"] == 50
    assert drops["late-or-double-record"] >= 25
    counted = stage.radio.counters
    assert {reason: counted[reason] for reason in ("malformed-record", "overlong-line", "unfinished-line")} == {
        "malformed-record": 50,
        "overlong-line": 1,
        "unfinished-line": 1,
    }
    assert len(stage.fixes) > 500
    track = [synthetic.place_m(k * synthetic.PERIOD_S, 0.5) for k in range(900)]
    assert all(min(math.dist(fix.position_m, place) for place in track) < 0.2 for fix in stage.fixes)


@pytest.mark.parametrize("jump_ticks", [-(2**38), 2**38])
def test_a_phone_whose_time_begins_again_is_found_again_as_in_a_file(jump_ticks):
    def later(line):
        record = json.loads(line)
        ticks = int.from_bytes(bytes.fromhex(record["rxTimestamp"]), "little") + jump_ticks
        return json.dumps(record | {"rxTimestamp": (ticks % 2**40).to_bytes(8, "little").hex()}).encode() + b"\n"

    lines = LINES[:450] + [later(line) for line in LINES[450:]]

    async def run():
        async with Stage() as stage:
            for number, part in enumerate((lines[:450], lines[450:]), start=1):
                writer = await stage.tcp()
                writer.write(b"".join(part))
                writer.close()
                await stage.until_gone(number)
            return stage

    stage = asyncio.run(run())
    assert stage.packets == in_a_file(lines)[0]
    last = stage.fixes[-100:]
    for number, fix in enumerate(last, start=800):
        assert math.dist(fix.position_m, synthetic.place_m(number * synthetic.PERIOD_S, 0.5)) < 0.2


def test_pages_other_requests_and_too_long_messages_are_refused_and_cost_nobody_the_line(monkeypatch):
    monkeypatch.setattr(phone_radio, "MAX_CONNECTIONS", 3)

    async def run():
        async with Stage() as stage:
            phone = await stage.tcp()
            phone.write(b"".join(LINES[:450]))
            await stage.until(lambda: len(stage.packets) == 450)
            for origin in ("https://page.example", "http://127.0.0.1:1", "http://[", "null"):
                with pytest.raises(InvalidStatus, match="403"):
                    await stage.websocket(origin=origin).__aenter__()
            async with stage.websocket(origin=f"http://127.0.0.1:{stage.radio.port}"):
                pass  # as some libraries for apps state it
            reader, writer = await asyncio.open_connection("127.0.0.1", stage.radio.port)
            writer.write(b"POST / HTTP/1.1\r\nHost: here\r\n\r\n" + LINES[450])
            assert not (await reader.read()).startswith(b"HTTP/1.1 101")
            idle = [await asyncio.open_connection("127.0.0.1", stage.radio.port) for _ in range(3)]
            with pytest.raises((EOFError, OSError)):
                await idle[0][0].readexactly(1)
            phone.write(b"".join(LINES[450:]))
            await stage.until(lambda: len(stage.packets) == 900)
            async with stage.websocket() as other:
                await other.send("x" * (MAX_LINE_BYTES + 1))
                with pytest.raises(ConnectionClosed, match="1009"):
                    await other.recv()
            return stage.radio.counters

    counted = asyncio.run(run())
    assert counted == {"page-refused": 4, "malformed-connection": 2, "too-many-connections": 2}


def test_what_cannot_be_a_phone_is_said_clearly():
    for spec, names, right in (
        ("phone://0.0.0.0:7470", ("one", "two"), "it is one phone, which is one tag, not 2"),
        ("phone://0.0.0.0:x", ("one",), r"it should be phone://HOST\[:PORT\] with a port from 1 to 65535"),
    ):
        with pytest.raises(SkylessError, match=right):
            open_sniffers(spec, names)
    (radio,) = open_sniffers("phone://[::1]:7470", ("one",))
    assert radio.advice().startswith("the phone at ::1:7470 sends no records")

    async def twice():
        async with Stage() as stage:
            await PhoneRadio("127.0.0.1", stage.radio.port, "other", {}, AnchorFrame()).run(print)

    with pytest.raises(SkylessError, match=r"--radio cannot listen on 127.0.0.1:\d+: Address already in use"):
        asyncio.run(twice())
