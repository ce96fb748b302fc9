"""MAVLink: pymavlink packs and reads the same bytes; profiles state what autopilots accept, and nothing unknown."""

import math
import os
import random
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec import structs

from skyless.bridges.mavlink import (
    CRC_EXTRAS,
    MAGIC_1,
    MAGIC_2,
    FrameReader,
    GpsGlobalOrigin,
    GpsInput,
    Heartbeat,
    MavlinkEncoder,
    Odometry,
    SetGpsGlobalOrigin,
    Timesync,
    VisionPositionEstimate,
    decoded,
    encoded,
    frame,
    gps_input,
    gps_time,
    no_gps_fix,
    odometry,
    vision_position_estimate,
)
from skyless.bridges.target import BridgeContext, open_hub
from skyless.bridges.targets import open_route
from skyless.core.earth import geodetic
from skyless.core.errors import SkylessError
from support.bridged_values import BARE_SITE, BERLIN, SITE, a_fix, fixes, georeferences

pymavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
pymavlink_1 = pytest.importorskip("pymavlink.dialects.v10.ardupilotmega")


def reader():
    link = pymavlink.MAVLink(None)
    link.robust_parsing = False  # raise at whatever is wrong
    return link


def parse(data):
    """What pymavlink finds in frames."""
    return reader().parse_buffer(data) or []


# The same bytes as pymavlink's own packing

f32 = st.floats(width=32)
i32, u8, u16, u32 = (st.integers(*limits) for limits in ((-(2**31), 2**31 - 1), (0, 255), (0, 65535), (0, 2**32 - 1)))
i64, u64 = st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**64 - 1)
f3, f21 = st.tuples(f32, f32, f32), st.tuples(*[f32] * 21)
messages = st.one_of(
    st.builds(Heartbeat, u32, u8, u8, u8, u8, u8),
    st.builds(SetGpsGlobalOrigin, i32, i32, i32, u8, u64),
    st.builds(GpsGlobalOrigin, i32, i32, i32, u64),
    st.builds(Timesync, i64, i64),
    st.builds(VisionPositionEstimate, u64, f3, f32, f32, f32, f21, u8),
    st.builds(
        Odometry, u64, f3, st.tuples(f32, f32, f32, f32), f3, f3, f21, f21, u8, u8, u8, u8, st.integers(-128, 127)
    ),
    st.builds(GpsInput, u64, u32, i32, i32, f32, f32, f32, f3, f32, f32, f32, u16, u16, u8, u8, u8, u16),
)
NAMES = {
    Heartbeat: "MAVLink_heartbeat_message",
    SetGpsGlobalOrigin: "MAVLink_set_gps_global_origin_message",
    GpsGlobalOrigin: "MAVLink_gps_global_origin_message",
    Timesync: "MAVLink_timesync_message",
    VisionPositionEstimate: "MAVLink_vision_position_estimate_message",
    Odometry: "MAVLink_odometry_message",
    GpsInput: "MAVLink_gps_input_message",
}
ARRAYS = {"q", "pose_covariance", "velocity_covariance", "covariance"}
"""Fields that are arrays in MAVLink; other tuples are several fields there."""


def theirs(message, kind=None):
    """The message as pymavlink's, whose fields are in another order."""
    kind = kind or getattr(pymavlink, NAMES[type(message)])
    wire = []
    for name in message.__struct_fields__:
        value = getattr(message, name)
        wire.extend(value if isinstance(value, tuple) and name not in ARRAYS else (value,))
    fields = dict(zip(kind.ordered_fieldnames, wire, strict=True))
    return kind(*(fields[name] for name in kind.fieldnames))


@given(message=messages, sequence=u8, system=u8, component=u8)
@example(message=Timesync(0, 0), sequence=0, system=1, component=1)  # of zeros one byte stays
def test_bytes_are_those_of_pymavlink(message, sequence, system, component):
    link = pymavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    link.seq = sequence
    assert encoded(message, sequence=sequence, system=system, component=component) == theirs(message).pack(link)


