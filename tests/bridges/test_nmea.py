"""NMEA 0183 as pynmeagps, a decoder of others, reads it."""

from datetime import UTC, datetime
from math import cos, hypot, isfinite, radians, sqrt

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pynmeagps import VALCKSUM, NMEAReader

from skyless.bridges.nmea import NmeaEncoder, epoch, epoch_without_fix
from skyless.bridges.target import BridgedSite, floored
from skyless.core.earth import geodetic, rotated
from skyless.core.errors import SkylessError
from skyless.core.site import GeoreferenceSite
from skyless.run.mqtt.messages import FixMessage

HALL = GeoreferenceSite(latitude_deg=52.5, longitude_deg=13.4, height_m=40.0, heading_deg=30.0)
DEGREE_M = 111_320.0
NOON_S = 1_750_000_000.0

FIX = FixMessage(
    tag="tag1", serial=7, unix_s=NOON_S, time_s=12.0, position_m=(3.0, 4.0, 1.2),
    covariance_m2=(0.0009, 0.0002, 0.0, 0.0002, 0.0004, 0.0, 0.0, 0.0, 0.0025),
    velocity_mps=(1.0, 0.0, 0.0), velocity_covariance=(0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01),
    std_m=0.06, gdop=1.4, pdop=1.3, hdop=1.1, vdop=0.7, anchors=(1, 2, 3, 4, 5), chi2=3.0, dof=2,
    residual_rms_m=0.03, method="joint", height_known=False, latency_s=0.001,
)  # fmt: skip


def read(data):
    """Every sentence of an epoch by its name, with checksums checked."""
    lines = data.decode("ascii").splitlines(keepends=True)
    assert all(line.startswith("$GN") and line.endswith("\r\n") and len(line) <= 88 for line in lines)
    messages = [NMEAReader.parse(line.encode(), validate=VALCKSUM) for line in lines]
    return {message.msgID: message for message in messages}


def numbers(low, high):
    return st.floats(low, high, allow_nan=False)


@st.composite
def covariances(draw):
    """Of an ellipsoid with axes of 1 mm to 30 m, turned about the vertical."""
    major, minor, up = (draw(numbers(0.001, 30.0)) for _ in range(3))
    flat = (major**2, 0.0, 0.0, 0.0, minor**2, 0.0, 0.0, 0.0, up**2)
    return rotated(flat, draw(numbers(0.0, 360.0)))


origins = st.builds(
    GeoreferenceSite,
    latitude_deg=numbers(-90.0, 90.0) | st.sampled_from([90.0, -90.0, 0.0, 59.999999999999, 89.99999999]),
    longitude_deg=numbers(-180.0, 180.0) | st.sampled_from([180.0, -180.0, 179.9999999999, 0.0, -1e-12]),
    height_m=numbers(-400.0, 9000.0),
    heading_deg=numbers(-360.0, 360.0),
)
moments = numbers(946_684_800.0, 3_124_000_000.0) | st.builds(
    lambda day, second: 86_400.0 * day + second,
    st.integers(12_000, 36_000), st.sampled_from([-0.001, -0.005, -0.0050001, 0.0, 86_399.994, 86_399.996]),
)  # fmt: skip
fixes = st.builds(
    lambda **changed: msgspec.structs.replace(FIX, **changed),
    unix_s=moments,
    position_m=st.tuples(*[numbers(-500.0, 500.0)] * 3),
    covariance_m2=covariances(),
    velocity_mps=st.none() | st.tuples(*[numbers(-30.0, 30.0)] * 3),
    anchors=st.lists(st.integers(0, 2000), max_size=40).map(tuple),
    hdop=st.none() | st.floats(0.0),
    residual_rms_m=st.floats(0.0),
)


@given(fix=fixes, origin=origins, quality=st.sampled_from(["gps", "rtk", "simulator"]), geoid_m=numbers(-110.0, 90.0))
def test_another_decoder_reads_what_was_sent(fix, origin, quality, geoid_m):
    received = read(epoch(fix, origin, quality, geoid_m))
    assert list(received) == ["RMC", "GGA", "GST", "GBS", "GSA"]
    rmc, gga, gst, gbs, gsa = received.values()
    latitude_deg, longitude_deg, height_m = geodetic(fix.position_m, origin)
    for message in (rmc, gga):
        turned_deg = (message.lon - longitude_deg + 180.0) % 360.0 - 180.0
        east_m = turned_deg * DEGREE_M * cos(radians(latitude_deg))
        assert hypot(east_m, (message.lat - latitude_deg) * DEGREE_M) < 2e-4
        assert abs(message.lat) <= 90.0 and abs(message.lon) <= 180.0
    assert abs(gga.alt + gga.sep - height_m) < 1.1e-3
    moment = datetime.combine(rmc.date, rmc.time, UTC)
    assert abs(moment.timestamp() - fix.unix_s) < 0.0051
    assert rmc.time == gga.time == gst.time == gbs.time
    assert (rmc.status, gga.quality) == ("A", {"gps": 1, "rtk": 4, "simulator": 8}[quality])
    covariance = floored(rotated(fix.covariance_m2, origin.heading_deg))
    east, north, up = (sqrt(covariance[axis]) for axis in (0, 4, 8))
    assert (gst.stdLong, gst.stdLat, gst.stdAlt) == pytest.approx((east, north, up), abs=1e-4)
    assert (gbs.errLon, gbs.errLat, gbs.errAlt) == (gst.stdLong, gst.stdLat, gst.stdAlt)
    assert gsa.navMode == 3
    named = [anchor for anchor in fix.anchors if anchor < 1000][:12]
    assert [getattr(gsa, f"svid_{slot:02d}") for slot in range(1, 13)] == named + [""] * (12 - len(named))
    assert gga.numSV == min(len(fix.anchors), 99)


