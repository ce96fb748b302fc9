import msgspec
import pytest
from beacon2_strategies import FULL_2, beacons2
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.air.almanac import SitePage
from skyless.air.beacon import HEARD, Heard, Malformed
from skyless.air.beacon2 import Authentication, Beacon2, SlotTime, StatedPosition, StatedSiteTime
from skyless.air.codec import decode
from skyless.air.codec2 import (
    authenticate_2,
    decode_2,
    encode_2,
    heard_capacity_2,
    packed_relays_2,
    pulse_age,
    signed_bytes_2,
)
from skyless.air.frames import decode_any
from skyless.air.ieee802154 import air_time_s, fcs
from skyless.air.page_codec import encode_page

FLAGS_AT, VERSION_AT = 11, 10


def with_fcs(body):
    return bytes(body) + fcs(bytes(body))


def changed(frame, at, value):
    body = bytearray(frame[:-2])
    body[at] = value
    return with_fcs(body)


@given(beacons2())
@settings(max_examples=300)
def test_round_trip_over_all_ranges(beacon):
    frame = encode_2(beacon)
    assert decode_2(frame) == beacon
    assert decode_any(frame) == beacon
    assert decode(frame) is Malformed.UNKNOWN_VERSION
    assert len(frame) <= 127 - (10 if beacon.authentication is None else 0)


@given(beacons2())
@settings(max_examples=25, deadline=None)
def test_every_single_bit_flip_is_noticed(beacon):
    frame = encode_2(beacon)
    value = int.from_bytes(frame, "little")
    for bit in range(8 * len(frame)):
        assert decode_2((value ^ 1 << bit).to_bytes(len(frame), "little")) is Malformed.BAD_FCS


@given(beacons2(), st.data())
@settings(max_examples=100, deadline=None)
def test_cut_frames_with_a_right_checksum_are_dropped(beacon, data):
    body = encode_2(beacon)[:-2]
    cut = data.draw(st.integers(0, len(body) - 1))
    assert isinstance(decode_2(with_fcs(body[:cut])), Malformed)


@given(st.binary(max_size=140))
@settings(max_examples=300)
def test_any_bytes_are_a_beacon_or_a_reason(data):
    assert isinstance(decode_2(data), Malformed)
    assert isinstance(decode_2(with_fcs(data)), Malformed | Beacon2)


@given(beacons2(), st.data())
@settings(max_examples=300)
def test_any_changed_byte_with_a_right_checksum_is_a_beacon_that_encodes_again_or_a_reason(beacon, data):
    frame = encode_2(beacon)
    at = data.draw(st.integers(0, len(frame) - 3))
    decoded = decode_2(changed(frame, at, data.draw(st.integers(0, 255))))
    if isinstance(decoded, Beacon2):
        assert decode_2(encode_2(decoded)) == decoded


def test_length_and_air_time_of_the_document():
    bare = msgspec.structs.replace(FULL_2, slot_time=None, position=None, site_time=None, heard=(), weak=0, page=None)
    assert len(encode_2(bare)) == 23
    free = msgspec.structs.replace(bare, position=FULL_2.position, page=FULL_2.page)
    assert len(encode_2(free)) == 23 + 12 + 17
    assert len(encode_2(msgspec.structs.replace(free, slot_time=FULL_2.slot_time))) == 52 + 16
    longest = msgspec.structs.replace(
        free, slot_time=FULL_2.slot_time, heard=tuple(Heard(other, 0, 0) for other in range(6))
    )
    assert len(encode_2(longest)) == 116
    assert air_time_s(116) == pytest.approx(297.37e-6, abs=0.005e-6)


@pytest.mark.parametrize(
    ("slot_time", "position", "site_time", "page", "entries"),
    [
        (True, True, False, True, 6),
        (True, True, True, True, 5),
        (False, True, False, True, 8),
        (True, False, False, True, 7),
        (False, False, False, False, 11),
    ],
)
def test_capacity_leaves_space_for_authentication(slot_time, position, site_time, page, entries):
    assert heard_capacity_2(slot_time=slot_time, position=position, site_time=site_time, page=page) == entries


