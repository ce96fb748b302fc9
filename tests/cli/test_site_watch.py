"""``skyless watch`` as its user meets it: at a real broker, in a pipe and on a terminal."""

import asyncio
import contextlib
import fcntl
import json
import os
import pty
import signal
import struct
import termios
import time
from itertools import count

import msgspec
import pytest

from skyless.cli.nodes.site_view import site_number
from skyless.core.errors import SkylessError
from skyless.run.mqtt import topics
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import AlarmMessage, SiteMessage
from skyless.sim.lab import lab_site
from support import waiting
from support.mqtt_brokers import Embedded, running
from support.processes import SKYLESS, usual_signals
from support.site_messages import a_fix, tag_health
from support.waiting import until

pytestmark = pytest.mark.site

SITE = msgspec.structs.replace(lab_site(), id=9)


@contextlib.asynccontextmanager
async def published_site(folder):
    """A broker, and a tag whose program publishes."""
    broker = Embedded(folder)
    link = Link(broker.address, "t1", site=9, kind="tag")

    async def publish():
        for serial in count(1):
            fix = a_fix(serial=serial, unix_s=time.time(), position_m=(1.25, 2.5, 0.0))
            link.publish(topics.fix_topic(9, "t1"), fix)
            health = tag_health(unix_s=time.time(), counters={"bad-fcs": 3})
            link.publish(topics.health_topic(9, "tag", "t1"), health)
            await asyncio.sleep(0.1)

    async with running(broker, link), waiting.running(publish()):
        alarm = AlarmMessage("r/t1", "r", "Rule", "inside", "critical", "t1", 1.0, 1.0, "Crane is in the cold store")
        for topic, message in (
            (topics.site_topic(9), SiteMessage(SITE, simulated=True, unix_s=time.time())),
            (topics.alarm_topic(9, "r", "t1"), alarm),
        ):
            link.publish(topic, message, qos=1, retain=True)
        await until(lambda: not link.unacknowledged)
        yield str(broker.address)


async def said(*arguments):
    process = await asyncio.create_subprocess_exec(
        *SKYLESS, *arguments, stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE, preexec_fn=usual_signals(),
    )  # fmt: skip
    out, _ = await process.communicate()
    return process.returncode, out.decode()


async def on_a_terminal(address):
    """What is drawn on a terminal of 80 columns until Ctrl-C ends it, and the exit code."""
    host, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    process = await asyncio.create_subprocess_exec(
        *SKYLESS, "watch", "--mqtt", address, stdin=terminal, stdout=terminal, stderr=asyncio.subprocess.DEVNULL,
        env=os.environ | {"TERM": "xterm", "COLUMNS": "", "LINES": ""}, preexec_fn=usual_signals(),
    )  # fmt: skip
    drawn = bytearray()
    asyncio.get_running_loop().add_reader(host, lambda: drawn.extend(os.read(host, 65536)))
    try:
        await until(lambda: b"Crane" in drawn and b"cold store" in drawn, 60.0)
        process.send_signal(signal.SIGINT)
        async with asyncio.timeout(20.0):
            code = await process.wait()
        await until(lambda: b"\x1b[?1049l" in drawn)
    finally:
        asyncio.get_running_loop().remove_reader(host)
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        os.close(host)
        os.close(terminal)
    return code, drawn.decode(errors="replace")


async def test_a_site_is_shown_in_a_pipe_as_json_and_on_a_terminal(tmp_path):
    async with published_site(tmp_path) as address:
        once = ("watch", "--mqtt", address)
        (text_code, text), (json_code, line), (code, drawn) = await asyncio.gather(
            said(*once), said(*once, "--json", "--site-id", "9"), on_a_terminal(address)
        )
    picture = json.loads(line.splitlines()[-1])
    assert (picture["site"], picture["number"], picture["trouble"]) == (SITE.name, 9, None)
    (tag,) = picture["tags"]
    assert (tag["tag"], tag["state"], tag["fix"]["position_m"]) == ("t1", "fix", [1.25, 2.5, 0.0])
    assert len(picture["anchors"]) == 6
    assert picture["drops"] == {"bad-fcs": 3}
    assert picture["alarms"][0]["sentence"] == "Crane is in the cold store"
    assert json_code == text_code == (1 if picture["condition"]["level"] == "bad" else 0)
    (row,) = [line for line in text.splitlines() if line.startswith("t1 ")]
    assert "1.25" in row
    assert "drops bad-fcs 3" in text
    assert code == 0
    assert "\x1b[?1049h" in drawn


async def test_a_broker_without_a_site_is_told(tmp_path):
    async with running(broker := Embedded(tmp_path)):
        with pytest.raises(SkylessError, match="no program of a site is online"):
            await site_number(broker.address, 0.5)
