"""``skyless replay`` as its user meets it, on recordings of a made-up room (``synthetic_recordings``)."""

import csv
import gzip
import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.image import imread
from msgspec.structs import replace

from skyless.cli.main import main
from skyless.cli.replay import FIXES_COLUMNS
from skyless.core.site import AnchorSite, TagsSite
from skyless.sim.lab import lab_site
from skyless.site.file.template import site_template
from support import synthetic_recordings as synthetic

pytestmark = pytest.mark.site

ROWS = 1500
MIN_FIXES = ROWS - 60 - 10
"""A start from ready-made differences takes 60 of them."""
DL_TDOA = ("uci-binary", "uci-text", "dl-tdoa-json")
TEXTS = {"anchor_ids", "hpl_m", "vpl_m", "integrity_risk", "alert"}
"""Columns that hold no number, or none here: pairs of time differences come without protection levels."""
PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(256))
COMMAND = [sys.executable, "-m", "skyless.cli.main", "replay"]


def site_of_six():
    """A site with six of the recordings' anchors."""
    places = list(synthetic.ANCHORS_M.items())[:6]
    anchors = tuple(AnchorSite(id=number, x_m=x, y_m=y, z_m=z) for number, (x, y, z) in places)
    return replace(lab_site(), anchors=anchors, tags=TagsSite(height_m=1.2))


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A recording of each format, called as the format is; nothing is ever written beside them."""
    folder = tmp_path_factory.mktemp("room")
    (folder / "anchors.csv").write_text(synthetic.anchors_csv())
    (folder / "truth.csv").write_text(synthetic.truth_csv(ROWS * 0.005 + 1.0))
    (folder / "six.toml").write_text(site_template(site_of_six()))
    for name in synthetic.MAKERS:
        synthetic.write(folder / name, name, ROWS)
    return folder


@pytest.fixture
def run(room, capsys, monkeypatch):
    """The command in the room's folder: exit code, standard output and standard error."""
    monkeypatch.chdir(room)

    def call(*arguments):
        return main(["replay", *map(str, arguments)]), *capsys.readouterr()

    return call


def report(result, said=""):
    code, out, err = result
    assert (code, err, out.count("\n")) == (0, said, 1)
    return json.loads(out)


@pytest.mark.parametrize("json_asked", [[], ["--json"]])
def test_a_table_that_knows_the_lesser_part_of_a_recording_is_warned_of(run, tmp_path, json_asked):
    head, *rows = synthetic.anchors_csv().splitlines(keepends=True)
    few = tmp_path / "few.csv"
    few.write_text(head + "".join(rows[:5]))
    code, out, err = run("tdoa-table", "--anchors", few, *json_asked)
    assert code == 0
    (warning,) = err.splitlines()
    count = int(re.fullmatch(r"skyless: warning: (\d+) of 1500 receptions \(\d+%\) are of anchors that .*", warning)[1])
    assert 0.5 * ROWS <= count < ROWS
    assert json_asked == [] or json.loads(out)["drops"]["unknown-anchor"] == count
    assert run("tdoa-table", "--anchors", "anchors.csv", *json_asked)[2] == ""


@pytest.mark.parametrize("name", synthetic.MAKERS)
def test_every_format_gives_fixes_at_the_truth(run, name):
    options = ["--anchors", "anchors.csv", "--truth", "truth.csv", "--settle", "1", "--json"]
    told = report(run(name, *options, *synthetic.LISTENER.get(name, [])))
    assert told["format"] == name
    assert told["receptions"] == ROWS
    assert told["fixes"] > MIN_FIXES
    assert told["rmse_2d_m"] < 0.05  # 100 ps of a stamp are 3 cm, differences of the table have 10 cm
    assert told["rmse_3d_m"] is None or told["rmse_3d_m"] < 0.1
    # fixes over the recording's whole time, that of the start included
    assert told["rate_hz"] == pytest.approx(200.0 if name == "miluv" else 500.0, rel=0.05)
    assert told["dropped"] == sum(told["drops"].values()) < 0.02 * ROWS * 8


