"""The optimiser against the even layout, and the comparison with the simulated world."""

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.core.site import EXACT, AccuracySite, AnchorSite, ScheduleSite, Site, TagsSite, WallSite
from skyless.research.verify import random_points, verify
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.site.channel import ChannelModel, barriers_of
from skyless.site.file.template import rectangular_site
from skyless.site.planning import links, optimise
from skyless.site.planning import optimise as optimiser
from skyless.site.planning.maps import Predictor, grid_of, plan_map, summary_of
from skyless.site.planning.report import plan_warnings

pytestmark = pytest.mark.statistical

FILE = Path("site.toml")
CHANNEL = ChannelModel()


def with_master(*room):
    """A rectangular site with a master, of long superframes and exact ranges, so that predictions are fast."""
    return replace(rectangular_site(*room), schedule=ScheduleSite(slot_s=0.02), accuracy=EXACT)


@pytest.fixture
def small_search(monkeypatch):
    """Searches with fewer points and starts."""
    for name, value in {"_SEARCH_POINTS": 24, "_JUDGE_POINTS": 200, "_STARTS": 4, "_REFINED": 2}.items():
        monkeypatch.setattr(optimise, name, value)


def searched(site, outline, anchors, heights, tag_heights, channel=CHANNEL, seed=1):
    floor = links.floor_of(site, FILE, outline, None)
    mounts = links.Mounts(links.sides(floor.outline_m), heights)
    return floor, optimiser.Search(site, channel, floor, mounts, tag_heights, anchors, seed, 300.0).run()


@pytest.mark.usefixtures("small_search")
@pytest.mark.parametrize(
    ("site", "outline", "anchors", "heights", "tag_heights"),
    [
        (with_master(20.0, 5.0, 6, 3.0, 1.2), None, 6, (2.5,), (1.2,)),
        (
            with_master(12.0, 9.0, 4, 3.0, 1.2),
            np.array([(0, 0), (12, 0), (12, 4), (5, 4), (5, 9), (0, 9)], float),
            5,
            (2.5,),
            (1.2,),
        ),
        (with_master(8.0, 6.0, 5, 3.0, None), None, 5, (0.3, 2.7), (1.0, 1.8)),
    ],
    ids=("corridor", "L", "3-D"),
)
def test_the_optimiser_beats_the_even_layout(site, outline, anchors, heights, tag_heights):
    if outline is not None:
        site = replace(site, anchors=site.anchors[:1])
    floor, found = searched(site, outline, anchors, heights, tag_heights)
    assert found.finished
    assert len(found.best.site.anchors) == anchors
    grid = grid_of(floor, tag_heights, 0.25)
    best, even = (summary_of(plan_map(Predictor(s.site, CHANNEL), grid)) for s in (found.best, found.even))
    assert best.covered_share == 1.0
    assert best.mean_sigma_m < even.mean_sigma_m
    assert best.worst_sigma_m < even.worst_sigma_m


@pytest.mark.usefixtures("small_search")
def test_same_seed_same_places():
    site = with_master(10.0, 6.0, 4, 3.0, 1.2)
    places = [searched(site, None, 4, (2.5,), (1.2,))[1].best.site.anchors for _ in range(2)]
    assert places[0] == places[1]


class SlowSearch(optimiser.Search):
    """Each point of a prediction takes 10 ms on a clock of its own; Ctrl-C at an evaluation."""

    now_s, interrupt_at = 0.0, None

    def _sigma(self, site, sample):
        SlowSearch.now_s += 0.01 * len(sample[1])
        if self.evaluations == self.interrupt_at:
            self.interrupt_at = None
            raise KeyboardInterrupt
        return super()._sigma(site, sample)


@pytest.fixture
def slow_search(monkeypatch):
    monkeypatch.setattr("skyless.site.planning.optimise.time.monotonic", lambda: SlowSearch.now_s)
    site = with_master(10.0, 6.0, 4, 3.0, 1.2)
    floor = links.floor_of(site, FILE, None, None)
    mounts = links.Mounts(links.sides(floor.outline_m), (2.5,))
    return lambda seconds: SlowSearch(site, CHANNEL, floor, mounts, (1.2,), 4, 1, seconds)


