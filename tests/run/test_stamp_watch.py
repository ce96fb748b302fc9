"""What an anchor's stamps show by themselves: clocks of their own, and two values."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.ticks import TICK_M, from_seconds
from skyless.run.masterless.stamp_watch import READY_S, StampWatch, two_values

EVERY_S = 0.05


def heard(watch, own_ppm=(0.0, 0.0, 0.0, 0.0), late_m=None, rounds=60, claims=True, speed_mps=0.0, begin_s=1.0):
    """Let a watch hear rounds of anchors; ``late_m`` gives lateness by anchor and round. Returns what it said."""
    said = []
    for index in range(rounds):
        for anchor, ppm in enumerate(own_ppm):
            sent_s = begin_s + index * EVERY_S + 0.002 * anchor
            path_m = 5.0 + anchor + speed_mps * index * EVERY_S
            path_m += 0.0 if late_m is None else late_m(anchor, index)
            rx_ticks = from_seconds(sent_s * (1.0 + 7e-6)) + round(path_m / TICK_M)
            tx_ticks = from_seconds(sent_s * (1.0 + ppm * 1e-6))
            said.append(watch.check(anchor, rx_ticks, tx_ticks, claims_common_time=claims))
    return said


@given(
    ppm=st.floats(0.25, 20.0), sign=st.sampled_from((-1.0, 1.0)), who=st.integers(0, 3), speed_mps=st.floats(-20, 20)
)
def test_the_anchor_with_a_clock_of_its_own_is_named_and_no_other(ppm, sign, who, speed_mps):
    watch = StampWatch()
    said = heard(watch, [sign * ppm * (anchor == who) for anchor in range(4)], rounds=20, speed_mps=speed_mps)
    assert list(watch.own_clocks_ppm) == [who]
    assert watch.own_clocks_ppm[who] == pytest.approx(sign * ppm, abs=0.01)
    assert [index % 4 for index, fault in enumerate(said) if fault] == [who] * said.count("time-base-lost") != []
    assert watch.changes == 1


@pytest.mark.parametrize("claims", [False, True])
def test_clocks_of_crystals_are_no_fault_where_no_common_time_is_claimed(claims):
    watch = StampWatch()
    heard(watch, (0.0, 3.0, 0.0, 0.0), claims=claims)
    assert list(watch.own_clocks_ppm) == [1] * claims


@pytest.mark.parametrize("own_ppm", [(0.0, 5.0), (0.0, 0.0, 5.0, 5.0), (0.0, 3.0, 5.0)])
def test_no_anchor_is_named_where_it_may_be_any(own_ppm):
    watch = StampWatch()
    assert not any(heard(watch, own_ppm))


def test_two_anchors_with_clocks_of_their_own_among_four_are_named():
    watch = StampWatch()
    heard(watch, (0.0, 3.0, 0.0, -5.0))
    assert list(watch.own_clocks_ppm) == [1, 3]


def test_a_time_base_that_is_back_is_in_use_again():
    watch = StampWatch()
    heard(watch, (0.0, 5.0, 0.0))
    said = heard(watch, (0.0, 0.0, 0.0), begin_s=10.0)
    assert not watch.own_clocks_ppm
    assert not any(said[90:])


@pytest.mark.parametrize(("share", "least"), [(0.3, 0.95), (0.5, 0.95), (0.7, 0.8)])
@pytest.mark.parametrize("gap_m", [0.7, 1.2, 3.0])
def test_the_later_of_two_values_is_left_out(share, least, gap_m):
    draw = np.random.default_rng([1, int(10 * share), int(10 * gap_m)])
    is_late = draw.random((4, 200)) < share
    noise_m = draw.normal(0.0, 0.03, (4, 200))
    watch = StampWatch()
    said = heard(watch, late_m=lambda a, k: gap_m * is_late[a, k] + noise_m[a, k], rounds=200, speed_mps=1.5)
    found = np.array([fault == "late-of-two-values" for fault in said]).reshape(200, 4).T[:, 40:]
    assert (found == is_late[:, 40:]).mean() > least
    assert watch.flips_m == pytest.approx(dict.fromkeys(range(4), gap_m), abs=0.25)


def test_people_who_pass_are_no_flips():
    draw = np.random.default_rng(4)
    late_m = np.zeros((4, 600))
    for anchor in range(4):
        for begin in draw.integers(0, 590, 20):
            late_m[anchor, begin : begin + draw.integers(2, 12)] = draw.uniform(0.5, 2.0)
    watch = StampWatch()
    heard(watch, late_m=lambda a, k: late_m[a, k], rounds=600)
    assert not watch.flips_m
    assert not watch.changes


def test_neither_an_obstacle_nor_single_late_packets_are_two_values():
    draw = np.random.default_rng(3)
    single_m = draw.exponential(1.0, (4, 400)) * (draw.random((4, 400)) < 0.1)
    watch = StampWatch()
    heard(watch, late_m=lambda a, k: 1.2 * (k > 200) if a == 0 else single_m[a, k], rounds=400)
    assert not watch.flips_m


def test_an_anchor_that_is_silent_is_not_named_any_more():
    watch = StampWatch()
    heard(watch, (0.0, 0.0, 5.0), rounds=20)
    assert list(watch.own_clocks_ppm) == [2]
    heard(watch, (0.0, 0.0), begin_s=8.0, rounds=2)
    assert not watch.own_clocks_ppm


def test_faults_show_within_a_second():
    watch = StampWatch()
    heard(watch, rounds=int(READY_S / EVERY_S))
    assert not watch.is_ready
    heard(watch, begin_s=1.0 + READY_S)
    assert watch.is_ready
    watch.forget()
    heard(watch, rounds=1, begin_s=9.0)
    assert not watch.is_ready


@given(st.lists(st.booleans(), min_size=16, max_size=16), st.floats(-5.0, 5.0), st.floats(0.8, 3.0))
def test_two_lines_are_found_at_any_slope(is_late, slope_mps, gap_m):
    time_s = EVERY_S * np.arange(16)
    late = np.array(is_late)
    above_m, found_m, evidence = two_values(time_s, slope_mps * time_s + gap_m * late)
    changes = (late[1:] != late[:-1]).sum()
    if min(late.sum(), 16 - late.sum()) >= 3 and changes >= 5 and max(late.sum(), 16 - late.sum()) > 8:
        assert (above_m, found_m) == (pytest.approx(gap_m * late[-1], abs=0.2), pytest.approx(gap_m, abs=0.2))
        assert evidence >= 1.0
    elif late.all() or not late.any():
        assert (above_m, found_m, evidence) == (0.0, 0.0, 0.0)