def test_fixes_file_and_report_agree(run, room, tmp_path):
    path = tmp_path / "fixes.csv"
    told = report(run("tdoa-table", "--anchors", "anchors.csv", "--fixes-csv", path, "--settle", "0", "--json"))
    with path.open(newline="") as file:
        table = list(csv.DictReader(file))
    assert tuple(table[0]) == FIXES_COLUMNS
    assert len(table) == told["fixes"]
    values = {name: np.array([float(row[name]) for row in table]) for name in FIXES_COLUMNS if name not in TEXTS}
    assert (np.diff(values["t_s"]) > 0.0).all()
    places = np.stack([values["x_m"], values["y_m"], values["z_m"]], axis=1)
    assert np.median(places, axis=0) == pytest.approx(told["median_m"], abs=1e-5)
    assert places.std(axis=0) == pytest.approx(told["std_m"], rel=1e-3)
    covariance = np.array([[values[f"cov_{''.join(sorted(a + b))}_m2"] for a in "xyz"] for b in "xyz"])
    assert (np.linalg.eigvalsh(np.moveaxis(covariance, 2, 0)) > 0.0).all()
    for row in table[20:]:
        anchors = row["anchor_ids"].split()
        assert len(anchors) == int(row["anchors"]) >= 4
        assert set(map(int, anchors)) <= synthetic.ANCHORS_M.keys()


def test_a_fixes_file_of_a_tag_at_known_height_has_that_height(run, tmp_path):
    path = tmp_path / "fixes.csv"
    told = report(run("tdoa-table", "--anchors", "anchors.csv", "--fixes-csv", path, "--tag-height", "1.2", "--json"))
    assert (told["height_m"], told["height_note"], told["rmse_3d_m"]) == (1.2, "given", None)
    with path.open(newline="") as file:
        assert {row["z_m"] for row in csv.DictReader(file)} == {"1.20000"}


def test_several_recordings_have_a_report_each(run, tmp_path):
    bad = tmp_path / "letter.txt"
    bad.write_text("Dear reader,\n" * 30)
    files, options = ["tdoa-table", bad, "bitcraze-text"], ["--anchors", "anchors.csv"]
    code, out, err = run(*files, *options, "--json")
    told = json.loads(out)["recordings"]
    assert (code, out.count("\n")) == (2, 1)
    assert [one["file"] for one in told] == list(map(str, files))
    assert str(bad) in err and "a recording of skyless record" in told[1]["error"]
    for one in (told[0], told[2]):
        alone = report(run(one["file"], *options, "--json"))
        assert one["median_m"] == alone["median_m"]
    code, out, _ = run("tdoa-table", "bitcraze-text", *options)
    assert code == 0
    assert "tdoa-table: tdoa-table: 1500 receptions" in out and "bitcraze-text: bitcraze-text" in out


def test_several_recordings_have_no_single_output(run, complaint, tmp_path):
    for option in ("--fixes-csv", "--plot"):
        err = complaint("replay", "tdoa-table", "bitcraze-text", *A, option, tmp_path / "out.png")
        assert f"{option} is" in err and "several recordings" in err
    assert "'nowhere'" in complaint("replay", "tdoa-table", "nowhere", *A)


def test_heights(run):
    arguments = ["tdoa-table", "--anchors", "anchors.csv", "--json"]
    assert report(run(*arguments))["height_m"] is None  # these anchors tell it
    assert report(run(*arguments, "--tag-height", "free"))["height_note"] == "estimated"
    told = report(run(*arguments, "--tag-height", "truth", "--truth", "truth.csv"))
    assert (told["height_m"], told["height_note"]) == (1.2, "the truth's median")


