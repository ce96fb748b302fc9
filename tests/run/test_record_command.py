"""``skyless record`` against real brokers and the tags' real program, whose radio plays a simulated tape."""

import asyncio
import contextlib
import json
import os
import resource
import signal
import time
from collections import Counter

import msgspec
import pytest

from skyless.core.air.frame import Reception
from skyless.research.replays.site import SiteReplay
from skyless.run import record
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import RawReception, ReceptionsMessage, SegmentStart, SiteMessage, StatusMessage
from skyless.run.mqtt.topics import receptions_topic, site_topic, status_topic
from skyless.run.record import RecorderNode
from skyless.run.recordings.recorder import McapFile
from skyless.run.recordings.recording import McapRecording
from skyless.run.tag import Tags, TagSettings
from support.bench import LAB, tape
from support.mqtt_brokers import MOSQUITTO, Embedded, Mosquitto
from support.processes import SKYLESS, usual_signals
from support.waiting import until

pytestmark = pytest.mark.site

SECONDS = 20.0
PLACES = ((3.0, 4.0, 0.0), (2.0, 2.0, 0.0))


class TapeRadio:
    """Plays what a simulated tag hears, in real time."""

    def __init__(self, name, position):
        self.name = name
        self.counters = Counter()
        self._tape = tape(LAB, SECONDS, 1, position)

    async def run(self, listener):
        begun_s = time.monotonic() - self._tape[0].host_s
        for heard in self._tape:
            wait_s = begun_s + heard.host_s - time.monotonic()
            if wait_s > 0.0:
                await asyncio.sleep(wait_s)
            listener(Reception(heard.frame, heard.rx_ticks, time.monotonic()))
        await asyncio.sleep(3600.0)

    def advice(self):
        return "the tape has ended"

    def now_ticks(self):
        return None

    def transmit(self, transmission):
        raise AssertionError("tags never speak")


class Recorder:
    """``skyless record`` as a process."""

    def __init__(self, address, path, *arguments, limit_bytes=None):
        self.path = path
        self._command = [*SKYLESS, "record", path, "--mqtt", str(address), *arguments]
        self._limit, self._usual_signals = limit_bytes, usual_signals()
        self.process = None

    def _prepare(self):
        self._usual_signals()
        if self._limit:
            resource.setrlimit(resource.RLIMIT_FSIZE, (self._limit, self._limit))

    async def start(self):
        self.process = await asyncio.create_subprocess_exec(
            *self._command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE, preexec_fn=self._prepare
        )

    def size(self):
        return self.path.stat().st_size if self.path.exists() else 0

    async def grown(self, by=20_000):
        """Until it has written more."""
        aim = self.size() + by
        await until(lambda: self.size() >= aim)

    async def end(self, number=signal.SIGINT):
        """Its exit code and what it said."""
        if number is not None:
            os.kill(self.process.pid, number)
        async with asyncio.timeout(20):
            out, err = await self.process.communicate()
        return self.process.returncode, out.decode(), err.decode()


@contextlib.asynccontextmanager
async def site(broker):
    """Two tags and one who tells the site, on a broker that runs."""
    for place in PLACES:
        tape(LAB, SECONDS, 1, place)  # made before the clock runs
    await broker.start()
    teller = Link(broker.address, "teller", site=LAB.id, kind="ether")
    teller.publish(site_topic(LAB.id), SiteMessage(LAB, True, time.time()), qos=1, retain=True)
    radios = [TapeRadio(name, place) for name, place in zip(("one", "two"), PLACES, strict=True)]
    tags = Tags(TagSettings(), radios, broker.address, lambda _: None)
    tasks = [asyncio.ensure_future(part) for part in (teller.run(), tags.run())]
    try:
        await until(lambda: teller.connected)
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        await broker.stop()


@pytest.fixture
def broker(request, tmp_path):
    """The embedded one, unless a test asks for another."""
    folder = tmp_path / "broker"
    folder.mkdir()
    kind = getattr(request, "param", Embedded)
    if kind is Mosquitto and MOSQUITTO is None:
        pytest.skip("mosquitto is not installed")
    return kind(folder)


both = pytest.mark.parametrize("broker", [Embedded, Mosquitto], indirect=True)


def replayed(path):
    with McapRecording(path) as recording:
        return SiteReplay(recording).run(None, lambda _: None), recording.summary()


@pytest.mark.statistical
async def test_a_recording_replays_and_ctrl_c_closes_it(broker, tmp_path):
    recorder = Recorder(broker.address, tmp_path / "live.mcap", "--json")
    async with site(broker):
        await recorder.start()
        await recorder.grown(200_000)
        code, out, _ = await recorder.end()
    assert code == 0
    told = json.loads(out)
    reports, summary = replayed(recorder.path)
    assert summary.finished
    assert summary.site == LAB.id
    assert summary.simulated
    assert told["messages"]["fix"] == summary.messages["fix"]
    assert told["receptions"] == sum(report.receptions for report in reports)
    assert told["drops"] == summary.drops == {}
    for report in reports:
        assert report.fixes > 50
        assert report.segments == 1


