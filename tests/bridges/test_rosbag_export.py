"""``skyless export``: what rosbags, which is not ours, reads in the bag is what stands in the recording."""

import json
import sys
from collections import Counter

import msgspec
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from skyless.bridges.target import floored
from skyless.cli.main import main
from skyless.core.earth import geodetic
from skyless.run.recordings.recording import McapRecording
from support import live_site

pytestmark = pytest.mark.site

KILTED = get_typestore(Stores.ROS2_KILTED)
TAGS = ("a", "b")


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A recording of two tags; one fix of the second must not be used."""
    path = tmp_path_factory.mktemp("walk") / "walk.mcap"
    said = live_site.messages(1.0, tags=TAGS)
    last = max(index for index, (_, topic, _) in enumerate(said) if topic.endswith("/b/fix"))
    unix_s, topic, payload = said[last]
    bad = msgspec.json.decode(payload) | {"alert": "alert-limit-exceeded"}
    said[last] = (unix_s, topic, msgspec.json.encode(bad))
    live_site.record(path, said)
    return path


@pytest.fixture
def export(tmp_path, walk, capsys):
    def call(*arguments, file=walk):
        folder = tmp_path / "bags" / "walk_bag"
        return folder, main(["export", str(file), "--to", str(folder), *arguments]), *capsys.readouterr()

    return call


def content(folder):
    """(topic, Unix time in ns, message) of a bag in its order, and the reader's view of its topics."""
    with Reader(folder) as bag:
        found = [
            (topic.topic, time_ns, KILTED.deserialize_cdr(data, topic.msgtype))
            for topic, time_ns, data in bag.messages()
        ]
        assert {topic.digest for topic in bag.connections} == {
            KILTED.hash_rihs01(topic.msgtype) for topic in bag.connections
        }
        return found


def stamp_ns(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def recorded_fixes(walk):
    with McapRecording(walk) as source:
        return [fix for fix in source.fixes() if fix.alert != "alert-limit-exceeded"]


def exact_ns(unix_s):
    whole = int(unix_s)
    return whole * 10**9 + round((unix_s - whole) * 1e9)


def test_count_stamps_and_positions_are_those_of_the_recording(export, walk):
    folder, code, out, err = export("--json")
    assert (code, err) == (0, "")
    summary = json.loads(out)
    assert (folder / "metadata.yaml").is_file()
    found = content(folder)
    fixes = recorded_fixes(walk)
    for tag in TAGS:
        wanted = [fix for fix in fixes if fix.tag == tag]
        poses = [one for topic, _, one in found if topic == f"/skyless/{tag}/pose"]
        assert [stamp_ns(one) for one in poses] == [exact_ns(fix.unix_s) for fix in wanted]
        places = [(p.x, p.y, p.z) for p in (one.pose.pose.position for one in poses)]
        assert places == [fix.position_m for fix in wanted]
        matrices = [tuple(one.pose.covariance.reshape(6, 6)[:3, :3].ravel()) for one in poses]
        assert matrices == [floored(fix.covariance_m2) for fix in wanted]
        earth = [one for topic, _, one in found if topic == f"/skyless/{tag}/fix"]
        origin = live_site.SITE.georeference
        assert [(one.latitude, one.longitude, one.altitude) for one in earth] == [
            geodetic(fix.position_m, origin) for fix in wanted
        ]
        truth = [one.pose.position for topic, _, one in found if topic == f"/skyless/{tag}/truth"]
        assert {(p.x, p.y, p.z) for p in truth} == {live_site.PLACES[tag]}
    assert summary["topics"] == dict(sorted(Counter(topic for topic, _, _ in found).items()))
    assert (summary["fixes"], summary["unusable"]) == (len(fixes), 1)
    times = [time_ns for _, time_ns, _ in found]
    assert times == sorted(times)
    assert found[0][0] == "/skyless/anchors"


def test_one_tag_in_another_frame_with_transforms_for_humble(export):
    folder, code, out, _ = export("--tag", "b", "--frame", "map", "--transforms", "--bag-version", "8")
    assert code == 0
    assert "version: 8" in (folder / "metadata.yaml").read_text()
    found = content(folder)
    topics = {topic for topic, _, _ in found}
    assert topics == {
        "/skyless/anchors",
        "/tf",
        *(f"/skyless/b/{what}" for what in ("pose", "velocity", "fix", "truth")),
    }
    assert {one.header.frame_id for topic, _, one in found if topic.endswith("/pose")} == {"map"}
    (name,) = {one.transforms[0].child_frame_id for topic, _, one in found if topic == "/tf"}
    assert name == "b"
    assert "/skyless/b/pose" in out
    assert "1 fixes were left out" in out


def test_a_bag_is_whole_or_not_there(export, tmp_path, walk):
    folder, code, _, err = export(file=tmp_path / "none.mcap")
    assert (code, err.count("\n")) == (2, 1)
    text = tmp_path / "text.mcap"
    text.write_text("no recording at all")
    for file, words in ((text, "MCAP"), (walk.parent, "file that can be read")):
        folder, code, _, err = export(file=file)
        assert (code, err.count("\n")) == (2, 1)
        assert words in err
    empty = tmp_path / "empty.mcap"
    live_site.record(empty, live_site.messages(0.1)[1:])
    folder, code, _, err = export(file=empty)
    assert (code, err.count("\n")) == (2, 1)
    assert "holds no site" in err
    assert not folder.exists()
    assert not list(tmp_path.glob("bags/*"))
    export()
    before = (folder / "metadata.yaml").read_bytes()
    _, code, _, err = export()
    assert (code, err.count("\n")) == (2, 1)
    assert "exists" in err
    assert (folder / "metadata.yaml").read_bytes() == before
    assert [one.name for one in folder.parent.iterdir()] == [folder.name]


def test_of_a_recording_that_was_cut_off_its_beginning_is_written(export, tmp_path):
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    live_site.record(whole, live_site.messages(4.0, tags=TAGS))
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
    folder, code, out, _ = export(file=cut)
    assert code == 0
    assert "it was cut off" in out
    stamps = [stamp_ns(one) for topic, _, one in content(folder) if topic == "/skyless/a/pose"]
    wanted = [exact_ns(fix.unix_s) for fix in recorded_fixes(whole) if fix.tag == "a"]
    assert 0 < len(stamps) < len(wanted)
    assert stamps == wanted[: len(stamps)]


@pytest.mark.parametrize("frame", ["", "a b", "/map", "site\n"])
def test_a_frame_that_ros_would_refuse_is_named(export, frame):
    folder, code, _, err = export("--frame", frame)
    assert (code, err.count("\n")) == (2, 1)
    assert f"--frame is {frame!r}; it should be a frame's name" in err
    assert not folder.exists()


def test_a_recording_without_a_fix_of_the_tag_says_so(export):
    _, code, out, _ = export("--tag", "zorro")
    assert code == 1
    assert "there is no fix in the bag" in out


def test_without_the_extra_the_message_names_it(export, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    folder, code, _, err = export()
    assert (code, err.count("\n")) == (2, 1)
    assert "rosbags, which is not installed" in err
    assert not folder.exists()
