"""A site of real processes that a test can hurt."""

import asyncio
import contextlib
import signal
import time

from support.mqtt_brokers import Mosquitto
from support.processes import SKYLESS, free_port, usual_signals

START_S = 120.0
"""A first start compiles the kernels."""

PLACES = ((0.0, 0.0), (8.0, 0.0), (8.0, 3.0), (8.0, 6.0), (4.0, 6.0), (0.0, 6.0), (0.0, 3.0))
SITE = 77
ANCHORS = tuple(range(1, len(PLACES) + 1))
TAGS = ("tag1", "tag2", "tag3")


def site_file(folder):
    """Seven anchors on the walls of 8 m × 6 m, the first one the master."""
    lines = [
        'name = "seven"',
        f"id = {SITE}",
        "master = 1",
        "[schedule]",
        "slot_s = 0.0025",
        "[tags]",
        "height_m = 0.0",
    ]
    for number, (x_m, y_m) in zip(ANCHORS, PLACES, strict=True):
        lines += ["[[anchors]]", f"id = {number}", f"x_m = {x_m}", f"y_m = {y_m}"]
    file = folder / "seven.toml"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


class Program:
    """One ``skyless`` program as a process, which ends with the test however that ends."""

    def __init__(self, *arguments, environment=None):
        self.environment = environment
        self.arguments = [str(argument) for argument in arguments]
        self.process = None
        self.said = []
        """Time and words of each line."""
        self._reader = None

    async def start(self):
        self.said.clear()
        self.process = await asyncio.create_subprocess_exec(
            *SKYLESS,
            *self.arguments,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            env=self.environment,
            preexec_fn=usual_signals(),
        )
        self._reader = asyncio.ensure_future(self._read(self.process))

    async def _read(self, process):
        async for line in process.stdout:
            self.said.append((time.monotonic(), line.decode(errors="replace").rstrip()))

    async def heard(self, words):
        """When it said something; the test fails if it never does."""
        async with asyncio.timeout(START_S):
            while True:
                for when_s, line in self.said:
                    if words in line:
                        return when_s
                assert self.process.returncode is None, f"{self.arguments} ended: {self.said}"
                await asyncio.sleep(0.005)

    def signal(self, number):
        self.process.send_signal(number)

    async def kill(self):
        self.signal(signal.SIGKILL)
        await self.process.wait()

    async def stop(self):
        """End it as a person would; its exit code."""
        if self.process is None or self.process.returncode is not None:
            return None
        with contextlib.suppress(ProcessLookupError):
            self.process.terminate()
        async with asyncio.timeout(20):
            return await self.process.wait()


@contextlib.asynccontextmanager
async def together(programs):
    """Programs that run; what they said, when they have ended."""
    lines = []
    try:
        await asyncio.gather(*(program.start() for program in programs))
        yield lines
    finally:
        await asyncio.gather(*(program.stop() for program in programs))
    lines += (line for program in programs for _, line in program.said)


class SevenAnchors:
    """Ether, seven anchors and three tags, each a process, at Debian's mosquitto."""

    def __init__(self, folder):
        self.site_file = site_file(folder)
        self.broker = Mosquitto(folder)
        self.port = free_port()
        mqtt = ("--mqtt", str(self.broker.address))
        site, radio = ("--site", self.site_file), ("--radio", f"ether:127.0.0.1:{self.port}")
        self.ether = Program("ether", *site, *mqtt, "--tags", len(TAGS), "--listen", f"127.0.0.1:{self.port}")
        self.anchors = {number: Program("anchor", number, *site, *radio, *mqtt) for number in ANCHORS}
        self.tags = {name: Program("tag", name, *radio, *mqtt, "--publish-hz", 100) for name in TAGS}
        self.page_port = free_port()
        page = ("dashboard", *mqtt, "--listen", f"127.0.0.1:{self.page_port}", "--site-id", SITE)
        self.page = Program(*page)

    @property
    def programs(self):
        return [self.ether, *self.anchors.values(), *self.tags.values(), self.page]

    async def start(self):
        await self.broker.start()
        await asyncio.gather(*(program.start() for program in self.programs))
        await asyncio.gather(*(program.heard("on the air") for program in self.anchors.values()))
        await asyncio.gather(*(program.heard("listening") for program in self.tags.values()))

    async def stop(self):
        """End all; the exit codes of those that were still running."""
        codes = await asyncio.gather(*(program.stop() for program in self.programs))
        await self.broker.stop()
        return [code for code in codes if code is not None]
