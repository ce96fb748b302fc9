"""``skyless site new --spacing``, ``site check`` and ``skyless plan`` at sites of protocol 2."""

import json

import pytest
from matplotlib.image import imread

from skyless.cli.main import main
from skyless.site.load import load_site

GRID = ["--width", "120", "--depth", "90", "--spacing", "15"]
HALL = """\
name = "hall"   # ours
id = 7

[schedule]
mode = "slots"  # by the planner
reuse_m = 40.0

[tags]
height_m = 1.0

"""


@pytest.fixture
def hall(tmp_path):
    path = tmp_path / "hall.toml"
    rows = (f"[[anchors]]\nid = {10 + k}  # post {k}\nx_m = {12 * (k % 9)}.0\ny_m = {12 * (k // 9)}.0\nz_m = 3.0\n\n"
            for k in range(27))  # fmt: skip
    path.write_text(HALL + "".join(rows) + "[[anchors]]\nid = 99   # to be measured\n")
    return path


def run(capsys, *arguments):
    assert main([*map(str, arguments)]) == 0
    return capsys.readouterr().out


def planned(capsys, *arguments):
    return json.loads(run(capsys, "plan", *arguments, "--json").splitlines()[-1])


def refused(capsys, *arguments):
    assert main([*map(str, arguments)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize("free", [[], ["--free"]])
def test_a_new_grid(tmp_path, capsys, free):
    path = tmp_path / "g.toml"
    run(capsys, "site", "new", path, *GRID, *free)
    site = load_site(path)
    assert (len(site.anchors), site.schedule.mode) == (48, "free" if free else "slots")
    assert {anchor.z_m for anchor in site.anchors} == {4.0}
    assert site.tags.height_m == 1.2
    shown = run(capsys, "site", "check", path)
    assert "at random instants" in shown if free else "anchors in a slot" in shown
    assert "the site file is valid" in shown
    report = json.loads(run(capsys, "site", "check", path, "--json"))
    assert (report["mode"], report["master"], len(report["anchors"])) == (site.schedule.mode, None, 48)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--spacing", "5"], "a grid needs"),
        (["--free", "--width", "9", "--depth", "9"], "a grid needs"),
        ([*GRID, "--anchor-count", "5"], "a grid needs"),
        (["--width", "10000", "--depth", "10000", "--spacing", "15"], "444889 anchors are too many"),
        (["--width", "100", "--depth", "100", "--spacing", "3"], "at most 255"),
    ],
)
def test_grids_that_cannot_be(tmp_path, capsys, options, said):
    assert said in refused(capsys, "site", "new", tmp_path / "x.toml", *options)


def test_a_table_with_few_anchors_shows_those_without_a_position(tmp_path, capsys):
    path = tmp_path / "few.toml"
    path.write_text(
        'name = "few"\nid = 1\n[schedule]\nmode = "free"\n[[anchors]]\nid = 8\n[[anchors]]\nid = 9\nx_m=1\ny_m=2\n'
    )
    shown = run(capsys, "site", "check", path)
    assert "?" in shown
    assert "1 of 2 anchors have no position yet" in shown


def test_slots_are_coloured_shown_and_written(hall, tmp_path, capsys):
    before = hall.read_text()
    assert "skyless plan" in refused(capsys, "site", "check", hall)
    picture = tmp_path / "slots.png"
    result = planned(capsys, hall, "--plot", picture)
    assert hall.read_text() == before
    assert imread(picture).shape[0] > 500
    assert (result["mode"], result["slots_of_file"], result["written"]) == ("slots", False, False)
    assert result["nearest_sharing_m"] >= 40.0
    slots = {anchor["id"]: anchor["slot"] for anchor in [*result["anchors"], *result["unplaced"]]}
    assert slots[99] == result["slots"] - 1
    assert list(slots.values()).count(slots[99]) == 1
    assert "--write" in result["warnings"][-1]

    hall.write_bytes(b"\xef\xbb\xbf" + hall.read_bytes())  # as an editor of Windows leaves it
    assert "written" in run(capsys, "plan", hall, "--write")
    site = load_site(hall)
    assert {anchor.id: anchor.slot for anchor in site.all_anchors} == slots
    assert site.schedule.slots == result["slots"]
    kept = [line for line in hall.read_text().splitlines() if not line.startswith("slot")]
    assert kept == before.splitlines()
    assert planned(capsys, hall)["slots_of_file"]

    assert "--force" in refused(capsys, "plan", hall, "--write")
    whole = hall.read_text()
    hall.write_text(whole.replace("slot = 0\n", "", 1))
    assert "plan --write --force colours" in refused(capsys, "site", "check", hall)
    assert planned(capsys, hall)["warnings"][-1].endswith("--write --force writes them into it")
    hall.write_text(whole)
    pairs = tmp_path / "pairs.csv"
    pairs.write_text(f"# heard at once\n10,{next(k for k in slots if k != 10 and slots[k] == slots[10])}\n")
    again = planned(capsys, hall, "--write", "--force", "--conflicts", pairs)
    changed = {anchor["id"]: anchor["slot"] for anchor in again["anchors"]}
    ten, other = (int(part) for part in pairs.read_text().splitlines()[1].split(","))
    assert changed[ten] != changed[other]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--optimise", "5"], "--optimise is not for this site"),
        (["--method", "weighted"], "--method is not for this site"),
        (["--verify", "5"], "--verify is not for this site"),
        (["--html", "x.html"], "--html is not for this site"),
        (["--rounds", "200"], "--rounds is not for this site"),
        (["--conflicts", "none.csv"], "cannot be read"),
        (["--exponent", "9"], "exponent"),
        (["--step", "0.001"], "no map"),
    ],
)
def test_options_that_mean_nothing_here(hall, capsys, options, said):
    assert main(["plan", str(hall), *options]) == 2
    assert said in capsys.readouterr().err


def test_conflicts_are_checked(hall, tmp_path, capsys):
    pairs = tmp_path / "pairs.csv"
    pairs.write_text("10,11\n\n10;12\n")
    assert "line 3 is '10;12'; it should be two identifiers" in refused(capsys, "plan", hall, "--conflicts", pairs)


def test_slots_are_not_for_other_modes(tmp_path, capsys):
    lab, grid = tmp_path / "lab.toml", tmp_path / "grid.toml"
    run(capsys, "site", "new", lab)
    assert "mode master" in refused(capsys, "plan", lab, "--write")
    assert "mode master" in refused(capsys, "plan", lab, "--exponent", "3")
    run(capsys, "site", "new", grid, *GRID, "--free")
    assert "mode free" in refused(capsys, "plan", grid, "--write")
    shown = run(capsys, "plan", grid, "--exponent", "2.5", "--range", "40")
    assert "40 m (path loss exponent 2.5)" in shown


def test_a_site_without_positions_gets_slots(tmp_path, capsys):
    path = tmp_path / "new.toml"
    path.write_text(
        'name = "new"\nid = 1\n[schedule]\nmode = "slots"\n' + "".join(f"[[anchors]]\nid = {k}\n" for k in (3, 4))
    )
    assert planned(capsys, path, "--write")["reception"] is None
    assert [anchor.slot for anchor in load_site(path).unplaced] == [0, 1]
    assert "--plot needs anchors" in refused(capsys, "plan", path, "--plot", tmp_path / "x.png")
