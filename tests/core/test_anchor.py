"""The anchor's machine in the simulated world and against a master made of arithmetic."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.core.air.frame import Heard, Reception
from skyless.core.air.site_pages import decode_page, encode_page
from skyless.core.native.views import view
from skyless.core.protocol1.almanac import page_for, pages_of
from skyless.core.protocol1.anchor import MAX_OFFSET_STD_M, Anchor
from skyless.core.protocol1.beacon import Beacon, MasterTime, decode, encode, first_slots, schedule_of
from skyless.core.ticks import DELAYED_TX_GRANULARITY_TICKS, TICK_M, TICK_RATE_HZ, TICK_S, difference, wrap
from skyless.sim.impairments import AnchorOutage, Outage
from support.bench import LAB, PAIRS, Stage

pytestmark = pytest.mark.site

RANGE_TICKS = {anchor.id: math.hypot(anchor.x_m, anchor.y_m) / TICK_M for anchor in LAB.anchors}


def beacons(stage, until_s):
    """Every broadcast with its beacon."""
    for broadcast in stage.world.run(until_s):
        yield broadcast, decode(broadcast.frame)


def master_reading(world, broadcast):
    """What the master's counter truly shows when a frame leaves: unwrapped ticks and fraction."""
    clock = world.medium.clocks[0]
    ahead = broadcast.emission_ticks - clock.true_ticks
    elapsed = (ahead + broadcast.emission_fraction - clock.true_fraction) * (1.0 + clock.rate)
    whole = math.floor(elapsed)
    return clock.local_ticks + whole, clock.local_fraction + elapsed - whole


class Ideal:
    """A master that never errs, and one listener's counter: where both stand after so many seconds."""

    def __init__(self, site=LAB, anchor=4, ppm=7.0):
        self.site, self.id, self.ppm = site, anchor, ppm
        self.anchor = Anchor(site, anchor)
        self.epoch_master, self.epoch_own = 2**40 - 10**9, 12345
        self.superframe_ticks = schedule_of(site).superframe_ticks

    def own_ticks(self, t_ticks):
        return self.epoch_own + t_ticks + round(t_ticks * self.ppm * 1e-6)

    def beacon(self, number):
        tx_ticks = wrap(self.epoch_master + number * self.superframe_ticks)
        return Beacon(1, 1, number & 0xFF, number, 0, tx_ticks, 0, 1, 0, None, MasterTime(tx_ticks << 8, 0.0), (), None)

    def reception(self, number, host=False, **fields):
        t_ticks = number * self.superframe_ticks
        rx_ticks = wrap(self.own_ticks(t_ticks) + round(RANGE_TICKS[self.id]))
        host_s = 1000.0 + t_ticks * TICK_S if host else None
        return Reception(encode(replace(self.beacon(number), **fields)), rx_ticks, host_s)

    def hear(self, superframes, **options):
        for superframe in superframes:
            self.anchor.hear(self.reception(superframe, **options))

    def sent(self, superframe):
        """The frame the anchor makes one millisecond after the master's of that superframe, None if it is silent."""
        now = wrap(self.own_ticks(superframe * self.superframe_ticks + round(1e-3 * TICK_RATE_HZ)))
        tx_ticks = self.anchor.next_transmission_ticks(now)
        return None if tx_ticks is None else decode(self.anchor.transmission(tx_ticks).frame)

    def error_m(self, beacon):
        """Claimed master time less the truth."""
        own = difference(beacon.tx_ticks, wrap(self.epoch_own))
        own += round((beacon.superframe * self.superframe_ticks - own) / 2**40) * 2**40
        t_ticks = own / (1.0 + self.ppm * 1e-6)
        whole = math.floor(t_ticks)
        claimed = beacon.master_time.tx_subticks_master
        error = difference(claimed, wrap(self.epoch_master + whole, 40) << 8, 48) / 256
        return (error - (t_ticks - whole)) * TICK_M


def test_anchors_join_from_silence_by_listening_only():
    """The master starts after three superframes of silence; the others have heard it twice before they speak."""
    stage = Stage(LAB)
    for anchor in LAB.anchors:
        machine, step_ticks = Anchor(LAB, anchor.id), round(5e-3 * TICK_RATE_HZ)
        silent_s = next(k for k in range(1000) if machine.next_transmission_ticks(k * step_ticks) is not None) * 5e-3
        assert silent_s == pytest.approx(0.045 if anchor.id == 1 else 0.5 + (anchor.id - 2) * 0.25, abs=5.1e-3)
    first = {}
    for broadcast, beacon in beacons(stage, 0.2):
        first.setdefault(beacon.anchor, (broadcast.end_s, stage.machines[beacon.anchor].clock(None).beacons))
    assert sorted(first) == [1, 2, 3, 4, 5, 6]
    assert all(heard >= 2 for anchor, (_, heard) in first.items() if anchor != 1)
    assert max(end_s for end_s, _ in first.values()) < (3 + 1 + 3) * 15e-3