def test_authentication_follows_all_that_it_covers():
    frame = encode_2(FULL_2)
    signed = []
    authentic = authenticate_2(frame, 0xABCD, lambda data: signed.append(data) or bytes(range(8)))
    body = bytearray(frame[:-2] + b"\xcd\xab")
    body[FLAGS_AT] |= 0x10
    assert signed == [bytes(body)] == [signed_bytes_2(authentic)]
    assert authentic == with_fcs(body + bytes(range(8)))
    decoded = decode_2(authentic)
    assert decoded.authentication == Authentication(0xABCD, bytes(range(8)))
    assert replace(decoded, authentication=None) == decode_2(frame)


def test_a_certificate_fills_a_frame():
    alone = replace(
        FULL_2, slot_time=None, position=None, site_time=None, heard=(), weak=0, page=None, certificate=bytes(range(94))
    )
    frame = authenticate_2(encode_2(alone), 1, lambda _: bytes(8))
    assert len(frame) == 127
    assert decode_2(frame).certificate == bytes(range(94))
    for part in ("slot_time", "position", "page"):
        with pytest.raises(ValueError, match="certificate has no"):
            encode_2(replace(alone, **{part: getattr(FULL_2, part)}))
    with pytest.raises(ValueError, match="93 bytes; it must have 94"):
        encode_2(replace(alone, certificate=bytes(93)))


@pytest.mark.parametrize("flag", [0x01, 0x02, 0x04, 0x08])
def test_a_certificate_comes_alone(flag):
    body = bytearray(encode_2(FULL_2)[:-2])
    body[FLAGS_AT] = 0x20 | flag
    assert decode_2(with_fcs(body)) is Malformed.BAD_FLAGS


@pytest.mark.parametrize(
    ("authentication", "named"),
    [(Authentication(1 << 16, bytes(8)), "interval"), (Authentication(-1, bytes(8)), "interval"),
     (Authentication(0, bytes(7)), "mac has 7 bytes")],
)  # fmt: skip
def test_impossible_authentication_is_named(authentication, named):
    with pytest.raises(ValueError, match=named):
        encode_2(replace(FULL_2, heard=(), weak=0, authentication=authentication))


def test_pages_of_types_not_known_are_passed_over():
    frame = encode_2(FULL_2)
    body = bytearray(frame[:-2])
    body[-17] = 200
    decoded = decode_2(with_fcs(body))
    assert isinstance(decoded, Beacon2)
    assert decoded.page is None


def test_an_impossible_page_drops_the_frame():
    frame = encode_2(FULL_2)
    body = bytearray(frame[:-2])
    body[-16] = 0  # no pages
    assert decode_2(with_fcs(body)) is Malformed.BAD_PAGE


@pytest.mark.parametrize("flag", [0x20, 0x40, 0x80])
def test_reserved_flags_drop_the_frame(flag):
    frame = encode_2(FULL_2)
    assert decode_2(changed(frame, FLAGS_AT, frame[FLAGS_AT] | flag)) is Malformed.BAD_FLAGS


def test_site_time_without_slot_time_drops_the_frame():
    frame = encode_2(FULL_2)
    assert decode_2(changed(frame, FLAGS_AT, frame[FLAGS_AT] & ~0x01)) is Malformed.BAD_FLAGS


@pytest.mark.parametrize("others", [(3000,), (5, 5)])
def test_impossible_relays_drop_the_frame(others):
    sound = msgspec.structs.replace(
        FULL_2, heard=tuple(Heard(7 + k, 1, 2) for k in range(len(others))), weak=0, page=None
    )
    body = bytearray(encode_2(sound)[:-2])
    for number, other in enumerate(reversed(others)):
        at = len(body) - HEARD.size * (number + 1)
        body[at : at + 2] = other.to_bytes(2, "little")
    assert decode_2(with_fcs(body)) is Malformed.BAD_HEARD


