"""The examples run as they stand, and print what they say."""

import json
import re
import runpy
import sys
from pathlib import Path

import matplotlib.image
import nbclient
import nbformat
import numpy as np
import pytest

from skyless.cli.main import main
from support import synthetic_recordings as synthetic

pytestmark = pytest.mark.site

EXAMPLES = Path(__file__).parents[2] / "examples"
IN_THE_TESTS = {
    "first_fix.py",
    "own_estimator.py",
    "own_radio.py",
    "replay_recording.py",
    "plan_a_hall.py",
    "compare_methods.py",
}


def printed(name, capsys, monkeypatch, *arguments):
    """What an example writes on standard output."""
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_first_fix(capsys, monkeypatch):
    x_m, y_m, z_m = map(
        float, re.search(r"\[ *(\S+) +(\S+) +(\S+) *\]", printed("first_fix.py", capsys, monkeypatch)).groups()
    )
    assert abs(x_m - 3.0) < 0.15
    assert abs(y_m - 4.0) < 0.15
    assert z_m == 0.0


def test_own_estimator(capsys, monkeypatch):
    """Its filter is half as far off as its least squares, which knows no motion."""
    by_name = dict(re.findall(r"(\w+): ([\d.]+) cm", printed("own_estimator.py", capsys, monkeypatch)))
    assert float(by_name["Filter"]) < 10.0
    assert float(by_name["LeastSquares"]) < 25.0


def test_own_estimator_on_a_recording(tmp_path, capsys):
    """By one line, as the documents have it; its filter is of the same class as the one of Skyless."""
    (tmp_path / "anchors.csv").write_text(synthetic.anchors_csv())
    (tmp_path / "tdoa.csv").write_bytes(b"".join(synthetic.tdoa_table(3000)))
    times_s = np.arange(0.0, 3000 * synthetic.PERIOD_S, 0.05)
    rows = "\n".join(",".join(map(str, (t_s, *synthetic.place_m(t_s)))) for t_s in times_s)
    (tmp_path / "truth.csv").write_text(f"t_s,x_m,y_m,z_m\n{rows}\n")
    told = []
    for more in ([], ["--estimator", f"{EXAMPLES / 'own_estimator.py'}:Filter"]):
        asked = [tmp_path / "tdoa.csv", "--anchors", tmp_path / "anchors.csv", "--truth", tmp_path / "truth.csv"]
        assert main([*map(str, ["replay", *asked, *more, "--json"])]) == 0
        told.append(json.loads(capsys.readouterr().out))
    assert [report["method"] for report in told] == ["joint", "Filter"]
    assert told[1]["rmse_3d_m"] < 3.0 * told[0]["rmse_3d_m"]


def test_own_radio(capsys, monkeypatch):
    x_m, y_m, std_cm = map(float, re.findall(r"[-\d.]+", printed("own_radio.py", capsys, monkeypatch)))
    assert abs(x_m - 2.0) < 0.15
    assert abs(y_m - 3.0) < 0.15
    assert 0.0 < std_cm < 10.0


def test_replay_recording(capsys, monkeypatch, tmp_path):
    out = printed("replay_recording.py", capsys, monkeypatch, tmp_path / "track.png")
    errors_cm = list(map(float, re.findall(r"[\d.]+", out.splitlines()[-1])))
    assert len(errors_cm) == 3
    assert max(errors_cm) < 40.0
    assert matplotlib.image.imread(tmp_path / "track.png").shape[0] > 100


@pytest.mark.statistical
def test_plan_a_hall(capsys, monkeypatch):
    now, better, anchors = printed("plan_a_hall.py", capsys, monkeypatch).splitlines()
    mean_cm, better_cm = (float(re.search(r"mean ([\d.]+) cm", line)[1]) for line in (now, better))
    assert better_cm < mean_cm
    assert anchors.count("(") == 8


@pytest.mark.statistical
def test_compare_methods(capsys, monkeypatch):
    _, *rows = printed("compare_methods.py", capsys, monkeypatch).splitlines()
    errors_cm = {name: float(at_rest) for name, at_rest, _ in map(str.split, rows)}
    assert list(errors_cm) == ["literal", "literal-delayed", "weighted", "bracketed", "joint"]
    assert errors_cm["joint"] == min(errors_cm.values())


@pytest.mark.statistical
def test_the_notebook_runs():
    notebook = nbformat.read(EXAMPLES / "notebook.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(EXAMPLES)}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert sum("text/html" in output.get("data", {}) for output in outputs) >= 3
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2


def test_the_list_of_examples_is_complete():
    listed = set(re.findall(r"\]\(([\w.]+)\)", (EXAMPLES / "README.md").read_text(encoding="utf-8")))
    files = {path.name for path in EXAMPLES.iterdir() if path.suffix in {".py", ".ipynb"}}
    assert listed == files == IN_THE_TESTS | {"notebook.ipynb"}
    for name in sorted(IN_THE_TESTS):
        assert (EXAMPLES / name).read_text(encoding="utf-8").startswith('"""'), name
