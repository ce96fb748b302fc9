"""``CellWorld``: the grid against brute force, schedules, workers, spans, range errors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from skyless.core.air.almanac import period_code
from skyless.core.ticks import DEFAULT_ANTENNA_DELAY_TICKS, TICK_M, TICK_S
from skyless.sim.cells.reception import (
    KNOT_TICKS,
    anchors_within,
    delivery_chance,
    list_neighbours,
    make_grid,
    rules_of,
)
from skyless.sim.cells.receptions import KNOTS_A_LENGTH, PairErrors, TagPath, changing_error
from skyless.sim.cells.world import CellAnchors, CellWorld
from skyless.sim.impairments import AnchorOutage, Impairments, Outage, RangeErrorModel
from skyless.sim.oscillator import OscillatorModel
from skyless.sim.trajectory import Roaming, Static, Waypoints
from skyless.site.channel import ChannelModel

pytestmark = pytest.mark.statistical

POSITIONS_M = np.array([(15.0 * x, 15.0 * y, 3.0) for y in range(20) for x in range(20)])
QUIET = OscillatorModel(offset_ppm=0.0, white_fm=0.0, random_walk_fm=0.0)
ROOM = Impairments(range_errors=RangeErrorModel(0.05, 0.1, 0.02, correlation_m=1.0))
RULES = rules_of(ChannelModel(), 0.0, 0.0, 1)
Z = 5.0
"""Bounds are five standard deviations of what is measured."""


def paths():
    return [
        Waypoints([(40, 40, 1), (220, 130, 1), (90, 200, 1)], 3.0, corner_s=0.5),
        Roaming((140.0, 140.0, 1.0), (15.0, 15.0, 0.0), seed=1),
        Static(100.0, 7.0, 1.0),
        Roaming((60.0, 60.0, 1.0), (20.0, 20.0, 0.0), seed=2),
    ]


def anchors_at(positions_m):
    count = len(positions_m)
    return CellAnchors(np.arange(count), positions_m, np.full(count, DEFAULT_ANTENNA_DELAY_TICKS))


CODES = np.full(400, period_code(1.0 / 30.0))


def columns(parts):
    """All columns of a tag's receptions, put together."""
    names = [name for name in parts[0].__slots__ if name not in {"tag", "from_s", "to_s"}]
    return {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}


coordinates = st.floats(-500.0, 500.0)


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(coordinates, coordinates, st.floats(0.0, 10.0)), min_size=1, max_size=40),
    st.tuples(coordinates, coordinates, st.floats(0.0, 10.0)),
    st.floats(0.01, 400.0),
    st.floats(0.5, 300.0),
)
def test_the_grid_finds_what_brute_force_finds(positions, point, radius_m, cell_m):
    positions_m = np.array(positions)
    found = np.empty(len(positions), dtype=np.int64)
    count = anchors_within(make_grid(positions_m, cell_m), positions_m, point, radius_m, found)
    square_m2 = np.maximum(((np.array(point) - positions_m) ** 2).sum(axis=1), 1e-4)
    sure, perhaps = (set(np.flatnonzero(square_m2 <= radius_m**2 * part)) for part in (1 - 1e-9, 1 + 1e-9))
    assert sure <= set(found[:count].tolist()) <= perhaps
    assert len(set(found[:count].tolist())) == count


def test_neighbours_are_all_within_the_audible_distance():
    positions_m = np.random.default_rng(1).uniform(0.0, 300.0, (200, 3)) * (1.0, 1.0, 0.01)
    keys = np.arange(200)
    lists = list_neighbours(RULES, make_grid(positions_m, 30.0), positions_m, keys)
    distance_m = np.linalg.norm(positions_m[:, None] - positions_m[None], axis=2)
    for one in keys:
        rows = slice(lists.offsets[one], lists.offsets[one + 1])
        near = np.flatnonzero((distance_m[one] <= RULES.audible_m) & (keys != one))
        assert sorted(lists.anchors[rows]) == near.tolist()
        for other, chance in zip(lists.anchors[rows], lists.chance[rows], strict=True):
            assert chance == pytest.approx(delivery_chance(RULES, float(distance_m[one, other]) ** 2), rel=1e-9)


