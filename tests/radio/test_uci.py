"""UCI: packets of streams, DL-TDoA measurements of both versions, and locations.

Published bytes are those of AOSP's own tests (Apache-2.0): ``external/uwb`` src/rust/uwb_uci_packets/src/lib.rs and
uci_packets.pdl, and ``UwbAnchorLocationTest``. SKYLESS_FUZZ_FRAMES sets how many random inputs the decoders get.
"""

import os
import random
from collections import Counter
from math import isfinite
from struct import Struct, error

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.radio.foreign import uci

pytestmark = pytest.mark.site

INPUTS = int(os.environ.get("SKYLESS_FUZZ_FRAMES", "20000"))
AOSP_1 = bytes.fromhex(
    "0a01330553050205 07090a0102050709 0a01020507090a01 0205070905070 90a 0102050709050709 0a01020507090709 05070"
    "90a01020507 090a010205070905".replace(" ", "")
    + "0a01330533050205 07090a0102050709 0a01020507090a01 0205070905070 90a 0102050709050709 0a01020507090709 05070"
    "90a01020102 05070 90a010205070905".replace(" ", "")
)
AOSP_2 = bytes.fromhex(
    "3a000a010005020507090a010205 07090a01020507090507090a0102050709050102030405 0e000000 080102030405060708 021122"
    "03aabbcc 55 31000b020105060308010b02030608 0a0b030208060a08060a0603020b0a0804020304 05 02000000"
    "06020304050607 0133"
)
AOSP_2_SHORT = bytes.fromhex(
    "26000b020005010406080b020306080a0b020306080a06080a0b020306080a04020304050800000000 77".replace(" ", "")
)
HEAD = Struct("<IIBIBBB8xB")


def notification(kind, count, measurements, wide=0):
    return uci.UciPacket(uci.UciType.NOTIFICATION, 2, 0, HEAD.pack(1, 2, 0, 200, kind, 0, wide, count) + measurements)


def test_published_measurements_of_version_1():
    info = uci.decode_session_info(notification(2, 2, AOSP_1))
    assert (info.version, info.sequence, info.session) == (1, 1, 2)
    for one, location in zip(info.measurements, ("07090709050709 0a0102", "070907090507090a01020102"), strict=True):
        assert (one.address, one.status, one.message, one.block, one.round) == (0x010A, 0x33, 5, 0x0502, 7)
        assert (one.tx_ticks, one.tx_bytes) == (0x02010A0907050201, 8)
        assert (one.rx_ticks_tag, one.rx_bytes) == (0x0705090705, 5)
        assert (one.initiator_reply_ticks, one.responder_reply_ticks) == (0x05090705, 0x010A0907)
        assert one.flight_ticks == 0x0502
        assert one.common_time
        assert one.location == bytes.fromhex(location)
    assert [one.location_kind for one in info.measurements] == [uci.RELATIVE_LOCATION, uci.WGS84_LOCATION]


@pytest.mark.parametrize("kind", [2, 6])
def test_published_measurements_of_version_2(kind):
    info = uci.decode_session_info(notification(kind, 2, AOSP_2))
    one, two = info.measurements
    assert info.version == 2
    assert (one.address, one.status, one.message, one.block, one.round) == (0x010A, 0, 5, 0x0502, 7)
    assert (one.rx_ticks_tag, one.tx_ticks, one.location) == (0x0504030201, 0x0807060504030201, b"\xaa\xbb\xcc")
    assert uci.location_of(one) is None
    assert (two.address, two.status, two.block, two.round) == (0x020B, 1, 0x0306, 8)
    assert (two.rx_ticks_tag, two.rx_bytes, two.tx_ticks, two.tx_bytes) == (0x05040302, 4, 0x070605040302, 6)
    assert two.location == b""
    (short,) = uci.decode_session_info(notification(kind, 1, AOSP_2_SHORT)).measurements
    assert (short.rx_ticks_tag, short.tx_bytes, short.location) == (0x05040302, 0, b"")


@pytest.mark.parametrize("wide", [False, True])
def test_published_notifications_without_measurements(wide):
    body = bytes.fromhex("62000019 00020304 05060708 00 00000000 02 00") + bytes((wide, *bytes(9)))
    (packet,) = uci.UciReader(Counter()).feed(body)
    info = uci.decode_session_info(packet)
    assert info == uci.SessionInfo(0x04030200, 0x08070605, 1, (), wide)
    assert uci.encode_packet(uci.encode_session_info(info)) == body


