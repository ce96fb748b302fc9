"""Predicted errors against other derivations of them: closed forms, Riccati equations, draws."""

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.linalg import solve_discrete_are

from dense_covariance import position_covariance
from skyless.core.clock_filter import ClockNoise, clock_noise
from skyless.core.geometry import anchor_positions, dops_at
from skyless.core.method_names import FILTERS
from skyless.core.protocol1.snapshots import (
    SnapshotMethod,
    bracketed_covariance,
    literal_covariance,
    literal_delayed_covariance,
)
from skyless.core.site import AnchorSite, NoiseSite, Site, TagsSite, WallSite
from skyless.sim.lab import paper_lab_site
from skyless.site.channel import ChannelModel, barriers_of
from skyless.site.planning.anchor_clocks import offset_variances, stamp_variances
from skyless.site.planning.links import (
    CLAIMED,
    FIX_SHARE,
    GDOP,
    PLAN_COLUMNS,
    RMSE,
    SIGMA,
    SIGMA_X,
    SIGMA_Y,
    SIGMA_Z,
    TDOP,
    link_budget,
    links,
    range_of,
    with_range,
)
from skyless.site.planning.predict import PlanSettings, Predictor, delays, phase_covariance, with_noise

pytestmark = pytest.mark.statistical

LAB = paper_lab_site(100.0)
QUIET = replace(LAB, noise=NoiseSite(100.0, 100.0, 1e-15, 1e-15))
"""The lab with crystals so good that only stamps count."""

COVARIANCES = {
    SnapshotMethod.LITERAL: literal_covariance,
    SnapshotMethod.LITERAL_DELAYED: literal_delayed_covariance,
    SnapshotMethod.WEIGHTED: literal_covariance,
    SnapshotMethod.BRACKETED: bracketed_covariance,
}


def points(count=40, seed=3, height=0.0):
    random = np.random.default_rng(seed)
    return np.column_stack([random.uniform(0.2, 5.8, count), random.uniform(0.2, 7.8, count), np.full(count, height)])


@pytest.mark.parametrize("method", list(SnapshotMethod))
def test_with_perfect_crystals_snapshots_follow_the_tdoas_covariance(method):
    tx_var, rx_var = stamp_variances(QUIET)
    kappa, _ = delays(QUIET)
    expected = position_covariance(
        anchor_positions(QUIET),
        points(),
        COVARIANCES[method](kappa[1:], tx_var, rx_var),
        height_known=True,
        weighted=method in {SnapshotMethod.WEIGHTED, SnapshotMethod.BRACKETED},
    )
    table = Predictor(QUIET, PlanSettings(str(method))).at(points())
    assert table[:, SIGMA] ** 2 == pytest.approx(np.trace(expected, axis1=1, axis2=2), rel=1e-6)
    assert table[:, SIGMA_X] ** 2 == pytest.approx(expected[:, 0, 0], rel=1e-6)
    assert table[:, SIGMA_Y] ** 2 == pytest.approx(expected[:, 1, 1], rel=1e-6)
    assert table[:, CLAIMED] == pytest.approx(table[:, SIGMA], rel=1e-6)
    assert table[:, FIX_SHARE] == pytest.approx(1.0, abs=1e-6)


def test_dops_are_those_of_all_anchors_where_all_are_in_view():
    table = Predictor(LAB, PlanSettings()).at(points())
    expected = dops_at(anchor_positions(LAB), points(), height_known=True)
    assert table[:, GDOP : TDOP + 1] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("method", "centimetres"),
    [
        ("literal", 5.35),
        ("literal-delayed", 3.59),
        ("weighted", 5.15),
        ("bracketed", 3.41),
        ("joint", 1.33),
    ],
)
def test_the_labs_figures_come_out(method, centimetres):
    """RMSE of 30 000 simulated fixes at (3, 4), docs/maths.md section 5; standard error 0.4 % (filters 1.5 %)."""
    table = Predictor(LAB, PlanSettings(method)).at(np.array([[3.0, 4.0, 0.0]]))
    assert 100.0 * table[0, RMSE] == pytest.approx(centimetres, rel=0.05 if method in FILTERS else 0.012)


def test_what_the_filter_will_claim_comes_out():
    table = Predictor(LAB, PlanSettings("joint")).at(np.array([[3.0, 4.0, 0.0], [1.2, 1.6, 0.0]]))
    assert 100.0 * table[:, CLAIMED] == pytest.approx([1.54, 1.61], rel=0.01)


def test_a_clocks_phase_against_drawn_crystals():
    """20 000 random walks, sampled finely: the standard error of a variance is 1 %."""
    kappa, round_s, steps, draws = np.array([0.25, 0.5, 0.75]), 0.2, 80, 20_000
    noise = ClockNoise(white=0.05, walk=3.0)
    random = np.random.default_rng(8)
    dt = 2.0 * round_s / steps
    gain = random.standard_normal((draws, steps)) * np.sqrt(noise.walk * dt)
    rate = np.cumsum(gain, axis=1)
    own = random.standard_normal((draws, steps)) * np.sqrt(noise.walk * dt**3 / 12.0 + noise.white * dt)
    phase = np.cumsum(np.concatenate([np.zeros((draws, 1)), (rate - gain / 2.0) * dt + own], axis=1), axis=1)

    def at(time):
        return phase[:, round(time / (2.0 * round_s) * steps)]

    for first in (True, False):
        drawn = [
            (1 + k) * at(k * round_s) - k * at((1 + k) * round_s) - at(0.0)
            if first
            else (1 - k) * at((1 + k) * round_s) + k * at(k * round_s) - at(round_s)
            for k in kappa
        ]
        expected = phase_covariance(kappa, round_s, noise, first=first)
        scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
        assert np.cov(drawn) / scale == pytest.approx(expected / scale, abs=0.05)


