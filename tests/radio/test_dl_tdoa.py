"""Rounds of DL-TDoA: messages become packets that relay when their senders received each other."""

from math import dist

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.air.masterless_packets import Packet, Relay
from skyless.core.ticks import TICK_M, TICK_RATE_HZ
from skyless.radio.foreign import uci

PLACES_M = {1: (0.0, 0.0, 2.0), 2: (6.0, 0.0, 2.0), 3: (6.0, 8.0, 2.0)}
POLL = uci.DtMessage(None, 1, uci.DtMessageType.POLL, 7, 0, 2**40 - 500, 1000, False)
RESPONSE = replace(
    POLL, address=2, kind=uci.DtMessageType.RESPONSE, tx_ticks=300, rx_ticks_tag=9000, responder_reply_ticks=1000
)
FINAL = replace(POLL, kind=uci.DtMessageType.FINAL, tx_ticks=2**39, rx_ticks_tag=20_000)


def test_a_response_relays_the_poll_and_the_final_message_the_responses():
    rounds = uci.DtRounds(uci.AnchorFrame())
    poll = rounds.on_message(POLL)
    assert poll == Packet(None, 1, poll.sequence, 2**40 - 500, 1000, ())
    one = rounds.on_message(replace(RESPONSE, flight_ticks=1280.0, initiator_reply_ticks=5000))
    assert one.relays == (Relay(1, poll.sequence, 2**40 - 700, 1280.0),)
    other = rounds.on_message(replace(RESPONSE, address=3))
    final = rounds.on_message(FINAL)
    assert final.relays == (Relay(2, one.sequence, 2**39 - 5000, 1280.0),)
    assert len({poll.sequence, final.sequence}) == 2
    assert other.sequence == one.sequence == poll.sequence


def test_a_response_that_is_reported_twice_is_relayed_once():
    rounds = uci.DtRounds(uci.AnchorFrame())
    for message in (POLL, *[replace(RESPONSE, initiator_reply_ticks=5000)] * 2):
        rounds.on_message(message)
    assert len(rounds.on_message(FINAL).relays) == 1


def test_a_final_message_without_responses_relays_nothing():
    rounds = uci.DtRounds(uci.AnchorFrame())
    rounds.on_message(POLL)
    assert rounds.on_message(FINAL).relays == ()


@pytest.mark.parametrize("states_positions", [True, False])
def test_in_the_common_time_the_poll_arrives_one_flight_after_it_left(states_positions):
    rounds = uci.DtRounds(uci.AnchorFrame(None if states_positions else PLACES_M))
    stated_m = PLACES_M if states_positions else dict.fromkeys(PLACES_M)
    rounds.on_message(replace(POLL, common_time=True, location=stated_m[1]))
    flight = dist(PLACES_M[1], PLACES_M[3]) / TICK_M
    packet = rounds.on_message(
        replace(RESPONSE, address=3, common_time=True, responder_reply_ticks=0, location=stated_m[3])
    )
    assert packet.relays == (Relay(1, packet.sequence, (2**40 - 500 + round(flight)) % 2**40, flight),)
    assert packet.position_m == stated_m[3]
    assert uci.DtRounds(uci.AnchorFrame()).on_message(replace(RESPONSE, common_time=True)) == "message-without-poll"


@pytest.mark.parametrize(
    ("messages", "reason"),
    [
        ([RESPONSE], "message-without-poll"),
        ([FINAL], "message-without-poll"),
        ([POLL, replace(RESPONSE, block=8)], "message-without-poll"),
        ([POLL, replace(RESPONSE, round=1)], "message-without-poll"),
        ([POLL, replace(RESPONSE, address=1)], "response-of-the-initiator"),
        ([POLL, replace(FINAL, address=2)], "final-of-another-anchor"),
        ([POLL, replace(RESPONSE, responder_reply_ticks=0)], "reply-time-unknown"),
        ([POLL, replace(RESPONSE, common_time=True)], "flight-unknown"),
    ],
)
def test_messages_of_no_use_have_a_reason(messages, reason):
    rounds = uci.DtRounds(uci.AnchorFrame())
    assert [rounds.on_message(message) for message in messages][-1] == reason


def test_addresses_that_change_for_ever_hide_no_newer_position():
    rounds = uci.DtRounds(uci.AnchorFrame())
    for address in range(3 * uci.MAX_ANCHORS_KEPT):
        rounds.on_message(replace(POLL, address=address, common_time=True, location=PLACES_M[1]))
    response = replace(RESPONSE, address=2**16, common_time=True, location=PLACES_M[2])
    assert isinstance(rounds.on_message(response), Packet)


@pytest.mark.parametrize(("stamp", "host_s"), [(2**40 - 1, None), (2**40, 2**40 / TICK_RATE_HZ)])
def test_a_counter_of_40_bits_given_in_64_is_no_host_s_time(stamp, host_s):
    assert uci.host_time_s(stamp) == pytest.approx(host_s)


stamps = st.integers(0, 2**40 - 1)
replies = st.integers(0, 2**32 - 1)
anything = st.builds(
    uci.DtMessage,
    st.none(),
    st.integers(0, 2**64 - 1),
    st.sampled_from(uci.DtMessageType),
    st.integers(0, 3),
    st.integers(0, 3) | st.integers(0, 2**64 - 1),
    stamps,
    stamps,
    st.booleans(),
    replies,
    replies,
    st.none() | st.floats(0, 65535),
    st.none() | st.tuples(*[st.floats(-1e6, 1e6)] * 3),
)


@pytest.mark.site
@given(st.lists(anything, max_size=40))
def test_any_messages_in_any_order(messages):
    rounds = uci.DtRounds(uci.AnchorFrame(PLACES_M))
    for message in messages:
        packet = rounds.on_message(message)
        if isinstance(packet, Packet):
            assert (packet.anchor, packet.rx_ticks) == (message.address, message.rx_ticks_tag)
            assert all(0 <= relay.rx_ticks < 2**40 for relay in packet.relays)
        else:
            assert message.kind is not uci.DtMessageType.POLL


def test_what_is_kept_of_rounds_is_bounded():
    rounds = uci.DtRounds(uci.AnchorFrame())
    for number in range(3 * uci.MAX_ROUNDS_AT_ONCE):
        rounds.on_message(replace(POLL, round=number))
    assert isinstance(rounds.on_message(replace(RESPONSE, round=3 * uci.MAX_ROUNDS_AT_ONCE - 1)), Packet)
    assert rounds.on_message(replace(RESPONSE, round=0)) == "message-without-poll"
