"""``skyless demo`` as its user meets it: real processes, in a pipe, in a terminal, stopped in every way, and hurt."""

import asyncio
import contextlib
import json
import os
import pty
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from skyless.run.broker import BrokerSettings, start_broker
from skyless.run.mqtt.address import mqtt_address
from skyless.run.mqtt.connection import Introduction, Reactions, open_connection
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.topics import fix_topic, health_topic, status_topic
from support.waiting import running, until

pytestmark = pytest.mark.live

COMMAND = [sys.executable, "-m", "skyless.cli.main", "demo"]
START_S = 120.0
"""A first start compiles the kernels."""

CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f]")


class Demo:
    """A running demo whose data stand in a folder of the test's."""

    def __init__(self, folder, *arguments, **environment):
        self.errors = folder / "errors"
        with self.errors.open("w", encoding="utf-8") as errors:
            self.process = subprocess.Popen(
                [*COMMAND, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=dict(os.environ) | {"XDG_DATA_HOME": str(folder)} | environment,
            )

    @property
    def said(self):
        return self.errors.read_text(encoding="utf-8")

    def wait_for(self, condition):
        """Wait for something that should come while it runs."""
        until_s = time.monotonic() + START_S
        while not condition():
            assert self.process.poll() is None, self.said
            assert time.monotonic() < until_s, self.said
            time.sleep(0.02)

    def wait_until_it_runs(self, tags=3):
        """Broker, ether, anchors, tags, page, recorder; until each tag has sent another fix and its health."""
        self.wait_for(lambda: len(self.children()) >= 6 and Path(f"/proc/{self.process.pid}").exists())
        words = next(words for words in self.children().values() if "ether" in words)
        address = mqtt_address(words[words.index("--mqtt") + 1])
        asyncio.run(until_tags_tell(address, tags))

    def children(self):
        """Process numbers and command lines of all that it has started, and these in turn."""
        parents, found = processes(), {}
        wanted = {self.process.pid}
        while wanted:
            wanted = {pid for pid, (parent, _) in parents.items() if parent in wanted}
            found |= {pid: parents[pid][1] for pid in wanted}
        return found

    def child(self, word):
        """The process with this word in its command line."""
        (pid,) = [pid for pid, words in self.children().items() if word in words]
        return pid

    def end(self, number):
        """Send a signal; exit code and standard output, once it and all that it had started have gone."""
        pids = self.children()
        self.process.send_signal(number)
        out, _ = self.process.communicate(timeout=30)
        wait_until_gone(pids)
        return self.process.returncode, out


async def until_tags_tell(address, tags):
    """Wait until fixes and health of this number of tags have arrived from now on."""
    heard, link = set(), Link(address, "test", site=1, kind="watch")
    link.subscribe(fix_topic("+", "+"), lambda topic, _: heard.add(topic))
    link.subscribe(health_topic("+", "tag", "+"), lambda topic, _: heard.add(topic))
    async with running(link.run()):
        await until(lambda: len(heard) >= 2 * tags, START_S)


def processes():
    """Parent and command line of every living process."""
    found = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            with contextlib.suppress(OSError):
                state, parent = (
                    (folder / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[:2]
                )
                words = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
                if state != "Z":
                    found[int(folder.name)] = int(parent), words
    return found


def wait_until_gone(pids):
    until_s = time.monotonic() + 20.0
    while left := {pid: words for pid, (_, words) in processes().items() if pid in pids}:
        assert time.monotonic() < until_s, f"still there: {left}"
        time.sleep(0.05)


def take_ports(*ports):
    """Sockets that listen on these ports, so far as nobody else does."""
    taken = contextlib.ExitStack()
    for port in ports:
        with contextlib.suppress(OSError):
            taken.enter_context(socket.create_server(("127.0.0.1", port)))
    return taken


def test_json_also_where_ports_are_taken_and_nothing_can_be_written_at_home(tmp_path):
    (tmp_path / "temporary").mkdir()
    nowhere = {"HOME": "/proc/nowhere", "XDG_DATA_HOME": "/proc/nowhere", "TMPDIR": str(tmp_path / "temporary")}
    with take_ports(8080, 1883, 7784):
        demo = Demo(tmp_path, "--duration", "3", "--json", **nowhere)
        out, _ = demo.process.communicate(timeout=START_S)
    assert demo.process.returncode == 0, demo.said
    assert out.count("\n") == 1
    assert not CONTROL.search(out + demo.said)
    summary = json.loads(out)
    assert summary.keys() >= {"tags", "fixes", "rmse_m", "max_m", "p95_m", "sigma_m", "updates_per_s", "duration_s"}
    assert summary.keys() >= {"fix_latency_p50_s", "fix_latency_p99_s", "subscriber_latency_p99_s", "page", "broker"}
    assert summary["tags"] == 3
    assert summary["restarts"] == 0
    assert summary["duration_s"] >= 3.0
    # at most one for each message of the schedule; how many a busy machine skips is not judged here
    assert 0.0 < summary["updates_per_s"] <= 410.0
    assert summary["fixes"] <= summary["messages"]
    assert 0.0 < summary["rmse_m"] < 0.05
    assert summary["rmse_m"] < summary["max_m"] < 0.3
    assert 0.0 < summary["fix_latency_p50_s"] < summary["subscriber_latency_p99_s"]
    assert int(summary["page"].rpartition(":")[2]) > 8080
    assert int(summary["broker"].rpartition(":")[2]) > 1883
    assert summary["page"] in demo.said
    assert summary["broker"] in demo.said


def test_a_pipe_gets_the_places_and_the_tables_once_also_when_it_is_terminated_and_a_tag_is_a_board(tmp_path):
    demo = Demo(tmp_path, "--plain", "--tags", "2", "--boards", "1")
    demo.wait_until_it_runs(tags=2)
    time.sleep(3.0)  # errors count from a second after the first fix, rates between two reports of health
    code, out = demo.end(signal.SIGTERM)
    assert code == 0
    assert "stopped" in demo.said
    assert not CONTROL.search(out)
    assert re.search(r"^page      http://127\.0\.0\.1:\d+$", out, re.MULTILINE)
    assert re.search(r"^broker    mqtt://127\.0\.0\.1:\d+$", out, re.MULTILINE)
    rows = [line for line in out.splitlines() if line.startswith("tag")]
    assert [row.split()[0] for row in rows] == ["tags", "tag1", "tag2"]
    assert [" board " in row for row in rows] == [False, False, True]
    assert re.search(r"^board     tag2 computes by itself \(emulated\), at /", out, re.MULTILINE)
    assert "error/cm" in rows[0]
    assert not any("…" in row for row in rows)
    assert re.search(r"2 tags \(1 of them on emulated boards\), \d+ messages in \d+\.\d s: RMSE", out.splitlines()[-2])
    assert out.splitlines()[-1] == "gone with this demo: names and zones; --history FOLDER keeps them"
    assert len(list((tmp_path / "skyless" / "recordings").glob("*.mcap"))) == 1


def test_programs_that_die_are_started_again_and_ctrl_c_ends_all_with_a_summary(tmp_path):
    demo = Demo(tmp_path, "--json")
    demo.wait_until_it_runs()
    time.sleep(1.0)  # the demo hears of it a little later
    begin_s = time.monotonic()
    killed = {name: demo.child(word) for name, word in (("tags", "tag"), ("page", "dashboard"), ("anchors", "anchor"))}
    for pid in killed.values():
        os.kill(pid, signal.SIGKILL)
    for name in killed:
        ended = re.compile(rf"^{name}.* ended \(signal 9\)", re.MULTILINE)
        demo.wait_for(lambda ended=ended: ended.search(demo.said))
    demo.wait_until_it_runs()
    assert not killed.values() & demo.children().keys()
    broker = next(pid for pid, words in demo.children().items() if "nats-server" in words[0])
    os.kill(broker, signal.SIGKILL)
    demo.wait_for(lambda: "broker ended" in demo.said)
    demo.wait_until_it_runs()
    lived_s = time.monotonic() - begin_s
    code, out = demo.end(signal.SIGINT)
    assert code == 0
    assert "stopped" in demo.said
    assert "Traceback" not in demo.said
    summary = json.loads(out)
    assert summary["restarts"] == 3
    assert summary["tags"] == 3
    assert summary["duration_s"] > lived_s - 0.5


def test_a_demo_that_is_killed_leaves_no_program_behind(tmp_path):
    demo = Demo(tmp_path, "--json")
    demo.wait_until_it_runs()
    demo.end(signal.SIGKILL)


async def test_ctrl_c_while_it_starts_ends_all_and_leaves_nothing_at_a_broker_of_others(tmp_path):
    foreign = status_topic(1, "tag", "foreign")
    async with await start_broker(BrokerSettings(temporary=True)) as broker:
        demo = Demo(tmp_path, "--json", "--mqtt", str(broker.address))
        demo.wait_for(lambda: len(demo.children()) >= 2)
        connection = await open_connection(broker.address, None, Introduction("", 10))
        connection.publish(foreign, b"not a status", 1, retain=True)
        await connection.leave()
        while len(await retained(broker.address)) < 2:
            assert demo.process.poll() is None
        code, out = demo.end(signal.SIGINT)
        left = await retained(broker.address)
    assert code == 0
    assert "Traceback" not in demo.said
    assert json.loads(out)["rmse_m"] is None
    assert left == {foreign}


async def retained(address):
    """Topics of what the broker keeps."""
    topics = set()
    react = Reactions(message=lambda topic, payload: topics.add(topic))
    connection = await open_connection(address, None, Introduction("", 10), react)
    connection.subscribe({"#": 0})
    await asyncio.sleep(0.5)
    await connection.leave()
    return topics


def test_on_a_terminal_the_picture_is_drawn_again_and_again_until_ctrl_c(tmp_path):
    process, terminal = pty.fork()
    if process == 0:
        os.environ.update(TERM="xterm", COLUMNS="80", LINES="40", XDG_DATA_HOME=str(tmp_path))
        os.execv(COMMAND[0], COMMAND)
    written, pressed = b"", False
    try:
        while data := os.read(terminal, 65536):
            written += data
            if not pressed and written.count(b"anchors") >= 8:
                pressed = True
                os.write(terminal, b"\x03")
    except OSError:  # the program has gone
        pass
    _, status = os.waitpid(process, 0)
    os.close(terminal)
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written.decode(errors="replace"))  # Ctrl-C drops what waits
    assert os.waitstatus_to_exitcode(status) == 0, text
    assert "Traceback" not in text
    assert max(len(line) for line in text.replace("\r", "\n").split("\n") if line.startswith("tag")) <= 80
    assert "Ctrl-C stops" in text
    assert re.search(r"page +http://127\.0\.0\.1:\d+", text)
    assert "updates per second" in text or "no fix was made" in text


WRONG = [
    *("--duration -1", "--duration nan", "--tags 0", "--tags 201", "--speed 100", "--noise-ps inf", "--seed x"),
    *("--port 4", "--method guess", "--mqtt http://here"),
]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        *((words.split(), words.split()[0]) for words in WRONG),
        (["--mqtt-ca", "/nowhere.pem"], "--mqtt"),
        (["--site", "/nowhere.toml"], "nowhere.toml"),
        (["--record", "/nowhere/x.mcap"], "--record"),
    ],
)
def test_a_mistake_is_told_in_one_line(complaint, arguments, said):
    assert said in complaint("demo", *arguments)