# Reading

READ = st.one_of(
    st.builds(Heartbeat, u32, u8, u8, u8, u8, u8),
    st.builds(GpsGlobalOrigin, i32, i32, i32, u64),
    st.builds(Timesync, i64, i64),
)


@given(sent=st.lists(READ, max_size=5), noise=st.lists(st.binary(max_size=20), min_size=6, max_size=6), step=u8)
def test_frames_are_found_in_pieces_of_any_length(sent, noise, step):
    """Also between noise that holds no frame's first byte."""
    noise = [piece.translate(None, b"\xfd\xfe") for piece in noise]
    frames = [encoded(message, sequence=i, system=9, component=1) for i, message in enumerate(sent)]
    stream = b"".join(a + b for a, b in zip(noise, [*frames, b""], strict=False))
    finder, found = FrameReader(CRC_EXTRAS), []
    for at in range(0, len(stream), step + 1):
        found += finder.frames(stream[at : at + step + 1])
    assert [(decoded(one), one.system, one.component) for one in found] == [(message, 9, 1) for message in sent]
    assert finder.damaged == 0


@given(message=READ)
def test_version_1_and_signed_frames_are_read(message):
    link = pymavlink_1.MAVLink(None, srcSystem=3, srcComponent=1)
    kind = getattr(pymavlink_1, NAMES[type(message)])
    if isinstance(message, GpsGlobalOrigin):  # its time came with version 2
        message = GpsGlobalOrigin(message.latitude_1e7, message.longitude_1e7, message.altitude_mm)
        first = kind(message.latitude_1e7, message.longitude_1e7, message.altitude_mm).pack(link)
    else:
        first = theirs(message, kind).pack(link)
    signing = pymavlink.MAVLink(None, srcSystem=3, srcComponent=1)
    signing.signing.secret_key, signing.signing.sign_outgoing = bytes(32), True
    second = theirs(message).pack(signing)
    found = list(FrameReader(CRC_EXTRAS).frames(first + second))
    assert [decoded(one) for one in found] == [message, message]


@given(message=READ, data=st.data())
def test_a_damaged_frame_is_dropped_and_the_next_is_read(message, data):
    damaged = bytearray(encoded(message, sequence=0, system=1, component=1))
    at = data.draw(st.integers(1, len(damaged) - 1))
    damaged[at] ^= data.draw(st.integers(1, 255))
    good = Heartbeat(custom_mode=5)
    # A wrong length may swallow what comes after; a wrong number makes it another message.
    follow_up = [encoded(good, sequence=i, system=1, component=1) for i in range(20)]
    finder = FrameReader(CRC_EXTRAS)
    found = [decoded(one) for one in finder.frames(bytes(damaged) + b"".join(follow_up))]
    assert found[-1] == good
    assert all(one == good for one in found)


def test_noise_and_damaged_frames_raise_nothing_and_are_not_kept():
    """``SKYLESS_FUZZ_FRAMES=1000000`` for a full run."""
    draw = random.Random(1)
    encoder = MavlinkEncoder("px4")
    encoder.on_site(SITE)
    for _ in range(int(os.environ.get("SKYLESS_FUZZ_FRAMES", "3000"))):
        noise = draw.randbytes(draw.randrange(60))
        kind = draw.randrange(4)
        if kind == 1:
            noise = bytes([draw.choice((MAGIC_1, MAGIC_2))]) + noise
        elif kind > 1:
            number = draw.choice((*CRC_EXTRAS, draw.randrange(1 << 24)))
            extra = CRC_EXTRAS.get(number, draw.randrange(256))
            noise = frame(number, extra, noise or b"\0", sequence=draw.randrange(256), system=1, component=1)
        if kind == 2:
            at = draw.randrange(len(noise))
            noise = noise[:at] + bytes([noise[at] ^ 1 << draw.randrange(8)]) + noise[at + 1 :]
        encoder.on_bytes(noise, draw.getrandbits(62))
        assert len(encoder._reader._buffer) <= 280
    assert encoder.dropped["mavlink-check"]