def test_stamps_lie_on_the_radios_grid_and_frames_in_their_slots():
    """On the master's true scale a frame leaves at most 512 ticks before its slot, within the clocks' accuracy."""
    stage, schedule, slots = Stage(LAB), schedule_of(LAB), first_slots(LAB)
    epoch, noise_ticks = None, 6.0 * (0.1 / TICK_M + 100e-12 / TICK_S)
    for broadcast, beacon in beacons(stage, 1.0):
        delay = stage.site.anchors[beacon.anchor - 1].tx_antenna_delay_ticks
        assert (beacon.tx_ticks - delay) % DELAYED_TX_GRANULARITY_TICKS == 0
        assert beacon.slot == slots[beacon.anchor]
        start = schedule.slot_start_ticks(beacon.superframe, beacon.slot)
        if epoch is None:
            epoch = beacon.tx_ticks - start
        reading = master_reading(stage.world, broadcast)
        late = difference(wrap(reading[0]), wrap(epoch + start)) + reading[1]
        assert -DELAYED_TX_GRANULARITY_TICKS - noise_ticks < late < DELAYED_TX_GRANULARITY_TICKS + noise_ticks


@pytest.mark.statistical
def test_the_master_time_is_as_good_as_it_says():
    """Mean of the squared normalised error over anchors, times and seeds.

    The frames' own TX noise is switched off, because the standard deviation does not contain it. Errors last about
    0.1 s (gain 0.2 per superframe), so 8 runs of 4 s count for about 300 independent times; anchors share the master's
    noise (correlation about a half), so the mean over five has variance 2/5·(1 + 4/4) = 0.8: one sigma is 0.052.
    """
    squares, largest = [], 0.0
    for seed in range(8):
        stage = Stage(LAB, seed)
        view(stage.world.medium.stations)["tx_noise_ticks"][1:] = 0.0
        for broadcast, beacon in beacons(stage, 5.0):
            if beacon.anchor == 1 or broadcast.end_s < 1.0:
                continue
            reading = master_reading(stage.world, broadcast)
            claimed = difference(beacon.master_time.tx_subticks_master, wrap(reading[0], 40) << 8, 48) / 256
            normalised = (claimed - reading[1]) / beacon.master_time.std_ticks
            squares.append(normalised**2)
            largest = max(largest, abs(normalised))
    assert len(squares) > 10_000
    assert np.mean(squares) == pytest.approx(1.0, abs=4 * 0.052)
    assert largest < 6.0


def test_the_master_sends_its_own_stamp_as_time():
    stage = Stage(LAB)
    times = [(b.tx_ticks, b.master_time, b.master_heard) for _, b in beacons(stage, 0.5) if b.anchor == 1]
    assert times == [(tx, MasterTime(tx << 8, 0.0), None) for tx, _, _ in times]


def test_what_is_heard_is_relayed(monkeypatch):
    """Each frame carries the raw stamps of the last beacon of every other anchor, the most recent first."""
    heard, original = {anchor: {} for anchor in range(1, 7)}, Anchor.hear

    def spy(machine, reception):
        beacon = decode(reception.frame)
        heard[machine.id][beacon.anchor] = (beacon.sequence, reception.rx_ticks)
        original(machine, reception)

    monkeypatch.setattr(Anchor, "hear", spy)
    for broadcast, beacon in beacons(Stage(LAB), 0.5):
        if broadcast.end_s < 0.2 or beacon.anchor == 1:
            continue
        # A frame is made 1 ms before it leaves and slots are 2.5 ms long: all before it were heard by then.
        relayed = {one.anchor: (one.sequence, one.rx_ticks) for one in (beacon.master_heard, *beacon.heard)}
        assert relayed == heard[beacon.anchor]
        assert beacon.master_heard.anchor == 1
        assert next(iter(beacon.heard)).anchor == (6 if beacon.anchor == 2 else beacon.anchor - 1)


