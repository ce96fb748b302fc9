"""What is predicted of ``joint``: against the Cramér–Rao bound, a textbook's recursion, and closed forms of relays."""

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.stats import binom

from skyless.core.geometry import anchor_positions
from skyless.core.protocol1.beacon import schedule_of
from skyless.core.site import EXACT, AccuracySite, AnchorSite, Site, TagsSite, WallSite
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_S
from skyless.research.uncertainty import BoundSettings, tracking_bound
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.site.channel import ChannelModel
from skyless.site.planning import links
from skyless.site.planning.maps import Predictor
from skyless.site.planning.superframe import stamp_variances

pytestmark = pytest.mark.statistical

LAB = paper_lab_site(100.0)
PLACES = ((0, 0, 0.2), (4, 0, 2.9), (8, 0, 0.4), (8, 5, 2.7), (8, 10, 0.2), (4, 10, 2.9), (0, 10, 0.5), (0, 5, 2.6))
ROOM = Site("room", 2, 1, tuple(AnchorSite(k + 1, *place) for k, place in enumerate(PLACES)), accuracy=EXACT)
QA = 0.3


def superframe_and_relays(site, channel=None):
    predictor = Predictor(site, channel or ChannelModel())
    return predictor.superframe, predictor.relays


@pytest.mark.parametrize(("site", "point"), [(LAB, (3.0, 4.0, 0.0)), (LAB, (1.2, 1.6, 0.0)), (ROOM, (3.0, 6.0, 1.3))])
def test_the_filter_claims_the_bound_of_what_has_come_in(site, point):
    """Posterior bound of a tag at rest that may accelerate, after so long that nothing of its beginning is left.

    The bound's reference clock is an anchor's, its packets are taken when they fly, it knows no rounding to ticks and
    its own oscillators' noise between packet and relay: together some 0.3 % (docs/maths.md section 7).
    """
    anchors, superframes = anchor_positions(site), 400
    noise, slot_s = site.noise, schedule_of(site).slot_ticks * TICK_S
    flat = site.tags.height_m is not None
    settings = BoundSettings(
        noise.tx_stamp_ps * 1e-12,
        white_fm=noise.white_fm,
        random_walk_fm=noise.random_walk_fm,
        qa=QA,
        slot_s=slot_s,
        speed_std_mps=1.0,
        mesh=True,
        height_known=flat,
        at_once=False,
    )
    path = np.tile(point, (superframes * len(anchors), 1))
    # the mean over a superframe's packets: the bound's superframe begins with each anchor in turn
    turns = []
    for first in range(len(anchors)):
        order = np.roll(anchors, -first, axis=0)
        turns.append(np.trace(tracking_bound(order, path, settings)[-1]))
    row = Predictor(site, ChannelModel()).at(np.array([point]))[0]
    assert row[links.CLAIMED] == pytest.approx(np.sqrt(np.mean(turns)), rel=0.006)