def test_a_frame_that_cannot_be_checked_is_skipped():
    strange = frame(30_000, 77, b"\xfd" * 9, sequence=0, system=1, component=1)
    good = encoded(Heartbeat(), sequence=0, system=1, component=1)
    finder = FrameReader(CRC_EXTRAS)
    assert [decoded(one) for one in finder.frames(strange + good)] == [Heartbeat()]
    assert finder.damaged == 0


# What a fix becomes


def ned(heading_deg):
    """Matrix from the site's axes to north, east, down."""
    h = math.radians(heading_deg)
    return np.array([[-math.sin(h), math.cos(h), 0], [math.cos(h), math.sin(h), 0], [0, 0, -1.0]])


def triangle(values):
    """6 × 6 of an upper triangle by rows."""
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = values
    return full + np.triu(full, 1).T


def matrix(covariance):
    return np.array(covariance).reshape(3, 3)


def floored_variances(covariance, heading_deg):
    rotation = ned(heading_deg)
    found = rotation @ matrix(covariance) @ rotation.T
    np.fill_diagonal(found, np.maximum(np.diag(found), 1e-4))
    return found


@given(fixes(), georeferences)
def test_ardupilot_gets_finite_numbers_and_no_heading(fix, georeference):
    heading = georeference.heading_deg
    found = vision_position_estimate(fix, heading, 3)
    numbers = (*found.position, found.roll, found.pitch, found.yaw, *found.covariance)
    assert all(map(math.isfinite, numbers))
    assert (found.roll, found.pitch, found.yaw) == (0, 0, 0)
    covariance = triangle(found.covariance)
    np.testing.assert_allclose(found.position, ned(heading) @ fix.position_m, atol=1e-9)
    np.testing.assert_allclose(covariance[:3, :3], floored_variances(fix.covariance_m2, heading), atol=1e-12)
    np.testing.assert_allclose(covariance[3:, 3:], np.diag([math.pi**2] * 3))
    assert not covariance[:3, 3:].any()
    assert abs(found.time_us - fix.unix_s * 1e6) <= 1


