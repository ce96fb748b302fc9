"""``skyless plan`` as its users meet it: outputs, options, and one line for every mistake."""

import json
import re

import numpy as np
import pytest
from matplotlib.image import imread, imsave

from skyless.cli.main import main
from skyless.core.site import AccuracySite
from skyless.sim.lab import paper_lab_site
from skyless.site.file.load import load_site
from skyless.site.file.template import site_template

pytestmark = pytest.mark.statistical

EXTRAS = """
[[walls]]
x1_m = 2.0
y1_m = 3.0
x2_m = 4.0
y2_m = 3.0
delay_m = 0.0

[floor_plan]
image = "floor.png"
width_m = 6.0

[georeference]
latitude_deg = 45.0
longitude_deg = 7.0
"""


@pytest.fixture
def lab(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text(site_template(paper_lab_site(accuracy=AccuracySite())) + EXTRAS)
    imsave(tmp_path / "floor.png", np.linspace(0, 1, 80 * 60).reshape(80, 60))
    return path


def planned(capsys, *arguments):
    assert main(["plan", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out.splitlines()[-1])


@pytest.mark.statistical
def test_all_files_at_once(lab, tmp_path, capsys):
    png, page, table = tmp_path / "map.png", tmp_path / "plan.html", tmp_path / "grid.geojson"
    files = ["--plot", png, "--html", page, "--grid", table]
    result = planned(capsys, lab, "--step", "0.5", "--target", "4.5", *files)
    assert result["points"] == 192
    assert 0.035 < result["mean_sigma_m"] < result["worst_sigma_m"] < 0.06
    assert 0.0 < result["target_share"] < 1.0
    assert imread(png).shape[0] > 500
    text = page.read_text()
    assert text.count("data:image/png;base64,") >= 4
    assert not re.search(r'(src|href)="(?!data:)', text), "a page that needs another file"
    features = json.loads(table.read_text())["features"]
    assert len(features) == 192
    assert features[0]["geometry"]["coordinates"][:2] == pytest.approx([7.0, 45.0], abs=1e-4)


def test_people_get_a_table(lab, capsys):
    assert main(["plan", str(lab), "--step", "1"]) == 0
    out = capsys.readouterr().out
    assert "standard deviation" in out
    assert "one more anchor" in out
    assert not re.search(r"one more anchor.* cm", out), "a second mean and worst, of other points than the map's"


def test_an_optimised_site_is_a_site(lab, tmp_path, capsys, complaint):
    out = tmp_path / "better" / "site.toml"
    out.parent.mkdir()
    options = ["--optimise", "4", "--out", out, "--heights", "0,1", "--step", "1", "--search-seconds", "10"]
    result = planned(capsys, lab, *options)
    site = load_site(out)
    assert len(site.anchors) == 4
    assert site.walls == load_site(lab).walls
    assert site.floor_plan.image == "../floor.png"
    assert {anchor.z_m for anchor in site.anchors} <= {0.0, 1.0}
    assert result["optimised"]["mean_ratio"] < 1.0
    assert result["optimised"]["worst_ratio"] < 1.0
    assert "exists" in complaint("plan", lab, *options)


def test_verification_tells_its_points(lab, capsys):
    result = planned(capsys, lab, "--verify", "2", "--rounds", "300", "--step", "1")
    points = result["verification"]["points"]
    assert len(points) == 2
    for point in points:
        assert point["ratio"] == pytest.approx(1.0, abs=0.03 + 4 * point["ratio_error"])


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (lambda text: "[[anchors]]".join(text.split("[[anchors]]")[:2]), ["lab.toml: anchors is", "at least 3"]),
        (lambda text: re.sub(r"(x|y)_m = \d+\.\d+\n", r"\1_m = 1.0\n", text), ["anchors[1] (anchor 2)", "same point"]),
        (lambda text: text.replace("x_m = 6.0", "x_m = nan", 1),
         ["anchors[1].x_m (anchor 2) is nan; it should be a number of metres"]),
        (lambda text: text.replace("width_m = 6.0", "width_m = 3.0"),
         ["(anchor 2)", "on the floor, which reaches from (0, 0) to (3, 4) m"]),
    ],
)  # fmt: skip
def test_a_wrong_site_is_reported(lab, complaint, changed, said):
    """One anchor, all in one point, not a number, outside the plan."""
    lab.write_text(changed(lab.read_text()))
    line = complaint("plan", lab)
    assert [part for part in said if part not in line] == []


@pytest.mark.parametrize("keep", [0, 10, 200])
def test_an_image_that_cannot_be_read(lab, tmp_path, complaint, keep):
    image = tmp_path / "floor.png"
    image.write_bytes(image.read_bytes()[:keep])
    assert 'floor_plan.image is "floor.png"; it should be' in complaint("plan", lab)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--region", "1,2,3"], "--region is '1,2,3'"),
        (["--region", "3,3,1,1"], "x1 < x2"),
        (["--region", "50,50,60,60"], "inside the outline"),
        (["--outline", "0,0 1,1"], "three or more corners"),
        (["--outline", "0,0 3,0 3,3"], "(anchor 2)"),
        (["--slices", "1,2"], "--slices"),
        (["--out", "new.toml"], "--optimise"),
        (["--grid", "grid.xls"], ".csv or .geojson"),
        (["--step", "0.00001"], "points"),
        (["--mounts", "1,1,1,1"], "--mounts"),
        (["--plot", "plan.what"], "its ending should be one of .png, .svg, .pdf"),
        (["--plot", "missing/plan.png"], "a file in a folder that exists"),
        (["--html", "missing/plan.html", "--step", "1"], "cannot be written"),
    ],
)
def test_wrong_options_are_reported(lab, tmp_path, complaint, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    assert message in complaint("plan", lab, *options)


@pytest.mark.parametrize(
    ("option", "words"),
    [("--plot", "its ending should be one of"), ("--grid", "would destroy it"), ("--html", "would destroy it")],
)
def test_inputs_are_spared(lab, tmp_path, complaint, option, words):
    before = lab.read_text()
    assert words in complaint("plan", lab, option, lab)
    assert "would destroy it" in complaint("plan", lab, option, tmp_path / "floor.png")
    assert lab.read_text() == before