def test_anchor_clocks_settle_where_riccati_says():
    """The covariance just before the master's message is the solution of the discrete Riccati equation."""
    told_m2 = offset_variances(LAB, np.ones(6))
    noise, dt = clock_noise(2e-11, 1e-9), 0.015
    F, H = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    Q = np.array(
        [
            [noise.white * dt + noise.walk * dt**3 / 3, noise.walk * dt**2 / 2],
            [noise.walk * dt**2 / 2, noise.walk * dt],
        ]
    )
    R = np.array([[sum(stamp_variances(LAB))]])
    prior = solve_discrete_are(F.T, H.T, Q, R)
    gain = (prior @ H.T / (prior[0, 0] + R)).ravel()
    posterior = prior - np.outer(gain, H @ prior)
    step = dt / 6
    told = posterior[0, 0] + 2 * step * posterior[0, 1] + step**2 * posterior[1, 1]
    told += noise.white * step + noise.walk * step**3 / 3
    assert told_m2[0] == 0.0
    assert told_m2[1] == pytest.approx(told, rel=1e-4)


def test_links_are_the_simulations():
    channel = with_range(ChannelModel(), 20.0)
    assert range_of(channel) == pytest.approx(20.0)
    walls = barriers_of((WallSite(5.0, -1.0, 5.0, 1.0, loss_db=6.0206, delay_m=0.3),))
    points_m = np.array([(0.0, 20.0, 0.0), (10.0, 0.0, 0.0), (4.0, 0.0, 0.0)])
    share, delay_m = links(np.zeros((1, 3)), points_m, link_budget(channel), walls)
    np.testing.assert_allclose(share[:2, 0], 0.5, atol=1e-4)
    assert share[2, 0] > 0.999
    np.testing.assert_allclose(delay_m[:, 0], [0.0, 0.3, 0.0])


def test_without_enough_anchors_there_is_no_fix():
    short = PlanSettings("bracketed", channel=with_range(ChannelModel(), 3.0))
    table = Predictor(LAB, short).at(points())
    assert np.isinf(table[:, SIGMA]).all()
    assert (table[:, FIX_SHARE] == 0.0).all()


def test_an_anchor_that_sends_before_the_master_is_of_no_use_to_snapshots():
    late = replace(LAB, anchors=tuple(replace(a, slot=a.id % 6) for a in LAB.anchors))  # anchor 6 sends first
    others = replace(LAB, anchors=LAB.anchors[:5], schedule=replace(LAB.schedule, slots=6))
    with_six, with_five = (Predictor(site, PlanSettings("bracketed")).at(points())[:, SIGMA] for site in (late, others))
    assert with_six == pytest.approx(with_five, rel=1e-3)


def test_a_walls_delay_shifts_positions_as_the_tdoas_shift():
    """Anchors 2, 3, 4 behind a wall: their TDoAs are late by the delay, and their clocks too."""
    wall = WallSite(3.0, -1.0, 3.0, 9.0, loss_db=0.0, delay_m=0.05)
    site = replace(QUIET, walls=(wall,))
    point = np.array([[1.0, 4.5, 0.0]])
    anchors = anchor_positions(site)
    delay = np.where(anchors[:, 0] > 3.0, 0.05, 0.0)
    shift = delay - delay[0] + np.where(anchors[:, 0] > 3.0, 0.05, 0.0)
    unit = (point - anchors) / np.linalg.norm(point - anchors, axis=1)[:, None]
    H = (unit[1:] - unit[0])[:, :2]
    expected = np.linalg.norm(np.linalg.lstsq(H, shift[1:], rcond=None)[0])
    row = Predictor(site, PlanSettings("literal")).at(point)[0]
    assert row[PLAN_COLUMNS.index("bias_m")] == pytest.approx(expected, rel=1e-6)
    assert row[RMSE] ** 2 == pytest.approx(row[SIGMA] ** 2 + expected**2, rel=1e-6)


def test_three_dimensions_have_heights():
    heights = (0.3, 2.7, 0.4, 2.8, 0.5, 2.5)
    anchors = tuple(replace(a, z_m=z) for a, z in zip(LAB.anchors, heights, strict=True))
    site = replace(LAB, anchors=anchors, tags=TagsSite())
    for method in ("weighted", "joint"):
        table = Predictor(site, PlanSettings(method)).at(points(5, height=1.2))
        parts = table[:, [SIGMA_X, SIGMA_Y, SIGMA_Z]]
        assert (parts > 0.0).all()
        assert (parts**2).sum(axis=1) == pytest.approx(table[:, SIGMA] ** 2)


def test_noise_scales_snapshots():
    one, three = (
        Predictor(with_noise(QUIET, ps), PlanSettings("literal")).at(points(5))[:, SIGMA] for ps in (2000.0, 6000.0)
    )
    assert three / one == pytest.approx(3.0, rel=1e-4)


def test_a_site_out_of_its_masters_reach_is_silent():
    anchors = (AnchorSite(1, 0.0, 0.0), AnchorSite(2, 5.0, 0.0), AnchorSite(3, 0.0, 5.0), AnchorSite(4, 90.0, 5.0))
    site = Site("far", 1, 1, anchors, tags=TagsSite(0.0))
    predictor = Predictor(site, PlanSettings())
    assert predictor.clocks.sends.tolist() == [True, True, True, False]
    assert 3 not in predictor.clocks.sender
