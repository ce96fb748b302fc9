"""Connections of the page's server that never finish a request, and too many of them."""

import asyncio
import contextlib
import errno
import logging

import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Route

from skyless.page import connections
from skyless.page.connections import Connection, FailedAccepts, end_unfinished
from skyless.run.web import PageLimits
from support.processes import free_port
from support.waiting import until

pytestmark = pytest.mark.site

GET = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
SLOW = GET.replace(b"/ H", b"/slow H")
LAST = GET.replace(b"\r\n\r\n", b"\r\nConnection: close\r\n\r\n")
UNFINISHED = {
    "nothing": b"",
    "half a head": GET[:-2],
    "a head without its body": GET.replace(b"GET", b"POST").replace(b"\r\n\r\n", b"\r\nContent-Length: 9\r\n\r\n"),
    "one answered, then one byte": GET + b"G",
}


@contextlib.asynccontextmanager
async def serving(release=None):
    """A server with the page's connections; what asks for ``/slow`` is answered when it is released."""

    async def at_once(request):
        await request.body()
        return PlainTextResponse("done")

    async def slow(_request):
        await release.wait()
        return PlainTextResponse("late")

    app = Starlette(routes=[Route("/", at_once, methods=["GET", "POST"]), Route("/slow", slow)])
    server = uvicorn.Server(uvicorn.Config(app, http=Connection, port=free_port(), log_config=None, lifespan="off"))
    task = asyncio.create_task(server.serve())
    await until(lambda: server.started)
    try:
        yield server
    finally:
        server.should_exit = server.force_exit = True
        await task


async def sent(server, data):
    """The two ends of a connection on which this is sent."""
    reader, writer = await asyncio.open_connection("127.0.0.1", server.config.port)
    writer.write(data)
    return reader, writer


async def rest(reader):
    """What comes until the connection ends."""
    async with asyncio.timeout(20.0):
        try:
            return await reader.read()
        except ConnectionResetError:
            return b""


@pytest.mark.parametrize("data", UNFINISHED.values(), ids=UNFINISHED)
async def test_a_request_that_is_never_finished_is_ended(data):
    release = asyncio.Event()
    async with serving(release) as server:
        slow, open_end = await sent(server, SLOW)
        reader, writer = await sent(server, data)
        ending = asyncio.create_task(end_unfinished(server.server_state.connections, 0.2, 0.4))
        ended = await rest(reader)
        assert ended.endswith(b"done" if data.startswith(GET) else b"")
        release.set()
        async with asyncio.timeout(20.0):
            assert (await slow.readuntil(b"late")).startswith(b"HTTP/1.1 200"), "one that is answered goes on"
        ending.cancel()
        writer.close(), open_end.close()


async def test_requests_that_are_not_finished_make_room_for_a_reader(monkeypatch):
    monkeypatch.setattr(connections, "LIMITS", PageLimits(connections_per_address=8))
    async with serving() as server:
        halves = [await sent(server, data) for data in 10 * tuple(UNFINISHED.values())]
        reader, writer = await sent(server, LAST)
        assert (await rest(reader)).endswith(b"done")
        assert len(server.server_state.connections) <= 8
        for _, end in (*halves, (reader, writer)):
            end.close()


@pytest.mark.parametrize(("limit", "said"), [("connections", b""), ("connections_per_address", b" of this ")])
async def test_beyond_the_limit_of_requests_in_work_a_client_is_told(monkeypatch, limit, said):
    monkeypatch.setattr(connections, "LIMITS", PageLimits(**{limit: 3}))
    release = asyncio.Event()
    async with serving(release) as server:
        busy = [await sent(server, SLOW) for _ in range(3)]
        await until(lambda: len(server.server_state.connections) == 3)
        reader, writer = await sent(server, b"")
        refusal = await rest(reader)
        assert refusal.startswith(b"HTTP/1.1 503") and b"3 connections" + said in refusal
        release.set()
        for _, end in (*busy, (reader, writer)):
            end.close()


def test_failed_accepts_are_one_line_a_minute(caplog):
    log = logging.getLogger("asyncio")
    one_a_minute = FailedAccepts()
    log.addFilter(one_a_minute)
    for _ in range(1000):
        log.error("%s", "socket.accept() out of system resource", exc_info=OSError(errno.EMFILE, "Too many open files"))
    log.error("something else")
    log.removeFilter(one_a_minute)
    assert [record.getMessage() for record in caplog.records] == [
        "socket.accept() out of system resource", "something else"
    ]  # fmt: skip
    assert "Traceback" not in caplog.text
