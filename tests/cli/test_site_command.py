"""``skyless site new`` and ``skyless site check``, called as the program calls them."""

import json
import math
import os

import pytest
from msgspec.structs import replace

from skyless.cli.main import main
from skyless.sim.lab import lab_site
from skyless.site.file.load import load_site


def test_new_writes_the_lab(tmp_path):
    path = tmp_path / "lab.toml"
    assert main(["site", "new", str(path), "--site-id", "1"]) == 0
    assert load_site(path) == replace(lab_site(), outline_m=((0, 0), (6, 0), (6, 8), (0, 8)))
    assert list(tmp_path.iterdir()) == [path]  # nothing left beside it
    umask = os.umask(0)
    os.umask(umask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask


def test_new_writes_a_room(tmp_path):
    path = tmp_path / "hall.toml"
    size = ["--width", "30", "--depth", "20", "--anchor-count", "8", "--height", "4.5", "--name", "Hall 3"]
    assert main(["site", "new", str(path), *size]) == 0
    site = load_site(path)
    assert (site.name, len(site.anchors), site.tags.height_m) == ("Hall 3", 8, None)
    assert {anchor.z_m for anchor in site.anchors} == {0.5, 4.0}


def test_two_new_sites_have_different_numbers(tmp_path):
    paths = [tmp_path / f"{number}.toml" for number in range(4)]
    for path in paths:
        assert main(["site", "new", str(path)]) == 0
    assert len({load_site(path).id for path in paths}) > 1  # four equal ones: once in 10¹⁴


def test_a_new_hall_has_the_master_that_a_plan_asks_for(tmp_path, capsys):
    """The hall of the README: from its corner one anchor received 9 % of the master."""
    path = tmp_path / "hall.toml"
    hall = ["--width", "30", "--depth", "20", "--anchor-count", "8", "--height", "4", "--paper"]
    assert main(["site", "new", str(path), *hall]) == 0
    assert load_site(path).master == 2
    capsys.readouterr()
    assert main(["site", "check", str(path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert min(anchor["hears_master"] for anchor in report["anchors"]) > 0.9
    assert report["warnings"] == []
    path.write_text(path.read_text().replace("\nmaster = 2", "\nmaster = 1"))
    assert main(["site", "check", str(path)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "anchors 5 (9%), 4 (58%)" in shown
    assert "with anchor 2 as the master all would receive 90% or more" in shown
    assert "the site file is valid, with warnings" in shown


def test_tags_of_a_grid_may_have_any_height(tmp_path):
    path = tmp_path / "grid.toml"
    grid = ["site", "new", str(path), "--width", "60", "--depth", "60", "--spacing", "15", "--force"]
    for given, height_m in (([], 1.2), (["--tag-height", "2.5"], 2.5), (["--tag-height", "free"], None)):
        assert main([*grid, *given]) == 0
        assert load_site(path).tags.height_m == height_m


def test_new_overwrites_only_by_force(tmp_path, complaint):
    path = tmp_path / "mine.toml"
    path.write_text("precious")
    assert "--force" in complaint("site", "new", path)
    assert path.read_text() == "precious"
    assert main(["site", "new", str(path), "--force"]) == 0
    assert load_site(path).name == "mine"


OUT_OF_RANGE = ("--width 0", "--width nan", "--anchor-count 0", "--anchor-count 256")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--width", "3"], "both --width and --depth"),
        (["--anchor-count", "8"], "both --width and --depth"),
        (["--tag-height", "0"], "both --width and --depth"),
        (["--spacing", "5"], "a grid needs"),
        (["--width", "9", "--depth", "9", "--spacing", "3", "--anchor-count", "5"], "a grid needs"),
        (["--width", "10000", "--depth", "10000", "--spacing", "15"], "444889 anchors are too many"),
        (["--width", "3", "--depth", "3", "--tag-height", "nan"], "--tag-height is 'nan'; it should be metres or free"),
        (["--unplaced", "200", "--board", "dwm1001-dev"], "its line carries 156 anchors in view, not 200"),
        (["--width", "0.001", "--depth", "0.001"], "--width is 0.001; it should be a number, at least 0.1"),
        (["--width", "3", "--depth", "0.09"], "--depth is 0.09; it should be a number, at least 0.1"),
        *(([*["--width", "3", "--depth", "3"], *two.split()], two.split()[0]) for two in OUT_OF_RANGE),
    ],
)
def test_new_refuses(tmp_path, complaint, options, said):
    assert said in complaint("site", "new", tmp_path / "x.toml", *options)
    assert list(tmp_path.iterdir()) == []


def test_new_where_nothing_can_be_written(tmp_path, complaint):
    assert "cannot be written" in complaint("site", "new", tmp_path / "no" / "x.toml")


def test_check_shows_the_site(tmp_path, capsys):
    path = tmp_path / "[red]lab.toml"  # no markup of the terminal library's
    main(["site", "new", str(path), "--paper"])
    assert main(["site", "check", str(path)]) == 0
    shown = capsys.readouterr().out
    for part in ("3 (master)", "66.7 superframes/s", "400 messages/s", "315 µs", "the site file is valid"):
        assert part in shown


def test_check_shows_warnings(tmp_path, capsys):
    path = tmp_path / "flat.toml"
    main(["site", "new", str(path)])
    path.write_text(path.read_text().replace("height_m = 0.0", "# height_m = 0.0"))
    assert main(["site", "check", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "warning: all anchors lie nearly in one plane" in shown
    assert "valid, with warnings" in shown


def test_new_writes_anchors_without_positions(tmp_path, complaint):
    path = tmp_path / "blank.toml"
    assert main(["site", "new", str(path), "--unplaced", "7", "--tag-height", "1.1"]) == 0
    site = load_site(path)
    assert (site.anchors, site.schedule.mode, site.tags.height_m) == ((), "free", 1.1)
    assert [anchor.id for anchor in site.unplaced] == [1, 2, 3, 4, 5, 6, 7]
    assert main(["site", "check", str(path)]) == 0
    assert "--unplaced is 7; it takes no sizes" in complaint(
        "site", "new", path, "--unplaced", "7", "--width", "3", "--force"
    )


HALF_A_LINE = 457_143 / 10 / 2  # bytes a second: 460,800 baud as an nRF52832 makes it


@pytest.mark.parametrize("phases", [[], ["--phases"]])
@pytest.mark.parametrize("anchors", [1, 2, 3, 6, 8, 9, 20, 57, 156])
def test_for_a_dwm1001_dev_all_anchors_together_fill_at_most_half_of_its_line(tmp_path, phases, anchors):
    path = tmp_path / "site.toml"
    assert main(["site", "new", str(path), "--unplaced", str(anchors), "--board", "dwm1001-dev", *phases]) == 0
    rate_hz = load_site(path).schedule.rate_hz
    used = anchors * rate_hz * (19 + min(63 + 8 * (anchors - 1), 127))  # docs/serial.md, docs/protocol2.md
    assert used <= HALF_A_LINE
    assert rate_hz == 66.6 or used > HALF_A_LINE - 0.1 * anchors * 146  # as many as fit, in steps of 0.1 Hz
    assert "half full at most, with all anchors in view: a DWM1001-DEV's" in path.read_text()


def test_for_a_dwm1001_dev_slots_are_longer_and_a_halls_far_anchors_do_not_count(tmp_path):
    path = tmp_path / "site.toml"
    new = ["site", "new", str(path), "--board", "dwm1001-dev", "--force"]
    assert main([*new, "--paper"]) == 0
    assert 146 / load_site(path).schedule.slot_s <= HALF_A_LINE < 146 / (load_site(path).schedule.slot_s - 1e-4)
    assert main([*new, "--width", "200", "--depth", "200", "--spacing", "12"]) == 0
    points = [(anchor.x_m, anchor.y_m) for anchor in load_site(path).anchors]
    in_view = max(sum(math.dist(at, point) < 31.0 for point in points) for at in points)
    assert in_view * load_site(path).schedule.rate_hz * 146 <= HALF_A_LINE
