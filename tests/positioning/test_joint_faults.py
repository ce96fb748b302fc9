"""Whom ``joint`` leaves out: the choice against dense least squares, and in worlds where anchors lie from the start."""

from itertools import combinations

import numpy as np
import pytest
from joint_builders import LAB_M, ROOM_M, Case, begun, episode_of, kept, packets_of, settings_of, with_syncs
from msgspec.structs import replace

from skyless.constants import TICK_M
from skyless.experiments.studies import nlos
from skyless.experiments.studies.plan import Plan
from skyless.experiments.studies.worlds import run_world
from skyless.positioning.joint_faults import EARLY, FAULTY, SECOND, exclude_likeliest
from skyless.positioning.joint_report import places_excluded
from skyless.positioning.joint_state import EVIDENCE, EXCLUDED, EXCLUSIONS, READMISSIONS, REFUSED, SLOTS, SYNCS_USED

CASE = Case(qa=0.02, mesh=True)


def late(messages, late_m):
    """The messages with the tag's receptions late by so much for each anchor."""
    shift = np.rint(np.asarray(late_m)[messages.sites] / TICK_M).astype(np.int64)
    return replace(messages, rx_ticks=messages.rx_ticks + shift)


def excluded(s):
    return tuple(np.flatnonzero(s.slots[: s.counts[SLOTS], EXCLUDED]).tolist())


def test_what_slots_share_is_their_information():
    episode = episode_of(CASE, 100)
    joint = begun(episode, settings_of(CASE))
    joint.track(episode.messages)
    s, n = joint.arrays, int(joint.arrays.counts[SLOTS])
    information = -s.shared[:n, :n]
    assert np.array_equal(information, information.T)
    assert np.linalg.eigvalsh(information).min() > -1e-12 * information.max()  # what all have in common is not seen
    assert np.diag(information) == pytest.approx(s.evidence[EVIDENCE + 1, :n], rel=1e-9)
    assert not s.evidence[REFUSED].any()
    assert not np.delete(s.shared, np.s_[:n], axis=1).any()


def likeliest(y, information, most):
    """By least squares over all sets of one and two faults."""
    best, found = FAULTY, ()
    for count in range(1, most + 1):
        for fault in combinations(range(len(y)), count):
            part = information[np.ix_(fault, fault)]
            size_m = np.linalg.solve(part, y[list(fault)])
            explained = size_m @ part @ size_m - SECOND * (count - 1) - EARLY * np.count_nonzero(size_m < 0.0)
            if explained > best:
                best, found = explained, fault
    return found


@pytest.mark.parametrize(("anchors", "most"), [(6, 2), (5, 1), (4, 1)])
def test_faults_that_explain_most_are_left_out(anchors, most):
    """In the plane three anchors are what a fix needs; two liars are told among six or more."""
    episode = episode_of(CASE, 20, anchors_m=ROOM_M[:anchors])
    s = begun(episode, settings_of(CASE), ROOM_M[:anchors])
    s.track(episode.messages)
    s, draw, sizes = s.arrays, np.random.default_rng(anchors), set()
    for _ in range(300):
        responses = draw.normal(size=(40, anchors))
        information = responses.T @ responses
        y = draw.choice([0.0, 1.0, -1.0], anchors, p=[0.6, 0.3, 0.1]) @ information + draw.normal(0.0, 6.0, anchors)
        s.shared[:anchors, :anchors] = -information
        s.evidence[EVIDENCE, :anchors] = y
        s.slots[:, EXCLUDED] = 0
        exclude_likeliest(s, 0.0)
        assert excluded(s) == likeliest(y, information, most)
        sizes.add(len(excluded(s)))
    assert sizes == set(range(most + 1))


def test_none_is_left_out_that_a_fix_needs():
    episode = episode_of(CASE, 20, anchors_m=ROOM_M[:3])
    joint = begun(episode, settings_of(CASE), ROOM_M[:3])
    joint.track(episode.messages)
    joint.arrays.evidence[EVIDENCE, :3] = (100.0, 200.0, 300.0)
    assert not exclude_likeliest(joint.arrays, 0.0)
    assert excluded(joint.arrays) == ()


@pytest.mark.parametrize("late_m", [(0.1, 0.1), (0.3, 0.3), (1.5, 0.2)])
def test_two_that_are_always_off_are_left_out(late_m):
    for seed in range(3):
        biases, liars = np.zeros(len(LAB_M)), (seed, seed + 2)
        biases[list(liars)] = late_m
        episode = episode_of(CASE, 300, seed)
        joint = begun(episode, settings_of(replace(CASE, qa=0.3)))
        joint.track(late(episode.messages, biases))
        assert tuple(sorted(places_excluded(joint.arrays))) == liars


def test_a_wrong_choice_is_mended():
    episode = episode_of(CASE, 300)
    messages = late(episode.messages, [0.0, 0.0, 0.3, 0.0, 0.0, 0.0])
    joint = begun(episode, settings_of(replace(CASE, qa=0.3)))
    s = joint.arrays
    for k, packet in enumerate(packets_of(messages)):
        joint.hear(*packet)
        if k == 20:
            assert s.slots[0, EXCLUDED] == 0
            s.slots[0, EXCLUDED] = 1
    assert places_excluded(joint.arrays) == [2]
    assert (s.counts[EXCLUSIONS], s.counts[READMISSIONS]) == (1, 1)
    assert np.linalg.norm(joint.motion()[0][:2] - episode.path_m[-1, :2]) < 0.1


@pytest.mark.parametrize("seed", [1, 77, 4242])
def test_a_liar_from_the_start_on_costs_no_more_than_the_anchor(seed):
    """Six anchors instead of seven cost a sixth; with these seeds tags once began by leaving out another anchor."""
    cases = {case.name: case for case in nlos.cases(Plan(seed=seed, quick=True, worlds=4, tags=2))}
    squared = {}
    for name in (nlos.CLEAN, "one anchor +0.3 m"):
        results = [run_world(replace(run, until_s=8.0)) for run in cases[name].runs]
        squared[name] = sum(one.squared_m2 for one in results) / sum(one.fixes for one in results)
    assert squared["one anchor +0.3 m"] <= 1.3**2 * squared[nlos.CLEAN]


def test_what_anchors_say_of_their_clocks_is_no_information_about_faults():
    """With nine tenths lost it is taken often."""
    case = Case(qa=0.3, mesh=True)
    episode = episode_of(case, 600)
    messages = with_syncs(episode.messages, case)
    keep = np.random.default_rng(4).random(len(messages.sites)) < 0.1
    joint = begun(episode, settings_of(case))
    joint.track(kept(messages, keep))
    s, n = joint.arrays, int(joint.arrays.counts[SLOTS])
    assert s.counts[SYNCS_USED] > 100
    assert -np.diag(s.shared[:n, :n]) == pytest.approx(s.evidence[EVIDENCE + 1, :n], rel=1e-6)
