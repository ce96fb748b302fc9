import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.masterless_packets import Packet, Relay
from skyless.radio.foreign.bitcraze import decode_payload
from support.capture_makers import tdoa2, tdoa3

byte = st.integers(0, 255)
seven_bits = st.integers(0, 127)
stamp = st.integers(0, 2**32 - 1)
distance = st.integers(1, 2**16 - 1)
points = st.none() | st.tuples(*[st.floats(-1000, 1000, width=32)] * 3)


@given(seven_bits, stamp, st.lists(st.tuples(byte, seven_bits, stamp, st.none() | distance), max_size=20), points)
def test_tdoa3_survives_the_air(sequence, tx_ticks, relays, position_m):
    packet = decode_payload(tdoa3(sequence, tx_ticks, relays, position_m), 5.0, 9, 77)
    assert packet == Packet(5.0, 9, sequence, tx_ticks, 77, tuple(Relay(*relay) for relay in relays), position_m)


@given(st.integers(0, 7), st.lists(st.tuples(byte, stamp, distance), min_size=8, max_size=8), points)
def test_tdoa2_survives_the_air(sender, anchors, position_m):
    sequences, stamps, distances = zip(*anchors, strict=True)
    packet = decode_payload(tdoa2(sequences, stamps, distances, position_m), None, sender, 1)
    heard = [Relay(i, *anchors[i]) for i in range(8) if i != sender and stamps[i] != 0]
    assert packet == Packet(None, sender, sequences[sender], stamps[sender], 1, tuple(heard), position_m)


def test_tdoa2_payload_has_the_57_bytes_of_the_description_and_a_distance_of_0_is_none():
    payload = tdoa2([1] * 8, [5] * 8, [0] * 8)
    assert len(payload) == 57
    packet = decode_payload(payload, None, 3, 1)
    assert [relay.tof_ticks for relay in packet.relays] == [None] * 7


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "empty-payload"),
        (b"\x99\x01\x02", "foreign-payload"),
        (tdoa3(1, 2, [(1, 2, 3, 4)])[:-1], "short-payload"),
        (tdoa3(1, 2, [(1, 2, 3, None)])[:-1], "short-payload"),
        (tdoa2([0] * 8, [0] * 8, [0] * 8)[:-1], "short-payload"),
    ],
)
def test_bad_payloads_give_their_reason(payload, reason):
    assert decode_payload(payload, None, 1, 1) == reason


def test_tdoa2_of_a_sender_beyond_its_eight_seats_is_refused():
    assert decode_payload(tdoa2([0] * 8, [0] * 8, [0] * 8), None, 8, 1) == "sender-unknown"


@pytest.mark.parametrize("position_m", [(float("nan"), 0, 0), (0, float("inf"), 0), (0, 0, 3e30)])
def test_a_senseless_position_is_no_position(position_m):
    assert decode_payload(tdoa3(1, 2, [], position_m), None, 1, 1).position_m is None


@given(st.sampled_from([b"\x22", b"\x30", b""]), st.binary(max_size=120), byte)
def test_random_payloads_never_raise(kind, tail, sender):
    assert isinstance(decode_payload(kind + tail, None, sender, 1), Packet | str)
