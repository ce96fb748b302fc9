"""The real gpsd reads NMEA from each sender, and its clients get the fixes of a simulated tag."""

import asyncio
import socket
from datetime import UTC, datetime
from math import atan2, cos, degrees, hypot, radians, sqrt

import msgspec
import numpy as np
import pytest

import skyless
from skyless.bridges.target import BridgeContext, BridgedSite, Hub, floored
from skyless.bridges.targets import open_route
from skyless.core.earth import geodetic, rotated
from skyless.core.site import GeoreferenceSite
from skyless.run.mqtt.messages import FixMessage
from support.gpsd import ANSWER_S, GPSD, connected, gpsd
from support.processes import free_port

pytestmark = [pytest.mark.site, pytest.mark.skipif(GPSD is None, reason="gpsd is not installed: apt-get install gpsd")]

HALL = GeoreferenceSite(latitude_deg=52.513, longitude_deg=13.4, height_m=40.0, heading_deg=25.0)
SITE = BridgedSite(1, "lab", simulated=True, anchors_m={}, georeference=HALL)
FIRST_S = 1_790_000_000.0
EPOCHS = 110
"""The first few are for gpsd to learn which sentence ends an epoch; acceptance counts the last hundred."""


@pytest.fixture(scope="module")
def fixes():
    """As ``skyless simulate`` makes them, ten a second."""
    made = skyless.simulate(tags=1, speed_mps=0.5, fixes=EPOCHS, settle_s=1.0).fixes
    assert len(made) >= EPOCHS
    return [
        FixMessage(
            tag="tag1", serial=number, unix_s=FIRST_S + 0.1 * number, time_s=0.1 * number,
            position_m=tuple(made.position_m[number].tolist()),
            covariance_m2=tuple(made.covariance_m2[number].ravel().tolist()),
            velocity_mps=tuple(made.velocity_mps[number].tolist()),
            velocity_covariance=(1e-4, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 0.0),
            std_m=float(made.std_m[number]), gdop=1.6, pdop=1.3, hdop=1.3, vdop=0.0, anchors=(1, 2, 3, 4, 5, 6),
            chi2=3.0, dof=3, residual_rms_m=0.02, method="joint", height_known=True, latency_s=0.001,
        )
        for number in range(EPOCHS)
    ]  # fmt: skip


def distance_m(a, b):
    """Between latitude, longitude and height of points that are next to each other, on a sphere as wide as HALL's."""
    north_m, up_m = (a[0] - b[0]) * 111_270.0, a[2] - b[2]
    return hypot(north_m, (a[1] - b[1]) * 111_320.0 * cos(radians(a[0])), up_m)


async def tpvs_of(transport, fixes, folder):
    """What a client of gpsd gets for each fix, each sent once the report of the one before is there, by time."""
    path = folder / "gps"
    port = free_port(socket.SOCK_DGRAM if transport == "udp" else socket.SOCK_STREAM)
    address = f"nmea+pty:{path}" if transport == "pty" else f"nmea+{transport}://127.0.0.1:{port}"
    route = open_route(f"{address}?hz=50", BridgeContext(lambda line: None))
    hub = Hub([route], lambda line: None)
    running = asyncio.create_task(route.target.run())
    if transport == "tcp":
        (await connected(port))[1].close()
    hub.on_site(SITE)
    while transport == "pty" and not path.exists():
        await asyncio.sleep(0.001)
    device = path.resolve() if transport == "pty" else f"{transport}://127.0.0.1:{port}"
    reports, gsts, now_s = {}, {}, 0.0
    try:
        async with gpsd(str(device)) as client:
            await client.receive(lambda report: report["class"] == "WATCH")
            for number, fix in enumerate(fixes):

                def is_of(report, stamp=f"{fix.unix_s % 60:06.3f}Z"):
                    if report["class"] == "GST":
                        gsts[report["time"]] = report
                    if report["class"] == "TPV" and "time" in report:
                        reports[report["time"]] = report
                    return report["class"] == "TPV" and report.get("time", "").endswith(stamp) and "lat" in report

                # Until the device is open, and while gpsd does not know where an epoch ends, nothing may come.
                wait_s = 0.3 if number < 10 else ANSWER_S
                for attempt in range(20 if number < 10 else 1):
                    now_s += 1.0
                    hub.on_fix(msgspec.structs.replace(fix, serial=attempt), now_s)
                    try:
                        await asyncio.wait_for(client.receive(is_of), wait_s)
                        break
                    except TimeoutError:
                        continue
            hub.on_tick(now_s + 3.0, fixes[-1].unix_s + 3.0)
            outage = await client.receive(lambda report: report["class"] == "TPV" and report["mode"] == 1)
    finally:
        running.cancel()
    return reports, gsts, outage


@pytest.mark.parametrize("transport", ["udp", "tcp", "pty"])
def test_gpsd_reports_every_fix_with_its_covariance(transport, fixes, tmp_path):
    reports, gsts, outage = asyncio.run(tpvs_of(transport, fixes, tmp_path))
    judged = fixes[10:]
    found = worst_m = worst_std_m = 0
    for fix in judged:
        time = f"{datetime.fromtimestamp(fix.unix_s, UTC):%Y-%m-%dT%H:%M:%S}.{round(fix.unix_s * 10) % 10}00Z"
        report = reports.get(time)
        if report is None:
            continue
        found += 1
        worst_m = max(
            worst_m, distance_m((report["lat"], report["lon"], report["altHAE"]), geodetic(fix.position_m, HALL))
        )
        covariance = floored(rotated(fix.covariance_m2, HALL.heading_deg))
        for key, axis in (("epx", 0), ("epy", 4), ("epv", 8)):
            worst_std_m = max(worst_std_m, abs(report[key] - sqrt(covariance[axis])))
        _, axes = np.linalg.eigh(np.array(covariance).reshape(3, 3)[:2, :2])
        azimuth_deg = degrees(atan2(*axes[:, 1]))
        turned_deg = (gsts[time]["orient"] - azimuth_deg + 90.0) % 180.0 - 90.0
        assert abs(turned_deg) < 0.5
        assert report["mode"] == 3
    assert found >= 99
    assert worst_m < 0.001
    assert worst_std_m < 0.001
    assert "lat" not in outage
