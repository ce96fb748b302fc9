"""Check sequence and air time of frames of IEEE 802.15.4."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air import frame


def test_symbols_as_tabled_in_the_standard():
    # IEEE 802.15.4-2015, clause 16.2: mean PRF 62.4 MHz, in nanoseconds to two decimals.
    assert abs(frame.PREAMBLE_SYMBOL_S * 1e9 - 1017.63) < 0.005
    assert abs(frame.HEADER_SYMBOL_S * 1e9 - 1025.64) < 0.005
    assert abs(frame.DATA_SYMBOL_S * 1e9 - 128.21) < 0.005


@pytest.mark.parametrize(("psdu_bytes", "tabled_us"), [(12, 178), (24, 191), (40, 207), (64, 238), (127, 315)])
def test_air_time_of_tabled_lengths(psdu_bytes, tabled_us):
    assert frame.air_time_s(psdu_bytes) * 1e6 == pytest.approx(tabled_us, abs=0.5)


def test_preamble_lies_before_the_rmarker():
    assert frame.preamble_s() * 1e6 == pytest.approx(138.4, abs=0.05)
    assert frame.preamble_s(1024, 8) * 1e6 == pytest.approx(1032 * 1.01763, abs=0.05)
    assert frame.preamble_s(64) + frame.after_rmarker_s(40) == frame.air_time_s(40, preamble_symbols=64)


def test_parity_comes_by_blocks_of_330_bits():
    # 41 bytes are 328 bits and fill one block, 42 bytes need another 48 bits of parity.
    step_s = frame.after_rmarker_s(42) - frame.after_rmarker_s(41)
    assert step_s == pytest.approx((8 + 48) * 64 / 499.2e6)
    assert frame.after_rmarker_s(41) - frame.after_rmarker_s(40) == pytest.approx(8 * 64 / 499.2e6)


def test_check_value_of_the_catalogue():
    # CRC-16/KERMIT in the catalogue of parametrised CRC algorithms: check 0x2189, sent low byte first.
    assert frame.fcs(b"123456789") == bytes.fromhex("8921")


@given(st.binary(max_size=125))
def test_bit_by_bit_division_agrees(data):
    register = 0
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0x8408 if register & 1 else 0)
    assert frame.fcs(data) == register.to_bytes(2, "little")


@given(st.binary(min_size=1, max_size=125), st.data())
def test_every_burst_of_up_to_16_bits_is_noticed(data, draw):
    sent = bytearray(data + frame.fcs(data))
    burst = draw.draw(st.integers(1, 0xFFFF))
    start = draw.draw(st.integers(0, 8 * len(sent) - burst.bit_length()))
    damaged = int.from_bytes(sent, "little") ^ burst << start
    assert not frame.is_intact(damaged.to_bytes(len(sent), "little"))


@pytest.mark.parametrize("length", [0, 1, 2])
def test_short_bytes_are_no_trouble(length):
    assert frame.is_intact(bytes(length))
    assert not frame.is_intact(b"\x01" * length) or length == 0
