"""Protection levels: sensitivities against finite differences, evidence against statistics, levels against errors."""

import numpy as np
import pytest
from joint_builders import LAB_M, ROOM_M, Case, begun, episode_of, kept, observations_of, packets_of, settings_of
from msgspec.structs import replace
from scipy.stats import chi2

from skyless.constants import TICK_M
from skyless.experiments.studies.integrity import Setting, run_chunk
from skyless.experiments.studies.integrity_faults import Fault
from skyless.positioning.fix import Fix
from skyless.positioning.joint_report import places_excluded
from skyless.positioning.joint_soundness import is_sound
from skyless.positioning.joint_state import BASE, EPOCH, EVIDENCE, EXCLUDED, JUMPS, SLOTS, values
from skyless.positioning.joint_tracking import JointTracking
from skyless.positioning.protection import Alert, IntegrityRequirement, integrity_of, limits_of
from skyless.positioning.protection_levels import HPL, LEVELS, VPL, protect
from skyless.positioning.protection_updates import SHORT
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


def chunk_of(fault, seed, episodes, risk=RISK, limit_m=None):
    seeds = tuple(np.random.SeedSequence(seed).spawn(episodes))
    return run_chunk((Setting(Case(mesh=True), fault, risk, limit_m), seeds))


@pytest.mark.parametrize("place", ["lab", "room"])
@pytest.mark.parametrize(
    ("size_m", "kind", "available"),
    [
        *((0.0, "step", 0.99), (0.05, "step", 0.9), (0.1, "step", 0.5), (0.3, "step", 0.95), (2.0, "step", 0.9)),
        *((1.0, "ramp", 0.8), (0.3, "early", 0.9), (1.5, "bursts", 0.9), (0.3, "delay", 0.6)),
    ],
)
def test_levels_hold(place, size_m, kind, available):
    counts = chunk_of(Fault(place, size_m, kind), 5, 12).counts
    epochs, promised, across, above = counts.sum(axis=0)
    assert across == above == 0  # of 5000 epochs that share some hundred independent errors
    assert promised / epochs > available


def test_levels_are_not_much_larger_than_need_be():
    assert 0.5 < chunk_of(Fault("lab"), 6, 40).top[-1] < 1.0


def test_lax_levels_are_exceeded_less_often_than_stated_and_not_never():
    """At a risk of 3 % errors beyond the level are frequent enough to be counted: of noise alone, and with a fault."""
    for fault, most in ((Fault("lab"), 1.0), (Fault("room", 0.1), 1.0)):
        epochs, _, across, _ = chunk_of(fault, 7, 60, risk=0.03).counts.sum(axis=0)
        assert 0.0 < across / epochs < most * 0.03


def test_an_alert_limit_costs_availability_alone():
    free, limited = (chunk_of(Fault("lab", 0.05), 8, 6, limit_m=limit_m).counts.sum(axis=0) for limit_m in (None, 0.07))
    assert free[0] == limited[0]
    assert 0 < limited[1] < free[1]


def test_a_coarse_fault_is_excluded_and_covered():
    case = Case(mesh=True)
    episode = episode_of(case, 100)
    joint = heard(episode, late(episode.messages, 1, 1000, since=300), settings_of(case))
    told = integrity(joint)
    assert told.alert is Alert.EXCLUDED
    assert told.hpl_m is not None
    assert np.linalg.norm(joint.motion()[0][:2] - episode.path_m[-1, :2]) < told.hpl_m < 0.2


def alerts_and_slots(episode, messages, settings):
    """Of each packet what its fix says, and which anchors the monitor leaves out."""
    joint, told = begun(episode, settings), []
    for packet in packets_of(messages):
        joint.hear(*packet)
        told.append((integrity(joint), tuple(places_excluded(joint.arrays))))
    return told


def test_an_anchor_that_is_left_out_is_told_and_one_that_is_taken_back_no_more():
    case, anchor = Case(mesh=True), 2
    episode = episode_of(case, 134)
    half = late(episode.messages, anchor, 45, since=200)  # 0.21 m, within the gate for many packets
    messages = late(half, anchor, -45, since=500)
    told = alerts_and_slots(episode, messages, settings_of(case))
    out = [k for k, (_, excluded) in enumerate(told) if excluded]
    assert out
    assert {excluded for _, excluded in told if excluded} == {(anchor,)}
    assert {told[k][0].alert for k in out[40:-40]} == {Alert.EXCLUDED}
    assert all(told[k][0].hpl_m is not None for k in out[40:-40])
    assert out[-1] < 620  # taken back soon after its messages were in time again
    assert told[-1][0].alert is Alert.NONE
    assert told[-1][0].hpl_m == pytest.approx(told[150][0].hpl_m, rel=0.5)