def test_an_anchor_that_does_not_know_the_time_is_silent():
    """With others about and the master's news still fresh by their word, a listener that cannot hear it falls silent.

    The rate's variance grows with the walk: 0.18 m²/s³·t³/3 alone reaches (0.3 m)² after 1.1 s.
    """
    ideal, last, largest_std_m = Ideal(), None, 0.0
    ideal.hear(range(200))
    for superframe in range(200, 400):
        relayed = Heard(1, superframe & 0xFF, 7)
        ideal.hear([superframe], anchor=5, slot=4, master_heard=relayed)
        beacon = ideal.sent(superframe)
        if beacon is not None:
            last, largest_std_m = superframe, beacon.master_time.std_ticks * TICK_M
    assert MAX_OFFSET_STD_M / 2 < largest_std_m < 1.05 * MAX_OFFSET_STD_M
    assert 0.5 / 15e-3 < last - 200 < 1.2 / 15e-3
    ideal.hear(range(400, 410))
    assert ideal.sent(409) is not None
    assert ideal.anchor.counters["takeover"] == 0


@pytest.mark.parametrize("ppm", [-20.0, 7.0])
def test_an_hour_of_wraps(ppm):
    """The own counter and the master's wrap 210 times, and not together."""
    ideal = Ideal(ppm=ppm)
    step = round(0.3 * TICK_RATE_HZ / ideal.superframe_ticks)
    worst = 0.0
    for superframe in range(0, round(3600 * TICK_RATE_HZ / ideal.superframe_ticks), step):
        ideal.hear([superframe])
        beacon = ideal.sent(superframe)
        if superframe > 10 * step:
            worst = max(worst, abs(ideal.error_m(beacon)))
    assert ideal.anchor.counters == {"heard": 12000, "sent": 11999}
    assert worst < 2.5 * TICK_M


@pytest.mark.parametrize(
    ("host", "gap_s"), [*((True, gap_s) for gap_s in (1.0, 5.0, 9.0, 20.0, 3600.0)), (False, 3600.0)]
)
def test_only_a_gap_without_host_time_restarts_the_clock(host, gap_s):
    """The driver asks for the next transmission without a host time in between."""
    ideal = Ideal()
    ideal.hear(range(200), host=host)
    assert ideal.sent(199) is not None
    later = 200 + round(gap_s * TICK_RATE_HZ / ideal.superframe_ticks)
    ideal.hear(range(later, later + 100), host=host)
    assert ideal.anchor.counters["clock-restart"] == (not host)
    assert abs(ideal.error_m(ideal.sent(later + 99))) < 2.5 * TICK_M


def test_what_does_not_belong_is_counted_and_changes_nothing():
    ideal, other = Ideal(), Ideal()
    strange = {
        "foreign-site": ideal.reception(200, site=2).frame,
        "unknown-anchor": ideal.reception(200, anchor=77, tx_ticks=5).frame,
        "bad-fcs": ideal.reception(200).frame[:-1] + b"\0",
        "too-short": b"abc",
        "too-long": bytes(128),
    }
    ideal.hear(range(200))
    other.hear(range(200))
    for frame in strange.values():
        ideal.anchor.hear(Reception(frame, 99))
    ideal.anchor.hear(Reception(ideal.reception(200, anchor=4, tx_ticks=5).frame, 99))  # its own voice
    assert ideal.anchor.counters == {"heard": 200, **dict.fromkeys(strange, 1), "unknown-anchor": 2}
    assert ideal.sent(199) == other.sent(199)


@pytest.mark.parametrize("at", [3, 200])
@pytest.mark.parametrize("fields", [{"superframe": 10**6, "tx_ticks": 5}, {"tx_ticks": 2**39 - 10**9 + 10**6}])
def test_one_forged_beacon_of_the_master_moves_nothing(at, fields):
    """Neither the clock nor the slots, wherever in the filter's life it comes."""
    ideal, other = Ideal(), Ideal()
    ideal.hear(range(at))
    ideal.hear([at], **fields)
    ideal.hear(range(at + 1, at + 3))
    other.hear([*range(at), *range(at + 1, at + 3)])
    assert ideal.anchor.counters == {"heard": at + 3, "impossible-stamp": 1}
    assert ideal.sent(at + 2) == other.sent(at + 2)


def test_a_replayed_and_a_repeated_beacon_of_the_master_move_nothing():
    """Old frames heard again, each as long after as may be, 200 of them among the valid ones."""
    ideal, other = Ideal(), Ideal()
    ideal.hear(range(400))
    other.hear(range(400))
    for superframe in range(400, 600):
        fresh = ideal.reception(superframe)
        ideal.anchor.hear(fresh)
        ideal.anchor.hear(fresh)
        ideal.anchor.hear(Reception(ideal.reception(superframe - 399).frame, wrap(fresh.rx_ticks + 10**7)))
        other.anchor.hear(fresh)
    assert ideal.anchor.counters["duplicate"] == 200
    assert ideal.anchor.counters["impossible-stamp"] == 200
    assert ideal.anchor.counters["clock-restart"] == 0
    assert ideal.sent(599) == other.sent(599)


