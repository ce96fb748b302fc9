"""Frames of protocol 1, and frames of other systems on the channel, built from what is published of their formats."""

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from protocol1_strategies import FULL, beacons

from skyless.core.air.almanac import AnchorPage, NoisePage
from skyless.core.air.frame import Heard, Malformed
from skyless.core.protocol1.beacon import Beacon, MasterTime, decode, decode_cached, encode, heard_capacity
from support.capture_makers import tdoa2, tdoa3
from support.frames import changed, with_fcs

pytestmark = pytest.mark.site

BARE = replace(FULL, master_heard=None, master_time=None, heard=(), page=None)
PAYLOAD_AT, VERSION_AT, FLAGS_AT, COUNT_AT = 9, 10, 11, 40


@given(beacons())
@settings(max_examples=500)
@pytest.mark.statistical
def test_round_trip_over_all_ranges(beacon):
    frame = encode(beacon)
    assert decode(frame) == beacon
    assert decode_cached(frame) == beacon
    assert len(frame) <= 127 - 16


@given(beacons(), st.data())
@settings(max_examples=300)
@pytest.mark.statistical
def test_any_changed_bytes_with_a_good_fcs_are_a_beacon_that_encodes_again_or_a_reason(beacon, data):
    body = bytearray(encode(beacon)[:-2])
    at = data.draw(st.integers(0, len(body)))
    body[at : at + data.draw(st.integers(0, 8))] = data.draw(st.binary(max_size=8))
    decoded = decode(with_fcs(body))
    if isinstance(decoded, Malformed):
        return
    parts = (decoded.master_heard is not None, decoded.master_time is not None, decoded.page is not None)
    if len(decoded.heard) <= heard_capacity(*parts):
        assert decode(encode(decoded)) == decoded


@given(st.binary(max_size=140))
def test_any_bytes_are_a_beacon_or_a_reason(data):
    assert isinstance(decode(data), Malformed)
    assert isinstance(decode(with_fcs(data)), Malformed | Beacon)


def test_truncated_frames_with_a_good_fcs_are_dropped_by_reason():
    body = encode(FULL)[:-2]
    reasons = [decode(with_fcs(body[:length])) for length in range(len(body))]
    assert reasons[:3] == [Malformed.TOO_SHORT] * 3
    assert reasons[3:11] == [Malformed.NOT_A_BEACON] * 8
    assert reasons[11:27] == [Malformed.TOO_SHORT] * 16
    assert reasons[27:] == [Malformed.BAD_LENGTH] * (len(body) - 27)


def test_surplus_bytes_are_dropped():
    body = encode(FULL)[:-2]
    assert decode(with_fcs(body + bytes(1))) is Malformed.BAD_LENGTH
    assert decode(with_fcs(body + bytes(8))) is Malformed.BAD_LENGTH
    assert decode(with_fcs(body + bytes(40))) is Malformed.TOO_LONG


def test_version_flags_and_foreign_headers():
    frame = encode(FULL)
    assert decode(changed(frame, VERSION_AT, 0xB2)) is Malformed.UNKNOWN_VERSION
    assert decode(changed(frame, VERSION_AT, 0xA1)) is Malformed.NOT_A_BEACON
    assert decode(changed(frame, PAYLOAD_AT, 0x30)) is Malformed.NOT_A_BEACON
    assert decode(changed(frame, 5, 0x07)) is Malformed.NOT_A_BEACON
    assert decode(changed(frame, 0, 0x61)) is Malformed.NOT_A_BEACON
    for flag in (0x10, 0x20, 0x40, 0x80):
        assert decode(changed(frame, FLAGS_AT, frame[FLAGS_AT] | flag)) is Malformed.BAD_FLAGS
    assert decode(changed(frame, COUNT_AT, 3)) is Malformed.BAD_LENGTH


@given(beacons(), st.binary(min_size=16, max_size=16))
def test_authentication_trailer_is_skipped(beacon, trailer):
    body = bytearray(encode(beacon)[:-2]) + trailer
    body[FLAGS_AT] |= 0x08
    assert decode(with_fcs(body)) == beacon


def test_unknown_page_type_leaves_the_rest_usable():
    frame = encode(FULL)
    page_at = len(frame) - 2 - 17
    assert decode(changed(frame, page_at, 200)) == replace(FULL, page=None)


@pytest.mark.parametrize("other", [FULL.anchor, FULL.master, FULL.heard[1].anchor])
def test_impossible_stamps_are_refused_and_dropped(other):
    heard = (Heard(other, 1, 2), *FULL.heard[1:])
    with pytest.raises(ValueError, match=f"heard.*anchor {other}"):
        encode(replace(FULL, heard=heard))
    assert decode(changed(encode(FULL), COUNT_AT + 1, other)) is Malformed.BAD_HEARD


def test_master_does_not_hear_itself():
    master = replace(FULL, anchor=FULL.master)
    with pytest.raises(ValueError, match="master_heard"):
        encode(master)
    assert decode(changed(encode(FULL), 7, FULL.master)) is Malformed.BAD_HEARD
    wrong = replace(FULL, master_heard=Heard(9, 1, 2))
    with pytest.raises(ValueError, match="master_heard is of anchor 9"):
        encode(wrong)


