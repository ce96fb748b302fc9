"""The commands of docs/survey.md: those on tables of ranges run as they stand there."""

import re
from pathlib import Path

import numpy as np
import pytest

from skyless.cli.main import main, program
from skyless.core.site import AnchorSite, ScheduleSite, Site
from skyless.site.file.load import load_site
from skyless.site.file.template import site_template

DOCUMENT = Path(__file__).parents[2] / "docs" / "survey.md"
COMMANDS = [
    re.sub(r"\s+#.*", "", line).strip()
    for line in DOCUMENT.read_text(encoding="utf-8").splitlines()
    if line.startswith("    skyless ")
]


SETUP = DOCUMENT.with_name("setup.md")


def test_the_files_of_the_walk_without_radios_are_of_one_site(tmp_path, monkeypatch):
    """Else the page compares no fix with the truth, which the air publishes under its own number."""
    monkeypatch.chdir(tmp_path)
    walk = SETUP.read_text(encoding="utf-8").split("## Try it without radios")[1]
    files = re.findall(r"^    skyless (site new .*)$", walk, re.MULTILINE)
    for command in files:
        assert main(command.split()) == 0
    truth, fresh = (load_site(Path(command.split()[2])) for command in files)
    assert truth.id == fresh.id
    assert {anchor.id for anchor in truth.anchors} == {anchor.id for anchor in fresh.unplaced}
    at = {anchor.id: anchor for anchor in truth.anchors}
    height_m = float(re.search(r"are ([\d.]+) m high", walk)[1])
    assert {anchor.z_m for anchor in truth.anchors} == {height_m}
    origin, along, left = map(
        int, re.search(r"anchor (\d+) the\s+origin, (\d+) on the x axis and (\d+) on", walk).groups()
    )
    assert (at[origin].x_m, at[origin].y_m, at[along].y_m) == (0.0, 0.0, 0.0)
    assert at[left].y_m > 0.0


@pytest.fixture
def hall(tmp_path, monkeypatch):
    """The folder in which the commands run: twelve anchors on a grid of 12 m, as tables and as a site file."""
    monkeypatch.chdir(tmp_path)
    draw = np.random.default_rng(3)
    x_m, y_m = np.meshgrid([0.0, 12.0, 24.0, 36.0], [0.0, 12.0, 24.0])
    at_m = np.column_stack([x_m.ravel(), y_m.ravel(), np.full(12, 6.0)]) + draw.uniform(-0.3, 0.3, (12, 3))
    rows = [
        f"{a + 1},{b + 1},{np.linalg.norm(at_m[a] - at_m[b]) + draw.normal(0.0, 0.02):.3f}"
        for a in range(12)
        for b in range(a)
        for _ in range(5)
    ]
    Path("ranges.csv").write_text("\n".join(["anchor_a,anchor_b,range_m", *rows, ""]))
    Path("heights.csv").write_text("id,z_m\n" + "".join(f"{k + 1},{at_m[k, 2]:.2f}\n" for k in range(12)))
    anchors = tuple(AnchorSite(k + 1, *np.round(at_m[k], 2).tolist()) for k in range(12))
    site = Site("hall", 3, 1, anchors, ScheduleSite(mode="free"))
    Path("site.toml").write_text(site_template(site))


def test_there_are_commands():
    assert sum("ranges.csv" in command for command in COMMANDS) >= 6


@pytest.mark.site
@pytest.mark.parametrize("command", [command for command in COMMANDS if "ranges.csv" in command])
def test_a_command_on_tables_runs(hall, capsys, command):
    assert main(command.split()[1:]) == 0
    assert all(line.startswith("wrote ") for line in capsys.readouterr().err.splitlines())


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_has_the_options_that_it_names(command):
    program().parse_args(command.split()[1:], print_error=False, exit_on_error=False)
