"""Phones and boards with anchors that people reported: lost time bases, unknown constants, slow rounds, two values."""

import numpy as np
import pytest

import skyless
from support.phone_records import FOUR, HEIGHT_M, SIX, Phone

pytestmark = pytest.mark.statistical

SEEDS = range(1, 11)
RISK = 1e-3


def replayed(phone, folder, table=None):
    """Errors [m] and levels [m] of the fixes, their times [s], and the report; by default all constants are known."""
    if table is None:
        table = folder / "anchors.csv"
        rows = [f"{anchor:04X},{x},{y},{z},0\n" for anchor, (x, y, z) in phone.anchors_m.items()]
        table.write_text("id,x_m,y_m,z_m,bias_m\n" + "".join(rows))
    result = skyless.replay(phone.write(folder / "phone.jsonl"), anchors=table, tag_height_m=HEIGHT_M)
    fixes = result.fixes
    return (
        phone.errors_m(fixes.time_s, fixes.position_m),
        np.nan_to_num(fixes.hpl_m, nan=np.inf),
        fixes.time_s,
        result.report,
    )


def rmse_m(errors_m):
    return float(np.sqrt(np.mean(np.square(errors_m))))


@pytest.mark.parametrize("anchors_m", [FOUR, SIX], ids=["four", "six"])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_anchor_that_lost_its_time_base_is_named_within_its_first_records(seed, anchors_m, tmp_path):
    draw = np.random.default_rng(seed)
    lost, ppm = int(draw.choice(list(anchors_m)[1:])), float(draw.choice((-1.0, 1.0)) * draw.uniform(0.4, 8.0))
    own_clocks = {lost: (float(draw.uniform(0.0, 1e6)), ppm)}
    phone = Phone(anchors_m, seconds=1.5, seed=seed, own_clocks=own_clocks)
    named = (f"Anchor {lost:04X} runs on its own clock ({ppm:+.1f} ppm): its time base is lost",)
    assert replayed(phone, tmp_path)[3].notes == named
    errors_m, levels_m, time_s, report = replayed(Phone(anchors_m, seed=seed, own_clocks=own_clocks), tmp_path)
    assert report.notes == named
    assert report.drops["time-base-lost"] > 0.9 * 20 * 60
    assert rmse_m(errors_m[time_s > 2.0]) < (0.2 if anchors_m is FOUR else 0.05)
    assert (errors_m > levels_m).mean() <= RISK


@pytest.mark.parametrize("anchors_m", [FOUR, SIX], ids=["four", "six"])
@pytest.mark.parametrize("seed", SEEDS[:5])
def test_constants_have_to_be_calibrated_before_there_is_a_level(seed, anchors_m, tmp_path):
    draw = np.random.default_rng(seed)
    late_m = {anchor: float(draw.choice((-1.0, 1.0)) * draw.uniform(0.3, 1.3)) for anchor in anchors_m}
    bare, calibrated = tmp_path / "bare.csv", tmp_path / "calibrated.csv"
    rows = [f"{anchor:04X},{x},{y},{z}\n" for anchor, (x, y, z) in anchors_m.items()]
    bare.write_text("id,x_m,y_m,z_m\n" + "".join(rows))
    phone = Phone(anchors_m, seed=seed, constants_m=late_m)
    _, levels_m, _, report = replayed(phone, tmp_path, bare)
    assert not np.isfinite(levels_m).any()
    assert [note[:14] for note in report.notes] == ["Not calibrated"]
    still = Phone(anchors_m, seed=seed, constants_m=late_m, place_m=(14.0, 13.0, HEIGHT_M))
    found = skyless.calibrate(still.write(tmp_path / "still.jsonl"), anchors=bare, stays=[(14.0, 13.0, HEIGHT_M)])
    calibrated.write_text(found.corrected_file())
    errors_m, levels_m, time_s, report = replayed(phone, tmp_path, calibrated)
    assert report.notes == ()
    assert np.isfinite(levels_m[time_s > 1.0]).all()
    assert not (errors_m > levels_m).any()
    assert rmse_m(errors_m) < 0.06


@pytest.mark.parametrize(("rounds_per_s", "most_m"), [(1.0, 0.25), (2.0, 0.15), (3.0, 0.08)])
@pytest.mark.parametrize("seed", SEEDS)
def test_slow_rounds_give_fixes(seed, rounds_per_s, most_m, tmp_path):
    errors_m, levels_m, time_s, report = replayed(Phone(rounds_per_s=rounds_per_s, seed=seed), tmp_path)
    assert time_s[0] < 3.0 / rounds_per_s
    assert report.fixes > 0.9 * 60 * 4 * rounds_per_s
    assert rmse_m(errors_m) < most_m
    assert np.isfinite(levels_m[time_s > 20.0]).mean() > 0.9
    assert (errors_m > levels_m).mean() <= RISK


def test_rounds_may_become_slow(tmp_path):
    phone = Phone()
    lines = [line for index, line in enumerate(phone.records()) if index // 4 < 200 or index // 4 % 20 == 0]
    file, table = tmp_path / "slower.jsonl", tmp_path / "anchors.csv"
    file.write_text("\n".join(lines) + "\n")
    replayed(Phone(seconds=1.0), tmp_path)  # writes the table
    fixes = skyless.replay(file, anchors=table, tag_height_m=HEIGHT_M).fixes
    slow = phone.errors_m(fixes.time_s, fixes.position_m)[fixes.time_s > 11.0]
    assert len(slow) > 0.85 * 49 * 4
    assert rmse_m(slow) < 0.25


@pytest.mark.parametrize("anchors_m", [FOUR, SIX], ids=["four", "six"])
@pytest.mark.parametrize("rounds_per_s", [2.0, 4.0, 5.0])
def test_slow_rounds_whose_stamps_flip_have_no_level(rounds_per_s, anchors_m, tmp_path):
    errors_m, levels_m, _, report = replayed(Phone(anchors_m, rounds_per_s, flip_share=0.5), tmp_path)
    assert (errors_m > levels_m).mean() <= RISK
    assert report.notes == ("Receptions are often late: no protection level",)


@pytest.mark.parametrize("anchors_m", [FOUR, SIX], ids=["four", "six"])
@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
@pytest.mark.parametrize("seed", SEEDS)
def test_stamps_that_flip_between_two_values_are_named_and_the_earlier_is_used(seed, share, anchors_m, tmp_path):
    errors_m, levels_m, time_s, report = replayed(Phone(anchors_m, seed=seed, flip_share=share), tmp_path)
    assert rmse_m(errors_m[time_s > 5.0]) < 0.08
    assert (errors_m > levels_m).mean() <= RISK
    is_often = share > 0.2
    assert any(" flip between two values 1." in note for note in report.notes) is is_often
    assert bool(np.isfinite(levels_m).mean() < 0.1) is is_often


def test_addresses_of_eight_bytes_are_whole_in_measurements(tmp_path):
    anchors_m = {0xFEDC << 48 | anchor: place_m for anchor, place_m in FOUR.items()}
    measured = skyless.replay(Phone(anchors_m, seconds=2.0).write(tmp_path / "phone.jsonl")).measurements
    assert set(measured.anchor_b.view(np.uint64)) == set(anchors_m)
