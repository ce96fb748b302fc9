"""What ranges do not determine has no figures and a sentence, for every way to have too few of them."""

import math

import numpy as np
import pytest
from msgspec import structs

from skyless.research.studies.surveyed_rooms import survey_layouts
from skyless.site.survey.facts import Facts, PairRange, PairRanges, Tape
from skyless.site.survey.solve import run_survey
from support.drawn_ranges import drawn_ranges

pytestmark = pytest.mark.site

LAB = survey_layouts()["lab"]
RANGES = drawn_ranges(LAB, 10.0, np.random.default_rng(1))
SKETCH = {anchor: tuple(row) for anchor, row in zip(LAB.anchors, LAB.position_m.tolist(), strict=True)}


def among(anchors, chosen=lambda a, b: True):
    """Ranges of some anchors of the lab, and of chosen pairs of these."""
    pairs = tuple(pair for pair in RANGES.pairs if {pair.a, pair.b} <= set(anchors) and chosen(pair.a, pair.b))
    return structs.replace(RANGES, pairs=pairs, anchors=tuple(anchors))


CASES = {
    "no anchor": (PairRanges((), ()), ()),
    "one anchor": (among((3,)), ()),
    "no range": (PairRanges((), LAB.anchors), ()),
    "one range": (among((1, 2)), ()),
    "two ranges": (among((1, 2, 3), lambda a, b: b == 3), ()),
    "three on a line": (among((2, 3, 4)), ()),
    "a triangle": (among((1, 2, 4)), (1, 2, 4)),
    "a square": (among((1, 2, 4, 5)), (1, 2, 4, 5)),
    "a star": (among(LAB.anchors, lambda a, b: a == 1), ()),
    "a chain": (among(LAB.anchors, lambda a, b: b == a + 1), ()),
    "two halves": (among(LAB.anchors, lambda a, b: (a <= 3) == (b <= 3)), ()),
    "an anchor without a range": (among(LAB.anchors, lambda a, b: b != 6), (1, 2, 3, 4, 5)),
    "an anchor with one range": (among(LAB.anchors, lambda a, b: b != 6 or a == 1), (1, 2, 3, 4, 5)),
    "an anchor with two ranges": (among(LAB.anchors, lambda a, b: b != 6 or a <= 2), (1, 2, 3, 4, 5)),
    "all ranges": (RANGES, LAB.anchors),
}


@pytest.mark.parametrize("delay_std_m", [0.0, 0.07])
@pytest.mark.parametrize(("ranges", "determined"), CASES.values(), ids=CASES)
def test_only_what_is_determined_has_figures(ranges, determined, delay_std_m):
    survey = run_survey(ranges, Facts(delay_std_m=delay_std_m))
    assert tuple(anchor.id for anchor in survey.anchors) == ranges.anchors
    sentences = " ".join(survey.not_determined)
    for anchor in survey.anchors:
        figures = (anchor.x_m, anchor.y_m, anchor.z_m, anchor.std_m, anchor.delay_m, anchor.covariance_m2)
        assert anchor.determined == (anchor.id in determined)
        if anchor.determined:
            assert None not in figures
            assert anchor.std_m <= 0.25
        else:
            assert set(figures) == {None}
            assert anchor.reason
            assert str(anchor.id) in sentences
    assert bool(determined) or survey.not_determined
    determined_pairs = {(pair.a, pair.b) for pair in survey.pairs if pair.residual_m is not None}
    assert determined_pairs == {(p.a, p.b) for p in ranges.pairs if {p.a, p.b} <= set(determined)}


@pytest.mark.parametrize("dimensions", [2, 3])
def test_three_on_a_line_stay_undetermined_whatever_the_noise(dimensions):
    """Errors of the ranges put the middle one off the line, where the equations seem to hold it."""
    for seed in range(8):
        error = np.random.default_rng(seed).normal(0.0, 0.03, 3)
        pairs = [(1, 2, 4.0), (2, 3, 4.0), (1, 3, 8.0)]
        ranges = tuple(PairRange(a, b, d + e, 0.001, 100) for (a, b, d), e in zip(pairs, error, strict=True))
        survey = run_survey(PairRanges(ranges, (1, 2, 3)), Facts(dimensions=dimensions, delay_std_m=0.0))
        assert not any(anchor.determined for anchor in survey.anchors)


