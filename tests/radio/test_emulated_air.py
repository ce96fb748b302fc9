"""The ether with a clock that stands still until the test moves it: everything but the network, to the last bit."""

import pytest
from air_stage import LAB, Stage, in_loop
from msgspec.structs import replace

from skyless.core.air.frame import after_rmarker_s
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_S, difference
from skyless.radio.emulated import Arrival, Clocks, Done, Joined, Send

FRAME = b"a frame" * 10


async def test_a_frame_reaches_all_that_are_on_the_air_and_its_sender_is_reported():
    stage = Stage()
    sender, session = stage.join("anchor", "1")
    others, _ = stage.join("anchor", "2", "4")
    tags, _ = stage.join("tag", "tag2", "tag1")
    sent_s = stage.now_s
    tx_ticks = stage.send(sender, session, ahead_s=2e-3)
    stage.pass_time(1.9e-3)
    assert sender.of(Done) == others.of(Arrival) == tags.of(Arrival) == []
    stage.pass_time(1e-3)
    assert sender.of(Done) == [Done(0, tx_ticks, late=False)]
    assert sender.of(Arrival) == []
    (arrival,) = tags.of(Arrival)
    assert arrival.frame == FRAME
    assert [row.node for row in arrival.rows] == [1, 0]  # as this process numbers them
    assert [row.node for row in others.of(Arrival)[0].rows] == [0, 1]
    # it ended as long after the RMARKER as it lasts, and that left when it should but for 20 ppm and 512 ticks
    assert arrival.host_s == pytest.approx(sent_s + 2e-3 + after_rmarker_s(len(FRAME)), abs=1e-7)


async def test_stamps_are_the_flight_time_apart():
    """Two anchors answer each other: half the sum of both one-way differences is the distance, clocks cancel out."""
    stage = Stage(noise_ps=1e-3)
    one, one_session = stage.join("anchor", "1")
    two, two_session = stage.join("anchor", "4")
    stamps = []
    # asymmetric single-sided ranging; the turn-round of 1.5 ms costs ppm × 1.5 ms, which a second round measures
    for sender, session, listener in ((one, one_session, two), (two, two_session, one), (one, one_session, two)):
        stage.send(sender, session, ahead_s=1e-3)
        stage.pass_time(1.5e-3)
        stamps.append((sender.of(Done)[-1].tx_ticks, listener.of(Arrival)[-1].rows[0].rx_ticks))
    (tx_one, rx_two), (tx_two, rx_one), (tx_again, rx_again) = stamps
    round_one, reply_two = difference(rx_one, tx_one), difference(tx_two, rx_two)
    reply_one, round_two = difference(tx_again, rx_one), difference(rx_again, tx_two)
    flight = (round_one * round_two - reply_one * reply_two) / (round_one + round_two + reply_one + reply_two)
    grid_m = 512 * TICK_S * SPEED_OF_LIGHT_MPS  # the radio sends at multiples of 512 ticks
    assert flight * TICK_S * SPEED_OF_LIGHT_MPS == pytest.approx(10.0, abs=grid_m)


@pytest.mark.parametrize("wrong_ticks", [-600, -1, 1, 20])
async def test_a_radio_that_is_set_to_another_delay_starts_its_frames_when_it_would_otherwise(wrong_ticks):
    """Only its stamps are off by the difference; the site of the ether has the delay that the radio really has."""
    delay_ticks = LAB.anchors[0].tx_antenna_delay_ticks

    def rx_ticks(tx_delays_ticks, wrong_ticks):
        stage = Stage()
        sender, session = stage.join("anchor", "1", tx_delays_ticks=tx_delays_ticks)
        tag, _ = stage.join("tag", "tag1")
        starts = stage.ticks(sender, 0, 2e-3) // 512 * 512
        stage.ether.transmit(session, Send(0, starts + delay_ticks + wrong_ticks, FRAME))
        stage.pass_time(4e-3)
        assert sender.of(Done) == [Done(0, starts + delay_ticks + wrong_ticks, late=False)]
        return tag.of(Arrival)[0].rows[0].rx_ticks

    assert rx_ticks((delay_ticks + wrong_ticks,), wrong_ticks) == rx_ticks((), 0)


async def test_delays_for_other_nodes_than_those_that_join_are_refused():
    _, session = Stage().join("anchor", "1", tx_delays_ticks=(1, 2))
    assert session == "tx_delays_ticks should have one value a node"


