"""The real gpsd, and a client of it."""

import asyncio
import json
import shutil
from contextlib import asynccontextmanager

from support.processes import free_port

GPSD = shutil.which("gpsd") or shutil.which("gpsd", path="/usr/sbin")
ANSWER_S = 20.0
"""For gpsd on a machine that does much else."""


class Client:
    """One of gpsd's clients."""

    def __init__(self, reader):
        self._reader = reader

    async def receive(self, wanted):
        """The first report that is wanted."""
        while True:
            report = json.loads(await asyncio.wait_for(self._reader.readline(), ANSWER_S))
            if wanted(report):
                return report


async def connected(port):
    """Reader and writer of a connection, as soon as somebody listens."""
    async with asyncio.timeout(ANSWER_S):
        while True:
            try:
                return await asyncio.open_connection("127.0.0.1", port)
            except ConnectionRefusedError:
                await asyncio.sleep(0.05)


@asynccontextmanager
async def gpsd(device):
    """A gpsd of its own that reads the device, and a client that watches it."""
    port = free_port()
    process = await asyncio.create_subprocess_exec(
        GPSD, "-N", "-n", "-S", str(port), device,
        stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    try:
        reader, writer = await connected(port)
        writer.write(b'?WATCH={"enable":true,"json":true}\n')
        yield Client(reader)
        writer.close()
    finally:
        process.terminate()
        await process.wait()
