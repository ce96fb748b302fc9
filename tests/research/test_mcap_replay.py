"""Replay of a running site, whatever the recording lacks or somebody forged."""

import csv
import json

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from skyless.cli.main import main
from skyless.core.alert import Alert
from skyless.core.integrity import IntegrityRequirement
from skyless.core.method_names import METHODS
from skyless.research.replays.site import SiteReplay
from skyless.run.mqtt.messages import ReceptionsMessage, SegmentStart, fix_message
from skyless.run.recordings.recording import McapRecording
from skyless.site.channel import ChannelModel
from support.live_site import PLACES, UNIX_S, fixes_of, messages, record

pytestmark = pytest.mark.site


def replayed(path, **options):
    with McapRecording(path) as recording:
        return SiteReplay(recording, **options).run(None, lambda _: None)


def changed(said, change):
    """Messages with every receptions message replaced by what ``change`` makes of it: a list of them."""
    out, number = [], 0
    for s, topic, payload in said:
        if topic.endswith("/receptions"):
            message = msgspec.json.decode(payload, type=ReceptionsMessage)
            out += [(s, topic, msgspec.json.encode(one)) for one in change(number, message)]
            number += 1
        else:
            out.append((s, topic, payload))
    return out


def replayed_fixes(path, **options):
    """All fixes of the only tag, with their Unix times."""
    found = []
    with McapRecording(path) as recording:
        SiteReplay(recording, **options).run(lambda _, unix_s, fix: found.append((unix_s, fix)), lambda _: None)
    return found


@pytest.mark.parametrize("method", METHODS)
def test_a_replay_from_the_tags_start_gives_the_live_fixes_bit_by_bit(tmp_path, method):
    path = tmp_path / "live.mcap"
    said = messages(2.5, ("a",), method, 0.0)
    record(path, said)
    live, again = fixes_of(said), replayed_fixes(path)
    assert len(live) > 60
    assert [
        fix_message("a", one.serial, fix, one.unix_s, one.latency_s) for one, (_, fix) in zip(live, again, strict=True)
    ] == live
    (report,) = replayed(path)
    assert (report.fixes, report.segments, report.method, report.drops) == (len(live), 1, method, {})


@pytest.mark.parametrize("method", METHODS)
def test_a_replay_from_the_middle_agrees_with_that_of_the_whole(tmp_path, method):
    whole, middle = tmp_path / "whole.mcap", tmp_path / "middle.mcap"
    record(whole, messages(2.5, ("a",), method, 0.0))
    record(middle, messages(2.5, ("a",), method, 1.0))
    known = {round(unix_s, 4): fix for unix_s, fix in replayed_fixes(whole)}
    late = replayed_fixes(middle)
    pairs = [(fix, known[round(unix_s, 4)]) for unix_s, fix in late if unix_s > late[0][0] + 0.1]
    assert len(pairs) > 20
    for cold, warm in pairs:
        std_m = np.sqrt(np.diag(cold.covariance_m2) + np.diag(warm.covariance_m2))
        assert np.all(np.abs(cold.position_m - warm.position_m)[:2] < 5.0 * std_m[:2])


@pytest.mark.parametrize(
    "had", [b'"start":{"serial":812,"state":"gASVBg==",', b'"settings":{"qa":3.0,"max_acceleration_mps2":10.0,']
)
def test_states_and_settings_that_only_older_programs_had_are_ignored(tmp_path, had):
    path, old = tmp_path / "new.mcap", tmp_path / "old.mcap"
    said = messages(2.0)
    record(path, said)
    older = [(s, topic, payload.replace(had[: had.index(b"{") + 1], had)) for s, topic, payload in said]
    assert older != said
    record(old, older)
    assert [fix.rows for _, fix in replayed_fixes(old)] == [fix.rows for _, fix in replayed_fixes(path)]


