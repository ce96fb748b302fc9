"""A given height that is not the tag's: its uncertainty is in fixes and levels."""

import numpy as np
import pytest
from estimator_builders import MESH, ROOM_M, begun, episode_of, settings_of, tracked

from skyless.core.integrity import HPL

pytestmark = pytest.mark.site

HEIGHT_STD_M = 0.3
EPISODES = 40
SETTLED = 120
"""Packets after which an episode is judged."""


def runs_of(height_std_m):
    """Episodes of tags at other heights than the one that is given, and what the estimator says of them."""
    for seed in range(EPISODES):
        path_m = episode_of(MESH, 40, seed, ROOM_M).path_m.copy()
        path_m[:, 2] = np.random.default_rng(seed).normal(0.0, HEIGHT_STD_M)
        episode = episode_of(MESH, 40, seed, ROOM_M, path_m=path_m)
        run = tracked(begun(episode, settings_of(height_std_m=height_std_m), ROOM_M), episode.packets)
        yield run.errors(episode)[SETTLED:], run.covariances[SETTLED:], run.levels[SETTLED:]


def nees_of_ends(runs):
    """Of the last packet of each episode, which are independent, over its degrees of freedom."""
    ends = [error[-1] @ np.linalg.solve(covariance[-1], error[-1]) for error, covariance, _ in runs]
    return sum(ends) / (2 * EPISODES)


@pytest.mark.statistical
def test_the_covariance_counts_the_height():
    runs = list(runs_of(HEIGHT_STD_M))
    # χ² of 80 degrees of freedom, 0.1 % on either side
    assert 0.57 < nees_of_ends(runs) < 1.56
    assert not any((np.hypot(*error.T) > levels[:, HPL]).any() for error, _, levels in runs)


def test_a_height_that_is_called_exact_is_believed():
    """So that the test above tells something."""
    runs = list(runs_of(0.0))
    assert nees_of_ends(runs) > 3.0


@pytest.mark.parametrize("height_std_m", [0.0, HEIGHT_STD_M])
@pytest.mark.statistical
def test_what_is_told_is_the_given_height(height_std_m):
    episode = episode_of(MESH, 10, 1, ROOM_M)
    estimator = begun(episode, settings_of(height_std_m=height_std_m), ROOM_M)
    estimator.track(episode.packets)
    assert estimator.process_height(0.0, 0.1) == 1
    assert estimator.state.fix[0][2] == 0.0