@pytest.mark.parametrize(
    ("data", "position_m"),
    [
        ("6ce4fff4600000b6feff", (-7.06, 0.07, -0.33)),
        ("c2fcfff921300066feff", (-0.83, 5.01, -0.41)),
        ("00000008813000000000", (0.0, 5.0, 0.0)),
    ],
)
def test_published_relative_locations(data, position_m):
    assert uci.decode_relative(bytes.fromhex(data)) == position_m
    assert uci.encode_relative(position_m).hex() == data


@pytest.mark.parametrize(
    ("data", "height_m"), [("b1b4d2322ee175861f4fc0c0", 101.5), ("22b5d2325d6275863c9040c0", 101.8)]
)
def test_published_locations_on_the_earth(data, height_m):
    point = uci.decode_wgs84(bytes.fromhex(data))
    assert (point.latitude_deg, point.longitude_deg) == pytest.approx((50.8231, 12.9209), abs=1e-4)
    assert point.height_m == pytest.approx(height_m, abs=0.1)
    assert uci.encode_wgs84(point).hex() == data


def whole(bits):
    return st.integers(0, (1 << bits) - 1)


FIELDS = {
    **{name: whole(8) for name in ("message", "round", "status")},
    **{name: whole(32) for name in ("initiator_reply_ticks", "responder_reply_ticks")},
    "block": whole(16),
    "flight_ticks": whole(16),
    "common_time": st.booleans(),
}


@st.composite
def measurements(draw, version, wide):
    widths = st.sampled_from((5, 8)) if version == 1 else st.integers(0, 8)
    tx_bytes, rx_bytes = draw(widths), draw(widths)
    if version == 1:
        kind = draw(st.sampled_from((uci.NO_LOCATION, uci.WGS84_LOCATION, uci.RELATIVE_LOCATION)))
        size = uci.LOCATION_BYTES[kind]
        location = draw(st.binary(min_size=size, max_size=size))
    else:
        kind, location = uci.NO_LOCATION, draw(st.binary(max_size=30))
    return uci.DtMeasurement(
        address=draw(whole(64 if wide else 16)),
        tx_ticks=draw(whole(8 * tx_bytes)),
        rx_ticks_tag=draw(whole(8 * rx_bytes)),
        tx_bytes=tx_bytes,
        rx_bytes=rx_bytes,
        location_kind=kind,
        location=location,
        **{name: draw(strategy) for name, strategy in FIELDS.items()},
    )


@st.composite
def notifications(draw):
    version, wide = draw(st.sampled_from((1, 2))), draw(st.booleans())
    found = draw(st.lists(measurements(version, wide), max_size=8))
    if not found:
        version = 1  # which no byte shows without a measurement
    return uci.SessionInfo(draw(whole(32)), draw(whole(32)), version, tuple(found), wide)


