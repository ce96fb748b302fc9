"""``skyless simulate`` as its user meets it."""

import csv
import json
import math
import re
from itertools import pairwise

import numpy as np
import pytest

from skyless.cli.main import main
from skyless.cli.nodes.options import check_live
from skyless.cli.simulate import FIXES_CSV_COLUMNS
from skyless.sim.lab import lab_site
from skyless.site.file.load import load_site

pytestmark = pytest.mark.site

C = 299_792_458.0
KEYS = {
    *("method", "tags", "messages", "fixes", "rmse_m", "p95_m", "max_m", "updates_per_s", "dropped"),
    *("simulated_s", "wall_s", "speed", "seed", "site"),
}


@pytest.fixture
def run(capsys, monkeypatch, tmp_path):
    """The command in an empty folder: exit code, standard output and standard error."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        return main(["simulate", *map(str, arguments)]), *capsys.readouterr()

    return call


def report(result):
    code, out, err = result
    assert (code, err, out.count("\n")) == (0, "", 1)
    told = json.loads(out)
    assert told.keys() >= KEYS
    return told


def test_a_run_tells_what_was_asked_of_it(run):
    asked = ["--scenario", "paper", "--noise-ps", "100", "--position", "3,4", "--duration", "8", "--seed", "3"]
    told = report(run(*asked, "--json"))
    assert (told["method"], told["tags"], told["site"], told["seed"]) == ("joint", 1, "lab", 3)
    assert told["simulated_s"] == 8.0
    assert told["messages"] == pytest.approx(8.0 * 400, rel=0.02)
    assert told["fixes"] == pytest.approx((8.0 - 2.0) / 0.015, abs=2)  # one a superframe after the warm-up
    assert told["updates_per_s"] == pytest.approx(400.0, rel=0.01)
    assert 0.0 < told["rmse_m"] < 0.03
    assert told["rmse_m"] < told["p95_m"] < told["max_m"]
    assert told["dropped"] == sum(told["drops"].values())


@pytest.mark.statistical
def test_protection_levels_are_told_and_hold_with_a_late_anchor(run, tmp_path):
    asked = ["--method", "joint", "--duration", "6", "--bias", "2:0.5", "--integrity-risk", "1e-3", "--json"]
    told = report(run(*asked, "--alert-limit-m", "0.2", "--fixes-csv", "fixes.csv"))
    levels = told["levels"]
    assert (levels["integrity_risk"], levels["misleading"]) == (1e-3, 0)
    assert levels["available"] > 0.95
    assert sum(levels["alerts"].values()) == told["fixes"]
    assert set(levels["alerts"]) <= {"none", "detected-excluded", "alert-limit-exceeded", "detected-not-excluded"}
    assert levels["alerts"].get("alert-limit-exceeded", 0) > 0
    with (tmp_path / "fixes.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert {row["integrity_risk"] for row in table} == {"0.001"}
    given = [row for row in table if row["hpl_m"] and abs(float(row["hpl_m"]) - 0.2) > 1e-3]  # the table is rounded
    assert len(given) > 500
    assert all((float(row["hpl_m"]) > 0.2) == (row["alert"] == "alert-limit-exceeded") for row in given)
    assert table[0]["alert"] == "unavailable"
    assert report(run("--method", "weighted", "--duration", "3", "--json"))["levels"] is None
    code, out, _ = run("--method", "joint", "--duration", "3")
    assert code == 0
    assert "stated risk 0.0001" in out


def test_the_same_seed_gives_the_same_run(run):
    arguments = ["--duration", "2.5", "--tags", "2", "--json"]
    first, again, other = (report(run(*arguments, "--seed", seed)) for seed in (5, 5, 6))
    for told in (first, again, other):
        for name in ("wall_s", "speed"):
            del told[name]
    assert first == again
    assert first["rmse_m"] != other["rmse_m"]


@pytest.mark.parametrize("method", ["literal", "literal-delayed", "weighted", "bracketed", "joint"])
def test_it_stops_at_the_wanted_number_of_fixes(run, method):
    told = report(run("--method", method, "--position", "3,4", "--fixes", "40", "--settle", "1", "--json"))
    assert told["method"] == method
    assert 40 <= told["fixes"] <= 40 + math.ceil(0.25 / 0.015)


def test_fixes_file_and_report_agree(run, tmp_path):
    told = report(run("--position", "3,4", "--duration", "3", "--settle", "0", "--fixes-csv", "fixes.csv", "--json"))
    with (tmp_path / "fixes.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert tuple(table[0]) == FIXES_CSV_COLUMNS
    assert len(table) == pytest.approx(told["updates_per_s"] * (3.0 - told["first_fix_s"]), abs=1)
    errors = [
        math.dist((float(r["x_m"]), float(r["y_m"])), (float(r["truth_x_m"]), float(r["truth_y_m"]))) for r in table
    ]
    assert max(errors) >= told["max_m"] - 1e-5  # the report judges one fix a superframe, of these
    assert {(row["truth_x_m"], row["truth_y_m"]) for row in table} == {("3", "4")}


def test_a_tag_walks_its_path_and_rests_at_its_end(run, tmp_path):
    path = ["--waypoints", "1,1;5,1;5,4", "--speed", "2", "--duration", "6", "--fixes-csv", "fixes.csv"]
    assert report(run(*path, "--position", "3,4", "--json"))["tags"] == 2
    with (tmp_path / "fixes.csv").open(newline="") as file:
        table = [row for row in csv.DictReader(file) if row["tag"] == "1"]
    truth = [(float(row["t_s"]), float(row["truth_x_m"]), float(row["truth_y_m"])) for row in table]
    # Corners, the start and the end among them, take 0.9 of the shorter leg's 1.5 s.
    assert {y for t, x, y in truth if t < 2.0} == {1.0}
    assert {(x, y) for t, x, y in truth if t > 3.5 + 1.35} == {(5.0, 4.0)}
    # Coordinates of the table are rounded to 10 µm, times to 1 µs.
    assert all(math.dist(a[1:], b[1:]) <= 2.0 * (b[0] - a[0]) + 1.3e-5 for a, b in pairwise(truth))


@pytest.mark.statistical
def test_faults_show_in_the_figures(run):
    base = ["--scenario", "paper", "--position", "3,4", "--duration", "6", "--noise-ps", "100", "--json"]
    clean = report(run(*base))
    assert report(run(*base, "--bias", "2:0.5", "--method", "literal"))["rmse_m"] > 3 * clean["rmse_m"]
    lossy = report(run(*base, "--loss", "0.3"))
    assert lossy["messages"] == pytest.approx(0.7 * clean["messages"], rel=0.1)
    silent = report(run(*base, "--outage", "3:2"))
    assert silent["messages"] == pytest.approx(clean["messages"] * (1 - 4 / 6 / 6), rel=0.02)


@pytest.mark.statistical
def test_the_room_is_the_lab_with_the_errors_of_rooms(run):
    """The same seed again gives the same room; paths may be given there, with their speed."""
    base = ["--method", "joint", "--tags", "3", "--duration", "5", "--json"]
    lab, room, again = (report(run("--scenario", name, *base)) for name in ("lab", "room", "room"))
    assert (lab["site"], room["site"], room["tags"]) == ("lab", "room", 3)
    assert room["rmse_m"] == again["rmse_m"] > 1.5 * lab["rmse_m"]
    walk = ["--waypoints", "1,1;5,1;5,7", "--speed", "2", "--duration", "3", "--json"]
    assert report(run("--scenario", "room", *walk))["tags"] == 1


@pytest.mark.statistical
def test_phases_of_the_carrier_make_errors_smaller(run):
    """Over eight seeds of a minute the lab's errors fall from 1.57 to 0.89 cm, the room's from 2.51 to 1.78 cm."""
    for scenario, ratio in (("lab", 0.75), ("room", 0.95)):
        base = ["--scenario", scenario, "--duration", "20", "--seed", "3", "--json"]
        without, phased = report(run(*base)), report(run(*base, "--carrier"))
        assert phased["messages"] == without["messages"]
        assert phased["rmse_m"] < ratio * without["rmse_m"]


@pytest.mark.parametrize("method", ["weighted", "joint"])
def test_deaf_tags_make_no_fix_and_find_themselves_again(run, tmp_path, method):
    base = ["--scenario", "paper", "--method", method, "--duration", "8", "--fixes-csv", "fixes.csv", "--json"]
    told = report(run(*base, "--silence", "3:4.5", "--silence", "5:5.5"))
    assert told["drops"]["radio-off"] == pytest.approx(2.0 * 400, abs=2)
    with (tmp_path / "fixes.csv").open(newline="") as file:
        times_s = [float(row["t_s"]) for row in csv.DictReader(file)]
    assert not any(3.0 <= time_s < 4.5 or 5.0 <= time_s < 5.5 for time_s in times_s)
    for lost_s, found_s in ((3.0, 4.5), (5.0, 5.5)):
        assert any(lost_s - 0.05 < time_s < lost_s for time_s in times_s)
        assert any(found_s <= time_s < found_s + 0.15 for time_s in times_s)
    assert told["max_m"] < 0.5


SITE_OFF = [argument for anchor in range(1, 7) for argument in ("--outage", f"{anchor}:3")]


@pytest.mark.parametrize(("fault", "end_s"), [(["--silence", "3"], 63), (SITE_OFF, 63), (["--silence", "3:70"], 70.5)])
@pytest.mark.statistical
def test_a_goal_that_cannot_be_reached_is_given_up(run, fault, end_s):
    told = report(run("--method", "literal", "--position", "3,4", "--fixes", "100", *fault, "--json"))
    assert told["simulated_s"] == pytest.approx(end_s, abs=0.5)
    assert (told["fixes"] < 100) == (end_s == 63)


def test_wrong_antenna_delays_bias_the_position_as_least_squares_says(run):
    """To first order (JᵀJ)⁻¹Jᵀ of what each difference is late: TX plus RX delay of its anchor, none for the master.

    The same seed without them has the same noise, which the difference of the two biases therefore has not.
    """
    late_m = np.array([0.0, 0.0, 0.2 + 0.1, 0.0, -0.25, 0.0]) * C * 1e-9
    away = np.array([3.0, 4.0]) - [(anchor.x_m, anchor.y_m) for anchor in lab_site().anchors]
    units = away / np.linalg.norm(away, axis=1)[:, None]
    expected_m = np.linalg.lstsq(units[1:] - units[0], late_m[1:], rcond=None)[0]
    base = ["--method", "literal", "--noise-ps", "100", "--position", "3,4", "--duration", "5", "--json"]
    wrong, right = report(run(*base, "--delay-error", "3:0.2:0.1", "--delay-error", "5:0:-0.25")), report(run(*base))
    assert wrong["fixes"] == right["fixes"]
    bias_m = np.subtract(wrong["bias_m"], right["bias_m"])[:2]
    assert np.linalg.norm(expected_m) > 0.03
    assert bias_m == pytest.approx(expected_m, abs=0.02 * np.linalg.norm(expected_m))


def test_a_table_for_people_has_no_control_characters(run):
    code, out, err = run("--duration", "3")
    assert (code, err) == (0, "")
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f]", out)
    for part in ("real time", "RMSE", "cm", "per second and tag"):
        assert part in out


OUT_OF_RANGE = [
    *("--integrity-risk 0", "--integrity-risk 1", "--alert-limit-m 0", "--position nan,1", "--position 1,2,3,4"),
    *("--duration -1", "--duration 0", "--duration inf", "--fixes 0", "--noise-ps inf", "--noise-ps nan"),
    *("--settle -1", "--tags 0", "--seed -1", "--loss 1", "--nlos nan"),
]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        *((words, words) for words in map(str.split, OUT_OF_RANGE)),
        (["--scenario", "moon"], ["--scenario", "moon", "one of lab, room"]),
        (["--scenario", "room", "--site", "lab.toml"], ["--scenario", "--site", "not both"]),
        (["--scenario", "room", "--speed", "2"], ["--speed", "--scenario room", "--waypoints"]),
        (["--scenario", "lab", "--site", "lab.toml"], ["--scenario", "--site", "not both"]),
        (["--alert-limit-m", "0.1", "--method", "weighted"], ["--alert-limit-m", "0.1", "weighted"]),
        (["--position", "1,2", "--tags", "5"], ["--position", "--tags", "either"]),
        (["--position", "1,2", "--speed", "2"], ["--position", "--speed", "either"]),
        (["--waypoints", "1,1;5,1", "--tags", "2"], ["--waypoints", "--tags", "either"]),
        (["--waypoints", "1,1"], ["--waypoints", "(1.0, 1.0)", "two or more points"]),
        (["--waypoints", "1,1;5"], ["--waypoints", "'5'", "2 or 3"]),
        (["--waypoints", "1,1;5,1,2"], ["--waypoints", "(5.0, 1.0, 2.0)", "all have a height, or none"]),
        (["--waypoints", "1,1;2e6,1"], ["--waypoints", "(2000000.0, 1.0)", "at most 1e+06"]),
        (["--waypoints", "1,1;5,1;5,1"], ["--waypoints", "(5.0, 1.0), (5.0, 1.0)", "0.01 m or more"]),
        (["--site", "missing.toml"], ["--site is 'missing.toml'", "a file"]),
        (["--site", "."], ["--site is '.'", "a file"]),
        (["--method", "magic"], ["method", "magic", "joint", "literal"]),
        (["--method", "tracker"], ["method", "tracker", "joint", "literal"]),
        (["--position", "3"], ["--position", "'3'", "2 or 3"]),
        (["--position", "north"], ["--position", "north", "2 or 3"]),
        (["--duration", "1"], ["--settle is 2", "--duration, which is 1", "no fix would be judged"]),
        (["--duration", "2", "--fixes", "5"], ["--settle is 2", "which is 2", "no fix would be judged"]),
        (["--settle", "60", "--duration", "60"], ["--settle is 60", "which is 60", "no fix would be judged"]),
        (["--noise-ps", "1e7"], ["--noise-ps", "10000000"]),
        (["--bias", "99:1"], ["99", "1, 2, 3, 4, 5, 6"]),
        (["--bias", "2"], ["--bias", "'2'", "2 or 3"]),
        (["--bias", "2.5:1"], ["--bias", "2.5:1", "whole number"]),
        (["--bias", "2:1:0"], ["--bias[0].burst_s is 0.0", "above 0"]),
        (["--outage", "99:1"], ["99", "1, 2, 3, 4, 5, 6"]),
        (["--outage", "2:3:1"], ["--outage", "from 3 s to 1 s", "the later one ends it"]),
        (["--outage", "2:-3"], ["--outage", "from -3 s", "from 0 s"]),
        (["--outage", "2:1e300"], ["--outage", "1e+300 s", "to 1e+08 s"]),
        (["--delay-error", "99:1:1"], ["99", "1, 2, 3, 4, 5, 6"]),
        (["--delay-error", "2:1"], ["--delay-error", "2:1", "3 numbers"]),
        (["--delay-error", "2.5:1:1"], ["--delay-error", "2.5:1:1", "whole number"]),
        (["--delay-error", "2:1:1e4"], ["--delay-error", "2:1:1e4", "within 1000 ns"]),
        (["--delay-error", "2:1:1", "--delay-error", "2:0:1"], ["--delay-error", "anchor 2", "once"]),
        (["--silence", "now"], ["--silence", "now", "1 or 2"]),
        (["--silence", "3:3"], ["--silence", "from 3 s to 3 s", "the later one ends it"]),
        (["--silence", "-1:3"], ["--silence", "from -1 s to 3 s"]),
        (["--silence", "1e300"], ["--silence", "1e+300 s", "to 1e+08 s"]),
        (["--speed", "1e300"], ["--speed", "1e+300"]),
        (["--fixes-csv", "no/fixes.csv"], ["no/fixes.csv", "cannot be written"]),
        (["--fixes-csv", "."], ["cannot be written"]),
    ],
)
def test_a_mistake_is_told_in_one_line(run, complaint, tmp_path, arguments, said):
    err = complaint("simulate", *arguments, *(["--duration", "3"] if "--duration" not in arguments else []))
    assert [part for part in said if part not in err] == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.statistical
def test_an_interrupted_run_keeps_what_it_has_written(interrupted):
    head, _ = interrupted("simulate", "--duration", "100000")
    assert tuple(head) == FIXES_CSV_COLUMNS


def protocol_2(tmp_path, anchors):
    file = tmp_path / "hall.toml"
    file.write_text('name = "hall"\nid = 1\n[schedule]\nmode = "free"\n[tags]\nheight_m = 1.0\n' + anchors)
    return file


CORNERS = "".join(
    f"[[anchors]]\nid = {k}\nx_m = {x}\ny_m = {y}\n" for k, (x, y) in enumerate(((0, 0), (9, 0), (0, 9), (9, 9)))
)


def test_methods_that_need_a_master_are_refused_where_there_is_none(complaint, tmp_path):
    command = ("simulate", "--site", protocol_2(tmp_path, CORNERS), "--method", "weighted", "--duration", "5")
    assert "needs a master, and site 'hall' has none (mode free); it should be joint" in complaint(*command)


def test_anchors_without_a_position_are_not_simulated(run, complaint, tmp_path):
    new = "[[anchors]]\nid = 7\n[[anchors]]\nid = 8\n"
    said = complaint("simulate", "--site", protocol_2(tmp_path, new), "--duration", "5")
    assert said == "skyless: no anchor of site 'hall' has a position, so it cannot be simulated\n"
    code, out, err = run("--site", protocol_2(tmp_path, CORNERS + new), "--duration", "3", "--json")
    assert (code, err) == (0, "not simulated, as the site file has no position: anchor 7, 8\n")
    assert json.loads(out)["fixes"] > 0


def test_a_site_too_large_for_real_time_is_warned_of(tmp_path, capsys):
    large = "".join(f"[[anchors]]\nid = {k}\nx_m = {15 * k}\ny_m = 0\n" for k in range(140))
    for anchors, warned in ((large, True), (CORNERS, False)):
        check_live(load_site(protocol_2(tmp_path, anchors)))
        assert ("140 anchors send 9333 beacons/s" in capsys.readouterr().err) is warned


THREE_3D = 'name = "hall"\nid = 1\n[schedule]\nmode = "free"\n' + "".join(
    f"[[anchors]]\nid = {k + 1}\nx_m = {x}\ny_m = {y}\nz_m = {k}\n" for k, (x, y) in enumerate(((0, 0), (9, 0), (0, 9)))
)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--position", "3,4", "--silence", "0"], "the tags' radios were off all the time (--silence)"),
        (["--position", "3,4", "--silence", "0", "--json"], "the tags' radios were off all the time (--silence)"),
        (["--position", "3,900"], "the tags heard nothing: no anchor within 31 m"),
        (["--position", "3,4", "--silence", "1.5"], "all came before --settle, 2 s"),
        (["--site", "three.toml"], "3 anchors give no position: one with its height needs 4"),
        (["--position", "3,4", *(w for k in range(2, 6) for w in ("--outage", f"{k}:0"))], "too-few-anchors"),
    ],
)
def test_a_run_without_a_fix_fails_with_its_reason(run, tmp_path, arguments, reason):
    (tmp_path / "three.toml").write_text(THREE_3D)
    code, out, err = run(*arguments, "--duration", "3")
    assert code == 1
    assert err.startswith("skyless: no fix: ")
    assert reason in err
    if "--json" in arguments:
        assert json.loads(out)["fixes"] == 0
    elif "settle" not in reason:
        assert re.search("tags without a fix +│ 1 of 1", out)


@pytest.mark.parametrize(("scenario", "said"), [("lab", "2-D"), ("room", "2-D")])
def test_figures_say_of_how_many_dimensions_they_are(run, scenario, said):
    _, out, _ = run("--scenario", scenario, "--duration", "3")
    for name in ("RMSE", "predicted σ", "95 %", "largest error"):
        assert f" {name} {said} " in out
