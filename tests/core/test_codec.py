"""Frames of protocol 2."""

import protocol1_strategies
import pytest
from beacon_strategies import FULL, beacons
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.air.almanac import LONGEST_PERIOD_CODE, SitePage
from skyless.core.air.beacon import (
    Authentication,
    Beacon,
    StatedPosition,
    decode,
    encode,
    heard_capacity,
    packed_relays,
    signed_bytes,
    with_authentication,
)
from skyless.core.air.frame import HEARD, Heard, Malformed, PackedHeard, air_time_s
from skyless.core.air.site_pages import encode_page
from skyless.core.any_receiver import decode_any
from skyless.core.protocol1 import beacon as protocol1_codec
from support.frames import changed, with_fcs

FLAGS_AT, PERIOD_AT = 11, 19


@pytest.mark.site
@given(beacons())
@settings(max_examples=300)
def test_round_trip_over_all_ranges(beacon):
    frame = encode(beacon)
    assert decode(frame) == beacon
    assert decode_any(frame) == beacon
    assert protocol1_codec.decode(frame) is Malformed.UNKNOWN_VERSION
    assert len(frame) <= 127 - (10 if beacon.authentication is None else 0)


@pytest.mark.parametrize(
    ("beacons", "encode", "decode"),
    [(beacons, encode, decode), (protocol1_strategies.beacons, protocol1_codec.encode, protocol1_codec.decode)],
    ids=["protocol 2", "protocol 1"],
)
@given(data=st.data())
@settings(max_examples=25, deadline=None)
def test_every_single_bit_flip_is_noticed(beacons, encode, decode, data):
    frame = encode(data.draw(beacons()))
    value = int.from_bytes(frame, "little")
    for bit in range(8 * len(frame)):
        assert decode((value ^ 1 << bit).to_bytes(len(frame), "little")) is Malformed.BAD_FCS


@given(beacons(), st.data())
@settings(max_examples=100, deadline=None)
def test_cut_frames_with_a_right_checksum_are_dropped(beacon, data):
    body = encode(beacon)[:-2]
    cut = data.draw(st.integers(0, len(body) - 1))
    assert isinstance(decode(with_fcs(body[:cut])), Malformed)


@pytest.mark.site
@given(st.binary(max_size=140))
@settings(max_examples=300)
def test_any_bytes_are_a_beacon_or_a_reason(data):
    assert isinstance(decode(data), Malformed)
    assert isinstance(decode(with_fcs(data)), Malformed | Beacon)


@pytest.mark.site
@given(beacons(), st.data())
@settings(max_examples=300)
def test_any_changed_byte_with_a_right_checksum_is_a_beacon_that_encodes_again_or_a_reason(beacon, data):
    frame = encode(beacon)
    at = data.draw(st.integers(0, len(frame) - 3))
    decoded = decode(changed(frame, at, data.draw(st.integers(0, 255))))
    if isinstance(decoded, Beacon):
        assert decode(encode(decoded)) == decoded


def test_length_and_air_time_of_the_document():
    bare = replace(FULL, position=None, heard=(), weak=0, page=None)
    assert len(encode(bare)) == 24
    usual = replace(bare, position=FULL.position, page=FULL.page)
    assert len(encode(usual)) == 24 + 12 + 17
    longest = replace(usual, heard=tuple(Heard(other, 0, 0) for other in range(8)))
    assert len(encode(longest)) == 117
    assert air_time_s(117) == pytest.approx(298.40e-6, abs=0.005e-6)


def test_capacity_leaves_space_for_authentication():
    parts = [(True, True), (False, True), (True, False), (False, False)]
    assert [heard_capacity(position=position, page=page) for position, page in parts] == [8, 9, 10, 11]


def test_authentication_follows_all_that_it_covers():
    frame = encode(FULL)
    signed = []
    authentic = with_authentication(frame, 0xABCD, lambda data: signed.append(data) or bytes(range(8)))
    body = bytearray(frame[:-2] + b"\xcd\xab")
    body[FLAGS_AT] |= 0x04
    assert signed == [bytes(body)] == [signed_bytes(authentic)]
    assert authentic == with_fcs(body + bytes(range(8)))
    decoded = decode(authentic)
    assert decoded.authentication == Authentication(0xABCD, bytes(range(8)))
    assert replace(decoded, authentication=None) == decode(frame)


