"""A hub of three real servers, a site whose line can be cut, and a program that sends it numbered batches.

The servers' files are those of ``skyless hub init``; the site is ``skyless broker --gather --hub``. Its line goes
through a proxy. 20 batches of 20 fixes a second are sent into the site's stream, each until it is acknowledged.
"""

import asyncio
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
from nats.errors import Error
from pyarrow import parquet

from skyless.run.fix_batch import RECORD, Batch, decode_batch, encode_batch
from skyless.run.gather import subjects
from skyless.run.gather.streams import Names, follow
from skyless.run.gather.subjects import connect, nats_address
from skyless.run.history.layout import current_files
from skyless.run.hub_files import LEAF_PORT
from skyless.run.process import end_with_parent

SITE = 7
FIX_STREAM = subjects.at(subjects.FIX_STREAM, SITE)
TAGS = 5
RECORDS = 20
PERIOD_S = 0.05
LIMIT_S = 240.0
SKYLESS = (sys.executable, "-m", "skyless.cli.main")
NATS_SERVER = Path(sys.executable).with_name("nats-server")


def quiet(_line):
    """Takes no notice of a trouble, of which there are many here."""


class Process:
    """A program that can be killed and started again."""

    def __init__(self, *command, log):
        self._command, self._log = command, log
        self._process = None

    def start(self):
        with self._log.open("ab") as log:
            pipes = {"stdout": subprocess.PIPE, "stderr": log, "text": True}
            self._process = subprocess.Popen(self._command, preexec_fn=end_with_parent(), **pipes)  # noqa: PLW1509

    def first_line(self):
        """What it says when it is ready. Raises RuntimeError: it has ended."""
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"{' '.join(map(str, self._command))} has ended: {self._log.read_text()[-2000:]}")
        return json.loads(line)

    def kill(self, number=signal.SIGKILL):
        self._process.send_signal(number)
        out, _ = self._process.communicate(timeout=LIMIT_S)
        return out

    @property
    def runs(self):
        return self._process is not None and self._process.poll() is None

    @property
    def pid(self):
        return self._process.pid


class Line:
    """Forwards TCP connections to a port until it is cut."""

    def __init__(self, target):
        self._target, self._is_cut = target, False
        self._writers = set()

    async def open(self):
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        return self._server.sockets[0].getsockname()[1]

    def cut(self, *, is_cut=True):
        self._is_cut = is_cut
        for writer in list(self._writers):
            writer.transport.abort()

    async def _serve(self, reader, writer):
        try:
            if self._is_cut:
                raise ConnectionError
            far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._target)
        except OSError:
            writer.transport.abort()
            return
        self._writers |= {writer, far_writer}
        with contextlib.suppress(OSError, asyncio.CancelledError):
            await asyncio.gather(self._pump(reader, far_writer), self._pump(far_reader, writer))
        self._writers -= {writer, far_writer}

    async def _pump(self, reader, writer):
        try:
            while data := await reader.read(65_536):
                writer.write(data)
                await writer.drain()
        finally:
            writer.transport.abort()


