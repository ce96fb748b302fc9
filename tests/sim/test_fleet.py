"""Simulated fleets against the statistics that theory gives them, with fixed seeds and bounds of four sigma."""

import math
from functools import partial

import numpy as np
import pytest
from msgspec.structs import asdict, replace

from skyless.core.any_receiver import AnyReceiver
from skyless.core.errors import SkylessError
from skyless.sim.evaluation.fleet import report
from skyless.sim.evaluation.scenarios import Request, fleet_of, trajectories_of
from skyless.sim.impairments import AnchorOutage, Outage
from skyless.sim.lab import paper_lab_site

pytestmark = pytest.mark.site

LAB = paper_lab_site()
P1 = (3.0, 4.0)
SEEDS = (1, 2, 3)
C = 299_792_458.0
TICK_S = 1.0 / (128 * 499.2e6)


def run(until_s, **request):
    """A fleet that ran, its report, and everything it judged after the warm-up."""
    asked = Request(LAB, **({"positions_m": (P1,)} | request))
    fleet = fleet_of(asked)
    judged = [one for one in fleet.run(until_s) if one.time_s >= asked.settle_s]
    return fleet, report(fleet, asked.method, 0.0), judged


def relative_std_of_rmse(judged, correlation):
    """Of independent plane errors with eigenvalues a, b: Var(e²)/E(e²)² = 2(a² + b²)/(a + b)², halved for the root.

    ``correlation``: factor on the variance of the mean from the correlation of neighbours.
    """
    a, b = np.linalg.eigvalsh(np.mean([one.fix.covariance_m2[:2, :2] for one in judged], axis=0))
    return math.sqrt(2.0 * (a * a + b * b) / (a + b) ** 2 * correlation / len(judged)) / 2.0


def theory(delayed, weighted):
    """Standard deviation at P1 by the maths, section 2: Σ with μ = 0, κ_k = k/6, and the estimate's own gain."""
    places = np.array([(a.x_m, a.y_m) for a in LAB.anchors])
    kappa = np.arange(1, 6) / 6.0
    q = (1.0 - kappa) ** 2 + kappa**2 if delayed else (1.0 + kappa) ** 2 + kappa**2
    transmit, receive = 100e-12**2, 100e-12**2 + TICK_S**2 / 12.0
    sigma = C**2 * (receive * np.ones((5, 5)) + np.diag(q * receive + q * transmit + receive))
    away = np.array(P1) - places
    away /= np.linalg.norm(away, axis=1)[:, None]
    design = away[1:] - away[0]
    weight = np.linalg.inv(sigma) if weighted else np.eye(5)
    gain = np.linalg.inv(design.T @ weight @ design) @ design.T @ weight
    return math.sqrt(np.trace(gain @ sigma @ gain.T))


@pytest.mark.parametrize(
    ("method", "delayed", "weighted"),
    [("literal", False, False), ("literal-delayed", True, False), ("weighted", False, True), ("bracketed", True, True)],
)
@pytest.mark.statistical
def test_snapshots_err_as_the_propagated_covariance_says(method, delayed, weighted):
    """3000 fixes at 100 ps. Neighbouring fixes share a frame of each node; their squared errors correlate by < 0.1."""
    runs = [run(16.0, method=method, seed=seed, settle_s=1.0) for seed in SEEDS]
    judged = [one for _, _, ones in runs for one in ones]
    assert len(judged) >= 2990
    rmse_m = math.sqrt(np.mean([np.sum(one.error_m**2) for one in judged]))
    sigma_m = math.sqrt(np.mean([np.trace(one.fix.covariance_m2) for one in judged]))
    expected_m = theory(delayed, weighted)
    tolerance = 4.0 * relative_std_of_rmse(judged, 1.2)
    assert tolerance < 0.055
    assert sigma_m == pytest.approx(expected_m, rel=5e-3)  # the fixes linearise at their own positions
    assert rmse_m == pytest.approx(expected_m, rel=tolerance)
    per_dimension = np.mean(
        [one.error_m[:2] @ np.linalg.solve(one.fix.covariance_m2[:2, :2], one.error_m[:2]) / 2 for one in judged]
    )
    # A mean of squared normals over 6000 components, correlated as above: one sigma is √(2·1.2/6000) = 0.02.
    assert per_dimension == pytest.approx(1.0, abs=0.08)


