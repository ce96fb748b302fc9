"""A filter that is linearised at noisy estimates must not learn what nothing measures (docs/maths.md section 6)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless import Request, fleet_of
from skyless.core.estimator.estimator import Estimator
from skyless.core.estimator.measurements import difference_terms, reception_terms
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.native.views import view
from skyless.core.site import AccuracySite
from skyless.sim.evaluation.scenarios import Room, displacements
from skyless.sim.impairments import RangeErrorModel
from skyless.sim.lab import paper_lab_site

pytestmark = pytest.mark.statistical

LAB = paper_lab_site(accuracy=AccuracySite())
"""Its site file states the typical errors of survey and ranges."""
ANCHORS_M = {
    2: np.array([[0, 0, 0], [6, 0, 0], [6, 4, 0], [6, 8, 0], [0, 8, 0], [0, 4, 0]], float),
    3: np.array([[0, 0, 0.2], [8, 0, 3], [8, 6, 0.2], [0, 6, 3], [4, 0, 3], [8, 3, 0.2], [4, 6, 3]], float),
}
NOISE_M = 0.03


def started(dim, position_m):
    """An estimator at a position, with all anchors."""
    estimator = Estimator(EstimatorSettings(height_m=0.0 if dim == 2 else None), ANCHORS_M[dim])
    estimator.start(0, position_m, NOISE_M**2 * np.eye(dim), 1e-6)
    for anchor in range(len(ANCHORS_M[dim])):
        estimator.process(anchor, 0, 1000 + anchor, 0)
    return estimator


def rows_at_noisy_estimates(dim, position_m, seed, terms_of, cases):
    """Jacobians of all measurements at forty noisy estimates of a tag at rest, shape (40·cases, states)."""
    estimator, draw = started(dim, np.array(position_m)), np.random.default_rng(seed)
    s, rows = estimator.state, []
    for _ in range(40):
        s.x[:dim] = position_m + NOISE_M * draw.uniform(-1.0, 1.0, dim)
        for case in cases:
            terms_of(s, *case)
            rows.append(np.zeros(len(s.x)))
            np.add.at(rows[-1], view(s.h_index)[: s.terms], view(s.h)[: s.terms])
    return np.array(rows)


@pytest.mark.parametrize("dim", [2, 3])
@settings(max_examples=20)
@given(st.lists(st.floats(1.5, 4.5), min_size=3, max_size=3), st.integers(0, 99))
def test_the_information_has_the_rank_of_the_model(dim, position_m, seed):
    """At rest, n anchors measure n combinations of position, clocks, errors of ranges and survey; differences n − 1."""
    count = len(ANCHORS_M[dim])
    own = rows_at_noisy_estimates(dim, position_m[:dim], seed, reception_terms, [(n, 0) for n in range(count)])
    assert np.linalg.matrix_rank(own, tol=1e-9) == count
    pairs = [(n, m) for n in range(count) for m in range(n)]
    differences = rows_at_noisy_estimates(dim, position_m[:dim], seed, difference_terms, pairs)
    assert np.linalg.matrix_rank(differences, tol=1e-9) == count - 1


def rmse_m(judged, from_s, to_s):
    errors = [np.sum((one.fix.position_m - one.truth_m) ** 2) for one in judged if from_s < one.fix.time_s <= to_s]
    return float(np.sqrt(np.mean(errors)))


@pytest.mark.parametrize("room", [None, Room()], ids=("right air", "room"))
def test_a_tag_at_rest_stays_where_it_is(room):
    site = replace(LAB, schedule=replace(LAB.schedule, slot_s=10e-3))
    request = Request(site=site, seed=3, room=room, positions_m=((1.0, 1.0), (5.0, 6.5), (3.0, 4.0)))
    judged = list(fleet_of(request).run(100.0))
    assert rmse_m(judged, 90.0, 100.0) < 1.2 * rmse_m(judged, 3.0, 13.0)


def estimator_after(request, duration_s):
    fleet = fleet_of(request)
    for _ in fleet.run(duration_s):
        pass
    return fleet.receivers[0].method.estimator


def test_multipath_is_learnt_from_the_way():
    """A field of 8 cm that changes within 10 cm; the site file states 5 mm within 1 m."""
    field = Room(ranges=RangeErrorModel(constant_m=0.05, slope_m=0.05, changing_m=0.08, correlation_m=0.1))
    std_m, distance_m = estimator_after(Request(site=LAB, seed=5, room=field), 40.0).multipath_m
    assert std_m == pytest.approx(0.08, rel=0.3)
    assert 0.04 < distance_m < 0.25


def test_no_multipath_is_learnt_in_a_room_without_any():
    assert estimator_after(Request(site=LAB, seed=5, room=Room()), 20.0).multipath_m is None


def test_a_misplaced_anchor_is_found_by_its_ranges_to_the_others():
    left_m, room = [], Room(off_anchors=1, off_m=0.3)
    for seed in range(1, 5):
        request = Request(site=LAB, seed=seed, room=room)
        estimator = estimator_after(request, 6.0)
        true_m = {one.anchor: (one.x_m, one.y_m) for one in displacements(room, request.site, request.seed)}
        s = estimator.state
        survey_m = view(s.x)[s.layout.survey : s.layout.end].reshape(-1, 2)
        found_m = dict(zip(estimator.anchors, survey_m, strict=True))
        off = max(true_m, key=lambda anchor: np.hypot(*true_m[anchor]))
        left_m.append(np.hypot(*(found_m[off] - true_m[off])))
        assert all(np.hypot(*found_m[anchor]) < 0.1 for anchor in found_m if anchor != off)
    assert np.sqrt(np.mean(np.square(left_m))) < 0.1
