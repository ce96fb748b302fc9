"""``skyless.simulate``, ``replay``, ``plan``, ``survey_site``, ``study``: the commands' figures, arrays, tables."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from msgspec.structs import replace

import skyless
from skyless.cli.common import to_json
from skyless.cli.main import main
from skyless.core.air.site_pages import MAX_COORDINATE_M
from skyless.core.site import AccuracySite
from skyless.research.calibration.options import Stay
from skyless.research.studies import lab
from skyless.research.studies.room import CONDITIONS
from skyless.research.studies.runner import MEASURED
from skyless.sim.impairments import AnchorBias
from skyless.sim.lab import paper_lab_site
from skyless.site.file.load import load_site
from skyless.site.file.template import grid_site, site_template
from skyless.site.planning.links import PLAN_COLUMNS
from support import live_site
from support import synthetic_recordings as synthetic

pytestmark = pytest.mark.statistical

MEASURED_TIMES = {"skyless_version", "wall_s", "speed", "receptions_per_s", *MEASURED}
ROWS = 600
LAB = paper_lab_site(accuracy=AccuracySite())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Recordings of a made-up room and of the lab with a resting tag, tables, site files."""
    folder = tmp_path_factory.mktemp("functions")
    (folder / "anchors.csv").write_text(synthetic.anchors_csv())
    (folder / "truth.csv").write_text(synthetic.truth_csv(ROWS * 0.002 + 1.0))
    (folder / "lab.toml").write_text(site_template(LAB))
    synthetic.write(folder / "tdoa-table", "tdoa-table", ROWS)
    live_site.record(folder / "stay.mcap", live_site.messages(3.0, join_s=0.0))
    return folder


