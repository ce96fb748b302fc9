"""What a tag on a board says, against the decoders and the arithmetic of Python, and to the real gpsd."""

import asyncio
import ctypes
import json
from datetime import UTC, datetime
from math import cos, hypot, radians

import msgspec
import numpy as np
import pynmeagps
import pytest
from emulator.board_library import library
from firmware_stage import needs_compiler
from hypothesis import given
from hypothesis import strategies as st

from skyless.bridges.nmea import epoch
from skyless.bridges.target import is_usable
from skyless.core.earth import geodetic
from skyless.core.fix import NoFixReason
from skyless.core.site import GeoreferenceSite
from skyless.radio.serial.serial_port import Pty
from skyless.radio.tag_reports import AnchorPlace, BoardReceiver, board_fix
from skyless.run.mqtt.messages import FixMessage, fix_message
from support.board_tag import ANCHORS, FixInC, OriginInC, fix_in_c
from support.gpsd import GPSD, gpsd

pytestmark = [pytest.mark.site, needs_compiler]

OUTPUT_MAX_BYTES = 896
HALL = OriginInC(525_130_000, 134_000_000, 40_000, 250_000_000)


def small(limit):
    return st.floats(-limit, limit, width=32)


@st.composite
def fixes(draw):
    roots = np.array(draw(st.lists(small(3.0), min_size=18, max_size=18))).reshape(2, 3, 3)
    upper = np.triu_indices(3)
    covariance, velocity_covariance = ((root @ root.T + 1e-4 * np.eye(3))[upper] for root in roots)
    millimetres = st.tuples(*[st.integers(-500_000, 500_000)] * 3)
    return fix_in_c(
        time_ticks=draw(st.integers(0, 2**62)),
        position_mm=draw(millimetres),
        velocity_mmps=draw(millimetres),
        covariance_m2=tuple(covariance),
        velocity_covariance=tuple(velocity_covariance),
        levels=draw(st.integers(0, 3)),
        hpl_m=draw(st.floats(0.01, 10.0)),
        alert_limit_m=draw(st.sampled_from([0.0, 1.0])),
        is_height_known=draw(st.booleans()),
        is_verified=draw(st.booleans()),
        unix_us=draw(st.integers(946_684_800_000_000, 4_100_000_000_000_000)),
    )


def written(name, fix):
    data = ctypes.create_string_buffer(OUTPUT_MAX_BYTES)
    size = getattr(library(), f"{name}_write")(ctypes.byref(fix), data)
    return data.raw[:size].decode("ascii")


def message_of(fix):
    """What a host's program makes of the record of this fix."""
    receiver = BoardReceiver()
    for number, place_mm in ANCHORS:
        receiver.take(AnchorPlace(number, tuple(mm / 1000 for mm in place_mm)))
    report = board_fix(bytes(2) + fix.sent())
    return fix_message(f"tag{fix.tag}", fix.serial, receiver.take(report), fix.unix_us / 1e6, report.latency_s)


@given(fixes())
def test_a_record_and_a_line_of_json_hold_the_fix(fix):
    message, matrix = message_of(fix), (0, 1, 2, 1, 3, 4, 2, 4, 5)
    assert message.position_m == tuple(mm / 1000 for mm in fix.position_mm)
    assert message.velocity_mps == tuple(mm / 1000 for mm in fix.velocity_mmps)
    assert message.covariance_m2 == tuple(fix.covariance_m2[at] for at in matrix)
    assert message.velocity_covariance == tuple(fix.velocity_covariance[at] for at in matrix)
    assert message.anchors == tuple(number for number, _ in ANCHORS)
    assert message.time_s == pytest.approx(fix.time_ticks / 63.8976e9)
    line, meant = written("json", fix), msgspec.structs.asdict(message)
    assert list(json.loads(line)) == [name for name in meant if name not in {"orientation", "heading_std_rad"}]
    assert line.endswith("}\n")
    found = msgspec.json.decode(line, type=FixMessage)
    for name, value in meant.items():
        got = getattr(found, name)
        if name.endswith("dop"):
            assert got == pytest.approx(value, rel=1e-2, abs=1e-3) or message.gdop > 10.0  # far from all anchors
        elif isinstance(value, float) or (isinstance(value, tuple) and name != "anchors"):
            assert got == pytest.approx(value, rel=1e-5, abs=6e-5), name
        else:
            assert got == value, name


def test_single_precision_dilutions_are_those_of_double():
    meant, found = message_of(fix_in_c()), msgspec.json.decode(written("json", fix_in_c()), type=FixMessage)
    for name in ("gdop", "pdop", "hdop", "vdop"):
        assert getattr(found, name) == pytest.approx(getattr(meant, name), abs=1e-3)