@both
@pytest.mark.statistical
async def test_a_broker_that_dies_and_returns_costs_no_reception_that_it_kept(broker, tmp_path):
    recorder = Recorder(broker.address, tmp_path / "restart.mcap", "--site-id", str(LAB.id), "--json")
    async with site(broker):
        await recorder.start()
        await recorder.grown(150_000)
        await broker.kill()
        await asyncio.sleep(0.5)
        await broker.start()
        await recorder.grown(150_000)
        code, out, _ = await recorder.end()
    assert code == 0
    reports, _ = replayed(recorder.path)
    gaps = json.loads(out)["drops"].get("gap-in-receptions", 0)
    if isinstance(broker, Embedded):
        assert gaps == 0
    for report in reports:
        assert report.fixes > 50
        # mosquitto saves what it has acknowledged once a second
        assert report.drops.get("gap-in-receptions", 0) <= gaps
        assert report.drops.keys() <= {"receptions-without-beginning", "gap-in-receptions"}
    spans_s = [report.receptions / 400.0 for report in reports]
    assert min(spans_s) > 1.5


@both
@pytest.mark.statistical
async def test_a_killed_recorder_leaves_all_but_the_last_second_and_another_one_goes_on(broker, tmp_path):
    first = Recorder(broker.address, tmp_path / "killed.mcap")
    second = Recorder(broker.address, tmp_path / "second.mcap", "--duration", "2", "--json")
    async with site(broker):
        await first.start()
        await first.grown(200_000)
        killed_s = time.time()
        await first.end(signal.SIGKILL)
        await second.start()
        code, out, _ = await second.end(None)
    reports, summary = replayed(first.path)
    assert not summary.finished
    assert killed_s - summary.end_s < 1.0
    assert all(report.fixes > 50 for report in reports)
    assert code == 0
    assert json.loads(out)["receptions"] > 400


@pytest.mark.statistical
async def test_a_disk_that_takes_no_more_is_reported_once_and_leaves_a_whole_file(broker, tmp_path):
    recorder = Recorder(broker.address, tmp_path / "full.mcap", limit_bytes=250_000)
    async with site(broker):
        await recorder.start()
        code, out, err = await recorder.end(None)
    assert code == 1
    assert err.count("cannot be written any more: File too large") == 1
    assert "not written at the end" in out
    _, summary = replayed(recorder.path)
    assert summary.unread_bytes == 0
    assert 100_000 < recorder.size() <= 250_000


def test_mistakes_are_reported_in_one_line(tmp_path, complaint):
    path = tmp_path / "there.mcap"
    path.write_text("precious")
    for arguments, words in (
        ([str(path)], "is not overwritten"),
        ([str(tmp_path / "no" / "x.mcap")], "cannot be written"),
        ([str(tmp_path / "x.mcap"), "--mqtt", "none"], "broker"),
        ([str(tmp_path / "x.mcap"), "--mqtt", "http://x"], "mqtt://"),
    ):
        assert words in complaint("record", *arguments)
    assert path.read_text() == "precious"


# When the recorder asks the tags


ONE = RawReception(b"frame", 5, 1.0)
START = SegmentStart({"method": "joint"})


@pytest.fixture
def node(tmp_path, monkeypatch):
    node = RecorderNode(McapFile(tmp_path / "x.mcap"), MqttAddress("127.0.0.1", 1), LAB.id, lambda _: None)
    node.asked = []
    monkeypatch.setattr(node.link, "publish", lambda topic, message, **_: node.asked.append(message.by))
    node.now_s = 1000.0
    monkeypatch.setattr(record.time, "monotonic", lambda: node.now_s)
    return node


def hear(node, segment, first, count, start=None, tag="a"):
    message = ReceptionsMessage(tag, segment, first, 0.0, (ONE,) * count, start)
    node._on_message(receptions_topic(LAB.id, tag), msgspec.json.encode(message))


def test_whole_runs_and_repetitions_ask_for_nothing(node):
    hear(node, "s-1", 0, 10, START)
    hear(node, "s-1", 10, 5)
    hear(node, "s-1", 10, 5)  # twice, after a broken connection
    hear(node, "s-1", 0, 10, START)
    hear(node, "s-1", 15, 5)
    hear(node, "s-2", 0, 5, START)
    hear(node, "s-1", 0, 5, START, tag="b")
    assert node.asked == []
    assert node.recorder.drops == {}


def test_a_gap_within_a_run_is_counted(node):
    hear(node, "s-1", 0, 10, START)
    hear(node, "s-1", 20, 5)
    hear(node, "s-1", 30, 5)
    assert node.recorder.drops == {"gap-in-receptions": 2}
    assert node.asked == []


def test_a_run_without_its_beginning_is_asked_about_under_another_name_but_not_in_a_rush(node):
    for number in range(3):
        hear(node, "s-1", 400 + 10 * number, 10)
    assert node.recorder.drops == {"receptions-without-beginning": 30}
    assert len(node.asked) == 1
    node.now_s += 2.0
    hear(node, "s-1", 430, 10)
    assert len(set(node.asked)) == 2


def test_a_tag_that_comes_is_asked_at_once(node):
    status = StatusMessage(True, "tag", "a", unix_s=1.0)
    node._on_message(status_topic(LAB.id, "tag", "a"), msgspec.json.encode(status))
    node._on_message(
        status_topic(LAB.id, "tag", "a"), msgspec.json.encode(msgspec.structs.replace(status, online=False))
    )
    node._on_message(status_topic(LAB.id, "anchor", 1), msgspec.json.encode(StatusMessage(True, "anchor", "1")))
    assert len(node.asked) == 1


def test_two_recorders_of_one_machine_have_two_names(node, tmp_path):
    other = RecorderNode(McapFile(tmp_path / "y.mcap"), MqttAddress("127.0.0.1", 1), LAB.id, lambda _: None)
    assert other._name != node._name
