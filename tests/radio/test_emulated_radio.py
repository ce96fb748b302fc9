"""Emulated radios and their ether over real sockets in one event loop, and strangers at the ether's door."""

import asyncio
import contextlib
import itertools
import time

import pytest
from air_stage import make_ether
from radio_events import radio_events

from skyless.core.air.frame import Reception, Transmission
from skyless.core.errors import SkylessError
from skyless.core.ticks import TICK_RATE_HZ, difference, wrap
from skyless.radio.emulated import Join, Joined, Refused, Send, Unpacker, from_ether, pack
from skyless.radio.interface import Gone, Late, Restarted, Sent
from skyless.run.ether import Client
from skyless.run.open_radio import host_and_port, is_simulated, open_radios
from support.waiting import until

pytestmark = pytest.mark.site

HOST = "127.0.0.1"
WORD = b"a frame" * 10


class OpenAir:
    """A listening ether whose connections the test can cut."""

    def __init__(self, port=0):
        self.ether, self.clients = make_ether(time.monotonic), []
        self.port, self._server, self._clocks = port, None, None

    async def __aenter__(self):
        def client():
            self.clients.append(Client(self.ether))
            return self.clients[-1]

        self._server = await asyncio.get_running_loop().create_server(client, HOST, self.port)
        self.port = self._server.sockets[0].getsockname()[1]
        self._clocks = asyncio.ensure_future(self.ether.send_clocks())
        self.ether.advance()
        return self

    async def __aexit__(self, *_):
        self._server.close()
        for client in self.clients:
            client._transport.abort()
        self._clocks.cancel()
        await asyncio.wait([self._clocks])
        self.ether._timer.cancel()


@contextlib.asynccontextmanager
async def nodes(port, kind, *names):
    async with contextlib.AsyncExitStack() as stack:
        radios = open_radios(f"ether:{HOST}:{port}", kind, names)
        yield [await stack.enter_async_context(radio_events(radio)) for radio in radios]


@contextlib.asynccontextmanager
async def anchor_and_tag(name):
    """An ether, and an anchor and a tag on the air."""
    async with OpenAir() as air, nodes(air.port, "anchor", name) as (anchor,), nodes(air.port, "tag", "tag1") as (tag,):
        await anchor.until(Restarted)
        await tag.until(Restarted)
        yield air, anchor, tag


def ahead(radio, seconds):
    return wrap(radio.now_ticks() + round(seconds * TICK_RATE_HZ))


async def speak(node, listener):
    """Send frames until one was in time and the listener has it; the machine may be busy."""
    for _ in range(50):
        heard, done = len(listener.of(Reception)), len(node.of(Sent)) + len(node.of(Late))
        tx_ticks = ahead(node.radio, 20e-3)
        node.radio.transmit(Transmission(WORD, tx_ticks))
        await until(lambda done=done: len(node.of(Sent)) + len(node.of(Late)) > done)
        if Sent(tx_ticks) in node.events:
            await listener.until(Reception, heard + 1)
            return tx_ticks
    raise AssertionError("no frame was in time")


async def test_frames_go_from_radio_to_radio_with_stamps_diagnostics_and_the_time_of_the_host():
    async with OpenAir() as air, nodes(air.port, "anchor", "1") as (anchor,), nodes(air.port, "tag", "tag1") as (tag,):
        assert anchor.radio.now_ticks() is None
        await anchor.until(Restarted)
        await tag.until(Restarted)
        await speak(anchor, tag)
        reception = tag.of(Reception)[-1]
        before_s, now_ticks, after_s = time.monotonic(), tag.radio.now_ticks(), time.monotonic()
        assert reception.frame == WORD
        assert 0.0 <= before_s - reception.host_s < 10.0
        # the stamp and the counter belong together: the RMARKER was 0.1 ms before the frame's end
        since_s = difference(now_ticks, reception.rx_ticks) / TICK_RATE_HZ
        assert before_s - reception.host_s - 5e-3 < since_s < after_s - reception.host_s + 5e-3
        measured = reception.diagnostics
        assert -110.0 < measured.first_path_power_dbm <= measured.rx_power_dbm < -40.0
        assert 0.0 < abs(measured.carrier_offset_ppm) < 50.0