def test_a_certificate_fills_a_frame():
    alone = replace(FULL, position=None, heard=(), weak=0, page=None, certificate=bytes(range(94)))
    frame = with_authentication(encode(alone), 1, lambda _: bytes(8))
    assert len(frame) == 126
    assert decode(frame).certificate == bytes(range(94))
    for part in ("position", "page"):
        with pytest.raises(ValueError, match="certificate has neither"):
            encode(replace(alone, **{part: getattr(FULL, part)}))
    with pytest.raises(ValueError, match="93 bytes; it must have 94"):
        encode(replace(alone, certificate=bytes(93)))


@pytest.mark.parametrize(
    ("authentication", "named"),
    [(Authentication(1 << 16, bytes(8)), "interval"), (Authentication(-1, bytes(8)), "interval"),
     (Authentication(0, bytes(7)), "mac has 7 bytes")],
)  # fmt: skip
def test_impossible_authentication_is_named(authentication, named):
    with pytest.raises(ValueError, match=named):
        encode(replace(FULL, heard=(), weak=0, authentication=authentication))


def test_pages_of_types_not_known_are_passed_over():
    assert decode(changed(encode(FULL), -17, 200)) == replace(decode(encode(FULL)), page=None)


@pytest.mark.parametrize(
    ("at", "value", "reason"),
    [
        *((FLAGS_AT, encode(FULL)[FLAGS_AT] | flag, Malformed.BAD_FLAGS) for flag in (0x10, 0x20, 0x80)),  # reserved
        *((FLAGS_AT, 0x08 | flag, Malformed.BAD_FLAGS) for flag in (0x01, 0x02, 0x40)),  # a certificate comes alone
        (PERIOD_AT, LONGEST_PERIOD_CODE + 1, Malformed.BAD_PERIOD),
        (-16, 0, Malformed.BAD_PAGE),  # a site of no pages
    ],
)
def test_one_impossible_byte_drops_the_frame(at, value, reason):
    assert decode(changed(encode(FULL), at, value)) is reason


@pytest.mark.site
@given(beacons(), st.data())
@settings(max_examples=200)
def test_phases_take_the_place_of_the_high_byte_of_stamps(beacon, data):
    """Anchors give whole stamps and any phase; frames are as long as without, and have it in the nearest step."""
    if beacon.certificate is not None:
        return
    cycles = [data.draw(st.none() | st.floats(0.0, 1.0, exclude_max=True)) for _ in beacon.heard]
    heard = [Heard(one.anchor, one.sequence, 0x5A << 32 | one.rx_ticks & 0xFFFFFFFF) for one in beacon.heard]
    without = replace(beacon, heard=tuple(heard), has_phases=False)
    given_heard = [replace(one, phase_cycles=phase) for one, phase in zip(heard, cycles, strict=True)]
    frame = encode(replace(without, heard=tuple(given_heard), has_phases=True))
    assert len(frame) == len(encode(without))
    for one, given_one in zip(decode(frame).heard, given_heard, strict=True):
        short = given_one.anchor, given_one.sequence, given_one.rx_ticks & 0xFFFFFFFF
        assert (one.anchor, one.sequence, one.rx_ticks) == short
        if given_one.phase_cycles is None:
            assert one.phase_cycles is None
        else:
            assert abs((one.phase_cycles - given_one.phase_cycles + 0.5) % 1.0 - 0.5) <= 1 / 256


@given(st.integers(0, (1 << 40) - 1), st.integers(-(1 << 31), (1 << 31) - 1))
def test_short_stamps_are_those_nearest_to_what_is_expected(rx_ticks, off_ticks):
    """Over all wraps of 32 and 40 bits, up to half a wrap of 67 ms away."""
    expected_ticks = rx_ticks - off_ticks
    assert Heard(1, 0, rx_ticks & 0xFFFFFFFF, is_short=True).rx_ticks_near(expected_ticks) == rx_ticks
    assert Heard(1, 0, rx_ticks).rx_ticks_near(expected_ticks) == rx_ticks


