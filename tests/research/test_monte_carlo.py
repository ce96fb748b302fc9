"""Monte Carlo of the paper's chain: covariances against the theory, sums against other ways to make them."""

import numpy as np
import pytest

from skyless.core.ticks import TICK_M, TICK_S
from skyless.research.paper.plan import CHUNK_DRAWS, Quantity, draw_lambdas, draw_moments, noise_batches
from skyless.research.uncertainty import CORRECTED, Chain, Reference, chain_covariance
from support.random_chain import draw_loop, random_chain

pytestmark = pytest.mark.statistical

SHARING = list(Reference)


def chain_for(reference, **changes):
    """Ten random anchors, stamps of master, anchors and tag of different noise."""
    chain = random_chain(10, seed=4)
    t_m = {Reference.APART: 0.041, Reference.FIRST_SYNC: 0.0, Reference.SECOND_SYNC: chain.sync_spacing_s}[reference]
    sigmas = {"sigma_master_s": 9e-12, "sigma_anchor_s": 4e-12, "sigma_tag_s": 6e-12}
    fields = {name: getattr(chain, name) for name in Chain.__slots__}
    return Chain(**(fields | sigmas | {"reference_s": t_m} | changes))


@pytest.mark.parametrize("uniform", [False, True])
@pytest.mark.parametrize("reference", SHARING)
def test_the_covariance_of_all_tdoas_is_the_theorys(reference, uniform):
    """All 100 elements within 5 standard errors of half a million draws; the variances then to 0.5 %."""
    chain = chain_for(reference)
    moments = draw_moments(chain, 3, 500_000, reference=reference, uniform=uniform)
    excess = moments.lambda_covariance_m2 - chain_covariance(chain, reference)
    own = np.diag(moments.lambda_covariance_m2)
    error = np.sqrt((np.outer(own, own) + moments.lambda_covariance_m2**2) / moments.draws)  # of Gaussian errors
    assert (np.abs(excess) < 5.0 * error).all()
    np.testing.assert_allclose(np.diag(excess), 0.0, atol=5e-3 * np.diag(moments.lambda_covariance_m2).max())


def test_the_theorys_covariance_of_a_shared_packet_does_not_know_the_sync_spacing():
    """As long as the reference is not apart from it: then the rate error grows with every second between."""
    for reference, same in ((Reference.FIRST_SYNC, True), (Reference.APART, False)):
        near, far = (chain_for(reference, sync_spacing_s=spacing_s) for spacing_s in (0.015, 0.3))
        variances = [np.diag(chain_covariance(chain, reference)) for chain in (near, far)]
        np.testing.assert_equal(np.isclose(*variances, rtol=1e-12), same)


def test_a_reference_that_is_no_sync_packet_is_refused():
    with pytest.raises(ValueError, match=r"reference_s is 0\.041, the first-sync packet is at 0\.0"):
        chain_covariance(chain_for(Reference.APART), Reference.FIRST_SYNC)


@pytest.mark.parametrize("reference", SHARING)
def test_the_theorys_covariance_is_a_diagonal_and_a_common_number(reference):
    """To the 40 ppm by which rates differ; the diagonal is FinalTDoAUnc's where the paper has it."""
    chain = chain_for(reference)
    covariance = chain_covariance(chain, reference)
    common = covariance[0, 1]
    own = covariance.diagonal() - common
    np.testing.assert_allclose(np.diag(own) + common, covariance, rtol=1e-4)
    if reference is Reference.APART:
        np.testing.assert_allclose(np.diag(covariance), CORRECTED.lambda_m2(chain), rtol=1e-12)


def test_the_autocovariance_of_epsilon_is_the_theorys():
    chain = chain_for(Reference.APART)
    moments = draw_moments(chain, 5, 500_000)
    excess = moments.epsilon_covariance_s2 - CORRECTED.epsilon_covariance(chain)
    both = moments.variance[Quantity.EPSILON_FIRST] * moments.variance[Quantity.EPSILON_DELAYED]
    error = np.sqrt((both + moments.epsilon_covariance_s2**2) / moments.draws)  # of jointly Gaussian errors
    assert (np.abs(excess) < 5.0 * error).all()


def test_sums_have_the_same_bits_for_any_number_of_threads():
    draws = 5 * CHUNK_DRAWS + 77
    one, three = (draw_moments(chain_for(Reference.APART), 8, draws, threads=threads) for threads in (1, 3))
    assert one.draws == three.draws == draws
    for name in ("mean", "variance", "fourth", "epsilon_covariance_s2", "lambda_covariance_m2"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))


def test_moments_are_those_of_the_draws_one_by_one():
    """Chunks merged against all draws at once, and standard errors against their own scatter over batches."""
    chain, draws = chain_for(Reference.APART), 2 * CHUNK_DRAWS + 5
    lambdas = np.concatenate(list(draw_lambdas(chain, 8, draws)))
    moments = draw_moments(chain, 8, draws)
    np.testing.assert_allclose(moments.mean[Quantity.LAMBDA], lambdas.mean(axis=0), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(moments.variance[Quantity.LAMBDA], lambdas.var(axis=0, ddof=1), rtol=1e-9)
    np.testing.assert_allclose(moments.lambda_covariance_m2, np.cov(lambdas.T, ddof=0), rtol=1e-6, atol=1e-12)
    batches = np.array([batch.std(axis=0) for batch in np.array_split(lambdas, 256)])
    scatter = batches.std(axis=0).mean() / batches.mean() / np.sqrt(256)
    assert moments.std_relative_error[Quantity.LAMBDA].mean() == pytest.approx(scatter, rel=0.06)


def test_a_loop_over_draws_gives_the_same_deviations():
    chain = chain_for(Reference.APART)
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
