"""``skyless benchmark``: its figures against NumPy alone and the table of fixes, and that it continues."""

import csv
import gzip
import json

import numpy as np
import pytest

from skyless.cli.main import main
from skyless.research import benchmark
from skyless.research.benchmark import BITCRAZE, GATE, plain_track, recordings_below
from support import synthetic_recordings as synthetic

pytestmark = pytest.mark.statistical

ROWS, SETTLE_S = 4000, 3.0
ARM_M = (-0.01245, 0.00127, 0.0908)
ARM = "--lever-arm=" + ",".join(map(str, ARM_M))
ESTIMATOR = """
import skyless

class Middle:
    def hear(self, one):
        return skyless.Fix.of(one.time_s, [(a + b) / 2 for a, b in zip(one.a_m, one.b_m)])
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two flights of one constellation, laid out as the recordings are; the truth is the body's, an arm away."""
    folder = tmp_path_factory.mktemp("recordings")
    times_s = np.arange(0.0, ROWS * synthetic.PERIOD_S + 0.1, 0.02)
    poses = (",".join(f"{value:.6f}" for value in (t, *np.subtract(synthetic.place_m(t), ARM_M))) for t in times_s)
    truth = "\n".join(["t_s,x_m,y_m,z_m", *poses]) + "\n"
    place = folder / "flights" / "const1"
    place.mkdir(parents=True)
    (place.parent / "anchors_const1.csv").write_text(synthetic.anchors_csv())
    (place.parent / "anchors_const2.csv").write_text(synthetic.anchors_csv())
    (place / "README.txt").write_text("nothing to replay\n" * 50)
    for trial in (1, 2):
        name = f"trial{trial}"
        (place / f"{name}_tdoa.csv.gz").write_bytes(gzip.compress(b"".join(synthetic.tdoa_table(ROWS, seed=trial))))
        (place / f"{name}_pose.csv.gz").write_bytes(gzip.compress(truth.encode()))
    return folder


def test_recordings_are_found_with_what_belongs_to_them(folder):
    found = list(recordings_below(folder))
    assert [one.name for one in found] == ["flights/const1/trial1_tdoa", "flights/const1/trial2_tdoa"]
    for one in found:
        assert (one.format, one.anchors.name) == ("tdoa-table", "anchors_const1.csv")
        assert one.truth.name == one.path.name.replace("_tdoa", "_pose")