@pytest.mark.parametrize("others", [(3000,), (5, 5)])
def test_impossible_relays_drop_the_frame(others):
    sound = replace(FULL, heard=tuple(Heard(7 + k, 1, 2) for k in range(len(others))), weak=0, page=None)
    body = bytearray(encode(sound)[:-2])
    for number, other in enumerate(reversed(others)):
        at = len(body) - HEARD.size * (number + 1)
        body[at : at + 2] = other.to_bytes(2, "little")
    assert decode(with_fcs(body)) is Malformed.BAD_HEARD


def test_weak_flags_beyond_the_entries_drop_the_frame():
    sound = replace(FULL, page=None)
    body = bytearray(encode(sound)[:-2])
    at = len(body) - 4 * HEARD.size - 2
    body[at : at + 2] = (4 | 1 << 4 + 4).to_bytes(2, "little")
    assert decode(with_fcs(body)) is Malformed.BAD_HEARD


def test_relays_with_a_weak_first_path_are_left_out():
    decoded = decode(encode(FULL))
    kept = [FULL.heard[0], *FULL.heard[2:]]
    assert list(HEARD.iter_unpack(packed_relays(decoded))) == [
        (one.anchor, one.sequence, one.rx_ticks & 0xFFFFFFFF, one.rx_ticks >> 32) for one in kept
    ]


@pytest.mark.parametrize(("std_m", "stated_m"), [(0.0201, 0.021), (0.02, 0.02), (3.0, 0.255)])
def test_standard_deviations_are_rounded_up_and_saturate(std_m, stated_m):
    decoded = decode(encode(replace(FULL, position=StatedPosition(0, 0, 0, std_m))))
    assert decoded.position.std_m == stated_m


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"anchor": 1 << 16}, "anchor is 65536"),
        ({"tx_ticks": -1}, "tx_ticks is -1"),
        ({"almanac_issue": 1.5}, "almanac_issue is 1.5"),
        ({"period_code": LONGEST_PERIOD_CODE + 1}, "period_code is 160"),
        ({"position": StatedPosition(8389.0, 0.0, 0.0)}, r"position\.x_m is 8389"),
        ({"position": StatedPosition(float("nan"), 0.0, 0.0)}, r"position\.x_m is nan"),
        ({"position": StatedPosition(0.0, 0.0, 0.0, floor=128)}, r"position\.floor is 128"),
        ({"position": StatedPosition(0.0, 0.0, 0.0, std_m=-1.0)}, r"position\.std_m"),
        ({"heard": (Heard(3000, 0, 0),)}, "heard has the sender 3000"),
        ({"heard": (Heard(1, 0, 0), Heard(1, 0, 0))}, "an anchor twice"),
        ({"heard": (Heard(1, 0, 1 << 40),), "weak": 0}, r"heard\[0\]\.rx_ticks"),
        ({"heard": tuple(Heard(k, 0, 0) for k in range(9))}, "9 entries; 8 fit"),
        ({"heard": (Heard(1, 0, 0, 0.5),), "weak": 0}, "without phases"),
        ({"heard": (Heard(1, 0, 0, is_short=True),), "weak": 0}, "without phases"),
        ({"heard": (Heard(1, 0, 0, 1.0),), "weak": 0, "has_phases": True}, r"heard\[0\]\.phase_cycles is 1\.0"),
        ({"heard": (Heard(1, 0, 0, float("nan")),), "weak": 0, "has_phases": True}, "phase_cycles is nan"),
        ({"heard": PackedHeard(bytes(8)), "weak": 0, "has_phases": True}, "packed without phases"),
        ({"weak": 1 << 4}, "weak is 16"),
        ({"page": SitePage(0, None)}, r"SitePage\.pages"),
    ],
)
def test_what_does_not_fit_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        encode(replace(FULL, **change))


def test_a_site_page_has_its_17_bytes():
    assert encode_page(SitePage(4, 1.2)).hex() == "0604" + "00" * 6 + "01" + "b0040000" + "00" * 4
