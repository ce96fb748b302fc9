"""Recordings, written as the recorder writes them, as a page gets them back."""

import contextlib
import json

import msgspec
import pytest
from dashboard_builders import SITE, SITE_ID, SQUARE, Wire, browser_of, fix, truth
from starlette.exceptions import HTTPException

from skyless.page.live import LiveSite
from skyless.page.playback import Playback
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import WatchFinding, WatchMessage, ZonesMessage
from skyless.run.recordings.recorder import McapFile, McapRecorder
from support.site_messages import anchor_health

pytestmark = pytest.mark.site

START_S = 1_700_000_000.0
PLAN = b"\x89PNG\r\n\x1a\nplan"
DURATION_S = 10.0


def record(path, *, begin_s=START_S, seconds=DURATION_S, close=True, clock_error_s=0.0):
    """Ten fixes a second of a tag that walks along x at 1 m/s and whose fixes lie 3 cm off it."""
    recorder = McapRecorder(McapFile(path))

    def take(topic, message, at_s):
        recorder.add(topic, message if isinstance(message, bytes) else msgspec.json.encode(message), at_s)

    take(topics.site_topic(SITE_ID), SITE, begin_s)
    take(topics.floor_plan_topic(SITE_ID), PLAN, begin_s)
    take(topics.zones_topic(SITE_ID), ZonesMessage((SQUARE,)), begin_s)
    for k in range(round(seconds * 10) + 1):
        at_s = begin_s + k / 10
        moving = truth(at_s, position_m=(k / 10, 2.0, 1.0), velocity_mps=(1.0, 0.0, 0.0))
        take(topics.truth_topic(SITE_ID), moving, at_s)
        take(topics.fix_topic(SITE_ID, "t1"), fix("t1", at_s + clock_error_s, (k / 10, 2.03, 1.0), serial=k), at_s)
        recorder.file.flush()
    if close:
        recorder.file.close()
    return recorder


@contextlib.contextmanager
def recorded(path):
    """A recording of the messages that the block gives, at times after ``START_S``."""
    recorder = McapRecorder(McapFile(path))

    def take(topic, message, at_s):
        recorder.add(topic, msgspec.json.encode(message), START_S + at_s)
        recorder.file.flush()

    yield take
    recorder.file.close()


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "recordings"
    folder.mkdir()
    record(folder / "first.mcap")
    return folder


def rows(states):
    return [row for state in states for row in json.loads(state)["tags"]]


def test_the_list_has_the_newest_first_and_leaves_out_what_is_no_recording(folder):
    record(folder / "second.mcap", begin_s=START_S + 100.0, seconds=2.0, close=False)
    (folder / "notes.txt").write_text("no")
    (folder / "broken.mcap").write_text("no")
    (folder / "folder.mcap").mkdir()
    playback = Playback(folder)
    second, first = playback.recordings()
    assert (second.name, second.start_unix_s, second.complete) == ("second.mcap", START_S + 100.0, False)
    assert (first.name, first.complete) == ("first.mcap", True)
    assert first.duration_s == pytest.approx(DURATION_S)
    assert first.bytes == (folder / "first.mcap").stat().st_size
    assert playback.recordings() == [second, first]


def test_a_recording_that_grows_is_read_to_its_end(folder):
    recorder = record(folder / "growing.mcap", seconds=1.0, close=False)
    playback = Playback(folder)
    assert playback.summary("growing.mcap").end_unix_s == START_S + 1.0
    late = fix("t9", START_S + 2.0)
    recorder.add(topics.fix_topic(SITE_ID, "t9"), msgspec.json.encode(late), START_S + 2.0)
    recorder.file.flush()
    assert playback.summary("growing.mcap").end_unix_s == START_S + 2.0
    assert next(r for r in playback.recordings() if r.name == "growing.mcap").duration_s == pytest.approx(2.0)
    assert rows(playback.states("growing.mcap", 1.5, 3.0, 20.0))[0][0] == "t9"


def test_the_summary_has_what_a_page_needs_before_it_plays(folder):
    found = Playback(folder).summary("first.mcap")
    assert found.site == SITE
    assert found.zones == (SQUARE,)
    assert found.tags == ("t1",)
    assert (found.start_unix_s, found.end_unix_s) == (START_S, START_S + DURATION_S)


