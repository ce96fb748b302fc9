"""``skyless calibrate``: sites with known wrong delays, tables, and what goes wrong."""

import csv
import gzip
import json
import os
from math import dist

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.cli.main import main
from skyless.core.ticks import TICK_M
from skyless.sim.impairments import DelayError
from skyless.site.file.load import load_site
from skyless.site.file.template import site_template
from skyless.site.tables import read_calibration
from support import live_site
from support.bench import LAB

pytestmark = pytest.mark.site

OFF = {2: (40.0, 0.0), 3: (0.0, -50.0), 4: (30.0, 30.0), 5: (-64.0, 20.0), 1: (0.0, 0.0), 6: (0.0, 0.0)}
"""True minus configured TX and RX delays, ticks."""


@pytest.fixture(scope="module")
def site_recording(tmp_path_factory):
    """A recording of the lab with wrong delays, one standing tag, and the site's file as it was."""
    folder = tmp_path_factory.mktemp("faulty")
    ids = sorted(anchor.id for anchor in LAB.anchors)
    errors = tuple(DelayError(id_, *OFF[k + 1]) for k, id_ in enumerate(ids))
    live_site.record(folder / "stay.mcap", live_site.messages(8.0, join_s=0.0, delay_errors=errors))
    (folder / "site.toml").write_text(site_template(LAB))
    return folder, {error.anchor: error for error in errors}


def run(capsys, *arguments):
    code = main(["calibrate", *map(str, arguments), "--json"])
    out, err = capsys.readouterr()
    assert (code, err) == (0, "")
    return json.loads(out)


@pytest.mark.parametrize("place", ["--recorded-truth", "--at=3,4"])
def test_the_delays_of_a_site_are_found_and_written_back(site_recording, capsys, tmp_path, place):
    folder, errors = site_recording
    out = tmp_path / "new.toml"
    report = run(capsys, folder / "stay.mcap", "--site", folder / "site.toml", "--out", out, place)
    wanted = {i: e.tx_ticks + e.rx_ticks for i, e in errors.items()}
    for one in report["anchors"]:
        assert one["delay_m"] == pytest.approx(wanted[one["id"]] * TICK_M / 2.0, abs=0.01)
        assert 0.005 < one["delay_std_m"] < 0.03  # it counts reflections, of which these simulated ways have none
    before = {anchor.id: anchor.tx_antenna_delay_ticks for anchor in LAB.anchors}
    after = {anchor.id: anchor.tx_antenna_delay_ticks for anchor in load_site(out).anchors}
    assert {i: after[i] - before[i] for i in after} == pytest.approx(wanted, abs=4.0)
    changed = ("tx_antenna_delay_ticks = 1", "_std_m = ")
    assert [line for line in out.read_text().splitlines() if not any(key in line for key in changed)] == [
        line for line in site_template(LAB).splitlines() if not any(key in line for key in changed)
    ]


@pytest.mark.statistical
def test_a_replay_with_the_corrected_file_is_as_good_as_without_errors(site_recording, capsys, tmp_path):
    folder, _ = site_recording
    out = tmp_path / "new.toml"
    run(capsys, folder / "stay.mcap", "--recorded-truth", "--site", folder / "site.toml", "--out", out)
    reports = []
    for more in ((), ("--site", out), ("--site", out, "--method", "weighted")):
        assert main(["replay", str(folder / "stay.mcap"), *map(str, more), "--json"]) == 0
        reports.append(json.loads(capsys.readouterr().out))
    assert reports[0]["rmse_2d_m"] > 2.0 * reports[1]["rmse_2d_m"]
    assert reports[1]["rmse_2d_m"] < 0.04
    assert reports[2]["rmse_2d_m"] < 0.09  # 5.2 cm of noise (docs/maths.md section 5)
    assert np.hypot(*reports[2]["bias_m"][:2]) < 0.02


def test_mending_twice_is_mending_once(site_recording, capsys, tmp_path):
    """Delays are counted from those of the recording, not from those of the file."""
    folder, _ = site_recording
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    run(capsys, folder / "stay.mcap", "--recorded-truth", "--site", folder / "site.toml", "--out", first)
    run(capsys, folder / "stay.mcap", "--recorded-truth", "--site", first, "--out", second)
    delays = [{one.id: one.tx_antenna_delay_ticks for one in load_site(file).anchors} for file in (first, second)]
    assert delays[0] == delays[1]