def test_figures_are_those_of_the_fixes(folder, tmp_path, capsys):
    """RMSE, percentiles and NEES of joint, from the CSV of fixes of ``skyless replay`` by NumPy, to a millimetre."""
    (tmp_path / "own.py").write_text(ESTIMATOR)
    out = tmp_path / "out"
    options = [ARM, "--out", str(out), "--calibrate-on", "trial1", "--estimator", f"{tmp_path / 'own.py'}:Middle"]
    assert main(["benchmark", str(folder), *options, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    simple = ["gate", "gradient", "least-squares"]
    methods = ["joint", "joint-smoothed", *simple, "bitcraze", "Middle", "joint-calibrated", "best simple"]
    assert sorted(row["method"] for row in told["methods"]) == sorted(methods)
    page = (out / "index.html").read_text()
    assert "Stanford" in page
    assert "by others" not in page
    with (out / "results.csv").open() as file:
        rows = {(row["recording"], row["method"]): row for row in csv.DictReader(file)}
    errors_m = {key: float(row["rmse_3d_m"]) for key, row in rows.items()}
    for trial in ("flights/const1/trial1_tdoa", "flights/const1/trial2_tdoa"):
        assert errors_m[trial, "best simple"] == min(errors_m[trial, method] for method in simple)
        assert max(errors_m[trial, method] for method in simple) < 0.5
    flight = folder / "flights" / "const1" / "trial1"
    fixes = tmp_path / "fixes.csv"
    given = ["--anchors", folder / "flights" / "anchors_const1.csv", "--truth", f"{flight}_pose.csv.gz", ARM]
    assert main([*map(str, ["replay", f"{flight}_tdoa.csv.gz", *given, "--fixes-csv", fixes]), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    columns = np.genfromtxt(fixes, delimiter=",", skip_header=1, usecols=range(13))
    times_s, position_m = columns[:, 0], columns[:, 1:4]
    truth = np.genfromtxt(f"{flight}_pose.csv.gz", delimiter=",", skip_header=1)
    true_m = np.column_stack([np.interp(times_s, truth[:, 0], axis) for axis in truth[:, 1:4].T]) + ARM_M
    begin_s = np.genfromtxt(f"{flight}_tdoa.csv.gz", delimiter=",", skip_header=1, max_rows=1)[0]
    here = (times_s - begin_s >= SETTLE_S) & (times_s <= truth[-1, 0])
    errors_m = (position_m - true_m)[here]
    figures = list(rows["flights/const1/trial1_tdoa", "joint"].items())[3:]
    joint = {name: float(value) for name, value in figures if value}
    for of in (2, 3):
        lengths_m = np.sqrt((errors_m[:, :of] ** 2).sum(axis=1))
        assert joint[f"rmse_{of}d_m"] == pytest.approx(np.sqrt((lengths_m**2).mean()), abs=1e-3)
        assert joint[f"p95_{of}d_m"] == pytest.approx(np.percentile(lengths_m, 95), abs=1e-3)
        assert joint[f"max_{of}d_m"] == pytest.approx(lengths_m.max(), abs=1e-3)
    covariance_m2 = columns[here][:, [7, 8, 9, 8, 10, 11, 9, 11, 12]].reshape(-1, 3, 3)
    nees = np.einsum("ni,nij,nj->n", errors_m, np.linalg.inv(covariance_m2), errors_m)
    assert joint["nees"] == pytest.approx(nees.mean() / 3.0, rel=1e-3)
    assert int(joint["judged"]) == here.sum() == report["judged"]
    assert joint["rmse_3d_m"] == report["rmse_3d_m"]


def test_what_exists_is_not_computed_again(folder, tmp_path, monkeypatch):
    asked = ["benchmark", str(folder), ARM, "--out", str(tmp_path), "--only", "trial2", "--only-first", "6"]
    assert main(asked) == 0
    before = (tmp_path / "results.json").read_bytes()
    (gone, *kept) = sorted((tmp_path / "results").glob("*.json"))
    states = [one.stat().st_mtime_ns for one in kept]
    gone.unlink()  # as where the run before was interrupted
    assert main(asked) == 0
    assert gone.exists()
    assert [one.stat().st_mtime_ns for one in kept] == states
    assert (tmp_path / "results.json").read_bytes() == before
    kept[0].write_bytes(b"damaged")
    assert main(asked) == 0
    assert (tmp_path / "results.json").read_bytes() == before
    monkeypatch.setattr(benchmark, "_results", lambda *_: pytest.fail("computed again"))
    assert main(asked) == 0


def test_a_folder_without_recordings_is_named(tmp_path, complaint):
    assert "it should hold recordings that skyless replay can read" in complaint(
        "benchmark", tmp_path, "--out", tmp_path / "out"
    )


def test_results_that_cannot_be_written_are_one_line(folder, tmp_path, capsys):
    (tmp_path / "results").mkdir()
    (tmp_path / "index.html").mkdir()
    assert main(["benchmark", str(folder), "--out", str(tmp_path), "--only", "trial2", "--only-first", "4"]) == 2
    err = capsys.readouterr().err
    assert (err.count("\n"), "cannot be written" in err) == (1, True)


@pytest.mark.parametrize("is_planar", [False, True])
def test_the_plain_filter_is_the_textbooks(is_planar):
    """Against the equations in NumPy, and Bitcraze's rule where nothing is refused against the gate where none is."""
    random, count = np.random.default_rng(2), 300
    anchors_m = random.uniform(0.0, 8.0, (6, 3))
    pairs = np.array([random.choice(6, 2, replace=False) for _ in range(count)])
    a_m, b_m, place_m = anchors_m[pairs[:, 0]], anchors_m[pairs[:, 1]], np.array([4.0, 3.0, 1.0])
    tdoa_m = np.linalg.norm(place_m - b_m, axis=1) - np.linalg.norm(place_m - a_m, axis=1)
    tdoa_m += random.normal(0.0, 0.05, count)
    time_s, start = np.arange(count) * 0.01, np.append(place_m, np.zeros(3))
    found_m, covariance_m2 = plain_track(GATE, time_s, tdoa_m, a_m, b_m, start, is_planar)
    x, P = start.copy(), np.diag([0.01] * 6)
    axes = np.array([1.0, 1.0, 0.0 if is_planar else 1.0] * 2)
    P = P * axes
    for n in range(count):
        dt = 0.01 if n else 0.0
        F = np.eye(6) + dt * np.eye(6, k=3)
        Q = 2.0 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.diag(axes[:3]))
        x, P = F @ x, F @ P @ F.T + Q
        to_a, to_b = x[:3] - a_m[n], x[:3] - b_m[n]
        H = np.append(to_b / np.linalg.norm(to_b) - to_a / np.linalg.norm(to_a), np.zeros(3))
        K = P @ H / (H @ P @ H + 0.22**2)
        x = x + K * (tdoa_m[n] - (np.linalg.norm(to_b) - np.linalg.norm(to_a)))
        P = (np.eye(6) - np.outer(K, H)) @ P
        assert found_m[n] == pytest.approx(x[:3], abs=1e-9)
        assert covariance_m2[n] == pytest.approx(P[:3, :3], abs=1e-9)
    tdoa_m[150] += 3.0  # one outlier, which both refuse once they are closed
    for rule in (GATE, BITCRAZE):
        again_m, _ = plain_track(rule, time_s, tdoa_m, a_m, b_m, start, is_planar)
        assert again_m[150] == pytest.approx(again_m[149], abs=0.01)