def test_windows_one_after_the_other_give_every_fix_once(folder):
    playback = Playback(folder)
    windows = [playback.states("first.mcap", k * 2.5, (k + 1) * 2.5, 20.0) for k in range(5)]
    found = [row for window in windows for row in rows(window)]
    assert [row[1] for row in found] == pytest.approx([k / 10 for k in range(101)])
    assert [row[15] for row in found] == pytest.approx([START_S + k / 10 for k in range(101)])
    assert [row[10] for row in found] == pytest.approx([0.03] * 101)
    times = [json.loads(state)["unix_s"] for window in windows for state in window]
    assert times == sorted(times)


def test_fixes_of_a_tag_with_a_wrong_clock_have_the_times_at_which_they_were_recorded(folder):
    record(folder / "wrong.mcap", seconds=1.0, clock_error_s=3600.0)
    found = rows(Playback(folder).states("wrong.mcap", 0.0, 2.0, 20.0))
    assert [row[15] for row in found] == pytest.approx([START_S + k / 10 for k in range(11)])


def test_a_lower_rate_gives_fewer_states(folder):
    playback = Playback(folder)
    assert len(playback.states("first.mcap", 0.0, 10.0, 2.0)) == 20
    assert len(playback.states("first.mcap", 0.0, 10.0, 100.0)) == 100
    assert playback.states("first.mcap", 20.0, 30.0, 20.0) == []


@pytest.mark.parametrize(
    "name",
    ["../secret.mcap", "..", ".mcap", "a/b.mcap", "\\x.mcap", "x\0.mcap", "link.mcap", "none.mcap", "/etc/passwd"],
)
def test_nothing_outside_the_folder_is_read(folder, name):
    record(folder.parent / "secret.mcap", seconds=0.1)
    (folder / "link.mcap").symlink_to(folder.parent / "secret.mcap")
    opening = (
        Playback(folder).summary,
        Playback(folder).floor_plan,
        Playback(folder).open_file,
        Playback(None).summary,
    )
    for read in opening:
        with pytest.raises(HTTPException):
            read(name)
    assert [found.name for found in Playback(folder).recordings()] == ["first.mcap"]


def test_reading_ends_when_the_server_does(folder):
    playback = Playback(folder)
    playback.stop()
    assert playback.recordings() == []
    assert playback.states("first.mcap", 0.0, 10.0, 20.0) == []


def test_a_recording_replaced_by_another_is_read_again(folder):
    playback = Playback(folder)
    playback.summary("first.mcap")
    record(folder / "new", begin_s=START_S + 50.0, seconds=1.0)
    (folder / "new").replace(folder / "first.mcap")
    assert playback.summary("first.mcap").start_unix_s == START_S + 50.0


def test_the_server_gives_recordings(folder):
    live = LiveSite("here", "mqtt://broker:1")
    live.attach(Wire(), SITE_ID)
    browser = browser_of(live, folder)
    (listed,) = browser.get("/api/recordings").json()
    assert listed.keys() == {"name", "bytes", "start_unix_s", "duration_s", "complete", "site", "tags", "fixes"}
    assert (listed["site"], listed["tags"], listed["fixes"]) == (SITE.site.name, 1, 101)
    summary = browser.get("/api/recordings/first.mcap").json()
    keys = {"name", "site", "start_unix_s", "end_unix_s", "tags", "zones", "fix_spans_unix_s"}
    assert summary.keys() == keys
    assert summary["site"]["site"]["id"] == SITE_ID
    states = browser.get("/api/recordings/first.mcap/states?from_s=1&to_s=2&rate_hz=20").json()["states"]
    assert [state["type"] for state in states] == ["state"] * 10
    assert browser.get("/api/recordings/first.mcap/floor_plan").content == PLAN
    for query in ("from_s=0&to_s=61", "from_s=5&to_s=4", "from_s=-1", "rate_hz=0", "from_s=nan"):
        assert browser.get(f"/api/recordings/first.mcap/states?{query}").status_code == 400
    for name in ("none.mcap", "..%2Fsecret.mcap", "%2e%2e", "%2Fetc%2Fpasswd"):
        assert browser.get(f"/api/recordings/{name}").status_code == 404
        assert browser.get(f"/api/recordings/{name}/file").status_code == 404