def test_no_fix_is_a_line_with_its_reason():
    for place, reason in enumerate(NoFixReason, 1):
        line = written("json", fix_in_c(reason=place, unix_us=5_000_000))
        assert msgspec.json.decode(line) == {"type": "no_fix", "tag": "tag4", "unix_s": 5.0, "reason": reason.value}


def as_site(origin):
    angles_deg = (origin.latitude_e7 / 1e7, origin.longitude_e7 / 1e7)
    return GeoreferenceSite(*angles_deg, origin.height_mm / 1e3, origin.heading_e7 / 1e7)


def parsed(text):
    """What another decoder reads of the sentences for receivers of satellites, by their names."""
    sentences = [line for line in text.splitlines(keepends=True) if line.startswith("$GN")]
    return {sentence[3:6]: pynmeagps.NMEAReader.parse(sentence) for sentence in sentences}


@given(fixes())
def test_sentences_say_what_the_bridge_s_sentences_say(fix):
    fix.has_origin, fix.origin = True, HALL
    message = message_of(fix)
    found = parsed(written("nmea", fix))
    assert len(written("nmea", fix)) < 500
    if not is_usable(message):
        assert list(found) == ["RMC", "GGA"]
        assert (found["RMC"].status, found["GGA"].quality, found["GGA"].lat) == ("V", 0, "")
        return
    assert list(found) == ["RMC", "GGA", "GST"]
    meant = parsed(epoch(message, as_site(HALL), "rtk").decode())
    rmc, gga, gst = found.values()
    assert (rmc.date, rmc.time, rmc.status, rmc.posMode) == (*(meant["RMC"].date, meant["RMC"].time), "A", "R")
    for one, other in ((rmc, meant["RMC"]), (gga, meant["GGA"])):
        assert hypot(one.lat - other.lat, cos(radians(52.5)) * (one.lon - other.lon)) * 111_300.0 < 2e-3
    assert (gga.quality, gga.numSV, gga.alt) == (4, 5, meant["GGA"].alt)
    assert rmc.spd == pytest.approx(meant["RMC"].spd, rel=1e-5, abs=2e-3)
    for name in ("rangeRms", "stdMajor", "stdMinor", "stdLat", "stdLong", "stdAlt"):
        assert getattr(gst, name) == pytest.approx(getattr(meant["GST"], name), rel=1e-3, abs=3e-3)
    if gst.stdMajor > 1.05 * gst.stdMinor:
        assert abs((gst.orient - meant["GST"].orient + 90.0) % 180.0 - 90.0) < 0.2
    if rmc.cog != "" and meant["RMC"].cog != "":
        assert abs((rmc.cog - meant["RMC"].cog + 180.0) % 360.0 - 180.0) < 0.02


def test_dates_are_those_of_the_calendar_and_empty_on_a_board_that_does_not_know_the_time():
    found = parsed(written("nmea", fix_in_c(has_origin=True, origin=HALL)))
    assert [message.time for message in found.values()] == [""] * 3
    assert found["RMC"].date == ""
    for unix_s in (951_782_400, 1_709_164_800, 1_790_000_000, 2_000_000_000):
        rmc = parsed(written("nmea", fix_in_c(has_origin=True, origin=HALL, unix_us=unix_s * 1_000_000)))["RMC"]
        assert datetime.combine(rmc.date, rmc.time, UTC).timestamp() == unix_s


def test_the_own_sentence_has_the_local_position_also_without_a_georeference():
    (line,) = written("nmea", fix_in_c(levels=1)).splitlines()
    body, check = line[1:].split("*")
    assert body == "PSKY,1.000,3,4,4.000,3.000,1.200,0.040,0.120,0.200,1,U"
    assert int(check, 16) == np.bitwise_xor.reduce(list(body.encode()))
    assert "PSKY,,,4,,,,,,,,U" in written("nmea", fix_in_c(reason=1, site=0xFFFF))


@given(
    st.integers(-800_000_000, 800_000_000),
    st.integers(-1_800_000_000, 1_799_999_999),
    st.integers(-500_000, 9_000_000),
    st.integers(0, 3_599_999_999),
    st.tuples(*[st.integers(-3_500_000, 3_500_000)] * 2),
)
def test_the_place_on_the_earth_is_right_to_millimetres_within_five_kilometres(lat, lon, height, heading, place):
    origin, found = OriginInC(lat, lon, height, heading), (ctypes.c_int64(), ctypes.c_int64())
    library().earth_geodetic(ctypes.byref(origin), (ctypes.c_int32 * 3)(*place, 0), *map(ctypes.byref, found))
    latitude, longitude = (angle.value / 60e7 for angle in found)
    right_latitude, right_longitude, _ = geodetic((place[0] / 1e3, place[1] / 1e3, 0.0), as_site(origin))
    east = cos(radians(right_latitude)) * ((longitude - right_longitude + 180.0) % 360.0 - 180.0)
    assert hypot(latitude - right_latitude, east) * 111_700.0 < 5e-3


