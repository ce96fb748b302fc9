"""``joint`` as a method: cold starts from raw stamps alone, honest from the first fix on, and starting again."""

import msgspec
import numpy as np
import pytest
from joint_builders import LAB_M, ROOM_M, Case, begun, episode_of, kept, observations_of, settings_of

from skyless.constants import TICK_RATE_HZ
from skyless.positioning.fix import Fix, NoFixReason
from skyless.positioning.joint_tracking import JointTracking

PLAIN, MESH = Case(), Case(mesh=True)


def fixes_of(tracking, observations, path_m):
    """Number of each packet that made a fix, the fix, and its error."""
    for k, observation in enumerate(observations):
        result = tracking.hear(observation)
        if isinstance(result, Fix):
            yield k, result, result.position_m - path_m[k]


@pytest.mark.parametrize("case", [PLAIN, MESH], ids=["plain", "mesh"])
@pytest.mark.parametrize(("anchors_m", "height_m"), [(LAB_M, 0.0), (ROOM_M, None)], ids=["2-D", "3-D"])
def test_fixes_are_honest_from_the_first_on(case, anchors_m, height_m):
    """Two superframes make a start, without a word of any master; over many starts errors are as large as said."""
    dim = 3 if height_m is None else 2
    squares = {0: [], 30: [], 100: []}
    for seed in range(60):
        episode = episode_of(case, 25, seed, anchors_m)
        tracking = JointTracking(settings_of(case, height_m))
        fixes = list(fixes_of(tracking, observations_of(episode, anchors_m), episode.path_m))
        assert fixes[0][0] == 2 * len(anchors_m)
        assert len(fixes) > 0.99 * (len(episode.path_m) - 2 * len(anchors_m))
        for place, found in squares.items():
            error, P = fixes[place][2][:dim], fixes[place][1].covariance_m2[:dim, :dim]
            found.append(error @ np.linalg.solve(P, error) / dim)
    assert 0.3 < np.mean(squares[0]) < 1.3  # it is taken to move faster than it does
    assert 0.5 < np.mean(squares[30]) < 1.35
    assert 0.7 < np.mean(squares[100]) < 1.35


def neighbours_only(observation, n):
    """An anchor that hears only those beside it."""
    near = {(observation.anchor + 1) % n, (observation.anchor - 1) % n}
    return msgspec.structs.replace(observation, relays=tuple(r for r in observation.relays if r[0] in near))


def test_clocks_lead_from_anchor_to_anchor():
    episode = episode_of(MESH, 60)
    observations = [neighbours_only(o, len(LAB_M)) for o in observations_of(episode, LAB_M)]
    fixes = list(fixes_of(JointTracking(settings_of(MESH)), observations, episode.path_m))
    assert fixes[0][0] < 3 * len(LAB_M)
    assert max(np.linalg.norm(error) for _, _, error in fixes) < 0.15


def test_without_any_link_between_clocks_there_is_no_start():
    episode = episode_of(MESH, 30)
    tracking = JointTracking(settings_of(MESH))
    bare = [msgspec.structs.replace(o, relays=()) for o in observations_of(episode, LAB_M)]
    assert {tracking.hear(o) for o in bare} <= {NoFixReason.TOO_FEW_ANCHORS, NoFixReason.ACQUIRING}


def test_an_anchor_that_was_never_heard_of_joins_later():
    episode = episode_of(MESH, 60)
    tracking = JointTracking(settings_of(MESH))
    late = [o for k, o in enumerate(observations_of(episode, LAB_M)) if o.anchor != 5 or k > 180]
    results = [tracking.hear(o) for o in late]
    assert tracking.clock(5) is not None
    assert isinstance(results[-1], Fix)
    assert set(results[-1].anchors) == set(range(6))
    assert tracking.clock(77) is None


def test_clocks_are_known():
    """The tag's clock less each anchor's, to the noise of the stamps, against the stamps themselves."""
    episode = episode_of(MESH, 60)
    tracking = JointTracking(settings_of(MESH))
    observations = list(observations_of(episode, LAB_M))
    for observation in observations:
        tracking.hear(observation)
    for observation in observations[-6:]:
        whole, rest_m, rate_mps = tracking.clock(observation.anchor)
        measured = observation.rx_ticks_tag - observation.tx_ticks_anchor
        flight_m = np.linalg.norm(episode.path_m[-1] - LAB_M[observation.anchor])
        age_s = (observations[-1].rx_ticks_tag - observation.rx_ticks_tag) / TICK_RATE_HZ
        offset_m = (measured - whole) * 0.0046918 - flight_m + age_s * rate_mps
        assert abs(offset_m - rest_m) < 0.3