def test_a_site_file_serves_as_anchors(run):
    told = report(run("tdoa-table", "--site", "six.toml", "--json"))
    assert told["height_note"] == "from the site file"
    assert told["drops"]["unknown-anchor"] > 0  # the site has six anchors, the recording eight


@pytest.mark.statistical
def test_pictures(run, tmp_path):
    arguments = ["tdoa-table", "--anchors", "anchors.csv", "--json"]
    first, other = tmp_path / "a.png", tmp_path / "b.SVG"
    report(run(*arguments, "--truth", "truth.csv", "--plot", first), f"wrote {first}\n")
    report(run(*arguments, "--plot", other), f"wrote {other}\n")
    assert imread(tmp_path / "a.png").shape[1] > 800
    assert b"<svg" in (tmp_path / "b.SVG").read_bytes()


@pytest.mark.statistical
def test_a_table_for_people_in_a_pipe_has_no_control_characters(room):
    environment = {**os.environ, "FORCE_COLOR": "", "FIXES_COLUMNS": "80"}
    done = subprocess.run(
        [*COMMAND, "bitcraze-yaml", "--anchors", "anchors.csv"],
        cwd=room,
        capture_output=True,
        text=True,
        check=True,
        env=environment,
    )
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f]", done.stdout + done.stderr)
    assert f"{ROWS} receptions" in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 80