class Stage:
    """A hub, the line to it, a site and its sender. ``ports`` are free ones, apart from each other by their offsets."""

    def __init__(self, folder, ports, mqtt_port):
        self.folder, self._ports, self._mqtt_port = folder, ports, mqtt_port
        self.servers, self.lines = [], []
        self.acknowledged, self.sequence = 0, 0
        self.arrivals = []

    async def __aenter__(self):
        hub = self.folder / "hub"
        nodes = [word for port in self._ports for word in ("--node", f"127.0.0.1:{port}")]
        store = ("--data", self.folder / "store", "--fixes-gb", "0.2")
        run(*SKYLESS, "hub", "init", hub, *nodes, "--sites", SITE, *store)
        for port in self._ports:
            self.servers.append(
                Process(NATS_SERVER, "-c", hub / f"127.0.0.1-{port}/nats-server.conf", log=self.folder / "hub.log")
            )
            self.servers[-1].start()
        await asyncio.to_thread(run, *SKYLESS, "hub", "apply", hub)
        lines = (hub / "tenants/plant.env").read_text().splitlines()
        variables = dict(line.split("=", 1) for line in lines if "=" in line)
        self.password = variables["SKYLESS_MQTT_PASSWORD"]
        address = variables["SKYLESS_HUB"].replace("@", f":{self.password}@")
        self.address, self.hub_url = nats_address(address), variables["SKYLESS_HUB"]
        leaf = json.loads((hub / f"sites/plant-site{SITE}.json").read_text())
        self.lines = [Line(port + LEAF_PORT) for port in self._ports]
        leaf["urls"] = [f"nats://127.0.0.1:{await line.open()}" for line in self.lines]
        file = self.folder / "leaf.json"
        file.write_text(json.dumps(leaf))
        place = ("--port", str(self._mqtt_port), "--data", self.folder / "site", "--keep-gb", "0.2")
        self.broker = Process(
            *SKYLESS, "broker", "--gather", "--hub", file, *place, "--json", log=self.folder / "broker.log"
        )
        await self.start_broker()
        self._is_sending, self._sending = True, asyncio.ensure_future(self._send())
        return self

    async def __aexit__(self, *_):
        await self.stop_sending()
        for process in (self.broker, *self.servers):
            if process.runs:
                process.kill(signal.SIGTERM)

    async def start_broker(self):
        self.broker.start()
        self._stated = await asyncio.to_thread(self.broker.first_line)

    def kill_broker(self):
        self.broker.kill()  # nats-server ends with it

    def kill_gather(self):
        for file in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                pid, parent = int(file.parent.name), int(file.read_text().rpartition(")")[2].split()[1])
                if parent == self.broker.pid and b"gather\0--nats" in (file.parent / "cmdline").read_bytes():
                    os.kill(pid, signal.SIGKILL)

    def cut(self, *, is_cut=True):
        for line in self.lines:
            line.cut(is_cut=is_cut)

    async def _send(self):
        """Number by number, each until it is acknowledged, whatever happens to the server."""
        run_number = random.randrange(1, 2**32)
        names = [f"tag{number}" for number in range(TAGS)]
        while self._is_sending:
            client = None
            with contextlib.suppress(Error, TimeoutError, OSError, AssertionError):
                address = nats_address(self._stated["nats"])
                client = await asyncio.wait_for(connect(address, "sender", quiet, Counter()), 5)
                stream = client.jetstream()
                table = Names(stream, SITE)
                await table.read()
                await table.give(names, "sender", time.time())
                while self._is_sending and self.broker.runs:
                    records = np.zeros(RECORDS, RECORD)
                    first = self.acknowledged * RECORDS
                    records["position_mm"][:, 0] = np.arange(first, first + RECORDS)
                    records["tag"] = [table.numbers[names[number % TAGS]] for number in range(RECORDS)]
                    records["unix_us"] = round(1e6 * time.time())
                    number = self.acknowledged + 1
                    batch = Batch(run_number, number, round(1e6 * time.time()), table.issue, records)
                    subject = subjects.at(subjects.FIXES, SITE, "sender")
                    await stream.publish(subject, encode_batch(batch), headers={"Nats-Msg-Id": batch.id}, timeout=3)
                    self.acknowledged = number
                    await asyncio.sleep(PERIOD_S)
            if client is not None:
                await client.close()
            await asyncio.sleep(0.1)

    async def view(self):
        """Note when batches arrive at the hub, by core NATS, until cancelled."""
        client = await connect(self.address, "viewer", quiet, Counter())

        async def note(_message):
            self.arrivals.append(time.monotonic())

        try:
            await client.subscribe(subjects.at(subjects.FIXES, SITE), cb=note)
            await asyncio.Event().wait()
        finally:
            await client.close()

    async def stop_sending(self):
        """Nothing is sent any more, and the last batch is acknowledged."""
        self._is_sending = False
        await self._sending

    async def complete(self):
        """Wait until the hub's stream has what is acknowledged now. Seconds, or infinity."""
        aim, begin_s = self.acknowledged, time.monotonic()
        client = await connect(self.address, "reader", quiet, Counter())
        try:
            while time.monotonic() < begin_s + LIMIT_S:
                with contextlib.suppress(Error):
                    if (await client.jetstream().stream_info(FIX_STREAM)).state.messages >= aim:
                        return time.monotonic() - begin_s
                await asyncio.sleep(0.2)
            return float("inf")
        finally:
            await client.close()

    async def sequences(self):
        """Those of the batches in the hub's stream, in its order."""
        client = await connect(self.address, "reader", quiet, Counter())
        try:
            found = []
            async for message in follow(client.jetstream(), FIX_STREAM, ">", quiet):
                found.append(decode_batch(message.data).sequence)
                if len(found) >= self.acknowledged:
                    return found
        finally:
            await client.close()


def run(*command):
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{command}: {done.stderr}")


async def at_random(stage, seed, actions):
    """Whether everything is in the history once, after kills and cuts."""
    draw, folder = random.Random(seed), stage.folder / "history"
    program = Process(
        *SKYLESS, "history", "run", "--from", str(stage.address).replace("@", f":{stage.password}@"), "--to", folder,
        "--json", log=stage.folder / "history.log",
    )  # fmt: skip
    program.start()
    for place in range(actions):
        kind = draw.choice(("server", "server", "line", "broker", "gather", "history"))
        seconds, server = draw.uniform(0.3, 4.0), draw.choice(stage.servers)
        print(f"{place + 1:3}: {kind}, {seconds:.1f} s, {stage.acknowledged} batches acknowledged", flush=True)
        match kind:
            case "server":
                server.kill()
                await asyncio.sleep(seconds)
                server.start()
            case "line":
                stage.cut()
                await asyncio.sleep(seconds)
                stage.cut(is_cut=False)
            case "broker":
                stage.kill_broker()
                await asyncio.sleep(seconds)
                await stage.start_broker()
            case "gather":
                stage.kill_gather()
            case "history":
                program.kill()
                await asyncio.sleep(seconds)
                program.start()
        await asyncio.sleep(draw.uniform(0.3, 2.0))
    await stage.stop_sending()
    aim, rows = stage.acknowledged * RECORDS, []
    print(f"complete at the hub {await stage.complete():.1f} s after the last one", flush=True)
    for pause_s in (5, 10, 20, 40, 80):
        await asyncio.sleep(pause_s)
        print(program.kill(signal.SIGINT), end="", flush=True)
        rows = [x for file in current_files(folder, SITE) for x in parquet.read_table(file)["x_mm"].to_pylist()]
        if len(rows) >= aim:
            break
        program.start()
    found = await stage.sequences()
    is_whole, is_ordered = sorted(rows) == list(range(aim)), found == list(range(1, stage.acknowledged + 1))
    print(f"{len(rows)} of {aim} acknowledged fixes in the history, each once: {is_whole}; in order: {is_ordered}")
    return is_whole and is_ordered