@pytest.mark.parametrize("join_s", [0.0, 1.0], ids=["from its start", "from its middle"])
def test_what_was_asked_of_levels_is_replayed(tmp_path, join_s):
    path, asked = tmp_path / "live.mcap", IntegrityRequirement(1e-6, 0.02)
    record(path, messages(2.0, ("a",), "joint", join_s, integrity=asked))
    fixes = [fix for _, fix in replayed_fixes(path)]
    assert {fix.integrity_risk for fix in fixes} == {1e-6}
    assert {fix.alert for fix in fixes if fix.hpl_m is not None} == {Alert.LIMIT}


@pytest.mark.statistical
def test_levels_of_another_risk_are_larger(tmp_path):
    path = tmp_path / "live.mcap"
    record(path, messages(2.0, ("a",), "joint", 0.0))
    last = [replayed_fixes(path, integrity=risk)[-1][1] for risk in (None, IntegrityRequirement(1e-7))]
    assert last[0].position_m == pytest.approx(last[1].position_m)
    assert last[1].hpl_m > 1.15 * last[0].hpl_m


@pytest.mark.parametrize(
    "forged",
    [
        *({"integrity_risk": risk} for risk in (0.0, "high")),
        *({"alert_limit_m": limit_m} for limit_m in (-1.0, "far")),
        *({"method": method} for method in ("rm -rf", "tracker")),
        {"method": 3.5, "site": "x"},
    ],
)
def test_settings_that_nobody_can_ask_for_are_counted(tmp_path, forged):
    path = tmp_path / "forged.mcap"

    def forge(_, m):
        return [m if m.start is None else replace(m, start=SegmentStart({**m.start.settings, **forged}))]

    record(path, changed(messages(1.5, ("a",), "joint", 0.0), forge))
    (report,) = replayed(path)
    assert report.drops == {"impossible-settings": 1}
    assert report.fixes > 300


@pytest.mark.statistical
def test_judged_against_the_recorded_truth(tmp_path):
    path = tmp_path / "live.mcap"
    record(path, messages(3.0, tuple(PLACES)))
    for report in replayed(path, settle_s=0.5):
        assert 0.005 < report.rmse_2d_m < 0.08
        assert report.median_m[:2] == pytest.approx(PLACES[report.tag][:2], abs=0.05)
        assert report.height_m == 0.0
        assert report.rate_hz == pytest.approx(400.0, rel=0.05)


def damage(report):
    """What was dropped but for beacons before the almanac is complete, where a recording begins."""
    beginning = {"no-position", "unconfirmed-anchor"}
    return {name: count for name, count in report.drops.items() if name not in beginning}


def test_messages_that_come_twice_change_nothing(tmp_path):
    path = tmp_path / "twice.mcap"
    record(path, messages(2.0))
    (once,) = replayed(path)
    record(tmp_path / "two.mcap", changed(messages(2.0), lambda _, m: [m, m]))
    (twice,) = replayed(tmp_path / "two.mcap")
    assert (twice.receptions, twice.fixes, twice.drops) == (once.receptions, once.fixes, once.drops)
    assert damage(twice) == {}


def test_a_lost_message_costs_no_more_than_its_receptions(tmp_path):
    path = tmp_path / "gap.mcap"
    lost = []
    record(path, changed(messages(2.0), lambda k, m: lost.append(m) or [] if k == 5 else [m]))
    (report,) = replayed(path)
    record(tmp_path / "all.mcap", messages(2.0))
    (whole,) = replayed(tmp_path / "all.mcap")
    assert damage(report) == {"gap-in-receptions": 1}
    assert report.receptions == whole.receptions - len(lost[0].receptions)
    assert 0 <= whole.fixes - report.fixes <= len(lost[0].receptions) + 10


def test_a_recording_that_begins_within_a_segment_waits_for_the_next(tmp_path):
    path = tmp_path / "late.mcap"
    record(path, changed(messages(2.0), lambda k, m: [replace(m, start=None)]))
    (report,) = replayed(path)
    assert report.fixes == 0
    assert report.drops["receptions-without-beginning"] > 400