def test_weak_flags_beyond_the_entries_drop_the_frame():
    sound = msgspec.structs.replace(FULL_2, page=None)
    body = bytearray(encode_2(sound)[:-2])
    at = len(body) - 4 * HEARD.size - 2
    body[at : at + 2] = (4 | 1 << 4 + 4).to_bytes(2, "little")
    assert decode_2(with_fcs(body)) is Malformed.BAD_HEARD


def test_relays_with_a_weak_first_path_are_left_out():
    decoded = decode_2(encode_2(FULL_2))
    kept = [FULL_2.heard[0], *FULL_2.heard[2:]]
    assert list(HEARD.iter_unpack(packed_relays_2(decoded))) == [
        (one.anchor, one.sequence, one.rx_ticks & 0xFFFFFFFF, one.rx_ticks >> 32) for one in kept
    ]


def test_standard_deviations_are_rounded_up_and_saturate():
    def decoded(std_m, std_ticks):
        return decode_2(
            encode_2(
                msgspec.structs.replace(
                    FULL_2, position=StatedPosition(0, 0, 0, std_m), site_time=StatedSiteTime(0.0, std_ticks)
                )
            )
        )

    assert decoded(0.0201, 0.001).position.std_m == 0.021
    assert decoded(0.02, 0.001).position.std_m == 0.02
    assert decoded(3.0, 5000.0).position.std_m == 0.255
    assert decoded(0.0, 0.001).site_time.std_ticks == 1 / 64
    assert decoded(0.0, 5000.0).site_time.std_ticks == 0xFFFF / 64


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"anchor": 1 << 16}, "anchor is 65536"),
        ({"tx_ticks": -1}, "tx_ticks is -1"),
        ({"almanac_issue": 1.5}, "almanac_issue is 1.5"),
        ({"slot_time": SlotTime(1 << 32, 0, 0, 0, 0, 0, 0.0)}, r"slot_time\.superframe"),
        ({"slot_time": SlotTime(0, 0, 0, 0, 0, 0, 2e-4)}, r"slot_time\.rate is 0\.0002"),
        ({"slot_time": None}, "site_time needs slot_time"),
        ({"position": StatedPosition(8389.0, 0.0, 0.0)}, r"position\.x_m is 8389"),
        ({"position": StatedPosition(float("nan"), 0.0, 0.0)}, r"position\.x_m is nan"),
        ({"position": StatedPosition(0.0, 0.0, 0.0, floor=128)}, r"position\.floor is 128"),
        ({"position": StatedPosition(0.0, 0.0, 0.0, std_m=-1.0)}, r"position\.std_m"),
        ({"site_time": StatedSiteTime(40_000.0, 0.0)}, r"site_time\.residual_ticks"),
        ({"heard": (Heard(3000, 0, 0),)}, "heard has the sender 3000"),
        ({"heard": (Heard(1, 0, 0), Heard(1, 0, 0))}, "an anchor twice"),
        ({"heard": (Heard(1, 0, 1 << 40),), "weak": 0}, r"heard\[0\]\.rx_ticks"),
        ({"heard": tuple(Heard(k, 0, 0) for k in range(6))}, "6 entries; 5 fit"),
        ({"weak": 1 << 4}, "weak is 16"),
        ({"page": SitePage(0, 1, 0, None)}, r"SitePage\.pages"),
        ({"page": SitePage(1, 0, 5, None)}, r"SitePage\.superframe_ticks"),
    ],
)
def test_what_does_not_fit_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        encode_2(msgspec.structs.replace(FULL_2, **change))


def test_a_site_page_has_its_17_bytes():
    assert (
        encode_page(SitePage(4, 0x0501020304, 38, 1.2)).hex() == "0604" + "0403020105" + "2601" + "b0040000" + "00" * 4
    )


def test_age_of_a_pulse_saturates():
    assert [pulse_age(10, pulse) for pulse in (10, 7, 12, -1000)] == [0, 3, 0, 255]