def test_what_is_left_of_a_damaged_recording_is_used(run, room, tmp_path):
    whole = (room / "tdoa-table").read_bytes()
    packed = gzip.compress(whole)
    (tmp_path / "cut.gz").write_bytes(packed[: len(packed) // 2])
    lines = whole.splitlines(keepends=True)
    lines[100:100] = [b"nan,1,2,3\n", b"0.2,1,2,inf\n", b"0.2,1,2,x\n", b"0.2,1\n", b"\n", b"0.2,1,1,0\n"]
    (tmp_path / "holes.csv").write_bytes(b"".join(lines))
    told = report(run(tmp_path / "cut.gz", "--anchors", "anchors.csv", "--json"))
    assert told["fixes"] > 300
    assert told["drops"]["compressed-stream-cut-off"] == 1
    told = report(run(tmp_path / "holes.csv", "--anchors", "anchors.csv", "--json"))
    assert told["fixes"] > MIN_FIXES
    assert told["drops"].items() >= {"not-finite": 2, "malformed-number": 1, "anchor-against-itself": 1}.items()


@pytest.mark.parametrize("name", [name for name in synthetic.MAKERS if name not in {"avalue", "miluv", *DL_TDOA}])
def test_missing_anchors_are_named_before_the_recording_is_read(run, complaint, name, monkeypatch):
    monkeypatch.setattr("skyless.research.replays.captures.CaptureReplay.run", lambda *_: pytest.fail("it was read"))
    err = complaint("replay", name)
    assert "--anchors is missing" in err
    assert "id,x_m,y_m,z_m" in err


def test_recordings_that_say_where_their_anchors_are_need_no_table(run):
    """MILUV rows have positions; Avalue's anchors measure their distances, which the report gives without a fix."""
    code, out, _ = run("miluv", "--json")
    assert (code, json.loads(out)["fixes"] > 0) == (0, True)
    code, out, err = run("avalue", "--json")
    found = json.loads(out)
    assert (code, found["fixes"], len(found["anchor_distances_m"]) > 0, err.count("\n")) == (1, 0, True, 1)


@pytest.mark.parametrize("name", DL_TDOA)
def test_anchors_of_dl_tdoa_state_where_they_are(run, name):
    packets = report(run(name, "--truth", "truth.csv", "--settle", "1", "--json"))
    assert packets["measurements"] == "packets"
    assert packets["fixes"] > 0.98 * ROWS
    assert packets["rmse_2d_m"] < 0.05
    differences = report(run(name, "--truth", "truth.csv", "--measurements", "differences", "--json"))
    assert differences["measurements"] == "differences"


def test_no_fix_at_all_is_exit_code_1_with_the_likely_reason(run, room, tmp_path):
    others = tmp_path / "others.csv"
    others.write_text("id,x_m,y_m,z_m\n101,0,0,0\n102,5,0,0\n103,5,5,0\n104,0,5,1\n")
    code, out, err = run("tdoa-table", "--anchors", others, "--json")
    told = json.loads(out)
    assert (code, told["fixes"], told["reason"], told["median_m"], told["rate_hz"]) == (1, 0, "no-almanac", None, None)
    assert err.startswith("skyless: no fix: no reception is of an anchor in the table or site file")
    code, out, err = run("tdoa-table", "--anchors", others)
    assert (code, err.count("\n")) == (1, 1)
    assert "none: no-almanac" in out


BAD_FILES = {
    "empty": b"",
    "picture": PNG,
    "letter": b"Dear reader,\n",
    "bad-number.csv": b"id,x_m,y_m,z_m\n1,0,0,far\n",
    "twice.csv": b"id,x_m,y_m,z_m\n1,0,0,0\n1,0,0,1\n",
    "no-z.csv": b"id,x_m,y_m\n1,0,0\n",
    "nan.csv": b"id,x_m,y_m,z_m\n1,0,nan,0\n",
    "ragged.csv": b"id,x_m,y_m,z_m\n1,0,0\n",
    "late.csv": b"t_s,x_m,y_m,z_m\n1000,0,0,0\n1001,0,0,0\n",
    "backwards.csv": b"t_s,x_m,y_m,z_m\n2,0,0,0\n1,0,0,0\n",
    "cut.csv.gz": gzip.compress(synthetic.truth_csv(100).encode())[:-400],
}
OUT_OF_RANGE = ("--tdoa-std 0", "--tdoa-std inf", "--tdoa-std nan", "--settle -1", "--above nan")
A, T = ["--anchors", "anchors.csv"], ["--truth", "truth.csv"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["missing.csv"], ["missing.csv", "there is none"]),
        (["."], ["there is none"]),
        (["{bad}/empty"], ["empty", "one of the formats", "tdoa-table"]),
        (["{bad}/picture"], ["PNG", "one of the formats"]),
        (["{bad}/letter"], ["Dear reader", "one of the formats"]),
        (["tdoa-table", "--format", "mp3"], ["format", "mp3", "bitcraze-yaml"]),
        (["tdoa-table", "--listener", "3"], ["listener", "one listener only"]),
        (["avalue", "--listener", "tag"], ["listener", "tag", "hexadecimal"]),
        (["avalue", "--listener", "77"], ["listener", "77", "that the recording names"]),
        (["miluv", "--listener", "77"], ["listener", "77", "that the recording names"]),
        (["tdoa-table", "--anchors", "missing.csv"], ["missing.csv", "there is none"]),
        (["tdoa-table", "--anchors", "."], ["there is none"]),
        (["tdoa-table", "--anchors", "{bad}/picture"], ["picture", "line 1", "id,x_m,y_m,z_m"]),
        (["tdoa-table", "--anchors", "{bad}/empty"], ["empty", "line 1", "id,x_m,y_m,z_m"]),
        (["tdoa-table", "--anchors", "{bad}/bad-number.csv"], ["line 2", "z_m", "far", "finite number"]),
        (["tdoa-table", "--anchors", "{bad}/nan.csv"], ["line 2", "y_m", "nan", "finite number"]),
        (["tdoa-table", "--anchors", "{bad}/twice.csv"], ["line 3", 'id is "1"', "only once"]),
        (["tdoa-table", "--anchors", "{bad}/no-z.csv"], ["line 1", "id,x_m,y_m,z_m"]),
        (["tdoa-table", "--anchors", "{bad}/ragged.csv"], ["line 2", "4 columns"]),
        (["tdoa-table", "--site", "missing.toml"], ["missing.toml", "there is none"]),
        (["tdoa-table", "--site", "anchors.csv"], ["anchors.csv"]),
        (["tdoa-table", *A, "--site", "six.toml"], ["--anchors", "--site", "not both"]),
        (["tdoa-table", *A, "--truth", "missing.csv"], ["missing.csv", "there is none"]),
        (["tdoa-table", *A, "--truth", "{bad}/late.csv"], ["late.csv", "t_s", "1000.000 to 1001.000", "recording"]),
        (["tdoa-table", *A, "--truth", "{bad}/backwards.csv"], ["backwards.csv", "t_s", "at least 2"]),
        (["tdoa-table", *A, "--truth", "{bad}/cut.csv.gz"], ["cut.csv.gz", "whole file"]),
        (["tdoa-table", *A, "--truth", "anchors.csv"], ["anchors.csv", "line 1", "t_s,x_m,y_m,z_m"]),
        (["tdoa-table", *A, "--lever-arm", "1,2,3"], ["--lever-arm", "--truth"]),
        (["tdoa-table", *A, *T, "--lever-arm", "1,2"], ["--lever-arm", "1,2", "3 number"]),
        (["tdoa-table", *A, *T, "--lever-arm", "1,2,nan"], ["--lever-arm", "nan"]),
        (["tdoa-table", *A, "--tag-height", "tall"], ["--tag-height", "tall", "metres"]),
        (["tdoa-table", *A, "--tag-height", "truth"], ["--tag-height", "--truth"]),
        (["tdoa-table", *A, "--fixes-csv", "no/fixes.csv"], ["no/fixes.csv", "cannot be written"]),
        (["tdoa-table", *A, "--fixes-csv", "."], ["cannot be written", "Is a directory"]),
        (["tdoa-table", *A, "--plot", "no/plot.png"], ["--plot", "no/plot.png", "folder that exists"]),
        (["tdoa-table", *A, "--plot", "plot.xyz"], ["--plot", "plot.xyz", ".png, .svg, .pdf"]),
        (["tdoa-table", *A, "--plot", "plot"], ["--plot", "ending"]),
        *((["tdoa-table", *A, *words], words) for words in map(str.split, OUT_OF_RANGE)),
        (["tdoa-table", *A, "--antenna", "4"], ["--antenna"]),
        ([], ["FILE"]),
    ],
)
def test_a_mistake_is_told_in_one_line(run, complaint, room, tmp_path, arguments, said):
    for name, data in BAD_FILES.items():
        (tmp_path / name).write_bytes(data)
    err = complaint("replay", *(argument.format(bad=tmp_path) for argument in arguments))
    assert [part for part in said if part not in err] == []
    assert sorted(entry.name for entry in room.iterdir()) == sorted(
        {*synthetic.MAKERS, "anchors.csv", "truth.csv", "six.toml"}
    )


def test_a_named_format_holds_where_the_content_does_not_show_it(run, complaint, room, tmp_path):
    path = tmp_path / "late.bin"
    path.write_bytes(bytes(40_000) + (room / "bitcraze-binary").read_bytes())
    assert "one of the formats" in complaint("replay", path, *A, *T, "--json")
    told = report(run(path, *A, *T, "--format", "bitcraze-binary", "--json"))
    assert told["receptions"] == ROWS


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_file_that_may_not_be_written(run, complaint, tmp_path):
    path = tmp_path / "fixes.csv"
    path.touch(mode=0o400)
    assert "Permission denied" in complaint("replay", "tdoa-table", *A, "--fixes-csv", path)


@pytest.mark.statistical
def test_interrupted_replay_keeps_what_it_has_written(room, interrupted, tmp_path):
    long = synthetic.write(tmp_path / "long", "bitcraze-binary", 100_000)
    head, rows = interrupted("replay", long, "--anchors", room / "anchors.csv")
    assert tuple(head) == FIXES_COLUMNS
    assert len(rows) < 100_000
    assert float(rows[-1][0]) > 0.0
