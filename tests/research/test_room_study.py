"""The study of the room: what its cases are, how levels are counted, and which limits hold."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.cli.api.study import StudyResult
from skyless.cli.study import print_rows
from skyless.core.alert import Alert
from skyless.core.integrity import Integrity
from skyless.research.studies import room
from skyless.research.studies.picture import WorldRow, clustered_interval, world_cells
from skyless.research.studies.room import biases_of
from skyless.research.studies.run import Parts
from skyless.research.studies.runner import Limit, plan_of, with_limits
from skyless.research.studies.worlds import RunResult, box, run_world
from skyless.research.uncertainty import Biases
from skyless.sim.evaluation.figures import LevelTally
from skyless.sim.impairments import Body
from skyless.sim.lab import lab_site
from skyless.site.channel import barriers_of, cross_walls

pytestmark = pytest.mark.site

PLAN = plan_of("joint", 1, study="room")
CASES = {case.name: case for case in room.cases(PLAN)}
RESTS = ("at rest, unbiased air", "at rest", "at rest, 3-D room")
FIELDS = ("multipath of 5 cm over 10 cm", "multipath of 10 cm over 10 cm")
LONG = {*RESTS, *(f"{name}, later" for name in RESTS), *FIELDS, *(f"1 of 6 creeps 5 cm/s for {s} s" for s in (20, 60))}
EMPTY = WorldRow(
    study="room", method="joint", case="a", series="s", mesh=True, noise_ps=100.0, runs=2, fixes=10, rmse_m=0.03
)


def test_the_room_has_a_hundred_tags_in_twenty_draws_and_the_rest_a_quarter():
    sizes = {name: (len(case.runs), len(case.runs[0].trajectories)) for name, case in CASES.items()}
    assert sizes.pop(room.BASE) == (20, 5)
    assert {name for name, size in sizes.items() if size == (2, 5)} == LONG
    assert {size for name, size in sizes.items() if name not in LONG} == {(5, 5)}
    run = CASES[room.BASE].runs[0]
    assert (run.warmup_s, run.until_s) == (1.5, 16.5)
    few = room.cases(plan_of("joint", 1, study="room", quick=True))
    assert {(len(case.runs), len(case.runs[0].trajectories)) for case in few} == {(3, 2), (2, 2)}
    assert few[0].name == room.BASE
    assert sorted(case.series for case in few) == sorted({case.series for case in CASES.values()})


@pytest.mark.statistical
def test_worlds_are_the_same_for_every_method_and_of_one_seed_in_all_cases():
    for case, other in zip(CASES.values(), room.cases(replace(PLAN, method="literal")), strict=True):
        for a, b, base in zip(case.runs, other.runs, CASES[room.BASE].runs, strict=False):
            assert (a.site, a.impairments, a.seed, a.until_s) == (b.site, b.impairments, b.seed, b.until_s)
            assert a.seed == base.seed
            ways = [[path.position(t_s).tolist() for path in run.trajectories for t_s in (0.0, 7.0)] for run in (a, b)]
            assert ways[0] == ways[1]
    assert len({run.seed for run in CASES[room.BASE].runs}) == 20


def test_each_case_is_wrong_in_what_its_name_says():
    def faults(name):
        return CASES[name].runs[0].impairments

    base = faults(room.BASE)
    assert len(base.anchor_displacements) == 6
    assert (base.range_errors.constant_m, base.range_errors.slope_m) == (0.05, 0.05)
    assert (faults(room.AIR).anchor_displacements, faults(room.AIR).range_errors.constant_m) == ((), 0.0)
    assert faults("constants change in 10 s").range_errors.correlation_s == 10.0
    assert faults("constants change within 1 m").range_errors.correlation_m == 1.0
    assert faults("constants within 10 cm").range_errors.constant_m == 0.1
    assert faults("a body").body == Body(0.2, math.radians(100.0))
    assert not faults("past a wall").channel.walls_between_anchors
    assert CASES["past a wall"].runs[0].site.walls[0].delay_m == 0.25
    for name, count, off_m in (("one anchor 10 cm off", 1, 0.1), ("two anchors 20 cm off", 2, 0.2)):
        moved = [
            math.dist((a.x_m, a.y_m), (b.x_m, b.y_m))
            for a, b in zip(faults(name).anchor_displacements, base.anchor_displacements, strict=True)
        ]
        assert sorted(moved)[-count:] == pytest.approx([off_m] * count)
        assert sorted(moved)[:-count] == [0.0] * (6 - count)
    axes = np.array(
        [(d.x_m, d.y_m) for run in CASES["each axis N(5 cm)"].runs for d in run.impairments.anchor_displacements]
    )
    assert np.std(axes) == pytest.approx(0.05, rel=0.4)
    (slow,) = faults("tags' crystals +5 ppm").warm_ups
    assert (slow.ppm, slow.tau_s, slow.start_s, slow.anchor) == (5.0, 60.0, 1.5, None)
    anchors = [run.impairments.warm_ups[0].anchor for run in CASES["an anchor's crystal +1 ppm"].runs]
    assert anchors == [1, 2, 3, 4, 5]
    hall, third = CASES["hall, 8 anchors"].runs[0].site, CASES["3-D room, 8 anchors"].runs[0].site
    assert (len(hall.anchors), len(third.anchors), hall.tags.height_m, third.tags.height_m) == (8, 8, 0.0, None)
    heights = {path.position(3.0)[2] for path in CASES["3-D room, 8 anchors"].runs[0].trajectories}
    assert len(heights) == 5


def test_tags_at_rest_lie_still_and_are_judged_at_first_and_after_two_minutes():
    for name in RESTS:
        first, later = CASES[name], CASES[f"{name}, later"]
        assert (first.of, later.of) == (None, name)
        assert {(run.warmup_s, run.until_s) for run in first.runs} == {(1.5, 16.5)}
        assert {(run.warmup_s, run.until_s) for run in later.runs} == {(106.5, 121.5)}
        for a, b in zip(first.runs, later.runs, strict=True):
            assert (a.seed, a.site, a.impairments) == (b.seed, b.site, b.impairments)
            places = [[path.position(t_s).tolist() for path in a.trajectories] for t_s in (0.0, 100.0)]
            assert places[0] == places[1] == [path.position(7.0).tolist() for path in b.trajectories]
    assert CASES["at rest"].runs[0].impairments.range_errors.constant_m == 0.05
    assert CASES["at rest, unbiased air"].runs[0].impairments.anchor_displacements == ()
    assert CASES["at rest, 3-D room"].runs[0].site.tags.height_m is None


def test_multipath_comes_on_top_of_the_constants_and_is_judged_after_a_minute():
    for name, std_m in zip(FIELDS, (0.05, 0.1), strict=True):
        run = CASES[name].runs[0]
        errors = run.impairments.range_errors
        assert (errors.constant_m, errors.slope_m) == (0.05, 0.05)
        assert (errors.changing_m, errors.correlation_m) == (std_m, 0.1)
        assert (run.warmup_s, run.until_s) == (60.0, 75.0)


def test_one_anchor_creeps_for_as_long_as_the_case_says():
    for seconds, until_s in ((5, 16.5), (20, 21.5), (60, 61.5)):
        case = CASES[f"1 of 6 creeps 5 cm/s for {seconds} s"]
        (bias,) = case.runs[1].impairments.anchor_biases
        assert (bias.anchor, case.runs[1].until_s) == (2, until_s)
        late_m = [bias.active_m(1.5 + s) for s in (-0.1, 0.0, seconds - 0.5, seconds)]
        assert late_m == pytest.approx([0.0, 0.0, 0.05 * (seconds - 0.5), 0.0])


def test_all_anchors_crystals_change_each_by_its_own_rate_and_sign():
    for change, low_hz, high_hz, seconds in (("0.5–3 ppm", 0.5, 3.0, 1e6), ("0.01–0.03 ppm/s", 0.01, 0.03, 1.0)):
        for run in CASES[f"all anchors' crystals ±{change}"].runs:
            warm_ups = run.impairments.warm_ups
            assert [one.anchor for one in warm_ups] == [1, 2, 3, 4, 5, 6]
            gains = [one.ppm * -math.expm1(-seconds / one.tau_s) for one in warm_ups]
            assert len({abs(gain) for gain in gains}) == 6
            assert all(0.999 * low_hz <= abs(gain) <= high_hz for gain in gains)
            assert {one.start_s for one in warm_ups} == {0.0}
    crystals = CASES["all anchors' crystals ±0.5–3 ppm"].runs
    signs = {math.copysign(1.0, one.ppm) for run in crystals for one in run.impairments.warm_ups}
    assert signs == {-1.0, 1.0}


def test_the_line_and_the_stairwell_are_what_they_are_called():
    line, stairs = CASES["anchors in a line"].runs[0], CASES["stairwell in 3-D, 8 anchors"].runs[0]
    assert {anchor.y_m for anchor in line.site.anchors} == {0.0, 0.1}
    assert min(path.position(t_s)[1] for path in line.trajectories for t_s in range(16)) > 0.3
    heights_m = [anchor.z_m for anchor in stairs.site.anchors]
    assert (len(set(heights_m)), max(heights_m) - min(heights_m), stairs.site.tags.height_m) == (8, 5.0, None)


def test_anchors_are_late_by_amounts_of_their_own_from_the_start_or_for_six_seconds():
    for span, low_m, high_m in (("0.1–0.4", 0.1, 0.4), ("0.5–2", 0.5, 2.0)):
        biases = [
            [run.impairments.anchor_biases for run in CASES[f"{count} of 6 late, {span} m"].runs] for count in (1, 2, 3)
        ]
        for one, two, three in zip(*biases, strict=True):
            assert (len(one), len(two), len(three)) == (1, 2, 3)
            assert set(one) < set(two) < set(three)
            assert len({bias.anchor for bias in three}) == 3
            assert all(low_m <= bias.bias_m <= high_m for bias in three)
            assert all((bias.from_s, bias.to_s) == (0.0, math.inf) for bias in three)
    brief = CASES["2 of 6 late, 0.5–2 m, 6 s"].runs[0].impairments.anchor_biases
    assert {(bias.from_s, bias.to_s) for bias in brief} == {(4.5, 10.5)}
    assert [(b.anchor, b.bias_m) for b in brief] == [
        (b.anchor, b.bias_m) for b in CASES["2 of 6 late, 0.5–2 m"].runs[0].impairments.anchor_biases
    ]


def test_the_wall_hides_up_to_three_anchors_for_four_seconds_and_none_before_and_after():
    walls = barriers_of((room.WALL,))
    for path in room.past_wall(20, 5):
        hidden = [
            sum(cross_walls(*walls, *path.position(t_s), a.x_m, a.y_m, a.z_m)[1] > 0.0 for a in lab_site().anchors)
            for t_s in np.arange(0.0, 16.5, 0.05)
        ]
        changes = np.flatnonzero(np.diff(np.array(hidden) > 0))
        first, last = 0.05 * changes[:2]
        assert first > 1.5
        assert 3.5 < last - first < 6.0
        assert max(hidden) == 3
        speeds = [np.linalg.norm(path.velocity(t_s)) for t_s in np.arange(1.0, 6.0, 0.1)]
        assert max(speeds) == pytest.approx(1.0)


@pytest.mark.parametrize("acceleration_mps2", room.TURNS_MPS2)
def test_tags_turn_as_hard_as_the_case_says_within_the_lab(acceleration_mps2):
    low_m, high_m = box(lab_site())
    for path in room.turning(PLAN, acceleration_mps2, 3):
        places = np.array([path.position(0.002 * k) for k in range(8000)])
        assert (places >= low_m - 1e-9).all()
        assert (places <= high_m + 1e-9).all()
        speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / 0.002
        pushes = np.linalg.norm(np.diff(places, 2, axis=0), axis=1) / 0.002**2
        assert speeds.max() == pytest.approx(3.0, rel=0.01)
        assert pushes.max() == pytest.approx(acceleration_mps2, rel=0.01)


def test_the_limits_are_those_of_the_acceptance():
    found = {name: {str(limit) for limit in case.limits} for name, case in CASES.items() if case.limits}
    late = {f"{n} of 6 late, {span} m{w}" for n in (2, 3) for span in ("0.1–0.4", "0.5–2") for w in ("", ", 6 s")}
    off = {f"one anchor {cm} cm off" for cm in (10, 15, 20, 30)} | {"two anchors 20 cm off"}
    assert found == {
        "the room": {"rmse_m:..0.03", "nees:0.7..1.3", "level:0.99..", "exceeded:..0.0001", "hpl_m:..0.3"}
        | {"ratio:..1.15"},
        "unbiased air": {"rmse_m:..0.019"},
        "hall, 8 anchors": {"level:0.97..", "nees:0.5..1.5"},
        "3-D room, 8 anchors": {"rmse_m:..0.05"},
        "stairwell in 3-D, 8 anchors": {"rmse_m:..0.038"},
        "anchors in a line": {"level:..0", "exceeded:..0"},
        **{name: {"nees:..2", "exceeded:..0"} for name in RESTS},
        **{f"{name}, later": {"nees:..2", "exceeded:..0", "ratio:..1.2"} for name in RESTS},
        **{f"tags' crystals {ppm} ppm": {"ratio:..1.3"} for ppm in ("+1", "-1", "+2", "-2", "+5")},
        "an anchor's crystal +1 ppm": {"ratio:..1.3"},
        **{
            name: {f"rmse_m:..{most_m:g}", "nees:..2", "exceeded:..0.001"}
            for name, most_m in zip(FIELDS, (0.075, 0.12), strict=True)
        },
        **{
            f"all anchors' crystals ±{change}": {f"rmse_m:..{most_m:g}", "level:0.95..", "exceeded:..0.001"}
            for change, most_m in (("0.5–3 ppm", 0.04), ("0.01–0.03 ppm/s", 0.04), ("0.03–0.1 ppm/s", 0.08))
        },
        **{f"1 of 6 creeps 5 cm/s for {seconds} s": {"exceeded:..0.001"} for seconds in (5, 20, 60)},
        "past a wall": {"rmse_m:..0.05", "nees:..3", "exceeded:..0.001"},
        "a body": {"rmse_m:..0.09", "nees:..3", "exceeded:..0.001"},
        "turns of 10 m/s² at 3 m/s": {"exceeded:..0.001"},
        **{name: {"exceeded:..0.001"} for name in late},
        **{name: {"exceeded:..0.0003"} for name in off},
    }
    references = {name: case.of for name, case in CASES.items() if case.of is not None}
    later = {f"{name}, later": name for name in RESTS}
    assert references == later | {name: "the room" for name in CASES if "crystal" in name and "all" not in name}


def test_limits_hold_at_their_ends_and_what_does_not_exist_exceeds_nothing():
    most, least, both = Limit("rmse_m", most=0.03), Limit("level", 0.99), Limit("nees", 0.7, 1.3)
    assert with_limits(EMPTY, ()) is EMPTY
    row = with_limits(replace(EMPTY, nees=1.31, level=0.99), (most, least, both))
    assert (row.missed, row.passed, row.limits) == (("nees",), False, (most, least, both))
    assert with_limits(replace(EMPTY, nees=0.7, level=1.0), (most, least, both)).passed is True
    assert with_limits(EMPTY, (most, least, Limit("exceeded", most=1e-4))).missed == ("level",)
    assert with_limits(replace(EMPTY, fixes=0, rmse_m=None), (most,)).passed is False


class FixWithLevel:
    """A fix that gives a level, or none."""

    integrity_risk = 1e-4

    def __init__(self, hpl_m, alert, vpl_m=None):
        self.integrity = Integrity(hpl_m, vpl_m, self.integrity_risk, alert)


class FixWithoutLevels:
    integrity = integrity_risk = None


def test_levels_are_counted_for_each_tag():
    counter = LevelTally(2, 100)
    counter.add(0, FixWithoutLevels(), np.ones(3))
    assert counter.report() is None
    for tag, hpl_m, across_m, alert in (
        (0, 0.1, 0.05, Alert.NONE),
        (0, 0.1, 0.2, Alert.NONE),
        (1, 0.3, 0.4, Alert.EXCLUDED),
        (1, None, 9.0, Alert.UNAVAILABLE),
    ):
        counter.add(tag, FixWithLevel(hpl_m, alert), np.array((0.6 * across_m, 0.8 * across_m, 9.0)))
    counts = counter.fixes, counter.levels, counter.exceeded, counter.unwarned
    assert [part.tolist() for part in counts] == [[2, 2], [2, 1], [1, 1], [1, 0]]
    assert sorted(counter.hpl_m) == [0.1, 0.1, 0.3]
    report = counter.report()
    assert (report.available, report.misleading, report.hpl_m) == (0.75, 2, 0.1)
    assert report.alerts == {"detected-excluded": 1, "none": 2, "unavailable": 1}
    counter.add(0, FixWithLevel(1.0, Alert.NONE, vpl_m=0.5), np.array((0.1, 0.1, -0.6)))
    assert counter.report().misleading == 3


class CountedLevels:
    """A tally of two tags with nine judged fixes."""

    def __init__(self, levels, exceeded, unwarned, hpl_m):
        self.levels, self.exceeded, self.unwarned = np.array([levels, exceeded, unwarned])
        self.hpl_m = np.array(hpl_m)


def _results(plan, levels):
    one = RunResult(9, 9, 0.01, 0.01, 9.0, 0, 0.1, np.full(9, 0.03), 9, 1.0, 1e-3, levels)
    each = room.cases(plan)
    worlds = sum(len(case.runs) for case in each)
    return [one] * worlds + [0.02**2] * (len(world_cells(each)) - worlds)


def test_rows_have_shares_of_the_fixes_with_a_level_and_intervals_over_tags():
    plan = plan_of("joint", 1, study="room", worlds=2)
    counts = CountedLevels((4.0, 2.0), (3.0, 0.0), (1.0, 0.0), (0.1, 0.4))
    rows = room.rows(plan, _results(plan, counts))
    row = rows[0]
    assert row.level == pytest.approx(12.0 / 18.0)
    assert row.exceeded == pytest.approx(6.0 / 12.0)
    assert row.exceeded_interval == (clustered_interval(np.array([3.0, 0.0, 3.0, 0.0]), 12.0)[0], 1.0)
    assert row.exceeded_unwarned == pytest.approx(2.0 / 12.0)
    assert row.hpl_m == pytest.approx(0.25)
    assert (row.bound_m, row.ratio) == (pytest.approx(0.02), pytest.approx(5.0 / 3.0))
    assert row.missed == ("rmse_m", "level", "exceeded", "ratio")
    assert {row.case for row in rows if row.bound_m is not None} == {
        *("the room", "unbiased air", "hall, 8 anchors", "3-D room, 8 anchors", "stairwell in 3-D, 8 anchors"),
        *("constants change in 10 s",),
        *("constants change within 1 m", "constants within 10 cm", "each axis N(5 cm)"),
    }
    none = CountedLevels((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), ())
    row = room.rows(plan, _results(plan, none))[0]
    assert (row.level, row.exceeded, row.hpl_m) == (0.0, None, None)


@pytest.mark.statistical
def test_the_table_shows_levels_and_what_is_missed(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    plan = plan_of("joint", 1, study="room", worlds=2)
    counts = CountedLevels((4.0, 2.0), (3.0, 0.0), (1.0, 0.0), (0.1, 0.4))
    rows = room.rows(plan, _results(plan, counts))
    print_rows(StudyResult("room", plan, tuple(rows), 1.0, Parts(1, 0, ())))
    out = capsys.readouterr().out
    notes = ("3 of 6 late, 0.5–2 m, 6 s", "missed: RMSE, level, exceeded, ratio")
    for words in ("past a wall", *notes, "held", "66.7 %", "5000", "±"):
        assert words in out


def test_the_bound_is_of_what_the_worlds_draw():
    found = {name: case.biases for name, case in CASES.items() if case.biases is not None}
    usual = found[room.BASE]
    assert (usual.survey_std_m, usual.constant_std_m, usual.slope_std_m) == (
        0.02,
        pytest.approx(0.0289, rel=1e-2),
        0.05,
    )
    assert usual.changing_std_m == 0.0
    assert found["unbiased air"] == Biases()
    assert (found["each axis N(5 cm)"].survey_std_m, found["constants within 10 cm"].constant_std_m) == (
        0.05,
        pytest.approx(0.0577, rel=1e-2),
    )
    slow, near = found["constants change in 10 s"], found["constants change within 1 m"]
    assert (slow.constant_std_m, slow.changing_std_m, slow.correlation_s, slow.correlation_m) == (
        0,
        0.029,
        10,
        math.inf,
    )
    assert (near.correlation_s, near.correlation_m) == (math.inf, 1.0)
    assert biases_of(None) == Biases()


@pytest.mark.statistical
def test_the_bound_of_the_room():
    """The bounds of the first two rows in ``docs/studies.md``, from six tags."""
    plan = replace(plan_of("joint", 11, study="room", worlds=2), tags=3)
    base, air = room.cases(plan)[:2]
    for case, bound_m in ((base, 0.0249), (air, 0.0167)):
        variances_m2 = [cell.function() for cell in world_cells([case])[len(case.runs) :]]
        assert math.sqrt(np.mean(variances_m2)) == pytest.approx(bound_m, rel=0.02)


@pytest.mark.statistical
@pytest.mark.parametrize("name", ["past a wall", "a body", *FIELDS])
def test_walls_bodies_and_multipath_cost_no_more_than_their_limits(name):
    """Of four worlds of two tags; no level is exceeded."""
    cases = room.cases(replace(plan_of("joint", 31, study="room", worlds=40), tags=2))
    case = next(case for case in cases if case.name == name)
    most_m = next(limit.most for limit in case.limits if limit.figure == "rmse_m")
    results = [run_world(run) for run in case.runs[:4]]
    fixes = sum(one.fixes for one in results)
    assert math.sqrt(sum(one.squared_m2 for one in results) / fixes) < most_m
    assert sum(one.nees for one in results) < 3.0 * fixes
    assert sum(one.levels.exceeded.sum() for one in results) == 0


@pytest.mark.statistical
def test_one_world_of_the_room_judges_levels_beside_errors():
    plan = plan_of("joint", 1, study="room", worlds=2, seconds=3.0)
    result = run_world(room.cases(plan)[0].runs[0])
    assert result.levels.fixes.sum() == result.fixes == 5 * 200
    assert (result.levels.exceeded <= result.levels.levels).all()
    assert (result.levels.levels <= result.levels.fixes).all()
    assert len(result.levels.hpl_m) == result.levels.levels.sum()
    assert run_world(room.cases(replace(plan, method="literal"))[0].runs[0]).levels is None
