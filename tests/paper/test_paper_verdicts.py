"""The verdicts of ``skyless paper`` follow from their numbers, its theory from closed forms and published figures."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.research.paper import _checks as checks
from skyless.research.paper import _claim as claim
from skyless.research.paper import _distributions as distributions
from skyless.research.paper import _dop_map as dop_map
from skyless.research.paper import _rate as rate
from skyless.research.paper import _scale as scale
from skyless.research.paper import _scenario as scenario
from skyless.research.paper import _static as static
from skyless.research.paper import _timeline as timeline
from skyless.research.paper import _walk as walk
from skyless.research.paper._checks import PaperCheck
from skyless.research.paper._distributions import LambdaDistribution
from skyless.research.paper.plan import P1, P2, Verdict, plan_of
from skyless.sim.evaluation.scenarios import Request, fleet_of
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.site.report import inline_svg

pytestmark = pytest.mark.site

HOLDS, CORRECTED, FAILS = Verdict.HOLDS, Verdict.CORRECTED, Verdict.FAILS


def check(printed_pct, corrected_pct, quantity="gamma_first"):
    return PaperCheck(
        f"gaussian/{quantity}/anchor 1", "gaussian", quantity, 1, printed_pct, corrected_pct, 0.05, 0.3, 10**6
    )


@pytest.mark.parametrize(
    ("found", "verdict"),
    [
        ([check(0.04, 0.04)], HOLDS),
        ([check(30.0, 0.04), check(0.03, 0.03, "beta")], CORRECTED),
        ([check(None, 0.04), check(40.0, 0.02)], CORRECTED),
        ([check(30.0, 2.0)], FAILS),
    ],
)
def test_gamma_holds_only_if_the_draws_agree(found, verdict):
    assert checks.judge(tuple(found))[0] is verdict


def distribution(corrected_std_m, noise="uniform"):
    edges = np.linspace(-5.0, 5.0, 11)
    return LambdaDistribution(noise, edges, np.ones(10, np.int64), 1.0, corrected_std_m, 1.5, 10)


def test_uniform_stamps_are_told_by_their_deviation():
    gaussian = replace(distribution(1.0, "gaussian"), draws=10**6)
    assert distributions.judge(gaussian, replace(distribution(1.001), draws=10**6))[0] is FAILS
    assert distributions.judge(gaussian, replace(distribution(1.05), draws=10**6))[0] is HOLDS


def test_distance_of_shapes_is_that_of_the_normal_law():
    """Draws that all lie in one bin differ from a Gaussian by what the Gaussian has elsewhere."""
    edges = np.array([-10.0, -1.0, 1.0, 10.0])
    one = LambdaDistribution("gaussian", edges, np.array([0, 100, 0]), 1.0, 1.0, None, 100)
    assert distributions.shape_distance(one) == pytest.approx(1.0 - math.erf(1.0 / math.sqrt(2.0)), rel=1e-9)


def moments(mean_sigmas, skewness=0.0, excess=0.0):
    return static.Moments(30_000, mean_sigmas * 1e-4, 1e-4, 0.04, skewness, excess)


@pytest.mark.parametrize(
    ("noise_only", "biased", "verdict"),
    [
        (moments(1.0), moments(100.0), CORRECTED),
        (moments(9.0), moments(100.0), HOLDS),
        (moments(1.0), moments(2.0), FAILS),
        (moments(1.0, skewness=0.4), moments(100.0), FAILS),
        (moments(1.0, excess=0.9), moments(100.0), FAILS),
    ],
)
def test_means_are_asked_of_noise_and_of_biases(noise_only, biased, verdict):
    assert static.judge([noise_only], [biased])[0] is verdict


def test_other_verdicts_follow_their_numbers():
    assert [walk.judge(p, f)[0] for p, f in ((0.9, 0.95), (0.4, 0.95), (0.4, 0.5))] == [HOLDS, CORRECTED, FAILS]
    assert [dop_map.judge(c, a)[0] for c, a in ((0.95, 0.02), (0.95, 0.3), (-0.2, 0.3))] == [HOLDS, CORRECTED, FAILS]
    assert [timeline.judge(3, 3, f, 100)[0] for f in (100, 90)] == [HOLDS, FAILS]
    assert [rate.judge(hz, 400.0)[0] for hz in (66.7, 60.0)] == [HOLDS, FAILS]
    limits = [claim.judge({"literal": ps, "joint": 2 * ps})[0] for ps in (160.0, 101.0, 12.0)]
    assert limits == [HOLDS, CORRECTED, FAILS]
    alone = {"sent": 400, "senders": 6, "heard_by_tags": 400}
    assert scenario.judge(alone, {**alone, "heard_by_tags": 800}, 2)[0] is HOLDS
    assert scenario.judge(alone, {**alone, "sent": 402, "heard_by_tags": 800}, 2)[0] is FAILS


def test_scaling_holds_only_if_nothing_changes():
    one = scale.summarise(np.array([0.04]), np.array([240]), 240, "same", 0.1)
    many = scale.summarise(np.array([0.04] * 5), np.array([240] * 5), 240, "same", 0.5)
    assert scale.judge([one, many])[0] is HOLDS
    assert scale.judge([one, replace(many, fewest_fixes_per_s=200.0)])[0] is CORRECTED
    assert scale.judge([one, replace(many, first_tag="other")])[0] is FAILS
    assert scale.judge([one, replace(many, frames_per_s=500.0)])[0] is FAILS
    assert scale.judge([one, replace(many, fewest_heard_per_s=300.0)])[0] is FAILS


def test_the_largest_of_many_round_errors_is_that_of_the_rayleigh_law():
    for count, quantile in ((1, 0.5), (30_000, 0.05), (30_000, 0.95)):
        closed = 0.02 * math.sqrt(-2.0 * math.log(1.0 - quantile ** (1.0 / count)))
        assert claim.largest_of_m(np.eye(2) * 0.02**2, count, quantile) == pytest.approx(closed, rel=1e-6)


def test_the_largest_of_many_long_errors_is_that_of_draws():
    covariance = np.array([[9.0, 2.0], [2.0, 1.0]])
    draws = np.random.default_rng(5).multivariate_normal((0.0, 0.0), covariance, (4_000, 200))
    largest = np.linalg.norm(draws, axis=2).max(axis=1)
    for quantile in (0.05, 0.5, 0.95):
        share = float(np.mean(largest < claim.largest_of_m(covariance, 200, quantile)))
        assert abs(share - quantile) < 4.5 * math.sqrt(quantile * (1.0 - quantile) / len(largest))


def test_a_power_law_crosses_where_it_should():
    rows = [
        claim.Worst("literal", ps, 1, 30_000, 0.002 * ps**0.9, 0.01, 1.0, (0.9, 1.1))
        for ps in (5.2, 50.0, 100.0, 200.0)
    ]
    unlucky, typical, lucky = claim.trend_of(rows).crossings_ps
    assert typical == pytest.approx(100.0 ** (1.0 / 0.9), rel=1e-9)
    assert unlucky == pytest.approx(typical * 1.1 ** (-1.0 / 0.9), rel=1e-9)
    assert lucky == pytest.approx(typical * 0.9 ** (-1.0 / 0.9), rel=1e-9)


def test_the_paper_keeps_20_cm_up_to_the_published_noise():
    """101 ps for 30 000 fixes of ``literal`` (docs/maths.md) lies within what a largest error scatters, 5 to 95 %."""
    low, high = (claim.largest_of_m(dop_map.literal_covariance_m2(np.array(P1)), 30_000, q) for q in (0.05, 0.95))
    assert 100.0 * 0.2 / high < 101.0 < 100.0 * 0.2 / low


def test_predicted_deviations_are_the_published_ones():
    """5.36 cm at P1 and 5.46 cm at P2 (docs/maths.md: predicted σ), rounding included."""
    for place, published_cm in ((P1, 5.36), (P2, 5.46)):
        predicted_cm = 100.0 * math.sqrt(np.trace(dop_map.literal_covariance_m2(np.array(place))))
        assert predicted_cm == pytest.approx(published_cm, abs=0.02)


def test_antenna_delays_move_the_least_squares_by_the_normal_equations():
    """A DTDoA is late by the TX and RX delay of its anchor; the master's own cancel."""
    assert static.expected_bias_m("noise", P2, 1) == pytest.approx([0.0, 0.0], abs=1e-12)
    late_m = np.array([error.tx_ticks + error.rx_ticks for error in static.delay_errors(7)])[1:] * 4.691764e-3
    anchors = np.array([(anchor.x_m, anchor.y_m) for anchor in lab_site().anchors])
    units = (np.array(P2) - anchors) / np.linalg.norm(np.array(P2) - anchors, axis=1)[:, None]
    rows = units[1:] - units[0]
    expected = np.linalg.inv(rows.T @ rows) @ rows.T @ late_m
    assert static.expected_bias_m("delay", P2, 7) == pytest.approx(expected, rel=1e-5)


