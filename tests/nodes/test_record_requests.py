"""When the recorder asks the tags, and that it asks anew after a loss."""

import msgspec
import pytest

from machines.bench import LAB
from skyless.mqtt.address import MqttAddress
from skyless.mqtt.messages import RawReception, ReceptionsMessage, SegmentStart, StatusMessage
from skyless.mqtt.topics import receptions_topic, status_topic
from skyless.nodes import record
from skyless.nodes.record import RecorderNode
from skyless.recordings.mcap.recorder import McapFile

ONE = RawReception(b"frame", 5, 1.0)
START = SegmentStart(0, {"method": "joint"}, None)


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


def test_a_gap_is_counted_and_asked_about_under_another_name_but_not_in_a_rush(node):
    hear(node, "s-1", 0, 10, START)
    hear(node, "s-1", 20, 5)
    hear(node, "s-1", 30, 5)
    assert node.recorder.drops == {"gap-in-receptions": 2}
    assert len(node.asked) == 1
    node.now_s += 2.0
    hear(node, "s-1", 40, 5)
    assert len(set(node.asked)) == 2


def test_a_run_without_its_beginning_is_asked_about(node):
    hear(node, "s-1", 400, 10)
    assert len(node.asked) == 1


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