async def test_a_counter_goes_with_its_crystal():
    async with OpenAir() as air, nodes(air.port, "anchor", "1") as (anchor,):
        await anchor.until(Restarted)
        begins_s, begin = [time.monotonic()], anchor.radio.now_ticks()
        begins_s.append(time.monotonic())
        await asyncio.sleep(0.5)
        ends_s, end = [time.monotonic()], anchor.radio.now_ticks()
        ends_s.append(time.monotonic())
        passed_s = difference(end, begin) / TICK_RATE_HZ
        assert ends_s[0] - begins_s[1] - 1e-3 < passed_s < ends_s[1] - begins_s[0] + 1e-3


async def test_a_late_frame_is_reported_late_and_the_radio_goes_on():
    async with anchor_and_tag("1") as (air, anchor, tag):
        tx_ticks = ahead(anchor.radio, -1e-3)
        anchor.radio.transmit(Transmission(WORD, tx_ticks))
        assert await anchor.until(Late) == Late(tx_ticks)
        await speak(anchor, tag)
        assert air.ether.health(0.0).late >= 1


async def test_radios_of_one_process_share_a_connection():
    async with OpenAir() as air, nodes(air.port, "anchor", "3", "1") as (three, one):
        await three.until(Restarted)
        await one.until(Restarted)
        assert len(air.clients) == 1
        assert three.radio.now_ticks() != one.radio.now_ticks()
        await speak(three, one)
        assert one.of(Sent) == three.of(Reception) == []


async def test_a_radio_finds_an_ether_that_starts_late_and_one_that_starts_again():
    async with OpenAir() as air:
        port = air.port
    async with nodes(port, "anchor", "1") as (anchor,), nodes(port, "tag", "tag1") as (tag,):
        gone = await anchor.until(Gone)
        assert str(port) in gone.reason
        anchor.radio.transmit(Transmission(WORD, 5))
        assert anchor.events[-1] == Late(5)  # without an ether everything is late
        async with OpenAir(port):
            await anchor.until(Restarted)
            await tag.until(Restarted)
            await speak(anchor, tag)
        await anchor.until(Gone, 2)
        assert anchor.radio.now_ticks() is None
        async with OpenAir(port):
            await anchor.until(Restarted, 2)
            await tag.until(Restarted, 2)
            await speak(anchor, tag)
        await asyncio.sleep(0.7)
        told = [event.reason for event in anchor.of(Gone)]
        assert len(told) <= 5  # each reason once, however often it is tried
        assert all(one != other for one, other in itertools.pairwise(told))


async def test_a_name_that_the_ether_has_not_or_that_is_taken_is_reported_and_asked_for_again():
    async with OpenAir() as air, nodes(air.port, "tag", "tag1") as (first,):
        await first.until(Restarted)
        async with nodes(air.port, "tag", "tag1") as (second,), nodes(air.port, "tag", "nobody") as (nobody,):
            assert "on the air already" in (await second.until(Gone)).reason
            assert "it has: tag1, tag2" in (await nobody.until(Gone)).reason
            await first.stop()
            await second.until(Restarted)  # the place is free
            assert nobody.of(Restarted) == []


HTTP = b"GET / HTTP/1.1\r\nHost: ether\r\n\r\n"
JOIN = pack(Join("anchor", ("1",)))


@pytest.mark.parametrize(
    "said",
    [
        HTTP,
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(500),  # a TLS client's hello
        b"\x05\x00\x00\x00hello",
        pack(Joined("", 0.0, ())),  # what only the ether says
        pack(Send(0, 1, b"")),  # before it has joined
        JOIN + JOIN,
        JOIN + pack(Send(1, 1, b"")),
        JOIN + pack(Send(-1, 1, b"")),
        JOIN + pack(Send(0, 1, bytes(128))),
        pack(Join("tag", ("tag2",))) + pack(Send(0, 1, b"a tag that speaks")),
        pack(Join("dog", ("1",))),
        b"\xff\xff\xff\xff",
    ],
)
async def test_a_stranger_is_sent_away_and_the_others_do_not_notice(said):
    async with anchor_and_tag("2") as (air, anchor, tag):
        reader, writer = await asyncio.open_connection(HOST, air.port)
        writer.write(said)
        async with asyncio.timeout(20):
            answer = await reader.read()
        writer.close()
        last = from_ether.decode(list(Unpacker().feed(answer))[-1])
        assert isinstance(last, Refused)
        assert last.reason.startswith("not understood")
        await speak(anchor, tag)
        assert len(tag.of(Restarted)) == len(anchor.of(Restarted)) == 1
        async with nodes(air.port, "anchor", "1") as (freed,):
            await freed.until(Restarted)


