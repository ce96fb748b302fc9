"""The study ``large``: a thousand anchors without a master. What its commands show is in docs/studies.md."""

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.research.studies import large
from skyless.research.studies.runner import Plan

pytestmark = pytest.mark.statistical

PLAN = Plan(seed=5, worlds=2, seconds=8.0)
CASES = {case.name: case for case in large.cases(PLAN)}


def results(name, count=2, plan=PLAN, **changes):
    case = replace(CASES[name], **changes)
    return large.row_of(plan, case, [large.run_large(case, plan, number) for number in range(count)])


def test_walking_tags_meet_the_limits():
    row = results("random instants")
    assert 0.01 < row.rmse_m < 0.03  # two tags: one standard error is about a tenth
    assert 0.4 < row.nees < 1.4
    assert row.restarts == 0
    assert row.gap_s < 0.15
    assert row.beacons_per_s > 120.0


def test_a_tag_that_drives_through_the_site_never_begins_again():
    row = results("5 m/s through the whole site", 1, seconds=60.0)
    assert row.joins > 30
    assert row.restarts == 0
    assert row.gap_s < 0.15


def test_where_more_than_24_anchors_are_in_reach_the_nearest_are_used():
    row = results("7 m apart", 1, plan=replace(PLAN, seed=31), seconds=30.0)
    assert row.max_m < 0.2  # a tag that could not confirm those that it meets was left with three, and 1.5 m off
    assert row.restarts == 0


def test_in_rooms_it_is_near_the_bound():
    row = results("room", 3)
    assert row.bound_m > 0.02
    assert 0.5 < row.ratio < 1.9  # three tags: constants of the ranges dominate, a few draws of each


def test_cold_starts_anywhere():
    row = results("cold starts", 1)
    assert row.fixes == 12
    assert row.first_fix_s <= 0.3


def test_the_same_seed_gives_the_same_numbers_wherever_it_runs():
    one, other = (large.run_large(CASES["random instants"], PLAN, 1) for _ in range(2))
    assert one.fixes == other.fixes
    np.testing.assert_array_equal(one.errors_m, other.errors_m)