async def test_a_frame_that_comes_too_late_is_not_sent_and_reported_late():
    stage = Stage()
    sender, session = stage.join("anchor", "1")
    tag, _ = stage.join("tag", "tag1")
    for ahead_s in (0.3e-3, 0.0, -1.0):
        tx_ticks = stage.send(sender, session, ahead_s=ahead_s)
        assert sender.of(Done)[-1] == Done(0, tx_ticks, late=True)
    stage.pass_time(0.1)
    assert tag.of(Arrival) == []
    health = stage.ether.health(0.0)
    assert (health.transmissions, health.late) == (0, 3)


async def test_a_radio_has_room_for_one_frame():
    stage = Stage()
    sender, session = stage.join("anchor", "1")
    first = stage.send(sender, session, ahead_s=2e-3)
    second = stage.send(sender, session, ahead_s=5e-3)
    assert sender.of(Done) == [Done(0, second, late=True)]
    stage.pass_time(10e-3)
    assert sender.of(Done)[1:] == [Done(0, first, late=False)]
    stage.send(sender, session, ahead_s=2e-3)
    stage.pass_time(5e-3)
    assert stage.ether.health(0.0).transmissions == 2


def test_two_anchors_in_one_slot_collide_and_alone_they_do_not():
    def play(apart_s):
        stage = Stage()
        anchors, session = stage.join("anchor", "1", "4")
        tag, _ = stage.join("tag", "tag1")
        stage.send(anchors, session, 0, 2e-3)
        stage.send(anchors, session, 1, 2e-3 + apart_s)
        stage.pass_time(20e-3)
        assert len(anchors.of(Done)) == 2  # a sender does not know
        return len(tag.of(Arrival)), stage.ether.health(0.0).at_tags

    heard, outcomes = in_loop(lambda: play(10e-6))
    assert (heard, outcomes["heard"], outcomes["collision"]) == (0, 0, 2)
    heard, outcomes = in_loop(lambda: play(3e-3))
    assert (heard, outcomes["heard"], outcomes["collision"]) == (2, 2, 0)


def test_the_same_seed_and_the_same_doings_give_the_same_bits():
    def play(seed):
        stage = Stage(seed, loss=0.2, nlos=0.2)
        anchors, session = stage.join("anchor", "1", "2")
        tags, _ = stage.join("tag", "tag1", "tag2")
        for number in range(100):
            stage.send(anchors, session, number % 2, 2e-3)
            stage.pass_time(5e-3, steps=1 + number % 7)
        return anchors.events, tags.events

    one, same, other = in_loop(lambda: play(1)), in_loop(lambda: play(1)), in_loop(lambda: play(2))
    assert one == same
    assert one != other


@pytest.mark.parametrize(
    ("kind", "names", "said"),
    [
        ("anchor", ("1", "9"), "no anchor 9; it has: 1, 2, 3, 4, 5, 6"),
        ("tag", ("tag3",), "no tag tag3; it has: tag1, tag2"),
        ("tag", ("1",), "no tag 1"),
        ("anchor", ("2",), "anchor 2 is on the air already"),
        ("tag", ("tag1", "tag1"), "tag tag1 is on the air already"),
    ],
)
async def test_who_may_not_join_is_reported_why(kind, names, said):
    stage = Stage()
    stage.join("anchor", "2")
    client, answer = stage.join(kind, *names)
    assert said in answer
    assert client.events == []
    good, session = stage.join("anchor", "1")  # nobody is left half joined
    assert not isinstance(session, str)
    assert good.of(Joined)


async def test_who_leaves_is_off_the_air_and_comes_back_with_a_new_counter():
    stage = Stage()
    sender, session = stage.join("anchor", "1")
    tag, tag_session = stage.join("tag", "tag1")
    assert set(stage.ether.truth(0.0).tags) == {"tag1"}
    stage.pass_time(0.5)
    expected = stage.ticks(tag, 0, 0.0)
    stage.ether.leave(tag_session)
    assert stage.ether.truth(0.0).tags == {}
    stage.send(sender, session)
    stage.pass_time(5e-3)
    assert tag.of(Arrival) == []
    again, _ = stage.join("tag", "tag1")
    assert abs(difference(again.of(Joined)[0].ticks[0], expected)) > 1e6
    assert set(stage.ether.truth(0.0).tags) == {"tag1"}


async def test_a_frame_of_a_process_that_dies_before_it_leaves_is_not_sent():
    stage = Stage()
    sender, session = stage.join("anchor", "1")
    tag, _ = stage.join("tag", "tag1")
    stage.send(sender, session, ahead_s=3e-3)
    stage.ether.leave(session)
    again, session = stage.join("anchor", "1")
    tx_ticks = stage.send(again, session, ahead_s=20e-3)  # the old frame does not keep the new one from its place
    stage.pass_time(10e-3)
    assert (tag.of(Arrival), again.of(Done)) == ([], [])
    stage.pass_time(20e-3)
    assert again.of(Done) == [Done(0, tx_ticks, late=False)]
    assert len(tag.of(Arrival)) == 1


