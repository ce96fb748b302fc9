"""``benchmarks/recorded_flights.py``: its sums against the command's own table of fixes, and its plain filter."""

import csv
import gzip
import importlib
import json

import numpy as np
import pytest

import synthetic_recordings as synthetic
from skyless.cli.main import main

pytestmark = pytest.mark.statistical

ROWS = 4000
SETTLE_S = 3.0
ARM_M = (-0.01245, 0.00127, 0.0908)


@pytest.fixture
def bench():
    return importlib.import_module("recorded_flights")


@pytest.fixture
def folder(tmp_path):
    """Two flights of one constellation, laid out as the recordings are; the truth is the body's, an arm away."""
    times_s = np.arange(0.0, ROWS * synthetic.PERIOD_S + 0.1, 0.02)
    poses = (",".join(f"{value:.6f}" for value in (t, *np.subtract(synthetic.place_m(t), ARM_M))) for t in times_s)
    truth = "\n".join(["t_s,x_m,y_m,z_m", *poses]) + "\n"
    place = tmp_path / "util_flights" / "const1"
    place.mkdir(parents=True)
    (place.parent / "anchors_const1.csv").write_text(synthetic.anchors_csv())
    for trial in (1, 2):
        name = f"const1-trial{trial}-tdoa2"
        (place / f"{name}_tdoa.csv.gz").write_bytes(gzip.compress(b"".join(synthetic.tdoa_table(ROWS, seed=trial))))
        (place / f"{name}_pose.csv.gz").write_bytes(gzip.compress(truth.encode()))
    return tmp_path