def test_the_command_beside_a_figure_makes_its_number_again():
    """Several methods and tags in one world hear what ``skyless simulate`` lets one tag hear."""
    tracks = static.run_world("noise", 9, 60, 60)
    fleet = fleet_of(Request(paper_lab_site(), method="literal", seed=9, noise_ps=100.0, positions_m=(P1,), fixes=60))
    for _ in fleet.run(3.2):
        pass
    error_m = tracks[0]["literal"].error_m
    assert fleet.errors.count == len(error_m) == 60
    summary = fleet.errors.summary()
    assert summary.rmse_2d_m == pytest.approx(math.sqrt((error_m**2).sum(axis=1).mean()), rel=1e-12)


def test_phases_end_with_the_fix():
    def heard(tag, when, fixed):
        return timeline.TimedReception(tag, 1, when, when + 1e-4, fixed, 1e-5)

    found = timeline.phases_of([heard(0, 1.0, False), heard(1, 1.0, False), heard(0, 2.0, True), heard(0, 3.0, False)])
    assert [(phase.tag, phase.begin_s, phase.last_s) for phase in found] == [(0, 1.0, 2.0)]


def test_a_quick_report_says_so_and_simulates_less():
    quick, full = plan_of(1, quick=True), plan_of(1, quick=False)
    assert quick.quick
    assert not full.quick
    assert full.draws >= 2_000_000
    assert full.fixes == 30_000
    assert full.fleet_sizes[-1] == 10_000
    assert quick.fixes < full.fixes


def test_a_drawing_in_a_page_has_names_and_colours_of_its_own():
    svg = (
        b'<?xml version="1.0"?>\n<svg xmlns="http://x" xmlns:xlink="y" width="9pt" height="5pt" viewBox="0 0 9 5">'
        b"<metadata><a/></metadata>"
        b'<g id="a" style="fill: #1f2933; clip-path: url(#b)"/><use xlink:href="#a"/></svg>'
    )
    text = inline_svg(svg, "fig", 'x < y "z"')
    assert text == (
        '<svg role="img" aria-label="x &lt; y &quot;z&quot;" viewBox="0 0 9 5">'
        '<g id="fig-a" style="fill: var(--ink); clip-path: url(#fig-b)"/><use href="#fig-a"/></svg>'
    )
