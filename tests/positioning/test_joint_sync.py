"""What anchors say of their clocks, in the joint filter: the theory, the step, its limits, and honesty under loss."""

import numpy as np
import pytest
from joint_builders import LAB_M, SLOT_S, Case, begun, episode_of, kept, packets_of, settings_of, with_syncs
from msgspec.structs import replace

from skyless.air.claim import Claim
from skyless.constants import TICK_M
from skyless.experiments.lab_bound import SPEED_STD_MPS, WHITE_FM
from skyless.experiments.studies.plan import Plan
from skyless.experiments.studies.stage import walking
from skyless.experiments.studies.worlds import run_world
from skyless.positioning.joint_hearing import SYNC_WANTED
from skyless.positioning.joint_report import covariance_of
from skyless.positioning.joint_state import EXCLUDED, SYNCS_REFUSED, SYNCS_USED, states, values
from skyless.positioning.joint_sync import SUBTICKS, WORTH
from skyless.positioning.master_scale import MasterScale
from skyless.positioning.observation import Observation
from skyless.uncertainty.bounds import bound_settings
from skyless.uncertainty.loss_bound import received_bound

PLAIN, MESH = Case(qa=0.3), Case(qa=0.3, mesh=True)
MODULO = SUBTICKS << 40


def test_of_two_filters_the_one_that_has_heard_all_replaces_the_other():
    """Dense, without Skyless: the errors of both filters, of a clock's offset and rate, followed together.

    The tag hears a tenth of what the anchor hears. The best combination of both offsets is the anchor's alone, its
    error is uncorrelated with their difference of variance P − q, and a state that hangs on the tag's offset follows
    by P_xd/P.
    """
    draw, step_s, noise = np.random.default_rng(1), 0.015, 18e-4
    F = np.array([[1.0, step_s], [0.0, 1.0]])
    Q = 0.18 * np.array([[step_s**3 / 3, step_s**2 / 2], [step_s**2 / 2, step_s]]) + np.diag([7.2e-5 * step_s, 0.0])
    h = np.array([1.0, 0.0])
    tag, anchor = np.diag([1.0, 10.0]), np.diag([1.0, 10.0])
    both = np.block([[tag, tag], [tag, anchor]])
    for step in range(400):
        tag, anchor = F @ tag @ F.T + Q, F @ anchor @ F.T + Q
        both = np.kron(np.eye(2), F) @ both @ np.kron(np.eye(2), F).T + np.kron(np.ones((2, 2)), Q)
        heard = step < 2 or draw.random() < 0.1
        gains = [tag @ h / (h @ tag @ h + noise) * heard, anchor @ h / (h @ anchor @ h + noise)]
        tag, anchor = tag - np.outer(gains[0], h @ tag), anchor - np.outer(gains[1], h @ anchor)
        gain = np.concatenate(gains)
        keep = np.eye(4) - np.block(
            [[np.outer(gains[0], h), np.zeros((2, 2))], [np.zeros((2, 2)), np.outer(gains[1], h)]]
        )
        both = keep @ both @ keep.T + noise * np.outer(gain, gain)
    P, q = both[0, 0], both[2, 2]
    assert pytest.approx(tag[0, 0]) == P
    assert 2.0 * q < P
    assert both[0, 2] == pytest.approx(q)
    assert P + q - 2.0 * both[0, 2] == pytest.approx(P - q)
    best = np.linalg.solve(both[np.ix_([0, 2], [0, 2])], np.ones(2))
    assert best / best.sum() == pytest.approx([0.0, 1.0], abs=1e-9)
    errors = draw.multivariate_normal(np.zeros(4), both, 20_000)
    other = 0.7 * errors[:, 0] + draw.normal(0.0, 0.01, 20_000)
    cross, variance = 0.7 * P, 0.49 * P + 1e-4
    followed = other + cross / P * (errors[:, 2] - errors[:, 0])
    assert np.var(followed) == pytest.approx(variance - cross**2 * (P - q) / P**2, rel=0.05)


def lost(case, share, seed, superframes=100):
    """An episode, and its messages with syncs of which a share is lost; the first two superframes are heard."""
    episode = episode_of(case, superframes, seed)
    messages = with_syncs(episode.messages, case)
    draw = np.random.default_rng(seed + 50)
    keep = (draw.random(len(messages.sites)) >= share) | (np.arange(len(messages.sites)) < 12)
    return episode, messages, keep