def test_a_compressed_recording_is_named(site_recording, complaint, tmp_path):
    folder, _ = site_recording
    packed = tmp_path / "stay.mcap.gz"
    packed.write_bytes(gzip.compress((folder / "stay.mcap").read_bytes()))
    assert 'the file is "a compressed MCAP"; it should be unpacked first' in complaint("calibrate", packed)


def test_a_recording_that_was_cut_off_serves_and_is_reported(site_recording, capsys, tmp_path):
    folder, _ = site_recording
    whole = (folder / "stay.mcap").read_bytes()
    (tmp_path / "half.mcap").write_bytes(whole[: len(whole) // 2])
    report = run(capsys, tmp_path / "half.mcap", "--at", "3,4")
    assert report["drops"] == ["left out: 1 × unfinished-record"]
    assert report["usable"]


@pytest.fixture
def stay(tmp_path):
    """A tag at two known places before anchors that are off, as tables."""
    rng = np.random.default_rng(1)
    places = {k: (6.0 * (k % 2), 4.0 * (k // 2), 0.3 + 2.0 * (k % 3)) for k in range(6)}
    bias = {k: 0.1 * k - 0.25 for k in places}
    with (tmp_path / "stay.csv").open("w") as table:
        writer = csv.writer(table)
        writer.writerow(("t_s", "idA", "idB", "tdoa_m"))
        for k in range(2000):
            at_m = (2.0, 3.0, 1.0) if k < 1000 else (4.0, 5.0, 1.5)
            a, b = rng.choice(6, 2, replace=False).tolist()
            tdoa_m = dist(at_m, places[b]) - dist(at_m, places[a]) + bias[b] - bias[a] + rng.normal(0.0, 0.05)
            writer.writerow((100.0 + 0.01 * k, a, b, tdoa_m))
    anchors = "\n".join(f"{k},{x},{y},{z}" for k, (x, y, z) in places.items())
    (tmp_path / "anchors.csv").write_text(f"id,x_m,y_m,z_m\n{anchors}\n")
    (tmp_path / "far.csv").write_text("t_s,x_m,y_m,z_m\n0,1e300,0,0\n")
    (tmp_path / "near.csv").write_text("t_s,x_m,y_m,z_m\n0,2,3,1\n")
    (tmp_path / "full.csv").symlink_to("/dev/full")
    os.mkfifo(tmp_path / "pipe")
    return tmp_path, bias


def test_two_stays_give_a_calibrated_table_that_replay_applies(stay, capsys):
    folder, bias = stay
    tables = (folder / "stay.csv", "--anchors", folder / "anchors.csv")
    out = folder / "calibrated.csv"
    report = run(capsys, *tables, "--at", "2,3,1@0:9.895", "--at", "4,5,1.5@10.095:99", "--out", out)
    assert report["drops"] == {"place-unknown": 20}
    known = read_calibration(out)
    for anchor, expected_m in bias.items():
        assert known.anchors[anchor].bias_m == pytest.approx(expected_m, abs=0.02)
    errors = []
    for more in ((folder / "anchors.csv",), (out,), (out, "--uncalibrated")):
        assert main(["replay", str(folder / "stay.csv"), "--anchors", *map(str, more), "--settle", "11", "--json"]) == 0
        errors.append(dist(json.loads(capsys.readouterr().out)["median_m"], (4.0, 5.0, 1.5)))
    assert errors[1] < 0.03
    assert errors[0] == errors[2] > 0.1


@pytest.mark.parametrize(("first", "used"), [("30", 30), ("5s", 501), ("25%", 500)])
def test_only_the_beginning(stay, capsys, first, used):
    folder, _ = stay
    report = run(capsys, folder / "stay.csv", "--anchors", folder / "anchors.csv", "--at", "2,3,1", "--first", first)
    assert report["used"] + report["rejected"] == pytest.approx(used, abs=1)
    assert report["written"] is None
    assert used < 100 or report["notes"] == []


def test_the_report_for_people(stay, capsys):
    folder, _ = stay
    command = ["calibrate", folder / "stay.csv", "--anchors", folder / "anchors.csv", "--at", "2,3,1@0:9"]
    assert main([*map(str, command)]) == 0
    out = capsys.readouterr().out
    assert "only differences can be seen" in out
    assert "cm before" in out


def test_a_wrong_place_is_noticed(stay, capsys):
    folder, _ = stay
    report = run(capsys, folder / "stay.csv", "--anchors", folder / "anchors.csv", "--at", "2,3,1")
    assert any("no constants explain" in note or "outliers" in note for note in report["notes"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--at", "1,2"), "lacks its height"),
        (("--at", "1,2,x"), "--at is"),
        (("--at", "1,2,x@0:9"), "--at is '1,2,x@0:9'; '1,2,x' should be 2 or 3 numbers"),
        (("--at", "1,2,1e300"), "metres, at most 1e+06"),
        (("--truth", "{folder}/far.csv"), 'line 2, column x_m is "1e300"; it should be metres, at most'),
        (("--truth", "{folder}/near.csv", "--lever-arm", "1e300,0,0"), "--lever-arm is (1e+300, 0.0, 0.0); it should"),
        (("--truth", "{folder}/pipe"), "a pipe"),
        (("--at", "1,2,3@9:4"), "later one last"),
        (("--at", "1,2,3", "--at", "4,5,6@0:9"), "--at is '1,2'; before another --at it should have its times"),
        (("--at", "1,2,3", "--force"), "nothing is written without --out"),
        (("--at", "1,2,3@90:99"), "place-unknown"),
        (("--at", "1,2,3", "--first", "0"), "--first is '0'"),
        (("--at", "1,2,3", "--first", "120%"), "--first is"),
        (("--at", "1,2,3", "--lever-arm", "0,0,1"), "without --truth"),
        (("--at", "1,2,3", "--tag", "a"), "--tag"),
        ((), "--truth or --at should say where the tag was"),
        (("--at", "1,2,3", "--site", "{folder}/site.toml", "--out", "x.toml"), "it should be a table, .csv"),
        (("--at", "1,2,3", "--out", "x.toml"), "needs --site"),
        (("--at", "1,2,3", "--out", "{folder}/anchors.csv"), "--force overwrites it"),
        (("--at", "1,2,3", "--force", "--out", "{folder}/stay.csv"), "would destroy it"),
        (("--at", "1,2,3", "--out", "{folder}/no/such.csv"), "a folder that exists"),
        (("--at", "1,2,3", "--force", "--out", "{folder}"), "should be a file in a folder"),
        (("--at", "2,3,1", "--force", "--out", "{folder}/full.csv"), "full.csv cannot be written: No space left"),
    ],
)
def test_what_the_user_can_mend_is_said(stay, complaint, arguments, words):
    folder, _ = stay
    before = (folder / "anchors.csv").read_text()
    given = (one.format(folder=folder) for one in arguments)
    assert words in complaint("calibrate", folder / "stay.csv", "--anchors", folder / "anchors.csv", *given)
    assert (folder / "anchors.csv").read_text() == before
    assert (folder / "full.csv").is_char_device()


def test_a_table_may_be_calibrated_in_its_place_when_asked(stay, capsys):
    folder, _ = stay
    table = folder / "anchors.csv"
    run(capsys, folder / "stay.csv", "--anchors", table, "--at", "2,3,1@0:9.9", "--out", table, "--force")
    once = table.read_text()
    run(capsys, folder / "stay.csv", "--anchors", table, "--at", "2,3,1@0:9.9", "--out", table, "--force")
    assert table.read_text() == once  # what stood in it is replaced and not added to


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--at", "3,4", "--out", "new.toml"), "a site file needs --site"),
        (("--at", "3,4", "--tag", "nobody"), "tag is"),
        (("--at", "3,4", "--site", "{folder}/other.toml"), "site's id"),
        (("--at", "3,4", "--site", "{folder}/site.toml", "--out", "{folder}/site.toml"), "--force overwrites it"),
        (("--at", "3,4", "--lever-arm", "0,0,1"), "without --truth and --lever-arm"),
    ],
)
def test_what_a_recording_of_a_site_does_not_take(site_recording, complaint, arguments, words):
    folder, _ = site_recording
    (folder / "other.toml").write_text(site_template(replace(LAB, id=LAB.id + 1)))
    given = (one.format(folder=folder) for one in arguments)
    assert words in complaint("calibrate", folder / "stay.mcap", *given)
