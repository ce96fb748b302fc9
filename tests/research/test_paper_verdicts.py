"""The verdicts of ``skyless paper`` follow from their numbers, its theory from closed forms and published figures."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.research.paper import _scale as scale
from skyless.research.paper import claims
from skyless.research.paper.claims import CLAIMS, LambdaDistribution, PaperCheck, largest_of_m, literal_covariance_m2
from skyless.research.paper.plan import P1, P2, TimedReception, Verdict, listen, plan_of
from skyless.sim.evaluation.scenarios import Request, fleet_of
from skyless.sim.impairments import lab_impairments
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.sim.trajectory import Static
from skyless.site.report import inline_svg

pytestmark = pytest.mark.site

HOLDS, CORRECTED, FAILS = Verdict.HOLDS, Verdict.CORRECTED, Verdict.FAILS


def verdict_of(key, figures):
    (claim,) = (claim for claim in CLAIMS if claim.key == key)
    return claim.judge(figures)[0]


def test_every_claim_has_a_last_rule_without_limits_and_limits_that_are_some():
    for claim in CLAIMS:
        *others, last = claim.rules
        assert not last.limits
        assert others
        for rule in others:
            assert all(low <= high and (low, high) != (-math.inf, math.inf) for low, high in rule.limits.values())


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
    assert verdict_of("gamma-check", claims.gamma_figures(found)) is verdict


def distribution(corrected_std_m, noise="uniform"):
    edges = np.linspace(-5.0, 5.0, 11)
    return LambdaDistribution(noise, edges, np.ones(10, np.int64), 1.0, corrected_std_m, 1.5, 10)


def test_uniform_stamps_are_told_by_their_deviation():
    gaussian = replace(distribution(1.0, "gaussian"), draws=10**6)
    for corrected_std_m, verdict in ((1.001, FAILS), (1.05, HOLDS)):
        figures = claims.distribution_figures(gaussian, replace(distribution(corrected_std_m), draws=10**6))
        assert verdict_of("dtdoa-distribution", figures) is verdict


def test_distance_of_shapes_is_that_of_the_normal_law():
    """Draws that all lie in one bin differ from a Gaussian by what the Gaussian has elsewhere."""
    edges = np.array([-10.0, -1.0, 1.0, 10.0])
    one = LambdaDistribution("gaussian", edges, np.array([0, 100, 0]), 1.0, 1.0, None, 100)
    assert one.shape_distance == pytest.approx(1.0 - math.erf(1.0 / math.sqrt(2.0)), rel=1e-9)


def moments(mean_sigmas, skewness=0.0, excess=0.0):
    return claims.Moments(30_000, mean_sigmas * 1e-4, 1e-4, 0.04, skewness, excess)


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
    assert verdict_of("static-errors", claims.static_figures([noise_only], [biased])) is verdict


def frames(sent, heard):
    return {"sent": sent, "senders": 6, "heard_by_tags": heard}


@pytest.mark.parametrize(
    ("key", "figures", "verdict"),
    [
        ("walking-test", {"pdop_correlation": 0.9, "predicted_correlation": 0.95}, HOLDS),
        ("walking-test", {"pdop_correlation": 0.4, "predicted_correlation": 0.95}, CORRECTED),
        ("walking-test", {"pdop_correlation": 0.4, "predicted_correlation": 0.5}, FAILS),
        ("pdop-map", {"correlation": 0.95, "asymmetry_pct": 2.0}, HOLDS),
        ("pdop-map", {"correlation": 0.95, "asymmetry_pct": 30.0}, CORRECTED),
        ("pdop-map", {"correlation": -0.2, "asymmetry_pct": 30.0}, FAILS),
        ("three-receivers", claims.timeline_figures(3, 3, 100, 100), HOLDS),
        ("three-receivers", claims.timeline_figures(3, 3, 90, 100), FAILS),
        ("three-receivers", claims.timeline_figures(2, 3, 100, 100), FAILS),
        ("update-rate", {"superframe_hz": 66.7, "message_hz": 400.0}, HOLDS),
        ("update-rate", {"superframe_hz": 60.0, "message_hz": 400.0}, FAILS),
        ("largest-error", {"literal": 160.0, "joint": 320.0}, HOLDS),
        ("largest-error", {"literal": 101.0, "joint": 202.0}, CORRECTED),
        ("largest-error", {"literal": 12.0, "joint": 24.0}, FAILS),
        ("scenario", claims.scenario_figures(frames(400, 400), frames(400, 800), 2), HOLDS),
        ("scenario", claims.scenario_figures(frames(400, 400), frames(402, 800), 2), FAILS),
        ("scenario", claims.scenario_figures(frames(400, 400), frames(400, 790), 2), FAILS),
    ],
)
def test_other_verdicts_follow_their_numbers(key, figures, verdict):
    assert verdict_of(key, figures) is verdict


def test_scaling_holds_only_if_nothing_changes():
    one = scale.summarise(np.array([0.04]), np.array([240]), 240, "same", 0.1)
    many = scale.summarise(np.array([0.04] * 5), np.array([240] * 5), 240, "same", 0.5)
    for changes, verdict in (
        ({}, HOLDS),
        ({"fewest_fixes_per_s": 200.0}, CORRECTED),
        ({"first_tag": "other"}, FAILS),
        ({"frames_per_s": 500.0}, FAILS),
        ({"fewest_heard_per_s": 300.0}, FAILS),
    ):
        assert verdict_of("scaling", scale.figures_of([one, replace(many, **changes)])) is verdict


def test_the_largest_of_many_round_errors_is_that_of_the_rayleigh_law():
    for count, quantile in ((1, 0.5), (30_000, 0.05), (30_000, 0.95)):
        closed = 0.02 * math.sqrt(-2.0 * math.log(1.0 - quantile ** (1.0 / count)))
        assert largest_of_m(np.eye(2) * 0.02**2, count, quantile) == pytest.approx(closed, rel=1e-6)


def test_the_largest_of_many_long_errors_is_that_of_draws():
    covariance = np.array([[9.0, 2.0], [2.0, 1.0]])
    draws = np.random.default_rng(5).multivariate_normal((0.0, 0.0), covariance, (4_000, 200))
    largest = np.linalg.norm(draws, axis=2).max(axis=1)
    for quantile in (0.05, 0.5, 0.95):
        share = float(np.mean(largest < largest_of_m(covariance, 200, quantile)))
        assert abs(share - quantile) < 4.5 * math.sqrt(quantile * (1.0 - quantile) / len(largest))


def test_a_power_law_crosses_where_it_should():
    rows = [
        claims.Worst("literal", ps, 1, 30_000, 0.002 * ps**0.9, 0.01, 1.0, (0.9, 1.1))
        for ps in (5.2, 50.0, 100.0, 200.0)
    ]
    unlucky, typical, lucky = claims.trend_of(rows).crossings_ps
    assert typical == pytest.approx(100.0 ** (1.0 / 0.9), rel=1e-9)
    assert unlucky == pytest.approx(typical * 1.1 ** (-1.0 / 0.9), rel=1e-9)
    assert lucky == pytest.approx(typical * 0.9 ** (-1.0 / 0.9), rel=1e-9)


def test_the_paper_keeps_20_cm_up_to_the_published_noise():
    """101 ps for 30 000 fixes of ``literal`` (docs/maths.md) lies within what a largest error scatters, 5 to 95 %."""
    low, high = (largest_of_m(literal_covariance_m2(np.array(P1)), 30_000, q) for q in (0.05, 0.95))
    assert 100.0 * 0.2 / high < 101.0 < 100.0 * 0.2 / low


def test_predicted_deviations_are_the_published_ones():
    """5.36 cm at P1 and 5.46 cm at P2 (docs/maths.md: predicted σ), rounding included."""
    for place, published_cm in ((P1, 5.36), (P2, 5.46)):
        predicted_cm = 100.0 * math.sqrt(np.trace(literal_covariance_m2(np.array(place))))
        assert predicted_cm == pytest.approx(published_cm, abs=0.02)


def test_antenna_delays_move_the_least_squares_by_the_normal_equations():
    """A DTDoA is late by the TX and RX delay of its anchor; the master's own cancel."""
    assert claims.expected_bias_m("noise", P2, 1) == pytest.approx([0.0, 0.0], abs=1e-12)
    late_m = np.array([error.tx_ticks + error.rx_ticks for error in claims.delay_errors(7)])[1:] * 4.691764e-3
    anchors = np.array([(anchor.x_m, anchor.y_m) for anchor in lab_site().anchors])
    units = (np.array(P2) - anchors) / np.linalg.norm(np.array(P2) - anchors, axis=1)[:, None]
    rows = units[1:] - units[0]
    expected = np.linalg.inv(rows.T @ rows) @ rows.T @ late_m
    assert claims.expected_bias_m("delay", P2, 7) == pytest.approx(expected, rel=1e-5)


def test_the_command_beside_a_figure_makes_its_number_again():
    """Several methods and tags in one world hear what ``skyless simulate`` lets one tag hear."""
    tags = [(Static(*P1), {"literal": 60, "joint": 60}), (Static(*P2), {"literal": 60})]
    tracks = listen(paper_lab_site(), tags, lab_impairments(100.0), 9)
    fleet = fleet_of(Request(paper_lab_site(), method="literal", seed=9, noise_ps=100.0, positions_m=(P1,), fixes=60))
    for _ in fleet.run(3.2):
        pass
    error_m = tracks[0]["literal"].error_m
    assert fleet.errors.count == len(error_m) == 60
    summary = fleet.errors.summary()
    assert summary.rmse_2d_m == pytest.approx(math.sqrt((error_m**2).sum(axis=1).mean()), rel=1e-12)


def test_phases_end_with_the_fix():
    def heard(tag, when, fixed):
        return TimedReception(tag, "literal", 1, when, when + 1e-4, fixed, 1e-5)

    given = [heard(0, 1.0, False), heard(1, 1.0, False), heard(0, 2.0, True), heard(0, 3.0, False)]
    assert claims.phases_of(given) == [(1.0, given[2])]


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
