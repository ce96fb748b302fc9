"""Accuracy and stated covariance of surveys on drawn ranges (SURVEY figures 1 to 4), by Monte Carlo."""

import math

import numpy as np
import pytest
from msgspec import structs
from scipy.stats import chi2

from skyless.research.studies.surveyed_rooms import survey_layouts
from skyless.site.survey.facts import Facts, Tape
from skyless.site.survey.fit import aligned_covariance
from skyless.site.survey.problem import solve_least_squares
from skyless.site.survey.shape import align, build_problem, own_delays, usable
from skyless.site.survey.solve import run_survey
from support.drawn_ranges import drawn_ranges

pytestmark = pytest.mark.site

LAYOUTS = survey_layouts()
RUNS = 60


def aligned_error_m(layout, position_m):
    """Error after the best rigid alignment, mirror images included, shape (n, 3)."""
    errors = []
    for sign in (1.0, -1.0):
        mirrored = position_m * [1.0, sign, 1.0]
        motion, _ = align(mirrored, layout.position_m, 1.0, layout.dimensions)
        errors.append(motion.moved(mirrored) - layout.position_m)
    return min(errors, key=lambda error: float(np.sum(error**2)))


def drawn(layout, run, *, delay_std_m, pair_std_m, tapes=()):
    rng = np.random.default_rng([13, run])
    delays = dict(zip(layout.anchors, rng.normal(0.0, delay_std_m, len(layout.anchors)).tolist(), strict=True))
    ranges = drawn_ranges(layout, 10.0, rng, delays_m=delays, pair_std_m=pair_std_m)
    measured = []
    for a, b in tapes:
        distance = float(np.linalg.norm(layout.position_m[a - 1] - layout.position_m[b - 1]))
        measured.append(Tape(a, b, distance + rng.normal(0.0, 0.005)))
    facts = Facts(
        dimensions=layout.dimensions,
        heights_m=layout.heights_m,
        delay_std_m=delay_std_m,
        pair_std_m=pair_std_m,
        tapes=tuple(measured),
    )
    return ranges, facts, delays


