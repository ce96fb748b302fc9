"""Values that cannot be: each is named in a note, counted, or refused with an error that names it."""

import itertools
import math

import pytest
from msgspec import structs

from skyless.core.errors import SkylessError
from skyless.site.survey.facts import Facts, Gauge, PairRange, PairRanges, Tape
from skyless.site.survey.legs import mean_ranges
from skyless.site.survey.pair_ranger import PairRanger
from skyless.site.survey.solve import run_survey

pytestmark = pytest.mark.site

POSITIONS_M = {1: (0.0, 0.0, 0.0), 2: (6.0, 0.0, 0.0), 3: (6.0, 5.0, 0.0), 4: (0.0, 5.0, 0.0), 5: (3.0, 2.0, 0.0)}
PAIRS = tuple(
    PairRange(a, b, math.dist(POSITIONS_M[a], POSITIONS_M[b]), 0.01, 10)
    for a, b in itertools.combinations(range(1, 6), 2)
)
RANGES = PairRanges(PAIRS, tuple(POSITIONS_M))
POSITIONS_GIVEN = [{}, {"keep_positions": True, "sketch_m": POSITIONS_M}]


@pytest.mark.parametrize("positions", POSITIONS_GIVEN, ids=["all", "delays"])
@pytest.mark.parametrize(
    ("facts", "note"),
    [
        ({"tapes": (Tape(1, 3, 7.81, math.nan),)}, "the measured distance of anchors 1 and 3 is not a possible figure"),
        ({"tapes": (Tape(1, 3, 1e9),)}, "the measured distance of anchors 1 and 3 is not a possible figure"),
        ({"points": {1: (math.nan, 0.0, 0.0)}}, "the point of anchor 1 is not a possible figure"),
        ({"heights_m": {1: math.inf}}, "the height of anchor 1 is not a possible figure"),
    ],
)
def test_facts_that_cannot_be_are_named_and_not_used(positions, facts, note):
    survey = run_survey(RANGES, Facts(**positions, **facts))
    assert any(one.startswith(note) and one.endswith("not used") for one in survey.notes)
    without = run_survey(RANGES, Facts(**positions))
    assert [one.x_m for one in survey.anchors] == [one.x_m for one in without.anchors]


def test_facts_of_other_anchors_are_named_and_not_used():
    """A site's facts may be older than its list of anchors."""
    facts = Facts(heights_m={1: 2.0, 9: 3.0}, tapes=(Tape(1, 9, 3.0),), points={8: (0.0, 0.0, None)}, gauge=Gauge(1, 9))
    survey = run_survey(RANGES, facts)
    for words in ("1 and 9 fits no pair", "anchor 8, which", "anchor 9, which", "anchor 9 has"):
        assert any(words in note for note in survey.notes), words
    assert all(one.determined for one in survey.anchors)


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0])
@pytest.mark.parametrize("name", ["height_std_m", "sketch_std_m", "delay_std_m", "common_delay_std_m", "pair_std_m"])
def test_standard_deviations_that_cannot_be_are_refused_by_name(name, value):
    with pytest.raises(SkylessError, match=f"{name} is {value}"):
        run_survey(RANGES, Facts(**{name: value}))


@pytest.mark.parametrize("positions", POSITIONS_GIVEN, ids=["all", "delays"])
@pytest.mark.parametrize("figure", [{"range_m": 1e200}, {"std_m": 1e200}, {"late_share": 2.0}, {"range_m": math.nan}])
def test_a_range_that_cannot_be_is_not_used(positions, figure):
    """The largest of them let the fit run for ever."""
    ranges = structs.replace(RANGES, pairs=(structs.replace(PAIRS[0], **figure), *PAIRS[1:]))
    survey = run_survey(ranges, Facts(**positions))
    assert "the range of anchors 1 and 2 is not a possible figure: not used" in survey.notes
    assert all(one.determined for one in survey.anchors)


def test_an_exact_sketch_and_anchors_named_twice():
    ranges = structs.replace(RANGES, anchors=(1, *RANGES.anchors))
    survey = run_survey(ranges, Facts(sketch_m=POSITIONS_M, sketch_std_m=0.0))
    assert [one.id for one in survey.anchors] == [1, 2, 3, 4, 5]


def test_ranges_that_are_not_finite_are_left_out_of_means():
    ranges = mean_ranges({(1, 2): [math.nan, 3.0, 3.0, 3.0], (1, 3): [], (2, 3): [math.inf] * 6})
    assert [(pair.a, pair.b, pair.exchanges) for pair in ranges.pairs] == [(1, 2, 3)]
    assert ranges.anchors == (1, 2, 3)
    assert math.isfinite(ranges.pairs[0].std_m)


def test_stamps_that_no_counter_has_are_counted():
    ranger = PairRanger()
    ranger.add(1, 2, 5, 1 << 70, 1.0)
    ranger.add(2, 1, 50, 60, math.nan)
    ranger.finish()
    assert ranger.counters["unusable"] == 2
