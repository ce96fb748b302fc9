"""Where one anchor may be elsewhere, the report names it, its two places, and the tape that decides."""

import re

import numpy as np
import pytest
from msgspec.structs import replace
from random_sites import draw_plant

from skyless.site.survey.facts import Facts, PairRange, PairRanges, Tape
from skyless.site.survey.solve import run_survey

pytestmark = pytest.mark.site

PLACES = re.compile(
    r"^(?P<case>.+), anchor (?P<anchor>\d+) is not at \((?P<here>[^)]+)\) but (?P<apart>[\d.]+) m away at "
    r"\((?P<there>[^)]+)\); the other anchors differ (?P<rest>.+); "
    r"the distance (?P<a>\d+)–(?P<b>\d+) decides: (?P<first>[\d.]+) m, or (?P<second>[\d.]+) m there$"
)


def plant(seed):
    """Positions, ranges and facts of a drawn plant: 28 anchors, 105 pairs, heights given."""
    drawn = draw_plant(seed)
    problem = drawn.problem
    stds_m = np.sqrt(problem.variance_m2 - 0.03**2)
    rows = zip(problem.first + 1, problem.second + 1, problem.range_m, stds_m, strict=True)
    pairs = tuple(PairRange(int(a), int(b), float(range_m), float(std_m), 5) for a, b, range_m, std_m in rows)
    heights_m = dict(enumerate(drawn.position_m[:, 2].tolist(), start=1))
    return drawn.position_m, PairRanges(pairs, tuple(range(1, 29))), Facts(heights_m=heights_m)


@pytest.mark.statistical
def test_the_one_anchor_is_named_and_the_others_that_follow_it_by_centimetres_are_not():
    _, ranges, facts = plant(0)
    survey = run_survey(ranges, facts)
    found = [PLACES.match(one.sentence) for one in survey.ambiguities]
    assert len(found) == 2
    for one, said in zip(survey.ambiguities, found, strict=True):
        assert one.anchors == (25,)
        assert said["anchor"] == "25"
        assert re.match(r"by \d\d cm at most", said["rest"])
        here, there = (np.array([float(part) for part in said[key].split(",")]) for key in ("here", "there"))
        known = survey.anchors[24]
        assert np.allclose(here, (known.x_m, known.y_m), atol=0.006)
        assert np.allclose(there, one.positions_m[25][:2], atol=0.006)
        assert abs(np.linalg.norm(here - there) - float(said["apart"])) < 0.02


@pytest.mark.statistical
def test_the_tape_that_is_named_decides_between_the_mirror_places():
    position_m, ranges, facts = plant(1)
    survey = run_survey(ranges, facts)
    mirror = next(one for one in survey.ambiguities if "mirror" in one.sentence)
    assert mirror.anchors == (28,)
    said = PLACES.match(mirror.sentence)
    a, b = int(said["a"]), int(said["b"])
    assert 28 in (a, b)
    true_m = float(np.linalg.norm(position_m[a - 1] - position_m[b - 1]))
    first_m, second_m = float(said["first"]), float(said["second"])
    assert abs(first_m - second_m) > 5.0
    assert min(abs(first_m - true_m), abs(second_m - true_m)) < 1.5
    taped = run_survey(ranges, replace(facts, tapes=(Tape(a, b, true_m),)))
    assert not any(28 in one.anchors for one in taped.ambiguities)
    at_m = {one.id: np.array([one.x_m, one.y_m, one.z_m]) for one in taped.anchors}
    assert abs(np.linalg.norm(at_m[a] - at_m[b]) - true_m) < 0.05