@pytest.mark.parametrize("packets", [10_000, 20_000, 40_000])
def test_what_an_anchor_did_that_is_out_for_long_spoils_no_level(packets):
    """Sensitivities and evidence fade until floating point has no number so small, the squares of sums first."""
    case, anchor = Case(mesh=True), 1
    episode, settings = episode_of(case, 100, anchors_m=ROOM_M), settings_of(case, height_m=None)
    messages = late(episode.messages, anchor, 1000, since=300)
    joint = begun(episode, settings, ROOM_M)
    for packet in packets_of(messages):
        joint.hear(*packet)
    before = joint.levels.copy()
    s, covariance = joint.arrays, joint.motion()[1]
    slot, fading = s.slot_of[anchor], 1.0 - 1.0 / (SHORT * len(ROOM_M))
    assert s.slots[slot, EXCLUDED]
    s.sensitivities[:, slot] *= 1e-6 ** (packets / 1000)
    s.evidence[:2, slot] *= fading**packets
    s.evidence[2, slot] *= fading ** (2 * packets)
    protect(s, covariance, limits_of(RISK), joint.levels)
    assert np.isfinite(joint.levels).all()
    assert joint.levels[[HPL, VPL]] == pytest.approx(before[[HPL, VPL]], rel=0.05)


def test_two_that_are_left_out_leave_nothing_to_promise():
    case = Case(mesh=True)
    episode = episode_of(case, 134)
    messages = late(late(episode.messages, 1, 40, since=300), 4, 40, since=300)
    twice = [told for told, excluded in alerts_and_slots(episode, messages, settings_of(case)) if len(excluded) == 2]
    assert twice
    assert {(one.alert, one.hpl_m) for one in twice} == {(Alert.NOT_EXCLUDED, None)}


def test_too_few_anchors_for_a_position_leave_nothing_to_promise():
    """What two ranges do not see in the plane, none tells: neither that the tag turns, nor how far it is off."""
    case, since = Case(mesh=True), 300
    episode = episode_of(case, 134)
    for left, alert in ((3, Alert.NONE), (2, Alert.UNAVAILABLE)):
        m = episode.messages
        messages = kept(m, (np.arange(len(m.sites)) < since) | (m.sites < left))
        joint = heard(episode, messages, settings_of(case, drop_s=0.1))
        assert joint.arrays.counts[SLOTS] == left
        assert integrity(joint).alert is alert
        assert (integrity(joint).hpl_m is None) == (left == 2)


def test_nothing_is_promised_until_the_filter_has_settled_after_an_anchor_restarts():
    case, anchor, since = Case(mesh=True), 3, 300
    episode = episode_of(case, 134)
    messages = episode.messages
    tx_ticks = messages.tx_ticks.copy()
    tx_ticks[since:][messages.sites[since:] == anchor] += 10**9
    relays = messages.relays.copy()
    begun_again = (relays[:, 2] >= messages.sequences[since]) & (relays[:, 0] == anchor)
    relays[begun_again, 3] += 10**9
    joint = begun(episode, settings_of(case))
    alerts = []
    for packet in packets_of(replace(messages, tx_ticks=tx_ticks, relays=relays)):
        joint.hear(*packet)
        alerts.append(integrity(joint).alert)
    restarted = alerts.index(Alert.UNAVAILABLE, since)
    assert restarted < since + 6 * len(LAB_M)
    assert set(alerts[restarted : restarted + 6 * len(LAB_M)]) == {Alert.UNAVAILABLE}
    assert alerts[-1] is Alert.NONE


def test_an_anchor_whose_stamps_contradict_one_another_joins_anew_but_seldom():
    """Its packets are late for all, as with a wrong antenna delay: no offset of its clock fits."""
    case = Case(mesh=True)
    episode = episode_of(case, 134)
    messages = late(episode.messages, 2, 320)
    relays = messages.relays.copy()
    relays[relays[:, 1] == 2, 3] += 320
    joint = heard(episode, replace(messages, relays=relays), settings_of(case))
    assert joint.arrays.counts[JUMPS] <= 1
    assert np.linalg.norm(joint.motion()[0][:2] - episode.path_m[-1, :2]) < 0.1


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


@pytest.mark.parametrize("limit_m", [0.0, -1.0, float("inf"), float("nan")])
def test_impossible_alert_limits_are_refused(limit_m):
    with pytest.raises(ValueError, match="alert_limit_m is"):
        IntegrityRequirement(alert_limit_m=limit_m)


@pytest.mark.parametrize("risk", [0.0, -1e-4, 0.5, float("nan")])
def test_impossible_risks_are_refused(risk):
    for refuse in (limits_of, IntegrityRequirement):
        with pytest.raises(ValueError, match="risk is"):
            refuse(risk)


def test_arrays_of_another_length_are_not_sound():
    case = Case()
    episode = episode_of(case, 5)
    joint = heard(episode, episode.messages, settings_of(case))
    joint._addresses = None
    assert is_sound(joint)
    joint._exchanged = joint._exchanged._replace(levels=np.zeros(LEVELS - 1))
    assert not is_sound(joint)


def test_settings_of_another_kind_are_not_sound():
    case = Case()
    episode = episode_of(case, 5)
    joint = heard(episode, episode.messages, settings_of(case))
    joint._addresses = None
    joint._arrays = joint.arrays._replace(settings=joint.arrays.settings.astype(np.float32))
    assert not is_sound(joint)
