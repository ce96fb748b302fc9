"""Recordings of a running site: by the official reader, cut anywhere, on a full disk, after kill −9."""

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import mcap.reader
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

import skyless
from skyless.core.errors import SkylessError
from skyless.run.foxglove import ellipse_of, schema_of
from skyless.run.mqtt import messages as outputs
from skyless.run.mqtt.messages import FixMessage
from skyless.run.recordings.recorder import McapFile
from skyless.run.recordings.recording import McapRecording, channel_of
from support.live_site import PLACES, SITE, UNIX_S, fixes_of, messages, record

pytestmark = pytest.mark.site

PAYLOADS = (
    *(outputs.SiteMessage, outputs.FixMessage, outputs.ReceptionsMessage, outputs.TruthMessage, outputs.ZonesMessage),
    *(outputs.ZoneEvent, outputs.TagHealth, outputs.AnchorHealth, outputs.EtherHealth, outputs.StatusMessage),
    outputs.RequestMessage,
)
SAID = messages(2.0, tuple(PLACES), publish_every=8)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("mcap") / "whole.mcap"
    record(path, SAID)
    return path


def test_the_official_reader_reads_all_of_it(whole):
    with whole.open("rb") as stream:
        reader = mcap.reader.make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "skyless"
        found = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages(log_time_order=False)]
        schemas = {schema.name: schema for schema in reader.get_summary().schemas.values()}
    ours = [(topic, round(s * 1e9), payload) for s, topic, payload in SAID]
    assert [one for one in found if channel_of(one[0])] == ours
    assert {name for name in schemas if name.startswith("skyless.")} == {
        *("skyless.Site", "skyless.Fix", "skyless.Receptions", "skyless.Truth")
    }
    for schema in schemas.values():
        assert schema.encoding == "jsonschema"
        check_schema(json.loads(schema.data))