def test_a_long_silence_and_a_tag_that_was_carried_away_mean_a_new_start():
    first, second = episode_of(MESH, 40, 1), episode_of(MESH, 40, 2)
    tracking = JointTracking(settings_of(MESH))
    assert list(fixes_of(tracking, observations_of(first, LAB_M), first.path_m))
    gap = int(10.0 * TICK_RATE_HZ) + int(first.messages.rx_ticks[-1] - second.messages.rx_ticks[0])
    later = [msgspec.structs.replace(o, rx_ticks_tag=o.rx_ticks_tag + gap) for o in observations_of(second, LAB_M)]
    fixes = list(fixes_of(tracking, later, second.path_m))
    assert fixes[0][0] == 2 * len(LAB_M)
    assert max(np.linalg.norm(error) for _, _, error in fixes) < 0.15


def test_a_filter_that_is_wrong_starts_anew():
    episode = episode_of(MESH, 80)
    tracking = JointTracking(settings_of(MESH))
    errors = {}
    for k, observation in enumerate(observations_of(episode, LAB_M)):
        if k == 200:
            tracking.filter.arrays.x[:2] += 5.0
        result = tracking.hear(observation)
        if isinstance(result, Fix):
            errors[k] = np.linalg.norm(result.position_m - episode.path_m[k])
    assert max(error for k, error in errors.items() if k < 200 or k > 240) < 0.15
    assert max(errors) == len(episode.path_m) - 1


def test_wide_states_stay_honest_near_anchors():
    """At 0.7 m ranges of a few metres are curved by more than the stamps' noise; taken as straight, NEES is 1.74."""
    nees = []
    for seed in range(100):
        episode = episode_of(MESH, 40, seed)
        keep = np.random.default_rng(seed + 50).random(len(episode.path_m)) >= 0.8
        keep[:12] = True
        heard = kept(episode.messages, keep)
        joint = begun(episode, settings_of(MESH), std_m=0.7, seed=seed)
        motions, variances = np.empty((len(heard.sites), 4)), np.empty((len(heard.sites), 4))
        joint.track(heard, motions, variances)
        errors, said = motions[12:, :2] - episode.path_m[keep][12:, :2], variances[12:].reshape(-1, 2, 2)
        nees.append(np.einsum("ni,nij,nj->n", errors, np.linalg.inv(said), errors).mean() / 2.0)
    assert np.mean(nees) < 1.4


def test_a_wrong_place_that_the_anchors_contradict_is_left():
    """With most messages lost, a wrong place makes wrong clocks that fit; what anchors heard of each other does not."""
    episode = episode_of(MESH, 400, 3)
    keep = np.random.default_rng(5).random(len(episode.path_m)) >= 0.6
    tracking, errors = JointTracking(settings_of(MESH)), []
    for k, observation in enumerate(observations_of(episode, LAB_M)):
        if k == 600:
            s = tracking.filter.arrays
            s.x[:2] += 2.0
            for slot in range(6):
                towards = s.x[:2] - LAB_M[slot, :2]
                s.x[2 + slot] -= np.linalg.norm(towards) - np.linalg.norm(towards - 2.0)
        if keep[k]:
            result = tracking.hear(observation)
            if isinstance(result, Fix) and k > 1200:
                errors.append(np.linalg.norm(result.position_m - episode.path_m[k]))
    assert len(errors) > 300
    assert max(errors) < 0.15


def test_a_covariance_that_is_none_any_more_leads_to_a_new_start():
    episode = episode_of(MESH, 60)
    tracking, observations = JointTracking(settings_of(MESH)), list(observations_of(episode, LAB_M))
    half = len(observations) // 2
    assert list(fixes_of(tracking, observations[:half], episode.path_m))
    tracking.filter.arrays.P[0, 0] = np.nan
    errors_m = [np.linalg.norm(error) for _, _, error in fixes_of(tracking, observations[half:], episode.path_m[half:])]
    assert len(errors_m) > half // 2
    assert max(errors_m) < 0.2