def told_by(bench, capsys, *arguments):
    bench.main([*map(str, arguments), "--json"])
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def replayed(folder, tmp_path, capsys):
    """The first flight by ``skyless replay``: its report, errors and covariances of the fixes."""
    flight = folder / "util_flights" / "const1" / "const1-trial1-tdoa2"
    fixes = tmp_path / "fixes.csv"
    options = ["--anchors", folder / "util_flights" / "anchors_const1.csv", "--truth", f"{flight}_pose.csv.gz"]
    arguments = [
        "replay",
        f"{flight}_tdoa.csv.gz",
        *options,
        "--lever-arm=-0.01245,0.00127,0.0908",
        "--fixes-csv",
        fixes,
    ]
    assert main([*map(str, arguments), "--json"]) == 0
    with fixes.open() as file:
        rows = [row for row in csv.DictReader(file) if float(row["t_s"]) >= SETTLE_S]
    report = json.loads(capsys.readouterr().out)
    errors_m, covariances_m2 = [], []
    for row in rows:
        place_m = [float(row[f"{axis}_m"]) for axis in "xyz"]
        errors_m.append(np.subtract(place_m, synthetic.place_m(float(row["t_s"]))))
        upper = [float(row[f"cov_{name}_m2"]) for name in ("xx", "xy", "xz", "yy", "yz", "zz")]
        covariances_m2.append(np.array(upper)[[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3))
    return report, np.array(errors_m), np.array(covariances_m2)


@pytest.mark.statistical
def test_sums_are_those_of_the_command(bench, folder, tmp_path, capsys):
    first, second = told_by(bench, capsys, folder)["default"]["recordings"]
    report, error_m, covariance_m2 = replayed(folder, tmp_path, capsys)
    found = first["score"]
    assert (first["name"], second["name"]) == ("const1-trial1-tdoa2", "const1-trial2-tdoa2")
    assert found["rmse_2d_m"] == pytest.approx(report["rmse_2d_m"], rel=1e-9)
    assert found["rmse_3d_m"] == pytest.approx(report["rmse_3d_m"], rel=1e-9)
    assert found["fixes"] == len(error_m)
    judged = ROWS - round(SETTLE_S / synthetic.PERIOD_S)
    assert first["available"] == pytest.approx(found["fixes"] / judged)
    nees = np.einsum("ni,nij,nj->n", error_m, np.linalg.inv(covariance_m2), error_m)
    assert found["nees_per_dof"] == pytest.approx(nees.mean() / 3.0, rel=0.01)
    assert found["rmse_3d_m"] == pytest.approx(np.sqrt((error_m**2).sum(axis=1).mean()), rel=0.01)
    assert first["ratio_3d"] == pytest.approx(found["rmse_3d_m"] / first["plain_3d_m"])
    assert 0.0 < first["plain_3d_m"] < 0.1


def test_summary_and_calibration(bench, folder, capsys):
    told = told_by(bench, capsys, folder, "--calibrated")
    rows, total = told["default"]["recordings"], told["default"]["all"]
    ratios = [row["ratio_2d"] for row in rows]
    assert total["recordings"] == 2
    assert total["ratio_2d_geometric_mean"] == pytest.approx((ratios[0] * ratios[1]) ** 0.5)
    assert total["ratio_2d_above_1.10"] == sum(ratio > 1.1 for ratio in ratios)
    assert total["nees_max"] == max(row["score"]["nees_per_dof"] for row in rows)
    assert total == told["default"]["flights"]
    assert [row["name"] for row in told["calibrated"]["recordings"]] == ["const1-trial2-tdoa2"]


def test_a_score_by_hand(bench):
    """Five fixes, 0.04 s apart, of σ 0.1 m per axis: three within, one beyond its level, one far off."""
    times_s = 0.04 * np.arange(5)
    error_m = np.array([[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1], [0.3, 0.4, 0], [0, 0, 2.0]])
    covariance_m2 = np.tile(0.01 * np.eye(3), (5, 1, 1))
    levels_m = np.array([[0.2, 0.2], [np.nan, np.nan], [0.2, 0.2], [0.4, 0.4], [3.0, 1.0]])
    alerted = np.array([False, False, False, False, True])
    here = np.full(5, True)
    found = bench.score(times_s, error_m, covariance_m2, levels_m, alerted, here)
    assert found.rmse_2d_m == pytest.approx(np.sqrt((0.01 + 0.01 + 0.25) / 5))
    assert found.rmse_3d_m == pytest.approx(np.sqrt((0.03 + 0.25 + 4.0) / 5))
    assert found.nees_per_dof == pytest.approx((1 + 1 + 1 + 25 + 400) / 15)
    assert (found.beyond, found.beyond_max_m) == (0.4, 2.0)
    assert (found.levels, found.exceeded_horizontal, found.exceeded_vertical, found.exceeded_unalerted) == (4, 1, 1, 1)
    assert found.blunders_s == 0.0  # the last fix counts for no time
    assert bench.score(
        times_s + 1.0, error_m[::-1], covariance_m2, levels_m, alerted, here
    ).blunders_s == pytest.approx(0.04)
    flat = bench.score(times_s, error_m[:, :2], covariance_m2, levels_m, alerted, here)
    assert flat.nees_per_dof == pytest.approx((1 + 1 + 0 + 25 + 0) / 10)
    assert (flat.rmse_3d_m, flat.exceeded_horizontal, flat.exceeded_vertical) == (None, 1, 0)
    silent = bench.score(times_s, error_m, np.full((5, 3, 3), np.nan), np.full((5, 2), np.nan), alerted, here)
    assert (silent.nees_per_dof, silent.beyond, silent.levels, silent.blunders_s) == (None, None, 0, 0.0)


def test_the_compiled_plain_filter_is_the_one_in_numpy(bench, monkeypatch):
    compiled = importlib.import_module("plain_flight_filter")
    rows = list(synthetic.tdoa_rows(500))
    start_m = np.array(synthetic.place_m(0.0)) + 0.1
    numpy_filter = importlib.import_module("plain_filter").PlainFilter(start_m, compiled.QA)
    numpy_filter.P = np.diag(np.repeat([compiled.START_STD_M**2, compiled.START_STD_MPS**2], 3))
    a_m, b_m = (np.array([synthetic.ANCHORS_M[row[side]] for row in rows]) for side in (1, 2))
    t_s, tdoa_m = (np.array([row[column] for row in rows]) for column in (0, 3))
    tdoa_m[100] += 5.0
    positions_m, used = compiled.plain_positions(t_s, a_m, b_m, tdoa_m, start_m, np.zeros(3))
    dts_s = np.diff(t_s, prepend=t_s[0])
    taken = [numpy_filter.hear(*one) for one in zip(a_m, b_m, dts_s, tdoa_m, strict=True)]
    assert used == sum(taken) < len(rows)
    np.testing.assert_allclose(positions_m[-1], numpy_filter.x[:3], rtol=1e-9)


def test_nodes_are_placed_by_their_distances(bench):
    places_m = np.array([[0.0, 0, 0], [5, 0, 1], [5, 6, 0], [0, 6, 2]])
    distances_m = {(a, b): float(np.linalg.norm(places_m[a] - places_m[b])) for a in range(4) for b in range(a + 1, 4)}
    found = bench.placed(distances_m)
    assert {pair: np.linalg.norm(np.subtract(found[pair[0]], found[pair[1]])) for pair in distances_m} == pytest.approx(
        distances_m
    )


@pytest.mark.statistical
def test_real_flights(bench, recordings, capsys):
    """DATA.md: a plain filter of this kind comes to 0.031 to 0.044 m in 2-D and 0.10 to 0.12 m in 3-D."""
    told = told_by(bench, capsys, recordings, "--only", "const1-trial1-tdoa2")
    (row,) = told["default"]["recordings"]
    assert 0.031 < row["plain_2d_m"] < 0.044
    assert 0.095 < row["plain_3d_m"] < 0.12
    assert row["available"] > 0.99
    assert row["score"]["rmse_2d_m"] < 0.03


def test_without_recordings_it_says_what_to_do(bench, tmp_path, capsys):
    with pytest.raises(SystemExit):
        bench.main([str(tmp_path)])
    assert "SKYLESS_DATA" in capsys.readouterr().err
