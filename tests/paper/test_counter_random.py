"""The counter-based generator: the authors' known answers, and the distributions of what is made of it."""

import numpy as np
import pytest
from scipy.special import ndtri

from skyless.paper.counter_random import fill_noise, philox, standard_normal, standard_uniform

ONES = 0xFFFFFFFF


@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((ONES,) * 4, (ONES, ONES), (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_the_known_answers_of_random123(counter, key, answer):
    assert philox(*counter, *key) == answer
    assert getattr(philox, "py_func", philox)(*counter, *key) == answer


def test_normals_are_the_inverse_of_the_distribution_function():
    bits = np.concatenate([np.random.default_rng(1).integers(0, 2**32, 20_000), [0, 1, 2**31 - 1, 2**31, 2**32 - 1]])
    normals = [standard_normal(int(b)) for b in bits]
    np.testing.assert_allclose(normals, ndtri((bits + 0.5) / 2**32), rtol=1e-14, atol=1e-15)


def test_uniforms_have_unit_variance_and_stay_within_the_root_of_three():
    assert standard_uniform(0) == pytest.approx(-np.sqrt(3.0))
    assert standard_uniform(ONES) == pytest.approx(np.sqrt(3.0))


@pytest.mark.parametrize(("uniform", "kurtosis"), [(False, 3.0), (True, 1.8)])
def test_moments_and_independence_of_the_numbers_of_a_draw(uniform, kurtosis):
    draws = 50_000
    noise = np.empty((draws, 8))
    for draw in range(draws):
        fill_noise(7, draw, uniform, noise[draw])
    tolerance = 5.0 / np.sqrt(draws)
    np.testing.assert_allclose(noise.T @ noise / draws, np.eye(8), atol=tolerance * np.sqrt(2.0))
    np.testing.assert_allclose((noise**4).mean(axis=0), kurtosis, atol=tolerance * np.sqrt(96.0))
    neighbours = (noise[1:] * noise[:-1]).mean(axis=0)
    np.testing.assert_allclose(neighbours, 0.0, atol=tolerance)


def test_seeds_and_draws_beyond_32_bits_count():
    rows = np.empty((4, 4))
    for row, (seed, draw) in zip(rows, [(1, 1), (1, 1 + 2**32), (1 + 2**32, 1), (1, 2)], strict=True):
        fill_noise(seed, draw, False, row)
    assert len(np.unique(rows)) == 16
