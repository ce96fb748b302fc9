import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.almanac import SchedulePage
from skyless.core.protocol1.beacon import Schedule, first_slots, schedule_from_page, schedule_of
from skyless.core.site import AnchorSite, ScheduleSite, Site
from skyless.core.ticks import TICK_S


def site(first=(None,) * 7, master=11, **schedule):
    """Anchors 11, 12, … with these slots."""
    anchors = tuple(AnchorSite(11 + index, 0.0, 0.0, slot=slot) for index, slot in enumerate(first))
    return Site("lab", 1, master, anchors, ScheduleSite(**schedule))


def test_the_papers_rate():
    # 7 slots of 2^27 ticks: 14.70 ms, 68 superframes and 476 messages a second (the paper: 67 Hz).
    schedule = schedule_of(site())
    assert schedule == Schedule(2**27, 7, 1)
    assert schedule.superframe_ticks * TICK_S == pytest.approx(14.70e-3, abs=0.005e-3)
    assert schedule.superframe_rate_hz == pytest.approx(68.0, abs=0.05)
    assert schedule.messages_per_s(7) == pytest.approx(476.0, abs=0.5)


def test_pair_of_the_paper_in_every_superframe():
    schedule = schedule_of(site(frames_per_node=2))
    assert schedule.slots == 14
    assert [schedule.slots_of(first) for first in (0, 1, 6)] == [(0, 7), (1, 8), (6, 13)]
    assert schedule.messages_per_s(7) == pytest.approx(476.0, abs=0.5)


@given(st.floats(1e-4, 60e-3))
def test_slots_are_whole_steps_of_the_delayed_transmission(slot_s):
    schedule = schedule_of(site(slot_s=slot_s))
    assert schedule.slot_ticks % 512 == 0
    assert abs(schedule.slot_ticks * TICK_S - slot_s) <= 256 * TICK_S * (1 + 1e-9)


def test_schedule_from_the_almanac():
    assert schedule_from_page(SchedulePage(2**27, 14, 2, 1, 7, None)) == Schedule(2**27, 14, 2)


schedules = st.integers(1, 40).flatmap(
    lambda slots: st.builds(Schedule, st.integers(1, 10_000), st.just(slots), st.integers(1, slots))
)


@given(schedules, st.integers(0, 39), st.integers(0, 10**9))
def test_next_slot_is_the_first_not_before(schedule, first_slot, ticks_master):
    slots = schedule.slots_of(first_slot % schedule.slots)
    chosen = schedule.next_slot(ticks_master, slots)
    around = ticks_master // schedule.superframe_ticks
    starts = {
        schedule.slot_start_ticks(superframe, slot): (superframe, slot)
        for superframe in range(around, around + 2)
        for slot in slots
    }
    assert chosen == starts[min(start for start in starts if start >= ticks_master)]


@given(schedules, st.integers(0, 39))
def test_frames_of_a_node_are_spread(schedule, first_slot):
    slots = schedule.slots_of(first_slot % schedule.slots)
    assert len(set(slots)) == schedule.frames_per_node
    assert first_slot % schedule.slots in slots
    assert list(slots) == sorted(slots)
    assert set(slots) <= set(range(schedule.slots))


@given(st.integers(1, 12), st.integers(1, 4), st.integers(0, 11))
def test_default_slots_fill_the_superframe_without_clash(anchors, frames_per_node, master_at):
    master = 11 + master_at % anchors
    a_site = site((None,) * anchors, master=master, frames_per_node=frames_per_node)
    schedule, first = schedule_of(a_site), first_slots(a_site)
    used = sorted(slot for node in first for slot in schedule.slots_of(first[node]))
    assert used == list(range(schedule.slots))
    assert first[master] == 0
    others = [first[node.id] for node in a_site.anchors if node.id != master]
    assert others == sorted(others)
    assert list(first) == [node.id for node in a_site.anchors]


def test_given_slots_are_kept_and_the_others_go_around():
    assert first_slots(site((None, 0, None, 5), slots=6, master=13)) == {11: 2, 12: 0, 13: 1, 14: 5}


@pytest.mark.parametrize(
    ("a_site", "message"),
    [
        (site((3, 3)), "anchor 11: slot is 3; it must be from 0 to 1"),
        (site((3, 3), slots=6), "anchor 12: slot is 3; .* another anchor's"),
        (site((0, 2, None), slots=6, frames_per_node=3), "anchor 12: slot is 2; .* another anchor's"),
        (site((-1, None)), "anchor 11: slot is -1"),
        (site((None,) * 4, slots=3), "anchor 14 finds no free slot; schedule.slots is 3"),
    ],
)
def test_slots_that_cannot_be_are_named(a_site, message):
    with pytest.raises(ValueError, match=message):
        first_slots(a_site)


@given(st.integers(1, 8), st.integers(1, 8), st.integers(0, 5))
def test_every_node_speaks_once_in_each_round(nodes, frames, spare):
    """Also where the slots are no multiple of the frames per node."""
    slots = nodes * frames + spare
    schedule = Schedule(2**27, slots, frames)
    for first in first_slots(site((None,) * nodes, slots=slots, frames_per_node=frames)).values():
        rounds = [schedule.round_of(7, slot) for slot in schedule.slots_of(first)]
        assert rounds == list(range(7 * frames, 8 * frames))