def test_a_recording_is_downloaded_with_its_name_as_far_as_it_is_written(folder):
    record(folder / "old hall (1).mcap", seconds=1.0)
    browser = browser_of(LiveSite("here", "mqtt://broker:1"), folder)
    answer = browser.get("/api/recordings/old%20hall%20(1).mcap/file")
    assert answer.content == (folder / "old hall (1).mcap").read_bytes()
    assert answer.headers["content-disposition"] == "attachment; filename*=utf-8''old%20hall%20%281%29.mcap"
    assert answer.headers["content-length"] == str(len(answer.content))
    growing = Playback(folder).open_file("first.mcap")
    before = (folder / "first.mcap").read_bytes()
    with (folder / "first.mcap").open("ab") as file:
        file.write(b"more")
    assert b"".join(growing.pieces()) == before, "as long as was announced, whatever is added meanwhile"


def test_the_events_of_a_recording_are_those_that_a_live_page_would_have_listed(folder):
    """Anchor 1 leads and is silent from 3 s on, 2 leads from 6 s on; t1 has an alert at 8 s, 2 has moved at 13 s."""
    with recorded(folder / "events.mcap") as take:
        for k in range(130):
            at_s = k / 10
            alert = "alert-limit-exceeded" if 8.0 <= at_s < 8.5 else "none"
            take(topics.fix_topic(SITE_ID, "t1"), fix("t1", START_S + at_s, serial=k, hpl_m=0.5, alert=alert), at_s)
            if k % 10 == 0:
                for anchor in (1, 2):
                    leads = anchor == 1 if at_s < 3.0 else anchor == 2 and at_s >= 6.0
                    if anchor == 2 or at_s < 3.0:
                        role = "master" if leads else "anchor"
                        health = anchor_health(anchor, unix_s=START_S + at_s, role=role, term=k)
                        take(topics.health_topic(SITE_ID, "anchor", anchor), health, at_s)
        finding = WatchFinding("moved", (2,), 0.3, 0.01, START_S, "Anchor 2 has moved by 30 cm.")
        take(topics.watch_topic(SITE_ID), WatchMessage(START_S + 13.0, "watching", (finding,), 3), 13.0)
    playback = Playback(folder)
    found = playback.events("events.mcap")
    assert found.complete
    assert [(event.kind, event.name, round(event.unix_s - START_S)) for event in found.events] == [
        ("anchor", "anchor/1", 6),
        ("master", "anchor/2", 6),
        ("alert", "tag/t1", 8),
        ("alert", "tag/t1", 10),
        ("watch", "anchor/2", 13),
    ]
    assert playback.events("events.mcap") is found, "it is read once"
    with pytest.raises(HTTPException):
        playback.events("../events.mcap")


def test_a_recording_with_a_gap_lists_no_outage(folder):
    with recorded(folder / "cut.mcap") as take:
        for at_s in (0, 1, 2, 3, 60, 61, 62):
            for anchor, later_s in ((1, 0.0), (2, 0.1)):
                health = anchor_health(anchor, unix_s=START_S + at_s)
                take(topics.health_topic(SITE_ID, "anchor", anchor), health, at_s + later_s)
    assert Playback(folder).events("cut.mcap").events == ()


def test_the_summary_says_when_there_are_fixes(folder):
    """Nothing for 3 s, fixes for 2 s, nothing for 5 s, fixes for 1 s; the first is known exactly."""
    with recorded(folder / "gaps.mcap") as take:
        for k in range(120):
            at_s = k / 10
            take(topics.truth_topic(SITE_ID), truth(START_S + at_s), at_s)
            if 3.0 <= at_s < 5.0 or at_s >= 10.0:
                take(topics.fix_topic(SITE_ID, "t1"), fix("t1", START_S + at_s, serial=k), at_s)
    spans = [[s - START_S for s in span] for span in Playback(folder).summary("gaps.mcap").fix_spans_unix_s]
    assert spans == [pytest.approx([3.0, 4.9]), pytest.approx([10.0, 11.9])]
    with recorded(folder / "empty.mcap") as take:
        take(topics.truth_topic(SITE_ID), truth(START_S), 0.0)
    assert Playback(folder).summary("empty.mcap").fix_spans_unix_s == ()
