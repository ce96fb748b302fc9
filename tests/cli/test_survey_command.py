"""``skyless survey`` as its user meets it: tables of ranges, what is stated of a site, files, and what goes wrong."""

import csv
import json
import os
import re
from itertools import pairwise

import numpy as np
import pytest
from msgspec import structs

from skyless.cli.main import main
from skyless.core.errors import SkylessError
from skyless.core.site import AnchorSite, ScheduleSite, Site
from skyless.core.ticks import TICK_M
from skyless.research.calibration.options import SurveyOptions, facts_of
from skyless.sim.impairments import DelayError
from skyless.sim.lab import lab_site
from skyless.site.file.load import load_site
from skyless.site.file.template import site_template
from skyless.site.survey.facts import Facts, Gauge, Survey, Tape, count
from skyless.site.survey.surveyed_site import read_record
from skyless.site.tables import read_anchors, read_calibration, read_ranges
from support import live_site
from support.alignment import aligned_rms_m
from support.bench import LAB
from support.full_disk import full_disk

pytestmark = pytest.mark.site

DRAW = np.random.default_rng(12)
HALL_M = np.column_stack(
    [*(a.ravel() for a in np.meshgrid([0.0, 12.0, 24.0, 36.0], [0.0, 12.0, 24.0])), np.full(12, 6.0)]
)
HALL_M[:, :2] += DRAW.uniform(-1.0, 1.0, (12, 2))
HALL_M[:, 2] += DRAW.uniform(-0.3, 0.3, 12)
DELAY_M = DRAW.normal(0.0, 0.05, 12)
NOISE_M = 0.02


def table_of_ranges(path, late=(), missing=(), repeats=12):
    """Every pair of the hall in either direction; ``late``: pairs of indices that come half a metre late."""
    draw = np.random.default_rng(4)
    with path.open("w") as file:
        rows = csv.writer(file)
        rows.writerow(("anchor_a", "anchor_b", "range_m"))
        for a in range(12):
            for b in range(a):
                if (a, b) in missing or 11 in (a, b):
                    continue
                true_m = np.linalg.norm(HALL_M[a] - HALL_M[b]) + DELAY_M[a] + DELAY_M[b] + 0.5 * ((a, b) in late)
                for k in range(repeats):
                    first, second = (a, b) if k % 2 else (b, a)
                    rows.writerow((first + 1, second + 1, f"{true_m + draw.normal(0.0, NOISE_M):.4f}"))


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    """Ranges and heights of eleven anchors, and a site of twelve whose positions are known within 0.1 m."""
    folder = tmp_path_factory.mktemp("hall")
    table_of_ranges(folder / "ranges.csv", late=((5, 2), (9, 0)), missing=((3, 1),))
    heights = "".join(f"{k + 1},{z:.3f}\n" for k, z in enumerate(HALL_M[:, 2]))
    (folder / "heights.csv").write_text("id,z_m\n" + heights)
    rough_m = HALL_M.copy()
    rough_m[:, :2] += np.random.default_rng(8).normal(0.0, 0.1, (12, 2))
    anchors = tuple(AnchorSite(k + 1, *np.round(rough_m[k], 3).tolist()) for k in range(12))
    site = Site("hall", 3, 1, anchors, ScheduleSite(mode="free"))
    (folder / "site.toml").write_text(site_template(site))
    (folder / "elsewhere.csv").write_text("id,z_m\n77,2\n78,2\n")
    (folder / "folder.csv").mkdir()
    os.mkfifo(folder / "pipe")
    assert main(["site", "new", str(folder / "blank.toml"), "--unplaced", "12"]) == 0
    return folder


def run(capsys, *arguments, code=0):
    assert main(["survey", *map(str, arguments), "--json"]) == code
    out, err = capsys.readouterr()
    assert err == "".join(f"wrote {name}\n" for flag, name in pairwise(arguments) if flag == "--plot")
    return json.loads(out)


def aligned_rmse_m(report):
    """Of the positions that were found, horizontal, after the best rigid alignment."""
    found = [one for one in report["anchors"] if one["determined"]]
    return aligned_rms_m([(one["x_m"], one["y_m"]) for one in found], [HALL_M[one["id"] - 1, :2] for one in found])


