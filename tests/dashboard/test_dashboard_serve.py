"""The server ends connections that never finish their first request, and no others."""

import asyncio
import socket

import pytest
import uvicorn
from page_fake_server import _free_port
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Route

from skyless.dashboard.serve import _Server


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nHost: localhost\r\n"])
def test_a_request_that_is_never_finished_is_ended(sent):
    async def slow(_request):
        await asyncio.sleep(1.0)
        return PlainTextResponse("done")

    async def run():
        port = _free_port()
        config = uvicorn.Config(Starlette(routes=[Route("/", slow)]), port=port, log_config=None, lifespan="off")
        server = _Server(config)
        serving = asyncio.create_task(server.serve())
        while not server.started:
            await asyncio.sleep(0.01)
        ending = asyncio.create_task(server.end_unfinished(0.2))
        idle_reader, idle_writer = await asyncio.open_connection("127.0.0.1", port, family=socket.AF_INET)
        idle_writer.write(sent)
        reader, writer = await asyncio.open_connection("127.0.0.1", port, family=socket.AF_INET)
        writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        async with asyncio.timeout(20.0):
            try:
                ended = await idle_reader.read()
            except ConnectionResetError:
                ended = b""
            answer = await reader.read()
        ending.cancel()
        server.should_exit = True
        await serving
        return ended, answer

    ended, answer = asyncio.run(run())
    assert ended == b""
    assert answer.endswith(b"done")
