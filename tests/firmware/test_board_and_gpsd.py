"""The real gpsd reads the sentences of a tag on a board from a pseudo-terminal."""

import asyncio
import ctypes
from math import cos, hypot, radians

import pytest
from emulator.board_library import library
from emulator.build import HAS_HOST_COMPILER

from skyless.core.earth import geodetic
from skyless.core.site import GeoreferenceSite
from skyless.radio.serial.serial_port import Pty
from support.board_tag import OriginInC, fix_in_c
from support.gpsd import GPSD, gpsd

pytestmark = [
    pytest.mark.site,
    pytest.mark.skipif(GPSD is None, reason="gpsd is not installed: apt-get install gpsd"),
    pytest.mark.skipif(not HAS_HOST_COMPILER, reason="make and gcc are not installed"),
]

HALL = OriginInC(525_130_000, 134_000_000, 40_000, 250_000_000)


def sentences(unix_us):
    fix, data = fix_in_c(has_origin=True, origin=HALL, unix_us=unix_us), bytearray(1280)
    into = (ctypes.c_char * len(data)).from_buffer(data)
    return bytes(data[: library().nmea_write(ctypes.byref(fix), into)])


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
                pty.send(sentences(knows_time * (1_790_000_000_000_000 + 100_000 * number)))
                try:
                    report = await asyncio.wait_for(client.receive(lambda one: one["class"] in ("TPV", "GST")), 0.1)
                except TimeoutError:
                    continue
                {"TPV": tpvs, "GST": gsts}[report["class"]].append(report)
    finally:
        pty.close()
    latitude_deg, longitude_deg, height_m = geodetic((4.0, 3.0, 1.2), GeoreferenceSite(52.513, 13.4, 40.0, 25.0))
    last = tpvs[-1]
    north_m = (last["lat"] - latitude_deg) * 111_270.0
    east_m = (last["lon"] - longitude_deg) * 111_320.0 * cos(radians(latitude_deg))
    assert hypot(north_m, east_m) < 0.002  # sigma is 2 cm
    assert last["altHAE"] == pytest.approx(height_m, abs=0.002)
    assert last["mode"] == 3
    assert (gsts[-1]["alt"], gsts[-1]["rms"]) == pytest.approx((0.03, 0.02), abs=1e-3)
    assert ("time" in last, "time" in gsts[-1]) == (knows_time, knows_time)