def test_a_table_of_ranges_and_heights_with_default_options(hall, capsys):
    report = run(capsys, "--recording", hall / "ranges.csv", "--anchor-height", hall / "heights.csv")
    assert {"id", "x_m", "y_m", "z_m", "std_m", "determined"} <= report["anchors"][0].keys()
    assert [one["id"] for one in report["anchors"]] == list(range(1, 12))
    assert all(one["determined"] for one in report["anchors"])
    assert sorted(map(sorted, report["excluded_pairs"])) == [[1, 10], [3, 6]]
    assert report["ambiguous"] == []
    assert report["range_std_m"] >= 0.0
    assert aligned_rmse_m(report) < 0.1
    assert {*Survey.__struct_fields__} - {"ambiguities"} <= report.keys()
    assert report["warnings"] == []
    assert report["count"]["spare"] == 54 - (2 * 11 - 3) - 11


def test_the_report_for_people(hall, capsys):
    assert main(["survey", "--recording", str(hall / "ranges.csv"), "--anchor-height", str(hall / "heights.csv")]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert out.index("11 anchors, 54 of 55 pairs, 30 unknowns: 24 ranges check the result") < out.index("anchors ┏")
    assert re.search(r"left out as late: 1–10 \(\+0\.[45]\d m\), 3–6 \(\+0\.[45]\d m\)", out)
    assert "delay / cm" in out


def test_a_full_disk_leaves_all_files_as_they_were(hall, capsys, tmp_path, monkeypatch):
    """A new site file with the record of another survey would give the watch a wrong baseline."""
    out = tmp_path / "new.toml"
    out.write_text("what was there")
    written = full_disk(monkeypatch, 3)
    command = ("--recording", hall / "ranges.csv", "--site", hall / "site.toml", "--out", out, "--force")
    assert main(["survey", *map(str, command)]) == 2
    said = capsys.readouterr().err
    assert "cannot be written: No space left on device" in " ".join(said.split())
    assert "Traceback" not in said
    assert len(written) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["new.toml"]
    assert out.read_text() == "what was there"


def test_an_anchor_that_nobody_receives_is_not_determined_and_stays(hall, capsys, complaint, tmp_path):
    out = tmp_path / "new.toml"
    out.write_text("what was there")
    command = ("--recording", hall / "ranges.csv", "--site", hall / "site.toml", "--out", out)
    assert "--force overwrites it" in complaint("survey", *command)
    assert out.read_text() == "what was there"
    report = run(capsys, *command, "--force")
    assert [one["id"] for one in report["anchors"] if not one["determined"]] == [12]
    assert report["unchanged"] == [12]
    assert report["written"] == [
        str(tmp_path / name) for name in ("new.before-survey-1.toml", "new.toml", "new.survey.json")
    ]
    assert (tmp_path / "new.before-survey-1.toml").read_text() == "what was there"
    old, new = load_site(hall / "site.toml"), load_site(out)
    assert new.anchors[11] == old.anchors[11]
    for one in report["anchors"][:11]:
        anchor, before = new.anchors[one["id"] - 1], old.anchors[one["id"] - 1]
        assert (anchor.x_m, anchor.y_m) == pytest.approx((one["x_m"], one["y_m"]), abs=1e-4)
        assert anchor.z_m == before.z_m
        assert anchor.tx_antenna_delay_ticks == before.tx_antenna_delay_ticks + round(2 * one["delay_m"] / TICK_M)
    record = read_record(tmp_path / "new.survey.json")
    assert record.ranges.anchors == tuple(range(1, 13))
    assert len(record.ranges.pairs) == 54


def test_anchors_without_positions_get_theirs(hall, capsys, tmp_path):
    out = tmp_path / "placed.toml"
    report = run(
        capsys, "--recording", hall / "ranges.csv", "--anchor-height", hall / "heights.csv",
        "--site", hall / "blank.toml",
        "--axes", "1,4,9", "--out", out,
    )  # fmt: skip
    site = load_site(out)
    assert [anchor.id for anchor in site.unplaced] == [12]
    assert len(site.anchors) == 11
    first, fourth, ninth = (site.anchors[k] for k in (0, 3, 8))
    assert (first.x_m, first.y_m, fourth.y_m) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    assert fourth.x_m > 30.0
    assert ninth.y_m > 20.0
    assert all(0.0 < anchor.std_m < 0.255 for anchor in site.anchors)
    assert main(["site", "check", str(out)]) == 0
    assert aligned_rmse_m(report) < 0.1


def test_only_delays_with_positions_kept(hall, capsys, tmp_path):
    out = tmp_path / "delays.toml"
    report = run(
        capsys, "--recording", hall / "ranges.csv", "--site", hall / "site.toml", "--keep-positions", "--out", out
    )
    old, new = load_site(hall / "site.toml"), load_site(out)
    at = lambda site: [(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors]  # noqa: E731
    assert at(new) == at(old)
    assert any(
        a.tx_antenna_delay_ticks != b.tx_antenna_delay_ticks for a, b in zip(old.anchors, new.anchors, strict=True)
    )
    assert [one["id"] for one in report["anchors"] if one["delay_m"] is None] == [12]


def test_a_table_of_anchors_with_their_delays(hall, capsys, tmp_path):
    out = tmp_path / "anchors.csv"
    report = run(
        capsys, "--recording", hall / "ranges.csv", "--anchor-height", hall / "heights.csv", "--out", out,
        "--plot", tmp_path / "hall.png",
    )  # fmt: skip
    assert read_anchors(out)[3][:2] == pytest.approx([report["anchors"][2][axis] for axis in ("x_m", "y_m")], abs=1e-4)
    assert read_calibration(out).anchors[3].bias_m == pytest.approx(report["anchors"][2]["delay_m"], abs=1e-4)
    assert (tmp_path / "hall.png").read_bytes().startswith(b"\x89PNG")


def test_nothing_determined_writes_nothing_and_ends_with_1(capsys, tmp_path):
    (tmp_path / "one.csv").write_text("anchor_a,anchor_b,range_m\n1,2,5.0\n")
    report = run(capsys, "--recording", tmp_path / "one.csv", "--out", tmp_path / "a.csv", code=1)
    assert not report["usable"]
    assert report["not_determined"]
    assert report["written"] == []
    assert not (tmp_path / "a.csv").exists()
    assert any("too few ranges check" in warning for warning in report["warnings"])


OFF_TICKS = {2: (40.0, 0.0), 3: (0.0, -50.0), 4: (30.0, 30.0), 5: (-64.0, 20.0), 1: (10.0, 0.0), 6: (0.0, 0.0)}
"""True minus configured TX and RX delays of the lab's anchors, in their order."""


def test_delays_from_a_recording_and_twice_is_once(capsys, tmp_path):
    """A tag's receptions suffice; delays count from those of the recording and not from those of the file."""
    ids = sorted(anchor.id for anchor in LAB.anchors)
    errors = tuple(DelayError(anchor, *OFF_TICKS[number]) for number, anchor in enumerate(ids, start=1))
    live_site.record(tmp_path / "stay.mcap", live_site.messages(5.0, join_s=0.0, delay_errors=errors))
    measured = structs.replace(LAB, accuracy=structs.replace(LAB.accuracy, survey_std_m=0.0005))
    (tmp_path / "site.toml").write_text(site_template(measured))
    exact = ("--keep-positions", "--delay-std", "0.5", "--pair-std", "0")
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    report = run(
        capsys, "--recording", tmp_path / "stay.mcap", "--site", tmp_path / "site.toml", *exact, "--out", first
    )
    assert report["excluded_pairs"] == []
    before = {anchor.id: anchor.tx_antenna_delay_ticks for anchor in LAB.anchors}
    after = {anchor.id: anchor.tx_antenna_delay_ticks for anchor in load_site(first).anchors}
    wanted = {error.anchor: error.tx_ticks + error.rx_ticks for error in errors}
    for one in report["anchors"]:  # a tick of rounding, and what two stamps' noise leaves
        tolerance = 1.0 + 10.0 * one["delay_std_m"] / TICK_M
        assert after[one["id"]] - before[one["id"]] == pytest.approx(wanted[one["id"]], abs=tolerance)
        assert one["delay_std_m"] < 0.002
    run(capsys, "--recording", tmp_path / "stay.mcap", "--site", first, *exact, "--out", second)
    again = {anchor.id: anchor.tx_antenna_delay_ticks for anchor in load_site(second).anchors}
    assert all(abs(again[anchor] - after[anchor]) <= 1 for anchor in after)
    whole = run(capsys, "--recording", tmp_path / "stay.mcap", "--delay-std", "0", "--pair-std", "0.1")
    assert len(whole["anchors"]) == len(LAB.anchors)
    assert whole["drops"] == []


def test_damage_of_a_recording_is_reported(capsys, tmp_path):
    stay = tmp_path / "stay.mcap"
    live_site.record(stay, live_site.messages(5.0, join_s=0.0))
    whole = bytearray(stay.read_bytes())
    stay.write_bytes(whole[: len(whole) // 2])
    report = run(capsys, "--recording", stay)
    assert report["drops"] == ["left out: 1 × unfinished-record"]
    whole[len(whole) // 2] ^= 0xFF
    stay.write_bytes(whole)
    report = run(capsys, "--recording", stay)
    assert "left out: 1 × damaged-chunk" in report["drops"]
    assert len(report["anchors"]) == len(LAB.anchors)


@pytest.mark.parametrize(
    ("walks", "words"),
    [
        (("a", "a@1:2"), "--walk is 'a@1:2'; a walk of a given before covers the same time"),
        (("a@2:1",), "the later one last"),
        (("a@x",), "--walk is 'a@x'; 'x' should be 2 numbers separated by ':'"),
        (("nobody",), "one of a"),
    ],
)
def test_walks_that_cannot_be_used(complaint, tmp_path, walks, words):
    stay = tmp_path / "stay.mcap"
    live_site.record(stay, live_site.messages(2.0, join_s=0.0))
    assert words in complaint("survey", "--recording", stay, *(part for walk in walks for part in ("--walk", walk)))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "needs a recording"),
        (("--recording", "{hall}/none.mcap"), "it should be a file, and there is none"),
        (("--recording", "{hall}/pipe"), "a pipe"),
        (("--recording", "{hall}/heights.csv"), 'the header is "id,z_m"; it should be a known table'),
        (("--recording", "{hall}/ranges.csv", "--walk", "a"), "a recording of skyless record"),
        (("--recording", "{hall}/ranges.csv", "--anchor-height", "{hall}/ranges.csv"), "a header with id,z_m"),
        (("--out", "a.toml"), "a site file needs --site"),
        (("--out", "a.txt"), "its ending should be .toml"),
        (("--out", "no/such/a.csv"), "a folder that exists"),
        (("--out", "{hall}/folder.csv", "--force"), "should be a file in a folder"),
        (("--out", "{hall}/ranges.csv", "--force"), "would destroy it"),
        (("--force",), "nothing is written without --out"),
        (("--plot", "a.txt"), "its ending should be one of"),
        (("--keep-positions",), "needs positions to keep"),
        (("--site", "{hall}/blank.toml", "--keep-positions"), "needs positions to keep"),
        (("--site", "{hall}/site.toml", "--keep-positions", "--delay-std", "0"), "give either"),
        (("--anchor-height", "tall"), "--anchor-height is 'tall'"),
        (("--anchor-height", "77=2"), "there is no anchor 77; there are 1, 2"),
        (("--anchor-height", "1=nan"), "--anchor-height is '1=nan'; 'nan' should be a number"),
        (("--anchor-height", "2", "--anchor-height", "3"), "given once"),
        (("--anchor-height", "1=2", "--anchor-height", "1=3"), "the height of anchor 1 should be given once"),
        (("--anchor-height", "{hall}/elsewhere.csv"), 'column id is "77, 78"; it should be anchors among 1, 2'),
        (("--anchor-height", "{hall}/pipe"), "a pipe"),
        (("--site", "/dev/zero"), "not a pipe or a device"),
        (("--distance", "1-2"), "--distance is '1-2'; it should be like"),
        (("--distance", "1-1=3"), "between two anchors"),
        (("--distance", "1-2=-3"), "a positive distance"),
        (("--distance", "1-77=3"), "no anchor 77"),
        (("--distance", "1-2=7,21"), "'7,21' should be a number"),
        (("--distance", "1-2=3", "--distance", "2-1=4"), "that between 2 and 1 should be given once"),
        (("--point", "1=3"), "2 or 3 numbers"),
        (("--point", "x=3,4"), "'x' should be the identifier of an anchor"),
        (("--axes", "1"), "--axes is '1'; it should be two or three different anchors"),
        (("--axes", "1,77"), "no anchor 77"),
        (("--axes", "1,x"), "'x' should be the identifier of an anchor"),
        (("--delay-std", "1e300"), "--delay-std"),
        (("--pair-std", "1e308"), "--pair-std"),
        (("--anchor-height", "1=1e300"), "metres, at most"),
        (("--distance", "1-2=1e308"), "metres, at most"),
        (("--distance", "1-2=3±1e9"), "metres, at most"),
        (("--point", "1=1e308,0"), "metres, at most"),
        (("--point", "1=0,0", "--point", "1=5,5"), "given once"),
    ],
)
def test_what_the_user_can_mend_is_named(hall, complaint, arguments, words):
    given = [one.format(hall=hall) for one in arguments]
    if given and given[0].startswith("--") and given[0] != "--recording":
        given = ["--recording", str(hall / "ranges.csv"), *given]
    assert words in complaint("survey", *given)
    assert (hall / "ranges.csv").read_text().startswith("anchor_a")


def test_facts_from_options(hall):
    site = load_site(hall / "site.toml")
    everybody = tuple(range(1, 13))
    facts = facts_of(
        SurveyOptions(
            anchor_height_m={None: 2.5, 3: 2.4},
            distances=(Tape(1, 4, 7.21), Tape(1, 5, 8.0, 0.01), Tape(2, 3, 4.0, 0.02)),
            points_m={7: (1, -2, 3), 8: (0, 0)},
            delay_std_m=0.15, pair_std_m=0.0, axes=(1, 4),
        ),
        everybody,
        site,
    )  # fmt: skip
    assert facts.heights_m == {**dict.fromkeys(everybody, 2.5), 3: 2.4, 7: 3.0}
    assert facts.tapes == (Tape(1, 4, 7.21), Tape(1, 5, 8.0, 0.01), Tape(2, 3, 4.0, 0.02))
    assert facts.points == {7: (1.0, -2.0, 3.0), 8: (0.0, 0.0, None)}
    assert facts.sketch_m[12] == (site.anchors[11].x_m, site.anchors[11].y_m, site.anchors[11].z_m)
    assert (facts.sketch_std_m, facts.delay_std_m, facts.pair_std_m) == (0.3, 0.15, 0.0)
    assert facts.gauge == Gauge(1, 4)
    assert facts_of(SurveyOptions(), everybody, None) == Facts()
    bare = facts_of(SurveyOptions(delay_std_m=0.0), everybody, site)
    assert (bare.delay_std_m, bare.heights_m[1]) == (0.0, site.anchors[0].z_m)
    kept = facts_of(SurveyOptions(keep_positions=True), everybody, site)
    assert (kept.keep_positions, kept.sketch_std_m) == (True, pytest.approx(site.accuracy.survey_std_m))
    free = facts_of(SurveyOptions(anchor_height_m=hall / "heights.csv", anchor_height_std_m=0.1), (1, 2, 99), site)
    assert (free.dimensions, sorted(free.heights_m), free.height_std_m) == (3, [1, 2], 0.1)


@pytest.mark.statistical
def test_missing_heights_are_those_of_the_others_and_said(hall, capsys):
    """They are neither typed nor measured, so the reader of the result has to know."""
    heights = [part for k in range(1, 11) for part in ("--anchor-height", f"{k}={3 if k < 10 else 5}")]
    report = run(capsys, "--recording", hall / "ranges.csv", *heights)
    assert report["assumed_heights"] == "no height is given for anchor 11: 3 m is assumed, the median of the others"
    assert report["anchors"][10]["z_m"] == 3.0
    report = run(capsys, "--recording", hall / "ranges.csv")
    assert {one["z_m"] for one in report["anchors"]} == {0.0}
    assert "no heights are given: all anchors are taken to be on the floor" in report["assumed_heights"]
    assert main(["survey", "--recording", str(hall / "ranges.csv")]) == 0
    assert "all anchors are taken to be on the floor" in " ".join(capsys.readouterr().out.split())
    whole = ("--recording", hall / "ranges.csv", "--anchor-height", hall / "heights.csv")
    assert run(capsys, *whole)["assumed_heights"] is None
    estimated = run(capsys, "--recording", hall / "ranges.csv", "--anchor-height-std", 0.1, code=1)
    assert estimated["assumed_heights"] is None


def test_a_height_of_no_anchor_is_refused():
    with pytest.raises(SkylessError, match="no anchor 9"):
        facts_of(SurveyOptions(anchor_height_m={9: 2.0}), (1, 2), None)


def test_ranges_are_counted_before(hall):
    ranges = read_ranges(hall / "ranges.csv")
    assert count(ranges, Facts(delay_std_m=0.0)).spare == 54 - 19
    assert count(ranges, Facts(dimensions=3)).spare == 54 - 27 - 11
    assert count(ranges, Facts(tapes=(Tape(1, 2, 3.0),))).spare == 54 - 30 + 1
    assert count(ranges, Facts(points={1: (0.0, 0.0, None), 2: (1.0, 0.0, None)})).spare == 54 - 30 + 1
    assert count(ranges, Facts(keep_positions=True)).spare == 54 - 11
    lab = lab_site()
    assert len(lab.anchors) == 6
    of_lab = count(_complete(6), Facts())
    assert (of_lab.spare, of_lab.possible) == (0, 15)
    assert "(--distance)" in of_lab.warning
    assert "expected delays decide" in count(_complete(5), Facts()).sentence
    assert count(_complete(12), Facts()).warning is None


def _complete(n):
    from skyless.site.survey.facts import PairRange, PairRanges

    pairs = tuple(PairRange(a, b, 1.0, 0.01, 1) for b in range(1, n + 1) for a in range(1, b))
    return PairRanges(pairs, tuple(range(1, n + 1)))
