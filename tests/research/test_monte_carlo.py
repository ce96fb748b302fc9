"""Monte Carlo of the paper's chain: covariances against the theory, sums against other ways to make them."""

from dataclasses import replace

import numpy as np
import pytest

from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.research.paper.plan import CHUNK_DRAWS, Quantity, draw_lambdas, draw_moments, noise_batches
from skyless.research.uncertainty import CORRECTED
from support.random_chain import draw_loop, random_chain

pytestmark = pytest.mark.statistical

SHARING = ["apart", "first sync", "second sync"]
"""Packet of the master that the TDoAs refer to: none of the synchronisation packets, as in the paper, or one."""


def chain_for(reference="apart"):
    """Ten random anchors, stamps of master, anchors and tag of different noise."""
    chain = random_chain(10, seed=4)
    t_m = dict(zip(SHARING, (0.041, 0.0, chain.sync_spacing_s), strict=True))[reference]
    return replace(chain, sigma_master_s=9e-12, sigma_anchor_s=4e-12, sigma_tag_s=6e-12, reference_s=t_m)


def theorys_covariance_m2(chain):
    """Covariance of the TDoAs of n anchors, shape (n, n), to first order in the noise (``docs/maths.md`` section 2)."""
    u = (chain.master_offset_s + chain.master_rate * chain.reference_s - chain.T_c) / chain.L
    w1, w2, Q = 0.5 - u, 0.5 + u, (1.0 + chain.kappa) ** 2 + chain.kappa**2
    is_apart = chain.reference_s not in (chain.sync_s, chain.sync_s + chain.sync_spacing_s)
    masters = (1.0 + w1**2 + w2**2) * is_apart
    common = chain.sigma_tag_s**2 + chain.V**2 * chain.sigma_master_s**2 * masters
    anchors = (chain.V / chain.N) ** 2 * chain.sigma_anchor_s**2 * (Q + w1**2 + w2**2)
    return SPEED_OF_LIGHT_MPS**2 * (np.diag(Q * chain.sigma_tag_s**2 + anchors) + common)


@pytest.mark.parametrize("uniform", [False, True])
@pytest.mark.parametrize("reference", SHARING)
def test_the_covariance_of_all_tdoas_is_the_theorys(reference, uniform):
    """All 100 elements within 5 standard errors of half a million draws; the variances then to 0.5 %."""
    chain = chain_for(reference)
    moments = draw_moments(chain, 3, 500_000, uniform=uniform)
    excess = moments.lambda_covariance_m2 - theorys_covariance_m2(chain)
    own = np.diag(moments.lambda_covariance_m2)
    error = np.sqrt((np.outer(own, own) + moments.lambda_covariance_m2**2) / moments.draws)  # of Gaussian errors
    assert (np.abs(excess) < 5.0 * error).all()
    np.testing.assert_allclose(np.diag(excess), 0.0, atol=5e-3 * np.diag(moments.lambda_covariance_m2).max())


def test_the_theorys_variances_are_those_of_the_paper():
    chain = chain_for()
    np.testing.assert_allclose(np.diag(theorys_covariance_m2(chain)), CORRECTED.lambda_m2(chain), rtol=1e-12)


def test_the_autocovariance_of_epsilon_is_the_theorys():
    chain = chain_for()
    moments = draw_moments(chain, 5, 500_000)
    excess = moments.epsilon_covariance_s2 - CORRECTED.epsilon_covariance(chain)
    both = moments.variance[Quantity.EPSILON_FIRST] * moments.variance[Quantity.EPSILON_DELAYED]
    error = np.sqrt((both + moments.epsilon_covariance_s2**2) / moments.draws)  # of jointly Gaussian errors
    assert (np.abs(excess) < 5.0 * error).all()


def test_sums_have_the_same_bits_for_any_number_of_threads():
    draws = 5 * CHUNK_DRAWS + 77
    one, three = (draw_moments(chain_for(), 8, draws, threads=threads) for threads in (1, 3))
    assert one.draws == three.draws == draws
    for name in ("mean", "variance", "fourth", "epsilon_covariance_s2", "lambda_covariance_m2"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))


def test_moments_are_those_of_the_draws_one_by_one():
    """Chunks merged against all draws at once, and standard errors against their own scatter over batches."""
    chain, draws = chain_for(), 2 * CHUNK_DRAWS + 5
    lambdas = np.concatenate(list(draw_lambdas(chain, 8, draws)))
    moments = draw_moments(chain, 8, draws)
    np.testing.assert_allclose(moments.mean[Quantity.LAMBDA], lambdas.mean(axis=0), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(moments.variance[Quantity.LAMBDA], lambdas.var(axis=0, ddof=1), rtol=1e-9)
    np.testing.assert_allclose(moments.lambda_covariance_m2, np.cov(lambdas.T, ddof=0), rtol=1e-6, atol=1e-12)
    batches = np.array([batch.std(axis=0) for batch in np.array_split(lambdas, 256)])
    scatter = batches.std(axis=0).mean() / batches.mean() / np.sqrt(256)
    assert moments.std_relative_error[Quantity.LAMBDA].mean() == pytest.approx(scatter, rel=0.06)


def test_a_loop_over_draws_gives_the_same_deviations():
    chain = chain_for()
    units = np.array([1.0, *[TICK_S] * 5, 1.0, TICK_S, TICK_M])[:, None]
    deviations = np.sqrt(draw_loop(chain, 4000)) * units
    np.testing.assert_allclose(deviations, draw_moments(chain, 2, 100_000).std, rtol=5.0 / np.sqrt(2 * 4000))


@pytest.mark.parametrize(("uniform", "kurtosis", "largest"), [(False, 3.0, 6.0), (True, 1.8, np.sqrt(3.0))])
def test_moments_and_independence_of_the_numbers_of_a_draw(uniform, kurtosis, largest):
    """Of mean 0 and variance 1, draws and the numbers of a draw independent of each other."""
    draws = CHUNK_DRAWS
    noise = np.concatenate(list(noise_batches(7, 3, draws, 8, uniform=uniform)))
    assert noise.shape == (draws, 8)
    assert np.abs(noise).max() <= largest
    tolerance = 5.0 / np.sqrt(draws)
    np.testing.assert_allclose(noise.T @ noise / draws, np.eye(8), atol=tolerance * np.sqrt(2.0))
    np.testing.assert_allclose((noise**4).mean(axis=0), kurtosis, atol=tolerance * np.sqrt(96.0))
    np.testing.assert_allclose((noise[1:] * noise[:-1]).mean(axis=0), 0.0, atol=tolerance)


def test_seeds_and_chunks_have_noise_of_their_own():
    keys = [(1, 1), (1, 2), (2, 1), (1, 1 + 2**32), (1 + 2**32, 1)]
    rows = [next(noise_batches(seed, chunk, 1, 4, uniform=False)) for seed, chunk in keys]
    assert len(np.unique(rows)) == 4 * len(keys)