@pytest.mark.statistical
def test_chi2_of_weighted_fixes_is_chi2():
    """Mean over degrees of freedom (3 each); one sigma of 1000 correlated fixes is √(2·1.2/3000) = 0.028."""
    judged = run(16.0, method="weighted", seed=4, settle_s=1.0)[2]
    assert {one.fix.dof for one in judged} == {3}
    assert np.mean([one.fix.chi2 / one.fix.dof for one in judged]) == pytest.approx(1.0, abs=4 * 0.028)


@pytest.mark.statistical
def test_joint_keeps_a_centimetre_and_a_half():
    """1.33 cm (docs/maths.md). Errors last about 0.3 s: 5 runs of 10 s are 170 independent ones, 4.5 % per sigma."""
    reports = [run(12.0, seed=seed, method="joint")[1] for seed in (11, 12, 13, 14, 15)]
    rmse_m = math.sqrt(np.mean([one.rmse_m**2 for one in reports]))
    assert 0.8 * 0.0133 < rmse_m < 0.0133 * (1.0 + 3 * 0.045)
    assert all(one.max_m < 0.08 for one in reports)
    assert all(one.first_fix_s < 0.15 for one in reports)


@pytest.mark.statistical
def test_joint_is_not_over_confident():
    """Static, with an agility near the truth: at most 1.3 times the variance it claims; with agility to spare, less."""
    for qa, low, high in ((1e-2, 0.6, 1.3), (0.3, 0.5, 1.1)):
        squares = [
            one.error_m[:2] @ np.linalg.solve(one.fix.covariance_m2[:2, :2], one.error_m[:2]) / 2
            for seed in (0, 1, 2, 3)
            for one in run(10.0, seed=seed, new_receiver=partial(AnyReceiver, qa=qa))[2][::20]
        ]
        assert low < np.mean(squares) < high


@pytest.mark.statistical
def test_the_same_seed_gives_the_same_report():
    def facts(seed):
        return {k: v for k, v in asdict(run(4.0, seed=seed, method="joint")[1]).items() if k not in {"wall_s", "speed"}}

    assert facts(5) == facts(5)
    assert facts(5) != facts(6)


@pytest.mark.parametrize("method", ["weighted", "joint"])
def test_another_tag_changes_nothing_for_the_first(method):
    alone = run(3.0, method=method)[2]
    together = [one for one in run(3.0, method=method, positions_m=(P1, (1.2, 1.6)))[2] if one.tag == 0]
    assert [(one.time_s, *one.fix.position_m) for one in alone] == [(o.time_s, *o.fix.position_m) for o in together]


@pytest.mark.statistical
def test_half_of_the_messages_lost():
    """It costs joint a quarter; snapshots, which need whole rounds, hardly exist."""
    whole = [run(10.0, seed=seed)[1] for seed in (1, 2, 3, 4)]
    half = [run(10.0, seed=seed, loss=0.5)[1] for seed in (1, 2, 3, 4)]
    ratio = math.sqrt(sum(h.rmse_m**2 for h in half) / sum(w.rmse_m**2 for w in whole))
    # Both are means over some 100 independent errors: 6 % each.
    assert 1.25 * (1 - 0.25) < ratio < 1.25 * (1 + 0.25)
    for one in half:
        expected = 0.5 * sum(one.air.at_tags.values())
        assert one.messages == pytest.approx(expected, abs=4 * math.sqrt(expected / 2))
        assert one.drops.get("outlier", 0) < 0.01 * one.messages
    literal, full = run(10.0, method="literal", loss=0.5)[1], run(10.0, method="literal")[1]
    assert literal.fixes < 0.1 * full.fixes
    assert literal.rmse_m is None or literal.rmse_m < 1.0


