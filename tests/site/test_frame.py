"""Frames of surveys: named axes, points, the sketch; and that no frame, order or name of anchors changes a shape."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs

from skyless.research.studies.surveyed_rooms import SurveyLayout, survey_layouts
from skyless.site.survey.facts import Facts, Gauge, PairRange, PairRanges
from skyless.site.survey.shape import align, axes_through
from skyless.site.survey.solve import run_survey
from support.drawn_ranges import drawn_ranges

pytestmark = pytest.mark.site

LAB = survey_layouts()["lab"]
ROOM = survey_layouts()["room"]
KNOWN = Facts(delay_std_m=0.0, pair_std_m=0.0)
RANGES = drawn_ranges(LAB, 10.0, np.random.default_rng(4))
TRUTH = {anchor: tuple(row) for anchor, row in zip(LAB.anchors, LAB.position_m.tolist(), strict=True)}


def positions(survey):
    return {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in survey.anchors}


def assert_near(found, expected, most_m):
    assert found.keys() == expected.keys()
    assert max(math.dist(found[anchor], expected[anchor]) for anchor in found) < most_m


def test_named_axes():
    survey = run_survey(RANGES, structs.replace(KNOWN, gauge=Gauge(1, 2, 5)))
    assert_near(positions(survey), TRUTH, 0.005)
    origin, x_axis = survey.anchors[0], survey.anchors[1]
    assert max(abs(value) for value in (origin.x_m, origin.y_m, x_axis.y_m)) < 1e-9
    assert survey.gauge == Gauge(1, 2, 5)
    mirrored = run_survey(RANGES, structs.replace(KNOWN, gauge=Gauge(2, 1, 4)))
    assert_near(positions(mirrored), {anchor: (6.0 - x, y, z) for anchor, (x, y, z) in TRUTH.items()}, 0.005)


def test_a_near_anchor_names_the_x_axis_badly():
    survey = run_survey(RANGES, structs.replace(KNOWN, gauge=Gauge(1, 6)))
    (note,) = survey.notes
    assert "choose anchor 4, 10.0 m away" in note
    assert "mirror image" in survey.frame


def test_a_frame_needs_anchors_that_are_determined():
    for gauge in (Gauge(1, 99, 2), Gauge(1, 1, 2)):
        survey = run_survey(RANGES, structs.replace(KNOWN, gauge=gauge))
        assert survey.gauge == Gauge(1, 4, 2)
        assert "the frame cannot be defined by" in survey.notes[0]


def test_without_a_frame_the_first_and_the_farthest_anchor_name_it():
    survey = run_survey(RANGES, KNOWN)
    found = positions(survey)
    assert survey.gauge == Gauge(1, 4, 2)
    assert "mirror image" in survey.frame
    assert max(abs(value) for value in (*found[1], found[4][1])) < 1e-9
    assert found[4][0] == pytest.approx(10.0, abs=0.005)
    assert found[2][1] > 0.0


def test_points_name_the_frame_and_a_wrong_one_bends_nothing():
    survey = run_survey(RANGES, structs.replace(KNOWN, points=TRUTH))
    assert_near(positions(survey), TRUTH, 0.005)
    assert survey.notes == ()
    wrong = {**TRUTH, 3: (6.25, 4.32, 0.0)}
    survey = run_survey(RANGES, structs.replace(KNOWN, points=wrong))
    assert_near(positions(survey), TRUTH, 0.005)
    (note,) = survey.notes
    assert note.startswith("the point of anchor 3 does not fit the ranges by 0.4")
    assert note.endswith("has the anchor moved, or is the point mistyped?")


def test_two_points_leave_the_mirror_image_and_a_sketch_decides():
    points = {1: TRUTH[1], 4: TRUTH[4]}
    survey = run_survey(RANGES, structs.replace(KNOWN, points=points))
    assert "mirror image" in survey.frame
    found = positions(survey)
    assert_near({anchor: found[anchor] for anchor in points}, points, 0.005)
    sketch = {anchor: (x + 0.2 * (-1) ** anchor, y - 0.1, z) for anchor, (x, y, z) in TRUTH.items()}
    survey = run_survey(RANGES, structs.replace(KNOWN, points=points, sketch_m=sketch))
    assert_near(positions(survey), TRUTH, 0.01)
    assert "mirror" not in survey.frame


def test_two_points_that_contradict_each_other():
    survey = run_survey(RANGES, structs.replace(KNOWN, points={1: TRUTH[1], 4: (6.3, 8.4, 0.0)}))
    assert "anchors 1 and 4 are 10.50 m apart, but 10.00 m by the ranges" in survey.notes[0]


def test_a_sketch_is_fitted_not_followed():
    rng = np.random.default_rng(5)
    turned = np.array([[math.cos(2.0), -math.sin(2.0)], [math.sin(2.0), math.cos(2.0)]])
    there = np.array(list(TRUTH.values()))[:, :2] @ turned.T + [30.0, -7.0]
    rough = there + rng.normal(0.0, 0.3, there.shape)
    sketch = {anchor: (*row, None) for anchor, row in zip(TRUTH, rough.tolist(), strict=True)}
    survey = run_survey(RANGES, structs.replace(KNOWN, sketch_m=sketch))
    found = np.array(list(positions(survey).values()))
    # The frame is as good as the sketch: 0.3 m over the root of six anchors, and twice that at the edges.
    assert np.abs(found[:, :2] - there).max() < 4.0 * 0.3 / math.sqrt(6.0)
    distances = np.linalg.norm(found[:, None] - found[None], axis=2)
    true_m = np.linalg.norm(LAB.position_m[:, None] - LAB.position_m[None], axis=2)
    assert np.abs(distances - true_m).max() < 0.01


def test_heights_level_a_room():
    ranges = drawn_ranges(ROOM, 10.0, np.random.default_rng(6))
    heights = dict(zip(ROOM.anchors, ROOM.position_m[:, 2].tolist(), strict=True))
    facts = Facts(dimensions=3, delay_std_m=0.0, pair_std_m=0.0, heights_m=heights, height_std_m=0.005)
    survey = run_survey(ranges, structs.replace(facts, gauge=Gauge(1, 3, 4)))
    found = positions(survey)
    assert max(abs(found[anchor][2] - heights[anchor]) for anchor in heights) < 0.02
    apart = ROOM.position_m[2] - ROOM.position_m[0]
    assert found[3][0] == pytest.approx(math.hypot(apart[0], apart[1]), abs=0.02)
    unlevelled = run_survey(ranges, Facts(dimensions=3, delay_std_m=0.0, pair_std_m=0.0))
    assert "heights of three anchors" in unlevelled.notes[0]
    assert all(anchor.determined for anchor in unlevelled.anchors)


@given(
    turn=st.floats(0.0, 6.28),
    x=st.floats(-100.0, 100.0),
    y=st.floats(-100.0, 100.0),
    mirror=st.sampled_from([1.0, -1.0]),
)
def test_alignment_undoes_a_motion(turn, x, y, mirror):
    rotation = np.array(
        [[math.cos(turn), -math.sin(turn), 0.0], [math.sin(turn), math.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    )
    position = survey_layouts()["hall"].position_m
    other = position * [1.0, mirror, 1.0] @ rotation.T + [x, y, 0.0]
    motion, mirror_decided = align(position, other, 0.1, 2)
    assert mirror_decided
    np.testing.assert_allclose(motion.moved(position), other, atol=1e-9)
    axes = axes_through(other, np.ones(len(other), bool), 2, 0, 3, 8)
    again = axes_through(position, np.ones(len(other), bool), 2, 0, 3, 8)
    np.testing.assert_allclose(axes.motion.moved(other), again.motion.moved(position), atol=1e-9)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 1000), order=st.permutations(range(6)))
def test_order_and_names_of_anchors_change_nothing(seed, order):
    """Renamed anchors, in another order, have the same shape and the same stated errors."""
    layout = SurveyLayout("drawn", 2, np.random.default_rng(seed).uniform(0.0, 12.0, (6, 3)) * [1.0, 1.0, 0.0], 0.0)
    ranges = drawn_ranges(layout, 10.0, np.random.default_rng(seed), pair_std_m=0.02)
    names = {anchor: 10 + order[anchor - 1] for anchor in layout.anchors}
    renamed = []
    for pair in reversed(ranges.pairs):
        a, b = sorted((names[pair.a], names[pair.b]))
        renamed.append(PairRange(a, b, pair.range_m, pair.std_m, pair.exchanges))
    tx_std_m = {names[anchor]: std for anchor, std in ranges.tx_std_m.items()}
    facts = Facts(delay_std_m=0.0, pair_std_m=0.02)
    first = run_survey(ranges, facts)
    second = run_survey(PairRanges(tuple(renamed), tuple(sorted(names.values())), tx_std_m), facts)
    others = {anchor.id: anchor for anchor in second.anchors}
    for anchor in first.anchors:
        assert anchor.determined == others[names[anchor.id]].determined
        if anchor.determined:
            assert anchor.std_m == pytest.approx(others[names[anchor.id]].std_m, rel=1e-3)
    residuals = {(pair.a, pair.b): pair.residual_m for pair in second.pairs}
    for pair in first.pairs:
        a, b = sorted((names[pair.a], names[pair.b]))
        assert (pair.residual_m is None) == (residuals[a, b] is None)
        if pair.residual_m is not None:
            assert pair.residual_m == pytest.approx(residuals[a, b], abs=1e-4)