@pytest.mark.parametrize("seconds", [20.0, 60.0, 200.0])
def test_a_search_holds_its_time_where_predictions_are_slow(slow_search, seconds):
    begin_s = SlowSearch.now_s
    found = slow_search(seconds).run()
    assert not found.finished
    assert SlowSearch.now_s - begin_s < seconds + 3.0  # two evaluations
    assert found.best.mean_sigma_m <= found.even.mean_sigma_m


@pytest.mark.parametrize("at", [40, 60])
def test_ctrl_c_keeps_the_best_that_was_found(slow_search, at):
    search = slow_search(1e6)
    search.interrupt_at = at
    found = search.run()
    assert not found.finished
    assert search.evaluations < at + 4
    assert found.best.mean_sigma_m < found.even.mean_sigma_m


def test_exchange_finds_what_trying_all_finds():
    """Four anchors on twelve places: the exchange against all 495 choices."""
    from itertools import combinations

    mounts = links.Mounts(
        np.array([[0.0, 0.0, 6.0, 0.0], [6.0, 0.0, 6.0, 8.0], [6.0, 8.0, 0.0, 8.0], [0.0, 8.0, 0.0, 0.0]]), (2.0,)
    )
    places = mounts.at(np.arange(12) * mounts.length_m / 12, np.zeros(12, np.int64))
    floor = links.floor_of(paper_lab_site(), FILE, None, None)
    points, weights = links.sample_points(floor, (0.0,), 60)
    lattice = optimiser.lattice_of(places, points, weights, links.link_budget(ChannelModel()), barriers_of(()), 2, 0.04)

    def score(chosen):
        return sum(optimiser.mean_and_worst(np.array(chosen), lattice))

    best = min(map(score, combinations(range(12), 4)))
    reference = (1e9, 1e9)  # far from any: then the score is the sum of both to a factor
    found = []
    for start in ([0, 1, 2, 3], [0, 3, 6, 9], [2, 5, 7, 11]):
        chosen = np.array(start)
        optimiser.exchange(chosen, 0, lattice, reference, 20)
        found.append(score(chosen))
    assert min(found) == pytest.approx(best, rel=1e-9)


def test_the_even_layout_goes_around_with_heights_in_turn():
    mounts = links.Mounts(links.sides(np.array([(0, 0), (4, 0), (4, 2), (0, 2)], float)), (0.5, 2.5))
    layout = optimiser.even_layout(mounts, 4)
    assert mounts.at(layout.along_m, layout.levels).tolist() == [[0, 0, 0.5], [3, 0, 2.5], [4, 2, 0.5], [1, 2, 2.5]]


def test_one_more_anchor_helps_where_one_is_missing():
    """The lab without its two anchors on the right: the new one belongs there."""
    anchors = tuple(a for a in paper_lab_site().anchors if a.id not in {3, 4})
    site = replace(paper_lab_site(), anchors=anchors)
    floor = links.floor_of(site, FILE, np.array([(0, 0), (6, 0), (6, 8), (0, 8)], float), None)
    more = optimiser.one_more(site, CHANNEL, floor, links.Mounts(links.sides(floor.outline_m), (0.0,)), (0.0,))
    assert more.position_m[0] == pytest.approx(6.0, abs=0.5)
    assert more.position_m[1] > 6.0
    assert more.mean_after_m < 0.9 * more.mean_before_m
    assert more.worst_after_m < 0.7 * more.worst_before_m
    assert more.helps
    grown = optimiser.site_with_one_more(site, np.array(more.position_m))
    assert [a.id for a in grown.anchors] == [1, 2, 5, 6, 7]


def test_one_more_anchor_helps_nobody_where_it_only_lengthens_the_superframe():
    ring = links.Mounts(links.sides(np.array([(0, 0), (6, 0), (6, 8), (0, 8)], float)), (0.0,))
    site = optimiser.site_with(
        paper_lab_site(), ring.at(optimiser.even_layout(ring, 16).along_m, np.zeros(16, np.int64)), 1
    )
    floor = links.floor_of(site, FILE, None, (2.0, 2.0, 4.0, 6.0))
    more = optimiser.one_more(site, CHANNEL, floor, ring, (0.0,))
    assert not more.helps
    assert more.mean_after_m > 0.95 * more.mean_before_m