def ask(page, path, body=None):
    """A question to the page's server, or something for it to keep."""
    request = urllib.request.Request(page + path, body, {"Origin": page}, method="GET" if body is None else "PUT")
    with urllib.request.urlopen(request, timeout=START_S) as answer:
        return json.loads(answer.read() or "null")


def test_the_demo_has_zones_names_a_rule_and_a_place_on_the_earth_for_other_tools(tmp_path):
    demo = Demo(tmp_path, "--json", "--history", str(tmp_path / "history"))
    demo.wait_until_it_runs()
    page, broker = (re.search(rf"{word}://127.0.0.1:\d+", demo.said)[0] for word in ("http", "mqtt"))
    demo.wait_for(lambda: ask(page, "/api/v1/alarms")["alarms"])
    (alarm,) = ask(page, "/api/v1/alarms")["alarms"]
    assert re.match(r"Ada \(tag3\) (is|has been|was) in Robot cell", alarm["sentence"])
    assert [asset["name"] for asset in ask(page, "/api/v1/assets")["assets"]] == ["Trolley", "Forklift", "Ada"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reader:
        reader.settimeout(START_S)
        reader.bind(("127.0.0.1", 0))
        bridge = ["bridge", f"nmea+udp://127.0.0.1:{reader.getsockname()[1]}", "--mqtt", broker]
        with subprocess.Popen([*COMMAND[:-1], *bridge]) as bridging:
            try:
                assert reader.recv(1000).startswith(b"$GN")
            finally:
                bridging.terminate()
    zones = json.dumps({"zones": [{"id": "own", "name": "Own", "polygon_m": [[0, 0], [1, 0], [1, 1]]}]})
    ask(page, "/api/zones", zones.encode())
    demo.end(signal.SIGINT)
    again = Demo(tmp_path, "--history", str(tmp_path / "history"))
    again.wait_until_it_runs()
    # Nothing else uses its ports meanwhile, so that the page is where the first one was.
    again.wait_for(lambda: [zone["id"] for zone in ask(page, "/api/v1/zones")["zones"]] == ["own"])
    _, out = again.end(signal.SIGINT)
    assert "3 tags" in out
    assert "gone with this demo" not in out
