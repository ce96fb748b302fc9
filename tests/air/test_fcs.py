import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.ieee802154 import fcs, is_intact


def test_check_value_of_the_catalogue():
    # CRC-16/KERMIT in the catalogue of parametrised CRC algorithms: check 0x2189, sent low byte first.
    assert fcs(b"123456789") == bytes.fromhex("8921")


def test_example_of_the_standard():
    # IEEE 802.15.4, clause 7.2.10: an acknowledgment whose bits b0 first are 0100000000000000 01010110
    # has the FCS 0010011110011110.
    def bits(text):
        return bytes(int(text[at : at + 8][::-1], 2) for at in range(0, len(text), 8))

    acknowledgment = bits("010000000000000001010110")
    assert fcs(acknowledgment) == bits("0010011110011110")
    assert is_intact(acknowledgment + fcs(acknowledgment))


@given(st.binary(max_size=125))
def test_bit_by_bit_division_agrees(data):
    register = 0
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0x8408 if register & 1 else 0)
    assert fcs(data) == register.to_bytes(2, "little")


@given(st.binary(min_size=1, max_size=125), st.data())
def test_every_burst_of_up_to_16_bits_is_noticed(data, draw):
    frame = bytearray(data + fcs(data))
    burst = draw.draw(st.integers(1, 0xFFFF))
    start = draw.draw(st.integers(0, 8 * len(frame) - burst.bit_length()))
    damaged = int.from_bytes(frame, "little") ^ burst << start
    assert not is_intact(damaged.to_bytes(len(frame), "little"))


@pytest.mark.parametrize("length", [0, 1, 2])
def test_short_bytes_are_no_trouble(length):
    assert is_intact(bytes(length))
    assert not is_intact(b"\x01" * length) or length == 0
