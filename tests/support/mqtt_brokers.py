"""Real brokers for tests, both kinds behind one face."""

import asyncio
import contextlib
import os
import secrets
import shutil
import signal
import subprocess
import time
import weakref
from pathlib import Path

from skyless.run.broker import BrokerSettings, start_broker
from skyless.run.mqtt.address import MqttAddress
from support.processes import free_port
from support.waiting import until

MOSQUITTO = shutil.which("mosquitto", path=os.environ.get("PATH", "") + ":/usr/sbin")


class Embedded:
    """nats-server as Skyless starts it."""

    def __init__(self, folder, **settings):
        self.settings = BrokerSettings(port=free_port(), data=folder / "store", **settings)
        self.address = self.settings.address(self.settings.port)
        self.broker = None

    async def start(self):
        self.broker = await start_broker(self.settings)

    async def saved(self):
        """Until all that it has acknowledged would survive its death; here that is always so."""

    async def stop(self):
        await self.broker.stop()

    async def kill(self):
        os.kill(self.broker.pid, signal.SIGKILL)
        await self.broker.stop()

    def signal(self, number):
        os.kill(self.broker.pid, number)


def _in_memory():
    """A folder yet to be made that no disk slows down: mosquitto stands still for seconds while one saves its store."""
    memory = Path("/dev/shm")
    return memory / f"skyless-test-{secrets.token_hex(8)}" if os.access(memory, os.W_OK) else None


class Mosquitto:
    """Debian's mosquitto, keeping its store as ``docs/mqtt.md`` advises."""

    def __init__(self, folder, user=None, password=None, certificate=None, key=None):
        self.port = free_port()
        self.file = folder / "mosquitto.conf"
        store = _in_memory() or folder / "store"
        store.mkdir(mode=0o777)
        weakref.finalize(self, shutil.rmtree, store, ignore_errors=True)
        self.store = store / "mosquitto.db"
        lines = [f"listener {self.port} 127.0.0.1", "persistence true", f"persistence_location {store}/"]
        lines += ["autosave_interval 1", "max_queued_messages 0", "user root"]
        if user is None:
            lines.append("allow_anonymous true")
        else:
            words = folder / "passwords"
            subprocess.run(["mosquitto_passwd", "-b", "-c", words, user, password], check=True)
            lines += ["allow_anonymous false", f"password_file {words}"]
        if certificate:
            lines += [f"certfile {certificate}", f"keyfile {key}"]
        self.file.write_text("\n".join(lines) + "\n", encoding="utf-8")
        self.address = MqttAddress("127.0.0.1", self.port, certificate is not None, user, password)
        self.process = None

    async def start(self):
        self.process = await asyncio.create_subprocess_exec(
            MOSQUITTO, "-c", self.file, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL
        )
        async with asyncio.timeout(10):
            while True:
                with contextlib.suppress(OSError):
                    _, writer = await asyncio.open_connection("127.0.0.1", self.port)
                    writer.close()
                    return
                assert self.process.returncode is None, "mosquitto does not start"
                await asyncio.sleep(0.02)

    async def saved(self):
        """It writes its store down once a second, and then renames it."""
        begin_s = time.time()
        await until(lambda: self.store.exists() and self.store.stat().st_mtime > begin_s)

    async def stop(self):
        if self.process.returncode is None:
            self.process.terminate()
            await self.process.wait()

    async def kill(self):
        self.process.kill()
        await self.process.wait()

    def signal(self, number):
        self.process.send_signal(number)


@contextlib.asynccontextmanager
async def running(broker, *links):
    """A started broker, and links that run and are connected, one after the other.

    Of a message that is retained at the very moment of a subscription, nats-server tells the subscriber nothing.
    """
    await broker.start()
    tasks = []
    try:
        for link in links:
            tasks.append(asyncio.ensure_future(link.run()))
            await until(lambda link=link: link.connected)
        yield tasks
    finally:
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)
        await broker.stop()


async def subscribed(link):
    """Wait until the broker has a link's subscriptions: the link subscribes to its own status among them."""
    await until(lambda: link.connected and link._has_echo)


async def stopped(task):
    """Cancel a task until it has ended: before Python 3.12 ``wait_for`` may lose a cancellation to its result."""
    while not task.done():
        task.cancel()
        await asyncio.wait([task], timeout=1.0)
