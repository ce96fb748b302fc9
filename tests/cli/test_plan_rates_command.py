"""``skyless site new --spacing``, ``site check`` and ``skyless plan`` at sites of protocol 2."""

import json

import pytest
from matplotlib.image import imread

from skyless.cli.main import main
from skyless.site.file.load import load_site

pytestmark = pytest.mark.statistical

GRID = ["--width", "120", "--depth", "90", "--spacing", "15"]
HALL = """\
name = "hall"   # ours
id = 7

[schedule]
mode = "free"

[tags]
height_m = 1.0

"""


@pytest.fixture
def hall(tmp_path):
    path = tmp_path / "hall.toml"
    rows = (f"[[anchors]]\nid = {10 + k}  # post {k}\nx_m = {12 * (k % 9)}.0\ny_m = {12 * (k // 9)}.0\nz_m = 3.0\n\n"
            for k in range(72))  # fmt: skip
    path.write_text(HALL + "".join(rows) + "[[anchors]]\nid = 99   # to be measured\n")
    return path


def run(capsys, *arguments):
    assert main([*map(str, arguments)]) == 0
    return capsys.readouterr().out


def planned(capsys, *arguments):
    return json.loads(run(capsys, "plan", *arguments, "--json").splitlines()[-1])


def test_a_new_grid(tmp_path, capsys):
    path = tmp_path / "g.toml"
    run(capsys, "site", "new", path, *GRID)
    site = load_site(path)
    assert (len(site.anchors), site.schedule.mode) == (48, "free")
    assert {anchor.z_m for anchor in site.anchors} == {4.0}
    assert site.tags.height_m == 1.2
    shown = run(capsys, "site", "check", path)
    assert "at random instants" in shown
    assert "the site file is valid" in shown
    report = json.loads(run(capsys, "site", "check", path, "--json"))
    assert (report["mode"], report["master"], len(report["anchors"])) == (site.schedule.mode, None, 48)


def test_a_table_with_few_anchors_shows_those_without_a_position(tmp_path, capsys):
    path = tmp_path / "few.toml"
    path.write_text(
        'name = "few"\nid = 1\n[schedule]\nmode = "free"\n[[anchors]]\nid = 8\n[[anchors]]\nid = 9\nx_m=1\ny_m=2\n'
    )
    shown = run(capsys, "site", "check", path)
    assert "?" in shown
    assert "1 of 2 anchors have no position yet" in shown


def test_a_plan_shows_and_draws_what_reaches_tags(hall, tmp_path, capsys):
    picture = tmp_path / "rates.png"
    result = planned(capsys, hall, "--plot", picture)
    assert imread(picture).shape[0] > 300
    assert (result["mode"], result["beacons_per_s_of_each_anchor"], len(result["anchors"])) == (
        "free",
        pytest.approx(26.47, abs=0.01),
        72,
    )
    assert [anchor["id"] for anchor in result["unplaced"]] == [99]
    assert result["reception"]["beacons_per_s"]["median"] > 100.0
    shown = run(capsys, "plan", hall, "--exponent", "2.5", "--range", "40")
    assert "40 m (path loss exponent 2.5)" in " ".join(shown.split())
    assert "beacons/s at a tag" in shown


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--optimise", "5"], "--optimise is"),
        (["--verify", "5"], "--verify is"),
        (["--html", "x.html"], "--html is"),
        (["--rounds", "200"], "--rounds is"),
        (["--exponent", "9"], "exponent"),
        (["--step", "0.001"], "no map"),
    ],
)
def test_options_that_mean_nothing_here(hall, complaint, options, said):
    error = complaint("plan", hall, *options)
    assert said in error
    assert not said.endswith(" is") or "it should be left out" in error


def test_the_exponent_is_not_for_a_site_with_a_master(tmp_path, capsys, complaint):
    run(capsys, "site", "new", tmp_path / "lab.toml", "--paper")
    assert "more than 60 anchors" in complaint("plan", tmp_path / "lab.toml", "--exponent", "3")


def test_a_site_without_positions_has_no_plan(tmp_path, capsys, complaint):
    path = tmp_path / "new.toml"
    run(capsys, "site", "new", path, "--unplaced", "2")
    assert "it should be at least 4" in complaint("plan", path)
