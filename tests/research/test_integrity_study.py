"""The study of protection levels: its faults, its intervals of rare shares, its rows and its picture."""

import numpy as np
import pytest
from scipy.stats import chi2

from skyless.core.ticks import TICK_M
from skyless.research.studies import integrity
from skyless.research.studies.efficiency import Case, draw_episode
from skyless.research.studies.picture import CLUSTER_FIXES, clustered_interval, draw
from skyless.research.studies.run import STUDIES
from skyless.research.studies.runner import plan_of
from skyless.sim.lab import paper_lab_site
from skyless.site.report import picture

pytestmark = pytest.mark.site

SLOT_S = paper_lab_site().schedule.slot_s
PLAN = plan_of("joint", 1, episodes=100)


def episode_of(superframes=120):
    return draw_episode(np.random.default_rng(1), integrity.anchors_of("lab"), SLOT_S, Case(mesh=True), superframes)


@pytest.mark.parametrize(("kind", "sign"), [("step", 1.0), ("early", -1.0), ("delay", 1.0)])
def test_a_fault_changes_what_is_heard_of_its_anchor_from_the_onset_on(kind, sign):
    episode, anchor, onset = episode_of(), 3, 240
    packets = integrity.faulty(episode, integrity.Fault("lab", 1.0, kind), anchor, onset, SLOT_S)
    late_m = (packets.rx_ticks - episode.packets.rx_ticks) * TICK_M
    touched = (packets.anchors == anchor) & (np.arange(len(late_m)) >= onset)
    assert late_m[touched] == pytest.approx(sign, abs=TICK_M)
    assert not late_m[~touched].any()
    relayed_m = (packets.relays[:, 3] - episode.packets.relays[:, 3]) * TICK_M
    of_anchor = (packets.relays[:, 1] == anchor) & (packets.relays[:, 2] >= onset // 6)
    assert not relayed_m[~of_anchor].any()
    assert relayed_m[of_anchor] == pytest.approx(1.0 if kind == "delay" else 0.0, abs=TICK_M)


def test_ramps_grow_for_a_second_and_bursts_come_and_go():
    episode, anchor, onset = episode_of(), 0, 60
    own = episode.packets.anchors == anchor
    since_s = (np.arange(len(own)) - onset)[own] * SLOT_S

    def late_m(kind):
        packets = integrity.faulty(episode, integrity.Fault("lab", 2.0, kind), anchor, onset, SLOT_S)
        return (packets.rx_ticks - episode.packets.rx_ticks)[own] * TICK_M

    assert late_m("ramp") == pytest.approx(2.0 * np.clip(since_s, 0.0, 1.0), abs=TICK_M)
    on = (since_s >= 0.0) & (since_s % (2.0 * integrity.FAULT_BURST_S) < integrity.FAULT_BURST_S)
    assert late_m("bursts") == pytest.approx(np.where(on, 2.0, 0.0), abs=TICK_M)


@pytest.mark.parametrize("n", [1, 7])
@pytest.mark.parametrize("size", [1.0, CLUSTER_FIXES, 2.0 * CLUSTER_FIXES])
def test_intervals_of_equal_clusters_are_garwoods(n, size):
    low, high = clustered_interval(np.full(n, size), 1e4)
    exact = size * chi2.ppf(0.995, 2 * n + 2) / 2e4
    assert low == pytest.approx(size * chi2.ppf(0.005, 2 * n) / 2e4)
    assert high == pytest.approx(exact) if size >= CLUSTER_FIXES else high > exact


def test_nothing_seen_proves_a_share_small_but_not_zero():
    assert clustered_interval(np.zeros(9), 1e4) == (0.0, pytest.approx(CLUSTER_FIXES * chi2.ppf(0.995, 2) / 2e4))


def test_intervals_of_clusters_hold_the_true_share():
    """Clusters of 1 to 20 events, three of them on average: 99 % of the intervals should hold the mean."""
    draw, runs, mean = np.random.default_rng(2), 1000, 3 * 10.5
    missed = 0
    for _ in range(runs):
        events = np.array([draw.integers(1, 21) for _ in range(draw.poisson(3.0))], float)
        low, high = clustered_interval(events, 1.0)
        missed += not low <= mean <= high
    assert missed <= 23  # at most 10 are expected; more than 23 with a probability of 10⁻⁴


def chunk(misleading, levels_m=(0.1, 0.2)):
    """What 50 episodes of 100 fixes would have found."""
    counts = np.tile([100.0, 90.0, 0.0, 0.0], (50, 1))
    counts[0, 2] = misleading
    return integrity.Chunk(counts, 1.0, levels_m, np.linspace(0.1, 0.8, 100), np.linspace(0.01, 0.1, 100))


def test_rows_are_what_chunks_tell():
    results = [chunk(0)] * 2 * len(integrity.FAULTS)
    results[2] = chunk(100)  # of the second row
    found = {row.case: row for row in integrity.rows(PLAN, results)}
    assert len(found) == len(integrity.FAULTS) + 1
    clean, step = found["lab, clean"], found["lab, step 0.05 m"]
    assert (clean.runs, clean.fixes, clean.available, clean.hmi, clean.limits[0].most) == (
        100,
        10_000,
        0.9,
        0.0,
        integrity.MAX_LEVEL_RATIO,
    )
    assert clean.ratio == pytest.approx(1.0 / 0.8, rel=0.01)
    assert clean.passed
    assert step.hmi == 0.01
    assert step.hmi_interval[0] < 1e-4 < 0.01 < step.hmi_interval[1]  # one cluster proves little
    assert step.passed
    assert (step.hpl_m, step.vpl_m, found["room, clean"].vpl_m) == (pytest.approx(0.1), None, pytest.approx(0.2))
    assert found[integrity.ALL_FAULTS].hmi == pytest.approx(100 / found[integrity.ALL_FAULTS].fixes)
    assert found[integrity.ALL_FAULTS].fixes == 10_000 * (len(integrity.FAULTS) - 2)


def test_levels_that_mislead_often_fail():
    results = [chunk(0)] * 2 * len(integrity.FAULTS)
    counts = np.tile([100.0, 90.0, 1.0, 0.0], (50, 1))
    results[2] = integrity.Chunk(counts, 1.0, (0.1, 0.2), results[0].top, results[0].errors_m)
    failed = [row.case for row in integrity.rows(PLAN, results) if not row.passed]
    assert failed == ["lab, step 0.05 m"]


@pytest.mark.parametrize("levels_m", [(0.1, 0.2), None])
@pytest.mark.statistical
def test_it_can_be_drawn(levels_m):
    study = STUDIES["integrity"]
    found = study.rows(PLAN, [chunk(3, levels_m)] * 2 * len(integrity.FAULTS))
    assert picture(draw(study, found), "png", 50.0).startswith(b"\x89PNG")


def test_cells_carry_what_is_asked():
    asked = plan_of("joint", 1, episodes=60, integrity_risk=1e-3, alert_limit_m=0.5)
    found = integrity.cells(asked)
    assert len(found) == 2 * len(integrity.FAULTS)
    asked_of = [cell.function.args for cell in found]
    assert {(plan.integrity_risk, plan.alert_limit_m) for plan, *_ in asked_of} == {(1e-3, 0.5)}
    assert [len(seeds) for *_, seeds in asked_of[:2]] == [50, 10]


@pytest.mark.parametrize("place", ["lab", "room"])
def test_levels_hold_in_clean_episodes(place):
    cell = next(cell for cell in integrity.cells(plan_of("joint", 1, episodes=3)) if cell.name == f"{place}, clean")
    found = cell.function()
    fixes, promised, across, above = found.counts.T
    assert (fixes > 350).all()
    assert (promised == fixes).all()
    assert not across.any()
    assert not above.any()
    assert 0.0 < found.top.max() < 1.0