@pytest.mark.parametrize("jump", [10**6, 2**39 - 10**8, 2**39 + 10**8, 2**40 - 10**6])
def test_a_master_that_starts_anew_is_followed_wherever_its_counter_starts(jump):
    ideal = Ideal()
    ideal.hear(range(200))
    ideal.epoch_master += jump
    ideal.hear(range(200, 250))
    assert ideal.anchor.counters["clock-restart"] == 1
    assert abs(ideal.error_m(ideal.sent(249))) < 2.5 * TICK_M


def test_stamps_of_an_anchor_that_fell_silent_are_not_relayed_for_ever():
    """After 256 frames its sequence numbers would name other frames."""
    stage, last = Stage(LAB, anchor_outages=(AnchorOutage(3, Outage(1.0)),)), {}
    for broadcast, beacon in beacons(stage, 3.0):
        if any(entry.anchor == 3 for entry in beacon.heard):
            last[beacon.anchor] = broadcast.end_s
    assert sorted(last) == [1, 2, 4, 5, 6]
    assert 1.9 < min(last.values()) <= max(last.values()) < 2.1


def test_two_frames_per_superframe():
    """Each anchor speaks twice, half a superframe apart, and every frame in a slot of its own."""
    stage = Stage(PAIRS)
    seen = {}
    for _, beacon in beacons(stage, 1.0):
        seen.setdefault(beacon.anchor, []).append((beacon.superframe, beacon.slot))
    for anchor, frames in seen.items():
        assert {slot for _, slot in frames} == {anchor - 1, anchor + 5}
        numbers = [2 * superframe + (slot > 5) for superframe, slot in frames]
        assert numbers == list(range(numbers[0], numbers[0] + len(frames)))


def a_master():
    """A fresh one, and the time at which it begins to speak."""
    anchor, now = Anchor(LAB, 1), round(50e-3 * TICK_RATE_HZ)
    assert anchor.next_transmission_ticks(0) is None
    assert anchor.next_transmission_ticks(now) is not None
    return anchor, now


def test_the_wrong_time_is_refused():
    anchor, now = a_master()
    tx_ticks = anchor.next_transmission_ticks(now)
    with pytest.raises(KeyError):
        anchor.transmission(tx_ticks + 512)
    assert anchor.transmission(tx_ticks).tx_ticks == tx_ticks


def test_superframes_wrap_after_two_years():
    """Numbers on the air are taken modulo 2³², for the master that counts them and for those that follow."""
    ideal = Ideal()
    for step in range(100):
        superframe = (2**32 - 50 + step) % 2**32
        ideal.hear([step], superframe=superframe)
        if step in {40, 99}:
            assert ideal.sent(step).superframe == superframe


@pytest.mark.parametrize("ahead", [-1, 0, 1, 2**20])
def test_pages_rotate_with_the_number_on_the_air_beyond_two_years(ahead):
    """A master that has counted past 2³² sends the page that belongs to the number its frame shows."""
    (master, start), schedule = a_master(), schedule_of(LAB)
    master._clock.epoch_ticks = start - (2**32 + ahead) * schedule.superframe_ticks
    for k in range(7):
        tx_ticks = master.next_transmission_ticks(start + k * schedule.superframe_ticks + 5)
        beacon = decode(master.transmission(tx_ticks).frame)
        assert beacon.superframe == (ahead + k + 1) % 2**32
        assert beacon.page == decode_page(encode_page(page_for(pages_of(LAB), beacon.superframe, beacon.slot)))


def test_an_anchor_tells_its_own_counter_less_the_sites_time():
    """Against the world's own clocks; the master's offset is nought, the others' are theirs against the master's."""
    stage = Stage(LAB, 4)
    assert all(anchor.clock(0).offset_s is None for anchor in (Anchor(LAB, 1), Anchor(LAB, 2)))
    *_, (broadcast, _) = beacons(stage, 3.0)
    medium = stage.world.medium
    counters = {anchor: medium.read_counter(node) for anchor, node in medium.node_of.items()}
    for anchor, machine in stage.machines.items():
        state = machine.clock(wrap(counters[anchor]))
        truth_s = difference(wrap(counters[anchor]), wrap(counters[1])) * TICK_S
        assert state.offset_s == pytest.approx(truth_s, abs=2e-9)
        assert state.superframe in {int(broadcast.end_s / 0.015) - k for k in range(5)}
