"""Heights that a tag is given: by a sensor among anchors in one plane, and by settings, with their uncertainty."""

import numpy as np
import pytest
from estimator_builders import MESH, ROOM_M, begun, episode_of, settings_of, tracked

from skyless.core.alert import Alert
from skyless.core.any_receiver import AnyReceiver
from skyless.core.fix import Fix
from skyless.core.integrity import HPL
from support.bench import LAB, LOFT, tape

pytestmark = pytest.mark.site

STD_M = 0.03


def heard_with_heights(position, height_of, seconds=6.0):
    """The last fixes of a tag whose sensor speaks after every packet, and whether what it said was used."""
    receiver, fixes, used = AnyReceiver(), [], []
    for one in tape(LOFT, seconds, position=position):
        fix = receiver.hear(one.reception)
        if isinstance(fix, Fix):
            fixes.append(fix)
        used.append(receiver.hear_height(height_of(one), STD_M))
    return fixes, used


@pytest.mark.parametrize("z_m", [5.0, 7.0, 3.0], ids=["in the plane", "above", "below"])
@pytest.mark.statistical
def test_the_sensor_tells_the_height_and_which_side_it_is(z_m):
    random = np.random.default_rng(1)
    fixes, used = heard_with_heights((3.0, 4.0, z_m), lambda one: one.truth_m[2] + random.normal(0.0, STD_M))
    assert sum(used) > 0.99 * len(fixes)
    for fix in fixes[-200:]:
        assert np.linalg.norm(fix.position_m - (3.0, 4.0, z_m)) < 6.0 * fix.std_m
        assert fix.alert == Alert.NONE
        assert abs(fix.position_m[2] - z_m) < fix.vpl_m < 0.5


def test_single_wild_heights_are_left_out():
    random = np.random.default_rng(1)

    def wild(one):
        return one.truth_m[2] + random.normal(0.0, STD_M) + (3.0 if random.random() < 0.1 else 0.0)

    fixes, used = heard_with_heights((3.0, 4.0, 5.0), wild)
    assert 0.85 < sum(used) / len(fixes) < 0.95
    assert all(abs(fix.position_m[2] - 5.0) < 0.1 for fix in fixes[-200:])


def test_a_sensor_that_never_fits_leads_to_a_new_start():
    """The side of the plane was wrong, as the owner had said that it could only be the lower one."""
    receiver, places = AnyReceiver(z_bounds_m=(0.0, 5.0)), []
    for k, one in enumerate(tape(LOFT, 6.0, position=(3.0, 4.0, 6.5))):
        fix = receiver.hear(one.reception)
        if isinstance(fix, Fix):
            places.append(fix.position_m[2])
        if k == 1000:
            assert places[-1] < 5.1
        if k > 1000:
            receiver.hear_height(6.5, STD_M)
    assert abs(places[-1] - 6.5) < 0.1


@pytest.mark.parametrize(("height_m", "std_m"), [(np.nan, 1.0), (1.0, 0.0), (1.0, np.inf), (1.0, -1.0)])
def test_what_is_no_height_is_refused(height_m, std_m):
    with pytest.raises(ValueError, match="height"):
        AnyReceiver().hear_height(height_m, std_m)


def test_a_method_without_states_has_no_use_for_it():
    receiver = AnyReceiver("literal")
    assert not receiver.hear_height(1.0, 0.1)
    for one in tape(LAB, 1.0):
        receiver.hear(one.reception)
    assert not receiver.hear_height(0.0, 0.1)


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