@pytest.fixture(scope="module", autouse=True)
def short_study():
    """Of the conditions ``motion`` two cases only."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(CONDITIONS, "motion", lambda plan: lab.motion_cases(plan)[:2])
        yield


@pytest.fixture(scope="module")
def results(folder):
    """A small result of each function."""
    anchors, truth = folder / "anchors.csv", folder / "truth.csv"
    return SimpleNamespace(
        simulate=skyless.simulate(tags=2, duration_s=3.0, method="weighted", seed=7),
        replay=skyless.replay(folder / "tdoa-table", anchors=anchors, truth=truth, settle_s=0.5),
        recorded=skyless.replay(folder / "stay.mcap"),
        plan=skyless.plan(folder / "lab.toml", step_m=1.0, target_m=0.1),
        biases=skyless.calibrate(folder / "tdoa-table", anchors=anchors, truth=truth),
        delays=skyless.calibrate(folder / "stay.mcap", site=folder / "lab.toml", stays=((3.0, 4.0),)),
        study=skyless.study(
            "room", conditions="motion", quick=True, method="weighted", worlds=2, seconds=1.0, processes=1
        ),
    )


COMMANDS = {
    "simulate": "simulate --tags 2 --duration 3 --method weighted --seed 7",
    "replay": "replay tdoa-table --anchors anchors.csv --truth truth.csv --settle 0.5",
    "recorded": "replay stay.mcap",
    "plan": "plan lab.toml --step 1 --target 10",
    "biases": "calibrate tdoa-table --anchors anchors.csv --truth truth.csv",
    "delays": "calibrate stay.mcap --site lab.toml --at 3,4",
    "study": "study room --conditions motion --quick --method weighted --worlds 2 --seconds 1 --processes 1",
}
"""What each result is compared with."""


def repeatable(value):
    """A tree without what is measured and different each time."""
    if isinstance(value, dict):
        return {
            key: repeatable(one) for key, one in value.items() if key not in MEASURED_TIMES | {"written", "unchanged"}
        }
    return [repeatable(one) for one in value] if isinstance(value, list) else value


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.statistical
def test_a_function_gives_the_figures_of_its_command(results, name, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main([*COMMANDS[name].split(), "--json"]) in {None, 0}
    shown = json.loads(capsys.readouterr().out.splitlines()[-1])
    ours = json.loads(to_json(getattr(results, name).summary))
    assert repeatable(ours) == repeatable(shown)


def test_functions_print_nothing_and_report_progress(folder, capsys):
    shares = {"simulate": [], "replay": [], "plan": []}
    skyless.simulate(duration_s=2.5, method="weighted", progress=shares["simulate"].append)
    skyless.replay(folder / "tdoa-table", anchors=folder / "anchors.csv", progress=shares["replay"].append)
    skyless.plan(LAB, step_m=1.0, progress=shares["plan"].append)
    assert capsys.readouterr() == ("", "")
    for name, reached in shares.items():
        assert reached == sorted(reached), name
        assert reached[-1] == pytest.approx(1.0), name
        assert reached[0] >= 0.0, name


# Arrays


def test_fixes_of_a_simulation(results):
    result = results.simulate
    fixes, count = result.fixes, len(result.fixes)
    assert result.tags == ("tag1", "tag2")
    assert set(fixes.tag) == {0, 1}
    assert (
        fixes.position_m.shape == fixes.truth_m.shape == fixes.error_m.shape == fixes.velocity_mps.shape == (count, 3)
    )
    assert fixes.covariance_m2.shape == (count, 3, 3)
    assert len(fixes.alert) == count
    assert fixes.judged.sum() == result.report.fixes
    errors_m = np.linalg.norm(fixes.error_m[fixes.judged], axis=1)
    assert np.sqrt(np.mean(errors_m**2)) == pytest.approx(result.report.rmse_m)
    assert errors_m.max() == pytest.approx(result.report.max_m)
    with pytest.raises(ValueError, match="read-only"):
        fixes.position_m[0] = 0.0


def test_fixes_of_replays(results):
    for result in (results.replay, results.recorded):
        (report,) = result.reports.values()
        fixes = result.fixes
        assert len(fixes) == report.fixes
        assert result.tags == tuple(result.reports)
        assert result.report is report
        with pytest.raises(skyless.SkylessError, match="has 2 tags"):
            _ = replace(result, reports={"a": report, "b": report}).report
        errors_m = np.linalg.norm(fixes.error_m[fixes.judged, :2], axis=1)
        assert np.sqrt(np.mean(errors_m**2)) == pytest.approx(report.rmse_2d_m)
    assert np.isfinite(results.recorded.fixes.hpl_m).any()


def test_measurements_of_a_replay_are_what_the_estimator_was_given(results, folder):
    told, table = results.replay.measurements, results.replay.measurements.to_dataframe()
    assert len(told) == len(table) == results.replay.reports["tag"].receptions == ROWS
    recorded = list(skyless.open_recording(folder / "tdoa-table"))
    for name in ("time_s", "anchor_a", "anchor_b", "tdoa_m"):
        np.testing.assert_array_equal(getattr(told, name), [getattr(pair, name) for pair in recorded])
    assert told.used.sum() == len(results.replay.fixes)
    assert (told.rx_ticks == -1).all()
    with pytest.raises(ValueError, match="read-only"):
        told.tdoa_m[0] = 0.0


def test_measurements_of_packets_and_beacons(results, folder):
    synthetic.write(folder / "bitcraze-text", "bitcraze-text", 200)
    result = skyless.replay(folder / "bitcraze-text", anchors=synthetic.ANCHORS_M)
    told, recorded = result.measurements, list(skyless.open_recording(folder / "bitcraze-text"))
    for ours, theirs in {"anchor_b": "anchor", "sequence": "sequence", "tx_ticks": "tx_ticks"}.items():
        np.testing.assert_array_equal(getattr(told, ours), [getattr(packet, theirs) for packet in recorded])
    assert np.isin(result.fixes.time_s, told.time_s[told.used]).all()
    beacons = results.recorded.measurements
    assert beacons.used.sum() == len(results.recorded.fixes)
    assert np.isin(results.recorded.fixes.time_s, beacons.time_s).all()


class EverySecond:
    """An estimator that makes a fix of every second difference."""

    def __init__(self):
        self.count = 0

    def hear(self, observation):
        self.count += 1
        return skyless.Fix.of(observation.time_s, (1.0, 1.0, 1.0)) if self.count % 2 else None


@pytest.mark.parametrize("options", [{"smooth": True}, {"estimator": EverySecond}])
def test_measurements_of_other_estimators(folder, options):
    result = skyless.replay(folder / "tdoa-table", anchors=folder / "anchors.csv", **options)
    assert len(result.measurements) == ROWS
    assert result.measurements.used.sum() == len(result.fixes) > 0


def test_values_serve_as_well_as_files(results, folder):
    """Anchors as a mapping, truth as an array, a site as a value."""
    truth = np.loadtxt(folder / "truth.csv", delimiter=",", skiprows=1)
    again = skyless.replay(folder / "tdoa-table", anchors=synthetic.ANCHORS_M, truth=truth, settle_s=0.5)
    assert repeatable(again.summary) == repeatable(results.replay.summary)
    planned = skyless.plan(load_site(folder / "lab.toml"), step_m=1.0)
    np.testing.assert_array_equal(planned.sigma_m, results.plan.sigma_m)


def test_arrays_of_a_plan(results):
    plan = results.plan
    shape = (len(plan.heights_m), len(plan.y_m), len(plan.x_m))
    assert shape == (1, 8, 6)
    assert plan.sigma_m.shape == plan.rmse_m.shape == plan.anchors_in_view.shape == plan.column("hdop").shape == shape
    assert plan.sigma_m.mean() == pytest.approx(plan.summary["mean_sigma_m"])
    assert (plan.anchors_in_view == 6).all()


def test_an_optimised_plan_has_other_anchors():
    plan = skyless.plan(LAB, step_m=2.0, optimise=4, search_s=0.5, verify_points=1, verify_rounds=100)
    assert len(plan.site.anchors) == 4
    assert plan.summary["optimised"]["best"]["mean_sigma_m"] > 0.0
    assert plan.summary["verification"].points


def test_a_plan_of_beacons(tmp_path, capsys):
    site = grid_site(100.0, 90.0, 10.0, 4.0, 1.2)
    file = tmp_path / "grid.toml"
    file.write_text(site_template(site))
    plan = skyless.plan(file)
    assert main(["plan", str(file), "--json"]) in {None, 0}
    shown = json.loads(capsys.readouterr().out)
    ours = json.loads(to_json(plan.summary))
    assert {key for key in ours if ours[key] != shown[key]} <= {"wall_s", "warnings"}
    assert isinstance(plan, skyless.RatePlanResult)
    assert plan.beacons_per_s.shape == (len(plan.heights_m), len(plan.y_m), len(plan.x_m))
    assert list(plan.to_dataframe().columns) == ["x_m", "y_m", "z_m", "beacons_per_s"]
    assert len(plan.to_dataframe()) == plan.summary["points"]
    assert_labelled(plan.plot())
    assert "beacons/s" in plan._repr_html_()


def test_arrays_and_files_of_surveys(results, folder, tmp_path, capsys):
    found = results.biases
    assert found.anchors.tolist() == sorted(synthetic.ANCHORS_M)
    assert found.bias_m.shape == found.std_m.shape == (8,)
    assert abs(found.bias_m).max() < 0.1
    delays = results.delays
    assert np.isfinite(delays.delay_m).any()
    assert delays.anchors.tolist() == [1, 2, 3, 4, 5, 6]
    out = tmp_path / "out.csv"
    recording, table, truth = (str(folder / name) for name in ("tdoa-table", "anchors.csv", "truth.csv"))
    assert main(["calibrate", recording, "--anchors", table, "--truth", truth, "--out", str(out)]) in {None, 0}
    assert found.corrected_file() == out.read_text()
    assert "tx_antenna_delay_ticks" in delays.corrected_file()


def test_a_study_by_case(results):
    study = results.study
    assert study.rmse_m.shape == (len(study.cases),)
    assert study.rmse_m[0] == study.rows[0].rmse_m
    assert (study.column("fixes") == [row.fixes for row in study.rows]).all()


# Tables


def test_tables_of_fixes(results):
    table = results.simulate.to_dataframe()
    assert list(table.columns[:5]) == ["t_s", "tag", "x_m", "y_m", "z_m"]
    assert set(table["tag"]) == {"tag1", "tag2"}
    assert len(table) == len(results.simulate.fixes)
    numbers = table.drop(columns=["tag", "alert", "anchors", "judged"])
    assert all(kind == np.float64 for kind in numbers.dtypes)
    assert table["anchors"].dtype == np.int64
    assert table["judged"].dtype == np.bool_
    assert list(results.replay.to_dataframe().columns) == list(table.columns)
    np.testing.assert_array_equal(table["cov_xy_m2"], results.simulate.fixes.covariance_m2[:, 0, 1])
    np.testing.assert_allclose(table["std_m"] ** 2, table["cov_xx_m2"] + table["cov_yy_m2"] + table["cov_zz_m2"])


def test_tables_of_the_others(results):
    plan = results.plan.to_dataframe()
    assert tuple(plan.columns) == ("x_m", "y_m", "z_m", *PLAN_COLUMNS)
    assert len(plan) == results.plan.summary["points"]
    assert list(results.biases.to_dataframe().columns) == ["anchor", "bias_m", "std_m", "noise_m", "count"]
    assert {"id", "x_m", "delay_m", "delay_std_m"} <= set(results.delays.to_dataframe().columns)
    study = results.study.to_dataframe()
    assert study["case"].tolist() == list(results.study.cases)
    assert study["rmse_m"].dtype == np.float64
    assert isinstance(study, pd.DataFrame)


def test_without_pandas_a_table_says_what_to_install(results, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    for result in vars(results).values():
        with pytest.raises(skyless.SkylessError, match="pandas, which is not installed"):
            result.to_dataframe()


# Pictures and notebooks


def assert_labelled(figure):
    assert isinstance(figure, Figure)
    axes = [one for one in figure.axes if one.axison]
    assert axes
    for one in axes:
        labels = one.get_xlabel() + one.get_ylabel() + one.get_title()
        assert labels, "an axis without words"
    words = " ".join(one.get_xlabel() + " " + one.get_ylabel() for one in axes)
    assert any(unit in words for unit in ("in m", "in cm", "in s", "per second"))


@pytest.mark.parametrize("name", COMMANDS)
def test_pictures_have_labels_with_units(results, name):
    assert_labelled(getattr(results, name).plot())


def test_pictures_of_one_tag_and_of_one_map(results):
    assert "tag2" in results.simulate.plot("tag2").get_suptitle()
    assert "HDOP" in results.plan.plot("hdop").get_suptitle()
    for plot in (results.simulate.plot, results.replay.plot):
        with pytest.raises(skyless.SkylessError, match="tag is 'nobody'; it should be one of tag"):
            plot("nobody")
    with pytest.raises(skyless.SkylessError, match="column is 'colour'; it should be one of sigma_m"):
        results.plan.plot("colour")


@pytest.mark.parametrize("name", COMMANDS)
def test_a_notebook_shows_the_figures(results, name):
    result = getattr(results, name)
    html, line = result._repr_html_(), repr(result)
    assert html.startswith("<table>")
    assert html.count("<tr>") == html.count("</tr>") >= 2
    assert "cm" in html
    assert line.startswith(type(result).__name__)
    assert "\n" not in line
    assert len(line) < 2000


def test_a_notebook_shows_names_as_they_are():
    site = replace(LAB, name="<b>hall</b> & yard")
    result = skyless.simulate(site=site, duration_s=2.2, method="weighted")
    assert "&lt;b&gt;hall&lt;/b&gt; &amp; yard" in result._repr_html_()
    assert "<b>" not in result._repr_html_()


# Mistakes

SIMULATE = [
    ({"positions_m": ((3,),)}, r"positions_m\[0\] is \(3,\); it should be 2 or 3 finite numbers in metres"),
    ({"positions_m": ((3, float("nan")),)}, r"positions_m\[0\] is \(3, nan\); it should be"),
    ({"positions_m": (3, 4)}, r"positions_m\[0\] is 3; it should be"),
    ({"positions_m": 3}, "positions_m is 3; it should be points"),
    ({"positions_m": ((3, 2 * MAX_COORDINATE_M),)}, "at most 1e"),
    ({"positions_m": ((3, 4),), "tags": 2}, "positions_m is for tags that lie still"),
    ({"paths_m": (((1, 1),),)}, r"paths_m\[0\] is \(\(1, 1\),\); it should be two or more points"),
    ({"paths_m": (((1, 1), (1, 1)),)}, "0.01 m or more"),
    ({"paths_m": (((1, 1), (1, 2, 3)),)}, "all have a height, or none"),
    ({"paths_m": ((1, 2),)}, r"paths_m\[0\]\[0\] is 1; it should be"),
    ({"noise_ps": float("nan")}, "noise_ps is nan; it should be a number, above 0"),
    ({"noise_ps": -1}, "noise_ps is -1; it should be a number, above 0"),
    ({"method": "best"}, "method is 'best'; it should be one of literal"),
    ({"tags": 1.5}, "tags is 1.5; it should be a whole number, at least 1, at most 10000"),
    ({"loss": 1}, "loss is 1; it should be a number, at least 0, below 1"),
    ({"seed": -1}, "seed is -1; it should be a whole number, at least 0"),
    ({"fixes": "3"}, "fixes is '3'; it should be a whole number, at least 1"),
    ({"biases": ((1, 2),)}, r"biases\[0\] is \(1, 2\); it should be a skyless.sim.impairments.AnchorBias"),
    ({"biases": (AnchorBias(99, 1.0),)}, "99"),
    ({"site": "no.toml"}, "site is 'no.toml'; it should be a file"),
    ({"site": 3}, "site is 3; it should be a path to a file"),
    ({"site": replace(LAB, master=9)}, "site: master is 9; it should be"),
    ({"site": LAB, "scenario": "lab"}, "give either scenario or site"),
    ({"scenario": "moon"}, "scenario is 'moon'; it should be one of lab, room"),
    ({"scenario": "room", "speed_mps": 2.0}, "speed_mps is for tags that walk from point to point"),
    ({"duration_s": 1}, "settle_s is 2; it should be less than duration_s, which is 1"),
    ({"integrity_risk": 0.5}, "integrity_risk is 0.5; it should be a number, above 0, at most 0.1"),
    ({"method": "weighted", "alert_limit_m": 1.0}, "alert_limit_m is 1; it should be left out: weighted gives no"),
]


def test_a_request_that_cannot_be_simulated_is_refused_as_well():
    with pytest.raises(skyless.SkylessError, match=r"positions_m\[0\] is \(3,\)"):
        skyless.fleet_of(skyless.Request(LAB, positions_m=((3,),)))
    with pytest.raises(skyless.SkylessError, match="noise_ps is nan"):
        skyless.fleet_of(skyless.Request(LAB, noise_ps=float("nan")))


REPLAY = [
    ({"file": "none.csv"}, "file is .*none.csv'; it should be a file"),
    ({"anchors": "none.csv"}, "anchors is 'none.csv'; it should be a file"),
    ({"anchors": {1: (0, 0)}}, r"anchors\[1\] is \(0, 0\); it should be 3 finite numbers"),
    ({"anchors": {"a": (0, 0, 0)}}, "anchors is 'a'; it should be positions by identifiers"),
    ({"site": LAB}, "give either anchors or site"),
    ({"truth": [[0, 1, 2]]}, r"truth is an array of shape \(1, 3\); it should be an array of shape \(n, 4\)"),
    ({"truth": [[0, 1, 2, float("nan")]]}, "all finite"),
    ({"truth": [[900, 1, 2, 1], [901, 1, 2, 1]]}, "truth: column t_s is .900.000 to 901.000.; it should be in the"),
    ({"lever_arm_m": (1, 2)}, r"lever_arm_m is \(1, 2\); it should be 3 finite numbers"),
    ({"lever_arm_m": (1, 2, 3)}, "lever_arm_m is .*; it should be left out: it moves the truth, which truth must give"),
    ({"tag_height_m": "high"}, "tag_height_m is 'high'; it should be metres, truth, free or auto"),
    ({"tag_height_m": float("nan")}, "tag_height_m is nan"),
    ({"tag_height_m": "free", "tag_height_std_m": 0.1}, "tag_height_std_m is 0.1; it should be left out"),
    ({"measurements": "ranges"}, "measurements is 'ranges'; it should be one of"),
    ({"measurements": "packets"}, "measurements is 'packets'; it should be 'differences'"),
    ({"tag": "tag1"}, "tag is 'tag1'; it should be left out: it is for recordings of skyless record"),
    ({"format": "wav"}, "wav"),
]


PLAN = [
    ({"site": "no.toml"}, "site is 'no.toml'; it should be a file"),
    ({"noise_ps": float("nan")}, "noise_ps is nan"),
    ({"region_m": (1, 2, 3)}, r"region_m is \(1, 2, 3\); it should be 4 finite numbers"),
    ({"region_m": (3, 2, 1, 4)}, "x1,y1,x2,y2 with x1 < x2"),
    ({"region_m": (50, 50, 60, 60)}, "no map"),
    ({"outline_m": ((0, 0), (1, 1))}, "outline_m is .* three or more corners"),
    ({"outline_m": ((20, 20), (30, 20), (30, 30))}, "on the floor"),
    ({"tag_heights_m": (1.0,)}, "tag_heights_m is .* left out: this site's tags are all at 0 m"),
    ({"mounts_m": ((0, 0, 0, 0),)}, "with two different ends"),
    ({"optimise": 2}, "optimise is 2; it should be a whole number, at least 3, at most 60"),
    ({"step_m": 1e-9}, "no map"),
    ({"exponent": 2.0}, "exponent is 2; it should be left out: it is for sites of more than 60 anchors"),
    *(
        ({"site": grid_site(100.0, 90.0, 10.0, 4.0, 1.2), name: value}, f"{name} is .*; it should be left out: errors")
        for name, value in {"noise_ps": 50.0, "search_s": 3.0, "verify_rounds": 200, "seed": 2, "optimise": 4}.items()
    ),
]

CALIBRATE = [
    ({"stays": ((1,),)}, r"stays\[0\] is \(1,\); it should be 2 or 3 finite numbers"),
    ({"stays": ((1, 2),)}, "lacks its height"),
    ({"stays": (Stay(1.0, 2.0, 3.0, 5.0, 4.0),)}, r"stays\[0\].to_s is 4.0; it should be above from_s"),
    ({"stays": ((1, 2, 3),), "truth": [[0, 1, 2, 3]]}, "stays says where the antenna was"),
    ({"stays": ((1, 2, 3),), "first": "200%"}, "first is '200%'; it should be a number of differences"),
    ({}, "truth or stays should say where the tag was"),
    ({"stays": ((1, 2, 3),), "tag": "tag1"}, "tag is 'tag1'; it should be left out"),
]


SURVEY = [
    ({}, "one with stamps of anchors"),
    ({"recording": None}, "recording is missing"),
    ({"distances": ((1, 2, 3.0),)}, r"distances\[0\] is \(1, 2, 3.0\); it should be a skyless.site.survey.facts.Tape"),
    ({"points_m": {3: (1.0,)}}, r"points_m\[3\] is \(1.0,\); it should be 2 or 3 finite numbers"),
]


def test_a_lever_arm_without_a_truth_to_move_is_refused(folder, complaint):
    with pytest.raises(skyless.SkylessError, match=r"lever_arm_m is .*; it should be left out: it moves the truth"):
        skyless.calibrate(folder / "stay.mcap", recorded_truth=True, lever_arm_m=(0.0, 0.0, 0.1))
    assert "--lever-arm is (0.0, 0.0, 0.1); it should be left out" in complaint(
        "calibrate", folder / "stay.mcap", "--recorded-truth", "--lever-arm", "0,0,0.1"
    )


STUDY = [
    ({"name": "everything"}, "name is 'everything'; it should be one of efficiency"),
    ({"method": "best"}, "method is 'best'"),
    ({"episodes": 3}, "it is for the studies efficiency and integrity; room takes worlds and seconds"),
    ({"integrity_risk": 0.01}, "integrity_risk is 0.01; it should be left out: it is for the study integrity"),
    ({"worlds": 1}, "worlds is 1; it should be a whole number, at least 2"),
    ({"noise_ps": float("nan")}, "noise_ps is nan"),
]

MISTAKES = {
    skyless.simulate: SIMULATE,
    skyless.replay: REPLAY,
    skyless.plan: PLAN,
    skyless.calibrate: CALIBRATE,
    skyless.survey_site: SURVEY,
    skyless.study: STUDY,
}


@pytest.mark.parametrize(
    ("call", "arguments", "right"),
    [
        pytest.param(call, *one, id=f"{call.__name__} {sorted(one[0])}")
        for call, mistakes in MISTAKES.items()
        for one in mistakes
    ],
)
def test_mistakes_are_named(folder, call, arguments, right):
    """A wrong call raises one line of error that names Python's arguments, not the options of the command."""
    tables = {"file": folder / "tdoa-table", "anchors": synthetic.ANCHORS_M}
    usual = {
        skyless.replay: tables,
        skyless.plan: {"site": LAB},
        skyless.calibrate: tables,
        skyless.survey_site: {"recording": folder / "tdoa-table"},
        skyless.study: {"name": "room"},
    }
    with pytest.raises(skyless.SkylessError, match=right) as found:
        call(**usual.get(call, {}) | arguments)
    assert "\n" not in str(found.value)
    assert "--" not in str(found.value)