@pytest.mark.parametrize("parts", [(h, t, p) for h in (False, True) for t in (False, True) for p in (False, True)])
def test_capacity_keeps_room_for_authentication(parts):
    without = {name: None for name, has in zip(("master_heard", "master_time", "page"), parts, strict=True) if not has}
    entries = tuple(Heard(100 + number, number, number) for number in range(20))
    fit = heard_capacity(*parts)

    def beacon(count):
        return replace(FULL, **without, heard=entries[:count])

    room = 127 - 16 - len(encode(beacon(fit)))
    assert 0 <= room < 8
    with pytest.raises(ValueError, match=rf"heard has {fit + 1} entries; {fit} fit"):
        encode(beacon(fit + 1))


@pytest.mark.parametrize(
    ("field", "bits"),
    [(name, 8) for name in ("sequence", "slot", "almanac_issue")]
    + [(name, 16) for name in ("site", "anchor", "master")]
    + [("superframe", 32), ("tx_ticks", 40)],
)
@pytest.mark.parametrize("wrong", ["below", "above", 1.5, None])
def test_errors_name_the_field(field, bits, wrong):
    value = {"below": -1, "above": 1 << bits}.get(wrong, wrong)
    with pytest.raises(ValueError, match=rf"^{field} is {value}; .* {bits} bits"):
        encode(replace(BARE, **{field: value}))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"heard": (Heard(9, 256, 0),)}, r"heard\[0\].sequence is 256"),
        ({"heard": (Heard(9, 0, 0), Heard(8, 0, 1 << 40))}, r"heard\[1\].rx_ticks is 1099511627776"),
        ({"heard": (Heard(65536, 0, 0),)}, r"heard\[0\].anchor is 65536"),
        ({"master_heard": Heard(1, 0, -1)}, "master_heard.rx_ticks is -1"),
        ({"master_time": MasterTime(1 << 48, 0.0)}, "master_time.tx_subticks_master is 281474976710656"),
        ({"master_time": MasterTime(0, -0.1)}, "master_time.std_ticks is -0.1"),
        ({"master_time": MasterTime(0, math.nan)}, "master_time.std_ticks is nan"),
        ({"page": AnchorPage(1, math.inf, 0.0, 0.0, 0)}, "AnchorPage.x_m is inf"),
        ({"page": NoisePage(1e-10, 1e-10, math.nan, 1e-9)}, "NoisePage.white_fm is nan"),
    ],
)
def test_errors_name_the_field_of_a_part(changes, named):
    with pytest.raises(ValueError, match=named):
        encode(replace(BARE, **changes))


@given(st.floats(0.0, allow_nan=False))
def test_standard_deviation_is_rounded_up_and_saturates(std_ticks):
    decoded = decode(encode(replace(BARE, master_time=MasterTime(5, std_ticks))))
    assert isinstance(decoded, Beacon)
    sent = decoded.master_time.std_ticks
    if std_ticks > 65535 / 64:
        assert sent == 65535 / 64
    else:
        assert 0.0 <= sent - std_ticks <= 1 / 64


LONG_ADDRESSES = 0xDC41
SHORT_ADDRESSES = 0x8841


def bitcraze_mac(sender, payload):
    """Header of 21 bytes with 64-bit addresses, sent to everyone."""
    address = bytes((sender, 0, 0, 0, 0, 0, 0xCF, 0xBC))
    return struct.pack("<HBH", LONG_ADDRESSES, 7, 0xBCCF) + bytes((0xFF, *address[1:])) + address + payload


def short_mac(sender, payload):
    """The header that a beacon has, in front of somebody else's payload."""
    return struct.pack("<HBHHH", SHORT_ADDRESSES, 7, 0xBCCF, 0xFFFF, sender) + payload


PLACE_M = (1.0, 2.0, 3.0)
TOLD = range(8), range(3, 8000, 1000), [33_000] * 8
RELAYS = [(other, other, 99 * other, 32_900) for other in range(6)]
PAYLOADS = {
    "TDoA2": tdoa2(*TOLD),
    "TDoA2 with position": tdoa2(*TOLD, PLACE_M),
    "TDoA3": tdoa3(42, 0xDEADBEEF, RELAYS),
    "TDoA3 alone": tdoa3(42, 0xDEADBEEF, []),
    "TDoA3 with position": tdoa3(42, 0xDEADBEEF, RELAYS, PLACE_M),
}


@pytest.mark.parametrize("payload", PAYLOADS.values(), ids=PAYLOADS)
@pytest.mark.parametrize("mac", [bitcraze_mac, short_mac])
def test_bitcraze_frames_are_not_beacons(mac, payload):
    frame = mac(3, payload)
    assert decode(with_fcs(frame)) is Malformed.NOT_A_BEACON


def test_short_frames_of_the_standard_are_not_beacons():
    acknowledgment = b"\x02\x00\x6a"
    blink = b"\xc5\x07" + bytes(range(8))
    for frame in (acknowledgment, blink):
        assert decode(with_fcs(frame)) is Malformed.NOT_A_BEACON


@pytest.mark.parametrize("length", range(5, 128))
def test_a_silent_channel_read_as_zeros_is_not_a_beacon(length):
    # The CRC of zeros is zero: such bytes pass the FCS.
    assert decode(bytes(length)) is Malformed.NOT_A_BEACON