def test_a_silent_site_gives_an_empty_report():
    fleet, summary, judged = run(1.0, outages=tuple(AnchorOutage(anchor, Outage(0.0)) for anchor in range(1, 7)))
    assert judged == []
    assert (summary.fixes, summary.rmse_m, summary.sigma_m, summary.first_fix_s) == (0, None, None, None)
    assert summary.tags_without_fix == 1
    assert summary.updates_per_s == 0.0
    assert fleet.drops == {}


def test_two_frames_per_superframe_give_twice_the_fixes():
    """The paper's pair in every superframe, end to end in every method."""
    pairs = replace(LAB, schedule=replace(LAB.schedule, frames_per_node=2))
    for method in ("literal", "literal-delayed", "weighted", "bracketed", "joint"):
        fleet = fleet_of(Request(pairs, method=method, positions_m=(P1,)))
        errors = [np.linalg.norm(one.error_m) / one.fix.std_m for one in fleet.run(2.0)]
        rate = 400 if method == "joint" else 2 / 30e-3
        assert len(errors) == pytest.approx(rate * 1.9, rel=0.05)
        assert max(errors) < 6.0
        assert set(fleet.drops) <= {"no-position"}  # before the almanac is complete


@pytest.mark.parametrize("anchors", [LAB.anchors[:1], LAB.anchors[:2]])
def test_tags_find_room_to_walk_where_anchors_span_none(anchors):
    """Around a point, or along a line: a metre each way, and no search without an end."""
    (path,) = trajectories_of(Request(replace(LAB, anchors=anchors)))
    places = np.array([path.position(0.5 * step) for step in range(60)])
    assert np.all(np.ptp(places, axis=0)[:2] > 0.25)
    assert np.all(np.abs(places[:, 1]) <= 0.5)
    assert np.all(places[:, 2] == 0.0)


def test_a_path_that_ends_where_it_began_is_walked_round_and_round():
    """A square of 4 m at 1 m/s: laps of 16 s; corners of 1 s cut off an eighth of a metre along both of their legs."""
    square = ((1.0, 1.0), (5.0, 1.0), (5.0, 5.0), (1.0, 5.0), (1.0, 1.0))
    closed, again = trajectories_of(Request(LAB, paths_m=(square, square[:4])))
    for lap_s in (0.0, 16.0, 160.0):
        assert closed.position(lap_s + 3.0) == pytest.approx((3.5, 1.0, 0.0))  # half a corner late since the start
        assert closed.position(lap_s + 4.5) == pytest.approx((4.875, 1.125, 0.0))
    assert again.position(40.0) == pytest.approx((1.0, 5.0, 0.0))
    assert again.velocity(40.0) == pytest.approx(np.zeros(3))


def test_paths_without_heights_lie_at_the_height_of_the_tags():
    raised = replace(LAB, tags=replace(LAB.tags, height_m=1.2))
    flat, slope = trajectories_of(
        Request(raised, paths_m=(((1.0, 1.0), (2.0, 1.0)), ((1.0, 1.0, 0.0), (1.0, 1.0, 2.0))))
    )
    assert flat.position(0.7)[2] == 1.2
    assert slope.position(60.0)[2] == 2.0


@pytest.mark.parametrize("point", [(), (3,), (1.0, 2.0, 3.0, 4.0), (1.0, math.nan)])
def test_a_position_has_two_or_three_coordinates(point):
    for wrong in ({"positions_m": (point,)}, {"paths_m": (((1.0, 1.0), point),)}):
        with pytest.raises(SkylessError, match=r"(positions|paths)_m\["):
            fleet_of(Request(paper_lab_site(), **wrong))