def normalised_squares(error, covariance):
    """Squares of an error in units of its covariance, and their number."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > 1e-9 * values.max()
    return float(np.sum((vectors.T @ error)[kept] ** 2 / values[kept])), int(kept.sum())


@pytest.mark.parametrize(
    ("name", "delay_std_m", "pair_std_m", "tapes", "most_mm"),
    [
        ("lab", 0.0, 0.0, (), 0.85),
        ("room", 0.0, 0.0, (), 1.7),
        ("hall", 0.0, 0.0, (), 1.0),
        ("room", 0.15, 0.0, (), 6.0),
        ("hall", 0.15, 0.0, (), 2.2),
        ("lab", 0.15, 0.0, ((1, 5),), 4.5),
        ("lab", 0.07, 0.02, (), 54.0),
        ("room", 0.07, 0.02, (), 69.0),
        ("hall", 0.07, 0.02, (), 31.0),
    ],
)
def test_errors_are_as_large_as_stated(name, delay_std_m, pair_std_m, tapes, most_mm):
    """The stated error keeps to the figure; squares of the errors are chi-square in units of what is stated."""
    layout = LAYOUTS[name]
    everyone = np.arange(len(layout.anchors))
    squares, freedom, stated = 0.0, 0, []
    for run in range(RUNS):
        ranges, facts, _ = drawn(layout, run, delay_std_m=delay_std_m, pair_std_m=pair_std_m, tapes=tapes)
        problem, _ = build_problem(usable(ranges, facts), everyone)
        solution = solve_least_squares(problem, layout.position_m)
        core = np.ones(len(everyone), bool)
        covariance = aligned_covariance(problem, layout.position_m, core)
        error = aligned_error_m(layout, solution.position_m).ravel()
        size = len(error)
        found, count = normalised_squares(error, covariance[:size, :size])
        squares, freedom = squares + found, freedom + count
        stated.append(np.trace(covariance[:size, :size]) / len(everyone))
    # 1 in 10,000 on either side, and 3 % for what is not linear in positions.
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], freedom)
    assert 0.97 * low < squares < 1.03 * high
    assert 1e3 * math.sqrt(np.mean(stated)) < most_mm


@pytest.mark.parametrize("name", LAYOUTS)
def test_delays_are_as_good_as_stated(name):
    layout = LAYOUTS[name]
    everyone = np.arange(len(layout.anchors))
    squares = []
    for run in range(RUNS):
        ranges, facts, delays = drawn(layout, run, delay_std_m=0.07, pair_std_m=0.02)
        measured = usable(ranges, facts)
        problem, _ = build_problem(measured, everyone)
        solution = solve_least_squares(problem, layout.position_m)
        covariance = aligned_covariance(problem, layout.position_m, np.ones(len(everyone), bool))
        of_delays = covariance[3 * len(everyone) :, 3 * len(everyone) :]
        delay, std = own_delays(measured, layout.anchors, problem, solution.delay_m, of_delays)
        squares.append(np.mean((delay - list(delays.values())) ** 2 / std**2))
    # Delays of one run may share one error: each run counts as one.
    assert abs(np.mean(squares) - 1.0) < 4.0 * np.std(squares) / math.sqrt(RUNS)


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_whole_survey_states_its_error(name):
    """From ranges to positions, with starts, robust fit and frame: the bound of figure 3 holds."""
    layout = LAYOUTS[name]
    squares, freedom = 0.0, 0
    for run in range(4):
        ranges, facts, _ = drawn(layout, run, delay_std_m=0.0, pair_std_m=0.02)
        survey = run_survey(ranges, facts)
        assert survey.unchecked is None
        assert survey.not_determined == ()
        assert survey.range_std_m == 0.02
        position = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in survey.anchors])
        stated = sum(np.trace(anchor.covariance_m2) for anchor in survey.anchors)
        unknown = layout.dimensions * len(layout.anchors) - (3 if layout.dimensions == 2 else 6)
        squares += float(np.sum(aligned_error_m(layout, position) ** 2)) / stated * unknown
        freedom += unknown
    # Directions differ in variance, so that the sum has fewer effective degrees of freedom: a quarter is safe.
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], freedom / 4) / (freedom / 4)
    assert low < squares / freedom < high


@pytest.mark.parametrize(("name", "most_cm"), [("lab", 1.6), ("room", 1.6), ("hall", 1.4)])
def test_delays_of_kept_positions(name, most_cm):
    """Figure 4: hand-measured positions, ±2 cm per axis, stay; delays less their mean come from the air."""
    layout = LAYOUTS[name]
    errors, squares = [], []
    for run in range(12):
        ranges, facts, delays = drawn(layout, run, delay_std_m=0.07, pair_std_m=0.0)
        shift = np.random.default_rng([14, run]).normal(0.0, 0.02, layout.position_m.shape)
        shift[:, layout.dimensions :] = 0.0
        sketch = {
            anchor: tuple(position.tolist())
            for anchor, position in zip(layout.anchors, layout.position_m + shift, strict=True)
        }
        survey = run_survey(ranges, structs.replace(facts, sketch_m=sketch, sketch_std_m=0.02, keep_positions=True))
        assert {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in survey.anchors} == sketch
        assert {anchor.std_m for anchor in survey.anchors} == {0.02}
        error = np.array([anchor.delay_m - delays[anchor.id] for anchor in survey.anchors])
        errors.append(np.mean((error - error.mean()) ** 2))
        squares.append(np.mean(error**2) / np.mean([anchor.delay_std_m**2 for anchor in survey.anchors]))
    # The figure is an expectation: the mean of these runs may stand above it by 3 of its own standard deviations.
    slack = 3.0 * np.std(errors) / math.sqrt(len(errors))
    assert np.mean(errors) < (0.01 * most_cm) ** 2 + slack
    assert abs(np.mean(squares) - 1.0) < 4.0 * np.std(squares) / math.sqrt(len(squares))


def test_what_all_delays_share_needs_no_tape_where_ranges_suffice():
    """With 1 m in all delays, as uncorrected stamps have."""
    layout = LAYOUTS["hall"]
    ranges, facts, _ = drawn(layout, 1, delay_std_m=0.07, pair_std_m=0.02)
    expected = run_survey(ranges, facts)
    late = structs.replace(
        ranges, pairs=tuple(structs.replace(pair, range_m=pair.range_m + 2.0) for pair in ranges.pairs)
    )
    found = run_survey(late, structs.replace(facts, common_delay_std_m=1.0))
    for one, other in zip(found.anchors, expected.anchors, strict=True):
        assert one.delay_m == pytest.approx(other.delay_m + 1.0, abs=0.01)
        assert math.dist((one.x_m, one.y_m), (other.x_m, other.y_m)) < 0.02


def test_a_lab_without_a_tape_names_what_is_missing():
    """Figure 2: all anchors stand on two lines, and delays change the lines' lengths."""
    ranges, facts, _ = drawn(LAYOUTS["lab"], 0, delay_std_m=0.15, pair_std_m=0.0)
    survey = run_survey(ranges, facts)
    (sentence,) = survey.not_determined
    assert sentence.startswith(
        "ranges alone do not separate the antenna delays of anchors 1, 2, 4 and 5 from positions along "
    )
    assert "longer delays look like anchors farther apart" in sentence
    assert sentence.endswith("measure the distance between 1 and 5")
    assert survey.unchecked is not None
    assert [(tape.a, tape.b) for tape in survey.tapes] == [(1, 5), (1, 4), (2, 4)]
    best = survey.tapes[0]
    assert best.std_before_m > 5.0 * best.std_after_m
    assert math.sqrt(2.0) * best.std_after_m < 0.0045


@pytest.mark.parametrize(("name", "tapes"), [("room", [(2, 4), (2, 7), (1, 3)]), ("hall", [(4, 9), (1, 12), (1, 4)])])
def test_the_best_tapes_are_the_long_diagonals(name, tapes):
    ranges, facts, _ = drawn(LAYOUTS[name], 0, delay_std_m=0.15, pair_std_m=0.0)
    survey = run_survey(ranges, facts)
    assert survey.not_determined == ()
    assert [(tape.a, tape.b) for tape in survey.tapes] == tapes


def test_residuals_show_worse_ranges_than_assumed():
    layout = LAYOUTS["hall"]
    rng = np.random.default_rng(3)
    ranges = drawn_ranges(layout, 10.0, rng, pair_std_m=0.08)
    survey = run_survey(ranges, Facts(heights_m=layout.heights_m, delay_std_m=0.0, pair_std_m=0.02))
    # 45 checks: the estimate's standard deviation is a tenth; late ranges that are cut off take some more.
    assert 0.055 < survey.range_std_m < 0.11
