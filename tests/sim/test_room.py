"""The room: its errors are as large as it says, belong to the seed, and are what the machines do not know."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.stats import chi2

from skyless.core.site import EXACT, AccuracySite, TagsSite
from skyless.sim.evaluation.fleet import report
from skyless.sim.evaluation.scenarios import (
    Request,
    Room,
    displacements,
    fleet_of,
    impairments_of,
    room_of,
    trajectories_of,
)
from skyless.sim.impairments import RangeErrorModel
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.sim.trajectory import Roaming, Static

pytestmark = pytest.mark.site

LAB = lab_site()


def shifts_m(room, seeds, site=LAB):
    """Shape (seeds, anchors, 3)."""
    return np.array([[(one.x_m, one.y_m, one.z_m) for one in displacements(room, site, seed)] for seed in seeds])


def test_each_axis_of_a_told_position_is_off_by_its_standard_deviation():
    drawn = shifts_m(Room(), range(100))
    low, high = chi2.ppf([1e-4, 1 - 1e-4], drawn[..., :2].size) / drawn[..., :2].size
    assert low < np.mean(drawn[..., :2] ** 2) / 0.02**2 < high
    assert not drawn[..., 2].any()  # a given height is not used
    free = shifts_m(Room(0.05), range(100), replace(LAB, tags=TagsSite()))
    assert np.std(free, axis=(0, 1)) == pytest.approx([0.05] * 3, rel=4.0 / math.sqrt(2.0 * 600))


def test_some_anchors_are_off_by_far_more_in_any_direction():
    more = shifts_m(Room(off_anchors=2, off_m=0.3), range(60)) - shifts_m(Room(), range(60))
    lengths = np.linalg.norm(more, axis=2)
    assert (np.count_nonzero(lengths, axis=1) == 2).all()
    assert lengths[lengths > 0.0] == pytest.approx(0.3)
    assert np.count_nonzero(lengths, axis=0).min() > 5  # each of six anchors is drawn 20 times, give or take 4
    angles = np.arctan2(more[..., 1], more[..., 0])[lengths > 0.0]
    assert np.histogram(angles, 4, (-math.pi, math.pi))[0].min() > 10  # of 30, give or take 5


def test_a_seed_has_its_room_and_no_room_is_none():
    assert displacements(Room(), LAB, 5) == displacements(Room(), LAB, 5) != displacements(Room(), LAB, 6)
    plain, rough = (impairments_of(Request(LAB, room=room, seed=5), LAB) for room in (None, Room()))
    assert (plain.anchor_displacements, plain.range_errors) == ((), RangeErrorModel())
    assert rough.anchor_displacements == displacements(Room(), LAB, 5)
    assert rough.range_errors == RangeErrorModel(constant_m=0.05, slope_m=0.05)
    assert (rough.tx_stamp_ps, rough.oscillator.random_walk_fm) == (100.0, 1e-9)


def test_tags_of_a_room_roam_in_the_box_unless_told_where_to_be():
    """At half a metre within the anchors the box ends, three standard deviations from its middle."""
    paths = trajectories_of(Request(LAB, room=Room(), seed=3, tags=40))
    assert all(isinstance(path, Roaming) for path in paths)
    places = np.array([[path.position(float(t)) for t in range(0, 60, 5)] for path in paths])
    inside = (places[..., :2] > 0.5).all(axis=2) & (places[..., :2] < [5.5, 7.5]).all(axis=2)
    assert inside.mean() > 0.98
    assert not places[..., 2].any()
    assert np.std(places[..., :2], axis=(0, 1)) == pytest.approx([2.5 / 3.0, 3.5 / 3.0], rel=0.15)
    (alone,) = trajectories_of(Request(LAB, room=Room(), seed=3))
    assert [alone.position(float(t)).tolist() for t in range(0, 60, 5)] == places[0].tolist()
    assert isinstance(trajectories_of(Request(LAB, room=Room(), positions_m=((3.0, 4.0),)))[0], Static)


@pytest.mark.statistical
def test_the_room_costs_accuracy_and_is_the_same_for_every_method():
    """``joint`` has about 5 cm where it has 2 in clean air."""
    told = []
    for room, method in ((None, "joint"), (Room(), "joint"), (Room(), "literal")):
        asked = Request(paper_lab_site(accuracy=AccuracySite()), method=method, seed=2, tags=4, room=room, settle_s=1.5)
        fleet = fleet_of(asked)
        truths = {(one.tag, one.time_s): one.truth_m.tolist() for one in fleet.run(6.0)}
        told.append((report(fleet, method, 0.0), truths))
    clean, rough, literal = (one for one, _ in told)
    assert rough.rmse_m > 1.5 * clean.rmse_m
    assert rough.air == literal.air
    common = told[1][1].keys() & told[2][1].keys()
    assert len(common) > 1000  # of about 66 fixes for each tag and second
    assert all(told[1][1][fix] == told[2][1][fix] for fix in common)


def test_a_sites_own_errors_are_those_of_its_file_and_tags_walk_as_in_exact_air():
    anchors = tuple(replace(anchor, std_m=0.1 if anchor.id == 2 else None) for anchor in LAB.anchors)
    site = replace(LAB, anchors=anchors, accuracy=replace(LAB.accuracy, survey_std_m=0.01, range_std_m=0.04))
    rooms = [room_of(site, seed, is_named_room=False, at_rest=False) for seed in range(200)]
    drawn = np.concatenate([shifts_m(room, [seed], site) for seed, room in enumerate(rooms)])
    stds_m = np.std(drawn[..., :2], axis=(0, 2))
    assert stds_m == pytest.approx(
        [0.1 if anchor.id == 2 else 0.01 for anchor in anchors], rel=4.0 / math.sqrt(2.0 * 400)
    )
    assert {room.ranges.constant_m for room in rooms} == {math.sqrt(3.0) * 0.04}  # uniform with that deviation
    assert np.std([room.ranges.slope_m for room in rooms]) == pytest.approx(0.05, rel=4.0 / math.sqrt(2.0 * 200))
    exact, drawn_in = (trajectories_of(Request(site, room=room, seed=3)) for room in (None, rooms[0]))
    assert exact[0].position(7.0).tolist() == drawn_in[0].position(7.0).tolist()
    assert room_of(replace(LAB, accuracy=EXACT), 1, is_named_room=False, at_rest=True) is None
    assert room_of(replace(site, accuracy=EXACT), 1, is_named_room=False, at_rest=True) is not None
