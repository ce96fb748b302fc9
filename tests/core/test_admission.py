"""Each rule by which a tag accepts frames and chooses anchors, at the very number from which it holds."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.core.air.beacon import Beacon, fields_of
from skyless.core.air.frame import Heard
from skyless.core.air.neighbours import (
    IMPOSSIBLE_STAMP,
    OUT_OF_ORDER,
    RELAYED_TICKS,
    Neighbour,
    Neighbours,
    find_neighbour,
    is_confirmed,
    neighbour_of,
)
from skyless.core.air.site_choice import NO_SITE, SITE_SILENCE_TICKS
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import add_anchor, new_state
from skyless.core.native.records import MAX_NEIGHBOURS
from skyless.core.tag.admission import (
    ADMITTED,
    BETTER_DB,
    COUNTER_JUMP_TICKS,
    COUNTER_JUMPED,
    DROP_COUNTERS,
    FOREIGN_SITE,
    HOST_JUMPED,
    IMPOSSIBLE_HOST_TIME,
    MAX_POWER_DBM,
    SITE_CHANGED,
    Admission,
    add_power,
    add_relays,
    admit_sender,
    admit_stamp,
    fitting_relays,
    replaced_by,
)
from skyless.core.ticks import FLIGHT_SLACK_TICKS, LAST_TICKS, MAX_DRIFT, NEVER, from_seconds, wrap

HOME, OTHER = 7, 8
FIRST = from_seconds(5.0)
MS = from_seconds(1e-3)


# Frames


def hear(a, rx_ticks, *, site=HOME, anchor=1, tx_ticks=None):
    """Admit a frame of an anchor whose counter agrees with the tag's, without a host's time."""
    outcome = admit_sender(a, site, anchor, wrap(rx_ticks), math.nan)
    tx_counter = wrap(rx_ticks if tx_ticks is None else tx_ticks)
    return admit_stamp(a, anchor, rx_ticks % 256, tx_counter, 0) if outcome == ADMITTED else outcome


def one_heard(**choice):
    """What a tag knows after its first frame."""
    a = Admission()
    a.choice = a.choice.changed(**choice)
    assert hear(a, FIRST) == ADMITTED
    return a


def test_frames_of_the_first_site_are_admitted():
    a = one_heard()
    assert (a.rx_ticks, a.choice.site, a.choice.heard_ticks, a.neighbours.count, a.events) == (FIRST, HOME, FIRST, 1, 0)
    assert hear(a, FIRST + MS, anchor=2) == ADMITTED
    assert (a.choice.since_ticks, a.choice.heard_ticks, a.neighbours.count, a.events) == (FIRST, FIRST + MS, 2, 0)


@pytest.mark.parametrize(("back", "is_restart"), [(COUNTER_JUMP_TICKS, False), (COUNTER_JUMP_TICKS + 1, True)])
def test_two_stamps_in_a_row_that_go_back_by_more_than_a_second_are_a_restart(back, is_restart):
    a = one_heard()
    for now in (FIRST, FIRST + MS):
        assert hear(a, now - back) == OUT_OF_ORDER
        assert (a.own.last_ticks, a.went_back, a.events) == (now, is_restart, 0)
        hear(a, FIRST + MS)  # so that each is a single one
    assert hear(a, now - back) == OUT_OF_ORDER
    assert hear(a, now - back) == (ADMITTED if is_restart else OUT_OF_ORDER)
    assert a.events == (COUNTER_JUMPED if is_restart else 0)
    assert (a.own.last_ticks, a.choice.since_ticks) == ((now - back, now - back) if is_restart else (now, FIRST))
    assert (a.went_back, a.neighbours.rows[0].frames) == (False, 1 if is_restart else 2)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("beyond", [0, 1])
def test_a_time_beyond_a_year_of_ticks_begins_again(sign, beyond):
    a = one_heard()
    a.own.last_ticks, a.neighbours.newest_rx_ticks = sign * LAST_TICKS, -LAST_TICKS
    outcome = admit_sender(a, HOME, 1, wrap(sign * (LAST_TICKS + beyond)), math.nan)
    n = a.neighbours
    if beyond:
        assert (outcome, a.events, a.own.has_stamp, a.went_back) == (IMPOSSIBLE_HOST_TIME, HOST_JUMPED, False, False)
        assert (n.has_newest, n.rows[0].frames, a.choice.heard_ticks, a.choice.since_ticks) == (False, 0, 0, 0)
        assert hear(a, FIRST) == ADMITTED
        assert a.rx_ticks == FIRST
    else:
        assert (outcome, a.events, a.own.has_stamp, n.rows[0].frames) == (ADMITTED, 0, True, 1)


@pytest.mark.parametrize(
    ("only_site", "silence_ticks", "is_left"),
    [(NO_SITE, MS, False), (NO_SITE, SITE_SILENCE_TICKS, True), (HOME, SITE_SILENCE_TICKS, False)],
)
def test_the_anchors_of_a_site_that_is_left_are_forgotten(only_site, silence_ticks, is_left):
    a = one_heard(only_site=only_site)
    later = FIRST + silence_ticks
    if is_left:
        assert admit_sender(a, OTHER, 2, later, math.nan) == ADMITTED
        assert (a.neighbours.count, a.neighbours.has_newest, a.events) == (0, False, SITE_CHANGED)
    else:
        assert hear(a, later, site=OTHER, anchor=2) == FOREIGN_SITE
        assert (a.neighbours.count, a.neighbours.has_newest, a.events) == (1, True, 0)
        assert a.own.last_ticks == later, "the tag's own counter goes on"


def test_a_frame_whose_stamp_does_not_fit_leaves_no_trace_in_the_tag_s_counter():
    a = one_heard()
    assert hear(a, FIRST + 2 * MS, tx_ticks=FIRST + 9 * MS) == IMPOSSIBLE_STAMP
    assert (a.own.last_ticks, a.choice.heard_ticks) == (FIRST, FIRST)
    counters = [DROP_COUNTERS[one] for one in (ADMITTED, OUT_OF_ORDER, FOREIGN_SITE, IMPOSSIBLE_HOST_TIME)]
    assert counters == [(), ("out-of-order",), ("foreign-site",), ("impossible-host-time",)]


# Relays


def relays(*heard, has_phases=False):
    heard = tuple(one if isinstance(one, Heard) else Heard(one, 0, 0) for one in heard)
    return fields_of(Beacon(1, 99, 0, 0, 0, 0, None, heard, 0, None, has_phases=has_phases))


def confirmed(t, anchor, rx_ticks):
    row = find_neighbour(t, anchor)
    return row >= 0 and is_confirmed(t.rows[row], rx_ticks)


def test_a_relayed_reception_confirms_for_two_seconds():
    t = Neighbours()
    t.rows[neighbour_of(t, 8, 0)].own_relays_ticks = 5
    add_relays(t, relays(7, 8), 1000)
    assert confirmed(t, 7, 1000 + RELAYED_TICKS - 1)
    assert not confirmed(t, 7, 1000 + RELAYED_TICKS)
    assert not confirmed(t, 9, 1000)
    assert t.rows[find_neighbour(t, 8)].own_relays_ticks == NEVER


AGES = [5 * MS, 10 * MS, 20 * MS, 20 * MS, 40 * MS]
SLACKS = [FLIGHT_SLACK_TICKS + int(MAX_DRIFT * age) for age in AGES[:2]]


@pytest.mark.parametrize("has_phases", [False, True])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("off_ticks", "fitting"), [(0, 2), (SLACKS[0], 2), (SLACKS[0] + 1, 1), (SLACKS[1], 1), (SLACKS[1] + 1, 0), (MS, 0)]
)
def test_receptions_that_an_anchor_relays_show_whether_it_is_there(off_ticks, fitting, sign, has_phases):
    """It received anchors 1 to 5 before its frame.

    The tag has another packet of 3, has forgotten when it received 4, and does not use 5.
    """
    tx_ticks, rx_ticks = (1 << 40) + 7, 5_000_000_000
    t, s = Neighbours(), new_state(EstimatorSettings(height_m=0.0))
    for n, age in enumerate(AGES, start=1):
        row = t.rows[neighbour_of(t, n, rx_ticks)]
        row.frames, row.sequence, row.rx_ticks = (1, 2, 2, 0, 2)[n - 1], 8 if n == 3 else 9, rx_ticks - age
        if n < 5:
            add_anchor(s, n, np.zeros(3), -1.0, False)
    t.row = neighbour_of(t, 99, rx_ticks)
    t.rows[t.row].tx_ticks = tx_ticks
    heard = [Heard(n, 9, wrap(tx_ticks - age + sign * off_ticks)) for n, age in enumerate(AGES, start=1)]
    assert fitting_relays(t, s, relays(*heard, has_phases=has_phases), rx_ticks) == fitting


def test_of_a_relay_with_phases_the_wrap_nearest_to_the_tags_own_reception_counts():
    """Its stamp has 32 bits: 40 ms before and after a frame look the same 7 ms from half a wrap."""
    t, s = Neighbours(), new_state(EstimatorSettings(height_m=0.0))
    for n, age in ((1, 40 * MS), (2, 0)):
        t.row = neighbour_of(t, n, 0)
        t.rows[t.row].frames, t.rows[t.row].rx_ticks, t.rows[t.row].tx_ticks = 2, FIRST - age, FIRST
    add_anchor(s, 1, np.zeros(3), -1.0, False)
    assert fitting_relays(t, s, relays(Heard(1, 0, wrap(FIRST - 40 * MS)), has_phases=True), FIRST) == 1


# Powers, and the anchors in use


@pytest.mark.parametrize("nonsense", [math.nan, math.inf, MAX_POWER_DBM + 1e-9, -MAX_POWER_DBM - 1e-9])
def test_powers_are_averaged_and_impossible_ones_passed_over(nonsense):
    n = Neighbour()
    for power_dbm in (nonsense, -80.0, nonsense, -70.0):
        add_power(n, power_dbm)
    assert n.power_dbm == pytest.approx(-79.0)
    for power_dbm in (MAX_POWER_DBM, -MAX_POWER_DBM):
        n = Neighbour()
        add_power(n, power_dbm)
        assert (n.has_power, n.power_dbm) == (True, power_dbm)


def replaced_anchor(new, used, unknown=None):
    """Index in the state of the anchor that makes way for a new one; all with range and power."""
    t, s = Neighbours(), new_state(EstimatorSettings(height_m=0.0))
    s.x[0] = 3.0
    for anchor, (range_m, power_dbm) in {**used, 99: new}.items():
        t.row = neighbour_of(t, anchor, 0)
        n = t.rows[t.row]
        n.has_place, n.place.position_mm[0] = anchor != unknown, round(1000 * range_m) + 5000
        n.has_power, n.power_dbm = power_dbm is not None, power_dbm or 0.0
        if anchor in used:
            add_anchor(s, anchor, np.zeros(3), -1.0, False)
    return replaced_by(t, s, (2000, 0, 0))


@pytest.mark.parametrize(
    ("new", "used", "replaced"),
    [
        ((10.0, -80.0 + BETTER_DB), {1: (10.0, -80.0), 2: (10.0, -75.0)}, -1),
        ((10.0, -79.9 + BETTER_DB), {1: (10.0, -80.0), 2: (10.0, -75.0)}, 0),
        ((10.0, -60.0), {1: (10.0, -75.0), 2: (10.0, -80.0), 3: (10.0, -80.0)}, 1),
        ((20.0, None), {1: (10.0, None), 2: (30.0, None)}, 1),  # the farthest, where no power is reported
        ((25.0, None), {1: (10.0, None), 2: (30.0, None)}, -1),
        ((10.0, -60.01), {1: (1.0, None)}, -1),
        ((10.0, -59.99), {1: (1.0, None)}, 0),
        ((10.0, -40.01), {1: (0.05, None)}, -1),  # as at 0.1 m
        ((10.0, -39.99), {1: (0.05, None)}, 0),
        ((10.0, -40.0), {1: (10.0, -80.0), 9: (10.0, -90.0)}, 0),  # 9 states no place
    ],
)
def test_the_weakest_leaves_for_one_that_is_stronger_by_3_db(new, used, replaced):
    assert replaced_anchor(new, used, unknown=9) == replaced


def test_an_anchor_in_use_that_is_not_in_the_table_stays():
    t, s = Neighbours(), new_state(EstimatorSettings(height_m=0.0))
    t.row = neighbour_of(t, 99, 0)
    t.rows[t.row].has_power = True
    add_anchor(s, 1, np.zeros(3), -1.0, False)
    assert replaced_by(t, s, (0, 0, 0)) == -1


@pytest.mark.site
@settings(max_examples=20)
@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(1, 1000)), min_size=400, max_size=500), st.sampled_from([20, 190])
)
def test_memory_is_bounded_and_those_that_others_receive_stay(rows, every):
    """Strangers come with any number of frames; an anchor in use relays anchors 1 to 9 every 0.2 s or 1.9 s."""
    t = Neighbours()
    for number, (frames, stranger) in enumerate(rows):
        rx_ticks = number * 10 * MS
        if number % every == 0:
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
