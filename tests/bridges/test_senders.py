"""Senders on the real system: what readers get, and what one that never reads costs."""

import asyncio
import contextlib
import functools
import socket
import stat

import pytest

from skyless.bridges.jsonl import JsonLines
from skyless.bridges.targets import PtySender, SerialSender, TcpServer, UdpSender
from skyless.core.errors import SkylessError
from skyless.radio.serial.serial_port import Pty
from skyless.run.web import BRIDGES as LIMITS
from support import waiting


@contextlib.asynccontextmanager
async def running(sender):
    async with waiting.running(sender.run()):
        yield sender


async def listening(server):
    while server.port == 0:
        await asyncio.sleep(0.001)
    return server.port


@pytest.mark.site
async def test_tcp_readers_get_the_greeting_and_then_everything():
    async with running(TcpServer("t:", "127.0.0.1", 0, lambda: [b"hello\n"])) as server:
        port = await listening(server)
        one, _ = await asyncio.open_connection("127.0.0.1", port)
        two, leaving = await asyncio.open_connection("127.0.0.1", port)
        assert [await one.readline(), await two.readline()] == [b"hello\n"] * 2
        server.send(b"first\n")
        assert [await one.readline(), await two.readline()] == [b"first\n"] * 2
        leaving.close()
        await leaving.wait_closed()
        for number in range(100):
            server.send(b"%d\n" % number)
        assert [await one.readline() for _ in range(100)] == [b"%d\n" % number for number in range(100)]
    assert await one.read() == b"", "the end of the server ends its connections"


@pytest.mark.site
async def test_a_tcp_reader_that_never_reads_costs_no_other_a_byte_and_is_disconnected():
    async with running(TcpServer("t:", "127.0.0.1", 0, list)) as server:
        port = await listening(server)
        asleep = socket.create_connection(("127.0.0.1", port))
        awake, held = await asyncio.open_connection("127.0.0.1", port)
        while len(server._readers) < 2:
            await asyncio.sleep(0.001)
        line = b"x" * 999 + b"\n"

        async def send():
            server.send(line)
            assert await awake.readline() == line

        while not server.dropped["slow-reader"]:  # until the buffers of the system are full
            await send()
        assert len(server._readers) == 2
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        while len(server._readers) > 1:  # minutes go by; the system may take a little more of what waits
            now_s += 60.0
            loop.time = functools.partial(float, now_s)
            server.send(line)
            del loop.time
            assert await awake.readline() == line
        asleep.close()
        held.close()


@pytest.mark.site
async def test_more_connections_than_allowed_are_closed_at_once():
    async with running(TcpServer("t:", "127.0.0.1", 0, list)) as server:
        port = await listening(server)
        held = [await asyncio.open_connection("127.0.0.1", port) for _ in range(LIMITS.readers)]
        reader, _ = await asyncio.open_connection("127.0.0.1", port)
        with contextlib.suppress(ConnectionResetError):
            assert await reader.read() == b""
        assert len(server._readers) == LIMITS.readers
        assert server.dropped == {"too-many-readers": 1}
        del held


@pytest.mark.site
async def test_a_port_in_use_is_named(taken):
    with pytest.raises(SkylessError, match=f"'t:' cannot listen on 127.0.0.1:{taken}: Address already in use"):
        await TcpServer("t:", "127.0.0.1", taken, list).run()


@pytest.mark.site
async def test_datagrams_arrive_one_by_one_and_none_is_missed_aloud():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as inbox:
        inbox.bind(("127.0.0.1", 0))
        inbox.settimeout(10)
        said = []
        async with running(UdpSender("u:", "127.0.0.1", inbox.getsockname()[1], said.append)) as sender:
            sender.send(b"one")
            sender.send(b"two")
            assert [inbox.recv(99), inbox.recv(99)] == [b"one", b"two"]
            for _ in range(3):
                sender.send(b"x" * 70_000)  # no datagram is so long
            assert sender.dropped["not-sent"] == 3
            assert len(said) == 1
            sender.send(b"three")
            assert inbox.recv(99) == b"three"


async def test_a_pseudo_terminal_that_nobody_reads_holds_only_what_is_new(tmp_path):
    link, said = tmp_path / "tag1", []
    async with running(PtySender("p:", str(link), said.append)) as sender:
        assert str(link) in said[0]
        assert stat.S_IMODE(link.stat().st_mode) == 0o666  # gpsd opens it without any rights
        for number in range(3000):
            sender.send(b"%07d\n" % number)
        assert sender.dropped["not-read"] > 0
        with link.open("rb", buffering=0) as port:
            data = await asyncio.to_thread(port.read, 1 << 16)
            assert len(data) <= 4096, "not more than the system itself holds"
            while not data.endswith(b"0002999\n"):  # the system passes on what it holds piece by piece
                data += await asyncio.to_thread(port.read, 1 << 16)
            numbers = [int(line) for line in data.split(b"\n")[1:-1]]
            assert numbers == list(range(numbers[0], 3000))
            assert numbers[0] > 1000
            sender.send(b"9999999\n")
            assert (await asyncio.to_thread(port.read, 1 << 16)).endswith(b"9999999\n")
    assert not link.exists()


async def test_a_path_in_the_way_of_a_link_is_named(tmp_path):
    (tmp_path / "file").write_text("keep me")
    with pytest.raises(SkylessError, match=r"'p:' has the path .*; it should be a free name"):
        await PtySender("p:", str(tmp_path / "file"), print).run()
    assert (tmp_path / "file").read_text() == "keep me"


async def test_a_pseudo_terminal_and_its_link_are_there_only_while_it_runs(tmp_path):
    link = tmp_path / "tag1"
    sender = PtySender("p:", str(link), lambda _line: None)
    sender.send(b"early")
    assert not link.is_symlink(), "another target may be wrong, and the program end"
    async with running(sender):
        assert link.exists()
    assert not link.is_symlink()
    sender.send(b"late")
    assert sender.dropped == {"not-read": 2}


@pytest.mark.site
async def test_a_message_longer_than_what_may_wait_reaches_a_reader_for_whom_nothing_waits():
    greeting = b"x" * 200_000 + b"\n"  # a site of thousands of anchors
    async with running(TcpServer("t:", "127.0.0.1", 0, lambda: [greeting])) as server:
        reader, writer = await asyncio.open_connection("127.0.0.1", await listening(server), limit=1 << 20)
        assert await reader.readline() == greeting
        server.send(greeting)
        server.send(b"missed\n")
        assert await reader.readline() == greeting
        assert server.dropped == {"slow-reader": 1}
        writer.close()


async def test_a_serial_port_gets_bytes_once_it_is_there(tmp_path):
    said, path, got = [], tmp_path / "port", bytearray()
    async with running(SerialSender("s:", str(path), 115_200, said.append)) as sender:
        sender.send(b"lost")
        assert sender.dropped["no-port"] == 1
        await waiting.until(lambda: said)
        device = Pty(path)
        device.start(got.extend)
        await waiting.until(lambda: sender._write is not None)
        sender.send(b"found")
        await waiting.until(lambda: bytes(got) == b"found")
        assert len(said) == 1
        assert "there is no" in said[0]
        device.close()


def test_a_stream_of_json_lines_begins_with_the_site():
    assert JsonLines().greeting() == []