def test_warnings_name_what_is_wrong():
    wall = WallSite(3.0, -1.0, 3.0, 9.0, loss_db=25.0, delay_m=0.3)
    site = replace(paper_lab_site(), walls=(wall,))
    floor = links.floor_of(site, FILE, None, None)
    predictor = Predictor(site, CHANNEL)
    text = "\n".join(plan_warnings(predictor, floor, plan_map(predictor, grid_of(floor, (0.0,), 0.5))))
    assert (
        "anchors 2 (0%), 3 (0%), 4 (0%), 6 m or more from the master, receive this share of its frames and stay silent"
        in text
    )
    assert "has no fix most of the time" in text


def test_mirrors_are_told_by_the_solver():
    flat = Site("flat", 1, 1, tuple(replace(a, z_m=2.5) for a in paper_lab_site().anchors), tags=TagsSite())
    floor = links.floor_of(flat, FILE, None, None)
    predictor = Predictor(flat, CHANNEL)
    warnings = plan_warnings(predictor, floor, plan_map(predictor, grid_of(floor, (1.0,), 1.0)))
    assert any("of the region has a mirror image" in warning for warning in warnings)
    assert any("one plane" in warning for warning in warnings)
    known = replace(flat, tags=TagsSite(1.0))
    quiet = Predictor(known, CHANNEL)
    assert plan_warnings(quiet, floor, plan_map(quiet, grid_of(floor, (1.0,), 1.0))) == []


SITES = {
    "2-D": paper_lab_site(),
    "3-D": replace(
        paper_lab_site(),
        tags=TagsSite(),
        anchors=tuple(
            replace(a, z_m=z) for a, z in zip(paper_lab_site().anchors, (0.3, 2.8, 0.4, 2.7, 0.3, 2.9), strict=True)
        ),
    ),
    "wall": replace(paper_lab_site(), walls=(WallSite(3.0, 0.0, 3.0, 5.0, loss_db=8.0, delay_m=0.0),)),
    "half-heard": replace(
        Site("wide", 1, 1, tuple(AnchorSite(k + 1, 20.0 * (k % 3), 18.0 * (k // 3)) for k in range(6))),
        tags=TagsSite(0.0),
        master=2,
        accuracy=EXACT,
    ),
}


@pytest.mark.parametrize(("name", "rounds"), [*((name, 900) for name in SITES), ("range errors", 300)])
@pytest.mark.statistical
def test_prediction_and_simulation_agree(monkeypatch, name, rounds):
    """To 5 %, and four standard errors of the simulation on top.

    Three points at once; their mean is held to a tighter bound.
    """
    monkeypatch.setattr("skyless.research.verify._WORLDS", 8)
    site = paper_lab_site(accuracy=AccuracySite()) if name == "range errors" else SITES[name]
    floor = links.floor_of(site, FILE, None, None)
    predictor = Predictor(site, CHANNEL)
    heights = (1.0, 2.0) if name == "3-D" else (0.0,)
    grid = grid_of(floor, heights, 0.5)
    plan = plan_map(predictor, grid)
    grid.within[:] &= (plan.column(links.FIX_SHARE) > 0.85).all(axis=0)
    checked = verify(predictor, random_points(plan, 3, 5), rounds, 9)
    for check in checked.points:
        assert check.ratio == pytest.approx(1.0, abs=0.05 + 4.0 * check.ratio_error)
        assert check.simulated_fix_share == pytest.approx(check.predicted_fix_share, abs=0.04)
    assert checked.mean_ratio == pytest.approx(1.0, abs=0.05 + 4.0 * checked.mean_ratio_error / 3**0.5)


def test_a_site_from_places_keeps_the_rest():
    site = replace(
        paper_lab_site(), walls=(WallSite(0.0, 0.0, 1.0, 1.0),), schedule=replace(paper_lab_site().schedule, slots=9)
    )
    made = optimiser.site_with(site, np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]]), 2)
    assert made.master == 3
    assert made.walls == site.walls
    assert made.schedule.slots is None
    assert made.noise == site.noise


def test_range_decides_coverage():
    floor = links.floor_of(lab_site(), FILE, None, None)
    near = links.with_range(ChannelModel(), 4.0)
    summary = summary_of(plan_map(Predictor(lab_site(), near), grid_of(floor, (0.0,), 0.5)))
    assert summary.covered_share < 1.0
    assert summary.fewest_anchors < 3