def test_why_and_what_to_measure():
    def sentence(name):
        return run_survey(CASES[name][0], Facts(delay_std_m=0.0)).not_determined

    assert sentence("an anchor with one range") == (
        "anchor 6 is not determined: only one range, to 1; it needs 3; measure the distances 6–2 and 6–5",
    )
    (found,) = sentence("an anchor with two ranges")
    assert found.startswith(
        "anchor 6 is not determined: only 2 ranges, to 1 and 2; it needs 3; measure the distance between 6 and "
    )
    assert sentence("two halves") == (
        "anchors 1, 2 and 3 are not determined: the group of anchors 1, 2 and 3 has too few ranges to "
        "anchors 4, 5 and 6",
        "anchors 4, 5 and 6 are not determined: the group of anchors 4, 5 and 6 has too few ranges to "
        "anchors 1, 2 and 3",
    )
    assert "on one line" in sentence("three on a line")[0]


def test_a_tape_stands_for_a_missing_range():
    ranges = CASES["an anchor with two ranges"][0]
    distance = math.dist(LAB.position_m[5], LAB.position_m[4])
    survey = run_survey(ranges, Facts(delay_std_m=0.0, tapes=(Tape(6, 5, distance),)))
    assert all(anchor.determined for anchor in survey.anchors)


def test_a_sketch_decides_between_two_positions():
    """With two ranges an anchor fits in two positions, one of which is far from the sketch."""
    ranges = CASES["an anchor with two ranges"][0]
    survey = run_survey(ranges, Facts(delay_std_m=0.0, sketch_m=SKETCH))
    assert all(anchor.determined for anchor in survey.anchors)
    assert math.dist((survey.anchors[5].x_m, survey.anchors[5].y_m), SKETCH[6][:2]) < 0.15


def test_a_sketch_determines_nothing():
    survey = run_survey(CASES["a star"][0], Facts(sketch_m=SKETCH, sketch_std_m=0.1))
    assert not any(anchor.determined for anchor in survey.anchors)


def test_a_ceiling_in_three_dimensions_has_no_heights():
    hall = survey_layouts()["hall"]
    ranges = drawn_ranges(hall, 10.0, np.random.default_rng(2))
    survey = run_survey(ranges, Facts(dimensions=3, delay_std_m=0.0))
    assert not any(anchor.determined for anchor in survey.anchors)
    assert "in one plane" in survey.not_determined[0]


def test_what_is_no_number_is_left_out_with_a_note():
    broken = [structs.replace(RANGES.pairs[0], range_m=math.nan), structs.replace(RANGES.pairs[1], range_m=math.inf)]
    ranges = structs.replace(RANGES, pairs=(*broken, *RANGES.pairs[2:], PairRange(1, 99, 5.0, 0.01, 1)))
    survey = run_survey(ranges, Facts(delay_std_m=0.0))
    assert all(anchor.determined for anchor in survey.anchors)
    assert len(survey.pairs) == 13
    assert [note for note in survey.notes if "not used" in note] == list(survey.notes)
    assert len(survey.notes) == 3


def test_kept_positions_need_ranges_and_a_sketch():
    sketch = {anchor: point for anchor, point in SKETCH.items() if anchor != 2}
    ranges = among(LAB.anchors, lambda a, b: b != 6)
    survey = run_survey(ranges, Facts(keep_positions=True, sketch_m=sketch, sketch_std_m=0.02))
    by_id = {anchor.id: anchor for anchor in survey.anchors}
    assert not by_id[2].determined
    assert by_id[2].x_m is None
    assert by_id[6].determined
    assert by_id[6].delay_m is None
    assert by_id[1].delay_std_m < 0.05
    assert len(survey.not_determined) == 2


def test_whole_numbers_are_numbers():
    survey = run_survey(RANGES, Facts(delay_std_m=0, pair_std_m=0, sketch_std_m=1))
    assert all(anchor.determined for anchor in survey.anchors)


@pytest.mark.parametrize("keep", [False, True])
def test_a_delay_far_beyond_what_is_expected_is_named(keep):
    layout = survey_layouts()["hall"]
    rng = np.random.default_rng(31)
    sketch = {anchor: tuple(row) for anchor, row in zip(layout.anchors, layout.position_m.tolist(), strict=True)}
    facts = Facts(heights_m=layout.heights_m, sketch_m=sketch, sketch_std_m=0.02, keep_positions=keep)
    usual = drawn_ranges(layout, 10.0, rng, delays_m={3: 0.1}, pair_std_m=0.02)
    assert not any("expected" in note for note in run_survey(usual, facts).notes)
    wrong = drawn_ranges(layout, 10.0, rng, delays_m={3: 0.7}, pair_std_m=0.02)
    (note,) = [note for note in run_survey(wrong, facts).notes if "expected" in note]
    assert note.startswith("the delay of anchor 3 is off by ")