def test_a_covariance_turns_with_the_site():
    """The site's x axis points east of south by 60°, so that σ along it is mostly north's."""
    along_x = msgspec.structs.replace(FIX, covariance_m2=(0.25, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01))
    origin = msgspec.structs.replace(HALL, heading_deg=60.0)
    gst = read(epoch(along_x, origin, "rtk"))["GST"]
    assert gst.orient == pytest.approx(150.0, abs=0.01)
    assert (gst.stdMajor, gst.stdMinor) == pytest.approx((0.5, 0.1), abs=1e-4)
    assert gst.stdLat > gst.stdLong


def test_small_deviations_leave_as_one_centimetre():
    sharp = msgspec.structs.replace(FIX, covariance_m2=(1e-6, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 0.0))
    gbs = read(epoch(sharp, HALL, "rtk"))["GBS"]
    assert (gbs.errLat, gbs.errLon, gbs.errAlt) == (0.01, 0.01, 0.01)


@pytest.mark.parametrize(("velocity_mps", "course"), [((0.0, 2.0, 0.0), 30.0), ((2.0, 0.0, 0.0), 120.0)])
def test_course_and_speed_are_those_over_ground(velocity_mps, course):
    moving = msgspec.structs.replace(FIX, velocity_mps=velocity_mps)
    rmc = read(epoch(moving, HALL, "rtk"))["RMC"]
    assert (rmc.spd, rmc.cog) == (pytest.approx(2.0 * 3600.0 / 1852.0, abs=1e-3), pytest.approx(course, abs=0.01))


def test_a_tag_that_stands_has_no_course():
    standing = msgspec.structs.replace(FIX, velocity_mps=(0.1, 0.1, 0.0))
    rmc = read(epoch(standing, HALL, "rtk"))["RMC"]
    assert rmc.spd == pytest.approx(0.275, abs=0.001)
    assert rmc.cog == ""
    unknown = msgspec.structs.replace(FIX, velocity_mps=None, velocity_covariance=None)
    assert read(epoch(unknown, HALL, "rtk"))["RMC"].spd == ""


def test_no_fix_has_a_time_and_no_position():
    received = read(epoch_without_fix(NOON_S))
    rmc, gga, gbs, gsa = received.values()
    assert (rmc.status, rmc.lat, rmc.lon, rmc.posMode) == ("V", "", "", "N")
    assert datetime.combine(rmc.date, rmc.time, UTC).timestamp() == NOON_S
    assert (gga.quality, gga.lat, gga.alt) == (0, "", "")
    assert (gbs.time, gbs.errLat) == (rmc.time, "")
    assert gsa.navMode == 1


@pytest.mark.parametrize(
    "changed",
    [
        {"unix_s": float("nan")}, {"unix_s": 1e300}, {"unix_s": -1.0}, {"position_m": (1e300, 0.0, 0.0)},
        {"position_m": (0.0, float("inf"), 0.0)}, {"position_m": (0.0, 0.0, float("nan"))},
        {"covariance_m2": (1e300, *FIX.covariance_m2[1:])}, {"covariance_m2": (float("nan"),) * 9},
    ],
)  # fmt: skip
def test_what_sentences_cannot_state_is_dropped_and_counted(changed):
    encoder = NmeaEncoder()
    encoder.on_site(BridgedSite(1, "hall", False, {}, HALL))
    sent = b"".join(encoder.on_fix(msgspec.structs.replace(FIX, **changed)))
    assert b",A," not in sent.partition(b"GSA")[0]
    assert (sent == b"") == ("unix_s" in changed)
    assert encoder.dropped == {"out-of-range": 1}


@given(
    fix=st.builds(
        lambda **changed: msgspec.structs.replace(FIX, **changed),
        unix_s=st.floats(),
        position_m=st.tuples(*[st.floats()] * 3),
        covariance_m2=st.tuples(*[st.floats()] * 9),
        velocity_mps=st.tuples(*[st.floats()] * 3),
        velocity_covariance=st.tuples(*[st.floats()] * 9),
        anchors=st.lists(st.integers()).map(tuple),
        hdop=st.floats(),
        residual_rms_m=st.floats(),
    )
)
def test_no_values_raise_or_leave_as_something_else_than_numbers(fix):
    data = epoch(fix, HALL, "rtk")
    if data is not None:
        read(data)
        assert b"nan" not in data and b"inf" not in data and isfinite(fix.unix_s)


def test_a_simulated_site_is_marked_unless_asked_otherwise():
    simulated = BridgedSite(1, "lab", True, {}, HALL)

    def quality(encoder, site):
        assert encoder.on_site(site) == []
        [data] = encoder.on_fix(FIX)
        return read(data)["GGA"].quality

    assert quality(NmeaEncoder(), simulated) == 8
    assert quality(NmeaEncoder(), msgspec.structs.replace(simulated, simulated=False)) == 4
    assert quality(NmeaEncoder(quality="gps"), simulated) == 1


def test_a_site_without_a_georeference_is_refused():
    with pytest.raises(SkylessError, match=r"\[georeference\] with latitude_deg"):
        NmeaEncoder().on_site(BridgedSite(1, "hall", False, {}))