@given(st.integers(0, 3), st.booleans(), st.integers(0, 2**32 - 1), fixes())
def test_an_advertisement_fits_and_holds_the_fix(reason, verified, age_ms, fix):
    fix.reason, fix.is_verified = reason, verified
    data = ctypes.create_string_buffer(31)
    library().advertisement_write(ctypes.byref(fix), age_ms, data)
    assert data.raw[:7] == bytes((26, 0xFF)) + b"\xff\xff" + b"SK" + b"\1"  # length, kind, company, mark, version
    numbers = [int.from_bytes(data.raw[at : at + 2], "little") for at in (7, 9, 12)]
    assert numbers == [fix.site, fix.tag, min(age_ms // 10, 0xFFFF)]
    place_cm = [int.from_bytes(data.raw[at : at + 3], "little", signed=True) for at in (14, 17, 20)]
    std_cm, hpl_cm = (int.from_bytes(data.raw[at : at + 2], "little") for at in (23, 25))
    flags, message = data.raw[11], None if reason else message_of(fix)
    if message is None:
        assert (flags, place_cm, std_cm, hpl_cm) == (0, [0, 0, 0], 0xFFFF, 0xFFFF)
        return
    alerts = ["none", "detected-excluded", "detected-not-excluded", "unavailable", "alert-limit-exceeded"]
    assert (flags & 1, alerts[flags >> 1 & 7], bool(flags & 16)) == (1, message.alert, verified)
    assert place_cm == [int(mm / 10) for mm in fix.position_mm]
    assert std_cm == pytest.approx(100 * message.std_m, abs=0.51)
    assert hpl_cm == (0xFFFF if message.hpl_m is None else pytest.approx(100 * message.hpl_m, abs=0.51))


@pytest.mark.parametrize(("rate_hz", "fixes_hz"), [(50, 397), (1, 100), (25, 20), (0, 397)])
def test_the_rate_of_an_output_gives_evenly_spaced_fixes(rate_hz, fixes_hz):
    slot, given_s = ctypes.c_int64(-(2**63)), []
    for number in range(10 * fixes_hz):
        fix = FixInC(time_ticks=round(63_897_600_000 * number / fixes_hz))
        if library().fix_is_due(ctypes.byref(fix), rate_hz, ctypes.byref(slot)):
            given_s.append(number / fixes_hz)
    wanted_hz = min(rate_hz or fixes_hz, fixes_hz)
    assert len(given_s) == 10 * wanted_hz
    assert np.abs(np.diff(given_s) - 1 / wanted_hz).max() < 1.001 / fixes_hz


@pytest.mark.skipif(GPSD is None, reason="gpsd is not installed: apt-get install gpsd")
@pytest.mark.parametrize("knows_time", [True, False])
async def test_gpsd_has_the_position_and_its_errors_whether_the_board_knows_the_time_or_not(knows_time):
    pty, tpvs, gsts = Pty(), [], []
    pty.start(lambda data: None)
    try:
        async with gpsd(pty.path) as client, asyncio.timeout(60):
            await client.receive(lambda report: report["class"] == "WATCH")
            number = 0
            while len(tpvs) < 10 or len(gsts) < 10:
                number += 1
                unix_us = knows_time * (1_790_000_000_000_000 + 100_000 * number)
                pty.send(written("nmea", fix_in_c(has_origin=True, origin=HALL, unix_us=unix_us)).encode())
                try:
                    report = await asyncio.wait_for(client.receive(lambda one: one["class"] in ("TPV", "GST")), 0.1)
                except TimeoutError:
                    continue
                {"TPV": tpvs, "GST": gsts}[report["class"]].append(report)
    finally:
        pty.close()
    latitude_deg, longitude_deg, height_m = geodetic((4.0, 3.0, 1.2), as_site(HALL))
    last = tpvs[-1]
    north_m = (last["lat"] - latitude_deg) * 111_270.0
    east_m = (last["lon"] - longitude_deg) * 111_320.0 * cos(radians(latitude_deg))
    assert hypot(north_m, east_m) < 0.002  # sigma is 2 cm
    assert last["altHAE"] == pytest.approx(height_m, abs=0.002)
    assert last["mode"] == 3
    assert (gsts[-1]["alt"], gsts[-1]["rms"]) == pytest.approx((0.03, 0.02), abs=1e-3)
    assert ("time" in last, "time" in gsts[-1]) == (knows_time, knows_time)