def test_impossible_receptions_are_counted(tmp_path):
    said = messages(1.5)
    last = sum(topic.endswith("/receptions") for _, topic, _ in said) - 1

    def change(k, m):
        if k != last:
            return [m]
        one = m.receptions[-1]
        wrong = (replace(one, rx_ticks=1 << 62), replace(one, rx_ticks=-1), replace(one, host_s=1e300))
        return [replace(m, receptions=(*m.receptions, *wrong))]

    path = tmp_path / "impossible.mcap"
    record(path, changed(said, change))
    (report,) = replayed(path)
    assert damage(report) == {"impossible-reception": 3}


def test_another_method(tmp_path):
    path = tmp_path / "live.mcap"
    record(path, messages(2.0))
    (report,) = replayed(path, method="bracketed")
    assert report.method == "bracketed"
    assert 60 < report.fixes < 200


@pytest.mark.statistical
def test_the_command_tells_one_tag_as_other_replays_and_all_in_sums(tmp_path, capsys):
    path, table, plot = tmp_path / "live.mcap", tmp_path / "fixes.csv", tmp_path / "plot.png"
    record(path, messages(2.0, ("a", "b"), publish_every=8))
    assert main(["replay", str(path), "--json", "--fixes-csv", str(table)]) == 0
    both = json.loads(capsys.readouterr().out)
    assert set(both["tags"]) == {"a", "b"}
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert len(rows) == both["fixes"]
    assert {row["tag"] for row in rows} == {"a", "b"}
    assert all(0.0 <= float(row["t_s"]) - UNIX_S <= 2.1 for row in rows)
    assert main(["replay", str(path), "--tag", "b", "--json", "--plot", str(plot)]) == 0
    one = json.loads(capsys.readouterr().out)
    assert one["fixes"] == both["tags"]["b"]["fixes"]
    assert {"rmse_2d_m", "p95_2d_m", "median_m", "receptions_per_s", "height_note"} <= one.keys()
    assert plot.stat().st_size > 10_000
    assert main(["replay", str(path), "--tag", "a"]) == 0
    shown = capsys.readouterr().out
    assert "has no end" not in shown
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 4])
    assert main(["replay", str(path), "--tag", "a"]) == 0
    assert "has no end: it was cut off" in " ".join(capsys.readouterr().out.split())


def test_mistakes_are_told_in_one_line(tmp_path, complaint):
    path = tmp_path / "live.mcap"
    record(path, messages(1.0, ("a", "b")))
    bare = tmp_path / "bare.mcap"
    record(bare, messages(1.0, join_s=9.0))
    at_once = tmp_path / "at_once.mcap"
    at_once.write_bytes(path.read_bytes()[:45])  # what a recorder leaves that is killed before it writes a chunk
    for arguments, words in (
        ([str(path), "--tag", "x"], "one of a, b"),
        ([str(path), "--plot", str(tmp_path / "x.png")], "--tag"),
        ([str(path), "--method", "magic"], "one of"),
        ([str(path), "--truth", str(bare)], "left out"),
        ([str(path), "--integrity-risk", "2"], "--integrity-risk"),
        ([str(path), "--alert-limit-m", "0"], "--alert-limit-m"),
        ([str(bare)], "raw receptions is missing"),
        ([str(at_once)], 'the recording is "empty'),
    ):
        assert words in complaint("replay", *arguments)


@pytest.mark.parametrize(
    ("loss", "method", "warned"), [(0.3, "weighted", True), (0.0, "weighted", False), (0.3, "joint", False)]
)
def test_snapshots_of_few_members_are_warned_of(tmp_path, capsys, loss, method, warned):
    path = tmp_path / "live.mcap"
    record(path, messages(3.0, channel=ChannelModel(loss_probability=loss)))
    assert main(["replay", str(path), "--method", method]) == 0
    told = capsys.readouterr()
    assert ("a: weighted had " in told.err) is warned
    assert "50, 75, 95, 100 % 2-D" in told.out