def test_the_step_is_what_the_theory_says():
    episode, messages, keep = lost(MESH, 0.9, 3)
    heard = kept(messages, keep)
    k = next(k for k in range(30, len(heard.sites)) if heard.sites[k] == 4)
    some = np.arange(len(heard.sites)) < k
    without, within = (begun(episode, settings_of(MESH)) for _ in range(2))
    before = replace(kept(heard, some), syncs=np.empty((0, 3)))
    packet = list(packets_of(heard))[k]
    for joint in (without, within):
        joint.track(before)
    without.hear(*packet)
    q = 5e-4
    within.hear(*packet, np.array([[0, heard.syncs[k, 1], q]]))
    assert within.arrays.counts[SYNCS_USED] == 1
    s, n, half = without.arrays, states(without.arrays), values(without.arrays)
    h = np.zeros(n)
    tau_s = (int(s.counts[0]) - int(s.counts[1])) * 15.65e-12 - s.anchors[s.slot_of[4], 3] / 299792458.0
    for site, sign in ((0, 1.0), (4, -1.0)):
        h[2 + s.slot_of[site]], h[half + 2 + s.slot_of[site]] = sign, sign * tau_s
    P, V = covariance_of(without.arrays), s.sensitivities[:n, : len(LAB_M)]
    spread = h @ P @ h
    assert spread > WORTH * q
    whole = int(s.slots[s.slot_of[0], 1] - s.slots[s.slot_of[4], 1]) * SUBTICKS
    off = (int(heard.syncs[k, 1]) - whole + MODULO // 2) % MODULO - MODULO // 2
    gain = P @ h / spread
    np.testing.assert_allclose(within.arrays.x[:n], s.x[:n] + gain * (off * TICK_M / SUBTICKS - h @ s.x[:n]), atol=1e-9)
    expected = P - np.outer(gain, gain) * (spread - q)
    np.testing.assert_allclose(covariance_of(within.arrays), expected, rtol=1e-6, atol=1e-9 * np.abs(P).max())
    assert h @ covariance_of(within.arrays) @ h == pytest.approx(q, rel=1e-3)
    moved = V - np.outer(gain, h @ V)
    np.testing.assert_allclose(within.arrays.sensitivities[:n, : len(LAB_M)], moved, atol=1e-9 * np.abs(V).max())
    assert np.array_equal(within.arrays.evidence, s.evidence)


@pytest.mark.parametrize("case", [PLAIN, MESH], ids=["plain", "mesh"])
def test_where_nothing_is_lost_no_bit_changes(case):
    episode = episode_of(case, 100)
    bare, told = (begun(episode, settings_of(case)) for _ in range(2))
    bare.track(episode.messages)
    told.track(with_syncs(episode.messages, case))
    assert told.arrays.counts[SYNCS_USED] == 0
    for name in ("x", "P", "sensitivities", "evidence", "statistics", "slots", "noise"):
        assert np.array_equal(getattr(bare.arrays, name), getattr(told.arrays, name))


def errors_of(messages, episode, keep, case):
    joint = begun(episode, settings_of(case), std_m=0.05)
    heard = kept(messages, keep)
    motions, variances = np.empty((len(heard.sites), 4)), np.empty((len(heard.sites), 4))
    joint.track(heard, motions, variances)
    errors = motions[:, :2] - episode.path_m[keep, :2]
    return errors[40:], variances[40:].reshape(-1, 2, 2), joint


@pytest.mark.parametrize(("case", "most"), [(PLAIN, 0.8), (MESH, 0.9)], ids=["plain", "mesh"])
def test_with_nine_tenths_lost_errors_are_smaller_and_as_said(case, most):
    """Each episode's mean is one draw: 40 of them scatter by 0.1 about 1."""
    squares, nees = np.zeros(2), []
    for seed in range(40):
        episode, messages, keep = lost(case, 0.9, seed, 200)
        bare, _, _ = errors_of(replace(messages, syncs=np.empty((0, 3))), episode, keep, case)
        told, said, joint = errors_of(messages, episode, keep, case)
        squares += np.square(bare).sum(), np.square(told).sum()
        nees.append(np.einsum("ni,nij,nj->n", told, np.linalg.inv(said), told).mean() / 2.0)
        assert joint.arrays.counts[SYNCS_REFUSED] < 3
    assert np.sqrt(squares[1] / squares[0]) < most
    assert np.mean(nees) == pytest.approx(1.0, abs=0.3)


def test_wrong_ones_are_counted_and_do_nothing():
    episode, messages, keep = lost(MESH, 0.9, 7)
    heard = kept(messages, keep)
    wrong = heard.syncs.copy()
    wrong[:, 1] = (wrong[:, 1] + 1e4 * SUBTICKS) % MODULO
    bare, told = (begun(episode, settings_of(MESH)) for _ in range(2))
    bare.track(replace(heard, syncs=np.empty((0, 3))))
    told.track(replace(heard, syncs=wrong))
    assert told.arrays.counts[SYNCS_REFUSED] > 10
    assert told.arrays.counts[SYNCS_USED] == 0
    assert np.array_equal(bare.arrays.x, told.arrays.x)
    assert np.array_equal(bare.arrays.P, told.arrays.P)


def test_anchors_that_are_left_out_say_nothing():
    episode, messages, keep = lost(MESH, 0.9, 8)
    heard = kept(messages, keep)
    joint = begun(episode, settings_of(MESH))
    half = np.arange(len(heard.sites)) < len(heard.sites) // 2
    joint.track(kept(heard, half))
    used = joint.arrays.counts[SYNCS_USED]
    joint.arrays.slots[:, EXCLUDED] = 1
    joint.arrays.anchors[:, 6] = 2.0
    for packet, sync in list(zip(packets_of(heard), heard.syncs, strict=True))[len(heard.sites) // 2 :][:4]:
        joint.hear(*packet, sync[None])
    assert joint.arrays.counts[SYNCS_USED] == used > 0


def test_streaming_is_batch():
    episode, messages, keep = lost(MESH, 0.8, 9)
    heard = kept(messages, keep)
    batch, stream, asked = (begun(episode, settings_of(MESH), capacity=4) for _ in range(3))
    asked._exchanged.names[: len(LAB_M)] = range(len(LAB_M))
    batch.track(heard)
    questions = 0
    for packet, sync in zip(packets_of(heard), heard.syncs, strict=True):
        became = stream.hear(*packet, sync[None])
        status = asked.hear_listed(*packet[:4], packet[4].ravel().tolist(), b"", int(sync[0]), float(sync[2]))
        if status >= SYNC_WANTED:
            questions += 1
            status = asked.synchronise(tuple(sync))
        assert status == became
    assert len(heard.sites) / 2 > questions >= batch.arrays.counts[SYNCS_USED] > 5
    for arrays in (stream.arrays, asked.arrays):
        assert all(np.array_equal(one, other) for one, other in zip(batch.arrays, arrays, strict=True))


def packet(anchor, own_ticks, site_subticks, claim):
    whole, fraction = divmod(site_subticks, SUBTICKS)
    return Observation(
        anchor, np.zeros(3), 0, 0, own_ticks, own_ticks, None, None, whole, fraction / SUBTICKS, 0.0, (), claim, 1e-4
    )


def test_a_master_may_lead_the_sites_time_at_another_rate_than_its_own():
    """As one does that took over; the first packets of its term say at which."""
    scale, claim = MasterScale(), Claim(3, 7)
    step, lead = 958_482_000, 1.0 + 17e-6
    own = [5_000 + k * step for k in range(4)]
    site = [123_456_789_012 + round(t * lead * SUBTICKS) for t in own]
    at = own[-1] + step // 2
    other = packet(1, 77, 123_456_789_012 + round(at * lead * SUBTICKS), claim)
    scale.hear(packet(7, own[0], site[0], claim))
    assert scale.difference(other) is None
    for ticks, subticks in zip(own[1:], site[1:], strict=True):
        scale.hear(packet(7, ticks, subticks, claim))
    assert abs(scale.difference(other) - (77 - at) * SUBTICKS % MODULO) <= 3
    assert scale.difference(replace(other, claim=Claim(4, 7))) is None
    scale.hear(packet(7, own[3] + step, site[3] + 3 * step, claim))
    assert scale.difference(replace(other, tx_ticks_master=other.tx_ticks_master + step)) is None


def test_tags_that_miss_nine_tenths_are_honest():
    """Whole machines, simulated; before, a tag that began wrong or wide could be metres off and say centimetres."""
    plan = Plan(seed=4, worlds=2, seconds=8.0, tags=6)
    for most_m, losses in ((0.06, {"lost_at_tags": 0.9}), (0.08, {"loss": 0.9})):
        results = [run_world(run) for run in walking(plan, **losses)]
        fixes = sum(result.fixes for result in results)
        assert fixes > 2000
        assert sum(result.squared_m2 for result in results) < most_m**2 * fixes
        assert 0.6 < sum(result.nees for result in results) / fixes < 1.3


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_little_more_could_be_made_of_what_is_on_the_air(share):
    """The filter's covariance against the bound of all that anchors hear of the master, and of what was relayed."""
    ratios = []
    for seed in range(6):
        episode, messages, keep = lost(MESH, share, seed, 300)
        _, said, _ = errors_of(messages, episode, keep, MESH)
        frame, listener = np.arange(len(keep))[:, None], np.arange(6)
        telling = frame + (listener - frame) % 6  # the listener's next packet
        told = keep[np.minimum(telling, len(keep) - 1)] & keep[:, None]
        known = np.column_stack([(told | (frame % 6 == 0)) & (frame % 6 != listener), keep])
        noise = {"white_fm": WHITE_FM, "random_walk_fm": MESH.random_walk_fm, "qa": MESH.qa}
        settings = bound_settings(1e-10, **noise, slot_s=SLOT_S, speed_std_mps=SPEED_STD_MPS, mesh=True)
        bound = np.trace(received_bound(LAB_M, episode.path_m, settings, known)[keep], axis1=1, axis2=2)
        ratios.append(np.sqrt(np.trace(said, axis1=1, axis2=2)[-60:].mean() / bound[40:][-60:].mean()))
    assert 0.99 < np.mean(ratios) < 1.09
