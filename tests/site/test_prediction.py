"""Predicted errors against other derivations of them: figures of the simulation, Riccati equations, the channel."""

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.linalg import solve_discrete_are

from skyless.core.clock_filter import clock_noise
from skyless.core.geometry import anchor_positions, dops_at
from skyless.core.site import AnchorSite, Site, TagsSite, WallSite
from skyless.sim.lab import paper_lab_site
from skyless.site.channel import ChannelModel, barriers_of
from skyless.site.planning import links as prediction
from skyless.site.planning.maps import Predictor
from skyless.site.planning.superframe import stamp_variances, steady_clock

pytestmark = pytest.mark.statistical

LAB = paper_lab_site(100.0)


def points(count=40, seed=3, height=0.0):
    random = np.random.default_rng(seed)
    return np.column_stack([random.uniform(0.2, 5.8, count), random.uniform(0.2, 7.8, count), np.full(count, height)])


def test_dops_are_those_of_all_anchors_where_all_are_in_view():
    table = Predictor(LAB, ChannelModel()).at(points())
    expected = dops_at(anchor_positions(LAB), points(), height_known=True)
    assert table[:, prediction.GDOP : prediction.TDOP + 1] == pytest.approx(expected, rel=1e-9)


def test_the_labs_figure_comes_out():
    """RMSE of 30 000 simulated fixes at (3, 4), docs/maths.md section 5; standard error 1.5 %."""
    table = Predictor(LAB, ChannelModel()).at(np.array([[3.0, 4.0, 0.0]]))
    assert 100.0 * table[0, prediction.RMSE] == pytest.approx(1.33, rel=0.05)


def test_what_the_filter_will_claim_comes_out():
    table = Predictor(LAB, ChannelModel()).at(np.array([[3.0, 4.0, 0.0], [1.2, 1.6, 0.0]]))
    assert 100.0 * table[:, prediction.CLAIMED] == pytest.approx([1.54, 1.61], rel=0.01)


def test_anchor_clocks_settle_where_riccati_says():
    """The covariance just before the master's message is the solution of the discrete Riccati equation."""
    noise, dt, variance_m2 = clock_noise(2e-11, 1e-9), 0.015, sum(stamp_variances(LAB))
    F, H = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    Q = np.array(
        [[noise.white * dt + noise.walk * dt**3 / 3, noise.walk * dt**2 / 2], [noise.walk * dt**2 / 2, noise.walk * dt]]
    )
    prior = solve_discrete_are(F.T, H.T, Q, np.array([[variance_m2]]))
    gain = (prior @ H.T / (prior[0, 0] + variance_m2)).ravel()
    posterior = prior - np.outer(gain, H @ prior)
    found = steady_clock(1.0, dt, variance_m2, noise)
    assert found == pytest.approx((posterior[0, 0], posterior[0, 1], posterior[1, 1]), rel=1e-4)


def test_links_are_the_simulations():
    channel = prediction.with_range(ChannelModel(), 20.0)
    assert prediction.range_of(channel) == pytest.approx(20.0)
    walls = barriers_of((WallSite(5.0, -1.0, 5.0, 1.0, loss_db=6.0206, delay_m=0.3),))
    points_m = np.array([(0.0, 20.0, 0.0), (10.0, 0.0, 0.0), (4.0, 0.0, 0.0)])
    share, delay_m = prediction.links(np.zeros((1, 3)), points_m, prediction.link_budget(channel), walls)
    np.testing.assert_allclose(share[:2, 0], 0.5, atol=1e-4)
    assert share[2, 0] > 0.999
    np.testing.assert_allclose(delay_m[:, 0], [0.0, 0.3, 0.0])


def test_without_enough_anchors_there_is_no_fix():
    short = prediction.with_range(ChannelModel(), 3.0)
    table = Predictor(LAB, short).at(points())
    assert np.isinf(table[:, prediction.SIGMA]).all()
    assert (table[:, prediction.FIX_SHARE] == 0.0).all()


def test_three_dimensions_have_heights():
    heights = (0.3, 2.7, 0.4, 2.8, 0.5, 2.5)
    anchors = tuple(replace(a, z_m=z) for a, z in zip(LAB.anchors, heights, strict=True))
    site = replace(LAB, anchors=anchors, tags=TagsSite())
    table = Predictor(site, ChannelModel()).at(points(5, height=1.2))
    parts = table[:, [prediction.SIGMA_X, prediction.SIGMA_Y, prediction.SIGMA_Z]]
    assert (parts > 0.0).all()
    assert (parts**2).sum(axis=1) == pytest.approx(table[:, prediction.SIGMA] ** 2)


def test_a_site_out_of_its_masters_reach_is_silent():
    anchors = (AnchorSite(1, 0.0, 0.0), AnchorSite(2, 5.0, 0.0), AnchorSite(3, 0.0, 5.0), AnchorSite(4, 90.0, 5.0))
    site = Site("far", 1, 1, anchors, tags=TagsSite(0.0))
    predictor = Predictor(site, ChannelModel())
    assert predictor.superframe.sent.tolist() == [1.0, 1.0, 1.0, 0.0]
    assert 3 not in predictor.superframe.sender