async def test_the_end_of_a_dead_process_s_frame_is_not_sent_to_the_next_one():
    stage = Stage()
    sender, session = stage.join("anchor", "1")
    stage.send(sender, session, ahead_s=2e-3)
    stage.pass_time(2.02e-3)  # the RMARKER has left, the frame has not ended
    stage.ether.leave(session)
    again, session = stage.join("anchor", "1")
    tx_ticks = stage.send(again, session, ahead_s=5e-3)
    stage.pass_time(2e-3)
    assert again.of(Done) == []
    stage.pass_time(5e-3)
    assert again.of(Done) == [Done(0, tx_ticks, late=False)]


async def test_what_a_process_does_not_read_is_counted_and_costs_the_others_nothing():
    stage = Stage()
    sender, session = stage.join("anchor", "1")
    deaf, _ = stage.join("tag", "tag1")
    tag, _ = stage.join("tag", "tag2")
    deaf.deaf = True
    for _ in range(5):
        stage.send(sender, session)
        stage.pass_time(5e-3)
    assert (len(deaf.of(Arrival)), len(tag.of(Arrival))) == (0, 5)
    assert stage.ether.health(0.0).overruns == 5


async def test_an_ether_that_was_stopped_is_in_the_present_at_once_and_has_missed_what_should_have_been_sent():
    stage = Stage()
    sender, session = stage.join("anchor", "1")
    tag, _ = stage.join("tag", "tag1")
    stage.pass_time(1.0)
    before = stage.send(sender, session, ahead_s=2e-3)
    stage.pass_time(5e-3)
    missed = stage.send(sender, session, ahead_s=5e-3)
    stage.now_s += 2.0
    stage.ether.advance()
    health = stage.ether.health(0.0)
    assert health.stalls == 1
    assert health.simulated_s == pytest.approx(3.005, abs=1e-6)
    assert (health.transmissions, health.late, health.missed_share) == (1, 1, 0.5)
    assert sender.of(Done) == [Done(0, before, late=False), Done(0, missed, late=True)]
    stage.send(sender, session, ahead_s=2e-3)
    stage.pass_time(10e-3)
    assert len(tag.of(Arrival)) == 2
    health = stage.ether.health(0.0)
    assert (health.stalls, health.transmissions, health.missed_share) == (1, 2, 0.0)
    assert tag.of(Arrival)[-1].host_s == pytest.approx(stage.now_s, abs=10e-3)


async def test_the_counters_that_it_sends_are_those_of_its_radios(monkeypatch):
    """20 ppm of crystal either way, and the counter that a frame's stamp shows."""
    stage = Stage()
    sender, session = stage.join("anchor", "1", "2")
    stage.pass_time(1.0)
    clocks = Clocks(stage.ether.now_host_s, stage.ether._counters(session))
    joined = sender.of(Joined)[0]
    for node in (0, 1):
        passed_s = difference(clocks.ticks[node], joined.ticks[node]) * TICK_S
        assert passed_s == pytest.approx(1.0, abs=30e-6)
        assert passed_s != 1.0


async def test_the_truth_is_where_the_tags_are():
    stage = Stage()
    stage.join("tag", "tag1", "tag2")
    stage.pass_time(0.5)
    truth = stage.ether.truth(1e9)
    assert truth.unix_s == pytest.approx(1e9 + 100.5)
    assert truth.tags["tag1"].position_m == (2.0, 3.0, LAB.tags.height_m)
    assert truth.tags["tag2"].velocity_mps == (0.0, 0.0, 0.0)


async def test_receptions_have_phases_where_the_ether_simulates_carriers():
    """One frame at two nodes: phases as drivers give them, none without carriers, and the same stamps."""

    def rows(**faults):
        stage = Stage(**faults)
        sender, session = stage.join("anchor", "1")
        listener, _ = stage.join("tag", "tag1", "tag2")
        stage.send(sender, session)
        stage.pass_time(4e-3)
        return listener.of(Arrival)[0].rows

    plain, phased = rows(), rows(carrier=True)
    assert [row.carrier_phase_cycles for row in plain] == [None, None]
    assert len({row.carrier_phase_cycles for row in phased}) == 2
    assert all(0.0 <= row.carrier_phase_cycles < 1.0 for row in phased)
    assert all((row.carrier_phase_cycles * 65536).is_integer() for row in phased)
    assert [replace(row, carrier_phase_cycles=None) for row in phased] == list(plain)