@given(fixes(), georeferences)
def test_px4_gets_nan_for_what_is_unknown(fix, georeference):
    heading = georeference.heading_deg
    found = odometry(fix, heading, 300)
    assert (found.frame_id, found.child_frame_id, found.estimator_type, found.reset_counter) == (1, 1, 2, 300 - 256)
    assert np.isnan([*found.q, *found.rates]).all()
    pose = triangle(found.pose_covariance)
    assert np.isnan(pose[3:, :]).all()
    expected = floored_variances(fix.covariance_m2, heading)
    if fix.height_known:
        expected[2, :] = expected[:, 2] = 0.0
        expected[2, 2] = 100.0**2
    np.testing.assert_allclose(pose[:3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(found.position, ned(heading) @ fix.position_m, atol=1e-9)
    assert np.isnan([*found.velocity, *found.velocity_covariance]).all(), "what a filter derived is not new"


@given(fixes(), georeferences)
def test_gps_gives_position_accuracy_and_what_is_to_be_ignored(fix, georeference):
    found = gps_input(fix, georeference)
    latitude, longitude, height = geodetic(fix.position_m, georeference)
    assert abs(found.latitude_1e7 - latitude * 1e7) <= 0.6
    assert abs(found.longitude_1e7 - longitude * 1e7) <= 0.6
    assert found.altitude == height
    covariance = floored_variances(fix.covariance_m2, georeference.heading_deg)
    assert found.horizontal_accuracy == pytest.approx(math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    assert found.vertical_accuracy == pytest.approx(100.0 if fix.height_known else math.sqrt(covariance[2, 2]))
    assert found.fix_type == 3
    assert found.yaw_cdeg == 0
    assert found.satellites_visible == len(fix.anchors)
    assert bool(found.ignore_flags & 2) == (fix.hdop is None)
    assert bool(found.ignore_flags & 4) == (fix.vdop is None)
    assert found.ignore_flags & 0x38 == (0x38 if fix.velocity_mps is None else 0x10 if fix.height_known else 0)
    assert not found.ignore_flags & 0xC1  # altitude and both accuracies are to be used
    if fix.velocity_mps is not None:
        np.testing.assert_allclose(found.velocity, ned(georeference.heading_deg) @ fix.velocity_mps, atol=1e-9)
    assert gps_input(fix, georeference, 12).satellites_visible == 12


GPS_WEEK_S = 7 * 24 * 3600


@pytest.mark.parametrize(
    ("unix_s", "expected"),
    [
        # The leap second of 31 December 2016 makes GPS time 18 s ahead: 2017-01-01T00:00:00Z is Sunday 00:00:18 GPS.
        (1_483_228_800.0, (1930, 18_000)),
        # A week begins at Saturday 23:59:42 UTC.
        (1_483_228_800.0 - 18.0 + GPS_WEEK_S, (1931, 0)),
        (1_483_228_800.0 - 18.001 + GPS_WEEK_S, (1930, GPS_WEEK_S * 1000 - 1)),
        (0.0, (0, 0)),
        (-1e300, (0, 0)),
        (1e300, (0, 0)),
        (math.nan, (0, 0)),
        (math.inf, (0, 0)),
    ],
)
def test_gps_time(unix_s, expected):
    week, week_ms = gps_time(unix_s)
    assert (week, week_ms) == pytest.approx(expected, abs=1)


def test_gps_time_is_that_of_gps_weeks_since_1980():
    """Against the calendar: GPS began on Sunday 6 January 1980 and counts no leap seconds."""
    from datetime import datetime, timedelta

    moment = datetime(2026, 11, 21, 13, 30, 15, 250_000)
    since = moment + timedelta(seconds=18) - datetime(1980, 1, 6)
    week, rest = divmod(since, timedelta(weeks=1))
    unix_s = (moment - datetime(1970, 1, 1)).total_seconds()
    assert gps_time(unix_s) == (week, rest // timedelta(milliseconds=1))


# What is sent when


def encoder(profile, site=SITE, **settings):
    made = MavlinkEncoder(profile, **settings)
    assert made.on_site(site) == []
    return made


def names(frames):
    return [one.get_type() for one in parse(b"".join(frames))]


MESSAGE = {"ardupilot": "VISION_POSITION_ESTIMATE", "px4": "ODOMETRY", "gps": "GPS_INPUT"}
profiles = pytest.mark.parametrize("profile", MESSAGE)


@profiles
def test_a_fix_is_one_message_that_pymavlink_reads(profile):
    made = encoder(profile, system=5)
    (data,) = made.on_fix(a_fix())
    (found,) = parse(data)
    assert found.get_type() == MESSAGE[profile]
    assert (found.get_srcSystem(), found.get_srcComponent()) == (5, 197)
    stamp = "usec" if profile == "ardupilot" else "time_usec"
    assert getattr(found, stamp) == 1_795_000_000_250_000


@profiles
def test_nothing_is_sent_before_the_site_is_known(profile):
    assert MavlinkEncoder(profile).on_fix(a_fix()) == []


@profiles
def test_without_a_fix_a_gps_says_so_and_the_others_are_silent(profile):
    made = encoder(profile)
    made.on_fix(a_fix())
    frames = made.on_no_fix("tag1", 1_795_000_002.0, "lost")
    if profile != "gps":
        assert frames == []
        return
    (found,) = parse(b"".join(frames))
    assert (found.get_type(), found.fix_type, found.satellites_visible) == ("GPS_INPUT", 1, 0)
    assert (found.lat, found.lon, found.alt) == (0, 0, 0)
    assert found.ignore_flags == 255
    assert no_gps_fix(1_795_000_002.0).fix_type == 1


def test_the_origin_goes_out_with_the_heartbeat_until_the_vehicle_has_one():
    made = encoder("ardupilot")
    heartbeat, origin = parse(b"".join(made.on_second(1_795_000_000.0)))
    assert (heartbeat.type, heartbeat.autopilot, heartbeat.base_mode) == (18, 8, 0)
    assert (origin.get_type(), origin.target_system) == ("SET_GPS_GLOBAL_ORIGIN", 1)
    assert origin.latitude == round(BERLIN.latitude_deg * 1e7)
    assert origin.longitude == round(BERLIN.longitude_deg * 1e7)
    assert origin.altitude == 34_500
    other = encoded(GpsGlobalOrigin(1, 2, 3), sequence=0, system=2, component=1)
    camera = encoded(GpsGlobalOrigin(1, 2, 3), sequence=0, system=1, component=100)
    made.on_bytes(other + camera, 0)
    assert names(made.on_second(0.0)) == ["HEARTBEAT", "SET_GPS_GLOBAL_ORIGIN"]
    made.on_bytes(encoded(GpsGlobalOrigin(1, 2, 3), sequence=0, system=1, component=1), 0)
    assert names(made.on_second(0.0)) == ["HEARTBEAT"]


def heard(made, message):
    """The vehicle has sent a message."""
    made.on_bytes(encoded(message, sequence=0, system=1, component=1), 1_795_000_000 * 10**9)


ORIGIN = GpsGlobalOrigin(525_123_457, 133_260_000, 34_500)


def test_a_vehicle_that_was_away_gets_the_origin_again():
    """It may have another battery, and no origin."""
    made = encoder("px4")
    heard(made, Heartbeat())
    heard(made, ORIGIN)
    for _ in range(10):
        assert names(made.on_second(0.0)) == ["HEARTBEAT"]
        heard(made, Heartbeat())
    sent = [names(made.on_second(0.0))[1:] for _ in range(4)]
    assert sent == [[], [], ["SET_GPS_GLOBAL_ORIGIN"], ["SET_GPS_GLOBAL_ORIGIN"]]


@profiles
def test_an_origin_that_is_not_the_sites_is_logged_once(profile):
    said = []
    made = encoder(profile, text="mavlink+udpout:", log=said.append)
    heard(made, ORIGIN)
    heard(made, structs.replace(ORIGIN, latitude_1e7=ORIGIN.latitude_1e7 - 10, altitude_mm=34_400))
    assert said == []
    heard(made, structs.replace(ORIGIN, longitude_1e7=ORIGIN.longitude_1e7 + 11))
    heard(made, structs.replace(ORIGIN, altitude_mm=34_399))
    if profile == "gps":  # gives none, and the vehicle has what it found itself
        assert said == []
        return
    (line,) = said
    assert "states the origin 52.5123457, 13.3260011, 34.50 m" in line
    assert "the site's is 52.5123457, 13.3260000, 34.50 m" in line


def test_no_origin_is_sent_to_an_armed_vehicle():
    made = encoder("px4")
    heard(made, Heartbeat(base_mode=0x81))
    assert [names(made.on_second(0.0)) for _ in range(9)] == [["HEARTBEAT"]] * 9, "nor if it was away"
    made.on_bytes(encoded(Heartbeat(base_mode=0x01), sequence=0, system=1, component=1), 0)
    assert names(made.on_second(0.0)) == ["HEARTBEAT", "SET_GPS_GLOBAL_ORIGIN"]


def test_a_site_that_does_not_know_where_it_is_gives_no_origin_and_no_gps():
    made = encoder("px4", BARE_SITE)
    assert names(made.on_second(0.0)) == ["HEARTBEAT"]
    (found,) = parse(b"".join(made.on_fix(a_fix(position_m=(1.0, 2.0, 3.0)))))
    assert (found.x, found.y, found.z) == (2.0, 1.0, -3.0)
    with pytest.raises(SkylessError, match="latitude_deg"):
        MavlinkEncoder("gps", text="mavlink+udpout:").on_site(BARE_SITE)


@pytest.mark.parametrize(("site", "heading_deg", "lines"), [(BARE_SITE, None, 1), (BARE_SITE, 0.0, 0), (SITE, None, 0)])
def test_that_north_is_assumed_is_logged_once(site, heading_deg, lines):
    said = []
    made = encoder("px4", site, text="mavlink+udpout:", heading_deg=heading_deg, log=said.append)
    assert said == [], "a tag by itself may still learn it"
    for serial in range(1, 4):
        made.on_fix(a_fix(serial=serial))
        made.on_site(structs.replace(site, anchors_m=site.anchors_m | {9: (0.0, serial, 2.0)}))
    assert len(said) == lines
    assert all(
        line.startswith("mavlink+udpout:: site 7 (hall) does not say where north is") and "heading=" in line
        for line in said
    )


@profiles
def test_that_a_height_is_assumed_is_logged_where_the_message_cannot_say_it(profile):
    said = []
    made = encoder(profile, log=said.append)
    made.on_fix(a_fix())
    assert said == []
    for serial in (2, 3):
        made.on_fix(a_fix(serial=serial, height_known=True))
    assert [("EK3_SRC1_POSZ 1" in line) for line in said] == ([True] if profile == "ardupilot" else [])


def test_the_heading_of_a_site_that_has_none_can_be_given():
    made = encoder("ardupilot", BARE_SITE, heading_deg=90.0)
    (found,) = parse(b"".join(made.on_fix(a_fix(position_m=(1.0, 2.0, 3.0)))))
    assert (found.x, found.y, found.z) == pytest.approx((-1.0, 2.0, -3.0))
    with pytest.raises(SkylessError, match=r"heading=90.*heading_deg = 30"):
        made.on_site(SITE)


@pytest.mark.site
@pytest.mark.parametrize(("key", "lines"), [("&tag=tag2", 0), ("", 1)])
def test_a_tag_that_the_user_chose_is_not_argued_about(key, lines):
    said = []
    hub = open_hub(
        [open_route(f"mavlink+udpout://127.0.0.1:9?profile=px4{key}", BridgeContext(said.append))], said.append
    )
    hub.on_site(SITE)
    for serial in range(1, 4):
        hub.on_fix(a_fix(tag="tag2", serial=serial), serial)
        hub.on_fix(a_fix(tag="tag1", serial=serial), serial)
    assert len([line for line in said if "carries one tag" in line]) == lines


def test_a_gps_gets_no_origin():
    assert names(encoder("gps").on_second(0.0)) == ["HEARTBEAT"]


def test_the_reset_counter_rises_when_the_receiver_or_the_site_begins_again():
    made = encoder("ardupilot")

    def counter(serial):
        (found,) = parse(b"".join(made.on_fix(a_fix(serial=serial))))
        return found.reset_counter

    assert [counter(serial) for serial in (0, 5, 9, 1, 2)] == [0, 0, 0, 1, 1]
    made.on_site(SITE)
    made.on_site(structs.replace(SITE, anchors_m=SITE.anchors_m | {3: (0.0, 9.0, 2.0)}))
    assert counter(3) == 1, "a tag that learns of more anchors stays in the same frame"
    made.on_site(structs.replace(SITE, anchors_m=SITE.anchors_m | {1: (0.0, 9.0, 2.0)}))
    assert counter(4) == 2, "an anchor was surveyed again"
    made.on_site(structs.replace(SITE, anchors_m=SITE.anchors_m | {1: (0.0, 9.0, 2.0)}, georeference=None))
    assert counter(5) == 3


def test_questions_for_the_time_are_answered():
    made = encoder("px4")
    question = encoded(Timesync(0, 123_456), sequence=0, system=1, component=1)
    answer = encoded(Timesync(7, 8), sequence=1, system=1, component=1)
    stranger = encoded(Timesync(0, 5), sequence=2, system=9, component=1)
    (found,) = parse(b"".join(made.on_bytes(question + answer + stranger, 1_795_000_000_250_000_123)))
    assert (found.get_type(), found.tc1, found.ts1) == ("TIMESYNC", 1_795_000_000_250_000_123, 123_456)


def states(place, flags=831):
    """What a vehicle says of itself."""
    link = pymavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    odometry_of = link.odometry_encode(0, 1, 1, *place, [1, 0, 0, 0], *[0] * 6, *[(math.nan,) * 21] * 2, 0, 0, 0)
    imu, status = link.highres_imu_encode(5_000_000, *range(15)), link.estimator_status_encode(0, flags, *[0] * 8)
    position, attitude = link.local_position_ned_encode(0, *place, 0, 0, 0), link.attitude_encode(0, *place, 0, 0, 0)
    return b"".join(one.pack(link) for one in (attitude, position, odometry_of, imu, status))


@pytest.mark.parametrize(
    ("place", "flags", "height_known", "words"),
    [
        ((2.0, 1.0, -1.5), 831, False, "the vehicle follows, 0 cm; north is seen after 20 s"),
        ((2.0, 1.0, -1.5), 831 & ~24, False, "set EKF2_EV_CTRL 3"),
        ((4.0, 1.0, -1.5), 831, False, "the vehicle is 2.0 m off: set EKF2_EV_CTRL 3"),
        ((2.0, 1.0, -0.8), 831, False, "height is 0.7 m off: set EKF2_HGT_REF 3"),
        ((2.0, 1.0, -0.8), 831, True, "the vehicle follows"),
        (None, 831, False, "no LOCAL_POSITION_NED, or the clocks of tag and bridge differ: set MAV_1_MODE 2"),
    ],
)
def test_what_a_vehicle_says_of_itself_is_judged_once(place, flags, height_known, words):
    said = []
    made = encoder("px4", BARE_SITE, heading_deg=0.0, log=said.append)
    for serial in range(400):
        unix_s = 1_795_000_000.0 + serial / 20.0
        made.on_fix(a_fix(serial=serial, unix_s=unix_s, velocity_mps=(0.0, 0.0, 0.0), height_known=height_known))
        heard(made, Heartbeat())
        made.on_bytes(states(place, flags) if place else b"", int(unix_s * 1e9))
        if serial % 20 == 0:
            made.on_second(unix_s)
    assert [words in line for line in said] == [True]


def test_nonsense_from_a_vehicle_is_a_counted_drop():
    made = encoder("px4")
    made.on_bytes(states((math.nan, math.inf, -1e30)), 0)
    assert made.dropped == {"mavlink-nonsense": 3}


def test_frames_are_numbered():
    made = encoder("gps")
    frames = [frame for _ in range(300) for frame in made.on_second(0.0)]
    assert [one[4] for one in frames] == [number % 256 for number in range(300)]


@profiles
def test_a_value_beyond_its_field_is_a_counted_drop(profile):
    made = encoder(profile)
    assert made.on_fix(a_fix(unix_s=1e300)) == []
    assert made.on_fix(a_fix(serial=2, covariance_m2=(1e300,) * 9)) == []
    assert made.dropped == {"mavlink-value": 2}


def test_the_parameters_of_ardupilots_page_are_a_file_that_its_programs_load(tmp_path):
    """MAVProxy and the others read such files with pymavlink's reader."""
    from pymavlink.mavparm import MAVParmDict

    page = (Path(__file__).parents[2] / "docs" / "tools" / "ardupilot.md").read_text(encoding="utf-8")
    file = tmp_path / "skyless.param"
    file.write_text(re.search(r"^```\n(SERIAL.*?)^```", page, re.DOTALL | re.MULTILINE)[1], encoding="utf-8")
    parameters = MAVParmDict()
    assert parameters.load(str(file), use_excludes=False)
    assert len(parameters) == 14
    assert (parameters["EK3_SRC1_YAW"], parameters["VISO_TYPE"], parameters["EK3_SRC1_POSXY"]) == (1, 1, 6)