@pytest.mark.parametrize("codes", [CODES, CODES + np.arange(400) % 30], ids=["one period", "several"])
def test_receptions_depend_neither_on_other_tags_nor_on_spans(codes):
    """As between workers: one runs all tags in spans of 0.5 s, the other two of them in spans of 0.3 s."""
    one = CellWorld(anchors_at(POSITIONS_M), codes, paths(), ROOM, 4, survey_std_m=0.02)
    other = CellWorld(anchors_at(POSITIONS_M), codes, paths(), ROOM, 4, survey_std_m=0.02)
    whole = {tag: [] for tag in range(4)}
    for part in one.run(2.0):
        whole[part.tag].append(part)
    other.receptions(1, 1.7, 1.8)  # and out of order
    few = {3: [], 1: []}
    for part in other.run(2.0, span_s=0.3, tags=[3, 1]):
        few[part.tag].append(part)
    for tag, parts in few.items():
        expected = columns(whole[tag])
        assert len(expected["anchor"]) > 100
        for name, column in columns(parts).items():
            assert (column == expected[name]).all(), name


def test_another_seed_is_another_world():
    one, other = (CellWorld(anchors_at(POSITIONS_M), CODES, paths(), ROOM, seed) for seed in (1, 2))
    assert one.receptions(0, 0.5, 0.6).rx_ticks.tolist() != other.receptions(0, 0.5, 0.6).rx_ticks.tolist()


def test_dead_anchors_are_silent_and_others_go_on():
    dead = np.arange(400) % 3 == 0
    faulty = CellWorld(anchors_at(POSITIONS_M), CODES, paths(), ROOM, 4, dead=dead.tolist())
    sound = CellWorld(anchors_at(POSITIONS_M), CODES, paths(), ROOM, 4)
    few, all_ = faulty.receptions(2, 0.5, 1.0), sound.receptions(2, 0.5, 1.0)
    assert not dead[few.anchor].any()
    assert not dead[few.relay_anchor[few.relay_anchor >= 0]].any()
    assert dead[all_.anchor].any()
    sent, still_sent = (
        dict(zip(zip(one.anchor, one.sequence, strict=True), one.tx_ticks, strict=True)) for one in (all_, few)
    )
    common = sent.keys() & still_sent.keys()
    assert len(common) > 20
    assert all(sent[frame] == still_sent[frame] for frame in common)


def ranging_world(tags, impairments):
    """A world without early first paths, so that ranges are true but for their errors."""
    world = CellWorld(anchors_at(POSITIONS_M), CODES, tags, impairments, 4)
    world._rules = world._rules._replace(first_path=world._rules.capture)
    return world


def ranges_m(world, tag, from_s, to_s):
    """Apparent less true range of each frame up to the counter's start, from ideal clocks and noiseless stamps."""
    received = world.receptions(tag, from_s, to_s)
    true_m = np.linalg.norm(received.positions_m - world.true_positions_m[received.anchor], axis=1)
    apparent = (received.rx_ticks - received.emission_ticks - received.emission_fraction) * TICK_M
    wrap_m = TICK_M * 2.0**40
    return received, true_m, (apparent - true_m) % wrap_m


def test_range_errors_are_a_constant_and_a_slope_for_each_pair():
    plain = Impairments(0.0, 0.0, QUIET)
    errors = Impairments(0.0, 0.0, QUIET, range_errors=RangeErrorModel(0.5, 0.2))
    tags = [Static(100.0 + 0.5 * k, 93.0, 1.0) for k in range(40)]
    base, world = (ranging_world(tags, one) for one in (plain, errors))
    constants = []
    for tag in range(40):
        _, _, start_m = ranges_m(base, tag, 0.0, 0.5)
        assert np.ptp(start_m) < 1.01 * TICK_M, "a tick: the stamps' rounding"
        received, true_m, late_m = ranges_m(world, tag, 0.0, 0.5)
        rest_m = late_m - 0.2 * np.clip((true_m - 4.0) / 4.0, -1.0, 1.0) - start_m.mean()
        for anchor in np.unique(received.anchor):
            of_pair = rest_m[received.anchor == anchor]
            assert np.ptp(of_pair) < 1.01 * TICK_M
            constants.append(of_pair.mean())
    assert np.abs(constants).max() < 0.5 + TICK_M
    assert kstest(constants, "uniform", (-0.5, 1.0)).pvalue > 1e-6


