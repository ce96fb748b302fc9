"""The study ``survey-room`` with a few short worlds, and the truth of its rooms."""

import numpy as np
import pytest

from skyless.core.ticks import TICK_M
from skyless.research.studies import surveyed_rooms as study
from skyless.research.studies.run import STUDIES
from skyless.research.studies.runner import Plan
from skyless.research.studies.surveyed_rooms import (
    ROOM_RANGES,
    SURVEYED,
    TRUTH,
    Group,
    RoomErrors,
    air_of,
    drawn_room,
    groups,
    hand_site,
    limits_of,
    ranges_of,
    survey_layouts,
    surveyed_room,
    true_site,
)

pytestmark = pytest.mark.site

ERRORS = RoomErrors(0.07, 0.02, ROOM_RANGES)


def one_way_m(room, site):
    """What a range between two anchors is longer than a file lets expect, half for each, less errors of pairs."""
    return np.array([(one.tx_ticks + one.rx_ticks) / 2.0 * TICK_M for one in air_of(room, site).delay_errors])


@pytest.mark.parametrize("name", ["lab", "room"])
def test_whoever_writes_the_file_the_truth_is_the_same(name):
    layout = survey_layouts()[name]
    room = drawn_room(layout, ERRORS, 100.0, 3)
    for site in (true_site(room), hand_site(room)):
        stated_m = np.array([(one.x_m, one.y_m, one.z_m) for one in site.anchors])
        off_m = np.array([(one.x_m, one.y_m, one.z_m) for one in air_of(room, site).anchor_displacements])
        assert stated_m + off_m == pytest.approx(layout.position_m)
    assert np.abs(one_way_m(room, true_site(room))).max() < TICK_M
    assert one_way_m(room, hand_site(room)) == pytest.approx((room.tx_delay_m + room.rx_delay_m) / 2.0)


def test_a_taped_survey_through_the_air_finds_positions_and_delays():
    """By noise alone the lab is known to 1.9 mm after 2 s, if delays are known."""
    room = drawn_room(survey_layouts()["lab"], RoomErrors(delay_std_m=0.07), 100.0, 5)
    ranges = ranges_of(room, 2.0)
    exact = drawn_room(survey_layouts()["lab"], RoomErrors(), 100.0, 5)
    known = surveyed_room(exact, ranges_of(exact, 2.0), is_exact=True)
    off_m = np.array([(one.x_m, one.y_m) for one in air_of(exact, known).anchor_displacements])
    assert np.sqrt(np.mean(np.sum(off_m**2, axis=1))) < 0.006
    assert known.accuracy.survey_std_m < 0.005
    assert known.accuracy.range_std_m == 0.0
    left_m = one_way_m(room, surveyed_room(room, ranges, with_tape=True))
    assert np.std(left_m) < np.std(one_way_m(room, hand_site(room)))


@pytest.mark.statistical
def test_rows_of_few_worlds(monkeypatch):
    small = (Group("lab, at rest", "lab", at_rest=True), Group("lab, room", "lab", ERRORS, (TRUTH, SURVEYED)))
    monkeypatch.setattr(study, "groups", lambda: small)
    chosen, plan = STUDIES["survey-room"], Plan(worlds=2, seconds=1.0, tags=2, seed=5, quick=True)
    cells = chosen.cells(plan)
    assert [cell.name for cell in cells] == ["lab, at rest"] * 2 + ["lab, room"] * 2
    rows = chosen.rows(plan, [cell.function() for cell in cells])
    assert [row.case for row in rows] == [f"{group.name}, {file}" for group in small for file in (TRUTH, SURVEYED)]
    still, still_surveyed, truth, surveyed = rows
    assert still.ratio is None
    assert still_surveyed.ratio == pytest.approx(1.0, abs=0.05)
    assert truth.fixes == surveyed.fixes > 200
    assert truth.rmse_m < 0.15  # of four tags: which of both is better is chance
    assert surveyed.rmse_m < 0.15
    assert surveyed.exceeded == 0.0


def test_limits():
    assert {file for group in groups() for file in group.files if limits_of(group, file)} == {
        "surveyed",
        "surveyed, a tape",
        "positions kept",
    }