def dense(site, point, superframes, shift_m=0.0):
    """Means over the last superframe: what the filter says, the true mean square of a tag at rest, its mean error.

    Matrices as in a textbook, Joseph's form for the true error; all anchors in view. ``shift_m``: by how much the
    tag's receptions of anchor 3 are late. Errors of ranges and survey are states that relays leave as they are.
    """
    anchors, accuracy = anchor_positions(site), site.accuracy
    n, dim = len(anchors), 2 if site.tags.height_m is not None else 3
    superframe, relays = superframe_and_relays(site)
    tx_var, rx_var = stamp_variances(site)
    white, walk = (SPEED_OF_LIGHT_MPS * site.noise.white_fm) ** 2, (SPEED_OF_LIGHT_MPS * site.noise.random_walk_fm) ** 2
    half = dim + n
    errors = 2 * half + n
    constant, change, slope, survey = errors, errors + n, errors + 2 * n, errors + 2 * n + 1
    stds = [accuracy.range_std_m] * n + [accuracy.place_std_m] * n + [accuracy.slope_std_m]
    stds += [accuracy.survey_std_m] * n * dim
    P = np.diag(np.r_[[1.0] * dim, [100.0] * n, [1.0] * dim, [100.0] * n, [tx_var] * n, np.square(stds)])
    S, mean = P.copy(), np.zeros(len(P))
    said = true = shifts = 0.0
    kept = np.exp(-superframe.gap_s.sum() / accuracy.place_time_s)
    for number in range(superframes):
        for k, i in enumerate(superframe.sender):
            dt, F, Q = superframe.gap_s[k], np.eye(len(P)), np.zeros((len(P), len(P)))
            F[range(half), range(half, 2 * half)] = dt
            F[2 * half + i, 2 * half + i] = 0.0
            F[change + i, change + i] = kept
            shape = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            common = np.eye(n) + 1.0
            rows = np.r_[dim:half, half + dim : 2 * half]
            Q[np.ix_(rows, rows)] = np.kron(walk * shape + np.diag([white * dt, 0.0]), common)
            Q[2 * half + i, 2 * half + i] = tx_var
            Q[change + i, change + i] = (1.0 - kept**2) * accuracy.place_std_m**2
            motion = np.zeros_like(Q)
            rows = np.r_[0:dim, half : half + dim]
            motion[np.ix_(rows, rows)] = np.kron(QA * shape, np.eye(dim))
            P, S, mean = F @ P @ F.T + Q + motion, F @ S @ F.T + Q, F @ mean
            range_m = np.linalg.norm(point - anchors[i])
            towards = ((point - anchors[i]) / range_m)[:dim]
            h = np.zeros(len(P))
            h[:dim], h[dim + i], h[2 * half + i] = towards, 1.0, 1.0
            h[constant + i], h[change + i], h[slope] = 1.0, 1.0, np.clip((range_m - 4.0) / 4.0, -1.0, 1.0)
            h[survey + dim * i : survey + dim * (i + 1)] = -towards
            measured = [(h, rx_var, shift_m * (site.anchors[i].id == 3))]
            for r in range(relays.ends[k - 1] if k else 0, relays.ends[k]):
                j, age = relays.sender[r], relays.age_s[r]
                h = np.zeros(len(P))
                h[dim + j], h[dim + i], h[2 * half + j] = 1.0, -1.0, 1.0
                h[half + dim + j], h[half + dim + i] = -age, age
                measured.append((h, rx_var + 2.0 * age * (white + walk * age**2 / 3.0), 0.0))
            for h, variance, late in measured:
                gain = P @ h / (h @ P @ h + variance)
                A = np.eye(len(P)) - np.outer(gain, h)
                P, S = (A @ X @ A.T + variance * np.outer(gain, gain) for X in (P, S))
                mean = mean + gain * (late - h @ mean)
            if number == superframes - 1:
                said += np.trace(P[:dim, :dim]) / len(superframe.sender)
                true += np.trace(S[:dim, :dim]) / len(superframe.sender)
                shifts += mean[:dim] @ mean[:dim] / len(superframe.sender)
    return np.sqrt([said, true, shifts])


@pytest.mark.parametrize(
    ("site", "point", "motion"),
    [
        (LAB, (2.0, 5.5, 0.0), 0.93),
        (ROOM, (6.0, 3.0, 1.0), 0.93),
        (paper_lab_site(accuracy=AccuracySite()), (1.2, 1.6, 0.0), 0.99),
    ],
    ids=("lab", "3-D", "range errors"),
)
def test_the_true_error_is_that_of_a_dense_recursion(site, point, motion):
    row = Predictor(site, ChannelModel()).at(np.array([point]))[0]
    said, true, _ = dense(site, np.array(point), 100)
    assert row[links.CLAIMED] == pytest.approx(said, rel=4e-3)
    assert row[links.SIGMA] == pytest.approx(true, rel=4e-3)
    assert row[links.SIGMA] < motion * row[links.CLAIMED]
    assert (row[links.SIGMA_X : links.SIGMA_Z + 1] ** 2).sum() == pytest.approx(row[links.SIGMA] ** 2)


def test_range_errors_add_to_the_noise():
    """Twice the errors of survey and ranges add four times as much to the square of the position's."""
    base = replace(lab_site().accuracy, place_std_m=0.0)
    twice = replace(
        base, **{name: 2.0 * getattr(base, name) for name in ("survey_std_m", "range_std_m", "slope_std_m")}
    )
    point = np.array([[1.2, 1.6, 0.0]])
    exact, one, two = (
        Predictor(lab_site(accuracy=accuracy), ChannelModel()).at(point)[0, links.SIGMA] ** 2
        for accuracy in (EXACT, base, twice)
    )
    assert (two - exact) / (one - exact) == pytest.approx(4.0, rel=0.1)