def test_changing_errors_are_a_gauss_markov_process():
    """Over pairs: variance 1, correlation exp(-lag); the taps leave out e⁻¹⁰ of the power."""
    errors = PairErrors(0.0, 0.0, 1.0, 0.1, np.uint64(1), np.uint64(2))
    pairs = 4000
    knots = (-3, 0, KNOTS_A_LENGTH, 3 * KNOTS_A_LENGTH)
    drawn = np.array([[changing_error(errors, 1 << 32, anchor, knot) for knot in knots] for anchor in range(pairs)])
    for one, first in enumerate(knots):
        for other, second in enumerate(knots):
            expected = np.exp(-abs(first - second) / KNOTS_A_LENGTH)
            std = np.sqrt((1.0 + expected**2) / pairs)
            assert np.mean(drawn[:, one] * drawn[:, other]) == pytest.approx(expected, abs=Z * std)


def test_a_walking_tags_errors_change_along_its_path():
    faults = Impairments(0.0, 0.0, QUIET, range_errors=RangeErrorModel(changing_m=1.0, correlation_m=1.0))
    tags = [Static(100.0, 93.0), Waypoints([(100, 93), (104, 93)], 2.0)]
    world = ranging_world(tags, faults)
    for tag, changes in enumerate((False, True)):
        received, _, late_m = ranges_m(world, tag, 0.0, 2.0)
        spreads = [np.ptp(late_m[received.anchor == anchor]) for anchor in np.unique(received.anchor)]
        assert (np.median(spreads) > 1.0) == changes
        assert changes or max(spreads) < 1.01 * TICK_M


def test_a_path_is_as_long_as_it_is_wherever_one_begins():
    path = Waypoints([(0, 0), (30, 40)], 5.0)
    asked = TagPath(path, length=True)
    for first, last in ((10, 40), (60, 80), (5, 30)):
        covered = asked.cover(first * KNOT_TICKS, last * KNOT_TICKS)
        expected_m = np.minimum(5.0 * np.arange(first, last + 2) * KNOT_TICKS * TICK_S, 50.0)
        assert covered.first_knot == first
        assert covered.travelled == pytest.approx(expected_m)
    in_time = TagPath(path, length=False).cover(10 * KNOT_TICKS, 12 * KNOT_TICKS)
    assert in_time.travelled == pytest.approx(np.arange(10, 14) * KNOT_TICKS * TICK_S)


def test_surveyed_positions_are_off_by_their_std():
    world = CellWorld(anchors_at(POSITIONS_M), CODES, [], Impairments(), 4, survey_std_m=0.05)
    errors_m = (world.true_positions_m - POSITIONS_M).ravel()
    assert kstest(errors_m / 0.05, "norm").pvalue > 1e-6
    assert (CellWorld(anchors_at(POSITIONS_M), CODES, [], Impairments(), 4).true_positions_m == POSITIONS_M).all()


def test_positions_are_those_of_the_trajectory():
    received = CellWorld(anchors_at(POSITIONS_M), CODES, paths(), Impairments(), 4).receptions(0, 59.0, 59.5)
    assert len(received) > 30
    for t_s, position_m in zip(received.emission_s, received.positions_m, strict=True):
        assert position_m == pytest.approx(paths()[0].position(t_s))


def test_a_lone_tag_and_a_lone_anchor():
    far, near = (
        CellWorld(anchors_at(np.zeros((1, 3))), CODES[:1], [Static(x, 0.0)], Impairments(), 1) for x in (500.0, 5.0)
    )
    assert len(far.receptions(0, 0.0, 1.0)) == 0
    received = near.receptions(0, 0.0, 1.0)
    assert len(received) == pytest.approx(29, abs=6)
    assert not received.relays.any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"impairments": Impairments(diagnostics=True)}, "diagnostics"),
        ({"impairments": Impairments(anchor_outages=(AnchorOutage(1, Outage(1.0)),))}, "anchor_outages"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(options, message):
    given_ = {"anchors": anchors_at(POSITIONS_M), "period_codes": CODES, "impairments": Impairments()} | options
    with pytest.raises(ValueError, match=message):
        CellWorld(tags=[], seed=1, **given_)