@pytest.mark.parametrize("ticks", [-1, -(2**63), 2**40, 2**63, 2**64 - 1])
async def test_a_stamp_that_no_radio_has_hurts_nobody(ticks):
    async with anchor_and_tag("2") as (air, anchor, tag):
        _, writer = await asyncio.open_connection(HOST, air.port)
        writer.write(JOIN + pack(Send(0, ticks, b"")))
        await asyncio.sleep(0.05)
        await speak(anchor, tag)
        writer.close()


async def test_a_process_that_does_not_read_loses_frames_which_are_counted_and_the_others_none():
    async with anchor_and_tag("2") as (air, anchor, tag):
        loop = asyncio.get_running_loop()
        reader, writer = await asyncio.open_connection(HOST, air.port, limit=1)
        writer.write(pack(Join("tag", ("tag2",))))
        await asyncio.sleep(0.05)
        reader._transport.pause_reading()
        deaf = air.clients[-1]
        filled_s = loop.time() + 20.0
        while deaf._transport.get_write_buffer_size() <= 1 << 16 and loop.time() < filled_s:
            deaf._transport.write(pack(Refused("x" * 60_000)))  # as many frames would, in a minute
        for _ in range(3):
            await speak(anchor, tag)
        assert air.ether.health(0.0).overruns >= 3
        assert air.ether.health(0.0).overruns <= air.ether.health(0.0).transmissions
        assert len(tag.of(Reception)) == air.ether.health(0.0).transmissions
        writer.transport.abort()


@pytest.mark.parametrize(
    "answer", [b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\xff\xff\xff\xff", b"\x01\x00\x00\x00\xc1", b""]
)
async def test_a_radio_reports_that_what_answers_is_no_ether(answer):
    async def serve(reader, writer):
        await reader.read(4)
        writer.write(answer)
        await writer.drain()
        writer.close()

    server = await asyncio.start_server(serve, HOST, 0)
    async with nodes(server.sockets[0].getsockname()[1], "tag", "tag1") as (tag,):
        gone = await tag.until(Gone)
        assert gone.reason.startswith("what answers is no ether" if answer else "the ether has gone")
        assert tag.of(Restarted) == []
    server.close()


async def test_of_another_machine_s_ether_the_clock_is_shifted_to_this_one(monkeypatch):
    async with OpenAir() as air:
        air.ether.machine = "another"
        air.ether._origin_s -= 1000.0
        air.ether._clock = lambda: time.monotonic() - 1000.0
        async with nodes(air.port, "anchor", "1") as (anchor,), nodes(air.port, "tag", "tag1") as (tag,):
            await anchor.until(Restarted)
            await tag.until(Restarted)
            await speak(anchor, tag)
            assert 0.0 <= time.monotonic() - tag.of(Reception)[-1].host_s < 10.0


@pytest.mark.parametrize(
    ("spec", "host", "port"),
    [
        ("ether", "127.0.0.1", 7784),
        ("ether:", "127.0.0.1", 7784),
        ("ether:box", "box", 7784),
        ("ether:box:99", "box", 99),
        ("ether:[::1]:99", "::1", 99),
    ],
)
def test_a_radio_s_name_holds_the_address_of_its_ether(spec, host, port):
    assert host_and_port(spec, spec.partition(":")[2], 7784) == (host, port)
    assert is_simulated(spec)


@pytest.mark.parametrize("spec", ["", "dw1000:/dev/spidev0.0", "ether:box:0", "ether:box:65536", "ether:box:x"])
def test_a_radio_that_there_is_not_is_reported_with_what_would_be_right(spec):
    with pytest.raises(SkylessError, match="ether:HOST"):
        open_radios(spec, "tag", ("tag1",))
