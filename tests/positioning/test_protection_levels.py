"""Protection levels: sensitivities against finite differences, evidence against statistics, levels against errors."""

import numpy as np
import pytest
from joint_builders import LAB_M, Case, begun, episode_of, observations_of, packets_of, settings_of
from msgspec.structs import replace
from scipy.stats import chi2

from skyless.constants import TICK_M
from skyless.experiments.studies.integrity import Fault, run_chunk
from skyless.positioning.fix import Fix
from skyless.positioning.joint_soundness import is_sound
from skyless.positioning.joint_state import BASE, EPOCH, EVIDENCE, values
from skyless.positioning.joint_tracking import JointTracking
from skyless.positioning.protection import Alert, integrity_of, limits_of
from skyless.positioning.protection_levels import LEVELS
from skyless.ticks import to_seconds

RISK = 1e-4


def late(messages, anchor, ticks, since=0):
    rx_ticks = messages.rx_ticks.copy()
    rx_ticks[since:][messages.sites[since:] == anchor] += ticks
    return replace(messages, rx_ticks=rx_ticks)


def tracked(episode, messages, settings):
    joint = begun(episode, settings)
    joint.track(messages)
    return joint


def heard(episode, messages, settings):
    joint = begun(episode, settings)
    for packet in packets_of(messages):
        joint.hear(*packet)
    return joint


def integrity(joint):
    return integrity_of(joint.levels, RISK, True, None)


@pytest.mark.parametrize("mesh", [False, True])
def test_sensitivities_are_what_a_fault_does_to_the_state(mesh):
    case, anchor, ticks = Case(mesh=mesh), 2, 8
    episode, settings = episode_of(case), settings_of(case, gate=1e6)
    clean = tracked(episode, episode.messages, settings)
    faulty = tracked(episode, late(episode.messages, anchor, ticks), settings)
    s = clean.arrays
    slot, half = s.slot_of[anchor], values(s)
    tau_s = to_seconds(int(s.counts[EPOCH] - s.counts[BASE]))
    expected = s.sensitivities[:2, slot] + tau_s * s.sensitivities[half : half + 2, slot]
    moved = (faulty.motion()[0][:2].copy() - clean.motion()[0][:2]) / (ticks * TICK_M)
    assert np.linalg.norm(expected) > 0.02
    assert moved == pytest.approx(expected, rel=0.05, abs=0.003)


def test_evidence_finds_the_size_of_a_fault():
    case, anchor, ticks = Case(mesh=True), 3, 8
    episode, settings = episode_of(case), settings_of(case, gate=1e6)
    sizes = []
    for late_ticks in (0, ticks):
        s = tracked(episode, late(episode.messages, anchor, late_ticks), settings).arrays
        y, a, _ = s.evidence[EVIDENCE : 2 * EVIDENCE, s.slot_of[anchor]]
        sizes.append(y / a)
    assert sizes[1] - sizes[0] == pytest.approx(ticks * TICK_M, rel=0.05)


def test_statistics_of_clean_data_are_normal():
    case = Case(mesh=True)
    squares = []
    for seed in range(80):
        episode = episode_of(case, 60, seed)
        s = begun(episode, settings_of(case), seed=seed + 1000)
        s.track(episode.messages)
        slot = s.arrays.slot_of[seed % len(LAB_M)]
        rows = s.arrays.evidence[: 2 * EVIDENCE, slot].reshape(2, EVIDENCE)
        squares.append(np.square(rows[:, 0]) / rows[:, 2])
    total = np.sum(squares, axis=0)
    low, high = chi2.ppf([0.0005, 0.9995], 80)
    assert np.all((low < total) & (total < high))


@pytest.mark.parametrize("place", ["lab", "room"])
@pytest.mark.parametrize(("size_m", "available"), [(0.0, 0.99), (0.05, 0.5), (0.1, 0.2), (2.0, 0.9)])
def test_levels_hold(place, size_m, available):
    seeds = tuple(np.random.SeedSequence(5).spawn(12))
    epochs, promised, across, above = run_chunk((Case(mesh=True), Fault(place, size_m), seeds)).sums[:4]
    assert across == above == 0  # of 7000 epochs that share some hundred independent errors
    assert promised / epochs > available


def test_levels_are_not_much_larger_than_need_be():
    seeds = tuple(np.random.SeedSequence(6).spawn(40))
    chunk = run_chunk((Case(mesh=True), Fault("lab"), seeds))
    assert 0.5 < chunk.top[-1] < 1.0


def test_a_coarse_fault_is_excluded_and_covered():
    case = Case(mesh=True)
    episode = episode_of(case, 100)
    joint = heard(episode, late(episode.messages, 1, 1000, since=300), settings_of(case))
    told = integrity(joint)
    assert told.alert is Alert.EXCLUDED
    assert told.hpl_m is not None
    assert np.linalg.norm(joint.motion()[0][:2] - episode.path_m[-1, :2]) < told.hpl_m < 0.2


def test_two_coarse_faults_leave_nothing_to_promise():
    case = Case(mesh=True)
    episode = episode_of(case, 80)
    messages = late(late(episode.messages, 1, 1000, since=300), 2, 1000, since=300)
    told = integrity(heard(episode, messages, settings_of(case)))
    assert (told.alert, told.hpl_m, told.vpl_m) == (Alert.NOT_EXCLUDED, None, None)


def test_a_filter_that_has_just_begun_promises_nothing():
    case = Case(mesh=True)
    episode = episode_of(case, 5)
    told = integrity(heard(episode, episode.messages, settings_of(case)))
    assert (told.alert, told.hpl_m) == (Alert.UNAVAILABLE, None)


def test_batch_and_streaming_follow_faults_alike():
    case = Case(mesh=True)
    episode, settings = episode_of(case), settings_of(case)
    batch, stream = (take(episode, episode.messages, settings).arrays for take in (tracked, heard))
    assert np.array_equal(batch.sensitivities, stream.sensitivities)
    assert np.array_equal(batch.evidence, stream.evidence)
    assert np.array_equal(batch.recent, stream.recent)


def test_fixes_carry_levels_and_alert_limit():
    case = Case(mesh=True)
    episode = episode_of(case, 60)
    for limit_m, alert in ((None, Alert.NONE), (0.01, Alert.LIMIT), (10.0, Alert.NONE)):
        tracking = JointTracking(settings_of(case, alert_limit_m=limit_m))
        fixes = [fix for fix in map(tracking.hear, observations_of(episode, LAB_M)) if isinstance(fix, Fix)]
        assert fixes[0].alert is Alert.UNAVAILABLE
        assert fixes[-1].alert is alert
        assert 0.02 < fixes[-1].hpl_m < 0.2
        assert fixes[-1].vpl_m is None  # the height is given
        assert fixes[-1].integrity_risk == RISK


def test_a_smaller_risk_gives_larger_levels():
    strict, lax = limits_of(1e-7), limits_of(1e-3)
    assert np.all(strict[:2] > lax[:2])


@pytest.mark.parametrize("risk", [0.0, -1e-4, 0.5, float("nan")])
def test_impossible_risks_are_refused(risk):
    with pytest.raises(ValueError, match="risk is"):
        limits_of(risk)


def test_arrays_of_another_length_are_not_sound():
    case = Case()
    episode = episode_of(case, 5)
    joint = heard(episode, episode.messages, settings_of(case))
    assert is_sound(joint)
    joint._levels = np.zeros(LEVELS - 1)
    assert not is_sound(joint)
