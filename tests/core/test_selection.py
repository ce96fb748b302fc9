import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.core.air.beacon import Beacon, fields_of
from skyless.core.air.frame import Heard
from skyless.core.air.neighbours import (
    RELAYED_TICKS,
    Neighbour,
    Neighbours,
    find_neighbour,
    is_confirmed,
    neighbour_of,
)
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import add_anchor, new_state
from skyless.core.native.records import MAX_NEIGHBOURS
from skyless.core.tag.admission import BETTER_DB, add_power, add_relays, fitting_relays, replaced_by
from skyless.core.ticks import NEVER, from_seconds, wrap


def relays(*heard, anchor=99):
    heard = tuple(one if isinstance(one, Heard) else Heard(one, 0, 0) for one in heard)
    return fields_of(Beacon(1, anchor, 0, 0, 0, 0, None, heard, 0, None))


def confirmed(t, anchor, rx_ticks):
    row = find_neighbour(t, anchor)
    return row >= 0 and is_confirmed(t.rows[row], rx_ticks)


def test_a_relayed_reception_confirms_for_two_seconds():
    t = Neighbours()
    add_relays(t, relays(7, 8), 1000)
    assert confirmed(t, 7, 1000 + RELAYED_TICKS - 1)
    assert not confirmed(t, 7, 1000 + RELAYED_TICKS)
    assert not confirmed(t, 9, 1000)
    assert t.rows[find_neighbour(t, 8)].own_relays_ticks == NEVER


def replaced_anchor(new, used):
    """Which of those in use, with range and power, makes way for a new anchor."""
    t, s = Neighbours(), new_state(EstimatorSettings(height_m=0.0))
    for anchor, (range_m, power_dbm) in {**used, 99: new}.items():
        t.row = neighbour_of(t, anchor, 0)
        n = t.rows[t.row]
        n.has_place, n.place.position_mm[0] = True, round(1000 * range_m)
        n.has_power, n.power_dbm = power_dbm is not None, power_dbm or 0.0
        if anchor in used:
            add_anchor(s, anchor, np.zeros(3), -1.0, False)
    index = replaced_by(t, s, (0, 0, 0))
    return None if index < 0 else s.anchors[index].identifier


def test_the_weakest_leaves_for_one_that_is_stronger_by_3_db():
    assert replaced_anchor((10.0, -77.1), {1: (10.0, -80.0), 2: (10.0, -75.0)}) is None
    assert replaced_anchor((10.0, -76.9), {1: (10.0, -80.0), 2: (10.0, -75.0)}) == 1
    assert BETTER_DB == 3.0


def test_where_no_power_is_reported_the_farthest_leaves_for_a_nearer_one():
    assert replaced_anchor((20.0, None), {1: (10.0, None), 2: (30.0, None)}) == 2
    assert replaced_anchor((25.0, None), {1: (10.0, None), 2: (30.0, None)}) is None


@pytest.mark.parametrize("nonsense", [math.nan, math.inf, -math.inf])
def test_powers_are_averaged_and_impossible_ones_passed_over(nonsense):
    n = Neighbour()
    for power_dbm in (nonsense, -80.0, nonsense, -70.0):
        add_power(n, power_dbm)
    assert n.power_dbm == pytest.approx(-79.0)


@pytest.mark.parametrize(
    ("off_ticks", "fitting"), [(0, 2), (from_seconds(0.9e-6), 2), (from_seconds(3e-6), 0), (-from_seconds(1e-3), 0)]
)
def test_receptions_that_an_anchor_relays_show_whether_it_is_there(off_ticks, fitting):
    """It received anchors 1 to 4, 5 to 40 ms before its frame; the tag has another packet of 3, and does not use 4."""
    tx_ticks, rx_ticks, ages = (1 << 40) + 7, 5_000_000_000, [from_seconds(1e-3 * age) for age in (5, 10, 20, 40)]
    t, s = Neighbours(), new_state(EstimatorSettings(height_m=0.0))
    for n, age in enumerate(ages, start=1):
        row = t.rows[neighbour_of(t, n, rx_ticks)]
        row.frames, row.sequence, row.rx_ticks = 2, 8 if n == 3 else 9, rx_ticks - age
        if n < 4:
            add_anchor(s, n, np.zeros(3), -1.0, False)
    t.row = neighbour_of(t, 99, rx_ticks)
    t.rows[t.row].tx_ticks = tx_ticks
    heard = [Heard(n, 9, wrap(tx_ticks - age + off_ticks)) for n, age in enumerate(ages, start=1)]
    assert fitting_relays(t, s, relays(*heard), rx_ticks) == fitting


@pytest.mark.site
@settings(max_examples=20)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(1, 1000)), min_size=400, max_size=500))
def test_memory_is_bounded_and_those_that_others_receive_stay(rows):
    """Strangers come with any number of frames; anchors 1 to 9 are relayed by an anchor in use all the time."""
    t = Neighbours()
    for number, (frames, stranger) in enumerate(rows):
        rx_ticks = number * from_seconds(0.01)
        if number % 20 == 0:
            add_relays(t, relays(*range(1, 10)), rx_ticks)
            for anchor in range(1, 10):
                t.rows[find_neighbour(t, anchor)].frames = 2
        identifier = 1000 + 100 * number + stranger
        t.row = neighbour_of(t, identifier, rx_ticks)
        t.rows[t.row].frames = frames
        assert t.rows[t.row].anchor == identifier
    identifiers = {t.rows[row].anchor for row in range(t.count)}
    assert len(identifiers) == t.count == MAX_NEIGHBOURS
    assert set(range(1, 10)) <= identifiers
