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
from skyless.radio.foreign.phone_radio import PhoneRadio
from skyless.radio.foreign.uci import AnchorFrame
from skyless.radio.interface import Gone
from skyless.run.masterless.packet_tags import PacketTagNode, PacketTagSettings
from support import synthetic_recordings as synthetic
from support.waiting import running, until

pytestmark = pytest.mark.site

LINES = list(synthetic.phone_records(900))
TRACK_M = [synthetic.place_m(number * synthetic.PERIOD_S, 0.5) for number in range(900)]


class Stage(PhoneRadio):
    """A radio that runs, and a tag that receives from it."""

    def __init__(self, port=0):
        super().__init__("127.0.0.1", port, "walker", AnchorFrame())
        self.events, self.fixes, self.said, self.faults = [], [], [], []
        settings = PacketTagSettings({}, publish_hz=1e9)
        self.node = PacketTagNode(settings, self, self.fixes.append, self.said.append)

    def on_event(self, event):
        self.events.append(event)
        self.node.on_event(event)

    def of_kind(self, kind=Packet):
        return [event for event in self.events if isinstance(event, kind)]

    async def until(self, count, kind=Packet):
        await until(lambda: len(self.of_kind(kind)) >= count)

    async def tcp(self, *lines):
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        writer.write(b"".join(lines))
        return reader, writer

    def websocket(self, **options):
        return connect(f"ws://127.0.0.1:{self.port}/any", **options)


def performed(act, *arguments):
    """The stage after an act on it."""

    async def run():
        stage = Stage()
        asyncio.get_running_loop().set_exception_handler(lambda _, context: stage.faults.append(context))
        async with running(stage.run(stage.on_event)):
            await stage.until(1, object)
            await act(stage, *arguments)
        await asyncio.sleep(0)
        assert not stage.faults
        return stage

    return asyncio.run(run())


async def by_tcp(stage, lines):
    _, writer = await stage.tcp(*lines)
    writer.close()
    await stage.until(1, Gone)


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


async def by_turns(stage, lines):
    """Connections that take the place of an ended one, and of each other; one that sends nothing replaces nobody."""
    _, idle = await stage.tcp()
    await by_tcp(stage, lines[:90])
    _, first = await stage.tcp(*lines[90:450])
    await stage.until(450)
    async with stage.websocket() as second:
        await second.send(b"".join(lines[450:459]))
        await stage.until(459)
        first.write(b"".join(lines[:9]))
        _, third = await stage.tcp(*lines[459:])
        await stage.until(900)
        with pytest.raises(ConnectionClosed):
            await second.recv()
    third.transport.abort()
    await stage.until(2, Gone)
    assert not idle.transport.is_closing()


def spoiled():
    """Late, double and malformed records among the others, and a last one without an end."""
    draw, lines = random.Random(7), []
    for number, at in enumerate(range(0, 900, 9)):
        lines += LINES[at : at + 9]
        if number % 4 == 3:
            lines += [draw.choice(LINES[max(0, at - 90) : at]), b'{"address": ]\n', b"\xff\x00 no JSON\r\n"]
        if number % 10 == 7:
            lines[-9], lines[-3] = lines[-3], lines[-9]
    return [*lines, b"[" * (2 * MAX_LINE_BYTES) + b"\n", b'{"address": 1']


def test_records_in_any_order_are_those_in_order_from_the_first_late_one_on():
    draw, drops = random.Random(5), Counter()
    rounds = [b"".join(draw.sample(LINES[at : at + 9], 9)) for at in range(0, 900, 9)]
    mixed = [*LINES[:9], LINES[0], *rounds[1:20], *LINES[180:720], LINES[718], *rounds[80:]]  # in order for long
    found, in_order = (list(phones.read(io.BytesIO(b"".join(one)), drops)) for one in (mixed, LINES))
    assert (found, drops) == (in_order, {"late-or-double-record": 2})


def begun_again(jump_ticks):
    """A phone whose time jumps in the middle."""
    late = [json.loads(line) for line in LINES[450:]]
    for record in late:
        ticks = int.from_bytes(bytes.fromhex(record["rxTimestamp"]), "little") + jump_ticks
        record["rxTimestamp"] = ticks % 2**40
    return LINES[:450] + [json.dumps(record).encode() + b"\n" for record in late]


@pytest.mark.parametrize(
    ("lines", "send"),
    [
        *((LINES, send) for send in (by_tcp, by_websocket, by_turns)),
        (spoiled(), by_tcp),
        *((begun_again(jump_ticks), by_turns) for jump_ticks in (-(2**38), 2**38)),
    ],
)
def test_live_records_give_the_packets_drops_and_fixes_of_their_file(lines, send, capfd, caplog):
    stage, of_file = performed(send, lines), Stage()
    for packet in phones.read(io.BytesIO(b"".join(lines)), of_file.counters):
        of_file.on_event(packet)
    assert stage.of_kind() == of_file.events
    assert (stage.counters, stage.node.drops) == (of_file.counters, of_file.node.drops)
    assert stage.counters["late-or-double-record"] == (25 if len(lines) > 900 else 0)  # of the spoiled ones
    assert [fix.position_m for fix in stage.fixes] == [fix.position_m for fix in of_file.fixes]
    assert len(stage.fixes) > 800
    assert dist(stage.fixes[-1].position_m, TRACK_M[-1]) < 0.15
    assert all(min(dist(fix.position_m, place_m) for place_m in TRACK_M) < 0.2 for fix in stage.fixes)
    assert stage.said[:3] == [
        f"tag walker: waits for a phone at 127.0.0.1:{stage.port}",
        "tag walker: listening",
        "tag walker: the phone has ended its connection; still looking for it",
    ]
    assert (capfd.readouterr(), caplog.records) == (("", ""), [])


def test_pages_other_requests_and_too_long_messages_are_refused_and_the_phone_goes_on(monkeypatch):
    monkeypatch.setattr(phone_radio, "MAX_CONNECTIONS", 3)

    async def act(stage):
        _, phone = await stage.tcp(*LINES[:450])
        await stage.until(450)
        for origin in ("https://page.example", "http://127.0.0.1:1", "http://[", "null"):
            with pytest.raises(InvalidStatus, match="403"):
                await stage.websocket(origin=origin).__aenter__()
        async with stage.websocket(origin=f"http://127.0.0.1:{stage.port}"):
            pass  # as some libraries for apps state it
        reader, _ = await stage.tcp(b"POST / HTTP/1.1\r\nHost: here\r\n\r\n", LINES[450])
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

    counted = performed(act).counters
    assert counted == {"page-refused": 4, "malformed-connection": 2, "too-many-connections": 2}


def test_a_port_in_use_is_said_clearly():
    with pytest.raises(SkylessError, match=r"--radio cannot listen on 127.0.0.1:\d+: Address already in use"):
        performed(lambda stage: Stage(stage.port).run(print))
