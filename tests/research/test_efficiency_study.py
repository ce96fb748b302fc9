"""The study of efficiency: what it simulates, and that its filter is where the bound is."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.machine import cores
from skyless.research.studies.efficiency import Case, draw_episode, row_of, run_chunk
from skyless.sim.lab import paper_lab_site

pytestmark = pytest.mark.statistical

LAB_M = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in paper_lab_site().anchors])
SLOT_S = paper_lab_site().schedule.slot_s
CASES = (Case(), Case(mesh=True), Case(mesh=True, at_once=True))


def test_stamps_have_the_noise_they_are_said_to_have():
    """A tag's and an anchor's stamps of one frame differ by two RX noises, and by TX noise not at all; clocks apart."""
    case = Case(mesh=True, at_once=True, noise_ps=200.0, random_walk_fm=0.0)
    episode = draw_episode(np.random.default_rng(1), LAB_M, SLOT_S, case, 400)
    p = episode.packets
    residuals = []
    for anchor in range(6):
        frames = np.flatnonzero(p.anchors == anchor)
        time_s = (p.rx_ticks[frames] - p.rx_ticks[0]) * TICK_S
        flight_m = np.linalg.norm(episode.path_m[frames] - LAB_M[anchor], axis=1)
        one_way = (p.rx_ticks[frames] - p.tx_ticks[frames]) * TICK_M - flight_m
        residuals.append(one_way - np.polyval(np.polyfit(time_s, one_way, 3), time_s))
    expected_m = np.sqrt(2.0) * 200e-12 * SPEED_OF_LIGHT_MPS
    assert np.std(residuals) == pytest.approx(expected_m, rel=0.05)


def test_relays_name_receptions_that_the_tag_can_place():
    for at_once in (False, True):
        p = draw_episode(np.random.default_rng(2), LAB_M, SLOT_S, Case(mesh=True, at_once=at_once), 20).packets
        sent = set(zip(p.anchors.tolist(), p.sequences.tolist(), strict=True))
        assert len({tuple(row) for row in p.relays[:, :3].tolist()}) == len(p.relays)
        begin = 0
        for k, end in enumerate(p.ends.tolist()):
            for listener, sender, sequence, _ in p.relays[begin:end].tolist():
                assert listener != sender
                assert (sender, sequence) in sent
                assert (sender if at_once else listener) == p.anchors[k]
            begin = end
        assert begin == len(p.relays)
        assert len(p.relays) == 120 * 5 - (0 if at_once else 15)


def test_episodes_do_not_depend_on_how_they_are_shared_out():
    seeds = np.random.SeedSequence(3).spawn(6)
    together = run_chunk(CASES[1], seeds)
    apart = np.concatenate([run_chunk(CASES[1], seeds[:2]), run_chunk(CASES[1], seeds[2:])])
    np.testing.assert_array_equal(together, apart)


@pytest.mark.parametrize("case", CASES, ids=["plain", "mesh", "mesh at once"])
@pytest.mark.statistical
def test_the_filter_is_at_the_bound(case):
    """To the statistics of 400 episodes; the bounds within 3 % of those over many paths."""
    seeds = np.random.SeedSequence(5).spawn(400)
    with ThreadPoolExecutor(cores()) as pool:
        chunks = list(pool.map(lambda first: run_chunk(case, seeds[first : first + 50]), range(0, 400, 50)))
    result = row_of(case, np.concatenate(chunks))
    assert abs(result.ratio - 1.0) < 4.0 * result.ratio_error
    assert result.ratio_error < 0.02
    assert result.said_m == pytest.approx(result.bound_m, rel=0.005)
    assert 0.8 < result.nees < 1.25
    assert result.nees_interval[0] < 1.0 < result.nees_interval[1]
    known_m = 0.01698 if case.at_once else 0.01735 if case.mesh else 0.02207
    assert result.bound_m == pytest.approx(known_m, rel=0.03)