def test_a_late_anchor_shifts_positions_as_in_a_dense_recursion():
    """Anchor 3 behind a wall that the others, and the tag's other paths, do not cross."""
    point = (2.0, 5.5, 0.0)
    wall = WallSite(4.5, 4.4, 4.5, 4.7, loss_db=0.0, delay_m=0.05)
    site = replace(LAB, walls=(wall,))
    _, relays = superframe_and_relays(site)
    assert (relays.delay_m == 0.0).all()
    row = Predictor(site, ChannelModel()).at(np.array([point]))[0]
    expected = dense(LAB, np.array(point), 150, 0.05)[2]
    assert row[links.BIAS] == pytest.approx(expected, rel=0.01)
    assert row[links.RMSE] ** 2 == pytest.approx(row[links.SIGMA] ** 2 + row[links.BIAS] ** 2)


def test_small_sites_relay_everything_once():
    superframe, relays = superframe_and_relays(LAB)
    assert superframe.sender.tolist() == [0, 1, 2, 3, 4, 5]
    assert relays.ends.tolist() == [5, 10, 15, 20, 25, 30]
    slot_s = schedule_of(LAB).slot_ticks * TICK_S
    assert relays.sender[5:10].tolist() == [0, 5, 4, 3, 2]
    assert relays.age_s[5:10] == pytest.approx(slot_s * np.arange(1, 6))
    assert relays.share == pytest.approx(1.0, abs=1e-6)


def test_large_sites_relay_the_master_and_the_last_receptions_that_fit():
    """Six beside the master's; with every other frame lost, those that came after fill the room by chance."""
    anchors = tuple(AnchorSite(k + 1, float(k % 5), float(k // 5)) for k in range(20))
    site = Site("many", 1, 1, anchors, tags=TagsSite(0.0))
    _, relays = superframe_and_relays(site)
    last = slice(relays.ends[18], relays.ends[19])
    assert relays.sender[last].tolist() == [18, 17, 16, 15, 14, 13, 0]
    assert relays.sender[: relays.ends[0]].tolist() == [19, 18, 17, 16, 15, 14, 13]  # the master has none to tell first
    _, relays = superframe_and_relays(site, ChannelModel(loss_probability=0.5))
    heard, share = relays.sender[relays.ends[18] :], relays.share[relays.ends[18] :]
    expected = 0.5 * binom.cdf(5, np.arange(18), 0.5)
    expected = expected[expected >= 0.01]
    assert heard.tolist() == [*range(18, 18 - len(expected), -1), 0]
    assert share == pytest.approx([*expected, 0.5], abs=1e-6)


def test_silent_anchors_relay_nothing_and_are_not_relayed():
    site = replace(
        LAB, walls=(WallSite(5.0, 7.0, 7.0, 7.0, loss_db=300.0), WallSite(5.0, 9.0, 5.0, 7.0, loss_db=300.0))
    )
    superframe, relays = superframe_and_relays(site)
    assert superframe.sent.tolist() == [1.0, 1.0, 1.0, 0.0, 1.0, 1.0]
    assert 3 not in relays.sender
    assert len(relays.ends) == 5


def test_lost_packets_cost_and_fixes_come_with_those_that_arrive():
    point = np.array([[3.0, 4.0, 0.0]])
    rows = [Predictor(LAB, ChannelModel(loss_probability=lost)).at(point)[0] for lost in (0.0, 0.2, 0.5)]
    assert [row[links.FIX_SHARE] for row in rows] == pytest.approx([1.0, 0.8, 0.5], abs=1e-5)
    assert rows[0][links.SIGMA] < rows[1][links.SIGMA] < rows[2][links.SIGMA]
    # anchors lose half as well here: more than the 1.39 of tags alone (docs/maths.md section 7)
    assert 1.39 < rows[2][links.CLAIMED] / rows[0][links.CLAIMED] < 1.6


def test_fixes_count_among_the_messages_of_the_anchors_in_use():
    """Of a corridor's twelve anchors the tag uses eight; of the last two of these half of the messages arrive."""
    anchors = tuple(AnchorSite(k + 1, 6.0 * (k // 2), 3.0 * (k % 2)) for k in range(12))
    site = Site("corridor", 1, 5, anchors, tags=TagsSite(0.0))
    predictor = Predictor(site, links.with_range(ChannelModel(), 17.0))
    point = np.array([[1.0, 1.5, 0.0]])
    (share,), _ = predictor.scene.heard_at(point)
    assert predictor.messages_at(point).tolist() == [8]
    assert 0.4 < share[7] < 0.6
    assert predictor.at(point)[0, links.FIX_SHARE] == pytest.approx(share[:8].mean())