@pytest.mark.parametrize("compression", list(CompressionType))
def test_the_front_door_opens_it_however_its_chunks_are_compressed(whole, tmp_path, compression):
    path = tmp_path / "again.mcap"
    with whole.open("rb") as stream, path.open("wb") as out:
        writer = Writer(out, compression=compression)
        writer.start("skyless")
        known = {}
        for _, channel, message in mcap.reader.make_reader(stream).iter_messages(log_time_order=False):
            if channel.id not in known:
                known[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id=0)
            writer.add_message(known[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    with skyless.open_recording(whole) as first, skyless.open_recording(path) as second:
        fixes = list(first.fixes())
        assert len(fixes) > 100
        assert list(second.fixes()) == fixes
        assert second.summary().raw_tags == first.summary().raw_tags == tuple(sorted(PLACES))
    with pytest.raises(SkylessError, match="it should be left out"):
        skyless.open_recording(path, listener="4")


def check_schema(schema):
    """That Foxglove takes a schema: the rules of its open-source viewer (``packages/mcap-support``)."""
    assert schema["type"] == "object"
    for value in schema["properties"].values():
        part = value["items"] if value["type"] == "array" else value
        if part["type"] == "object":
            check_schema(part)
        else:
            assert part["type"] in ("boolean", "string", "number", "integer")
            assert part.get("contentEncoding") in (None, "base64")


@pytest.mark.parametrize("payload", PAYLOADS, ids=lambda payload: payload.__name__)
def test_viewers_take_the_schemas(payload):
    name, data = schema_of(payload)
    schema = json.loads(data)
    check_schema(schema)
    assert schema["title"] == name
    told = set(schema["properties"])
    assert told <= set(payload.__struct_fields__)
    plain = {field.name for field in msgspec.structs.fields(payload) if field.type in (float, int, str, float | None)}
    assert plain <= told


def test_a_fixs_position_can_be_plotted():
    properties = json.loads(schema_of(FixMessage)[1])["properties"]
    for name in ("position_m", "covariance_m2", "velocity_mps"):
        assert properties[name] == {"type": "array", "items": {"type": "number"}}
    assert set(properties) == set(FixMessage.__struct_fields__)


def fits(schema, value):
    """Whether a value is what a schema of Foxglove says, and no property is missing or unknown."""
    match schema["type"]:
        case "object":
            assert value.keys() == schema["properties"].keys()
            for name, part in value.items():
                fits(schema["properties"][name], part)
        case "array":
            assert schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", 1000)
            for part in value:
                fits(schema["items"], part)
        case kind:
            assert isinstance(value, {"number": float, "integer": int, "string": str, "boolean": bool}[kind])


def test_foxglove_finds_what_it_shows(whole):
    with whole.open("rb") as stream:
        found = [
            (schema.name, json.loads(schema.data), channel.topic, json.loads(message.data))
            for schema, channel, message in mcap.reader.make_reader(stream).iter_messages()
            if schema.name.startswith("foxglove.")
        ]
    for name, schema, _, value in found:
        assert schema["title"] == name
        fits(schema, value)
    by_topic = {topic: value for _, _, topic, value in found}
    for tag, place_m in PLACES.items():
        position = by_topic[f"/tag/{tag}/pose"]["pose"]["position"]
        assert np.hypot(position["x"] - place_m[0], position["y"] - place_m[1]) < 0.3
        east_m, north_m = on_the_earth(by_topic[f"/tag/{tag}/location"])
        turned = np.exp(-1j * np.radians(30.0)) * complex(*list(position.values())[:2])
        assert abs(complex(east_m, north_m) - turned) < 1e-3
    assert len(by_topic["/site/scene"]["entities"]) == len(SITE.anchors) + len(SITE.walls)


def on_the_earth(location):
    """East and north of the site's origin, by metres per degree at 52.5° (NGA's series: 111 272.3 and 67 909.3)."""
    return (location["longitude"] - 13.4) * 67909.3, (location["latitude"] - 52.5) * 111272.3


def test_an_ellipse_covers_two_standard_deviations():
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = turn @ np.diag([0.09, 0.01]) @ turn.T
    fix = fixes_of(SAID)[0]
    axes_m, yaw = ellipse_of(msgspec.structs.replace(fix, covariance_m2=tuple(covariance.ravel())))
    assert axes_m == pytest.approx((4 * 0.3, 4 * 0.1))
    assert np.tan(yaw) == pytest.approx(0.75)


def test_a_recording_gives_back_what_was_said(whole):
    with McapRecording(whole) as recording:
        summary = recording.summary()
        assert summary.finished
        assert summary.site == SITE.id
        assert summary.tags == summary.raw_tags == ("a", "b", "c")
        assert summary.drops == {}
        assert summary.messages["truth"] == 20
        assert recording.site.site == SITE
        assert recording.zones is None
        fixes = list(recording.fixes())
        assert fixes == fixes_of(SAID)
        some = list(recording.fixes(UNIX_S + 0.9, UNIX_S + 1.2, ["b"]))
        assert some == [f for f in fixes if f.tag == "b" and UNIX_S + 0.9 <= f.unix_s < UNIX_S + 1.2]
        assert len(some) > 5
        assert len(list(recording.truth(UNIX_S + 1.0))) == 10


def test_a_growing_file_is_read_as_far_as_it_goes(tmp_path):
    path = tmp_path / "growing.mcap"
    half = len(SAID) // 2
    recorder = record(path, SAID[:half], close=False)
    with McapRecording(path) as recording:
        fixes = list(recording.fixes())
        assert fixes == fixes_of(SAID[:half])
        assert not recording.summary().finished
        for s, topic, payload in SAID[half:]:
            recorder.add(topic, payload, s)
        recorder.file.close()
        recording.refresh()
        assert recording.summary().finished
        assert list(recording.fixes()) == fixes_of(SAID)


SMALL = [one for one in SAID if "/tag/" not in one[1] or one[1].endswith("a/fix")][:40]


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A small file, and how long it was after every flush with the number of messages in it."""
    path = tmp_path_factory.mktemp("mcap") / "small.mcap"
    marks = []
    recorder = record(path, SMALL[:1], close=False)
    marks.append((path.stat().st_size, 1))
    for number, (s, topic, payload) in enumerate(SMALL[1:], 2):
        recorder.add(topic, payload, s)
        if number % 10 == 0:
            recorder.file.flush()
            marks.append((path.stat().st_size, number))
    recorder.file.close()
    return path.read_bytes(), marks


@given(st.data())
@settings(max_examples=400)
def test_a_file_cut_anywhere_loses_only_what_is_beyond_the_cut(small, tmp_path_factory, data):
    content, marks = small
    length = data.draw(st.integers(8, len(content)))
    path = tmp_path_factory.getbasetemp() / "cut.mcap"
    path.write_bytes(content[:length])
    expected = max((number for size, number in marks if size <= length), default=0)
    with McapRecording(path) as recording:
        found = list(recording.messages({"site", "truth", "fix"}))
        assert expected <= len(found) <= expected + 10  # a chunk may be whole before its index is
        assert [one.topic for one in found] == [one[1] for one in SMALL[: len(found)]]
        assert sum(recording.summary().messages.values()) == len(found)
        assert recording.summary().drops == {}


@given(st.data())
@settings(max_examples=300)
@pytest.mark.statistical
def test_damaged_files_do_not_raise(small, tmp_path_factory, data):
    content = bytearray(small[0])
    for _ in range(data.draw(st.integers(1, 5))):
        content[data.draw(st.integers(8, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "damaged.mcap"
    path.write_bytes(content)
    with McapRecording(path) as recording:
        recording.summary()
        assert len(list(recording.messages({"site", "truth", "fix"}))) <= len(SMALL)


WRITER = """
import sys, time
sys.path[:0] = [{tests!r}]
from support.live_site import messages
from skyless.run.recordings.recorder import McapFile
from skyless.run.recordings.recorder import McapRecorder
recorder = McapRecorder(McapFile(sys.argv[1]))
for number, (s, topic, payload) in enumerate(messages(2.0)):
    recorder.add(topic, payload, s)
    if number % 50 == 49:
        recorder.file.flush()
        print(number + 1, flush=True)
print("all", flush=True)
time.sleep(60)
"""


@pytest.mark.statistical
def test_a_writer_that_is_killed_leaves_all_that_it_flushed(tmp_path):
    path = tmp_path / "killed.mcap"
    code = WRITER.format(tests=str(Path(__file__).parents[1]))
    with subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True) as writer:
        lines = [writer.stdout.readline().strip() for _ in range(7)]
        os.kill(writer.pid, signal.SIGKILL)
    with McapRecording(path) as recording:
        found = list(recording.messages({"site", "truth", "fix", "receptions"}))
        assert len(found) >= int(lines[-1])
        assert not recording.summary().finished
    said = messages(2.0)
    assert [(one.topic, round(one.time_s, 3)) for one in found] == [(t, round(s, 3)) for s, t, _ in said[: len(found)]]


def test_a_full_disk_ends_the_recording_once_and_leaves_a_whole_file(tmp_path, monkeypatch):
    path = tmp_path / "full.mcap"
    room = 20_000
    write = os.write

    def full(handle, data):
        left = room - os.fstat(handle).st_size
        if left <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(handle, bytes(data)[:left])

    monkeypatch.setattr(os, "write", full)
    recorder = record(path, SAID, flush_s=0.1)
    assert "No space left" in recorder.file.ended
    assert recorder.file.lost > 0
    assert path.stat().st_size == recorder.file.written_bytes <= room
    monkeypatch.undo()
    with McapRecording(path) as recording:
        found = list(recording.messages({"site", "truth", "fix", "receptions"}))
        assert recording.summary().unread_bytes == 0
    assert [one.topic for one in found] == [one[1] for one in SAID[: len(found)]]
    assert len(found) > 20


def test_a_limit_ends_the_recording_with_a_whole_file(tmp_path):
    recorder = record(tmp_path / "limited.mcap", SAID, flush_s=0.1, limit_bytes=15_000)
    assert "limit" in recorder.file.ended
    assert recorder.file.lost > 0
    with McapRecording(tmp_path / "limited.mcap") as recording:
        assert recording.summary().finished


def test_an_existing_file_is_not_overwritten(tmp_path):
    path = tmp_path / "there.mcap"
    path.write_text("precious")
    with pytest.raises(SkylessError, match="exists and is not overwritten"):
        McapFile(path)
    assert path.read_text() == "precious"
    with pytest.raises(SkylessError, match="cannot be written"):
        McapFile(tmp_path / "nowhere" / "x.mcap")


def test_the_recorder_drops_and_counts_what_is_no_message(tmp_path):
    recorder = record(tmp_path / "bad2.mcap", SAID[:1], close=False)
    topic = f"skyless/v1/{SITE.id}/tag/a/fix"
    for payload in (b"{", b"\xff\xfe", b"[]", b"[" * 100_000):
        recorder.add(topic, payload, UNIX_S)
    recorder.add("skyless/v2/1/site", b"{}", UNIX_S)
    recorder.add("elsewhere", b"{}", UNIX_S)
    recorder.add(SAID[0][1], SAID[0][2], UNIX_S + 5.0)  # retained, repeated after a reconnect
    image = b"\x89PNG" + bytes(1000)
    recorder.add(f"skyless/v1/{SITE.id}/floor_plan", image, UNIX_S)
    assert recorder.drops == {"malformed-message": 4, "unknown-topic": 2}
    recorder.file.close()
    with McapRecording(tmp_path / "bad2.mcap") as recording:
        assert recording.summary().messages == {"site": 1}
        assert recording.floor_plan == image


def test_looking_into_a_long_recording_is_cheap(tmp_path):
    """The slider reads the second that it wants, not the hour: chunks that lie elsewhere are not decompressed."""
    path = tmp_path / "long.mcap"
    record(path, [(s, t, p) for k in range(20) for s, t, p in ((s + 2.0 * k, t, p) for s, t, p in SAID)])
    with McapRecording(path) as recording:
        read = []
        content = recording._scan._content
        recording._scan._content = lambda chunk: read.append(chunk) or content(chunk)
        assert len(list(recording.truth(UNIX_S + 20.0, UNIX_S + 21.0))) == 10
        assert len(read) <= 3