@given(notifications(), st.lists(st.integers(1, 300), max_size=20))
def test_notifications_survive_the_line_in_segments_and_pieces(info, sizes):
    packet, drops = uci.encode_session_info(info), Counter()
    reader, stream, found = uci.UciReader(drops), uci.encode_packet(packet) * 2, []
    assert len(stream) == 2 * (len(packet.payload) + 4 * max(1, -(-len(packet.payload) // 255)))
    for size in (*sizes, len(stream)):
        found += reader.feed(stream[:size])
        stream = stream[size:]
    assert found == [packet, packet]
    assert not drops
    assert uci.decode_session_info(packet) == info


@given(st.tuples(*[st.integers(-(2**27), 2**27 - 1)] * 2, st.integers(-(2**23), 2**23 - 1)))
def test_relative_locations_survive_the_line(millimetres):
    position_m = tuple(value / 1000.0 for value in millimetres)
    assert uci.decode_relative(uci.encode_relative(position_m)) == position_m


@given(st.floats(-90, 90), st.floats(-180, 180), st.floats(-1000, 200_000))
def test_locations_on_the_earth_survive_the_line(latitude, longitude, height):
    point = uci.decode_wgs84(uci.encode_wgs84(uci.GeodeticPoint(latitude, longitude, height)))
    assert point.latitude_deg == pytest.approx(latitude, abs=2**-25)
    assert point.longitude_deg == pytest.approx(longitude, abs=2**-25)
    assert point.height_m == pytest.approx(height, abs=3e-4)


@pytest.mark.parametrize("header", ["01", "0103"])
@pytest.mark.parametrize("storey", ["", "aabbccddeeff"])
def test_locations_of_version_2_with_and_without_the_second_header_and_the_storey(header, storey):
    body = bytearray(bytes.fromhex(header + "6ce4fff4600000b6feff" + storey))
    if storey:
        body[0] = 3
        body[1:2] = b"\x07" if len(header) == 4 else body[1:2]
    one = uci.DtMeasurement(1, 0, 0, 0, 0, 0, location=bytes(body))
    assert uci.location_of(one) == (-7.06, 0.07, -0.33)
    assert uci.location_of(replace(one, location=bytes(body)[:8])) is None


def test_a_control_of_16_bits_is_accepted_where_the_size_shows_it():
    body = bytearray(AOSP_2[:0x3A])
    del body[39:41]
    body[0] -= 2
    (one,) = uci.decode_session_info(notification(6, 1, bytes(body))).measurements
    assert (one.tx_ticks, one.location) == (0x0807060504030201, b"\xaa\xbb\xcc")


@pytest.mark.parametrize(
    ("version", "changes"),
    [
        (1, {"tx_bytes": 6}),
        (1, {"location": b"12"}),
        (1, {"tx_ticks": 1 << 40}),
        (2, {"rx_bytes": 9}),
        (1, {"address": 1 << 16}),
        (1, {"block": 1 << 16}),
    ],
)
def test_values_without_bytes_are_refused(version, changes):
    one = replace(uci.DtMeasurement(1, 0, 0, 0, 0, 0), **changes)
    with pytest.raises((ValueError, error)):
        uci.encode_session_info(uci.SessionInfo(0, 0, version, (one,)))


@pytest.mark.parametrize(
    ("packet", "reason"),
    [
        (uci.UciPacket(uci.UciType.NOTIFICATION, 1, 2, bytes(6)), "other-packet"),
        (uci.UciPacket(uci.UciType.NOTIFICATION, 2, 0, bytes(24)), "short-notification"),
        (notification(1, 0, b""), "other-measurements"),
        (notification(2, 0, b"", wide=2), "impossible-address-mode"),
        (notification(2, 3, AOSP_1), "measurements-that-do-not-fit"),
        (notification(6, 3, AOSP_2), "measurements-that-do-not-fit"),
    ],
)
def test_what_is_no_notification_of_measurements_has_a_reason(packet, reason):
    assert uci.decode_session_info(packet) == reason


def test_packets_are_found_behind_garbage_and_unfinished_ones_are_counted():
    drops = Counter()
    reader, info = uci.UciReader(drops), uci.encode_session_info(uci.SessionInfo(1, 2, 1, ()))
    segment = bytes((0x72, 0, 0, 5)) + b"begun"
    other = uci.UciPacket(uci.UciType.RESPONSE, 0, 2, b"\0")
    assert reader.feed(b"\xff\xee\xdd" + uci.encode_packet(info)) == [info]
    assert reader.feed(segment + uci.encode_packet(other)) == [other]
    assert drops == {"bytes-of-no-packet": 1, "unfinished-packet": 1}
    data = bytes((0x02, 0, 3, 0)) + b"abc"
    assert reader.feed(data) == [uci.UciPacket(uci.UciType.DATA, 2, 0, b"abc")]
    endless = (bytes((0x72, 0, 0, 255)) + bytes(255)) * 258
    assert reader.feed(endless) == []
    assert drops["overlong-packet"] == 1


def test_random_bytes_never_raise():
    rng, drops, decoded = random.Random(3), Counter(), 0
    reader = uci.UciReader(drops)
    seeds = [bytes(notification(2, 2, AOSP_1).payload), bytes(notification(6, 2, AOSP_2).payload)]
    for number in range(INPUTS):
        payload = bytearray(rng.choice(seeds) if number % 4 else rng.randbytes(rng.randrange(120)))
        for _ in range(rng.randrange(4)):
            at = rng.randrange(len(payload) + 1)
            payload[at : at + rng.randrange(3)] = rng.randbytes(rng.randrange(3))
        info = uci.decode_session_info(uci.UciPacket(uci.UciType.NOTIFICATION, 2, 0, bytes(payload)))
        if isinstance(info, uci.SessionInfo):
            decoded += 1
            for one in info.measurements:
                located = uci.location_of(one)
                assert located is None or isinstance(located, uci.GeodeticPoint) or all(map(isfinite, located))
        else:
            drops[info] += 1
        stream = uci.encode_packet(uci.UciPacket(uci.UciType.NOTIFICATION, 2, 0, bytes(payload)))
        for packet in reader.feed(stream[rng.randrange(3) :] + rng.randbytes(rng.randrange(3))):
            uci.decode_session_info(packet)
    assert decoded > INPUTS / 10
    assert drops["measurements-that-do-not-fit"] > INPUTS / 10
    assert drops["bytes-of-no-packet"] > 0
